"""Measure a landscape into a directory: its points first, then everything that is made of them.

DIR/landscape.yaml      the resolved tuning whose objective it is
DIR/recording.npz       the tuning's reference recording, if any
DIR/results/            the points, a part for each batch, see `nermo_mjx.runs.rows`
DIR/landscape.parquet   one row per point: parameters, objective, exact gradient, metrics
DIR/landscape.json      how well slopes and secants agree, by parameter and width; versions, machine, command
DIR/plots/              a figure for each parameter
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nermo_mjx.optimize.directory import keep_recording, read_stored, refuse_another
from nermo_mjx.optimize.figures import corner, legend, star
from nermo_mjx.optimize.objective import FURTHEST, Evaluation, Problem
from nermo_mjx.optimize.problems import WalkProblem
from nermo_mjx.optimize.spec import Gradient, Tuned, Tuning
from nermo_mjx.plotting.charts import horizontal_grid, page, set_scales
from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.plotting.shown import ShownValues, shown, spoken
from nermo_mjx.plotting.style import BAND, INK, LINE, MUTED
from nermo_mjx.progress import shows_progress
from nermo_mjx.runs import RunDirectory, engine_of, session, stamp
from nermo_mjx.runs.directory import read_record
from nermo_mjx.runs.files import (
    MISSING,
    DirectoryError,
    clear_errors,
    content_of,
    parquet_bytes,
    parquet_table,
    stored_table,
    to_json,
)
from nermo_mjx.runs.job import SILENT, Interrupted, Progress, Watch
from nermo_mjx.runs.rows import Columns, Runs, keys_of, part_files
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.specs.described import digest_of, write_described
from nermo_mjx.specs.model import written
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.table import joined, profile_text

# ---
# The points: for each parameter a line through the start over its bounds, and pairs of points about nine of it.


#: Points of a line, ends included.
POINTS: Final = 41
#: Those of them about which secants are taken, as far from the ends as the widest ones reach.
CENTRES: Final = (3, 7, 11, 16, 20, 24, 29, 33, 37)
#: Widths of the secants, as fractions of a parameter's range: from those that show whether a derivative is correct to
#: those that show whether it is useful.
WIDTHS: Final = (0.001, 0.005, 0.02, 0.05, 0.1)
#: Points for each parameter.
EACH: Final = POINTS + 2 * len(CENTRES) * len(WIDTHS)
#: What tells the points apart: their columns in the table, beside those of the parameters.
_INDEX: Final = {
    "line": "parameter that changes along the line",
    "centre": "of a secant's end: position in the line of its middle; else -1",
    "width": "of a secant's end: share of the parameter's bounds; else 0",
    "side": "of a secant's end: -1 or 1; else 0",
}


def points_along(tuning: Tuning) -> dict[str, np.ndarray]:
    """For each parameter its line from low to high, then the ends of its secants: `_INDEX` and parameters, (n,)."""
    rows: list[tuple[str, int, float, int, float]] = []
    for tuned in tuning.tuned:
        bounds = tuned.high - tuned.low
        # Like a tuner's points, these stop short of the bounds.
        line = np.linspace(tuned.low + FURTHEST * bounds, tuned.high - FURTHEST * bounds, POINTS)
        line = line.round(14) + 0.0  # 0 and not -4e-16
        rows += [(tuned.name, -1, 0.0, 0, x) for x in line]
        for centre, share, side in itertools.product(CENTRES, WIDTHS, (-1, 1)):
            rows.append((tuned.name, centre, share, side, line[centre] + side * 0.5 * share * bounds))
    *index, x = map(np.array, zip(*rows, strict=True))
    columns = dict(zip(_INDEX, index, strict=True))
    return columns | {each.name: np.where(columns["line"] == each.name, x, each.start) for each in tuning.tuned}


@dataclasses.dataclass(frozen=True)
class Slice:
    """One parameter's line through the start.

    Attributes:
        tuned: the parameter.
        x: its values (N,), increasing; value, slope: objective and its exact derivative (N,), NaN where the robot fell.
        secants: difference quotients about `CENTRES`, of `WIDTHS`, (centres, widths); NaN where the robot fell at one
            end or in the middle.
    """

    tuned: Tuned
    x: Float[np.ndarray, " N"]
    value: Float[np.ndarray, " N"]
    slope: Float[np.ndarray, " N"]
    secants: Float[np.ndarray, "centres widths"]

    def measures(self) -> list[dict[str, Any]]:
        """Of the secants of each width, for landscape.json: the error is the median of |slope - secant| / |secant|."""
        found = []
        for share, column in zip(WIDTHS, self.secants.T, strict=True):
            there = np.isfinite(column)
            secant, slope = column[there], self.slope[list(CENTRES)][there]
            apart, size = np.abs(slope - secant), np.abs(secant)
            # A flat place, where both are 0, is not an error.
            relative = np.divide(apart, size, out=np.where(apart > 0, np.inf, 0.0), where=size > 0)
            found.append(
                {
                    "share": share,
                    "width": share * (self.tuned.high - self.tuned.low),
                    "secants": len(secant),
                    "median_relative_error": float(np.median(relative)) if len(secant) else math.nan,
                    "sign_agreement": float(np.mean(np.sign(slope) == np.sign(secant))) if len(secant) else math.nan,
                }
            )
        return found


def lines_of(tuning: Tuning, table: pa.Table) -> list[Slice]:
    """The lines of a landscape's table, one a tuned parameter."""
    lines = []
    for i, tuned in enumerate(tuning.tuned):
        rows = table.slice(i * EACH, EACH)
        x, value, slope = (rows[name].to_numpy() for name in (tuned.name, "objective", f"gradient.{tuned.name}"))
        ends = np.stack([x, value])[:, POINTS:].reshape(2, len(CENTRES), len(WIDTHS), 2)
        width, rise = ends[..., 1] - ends[..., 0]
        secants = rise / width
        secants[~np.isfinite(value[list(CENTRES)])] = math.nan
        lines.append(Slice(tuned, x[:POINTS], value[:POINTS], slope[:POINTS], secants))
    return lines


# ---
# The points of a landscape: evaluated in batches of one size, and stored as a table.


#: Files of a directory: all points, the resolved tuning whose objective they are of, and what is concluded.
TABLE: Final = "landscape.parquet"
TUNING: Final = "landscape.yaml"
MEASURES: Final = "landscape.json"
#: Worlds of a batch at most: a minute of gradients on two cores, and what a device holds.
CPU_BATCH, DEVICE_BATCH = 64, 1024


def batch_size(count: int) -> int:
    """Worlds of each batch: as even as they can be."""
    most = CPU_BATCH if jax.default_backend() == "cpu" else DEVICE_BATCH
    return math.ceil(count / math.ceil(count / most))


def _evaluate(
    tuning: Tuning, problem: Problem, columns: dict[str, np.ndarray], runs: Runs, code: str, watch: Watch
) -> None:
    """Evaluate the points that are missing, in batches."""
    total, names = len(columns["line"]), tuning.names
    points, there, size = np.stack([columns[name] for name in names], axis=1), len(runs.numbers), batch_size(total)
    missing = np.setdiff1d(np.arange(total), runs.numbers)
    watch.progress(Progress(there / total, there, total, there))
    for first in range(0, len(missing), size):
        began, rows = time.perf_counter(), missing[first : first + size]
        # The last batch is filled up, so that one program is compiled. In double precision, but at the very points that
        # are evaluated: a secant divides by their distance.
        worlds = jnp.asarray(points[np.pad(rows, (0, size - len(rows)), mode="edge")], float)
        results = problem.evaluate(worlds, True)
        batch = _table(tuning, rows, columns, np.asarray(worlds, float), results, code)
        keys = keys_of(runs.group, {name: columns[name][rows] for name in names}, len(rows))
        runs.add(keys, batch.replace_schema_metadata({"wall_seconds": f"{time.perf_counter() - began:.3f}"}))
        done = len(runs.numbers)
        watch.progress(Progress(done / total, done, total, there))


def _table(
    tuning: Tuning, rows: np.ndarray, index: Mapping[str, np.ndarray], points: np.ndarray, found: Evaluation, code: str
) -> pa.Table:
    """The table of some rows, the first ones of a batch at these points (n, p)."""
    batch, parameters, count = Columns(), tuning.parameters, len(rows)
    batch.add("row", rows, "index", "1", "position in the plan")
    for name, meaning in _INDEX.items():
        batch.add(name, index[name][rows], "index", "1", meaning)
    for i, name in enumerate(tuning.names):
        batch.add(name, points[:count, i], "parameter", parameters[name].unit, parameters[name].doc)
    ok, slopes = np.asarray(found.ok, bool)[:count], np.asarray(found.gradient)[:count]
    value = np.where(ok, found.value[:count], np.nan)
    batch.add("objective", value, "objective", "1", "value that is minimized; NaN where the robot fell")
    for i, name in enumerate(tuning.names):
        unit = "1" if parameters[name].unit == "1" else f"1/({parameters[name].unit})"
        slope = np.where(ok, slopes[:, i], np.nan)
        batch.add(f"gradient.{name}", slope, "gradient", unit, f"exact d objective / d {name}")
    for name, values in found.metrics.items():
        metric = (tuning.metrics | tuning.objective_metrics)[name]
        batch.add(name, np.asarray(values)[:count], "metric", metric.unit, metric.doc)
    batch.add("ok", ok, "status", "1", "whether the robot walked to the end, with a finite gradient")
    made_by = "which code made the row, by its name in run.json; empty: not known"
    batch.add("code", np.full(count, code), "code", "1", made_by)
    return batch.table({})


# ---
# What is concluded: landscape.json for programs, the terminal's table and sentences for readers.


#: If slopes and secants of `JUDGED` agree within this, exact gradients point in the right direction.
JUDGED: Final = (0.02, 0.05)
ERROR: Final = 0.25
SIGNS: Final = 0.9
HEADINGS: Final = ("parameter", "width>", "of the bounds>", "secants>", "median error>", "same sign>")


def landscape_content(tuning: Tuning, lines: Sequence[Slice]) -> dict[str, Any]:
    """Content of landscape.json, in SI units and radians.

    `parameters`: by name `bounds`, `start`, at how many of the line's points the robot `fell`, `widths`: for each width
    of secants its `share` of the bounds, the number of `secants`, `median_relative_error` of the slope and
    `sign_agreement`; and `follows`: whether slope and secants of 2 and 5 % agree.
    """
    parameters = {}
    for line in lines:
        tuned, widths = line.tuned, line.measures()
        judged = [width for width in widths if width["share"] in JUDGED]
        agree = all(s["median_relative_error"] <= ERROR and s["sign_agreement"] >= SIGNS for s in judged)
        parameters[tuned.name] = {
            "unit": tuning.parameters[tuned.name].unit,
            "bounds": [tuned.low, tuned.high],
            "start": tuned.start,
            "fell": int((~np.isfinite(line.value)).sum()),
            "widths": widths,
            "follows": agree if all(width["secants"] for width in judged) else None,
        }
    return {"objective": [written(term) for term in tuning.objective.terms], "parameters": parameters}


def rows_of(content: Mapping[str, Any]) -> list[list[str]]:
    """Rows of texts under `HEADINGS`."""
    rows = []
    for name, about in content["parameters"].items():
        for i, width in enumerate(about["widths"]):
            quantity = shown("", about["unit"], np.asarray(width["width"]))
            row = [name if i == 0 else "", quantity.shown(float(quantity.values)), f"{100 * width['share']:g} %"]
            shares = (width["median_relative_error"], width["sign_agreement"])
            rows.append([*row, str(width["secants"]), *map(_percent, shares)])
    return rows


def sentences(content: Mapping[str, Any]) -> list[str]:
    """The conclusion, one sentence per parameter."""
    conclusions = []
    for name, about in content["parameters"].items():
        fell = f" At {about['fell']} of {POINTS} points the robot fell." if about["fell"] else ""
        if about["follows"] is None:
            conclusions.append(f"{name}: too few places where the robot walks to the end; nothing can be said.{fell}")
            continue
        differs = " and ".join(
            f"{_percent(width['median_relative_error'])} from secants {100 * width['share']:g} % of the bounds wide "
            f"({_percent(width['sign_agreement'])} of one sign)"
            for width in about["widths"]
            if width["share"] in JUDGED and width["secants"]
        )
        follow, mislead = "exact gradients can be followed", "exact gradients may mislead; take secants or CMA-ES"
        conclusions.append(f"{name}: {follow if about['follows'] else mislead}. The slope differs by {differs}.{fell}")
    return conclusions


def _percent(share: float) -> str:
    if not math.isfinite(share):
        return MISSING
    return f"{100 * share:.2g} %" if 0 < share < 0.0995 else f"{100 * share:.0f} %"


@dataclasses.dataclass(frozen=True)
class LandscapeResult:
    """A measured landscape.

    Attributes:
        out: its directory.
        tuning: whose objective it is.
        table: all points, see `nermo_mjx.optimize.landscape`.
        content: of landscape.json.
        plots: files of the figures.
        evaluated: points that this call evaluated; 0 if the directory held them.
    """

    out: Path
    tuning: Tuning
    table: pa.Table
    content: dict[str, Any]
    plots: tuple[Path, ...]
    evaluated: int


@shows_progress("landscape", "points")
def run_landscape(
    spec: Tuning | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    problem: Problem | None = None,
    watch: Watch = SILENT,
    progress: bool = True,
    accept_new_code: bool = False,
) -> LandscapeResult:
    """Measure whether a tuning's gradients can be trusted, on a line along each parameter through the given start.

    Objective and exact slope are found at 41 points of each line, and about nine of them secants of five widths, from
    0.1 to 10 % of the bounds; narrower bounds in the file look more closely. If the slope equals narrow secants, the
    derivative is correct; if it equals wide ones, it is useful. A directory that already contains the points is not
    evaluated again; one that contains some of them is resumed.

    Args:
        spec: a `Tuning`, a dict with the fields of a tuning file, or the path of one; its optimizer and further
            starts do not matter.
        out: the directory.
        problem: replaces the simulation of the tuning (`nermo_mjx.optimize.problems.WalkProblem`).
        watch: is told the points done, and all of them, and what is moved aside.
        progress: whether it is shown where somebody looks, if there is no watch.
        accept_new_code: reuse points that other code evaluated.

    Raises:
        SpecError, DirectoryError, OtherCode, Interrupted: see "Errors of jobs" in docs/reference/python.md.
    """
    # Slopes are exact ones, however it is tuned; a tuner's path does not matter.
    tuning = dataclasses.replace(Tuning.of(spec), method=Gradient()).without_path()
    with RunDirectory(out, "landscape") as held, clear_errors(held.out):
        if part_files(held.out):
            refuse_another(held.out / TUNING, "landscape", "points", tuning)
        columns, group = points_along(tuning), digest_of(tuning.digest(), POINTS, CENTRES, WIDTHS)
        runs = Runs(held.out, group, warn=watch.warn, held=held)
        there, total = len(runs.numbers), len(columns["line"])
        made_by = stamp(tuning.setup.load().fingerprint, tuning.engine)
        if there < total:
            runs.take_codes([made_by], accept=accept_new_code)
            held.note_session(session())
        tuning = keep_recording(held, tuning, watch.warn)
        write_described(held, TUNING, tuning, read_stored, watch.warn)
        try:
            if there < total:
                _evaluate(tuning, problem or WalkProblem(tuning), columns, runs, made_by.id, watch)
        except KeyboardInterrupt:
            kept = f"{len(runs.numbers)} of {total} walks are kept in {held.out}"
            raise Interrupted(f"stopped; {kept}: run the same command again to resume.") from None
        parts = [stored_table(part.path, "points that can be read any more") for part in runs.parts]
        points = joined([part.replace_schema_metadata(None) for part in parts], np.arange(total))
        points = points.drop_columns(["row", "key"])
        held.write(TABLE, parquet_bytes(points))  # before anything that can still fail
        lines = lines_of(tuning, points)
        plots = write_figures(figures_of_lines(tuning, lines), held.out / "plots")
        content = landscape_content(tuning, lines) | {
            "evaluations": total,
            "wall_seconds": round(sum(part.seconds for part in runs.parts), 3),
            "plots": [path.relative_to(held.out).as_posix() for path in plots],
            **(read_record(held.out).get("sessions") or [{}])[-1],
        }
        held.write(MEASURES, to_json(content))  # last: it marks completion
        return LandscapeResult(held.out, tuning, points, content, tuple(plots), total - there)


def landscape_status(out: Path) -> Status:
    """How many points of a landscape a directory holds."""
    notes, total = list[str](), None
    try:
        total = EACH * len(read_stored(out / TUNING).tuned)
    except (SpecError, OSError) as error:
        notes.append(f"Its tuning cannot be read: {error}")
    parts = (metadata_of(path, notes, "its points will be evaluated again.") for path in part_files(out))
    done = sum(part.num_rows for part in parts if part)
    made = metadata_of(out / TABLE, notes, "it is made again of the points.") is not None and (out / MEASURES).exists()
    return status_of(
        "points",
        out,
        done,
        total,
        made and done == total,
        command="landscape",
        spec=TUNING,
        engine=engine_of(out),
        notes=notes,
    )


# ---
# Figures of a landscape: the objective along each parameter with its exact tangents, and its slope beside secants.


#: From narrow secants to wide ones.
_SECANTS: Final = ("#fcae12", "#e55c30", "#ba3655", "#781c6d", "#230c4c")  # of the even colour map inferno
#: Length of a tangent, in distances of two points.
_TANGENT: Final = 0.8
#: Slopes further from the middle than this multiple of the exact ones' spread are cut off.
_CUT: Final = 2.5


def figures_of_lines(tuning: Tuning, lines: Sequence[Slice]) -> Iterator[tuple[str, Figure]]:
    """A figure for each line; one on which the robot nowhere walks has none."""
    for line in lines:
        if np.isfinite(line.value).any():
            yield f"line-{line.tuned.name}", line_figure(tuning, line)


def landscape_figures(out: Path) -> Figures:
    """The figures of a landscape's directory, from its table.

    Raises:
        SpecError: its landscape.yaml cannot be read.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    tuning, points = read_stored(out / TUNING), parquet_table(content_of(out / TABLE) or b"")
    if points is None or not set(tuning.names) <= set(points.column_names) or len(points) != EACH * len(tuning.tuned):
        raise DirectoryError(
            f"{out / TABLE} is missing, damaged, or another landscape's: run nermo-mjx landscape again."
        )
    return figures_of_lines(tuning, lines_of(tuning, points))


def line_figure(tuning: Tuning, line: Slice) -> Figure:
    """One line: the objective with a tangent at each point; below it the slope, and each secant over its width."""
    parameters = tuning.parameters
    starts = {each.name: shown(each.name, parameters[each.name].unit, np.array(each.start)) for each in tuning.tuned}
    others = [f"{name} {q.shown(float(q.values))}" for name, q in starts.items() if name != line.tuned.name]
    note = "above: objective with its exact tangents, star: lowest; below: exact slope, and secants over their width"
    note += f"; {profile_text([tuning.setup.profile])}"
    note += "; dashed: the given start" + (f"; there, and here, {', '.join(others)}" if others else "")
    x = shown(line.tuned.name, parameters[line.tuned.name].unit, line.x)
    figure = page(f"Objective and slope along {spoken(line.tuned.name)}", 7.4, 5.6, note)
    above, below = figure.subplots(2, 1, sharex=True)
    per_shown = np.ptp(line.x) / np.ptp(x.values)
    _draw_objective(above, line, x, per_shown)
    _draw_slopes(below, line, x, per_shown)
    for ax in (above, below):
        horizontal_grid(ax)
        ax.axvline(float(starts[line.tuned.name].values), color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=1)
    set_scales(below, x)
    above.set_ylabel("objective [1]")
    below.set(xlabel=x.label, ylabel=f"slope [1/{x.unit}]" if x.unit else "slope [1]")
    return figure


def _draw_objective(ax: Axes, line: Slice, x: ShownValues, per_shown: float) -> None:
    """Points with tangents, their lowest a star, and a cross where the robot fell."""
    half = 0.5 * _TANGENT * np.ptp(x.values) / (len(line.x) - 1)
    rise = half * line.slope * per_shown
    ax.plot(x.values, line.value, color=BAND, lw=1.0, zorder=2)
    across, up = np.stack([x.values - half, x.values + half]), np.stack([line.value - rise, line.value + rise])
    ax.plot(across, up, color=LINE, lw=1.5, zorder=3, solid_capstyle="butt")
    ax.plot(x.values, line.value, "o", ms=2.8, color=LINE, mec="white", mew=0.4, zorder=4)
    at = int(np.nanargmin(line.value))
    star(ax, x.values[at], line.value[at], 130, zorder=5)
    # The axis is the values', however steep a tangent is.
    low, high = float(np.nanmin(line.value)), float(np.nanmax(line.value))
    room = 0.08 * (high - low) or 0.01 * max(abs(low), 1e-6)
    ax.set_ylim(low - room, high + room)
    fell = x.values[~np.isfinite(line.value)]
    if len(fell):
        top = np.full(len(fell), 0.97)
        ax.plot(fell, top, "x", transform=ax.get_xaxis_transform(), color=INK, ms=5, mew=1.3, label="fell")
        legend(ax)


def _draw_slopes(ax: Axes, line: Slice, x: ShownValues, per_shown: float) -> None:
    """Exact slopes as a line, each secant as a bar over its width."""
    slope = line.slope * per_shown
    ax.plot(x.values, slope, "-o", color=LINE, lw=1.4, ms=2.8, mec="white", mew=0.4, zorder=2, label="exact slope")
    drawn = [slope[np.isfinite(slope)]]
    for i, (share, colour) in enumerate(zip(WIDTHS, _SECANTS, strict=True)):
        there = np.isfinite(line.secants[:, i])
        centre, value = line.x[list(CENTRES)][there] / per_shown, line.secants[there, i] * per_shown
        half = 0.5 * share * (line.tuned.high - line.tuned.low) / per_shown
        # The narrow ones lie on top, smaller, so that those that agree are all seen.
        ax.hlines(value, centre - half, centre + half, color=colour, lw=2.0, zorder=4 - 0.1 * i)
        name, size, layer = f"secants of {100 * share:g} %", 3.0 + 1.1 * i, 5 - 0.1 * i
        ax.plot(centre, value, "D", ms=size, color=colour, mec="white", mew=0.4, zorder=layer, label=name)
        drawn.append(value)
    ax.axhline(0.0, color=MUTED, lw=0.8, zorder=1)
    # What lies so far off that the slope could not be seen is left out, and counted.
    low, high = np.quantile(drawn[0], [0.02, 0.98])
    room, everything = _CUT * max(high - low, 1e-9 + 1e-3 * abs(low)), np.concatenate(drawn)
    inside = everything[(everything >= low - room) & (everything <= high + room)]
    margin = 0.06 * (np.ptp(inside) or 1.0)
    ax.set_ylim(min(inside.min(), 0.0) - margin, max(inside.max(), 0.0) + margin)
    if outside := len(everything) - len(inside):
        corner(ax, f"{outside} outside", 1.0)
    legend(ax)
