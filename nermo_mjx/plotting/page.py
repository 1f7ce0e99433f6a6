"""The page around the axes of a figure: title above, legend and note below, with as much space as they need."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure

from nermo_mjx.plotting.style import MUTED, SMALL

#: Inches around a page, between its lines of text, and of a line of text.
_EDGE: Final = 0.1
_GAP: Final = 0.08
_LINE: Final = 0.15
#: Mean width of a character of the note, and of the title [inch].
_CHARACTER: Final = 0.059
_TITLE_CHARACTER: Final = 0.098
_TITLE_LINE: Final = 0.21


class Page:
    """A figure with a title above its axes, and a legend and a note below.

    Attributes:
        figure: to draw on.
        axes: (rows, columns) of `Axes`.
    """

    def __init__(self, title: str, size: tuple[float, float], rows: int = 1, columns: int = 1, **subplots) -> None:
        self.figure = blank(*size)
        self.axes: np.ndarray = self.figure.subplots(rows, columns, squeeze=False, **subplots)
        self._title = title
        for ax in self.axes.ravel():
            ax.set_axisbelow(True)

    def finish(self, handles: Sequence[Artist], note: str) -> Figure:
        """Add title, legend, in as few rows as fit, and note; the axes keep the rest of the page."""
        return around(self.figure, self._title, note, handles)


def blank(width: float, height: float) -> Figure:
    """A blank figure of the given size in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def page(title: str, width: float, height: float, note: str = "") -> Figure:
    """A blank figure of the given size in inches, its title above and its note below; axes share what is left."""
    return around(blank(width, height), title, note)


def around(figure: Figure, title: str, note: str, handles: Sequence[Artist] = ()) -> Figure:
    """Put the title above a figure's axes, and legend and note below; its layout keeps the axes off them.

    Lines of the title and the note that are too long for the page are broken; see `note_lines`.
    """
    width, height = figure.get_size_inches()
    head = textwrap.wrap(title, int((width - 2 * _EDGE) / _TITLE_CHARACTER))
    figure.text(
        _EDGE / width, 1 - _EDGE / height, "\n".join(head), va="top", fontsize=11.5, fontweight="bold", linespacing=1.15
    )
    lines = note_lines(note, width)
    figure.text(
        _EDGE / width, _EDGE / height, "\n".join(lines), va="bottom", fontsize=SMALL, color=MUTED, linespacing=1.2
    )
    below = _EDGE + _LINE * len(lines) + _GAP * bool(lines)
    if handles:
        below += _legend(figure, handles, below) + _GAP
    above = _EDGE + _TITLE_LINE * len(head) + 0.07
    engine = figure.get_layout_engine()
    engine.set(rect=(0, below / height, 1 - _EDGE / width, 1 - (below + above) / height), hspace=0.05, wspace=0.05)  # type: ignore[union-attr, call-arg]
    return figure


def colour_bar(figure: Figure, axes: Any, colours: ScalarMappable, label: str, **look: Any) -> Colorbar:
    """A colour bar beside axes, with its label and without a frame."""
    bar = figure.colorbar(colours, ax=axes, **{"pad": 0.02, "extendfrac": 0.03} | look)
    bar.set_label(label)
    bar.outline.set_visible(False)
    return bar


def note_lines(note: str, width: float) -> list[str]:
    """The lines of a note on a page of the given width in inches; text after a tab is indented together."""
    broken: list[str] = []
    for line in note.splitlines():
        hangs = "\t" in line
        broken += textwrap.wrap(
            line.replace("\t", "   "),
            int((width - 2 * _EDGE) / _CHARACTER),
            subsequent_indent="      " if hangs else "",
            replace_whitespace=False,
        )
    return broken


def _legend(figure: Figure, handles: Sequence[Artist], below: float) -> float:
    """The legend in the fewest rows that fit the page; its height [inch]."""
    width, height = figure.get_size_inches()
    for rows in range(1, len(handles) + 1):
        columns = -(-len(handles) // rows)
        legend = figure.legend(
            # Matplotlib fills a legend column by column; in this order, it reads row by row.
            handles=[handle for first in range(columns) for handle in handles[first::columns]],
            ncols=columns,
            columnspacing=1.4,
            handlelength=1.7,
            loc="lower left",
            bbox_to_anchor=(_EDGE / width, below / height),
            borderaxespad=0,
            borderpad=0.2,
        )
        box = legend.get_window_extent(figure.canvas.get_renderer())  # type: ignore[attr-defined]
        if box.width / figure.dpi <= width - 2 * _EDGE or columns == 1:
            return box.height / figure.dpi
        legend.remove()
    raise AssertionError("one column is always taken")
