"""Figures of all variants at once: two metrics against each other, and parallel coordinates of all parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from nermo_mjx.plotting.shown import ShownValues
from nermo_mjx.sweep.parallel import BEST_LINES, MOST_AXES, MOST_LINES, chosen_lines, parallel
from nermo_mjx.sweep.points import Points, points_of, thinned, titled
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.sides import cost
from nermo_mjx.sweep.summary import LEADING
from nermo_mjx.sweep.trade_off import front, named_points, trade_off

#: What a faster walk is weighed against.
AGAINST: Final = "roll_std"
#: Points of a trade-off that are drawn, and parameters that are told of a named one.
_MOST_POINTS: Final = 20_000
_MOST_TOLD: Final = 6


def survey_figures(results: Results, metric: str, remark: str = "") -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of the figures over all variants of a table; none where one parameter or none differs."""
    weighed = AGAINST if metric == LEADING and AGAINST in results.schema.names else None
    points = points_of(results, [metric, *([weighed] if weighed else [])])
    names = points.differing
    if len(names) < 2 or len(points.rows) < 4:
        return
    yield f"{metric}-parallel", _parallel(points, names, metric, remark)
    if weighed:
        yield f"{metric}-against-{weighed}", trade_off_figure(points, metric, weighed, names, remark)


def trade_off_figure(points: Points, first: str, second: str, names: tuple[str, ...], remark: str) -> Figure:
    """Two metrics with a better direction against each other; the named points have their parameters below."""
    x, y = points.metrics[first], points.metrics[second]
    best = front(cost(x.side, x.values), cost(y.side, y.values))
    named = best[named_points(x.values[best], y.values[best])]
    told = points.of(names[:_MOST_TOLD], named)
    lines = [
        (int(place), f"{first} {x.shown(x.values[place])}, {second} {y.shown(y.values[place])}:  "
                     + ", ".join(f"{each.name} {each.shown(each.values[i])}" for each in told))
        for i, place in enumerate(named)
    ]  # fmt: skip
    if len(names) > _MOST_TOLD:
        remark += f"{len(names) - _MOST_TOLD} more parameters are in the table; "
    drawn = np.flatnonzero(np.isfinite(x.values) & np.isfinite(y.values))
    note = f"{remark}{points.what}; "
    if len(drawn) > _MOST_POINTS:
        drawn = thinned(drawn, _MOST_POINTS, best)
        note = f"{remark}{_MOST_POINTS:,} of {points.what}, and the whole front; "
    place = {int(row): i for i, row in enumerate(drawn)}
    x, y = (dataclasses.replace(each, values=each.values[drawn]) for each in (x, y))
    best = np.array([place[int(row)] for row in best], int)
    lines = [(place[row], text) for row, text in lines]
    return trade_off(x, y, best, (x.side, y.side), lines, f"{titled(first)} against {second}", note)


def _parallel(points: Points, names: tuple[str, ...], metric: str, remark: str) -> Figure:
    values = points.metrics[metric]
    price = cost(values.side, values.values)
    drawn, left_out = chosen_lines(price), 0
    parameters = points.of(names, drawn)
    z = dataclasses.replace(values, values=values.values[drawn])
    if len(parameters) > MOST_AXES:
        matter = np.argsort([-abs(_influence(each, z)) for each in parameters], kind="stable")[:MOST_AXES]
        left_out = len(parameters) - MOST_AXES
        parameters = [parameters[i] for i in sorted(matter)]
    known = int(np.isfinite(price).sum())
    note = f"{remark}{points.what}" if known <= MOST_LINES else (
        f"{remark}{MOST_LINES:,} of {points.what}, evenly by rank, and the best {BEST_LINES}"
    )  # fmt: skip
    if left_out:
        note += f"; {left_out} parameters that matter less are not shown"
    at = ", ".join(f"{each.name} {each.shown(each.values[-1])}" for each in parameters)
    word = "best" if values.side else "highest"
    note += f"; orange: the {min(BEST_LINES, known)} {word}, of which the first is {z.shown(z.values[-1])} at {at}"
    return parallel(parameters, z, f"{titled(metric)}: all parameters side by side", note)


def _influence(parameter: ShownValues, z: ShownValues) -> float:
    known = np.isfinite(parameter.values)
    own, other = parameter.values[known], z.values[known]
    if len(own) < 3 or np.ptp(own) == 0 or np.ptp(other) == 0:
        return 0.0
    return float(stats.spearmanr(own, other).statistic)
