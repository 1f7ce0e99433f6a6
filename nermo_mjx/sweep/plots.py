"""Which figures a sweep's table gives.

Heat maps over pairs of a grid, a line for one parameter, scatters of a sample; where structures vary, these side by
side; and, where two parameters or more tell the variants apart, parallel coordinates and the Pareto front of speed
against roll.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.shown import ShownValues
from nermo_mjx.robot.quantity import ParameterError, did_you_mean
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.sweep.figures import (
    alike,
    heat_maps,
    line,
    metric_of,
    pair_scatters,
    points_of,
    quantities,
    quantity,
    repeats_remark,
    scatters,
    thinned,
    titled,
)
from nermo_mjx.sweep.findings import findings
from nermo_mjx.sweep.results import Results, SweepRecord, result_files
from nermo_mjx.sweep.side_by_side import groups_of, structure_figures
from nermo_mjx.sweep.spec import cost, sides_in
from nermo_mjx.sweep.survey import survey_figures, trade_off_figure
from nermo_mjx.sweep.table import LEADING, columns_of, spine_ratio

#: A figure has no more panels than this; more values are thinned evenly.
MOST_PANELS = 12
#: A scatter has no more points than this; more are thinned evenly.
MOST_POINTS = 50_000
#: Pairs are drawn among this many parameters: the first of a grid, the most influential of a sample.
MOST_PAIRED = 4


def figures_of(results: Results, metric: str = LEADING, remark: str = "") -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of one metric; only successful runs count. The note of each begins with the remark."""
    if not results.well.any():
        return
    z = metric_of(results, metric)
    varied = [x for x in quantities(results, columns_of(results, "varied")) if not alike(x.values)]
    if (groups := groups_of(results)) is not None:
        yield from structure_figures(results, groups, metric, remark)
        if not results.is_grid:
            yield from _scatter_figures([x for x in varied if not x.names and not np.isnan(x.values).any()], z, remark)
    elif not results.is_grid or not varied:
        yield from _scatter_figures(varied or quantities(results, columns_of(results, "randomized")), z, remark)
    elif len(varied) == 1:
        title = f"{titled(metric)} over {varied[0].name}"
        yield f"{metric}-over-{varied[0].name}", line(varied[0], z, title, remark + repeats_remark(results))
    else:
        for x, y in itertools.combinations(varied[:MOST_PAIRED], 2):
            yield heat_map(x, y, varied, z, remark + repeats_remark(results))
        yield from _gain_figures(results, metric, remark)
    yield from survey_figures(results, metric, remark)


def heat_map(
    x: ShownValues, y: ShownValues, varied: Sequence[ShownValues], z: ShownValues, note: str
) -> tuple[str, Figure]:
    """A heat map of z over two parameters; with a third one that varies, one panel for each of its values."""
    good = np.isfinite(x.values) & np.isfinite(y.values)  # what a structure does not have has no place
    if not good.all():
        x, y, z, *varied = (dataclasses.replace(each, values=each.values[good]) for each in (x, y, z, *varied))
    panels, remark = _panels([other for other in varied if other.name not in (x.name, y.name)], len(z.values))
    figure = heat_maps(x, y, z, panels, f"{titled(z.name)} over {x.name} and {y.name}", note + remark)
    return f"{z.name}-over-{x.name}-and-{y.name}", figure


def _gain_figures(results: Results, metric: str, start: str) -> Iterator[tuple[str, Figure]]:
    """Speed relative to the stiff spine, where a grid varies the spine's phase, and its amplitude from 0."""
    names = columns_of(results, "varied")
    if metric != LEADING or not {"spine.amplitude", "spine.phase"} <= set(names):
        return
    data = spine_ratio(results)
    varied = {name: quantity(results, name, data[name]) for name in names}
    x, y = varied.pop("spine.amplitude"), varied.pop("spine.phase")
    z = ShownValues("speed relative to the stiff spine", "%", 100 * (data["ratio"] - 1))
    bends = x.values > 0
    if not np.isfinite(z.values[bends]).any() or len(np.unique(y.values)) < 2:
        return
    panels, remark = _panels([other for other in varied.values() if len(np.unique(other.values)) > 1], len(z.values))
    title, note = f"Speed gain over {x.name} and {y.name}", f"{start}{remark}stiff: mean at {x.name} 0; "
    yield f"{metric}-gain-over-{x.name}-and-{y.name}", heat_maps(x, y, z, panels, title, note, gain=bends)


def _scatter_figures(drawn: list[ShownValues], z: ShownValues, remark: str) -> Iterator[tuple[str, Figure]]:
    """The metric against each parameter, and over the pairs of those that matter most."""
    good = np.isfinite(z.values)
    drawn = [dataclasses.replace(x, values=x.values[good]) for x in drawn if len(np.unique(x.values[good])) > 1]
    z = dataclasses.replace(z, values=z.values[good])
    if not drawn:
        return
    still = np.ptp(z.values) == 0
    influence = [0.0 if still else float(stats.spearmanr(x.values, z.values).statistic) for x in drawn]
    order = np.argsort(-np.abs(influence), kind="stable")
    first = [drawn[i] for i in order[:MOST_PANELS]]
    titles = [f"rank correlation {influence[i]:+.2f}" for i in order[:MOST_PANELS]]
    note = f"{len(z.values):,} runs; line: running mean"
    if len(z.values) > MOST_POINTS:
        best = np.argmin(cost(z.side, z.values))  # a star
        thin = thinned(np.arange(len(z.values)), MOST_POINTS, [int(best)])
        first = [dataclasses.replace(x, values=x.values[thin]) for x in first]
        z, note = dataclasses.replace(z, values=z.values[thin]), f"{MOST_POINTS:,} of {note}"
    note = remark + note
    if len(drawn) > MOST_PANELS:
        note += f"; the {MOST_PANELS} of {len(drawn)} parameters that matter most"
    yield f"{z.name}-over-each", scatters(first, z, titles, f"{titled(z.name)} over each parameter", note)
    if len(drawn) > 1:
        pairs = list(itertools.combinations(first[:MOST_PAIRED], 2))
        title = f"{titled(z.name)} over pairs of the parameters that matter most"
        yield f"{z.name}-over-pairs", pair_scatters(pairs, z, title, note.partition("; line")[0] + "; ")


def _panels(rest: list[ShownValues], count: int) -> tuple[list[tuple[str, np.ndarray]], str]:
    """The panels of a heat map of `count` points for the parameters not on its axes, and a remark about them."""
    if len(rest) == 1:
        panels, left_out = _slices(rest[0])
        return panels, f"{left_out} more values of {rest[0].name} not shown; " if left_out else ""
    remark = f"mean over {', '.join(other.name for other in rest)}; " if rest else ""
    return [("", np.full(count, True))], remark


def _slices(third: ShownValues) -> tuple[list[tuple[str, np.ndarray]], int]:
    """A panel for each value of the third parameter, and how many values were left out."""
    values = np.unique(third.values[np.isfinite(third.values)])
    kept = thinned(values, MOST_PANELS)
    panels = [(f"{third.name} = {third.shown(value)}", third.values == value) for value in kept]
    return panels, len(values) - len(kept)


# ---
# The figures of a sweep's directory, from its table alone: the default ones, or one of columns that a user names.


def figures(
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
    files = result_files(out)
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
    found = findings(results, None if sweep is None else sweep.comparison, color or LEADING, notify)
    return itertools.chain(_usual(out, results, color or LEADING, remark), *(finding.figures for finding in found))


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
    return (_figure(results, x, y or LEADING, color, remark) for _ in range(1))


def _usual(out: Path, results: Results, metric: str, remark: str) -> Iterator[tuple[str, Figure]]:
    some = False
    for named in figures_of(results, metric, remark):
        some = True
        yield named
    if not some:
        why = "all its parameters have one value" if results.well.any() else "no run succeeded"
        raise DirectoryError(f"there is nothing to draw of {out}: {why}.")


def _check_column(results: Results, name: str | None, option: str) -> None:
    """Refuse a name that is neither a parameter nor a metric of the table; None is accepted."""
    known = columns_of(results, "varied", "randomized", "metric")
    if name is not None and name not in known:
        hint = did_you_mean(name, known)
        raise ParameterError(f"{option} is {name!r}, no column of the table{hint} There are {', '.join(known)}.")


def _figure(results: Results, x: str, y: str, color: str | None, remark: str) -> tuple[str, Figure]:
    metrics, varied = columns_of(results, "metric"), columns_of(results, "varied")
    sides = sides_in(results.schema)
    if color is None and x in sides and y in sides and x != y:
        points = points_of(results, [x, y])
        return f"{x}-against-{y}", trade_off_figure(points, x, y, points.differing, remark)
    if color is None and not {x, y} & set(metrics):
        color = LEADING
    if results.is_grid and color in metrics and {x, y} <= set(varied) and x != y:
        others = quantities(results, varied)
        across, up = (next(each for each in others if each.name == wanted) for wanted in (x, y))
        differing = [each for each in others if not alike(each.values)]
        return heat_map(across, up, differing, metric_of(results, color), remark + repeats_remark(results))
    title = f"{color} over {x} and {y}" if color else f"{y} over {x}"
    name = title.replace(" ", "-")
    drawn = [quantities(results, [each])[0] for each in (x, y, color) if each]
    good = results.well & np.logical_and.reduce([np.isfinite(each.values) for each in drawn])
    places = np.flatnonzero(good)
    note = f"{len(places):,} runs"
    if len(places) > MOST_POINTS:
        best = places[np.argmin(cost(drawn[-1].side, drawn[-1].values[places]))]
        places, note = thinned(places, MOST_POINTS, [best]), f"{MOST_POINTS:,} of {note}"
    note = remark + note
    across, up, *by = (dataclasses.replace(each, values=each.values[places]) for each in drawn)
    title = title[:1].upper() + title[1:]
    if by:
        return name, pair_scatters([(across, up)], by[0], title, f"{note}; ", star=color in metrics)
    return name, scatters([across], up, [""], title, f"{note}; line: running mean")
