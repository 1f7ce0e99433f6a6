"""The look that all figures share: type, colours by meaning, scales and grids.

Colours of things are from Okabe and Ito's palette, which colour-blind readers can distinguish; colours of values
are those of viridis, which is perceptually uniform and increases in lightness, so that it survives printing in grey.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_hex, to_rgb
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullLocator

from nermo_mjx.plotting.shown import ShownValues, spoken

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
INK, MUTED, GRID, SHADE, MISSING = "#222222", "#555555", "#e6e6e6", "#f1f1f1", "#d9d9d9"
#: The main line, secondary lines, and the best value.
LINE, BAND, BEST = OKABE_ITO["blue"], "#9cc9e6", OKABE_ITO["vermilion"]
#: Several things side by side, in this order; yellow is too pale for lines on white.
SERIES: Final = tuple(OKABE_ITO[name] for name in ("blue", "orange", "green", "purple", "sky", "vermilion"))
#: The feet: front blue, rear red; left dark, right light.
FOOT: Final = {
    "front_left": OKABE_ITO["blue"],
    "front_right": OKABE_ITO["sky"],
    "rear_left": OKABE_ITO["vermilion"],
    "rear_right": OKABE_ITO["orange"],
}
#: The tail, next to the feet.
TAIL: Final = OKABE_ITO["purple"]
#: Numbers from low to high, and gains and losses about 0.
COLOURS: Final = "viridis"
GAIN_COLOURS: Final = "RdBu"
#: Sizes of type that are not those of `STYLE` [pt].
SMALL: Final = 8.0

#: Share of outliers at an end that are excluded from the colours where they would take most of the scale.
_TAIL: Final = 0.05
_MOST: Final = 0.5

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # bundled with matplotlib, so that it is the same on all machines
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.5,
    "figure.titlesize": 11.5,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.grid": False,
    "axes.prop_cycle": cycler(color=SERIES),
    "axes.unicode_minus": True,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "svg.hashsalt": "nermo",
    "svg.fonttype": "none",  # text stays text
}


def light(colour: str) -> str:
    """The colour on its way to white."""
    red, green, blue = (0.42 * part + 0.58 for part in to_rgb(colour))
    return to_hex((red, green, blue))


def colour_scale(values: np.ndarray) -> tuple[Normalize, str]:
    """The colour scale of values, and the end at which it is cut off, as `extend` of a colour bar.

    It goes from the lowest finite value to the highest. An end at which one value of twenty or fewer would take more
    than half of the colours is cut off before them: all of these have the colour of the end.

    >>> scale, extend = colour_scale(np.array([*range(100), 900.0]))
    >>> float(scale.vmin), extend
    (0.0, 'max')
    """
    good = values[np.isfinite(values)]
    if not len(good):
        return Normalize(0.0, 1.0), "neither"
    low, high = float(good.min()), float(good.max())
    if low == high:
        return Normalize(low - abs(low) * 0.01 - 1e-9, high + abs(high) * 0.01 + 1e-9), "neither"
    first, last = np.quantile(good, [_TAIL, 1 - _TAIL]).tolist()
    cut_low, cut_high = first - low > _MOST * (high - low), high - last > _MOST * (high - low)
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max"}[cut_low, cut_high]
    return Normalize(first if cut_low else low, last if cut_high else high), extend


def set_scales(ax: Axes, x: ShownValues, y: ShownValues | None = None) -> None:
    """Linear or logarithmic axes, with ticks at round values; whole turns in round angles."""
    for quantity, axis, scale in ((x, ax.xaxis, ax.set_xscale), (y, ax.yaxis, ax.set_yscale)):
        if quantity is None:
            continue
        if quantity.names:
            axis.set_ticks(range(len(quantity.names)), [*map(spoken, quantity.names)])
        elif quantity.log:
            scale("log")
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FormatStrFormatter("%g"))
            axis.set_minor_locator(NullLocator())
        elif quantity.unit == "deg" and np.ptp(quantity.values) >= 180:
            axis.set_major_locator(MaxNLocator(6, steps=[1, 3, 4.5, 6, 9, 10]))
        else:
            axis.set_major_locator(MaxNLocator(5))


def horizontal_grid(ax: Axes) -> None:
    """Faint lines to read values by, and a line at zero where values have both signs."""
    ax.grid(axis="y", color=GRID, lw=0.8)
    ax.set_axisbelow(True)
    low, high = ax.get_ylim()
    if low < 0 < high:
        ax.axhline(0, color=MUTED, lw=0.8, zorder=1)
