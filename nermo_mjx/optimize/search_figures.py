"""The figures of a search: its convergence, its front or its atlas, and figures of chosen columns of its table."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from nermo_mjx.optimize.objective import ObjectiveTerm
from nermo_mjx.optimize.search_directory import SEARCH_FILE
from nermo_mjx.optimize.search_methods import find_cells, find_elites
from nermo_mjx.optimize.search_results import Evaluations, atlas_progress, hypervolumes
from nermo_mjx.optimize.search_spec import Measure, Search
from nermo_mjx.plotting.charts import (
    PAGE_WIDTH_INCHES,
    blank_figure,
    blank_page,
    colour_bar,
    colour_scale,
    draw_horizontal_grid,
    draw_star,
    finish_page,
    named_points,
    set_scales,
    trade_off,
)
from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.shown import ShownValues, shown
from nermo_mjx.plotting.style import BAND_COLOUR, COLOUR_MAP, LINE_COLOUR, MUTED_INK
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.runs.rows import part_files
from nermo_mjx.sweep.plots import chosen_figure, survey_figures
from nermo_mjx.sweep.table import Results, profile_text, profiles_of

# ---
# The figures of a search: its convergence, its front or its atlas, and figures of chosen columns of its table.


#: Maximum number of pairs of measures in the figure of an atlas with three or more measures.
_MAX_ATLAS_PAIRS: Final = 6


def search_figures_of(search: Search, results: Results) -> Figures:
    """Pairs of a file name and a figure of a search's table; none if no point is allowed."""
    evaluations = Evaluations.of(search, results)
    if evaluations.best() is None:
        return
    if search.aim.measures:
        yield "atlas", atlas(evaluations)
        yield "coverage", coverage(evaluations)
    elif search.aim.pareto:
        yield "front", front_figure(evaluations)
        yield "hypervolume", hypervolume(evaluations)
    else:
        yield "convergence", convergence(evaluations)
    metric = search.aim.objective.terms[0].metric
    yield from (
        (name, figure)
        for name, figure in survey_figures(results, metric)
        if name.endswith("-parallel")
    )


def search_figures(
    out: Path, *, x: str | None = None, y: str | None = None, color: str | None = None
) -> Figures:
    """The figures of the batches in a search's directory.

    Args:
        out: Directory of the search.
        x, y, color: Columns of a single figure, see `nermo_mjx.sweep.plots.chosen_figure`.

    Raises:
        ParameterError: The column does not exist.
        SpecError: search.yaml cannot be read.
        DirectoryError: The table is empty, or cannot be read.
    """
    search, files = Search.from_file(out / SEARCH_FILE), part_files(out)
    if not files:
        command = f"nermo-mjx search {out / SEARCH_FILE} --out {out}"
        raise DirectoryError(f"{out} holds no results of its search yet: run {command}.")
    results = Results(files)
    if x is not None:
        return chosen_figure(results, x, y, color)
    if y is not None or color is not None:
        raise ParameterError("x is not given, beside y or color: name it, too.")
    if Evaluations.of(search, results).best() is None:
        raise DirectoryError(
            f"there is nothing to draw of {out}: no point is within the constraints."
        )
    return search_figures_of(search, results)


def convergence(evaluations: Evaluations) -> Figure:
    """The objective of all points in the order of the requests, and the best one so far."""
    quantity = _objective(evaluations)
    values, allowed = quantity.values, evaluations.scores.is_allowed
    number = np.arange(1, len(values) + 1)
    cost = np.where(allowed, evaluations.scores.cost[:, 0], np.inf)
    best = int(np.argmin(cost))
    first = np.concatenate(
        [[True], cost[1:] < np.minimum.accumulate(cost)[:-1]]
    )  # better than all points before
    leading = np.maximum.accumulate(np.where(first, np.arange(len(cost)), 0))
    note = f"{_counts(evaluations)}; line: best so far; star: best, {quantity.shown(values[best])} at {_label(evaluations, best)}"
    figure = blank_page(f"{_title(quantity)} over the evaluations", PAGE_WIDTH_INCHES, 4.4, note)
    ax = figure.subplots()
    ax.scatter(
        number[allowed],
        values[allowed],
        s=9,
        color=BAND_COLOUR,
        lw=0,
        rasterized=len(values) > 2000,
    )
    reached = np.isfinite(cost[leading])
    ax.step(number[reached], values[leading][reached], where="post", color=LINE_COLOUR)
    draw_star(ax, number[best], values[best], 170, zorder=5)
    if not allowed.all():  # short lines at the bottom for points that fell or violate a constraint
        height = np.full(int((~allowed).sum()), 0.01)
        ax.plot(
            number[~allowed], height, "|", color=MUTED_INK, ms=5, transform=ax.get_xaxis_transform()
        )
    terms = evaluations.search.aim.objective.terms
    higher = len(terms) == 1 and terms[0].aim == "maximize"
    low, high = np.nanquantile(values[allowed], [0.01, 1.0] if higher else [0.0, 0.99])
    room = 0.06 * max(high - low, 1e-9)
    ax.set(ylim=(low - room, high + room), xlim=(0, len(values) + 1))
    draw_horizontal_grid(ax)
    ax.set(xlabel="evaluations [1]", ylabel=quantity.label)
    return figure


def front_figure(evaluations: Evaluations) -> Figure:
    """The second objective over the first one, with the front of these two or of all objectives."""
    terms, best = evaluations.search.aim.objective.terms, evaluations.front()
    allowed = np.flatnonzero(evaluations.scores.is_allowed)
    x, y = (_term_values(evaluations, i) for i in (0, 1))
    index_of_point = {int(point): i for i, point in enumerate(allowed)}
    lines = []
    for point in (int(best[i]) for i in named_points(x.values[best], y.values[best])):
        values_text = f"{x.name} {x.shown(x.values[point])}, {y.name} {y.shown(y.values[point])}"
        lines.append((index_of_point[point], f"{values_text}:  {_label(evaluations, point)}"))
    front_note = f"front of all {len(terms)} objectives; " if len(terms) > 2 else ""
    across, up = (ShownValues(axis.name, axis.unit, axis.values[allowed]) for axis in (x, y))
    first, second = ("max" if term.aim == "maximize" else "min" for term in terms[:2])
    # A line along a front of more objectives would cross itself.
    sides = (first, second) if len(terms) == 2 else ("nearest zero", "nearest zero")
    title = f"{x.name} against {y.name}".replace("_", " ").capitalize()
    places = np.array([index_of_point[int(point)] for point in best])
    return trade_off(
        across, up, places, sides, lines, title, f"{_counts(evaluations)}; {front_note}"
    )


def hypervolume(evaluations: Evaluations) -> Figure:
    """The hypervolume over the evaluations, see `hypervolumes`."""
    shares, worst = hypervolumes(evaluations)
    corner = []
    for term, value in zip(evaluations.search.aim.objective.terms, worst.tolist(), strict=True):
        quantity = _quantity(evaluations, term.metric, _as_metric(term, value))
        corner.append(f"{term.metric} {quantity.shown(float(quantity.values))}")
    note = (
        f"{_counts(evaluations)}; box: from the best of each objective to the worst of the first batch,"
        f" {', '.join(corner)}"
    )
    figure = blank_page(
        "Hypervolume of the front over the evaluations", PAGE_WIDTH_INCHES, 3.6, note
    )
    ax = figure.subplots()
    ax.step(_batch_ends(evaluations), 100 * shares, where="post", color=LINE_COLOUR)
    ax.set(
        xlabel="evaluations [1]", ylabel="hypervolume [%]", xlim=(0, len(evaluations.scores) + 1)
    )
    draw_horizontal_grid(ax)
    return figure


def coverage(evaluations: Evaluations) -> Figure:
    """The number of filled cells and the QD score over the evaluations, see `atlas_progress`."""
    filled, total = atlas_progress(evaluations)
    cells = int(np.prod([measure.cells for measure in evaluations.search.aim.measures]))
    terms = evaluations.search.aim.objective.terms
    note = f"{_counts(evaluations)}; {filled[-1]:,} of {cells:,} cells are filled; QD score: sum over the filled cells of "
    note += "what their best is better than the worst of the first batch"
    figure = blank_page(
        "Filled cells and QD score over the evaluations", PAGE_WIDTH_INCHES, 4.8, note
    )
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.step(_batch_ends(evaluations), filled, where="post", color=LINE_COLOUR)
    top.set_ylabel("filled cells [1]")
    scale = ShownValues("", "", total)
    if len(terms) == 1 and terms[0].aim != "hold":
        scale = _quantity(evaluations, terms[0].metric, total * terms[0].scale / terms[0].weight)
    bottom.step(_batch_ends(evaluations), scale.values, where="post", color=LINE_COLOUR)
    bottom.set_ylabel(f"QD score [{scale.unit or 1}]")
    for ax in (top, bottom):
        ax.set_ylim(bottom=0)
        draw_horizontal_grid(ax)
    bottom.set(xlabel="evaluations [1]", xlim=(0, len(evaluations.scores) + 1))
    return figure


def atlas(evaluations: Evaluations) -> Figure:
    """The best point in each cell: bars for one measure, a map for two, and maps of pairs for more measures."""
    measures, quantity = evaluations.search.aim.measures, _objective(evaluations)
    cells, points = find_elites(evaluations.search.aim, evaluations.scores)
    best = int(points[np.argmax(evaluations.scores.quality[points])])
    total = int(np.prod([measure.cells for measure in measures]))
    note = f"{_counts(evaluations)}; {len(cells):,} of {total:,} cells are filled; star: best, "
    note += f"{quantity.shown(quantity.values[best])} at {_label(evaluations, best)}"
    title = f"{_title(quantity)}: the best in each cell"
    if len(measures) == 1:
        return _bar_figure(evaluations, points, quantity, best, title, note)
    pairs = list(itertools.combinations(range(len(measures)), 2))[:_MAX_ATLAS_PAIRS]
    if len(pairs) > 1:
        note += "; each map shows the best over all other measures"
    columns = min(len(pairs), 2)
    rows = -(-len(pairs) // columns)
    figure = blank_figure(PAGE_WIDTH_INCHES, 1.1 + 4.2 * rows / (1 if columns == 1 else 1.3))
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel().tolist()
    scale, extend = colour_scale(quantity.values[points])
    for ax in axes[len(pairs) :]:
        ax.remove()
    for ax, pair in zip(axes, pairs, strict=False):
        _draw_map(ax, evaluations, points, quantity, scale, pair, best)
    bar = ScalarMappable(scale, COLOUR_MAP)
    colour_bar(figure, axes[: len(pairs)], bar, quantity.label, shrink=0.9, extend=extend)
    return finish_page(figure, title, note)


def _draw_map(
    ax: Axes,
    evaluations: Evaluations,
    points: np.ndarray,
    z: ShownValues,
    scale: Normalize,
    pair: tuple[int, int],
    best: int,
) -> None:
    """Draw the cells of two measures, coloured by the best point in each."""
    measures = [evaluations.search.aim.measures[i] for i in pair]
    places, edges, best_position = [], [], []
    for i, measure in zip(pair, measures, strict=True):
        share = (evaluations.scores.measures[points, i] - measure.low) / (
            measure.high - measure.low
        )
        places.append(np.clip((share * measure.cells).astype(int), 0, measure.cells - 1))
        edges.append(_edges(evaluations, measure))
        best_position.append(
            _quantity(evaluations, measure.metric, evaluations.scores.measures[best, i]).values
        )
    grid = np.full([measure.cells for measure in measures], np.nan)
    order = np.argsort(
        evaluations.scores.quality[points], kind="stable"
    )  # the best of several points is drawn last
    grid[places[0][order], places[1][order]] = z.values[points[order]]
    ax.set_facecolor("#fafafa")
    ax.pcolormesh(
        edges[0].values, edges[1].values, np.ma.masked_invalid(grid.T), norm=scale, cmap=COLOUR_MAP
    )
    draw_star(ax, best_position[0], best_position[1], 190, 1.3, zorder=5)
    set_scales(ax, *edges)
    ax.set(xlabel=edges[0].label, ylabel=edges[1].label)


def _bar_figure(
    evaluations: Evaluations, points: np.ndarray, z: ShownValues, best: int, title: str, note: str
) -> Figure:
    """The best point of each cell as bars over one measure."""
    (measure,) = evaluations.search.aim.measures
    figure = blank_page(title, PAGE_WIDTH_INCHES, 3.9, note)
    ax = figure.subplots()
    edges = _edges(evaluations, measure)
    cell = find_cells(evaluations.search.aim, evaluations.scores.measures[points])
    values = z.values[points]
    floor = (
        min(float(values.min()), 0.0)
        if np.ptp(values) == 0
        else float(values.min() - 0.1 * np.ptp(values))
    )
    ax.bar(
        edges.values[cell],
        values - floor,
        np.diff(edges.values)[cell],
        floor,
        align="edge",
        color=BAND_COLOUR,
        ec="white",
    )
    best_value = _quantity(evaluations, measure.metric, evaluations.scores.measures[best, 0])
    draw_star(ax, best_value.values, z.values[best], 170, zorder=5)
    ax.set(xlabel=edges.label, ylabel=z.label, xlim=(edges.values[0], edges.values[-1]))
    draw_horizontal_grid(ax)
    return figure


def _objective(evaluations: Evaluations) -> ShownValues:
    """The objective of all points (n,), in the unit of the metric if it has one metric; NaN if a run failed."""
    terms = evaluations.search.aim.objective.terms
    if len(terms) == 1 and terms[0].aim != "hold":
        return _term_values(evaluations, 0)
    return ShownValues("objective", "", evaluations.scores.cost[:, 0])


def _term_values(evaluations: Evaluations, term_index: int) -> ShownValues:
    """The metric of a term (n,), or the cost of a term that holds the metric at a value."""
    term, cost = (
        evaluations.search.aim.objective.terms[term_index],
        evaluations.scores.cost[:, term_index],
    )
    if term.aim == "hold":
        return ShownValues(f"{term.metric} off {term.at:g}", "", cost)
    return _quantity(evaluations, term.metric, _as_metric(term, cost))


def _as_metric(term: ObjectiveTerm, cost: np.ndarray | float) -> np.ndarray | float:
    """The metric from the cost of a term that maximizes or minimizes this metric."""
    return (
        cost
        if term.aim == "hold"
        else cost * term.scale / term.weight * (-1.0 if term.aim == "maximize" else 1.0)
    )


def _quantity(evaluations: Evaluations, metric: str, values: np.ndarray | float) -> ShownValues:
    return shown(metric, evaluations.search.sweep.metrics[metric].unit, values)


def _edges(evaluations: Evaluations, measure: Measure) -> ShownValues:
    """The edges of a measure's cells."""
    return _quantity(
        evaluations, measure.metric, np.linspace(measure.low, measure.high, measure.cells + 1)
    )


def _title(quantity: ShownValues) -> str:
    return quantity.name.replace("_", " ").capitalize()


def _label(evaluations: Evaluations, point: int) -> str:
    """A text with the first parameters of a point, with units."""
    parameters, names = evaluations.search.sweep.parameters, list(evaluations.search.names[:6])
    values = evaluations.means(names, np.array([point]))
    quantities = [shown(name, parameters[name].unit, values[name][0]) for name in names]
    return ", ".join(
        f"{quantity.name} {quantity.shown(float(quantity.values))}" for quantity in quantities
    )


def _counts(evaluations: Evaluations) -> str:
    failed_count = int((~evaluations.scores.ok).sum())
    disallowed_count = int((evaluations.scores.ok & ~evaluations.scores.is_allowed).sum())
    text = profile_text(profiles_of(evaluations.results))
    text += f"; {len(evaluations.scores):,} evaluations by {evaluations.search.method.name.replace('_', '-').upper()}"
    text += (
        f", each the mean of {evaluations.search.repeats} runs"
        if evaluations.search.repeats > 1
        else ""
    )
    text += f"; {failed_count:,} fell" if failed_count else ""
    return text + (f"; {disallowed_count:,} broke a constraint" if disallowed_count else "")


def _batch_ends(evaluations: Evaluations) -> np.ndarray:
    """Number of evaluations at the end of each batch (batches,)."""
    return np.cumsum(np.bincount(evaluations.batch))
