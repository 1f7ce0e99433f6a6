"""What all figures have in common: the units they show, colours and type, scales, the note below, and their files."""

from __future__ import annotations

import dataclasses
import io
import math
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import ArrayLike

#: One look for all figures; viridis, blue on white and red to blue read well for the colour-blind and in print.
STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.5,
    "figure.titlesize": 11.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.labelcolor": "#222222",
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "axes.grid": False,
    "legend.frameon": False,
    "svg.hashsalt": "nermo",
    "svg.fonttype": "none",
}
COLOURS = "viridis"
LINE, BAND, MISSING, BEST, MUTED = "#23648f", "#9dc3de", "#d9d9d9", "#e4572e", "#555555"
#: Height of a line of the note, and mean width of its characters [inch].
_LINE, _CHARACTER = 0.15, 0.059
_SHOWN_UNITS = {
    "rad": ("deg", 180 / math.pi),
    "m/s": ("mm/s", 1e3),
    "m": ("mm", 1e3),
    "rad/s": ("deg/s", 180 / math.pi),
}


@dataclasses.dataclass(frozen=True)
class Quantity:
    """Values of one column as a figure shows them: angles in degrees, lengths in mm, speeds in mm/s.

    Attributes:
        name, unit: what the axis is called; the unit is empty for a pure number.
        values: (n,), in that unit.
        log: whether the axis is logarithmic.
    """

    name: str
    unit: str
    values: np.ndarray
    log: bool = False

    @property
    def label(self) -> str:
        """Name and unit for an axis."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def shown(self, value: float) -> str:
        """One value with its unit, for a title."""
        return f"{value + 0.0:.4g} {self.unit}".rstrip()


def shown(name: str, unit: str, values: ArrayLike, *, log: bool = False) -> Quantity:
    """A column in SI units as a `Quantity`."""
    unit, factor = _SHOWN_UNITS.get(unit, ("" if unit == "1" else unit, 1.0))
    return Quantity(name, unit, np.asarray(values, dtype=float) * factor, log)


def page(title: str, width: float, height: float, note: str = "") -> Figure:
    """An empty figure of so many inches, its title above and its note below; axes share what is left."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, x=0.1 / width, ha="left", fontweight="bold")
    lines = textwrap.wrap(note, int((width - 0.2) / _CHARACTER))
    figure.text(0.1 / width, 0.06 / height, "\n".join(lines), fontsize=8, color=MUTED, va="bottom", linespacing=1.2)
    below = (0.12 + _LINE * len(lines)) / height
    figure.get_layout_engine().set(rect=(0, below, 1, 1 - below))  # type: ignore[union-attr, call-arg]
    return figure


def set_scales(ax: Axes, x: Quantity, y: Quantity | None = None) -> None:
    """Linear or logarithmic axes, with ticks at round values; whole turns in round angles."""
    for quantity, axis, scale in ((x, ax.xaxis, ax.set_xscale), (y, ax.yaxis, ax.set_yscale)):
        if quantity is None:
            continue
        if quantity.log:
            scale("log")
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FormatStrFormatter("%g"))
            axis.set_minor_locator(NullLocator())
        elif quantity.unit == "deg" and np.ptp(quantity.values) >= 180:
            axis.set_major_locator(MaxNLocator(6, steps=[1, 3, 4.5, 6, 9, 10]))
        else:
            axis.set_major_locator(MaxNLocator(5))


def horizontal_grid(ax: Axes) -> None:
    """Faint lines to read values by."""
    ax.grid(axis="y", color="#e6e6e6", lw=0.8)
    ax.set_axisbelow(True)


def add_note(figure: Figure, text: str) -> None:
    """A small line below the panels."""
    figure.text(0.01, 0.005, text, fontsize=8, color=MUTED, va="bottom")


def encode(figure: Figure, form: str) -> bytes:
    """The figure as PNG or SVG; the same figure gives the same bytes."""
    stream = io.BytesIO()
    figure.savefig(stream, format=form, dpi=160, metadata={"Date": None} if form == "svg" else {"Software": None})
    return stream.getvalue()


def lay_out(figure: Figure) -> None:
    """Fix the places of a figure's axes, once for all its files."""
    for _ in range(2):  # axes of equal scales take a second time
        figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for ax in figure.axes:  # the layout's last digits differ from run to run, and with them the files' bytes
        ax.set_position(np.round(ax.get_position(original=True).bounds, 6).tolist())


def write_figure(
    figure: Figure, folder: Path, name: str, write: Callable[[Path, bytes], None] | None = None
) -> list[Path]:
    """Write a figure that is laid out as FOLDER/NAME.png and .svg, and return the two files.

    Args:
        write: how a file is written; `Path.write_bytes` if it is None.
    """
    files = [folder / f"{name}.{form}" for form in ("png", "svg")]
    for file in files:
        (write or Path.write_bytes)(file, encode(figure, file.suffix[1:]))
    return files
