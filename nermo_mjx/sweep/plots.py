"""The figures of a sweep's table: which ones it gives, and how each is drawn.

Heat maps over pairs of a grid, a line for one parameter, scatters of a sample; where structures vary, these side by
side; and, where two parameters or more tell the variants apart, parallel coordinates and the Pareto front of speed
against roll.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from scipy import stats

from nermo_mjx.plotting.charts import (
    BEST_LINES,
    best_word,
    groups_of,
    heat_maps,
    line,
    named_points,
    pair_scatters,
    parallel_coordinates,
    pareto_front,
    scatters,
    structure_figures,
    thin_out,
    trade_off,
)
from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.shown import ShownValues, cost, shown, spoken, titled
from nermo_mjx.robot.quantity import ParameterError, did_you_mean
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.runs.rows import part_files
from nermo_mjx.sweep.counting import Variants, counts
from nermo_mjx.sweep.optimum import find_optimum
from nermo_mjx.sweep.optimum_figure import optimum_figure
from nermo_mjx.sweep.optimum_tables import optimum_files, optimum_table
from nermo_mjx.sweep.spec import SoughtOptimum
from nermo_mjx.sweep.table import (
    LEADING,
    Results,
    SweepRecord,
    columns_of,
    meta,
    profile_text,
    profiles_of,
    rank_correlation,
    sides_in,
    spine_ratio,
)

#: A figure has no more panels than this; more values are thinned evenly.
MAX_FIGURE_PANELS = 12
#: A scatter has no more points than this; more are thinned evenly.
MAX_SCATTER_POINTS = 50_000
#: Pairs are drawn among this many parameters: the first of a grid, the most influential of a sample.
MOST_PAIRED = 4


def figures_of_results(
    results: Results, metric: str = LEADING, remark: str = ""
) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of one metric; only successful runs count. Notes begin with the remark and the profile."""
    if not results.well.any():
        return
    remark += f"{profile_text(profiles_of(results))}; "
    z = metric_of(results, metric)
    varied = [
        x for x in shown_columns(results, columns_of(results, "varied")) if not alike(x.values)
    ]
    numbers = [x for x in varied if not x.names]
    groups = groups_of([x for x in varied if x.names])
    if groups is not None:
        yield from structure_figures(groups, numbers, z, remark, grid=results.is_grid)
        yield from _gain_figures(results, metric, remark) if results.is_grid else ()
    if not results.is_grid or not varied:
        shown_variables = varied or shown_columns(results, columns_of(results, "randomized"))
        if groups is not None:
            shown_variables = [x for x in numbers if not np.isnan(x.values).any()]
        yield from _scatter_figures(shown_variables, z, remark)
    elif len(varied) == 1 and groups is None:
        x, title = varied[0], f"{titled(metric)} over {varied[0].spoken}"
        yield f"{metric}-over-{x.name}", line(x, z, title, remark + repeats_remark(results))
    elif groups is None:
        note = remark + repeats_remark(results)
        for x, y in itertools.combinations(varied[:MOST_PAIRED], 2):
            yield heat_map(x, y, varied, z, note)
        yield from _gain_figures(results, metric, remark)
    yield from survey_figures(results, metric, remark)


def heat_map(
    x: ShownValues, y: ShownValues, varied: Sequence[ShownValues], z: ShownValues, note: str
) -> tuple[str, Figure]:
    """A heat map of z over two parameters; with a third one that varies, one panel for each of its values."""
    good = np.isfinite(x.values) & np.isfinite(
        y.values
    )  # what a structure does not have has no place
    if not good.all():
        x, y, z, *varied = (
            dataclasses.replace(shown, values=shown.values[good]) for shown in (x, y, z, *varied)
        )
    panels, remark = _panels(
        [averaged for averaged in varied if averaged.name not in (x.name, y.name)], len(z.values)
    )
    figure = heat_maps(
        x, y, z, panels, f"{titled(z.name)} over {x.spoken} and {y.spoken}", note + remark
    )
    return f"{z.name}-over-{x.name}-and-{y.name}", figure


def _gain_figures(results: Results, metric: str, start: str) -> Iterator[tuple[str, Figure]]:
    """Speed relative to the stiff spine, where a grid varies the spine's phase, and its amplitude from 0."""
    names = columns_of(results, "varied")
    if metric != LEADING or not {"spine.amplitude", "spine.phase"} <= set(names):
        return
    data = spine_ratio(results)
    bent = np.isfinite(data["spine.amplitude"]) & np.isfinite(
        data["spine.phase"]
    )  # a structure may have none
    varied = {
        name: shown_column(results, name, data[name][bent]) for name in names if name != "spine"
    }
    x, y = varied.pop("spine.amplitude"), varied.pop("spine.phase")
    z = ShownValues("speed relative to the stiff spine", "%", 100 * (data["ratio"][bent] - 1))
    bends = x.values > 0
    if not np.isfinite(z.values[bends]).any() or len(np.unique(y.values)) < 2:
        return
    rest = [variable for variable in varied.values() if not alike(variable.values)]
    panels, remark = _panels([variable for variable in rest if not variable.names], len(z.values))
    if (groups := groups_of([variable for variable in rest if variable.names])) is not None:
        remark = "".join(
            f"mean over {variable.spoken}; " for variable in rest if not variable.names
        )
        panels = [
            (name, groups.index == group_index)
            for group_index, name in enumerate(groups.names[:MAX_FIGURE_PANELS])
        ]
    title = f"Speed gained by the spine over {x.spoken} and {y.spoken}"
    note = f"{start}{remark}stiff: mean at {x.spoken} 0; "
    yield (
        f"{metric}-gain-over-{x.name}-and-{y.name}",
        heat_maps(x, y, z, panels, title, note, gain=bends),
    )


def _scatter_figures(
    variables: list[ShownValues], z: ShownValues, remark: str
) -> Iterator[tuple[str, Figure]]:
    """The metric against each parameter, and over the pairs of those that matter most."""
    good = np.isfinite(z.values)
    variables = [
        dataclasses.replace(x, values=x.values[good])
        for x in variables
        if len(np.unique(x.values[good])) > 1
    ]
    z = dataclasses.replace(z, values=z.values[good])
    if not variables:
        return
    still = np.ptp(z.values) == 0
    influence = [
        0.0 if still else float(stats.spearmanr(x.values, z.values).statistic) for x in variables
    ]
    order = np.argsort(-np.abs(influence), kind="stable")
    first = [variables[i] for i in order[:MAX_FIGURE_PANELS]]
    titles = [f"rank correlation {influence[i]:+.2f}" for i in order[:MAX_FIGURE_PANELS]]
    places, count = _drawn_of(z.side, z.values)
    z, *first = (dataclasses.replace(shown, values=shown.values[places]) for shown in (z, *first))
    other_note = (
        f"; the {MAX_FIGURE_PANELS} of {len(variables)} parameters that matter most"
        if len(variables) > MAX_FIGURE_PANELS
        else ""
    )
    note = f"{remark}{count}; line: running mean{other_note}"
    yield (
        f"{z.name}-over-each",
        scatters(first, z, titles, f"{titled(z.name)} over each parameter", note),
    )
    if len(variables) > 1:
        pairs = list(itertools.combinations(first[:MOST_PAIRED], 2))
        title = f"{titled(z.name)} over pairs of the parameters that matter most"
        yield f"{z.name}-over-pairs", pair_scatters(pairs, z, title, f"{remark}{count}; ")


def _panels(rest: list[ShownValues], count: int) -> tuple[list[tuple[str, np.ndarray]], str]:
    """The panels of a heat map of `count` points for the parameters not on its axes, and a remark about them."""
    if len(rest) == 1:
        third, values = rest[0], np.unique(rest[0].values[np.isfinite(rest[0].values)])
        panel_values = thin_out(values, MAX_FIGURE_PANELS)
        panels = [
            (f"{third.spoken} = {third.shown(value)}", third.values == value)
            for value in panel_values
        ]
        left_out = len(values) - len(panel_values)
        return panels, f"{left_out} more values of {rest[0].spoken} not shown; " if left_out else ""
    remark = f"mean over {', '.join(variable.spoken for variable in rest)}; " if rest else ""
    return [("", np.full(count, True))], remark


# ---
# Additional results of a finished sweep: the comparison that it requests, and the sensitivity of its metric.


def findings(
    results: Results,
    comparison: Mapping[str, Any] | None,
    sought: tuple[SoughtOptimum, int, int] | None = None,
    metric: str = LEADING,
    notify: Callable[[str], None] = lambda _: None,
) -> Iterator[tuple[str, pa.Table, dict[str, Any], Figures, dict[str, bytes]]]:
    """What a sweep finds besides its figures: name, table, part of the summary, figures and other files of each.

    Args:
        comparison: what the sweep's file compares, as its section `compare` has it.
        sought: what the section `optimum` seeks, and the sweep's repeats and variants.
        metric: which the figures show.
        notify: called with a message about what cannot be computed, as from a few runs.
    """
    if sought is not None:
        optimum = find_optimum(results, *sought)
        yield (
            "optimum",
            optimum_table(optimum),
            optimum.about(),
            optimum_figure(optimum),
            optimum_files(optimum),
        )
    try:
        if comparison is not None:
            from nermo_mjx.sweep import comparing  # few sweeps ask for it

            by, base, groups = comparison["by"], comparison.get("base"), comparison.get("for", ())
            gained = comparing.compare(
                results,
                by=by,
                base=base,
                groups=groups,
                drawn=() if metric == LEADING else (metric,),
            )
            gain_figures = comparing.figures_of_comparison(gained.table)
            yield "comparison", gained.table, gained.about(only=gained.drawn), gain_figures, {}
    except ParameterError as error:
        notify(f"There is no comparison: {error}")
    try:
        if (results.schema.metadata or {}).get(b"sampler") == b"saltelli":
            from nermo_mjx.sweep import sensitivity

            indices = sensitivity.sensitivity(results, metric)
            yield (
                "sensitivity",
                indices.table,
                indices.about(),
                sensitivity.figures_of_indices(indices.table),
                {},
            )
    except ParameterError as error:
        notify(f"There is no sensitivity: {error}")


# ---
# The figures of a sweep's directory, from its table alone: the default ones, or one of columns that a user names.


def sweep_figures(
    out: Path,
    *,
    x: str | None = None,
    y: str | None = None,
    color: str | None = None,
    notify: Callable[[str], None] | None = None,
) -> Figures:
    """The figures of a sweep's directory, as far as it is complete.

    Args:
        out: the directory.
        x, y, color: columns of one figure, see `chosen_figure`; a metric as color alone gives the default figures of
            that metric; without any of them, those of the speed are drawn.
        notify: called with a message if the table is not complete.

    Raises:
        ParameterError: there is no such column.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    files = part_files(out)
    if not files:
        raise DirectoryError(
            f"{out} holds no results of its sweep yet: run nermo-mjx sweep {out / 'sweep.yaml'} --out {out}."
        )
    results, sweep, remark = Results(files), SweepRecord.of_directory(out), ""
    if sweep is not None and results.rows < sweep.rows:
        remark = f"{results.rows:,} of {sweep.rows:,} runs so far; "
        if notify is not None:
            notify(f"{results.rows:,} of {sweep.rows:,} runs are in {out}; the figures show these.")
    if x is not None:
        return chosen_figure(results, x, y, color, remark)
    if y is not None:
        raise ParameterError("y is given without x: name both, or x alone.")
    if color is not None and color not in columns_of(results, "metric"):
        _check_column(results, color, "color")
        raise ParameterError(f"color is {color!r}, a parameter: name x and y, too.")
    comparison = None if sweep is None else sweep.comparison
    sought = (
        sweep
        and sweep.optimum
        and (SoughtOptimum.model_validate(sweep.optimum), sweep.repeats, sweep.variants)
    )
    all_findings = findings(
        results, comparison, sought or None, color or LEADING, notify or (lambda _: None)
    )

    def usual() -> Figures:  # each is drawn when it is asked for, in the style that holds then
        some = False
        for named in figures_of_results(results, color or LEADING, remark):
            some = True
            yield named
        if not some:
            why = "all its parameters have one value" if results.well.any() else "no run succeeded"
            raise DirectoryError(f"there is nothing to draw of {out}: {why}.")

    return itertools.chain(usual(), *(figures for *_, figures, _ in all_findings))


def chosen_figure(
    results: Results, x: str, y: str | None = None, color: str | None = None, remark: str = ""
) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of the named columns, made on demand.

    Two parameters of a grid give a heat map, two metrics with a better direction a Pareto front, all else a scatter.

    Args:
        results: the table.
        x, y: parameters or metrics; without y, it is the speed.
        color: a column that colours the points; of two parameters, the speed by default.
        remark: what the figure's note begins with.

    Raises:
        ParameterError: there is no such column, or no successful run.
    """
    for option, name in (("x", x), ("y", y), ("color", color)):
        _check_column(results, name, option)
    if not results.well.any():
        raise ParameterError("no run in the table succeeded, so there is nothing to plot.")
    remark += f"{profile_text(profiles_of(results))}; "
    return (
        _chosen(results, x, y or LEADING, color, remark) for _ in range(1)
    )  # in the style that holds then


def _check_column(results: Results, name: str | None, option: str) -> None:
    """Refuse a name that is neither a parameter nor a metric of the table; None is accepted."""
    columns = columns_of(results, "varied", "randomized", "metric")
    if name is not None and name not in columns:
        hint = did_you_mean(name, columns)
        raise ParameterError(
            f"{option} is {name!r}, no column of the table{hint} There are {', '.join(columns)}."
        )


def _chosen(results: Results, x: str, y: str, color: str | None, remark: str) -> tuple[str, Figure]:
    metrics, varied, sides = (
        columns_of(results, "metric"),
        columns_of(results, "varied"),
        sides_in(results.schema),
    )
    if color is None and x in sides and y in sides and x != y:
        points = points_of(results, [x, y])
        return f"{x}-against-{y}", trade_off_figure(
            points, x, y, points.differing, remark + lost_remark(results)
        )
    if color is None and not {x, y} & set(metrics):
        color = LEADING
    if results.is_grid and color in metrics and {x, y} <= set(varied) and x != y:
        others = {variable.name: variable for variable in shown_columns(results, varied)}
        differing = [variable for variable in others.values() if not alike(variable.values)]
        return heat_map(
            others[x],
            others[y],
            differing,
            metric_of(results, color),
            remark + repeats_remark(results),
        )
    shown_axes = [shown_columns(results, [variable])[0] for variable in (x, y, color) if variable]
    places = np.flatnonzero(
        results.well
        & np.logical_and.reduce([np.isfinite(variable.values) for variable in shown_axes])
    )
    kept_places, count = _drawn_of(shown_axes[-1].side, shown_axes[-1].values[places])
    across, up, *by = (
        dataclasses.replace(variable, values=variable.values[places[kept_places]])
        for variable in shown_axes
    )
    if by:
        title = f"{titled(str(color))} over {spoken(x)} and {spoken(y)}"
        figure = pair_scatters(
            [(across, up)], by[0], title, f"{remark}{count}; ", star=color in metrics
        )
        return f"{color}-over-{x}-and-{y}", figure
    note = f"{remark}{count}; line: running mean"
    return f"{y}-over-{x}", scatters([across], up, [""], f"{titled(y)} over {spoken(x)}", note)


def _drawn_of(side: str, values: np.ndarray) -> tuple[np.ndarray, str]:
    """Places of the points (n,) that a scatter draws, the best one among them, and how many these are of all."""
    places, note = np.arange(len(values)), f"{len(values):,} runs"
    if len(values) > MAX_SCATTER_POINTS:
        places = thin_out(places, MAX_SCATTER_POINTS, [int(np.argmin(cost(side, values)))])
        note = f"{MAX_SCATTER_POINTS:,} of {note}"
    return places, note


# ---
# The points of a figure of variants: the mean of each variant's runs, or single runs if nothing is varied.


@dataclasses.dataclass(frozen=True)
class Points:
    """Points of a table, with some of its metrics.

    Attributes:
        results: the table.
        parameters: names of what tells the points apart: the varied parameters, or else the randomized ones.
        rows: a row of each point, (n,), which has its parameters.
        metrics: name -> (n,), as shown; NaN where no run had the number.
        runs: how many runs ended well.
    """

    results: Results
    parameters: tuple[str, ...]
    rows: np.ndarray
    metrics: dict[str, ShownValues]
    runs: int

    def of(self, names: Sequence[str], selection: np.ndarray) -> list[ShownValues]:
        """Columns of the chosen points, as shown; only those columns are read, and only those points kept."""
        rows = self.rows[selection]
        return [
            shown_column(self.results, name, values[rows])
            for name, values in self.results.columns(names)
        ]

    @property
    def differing(self) -> tuple[str, ...]:
        """The parameters that are not the same in all points."""
        values = self.results.columns(self.parameters)
        return tuple(
            name for name, column in values if len(self.rows) and not alike(column[self.rows])
        )

    @property
    def what(self) -> str:
        """How many points there are, and what they are."""
        count = len(self.rows)
        if count == self.runs:
            return f"{count:,} runs"
        return f"{count:,} variants, each the mean of its runs"


def points_of(results: Results, metrics: Sequence[str]) -> Points:
    """The points of a table with these metrics: the variants of which a run ended well, or else such runs."""
    well, varied = results.well, columns_of(results, "varied")
    columns = results.columns(["variant", *metrics])
    variant = next(columns)[1]
    if not varied:
        columns_by_name = {
            name: shown_column(results, name, values[well]) for name, values in columns
        }
        randomized = tuple(columns_of(results, "randomized"))
        return Points(results, randomized, np.flatnonzero(well), columns_by_name, int(well.sum()))
    variants = Variants.of(variant)
    some = np.bincount(variants.place, well) > 0
    columns_by_name = {
        name: shown_column(
            results, name, variants.tally(values, counts(name, values, well)).mean[some]
        )
        for name, values in columns
    }
    return Points(results, tuple(varied), variants.first[some], columns_by_name, int(well.sum()))


def shown_column(results: Results, name: str, values: np.ndarray | Sequence[float]) -> ShownValues:
    """Values of a column as shown."""
    metadata = meta(results.schema.field(name))
    if metadata.get("scale") == "structure":
        names = results.names(name)
        return ShownValues(
            name, "", np.array([names.index(label) for label in values], float), names=names
        )
    side = sides_in(results.schema).get(name, "")
    return shown(name, metadata["unit"], values, log=metadata.get("scale") == "log", side=side)


def shown_columns(results: Results, names: Sequence[str]) -> list[ShownValues]:
    """Columns as shown."""
    return [shown_column(results, name, values) for name, values in results.columns(names)]


def alike(values: np.ndarray) -> bool:
    """Whether all values are one; what is not known does not count."""
    return len(np.unique(values[values == values])) < 2


def metric_of(results: Results, metric: str) -> ShownValues:
    """A metric as shown, NaN where a run is lost."""
    values = results.column(metric)
    return shown_column(
        results, metric, np.where(counts(metric, values, results.well), values, np.nan)
    )


def repeats_remark(results: Results) -> str:
    """What the note of a figure says of repeats that share a point, and of runs that are lost."""
    repeats = int(np.max(results.column("repeat"))) + 1
    return (f"mean of {repeats} repeats; " if repeats > 1 else "") + lost_remark(results)


def lost_remark(results: Results) -> str:
    """What the note of a figure says of runs that are lost."""
    lost = int((~results.well).sum())
    return f"{lost:,} of {results.rows:,} runs lost; " if lost else ""


# ---
# Parallel coordinates: an axis for each parameter, the metric as the last one, a line for each variant.


#: Lines that are drawn; of more points, as many are chosen evenly by rank.
MOST_LINES: Final = 800
#: Axes of parameters.
MOST_AXES: Final = 9


def chosen_lines(costs: np.ndarray) -> np.ndarray:
    """Places of the points that are drawn, the best one last: the best few, and the rest evenly by rank.

    Args:
        costs: (n,), less is better; a NaN is never drawn.
    """
    finite_lines = np.flatnonzero(np.isfinite(costs))
    order = finite_lines[np.argsort(-costs[finite_lines], kind="stable")]
    if len(order) <= MOST_LINES:
        return order
    rest = order[:-BEST_LINES]
    return np.concatenate(
        [rest[np.linspace(0, len(rest) - 1, MOST_LINES).round().astype(int)], order[-BEST_LINES:]]
    )


def parallel_figure(points: Points, names: Sequence[str], metric: str, remark: str) -> Figure:
    """A line for each point through its parameters to the metric; the best lines are orange."""
    every = points.metrics[metric]
    price = cost(every.side, every.values)
    line_indices, left_out = chosen_lines(price), ""
    parameters = points.of(names, line_indices)
    z = dataclasses.replace(every, values=every.values[line_indices])
    if len(parameters) > MOST_AXES:
        influence = [
            abs(np.nan_to_num(rank_correlation(parameter.values, z.values)))
            for parameter in parameters
        ]
        matter = np.argsort(-np.array(influence), kind="stable")[:MOST_AXES]
        left_out = f"; {len(parameters) - MOST_AXES} parameters that matter less are not shown"
        parameters = [parameters[i] for i in sorted(matter)]
    finite_count = int(np.isfinite(price).sum())
    note = f"{remark}{points.what}{left_out}"
    if finite_count > MOST_LINES:
        note = f"{remark}{MOST_LINES:,} of {points.what}, evenly by rank, and the best {BEST_LINES}{left_out}"
    where = ", ".join(
        f"{parameter.spoken} {parameter.shown(parameter.values[-1])}" for parameter in parameters
    )
    best_text = f"the {min(BEST_LINES, finite_count)} {best_word(every)}"
    note += f"; orange: {best_text}, of which the first is {z.shown(z.values[-1])} at {where}"
    return parallel_coordinates(
        parameters, z, f"{titled(metric)}: all parameters side by side", note
    )


# ---
# A figure of two metrics against each other: all points, the Pareto front, and its best points by name.


#: What a faster walk is weighed against.
AGAINST: Final = "roll_std"
#: Points of a trade-off that are drawn, and parameters that are told of a named one.
_MAX_FRONT_POINTS: Final = 20_000
_MOST_TOLD: Final = 6


def survey_figures(results: Results, metric: str, remark: str = "") -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of the figures over all variants of a table; none where one parameter or none differs."""
    weighed = AGAINST if metric == LEADING and AGAINST in results.schema.names else None
    points = points_of(results, [metric, *([weighed] if weighed else [])])
    remark += lost_remark(results)
    names = points.differing
    if len(names) < 2 or len(points.rows) < 4:
        return
    if not results.is_grid:  # whose lines would all cross
        yield f"{metric}-parallel", parallel_figure(points, names, metric, remark)
    if weighed:
        yield (
            f"{metric}-against-{weighed}",
            trade_off_figure(points, metric, weighed, names, remark),
        )


def trade_off_figure(
    points: Points, first: str, second: str, names: tuple[str, ...], remark: str
) -> Figure:
    """Two metrics with a better direction against each other; the named points have their parameters below."""
    x, y = points.metrics[first], points.metrics[second]
    best = pareto_front(cost(x.side, x.values), cost(y.side, y.values))
    named = best[named_points(x.values[best], y.values[best])]
    parameters = points.of(names[:_MOST_TOLD], named)
    lines = []
    for i, point in enumerate(named):
        point_text = f"{x.spoken} {x.shown(x.values[point])}, {y.spoken} {y.shown(y.values[point])}"
        lines.append(
            f"{point_text}:  "
            + ", ".join(
                f"{parameter.spoken} {parameter.shown(parameter.values[i])}"
                for parameter in parameters
            )
        )
    if len(names) > _MOST_TOLD:
        remark += f"{len(names) - _MOST_TOLD} more parameters are in the table; "
    finite_points = np.flatnonzero(np.isfinite(x.values) & np.isfinite(y.values))
    note = f"{remark}{points.what}; "
    if len(finite_points) > _MAX_FRONT_POINTS:
        finite_points = thin_out(finite_points, _MAX_FRONT_POINTS, best)
        note = f"{remark}{_MAX_FRONT_POINTS:,} of {points.what}, and the whole front; "
    x, y = (
        dataclasses.replace(parameter, values=parameter.values[finite_points])
        for parameter in (x, y)
    )
    best, named = np.searchsorted(finite_points, best), np.searchsorted(finite_points, named)
    labelled = list(zip(named.tolist(), lines, strict=True))
    return trade_off(
        x, y, best, (x.side, y.side), labelled, f"{titled(first)} over {y.spoken}", note
    )
