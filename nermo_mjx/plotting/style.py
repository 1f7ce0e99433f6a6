"""The look that all figures share: type, and colours by meaning.

Colours of things are from Okabe and Ito's palette, which colour-blind readers can distinguish; colours of values
are those of viridis, which is perceptually uniform and increases in lightness, so that it survives printing in grey.
"""

from __future__ import annotations

from typing import Any, Final

#: Okabe, M. and Ito, K., "Color universal design", 2008.
OKABE_ITO: Final = {
    "black": "#000000",
    "orange": "#e69f00",
    "sky": "#56b4e9",
    "green": "#009e73",
    "yellow": "#f0e442",
    "blue": "#0072b2",
    "vermilion": "#d55e00",
    "purple": "#cc79a7",
}
INK, MUTED_INK, GRID, SHADE, MISSING_COLOUR = "#222222", "#555555", "#e6e6e6", "#f1f1f1", "#d9d9d9"
#: The main line, secondary lines, and the best value.
LINE_COLOUR, BAND_COLOUR, BEST_COLOUR = OKABE_ITO["blue"], "#9cc9e6", OKABE_ITO["vermilion"]
#: Several things side by side, in this order; yellow is too pale for lines on white.
SERIES: Final = tuple(
    OKABE_ITO[name] for name in ("blue", "orange", "green", "purple", "sky", "vermilion")
)
#: The feet: front blue, rear red; left dark, right light.
FOOT: Final = {
    "front_left": OKABE_ITO["blue"],
    "front_right": OKABE_ITO["sky"],
    "rear_left": OKABE_ITO["vermilion"],
    "rear_right": OKABE_ITO["orange"],
}
#: The tail, next to the feet.
TAIL_COLOUR: Final = OKABE_ITO["purple"]
#: Numbers from low to high, and gains and losses about 0.
COLOUR_MAP: Final = "viridis"
GAIN_COLOUR_MAP: Final = "RdBu"
#: Sizes of type that are not those of `STYLE` [pt].
SMALL_POINTS: Final = 8.0

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": [
        "DejaVu Sans"
    ],  # bundled with matplotlib, so that it is the same on all machines
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.5,
    "figure.titlesize": 11.5,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": MUTED_INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": MUTED_INK,
    "ytick.color": MUTED_INK,
    "axes.grid": False,
    "axes.prop_cycle": f"cycler(color={SERIES})",
    "axes.unicode_minus": True,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "svg.hashsalt": "nermo",
    "svg.fonttype": "none",  # text stays text
}
