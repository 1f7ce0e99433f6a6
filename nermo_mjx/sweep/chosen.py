"""One figure of a sweep's table, of columns that a user names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from nermo_mjx.plotting.files import FORMATS, lay_out, write_figure
from nermo_mjx.plotting.quantity import Quantity
from nermo_mjx.plotting.style import STYLE
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.specs.reading import nearest
from nermo_mjx.sweep.figures import pair_scatters, scatters
from nermo_mjx.sweep.plots import MOST_POINTS, heat_map
from nermo_mjx.sweep.points import points_of, quantity
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.summary import LEADING, OBJECTIVES, cost
from nermo_mjx.sweep.survey import trade_off_figure
from nermo_mjx.sweep.table import columns_of


def draw_chosen(
    results: Results,
    folder: Path,
    x: str,
    y: str | None = None,
    color: str | None = None,
    *,
    write: Callable[[Path, bytes], None] | None = None,
    formats: Sequence[str] = FORMATS,
    remark: str = "",
) -> list[Path]:
    """Draw one figure of the named columns.

    Two parameters of a grid give a heat map, two metrics that have a better side a Pareto front, all else a scatter.

    Args:
        results: the table.
        folder: where the files go.
        x, y: parameters or metrics; without y, it is the speed.
        color: a column that colours the points; of two parameters, the speed by default.
        write, formats, remark: see `nermo_mjx.sweep.plots.draw_plots`.

    Raises:
        ParameterError: there is no such column, or no run that went well.
    """
    for option, name in (("x", x), ("y", y), ("color", color)):
        check_column(results, name, option)
    y = y or LEADING
    if not results.statuses()[0].any():
        raise ParameterError("no run of the table went well, so that there is nothing to plot.")
    with matplotlib.rc_context(STYLE):
        name, figure = _figure(results, x, y, color, remark)
        lay_out(figure)
        return write_figure(figure, folder, name, write, formats)


def check_column(results: Results, name: str | None, option: str) -> None:
    """Refuse a name that is no parameter and no metric of the table; None is none."""
    known = columns_of(results, "varied", "randomized", "metric")
    if name is not None and name not in known:
        hint = nearest(name, known)
        raise ParameterError(f"{option} is {name!r}, no column of the table{hint} There are {', '.join(known)}.")


def _figure(results: Results, x: str, y: str, color: str | None, remark: str) -> tuple[str, Figure]:
    metrics, varied = columns_of(results, "metric"), columns_of(results, "varied")
    if color is None and x in OBJECTIVES and y in OBJECTIVES and x != y:
        points = points_of(results, [x, y])
        return f"{x}-against-{y}", trade_off_figure(points, x, y, points.differing, remark)
    if color is None and not {x, y} & set(metrics):
        color = LEADING
    well, _ = results.statuses()
    title = f"{color} over {x} and {y}" if color else f"{y} over {x}"
    name = f"{color}-over-{x}-and-{y}" if color else f"{y}-over-{x}"
    grid = (results.schema.metadata or {}).get(b"sampler") == b"grid"
    if grid and color in metrics and {x, y} <= set(varied) and x != y:
        z = quantity(results, color, np.where(well, results.column(color), np.nan))
        others = [quantity(results, other, results.column(other)) for other in varied]
        across, up = (next(each for each in others if each.name == wanted) for wanted in (x, y))
        repeats = int(np.max(results.column("repeat"))) + 1
        remark += f"mean of {repeats} repeats; " if repeats > 1 else ""
        return name, heat_map(across, up, [each for each in others if np.ptp(each.values) > 0], z, remark)
    columns = [x, y, *([color] if color else [])]
    drawn = [quantity(results, each, results.column(each)) for each in columns]
    good = well & np.logical_and.reduce([np.isfinite(each.values) for each in drawn])
    places = np.flatnonzero(good)
    note = f"{remark}{len(places):,} runs"
    if len(places) > MOST_POINTS:
        best = places[np.argmin(cost(drawn[-1].name, drawn[-1].values[places]))]
        places = np.union1d(places[np.linspace(0, len(places) - 1, MOST_POINTS).round().astype(int)], [best])
        note = f"{remark}{MOST_POINTS:,} of {note.removeprefix(remark)}"
    across, up, *by = (Quantity(each.name, each.unit, each.values[places], each.log) for each in drawn)
    title = title[:1].upper() + title[1:]
    if by:
        return name, pair_scatters([(across, up)], by[0], title, f"{note}; ", star=color in metrics)
    return name, scatters([across], up, [""], title, f"{note}; line: running mean")
