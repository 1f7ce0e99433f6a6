"""Figures that compare the structures of a sweep: a line, a panel or a dot for each combination of them."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nermo_mjx.plotting.page import around, blank
from nermo_mjx.plotting.shown import ShownValues
from nermo_mjx.plotting.style import BEST, GRID, INK, SERIES, horizontal_grid, set_scales
from nermo_mjx.sweep.figures import alike, best_word, binned, heat_maps, metric_of, panelled, quantities, titled
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.table import columns_of, cost, labelled

#: Lines or panels of one figure; more structures are told by one of their names alone.
MOST_GROUPS: Final = 12
#: Parameters with a figure of their own, and of which pairs are drawn.
_MOST_ALONE: Final = 6
_MOST_PAIRED: Final = 3
_DASHES: Final = ("-", "--", ":", "-.")
#: Maximum number of lines with bands of spread; more would cover each other.
_MOST_BANDS: Final = 4
_BINS: Final = 9


@dataclasses.dataclass(frozen=True)
class Groups:
    """The structures of a table.

    Attributes:
        names: what each is called.
        of: which one each run has, (rows,) int.
        what: of which columns they are, in words.
    """

    names: tuple[str, ...]
    of: np.ndarray
    what: str


def groups_of(results: Results, most: int = MOST_GROUPS) -> Groups | None:
    """The combinations of structures, None where there is one alone; of fewer columns where they were too many."""
    columns = {name: results.column(name) for name in labelled(results)}
    columns = {name: column for name, column in columns.items() if len(set(column.tolist())) > 1}
    chosen = list(columns)
    while chosen:
        each = list(zip(*(columns[name].tolist() for name in chosen), strict=True))
        places = {key: place for place, key in enumerate(dict.fromkeys(each))}
        if len(places) <= most or len(chosen) == 1:
            left = [name for name in columns if name not in chosen]
            what = ", ".join(chosen) + (f"; mean over {', '.join(left)}" if left else "")
            return Groups(tuple(map(", ".join, places)), np.array([places[key] for key in each]), what)
        chosen.pop()
    return None


def structure_figures(results: Results, groups: Groups, metric: str, remark: str = "") -> Iterator[tuple[str, Figure]]:
    """(file name, figure): a metric of each structure; over each parameter, and on a grid over pairs of them."""
    z = metric_of(results, metric)
    numbers = [name for name in columns_of(results, "varied") if name not in labelled(results)]
    drawn = [x for x in quantities(results, numbers) if not alike(x.values)]
    yield f"{metric}-over-structures", dots(groups, z, f"{titled(metric)} of each structure", remark)
    for x in drawn[:_MOST_ALONE]:
        title = f"{titled(metric)} over {x.name}, by structure"
        yield f"{metric}-over-{x.name}-by-structure", lines(x, z, groups, title, remark, even=not results.is_grid)
    for x, y in itertools.combinations(drawn[:_MOST_PAIRED] if results.is_grid else [], 2):
        good = np.isfinite(x.values) & np.isfinite(y.values)
        across, up, value = (dataclasses.replace(each, values=each.values[good]) for each in (x, y, z))
        which = groups.of[good]
        here = np.unique(which)
        note = remark
        if len(drawn) > 2:
            note += f"mean over {', '.join(each.name for each in drawn if each.name not in (x.name, y.name))}; "
        if lacking := len(groups.names) - len(here):
            note += f"{lacking} structures without one of them; "
        if len(here) > MOST_GROUPS:
            note += f"{len(here) - MOST_GROUPS} more structures not shown; "
        title = f"{titled(metric)} over {x.name} and {y.name}, by structure"
        panels = [(groups.names[place], which == place) for place in here[:MOST_GROUPS]]
        yield f"{metric}-over-{x.name}-and-{y.name}-by-structure", heat_maps(across, up, value, panels, title, note)


def dots(groups: Groups, z: ShownValues, title: str, note: str) -> Figure:
    """A dot for each structure at the mean of its runs, a bar of one standard deviation; the best one in orange."""
    count = len(groups.names)
    mean, spread = np.full(count, np.nan), np.zeros(count)
    for place in range(count):
        own = z.values[(groups.of == place) & np.isfinite(z.values)]
        if len(own):
            mean[place], spread[place] = own.mean(), own.std()
    best = int(np.nanargmin(cost(z.side, mean))) if np.isfinite(mean).any() else -1
    figure = blank(7.2, 1.3 + 0.3 * count)
    ax = figure.subplots()
    for place in range(count):
        colour = BEST if place == best else SERIES[0]
        ax.errorbar(mean[place], place, xerr=spread[place], color=colour, elinewidth=2, alpha=0.5)
        ax.plot(mean[place], place, "o", color=colour, ms=7, mec="white")
    ax.set_yticks(range(count), groups.names, color=INK)
    ax.set(xlabel=z.label, ylim=(count - 0.5, -0.5))
    ax.grid(axis="x", color=GRID, lw=0.8)
    ax.set_axisbelow(True)
    told = f"; orange: {best_word(z)}, {z.shown(mean[best])}" if best >= 0 else ""
    return around(figure, title, f"{note}{groups.what}: mean of all runs, and their standard deviation{told}")


def lines(x: ShownValues, z: ShownValues, groups: Groups, title: str, note: str, *, even: bool) -> Figure:
    """A line for each structure: the mean at each value of x, or in bins with as many runs where x is `even`.

    A structure that has no such parameter is a level line at its mean.
    """
    figure, (ax,) = panelled(1, 4.6)
    handles, level = [], False
    for place, name in enumerate(groups.names):
        own = (groups.of == place) & np.isfinite(z.values)
        colour, dashes = place % len(SERIES), place // len(SERIES) % len(_DASHES)
        style: dict[str, Any] = {"color": SERIES[colour], "ls": _DASHES[dashes]}
        handles.append(Line2D([], [], label=name, **style))
        there = own & np.isfinite(x.values)
        if not there.any():
            if own.any():
                ax.axhline(z.values[own].mean(), lw=1.2, alpha=0.8, **style)
                level = True
            continue
        nodes = np.quantile(x.values[there], np.linspace(0, 1, _BINS)) if even else np.unique(x.values[there])
        xs, mean, std = binned(x.values[there], z.values[there], nodes)
        if len(groups.names) <= _MOST_BANDS:
            ax.fill_between(xs, mean - std, mean + std, color=style["color"], alpha=0.15, lw=0)
        ax.plot(xs, mean, marker="o", ms=3.5, mec="white", mew=0.5, **style)
    set_scales(ax, x)
    horizontal_grid(ax)
    ax.set(xlabel=x.label, ylabel=z.label)
    said = [f"{groups.what}: " + ("running mean" if even else "mean over everything else")]
    said += ["band: standard deviation"] if len(groups.names) <= _MOST_BANDS else []
    said += [f"level: without {x.name}"] if level else []
    return around(figure, title, note + "; ".join(said), handles)
