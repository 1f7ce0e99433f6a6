"""The figures of a search."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from nermo_mjx.optimize.objective import Term
from nermo_mjx.optimize.search import Search, cells_of, elites_of
from nermo_mjx.optimize.search_directory import SEARCH, Evaluations, atlas_progress, hypervolumes
from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.page import around, blank, page
from nermo_mjx.plotting.shown import ShownValues, shown
from nermo_mjx.plotting.style import BAND, BEST, COLOURS, LINE, MUTED, colour_scale, horizontal_grid, set_scales
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Metric
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.sweep.plots import chosen_figure
from nermo_mjx.sweep.results import Results, chunk_files
from nermo_mjx.sweep.survey import named_points, survey_figures, trade_off

_WIDTH: Final = 7.2
#: Pairs of measures that an atlas of three or more shows.
_MOST_PAIRS: Final = 6


def convergence(found: Evaluations) -> Figure:
    """Every evaluated point, in the order in which they were asked for, and the best so far."""
    quantity = _objective(found)
    values, allowed = quantity.values, found.scores.allowed
    number = np.arange(1, len(values) + 1)
    cost = np.where(allowed, found.scores.cost[:, 0], np.inf)
    best = int(np.argmin(cost))
    first = np.concatenate([[True], cost[1:] < np.minimum.accumulate(cost)[:-1]])  # better than all before it
    leading = np.maximum.accumulate(np.where(first, np.arange(len(cost)), 0))
    at = ", ".join(f"{name} {text}" for name, text in _parameters(found, best))
    note = f"{_what(found)}; line: best so far; star: best, {quantity.shown(values[best])} at {at}"
    figure = page(f"{_named(found)} over the evaluations", _WIDTH, 4.4, note)
    ax = figure.subplots()
    ax.scatter(number[allowed], values[allowed], s=9, color=BAND, lw=0, rasterized=len(values) > 2000)
    reached = np.isfinite(cost[leading])
    ax.step(number[reached], values[leading][reached], where="post", color=LINE)
    ax.scatter(number[best], values[best], s=170, marker="*", fc=BEST, ec="white", zorder=5, clip_on=False)
    _mark_lost(ax, number, ~allowed)
    low, high = np.nanquantile(values[allowed], [0.01, 1.0] if _higher(found) else [0.0, 0.99])
    room = 0.06 * max(high - low, 1e-9)
    ax.set(ylim=(low - room, high + room), xlim=(0, len(values) + 1))
    horizontal_grid(ax)
    ax.set(xlabel="evaluations [1]", ylabel=quantity.label)
    return figure


def front(found: Evaluations) -> Figure:
    """The first two objectives against each other, with the front of these two or of all."""
    terms, best = found.search.aim.objective.terms, found.front()
    allowed = np.flatnonzero(found.scores.allowed)
    x, y = (_term_values(found, i) for i in (0, 1))
    place = {int(point): i for i, point in enumerate(allowed)}
    named = [int(best[i]) for i in named_points(x.values[best], y.values[best])]
    lines = [
        (place[point], f"{x.name} {x.shown(x.values[point])}, {y.name} {y.shown(y.values[point])}:  "
                       + ", ".join(f"{name} {text}" for name, text in _parameters(found, point)))
        for point in named
    ]  # fmt: skip
    more = f"front of all {len(terms)} objectives; " if len(terms) > 2 else ""
    across, up = (ShownValues(each.name, each.unit, each.values[allowed]) for each in (x, y))
    first, second = ("max" if term.aim == "maximize" else "min" for term in terms[:2])
    # A line along a front of more objectives would cross itself.
    sides = (first, second) if len(terms) == 2 else ("nearest zero", "nearest zero")
    title = f"{x.name} against {y.name}".replace("_", " ").capitalize()
    places = np.array([place[int(point)] for point in best])
    return trade_off(across, up, places, sides, lines, title, f"{_what(found)}; {more}")


def hypervolume(found: Evaluations) -> Figure:
    """How much of the box between first batch and best values the front beats, over the evaluations."""
    shares, worst = hypervolumes(found)
    corner = ", ".join(
        f"{term.metric} {_unit(found, term.metric, _as_metric(term, value))}"
        for term, value in zip(found.search.aim.objective.terms, worst.tolist(), strict=True)
    )
    note = f"{_what(found)}; box: from the best of each objective to the worst of the first batch, {corner}"
    figure = page("Hypervolume of the front over the evaluations", _WIDTH, 3.6, note)
    ax = figure.subplots()
    ax.step(_ends(found), 100 * shares, where="post", color=LINE)
    ax.set(xlabel="evaluations [1]", ylabel="hypervolume [%]", xlim=(0, len(found.scores) + 1))
    horizontal_grid(ax)
    return figure


def coverage(found: Evaluations) -> Figure:
    """Filled cells and QD score over the evaluations."""
    filled, total = atlas_progress(found)
    cells = int(np.prod([each.cells for each in found.search.aim.measures]))
    note = f"{_what(found)}; {filled[-1]:,} of {cells:,} cells are filled; QD score: sum over the filled cells of " \
           "what their best is better than the worst of the first batch"  # fmt: skip
    figure = page("Filled cells and QD score over the evaluations", _WIDTH, 4.8, note)
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.step(_ends(found), filled, where="post", color=LINE)
    top.set_ylabel("filled cells [1]")
    term = found.search.aim.objective.terms[0]
    single = len(found.search.aim.objective.terms) == 1 and term.aim != "hold"
    scale = shown(term.metric, _about(found)[term.metric].unit, total * term.scale / term.weight) if single else None
    bottom.step(_ends(found), total if scale is None else scale.values, where="post", color=LINE)
    bottom.set_ylabel(f"QD score [{1 if scale is None else scale.unit or 1}]")
    for ax in (top, bottom):
        ax.set_ylim(bottom=0)
        horizontal_grid(ax)
    bottom.set(xlabel="evaluations [1]", xlim=(0, len(found.scores) + 1))
    return figure


def atlas(found: Evaluations) -> Figure:
    """The best in each cell: bars over one measure, a map over two, maps over the pairs of more."""
    aim, quantity = found.search.aim, _objective(found)
    cells, points = elites_of(aim, found.scores)
    best = int(points[np.argmax(found.scores.quality[points])])
    total = int(np.prod([each.cells for each in aim.measures]))
    at = ", ".join(f"{name} {text}" for name, text in _parameters(found, best))
    note = f"{_what(found)}; {len(cells):,} of {total:,} cells are filled; star: best, " \
           f"{quantity.shown(quantity.values[best])} at {at}"  # fmt: skip
    title = f"{_named(found)}: the best in each cell"
    if len(aim.measures) == 1:
        return _bars(found, points, quantity, best, title, note)
    pairs = list(itertools.combinations(range(len(aim.measures)), 2))[:_MOST_PAIRS]
    if len(pairs) > 1:
        note += "; each map shows the best over all other measures"
    columns = min(len(pairs), 2)
    rows = -(-len(pairs) // columns)
    figure = blank(_WIDTH, 1.1 + 4.2 * rows / (1 if columns == 1 else 1.3))
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    scale, extend = colour_scale(quantity.values[points])
    for ax in axes[len(pairs) :]:
        ax.remove()
    for ax, (i, j) in zip(axes, pairs, strict=False):
        _map(ax, found, points, quantity, scale, (i, j), best)
    bar = figure.colorbar(ScalarMappable(scale, COLOURS), ax=axes[: len(pairs)].tolist(), shrink=0.9, pad=0.02,
                          extend=extend, extendfrac=0.03)  # fmt: skip
    bar.set_label(quantity.label)
    bar.outline.set_visible(False)
    return around(figure, title, note)


def _map(
    ax: Axes, found: Evaluations, points: np.ndarray, z: ShownValues, scale: Normalize, pair: tuple[int, int], best: int
) -> None:
    """Cells of two measures, coloured by the best point in each."""
    x, y = (found.search.aim.measures[i] for i in pair)
    place = [np.clip(((found.scores.measures[points, i] - each.low) / (each.high - each.low) * each.cells).astype(int),
                     0, each.cells - 1) for i, each in zip(pair, (x, y), strict=True)]  # fmt: skip
    grid = np.full((x.cells, y.cells), np.nan)
    order = np.argsort(found.scores.quality[points], kind="stable")  # the best of several comes last
    grid[place[0][order], place[1][order]] = z.values[points[order]]
    xs, ys = (shown(each.metric, _about(found)[each.metric].unit, np.linspace(each.low, each.high, each.cells + 1))
              for each in (x, y))  # fmt: skip
    ax.set_facecolor("#fafafa")
    ax.pcolormesh(xs.values, ys.values, np.ma.masked_invalid(grid.T), norm=scale, cmap=COLOURS)
    star_x, star_y = (shown(each.metric, _about(found)[each.metric].unit, found.scores.measures[best, i]).values
                      for i, each in zip(pair, (x, y), strict=True))  # fmt: skip
    ax.scatter(star_x, star_y, s=190, marker="*", fc=BEST, ec="white", lw=1.3, zorder=5, clip_on=False)
    set_scales(ax, xs, ys)
    ax.set(xlabel=xs.label, ylabel=ys.label)


def _bars(found: Evaluations, points: np.ndarray, z: ShownValues, best: int, title: str, note: str) -> Figure:
    """The best point over one measure."""
    measure = found.search.aim.measures[0]
    figure = page(title, _WIDTH, 3.9, note)
    ax = figure.subplots()
    unit = _about(found)[measure.metric].unit
    edges = shown(measure.metric, unit, np.linspace(measure.low, measure.high, measure.cells + 1))
    cell = cells_of(found.search.aim, found.scores.measures[points])
    values = z.values[points]
    floor = min(float(values.min()), 0.0) if np.ptp(values) == 0 else float(values.min() - 0.1 * np.ptp(values))
    ax.bar(edges.values[cell], values - floor, np.diff(edges.values)[cell], floor, align="edge", color=BAND, ec="white")
    at = shown(measure.metric, unit, found.scores.measures[best, 0]).values
    ax.scatter(at, z.values[best], s=170, marker="*", fc=BEST, ec="white", zorder=5, clip_on=False)
    ax.set(xlabel=edges.label, ylabel=z.label, xlim=(edges.values[0], edges.values[-1]))
    horizontal_grid(ax)
    return figure


def _objective(found: Evaluations) -> ShownValues:
    """The objective of all points, in the metric's unit where it is one metric, NaN where a run failed."""
    terms = found.search.aim.objective.terms
    if len(terms) == 1 and terms[0].aim != "hold":
        return _term_values(found, 0)
    return ShownValues("objective", "", found.scores.cost[:, 0])


def _term_values(found: Evaluations, place: int) -> ShownValues:
    """The metric of a term, or what it adds where it holds the metric at a value."""
    term, cost = found.search.aim.objective.terms[place], found.scores.cost[:, place]
    if term.aim == "hold":
        return ShownValues(f"{term.metric} off {term.at:g}", "", cost)
    return shown(term.metric, _about(found)[term.metric].unit, _as_metric(term, cost))


def _as_metric(term: Term, cost: np.ndarray | float) -> np.ndarray | float:
    """The metric of a cost, of a term that maximizes or minimizes it."""
    return cost if term.aim == "hold" else cost * term.scale / term.weight * (-1.0 if term.aim == "maximize" else 1.0)


def _named(found: Evaluations) -> str:
    return _objective(found).name.replace("_", " ").capitalize()


def _higher(found: Evaluations) -> bool:
    terms = found.search.aim.objective.terms
    return len(terms) == 1 and terms[0].aim == "maximize"


def _about(found: Evaluations) -> dict[str, Metric]:
    """Every metric of the runs, by name."""
    return found.search.sweep.metrics


def _unit(found: Evaluations, metric: str, value: np.ndarray | float) -> str:
    quantity = shown(metric, _about(found)[metric].unit, value)
    return quantity.shown(float(quantity.values))


def _parameters(found: Evaluations, point: int) -> list[tuple[str, str]]:
    """Names of the first parameters of a point, and their values as people read them."""
    about = found.search.sweep.parameters
    names = list(found.search.names[:6])
    values = found.means(names, np.array([point]))
    quantities = (shown(name, about[name].unit, values[name][0]) for name in names)
    return [(each.name, each.shown(float(each.values))) for each in quantities]


def _what(found: Evaluations) -> str:
    """How many points there are, and how they were chosen."""
    lost, broken = int((~found.scores.ok).sum()), int((found.scores.ok & ~found.scores.allowed).sum())
    text = f"{len(found.scores):,} evaluations by {found.search.method.replace('_', '-').upper()}"
    text += f", each the mean of {found.search.repeats} runs" if found.search.repeats > 1 else ""
    text += f"; {lost:,} fell" if lost else ""
    return text + (f"; {broken:,} broke a constraint" if broken else "")


def _ends(found: Evaluations) -> np.ndarray:
    """Evaluations at the end of each batch."""
    return np.cumsum(np.bincount(found.batch))


def _mark_lost(ax: Axes, number: np.ndarray, lost: np.ndarray) -> None:
    """Short lines at the bottom where a point fell or broke a constraint."""
    if lost.any():
        height = np.full(int(lost.sum()), 0.01)
        ax.plot(number[lost], height, "|", color=MUTED, ms=5, transform=ax.get_xaxis_transform())


# ---
# Which figures a search gives: how it converged, its front or its atlas; and any columns of its table.


def figures_of(search: Search, results: Results) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of a search's table; nothing where no point is allowed."""
    found = Evaluations.of(search, results)
    if found.best() is None:
        return
    if search.aim.measures:
        yield "atlas", atlas(found)
        yield "coverage", coverage(found)
    elif search.aim.pareto:
        yield "front", front(found)
        yield "hypervolume", hypervolume(found)
    else:
        yield "convergence", convergence(found)
    metric = search.aim.objective.terms[0].metric
    yield from ((name, figure) for name, figure in survey_figures(results, metric) if name.endswith("-parallel"))


def figures(
    out: Path,
    *,
    x: str | None = None,
    y: str | None = None,
    color: str | None = None,
    notify: Callable[[str], None] | None = None,
) -> Figures:
    """The figures of a search's directory, as far as it goes.

    Args:
        out: the directory.
        x, y, color: columns of one figure, see `nermo_mjx.sweep.plots.chosen_figure`.
        notify: not called: a search is drawn as far as it is.

    Raises:
        ParameterError: there is no such column.
        SpecError: its search.yaml cannot be read.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    search, files = Search.from_file(out / SEARCH), list(chunk_files(out).values())
    if not files:
        command = f"nermo-mjx search {out / SEARCH} --out {out}"
        raise DirectoryError(f"{out} holds no results of its search yet: run {command}.")
    results = Results(files)
    if x is not None:
        return chosen_figure(results, x, y, color)
    if y is not None or color is not None:
        raise ParameterError("x is not given, beside y or color: name it, too.")
    if Evaluations.of(search, results).best() is None:
        raise DirectoryError(f"there is nothing to draw of {out}: no point is within the constraints.")
    return figures_of(search, results)
