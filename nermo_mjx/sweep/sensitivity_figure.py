"""Figures of Sobol indices, from their table alone: a bar for each parameter alone and with interactions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import BAND, GRID, INK, LINE, MUTED, OKABE_ITO
from nermo_mjx.sweep.figures import titled
from nermo_mjx.sweep.sensitivity import strongest
from nermo_mjx.sweep.table import labelled, report_table

Line = Mapping[str, Any]
#: Bars, and panels, of one figure.
_MOST_PARAMETERS: Final = 16
_MOST_PAIRS: Final = 10
_MOST_PANELS: Final = 6
_COLOURS: Final = {"first": LINE, "total": BAND, "second": OKABE_ITO["purple"]}
_WORDS: Final = {"first": "alone (first)", "total": "with all others (total)", "second": "of a pair (second)"}


def figures(out: Path) -> Figures:
    """The figures of a sensitivity's directory.

    Raises:
        DirectoryError: its table is absent or damaged.
    """
    return figures_of(report_table(out, "sensitivity"))


def figures_of(table: pa.Table) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of a table of indices; a panel for each structure, and one for its pairs."""
    about = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
    lines, metric = table.to_pylist(), about["sensitivity"]
    structures = labelled(table)
    parts = list(dict.fromkeys(tuple(line[name] for name in structures) for line in lines))[:_MOST_PANELS]
    names = strongest(table)[:_MOST_PARAMETERS]
    pairs = any(line["order"] == "second" for line in lines)
    columns = 2 if pairs else min(len(parts), 2)
    rows = len(parts) if pairs else -(-len(parts) // columns)
    size = (5.6 if columns == 1 else 9.6, rows * (0.34 * len(names) + 0.9) + 1.2)
    page = Page(f"What {titled(metric).lower()} depends on", size, rows, columns)
    axes = page.axes.ravel()
    places = iter(axes)
    for part in parts:
        own = [line for line in lines if tuple(line[name] for name in structures) == part]
        title = ", ".join(f"{name} {value}" for name, value in zip(structures, part, strict=True))
        _bars(next(places), own, names, title)
        if pairs:
            _pairs(next(places), own, title)
    for ax in places:
        ax.remove()
    orders = dict.fromkeys(line["order"] for line in lines)
    handles = [Patch(fc=_COLOURS[order], label=_WORDS[order]) for order in orders]
    more = len(strongest(table)) - len(names)
    note = "share of the variance; lines: 95 % intervals" + f"; {more} weaker ones are in the table" * (more > 0)
    yield f"{metric}-sensitivity", page.finish(handles, f"{note}\n{about['notes']}".strip())


def _bars(ax: Axes, lines: Sequence[Line], names: Sequence[str], title: str) -> None:
    orders = [order for order in ("total", "first") if any(line["order"] == order for line in lines)]
    for order in orders:
        own = {line["parameter"]: line for line in lines if line["order"] == order}
        shift = 0.0 if len(orders) == 1 else -0.19 if order == "first" else 0.19
        there = [(place, own[name]) for place, name in enumerate(names) if name in own]
        _draw(ax, np.array([place + shift for place, _ in there]), [line for _, line in there], 0.38 if shift else 0.6)
    _finish(ax, names, title)


def _pairs(ax: Axes, lines: Sequence[Line], title: str) -> None:
    pairs = sorted((line for line in lines if line["order"] == "second"), key=lambda line: -line["index"])[:_MOST_PAIRS]
    _draw(ax, np.arange(len(pairs), dtype=float), pairs, 0.6)
    _finish(ax, [f"{line['parameter']}\n{line['second']}" for line in pairs], title)


def _draw(ax: Axes, places: np.ndarray, lines: Sequence[Line], height: float) -> None:
    if lines:
        values = np.array([[line["index"], line["low"], line["high"]] for line in lines])
        ax.barh(places, values[:, 0], height, color=_COLOURS[lines[0]["order"]])
        ax.hlines(places, values[:, 1], values[:, 2], color=INK, lw=1.0)


def _finish(ax: Axes, names: Sequence[str], title: str) -> None:
    ax.axvline(0, color=MUTED, lw=0.8)
    ax.set_yticks(range(len(names)), names)
    ax.set(ylim=(max(len(names), 1) - 0.4, -0.6), title=title, xlabel="Sobol index [1]")
    low, high = ax.get_xlim()
    ax.set_xlim(max(low, -0.5), min(max(high, 0.1), 1.5))
    ax.grid(axis="x", color=GRID, lw=0.8)
