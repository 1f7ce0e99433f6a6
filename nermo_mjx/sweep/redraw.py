"""The figures of a sweep's directory, from its table alone: the default ones, or one of columns that a user names."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from nermo_mjx.plotting.files import Figures
from nermo_mjx.robot.nearest import did_you_mean
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.sweep.figures import pair_scatters, scatters
from nermo_mjx.sweep.findings import findings
from nermo_mjx.sweep.plots import MOST_POINTS, figures_of, heat_map
from nermo_mjx.sweep.points import alike, metric_of, points_of, quantities, repeats_remark, thinned
from nermo_mjx.sweep.results import Results, chunk_files
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.sides import cost, sides_in
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.summary import LEADING
from nermo_mjx.sweep.survey import trade_off_figure
from nermo_mjx.sweep.table import columns_of


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
    files = list(chunk_files(out).values())
    if not files:
        raise DirectoryError(
            f"{out} holds no results of its sweep yet: run nermo-mjx sweep {out / 'sweep.yaml'} --out {out}."
        )
    results, sweep = Results(files), Sweep.from_directory(out)
    rows = len(Sample(sweep))
    remark = ""
    if results.rows < rows:
        remark = f"{results.rows:,} of {rows:,} runs so far; "
        if notify is not None:
            notify(f"{results.rows:,} of {rows:,} runs are in {out}; the figures show these.")
    if x is not None:
        return chosen_figure(results, x, y, color, remark)
    if y is not None:
        raise ParameterError("y is given without x: name both, or x alone.")
    if color is not None and color not in columns_of(results, "metric"):
        _check_column(results, color, "color")
        raise ParameterError(f"color is {color!r}, a parameter: name x and y, too.")
    found = findings(results, sweep, color or LEADING, notify)
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
