"""Measure a landscape into a directory: its points first, then everything that is made of them.

DIR/landscape.yaml      the resolved tuning whose objective it is
DIR/results/            the points, a part for each batch, see `nermo_mjx.runs.rows`
DIR/landscape.parquet   one row per point: parameters, objective, exact gradient, metrics
DIR/recording.npz       the tuning's reference recording, if any
DIR/run.json            which code made it; versions, machine and command of each session that evaluated points
DIR/landscape.json      how well slopes and secants agree, by parameter and width; versions, machine, command
DIR/report.md           the same to read, with its figures
DIR/plots/              a figure for each parameter
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nermo_mjx.optimize.directory import keep_recording, read_stored
from nermo_mjx.optimize.figures import corner, legend, star
from nermo_mjx.optimize.objective import FURTHEST, Evaluation, Problem
from nermo_mjx.optimize.problems import WalkProblem
from nermo_mjx.optimize.spec import Gradient, Tuned, Tuning
from nermo_mjx.plotting.charts import horizontal_grid, page, set_scales
from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.plotting.shown import ShownValues, shown, spoken
from nermo_mjx.plotting.style import BAND, INK, LINE, MUTED
from nermo_mjx.progress import shows_progress
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs import RunDirectory, Written, engine_of, session, stamp
from nermo_mjx.runs.code import local_time
from nermo_mjx.runs.files import (
    MISSING,
    DirectoryError,
    WrongDirectory,
    clear_errors,
    content_of,
    listed,
    parquet_bytes,
    parquet_table,
    stored_table,
    table,
    to_json,
)
from nermo_mjx.runs.job import SILENT, Interrupted, Progress, Watch
from nermo_mjx.runs.rows import Columns, Runs, keys_of, part_files
from nermo_mjx.runs.status import Status, last_command, metadata_of
from nermo_mjx.specs.described import digest_of, write_described
from nermo_mjx.specs.model import written
from nermo_mjx.specs.reading import changes
from nermo_mjx.sweep.table import joined, profile_text

# ---
# Which points a landscape is measured at: a line along each parameter, and pairs of points about some of them.


#: Widths of the secants, as fractions of a parameter's range: from those that show whether a derivative is correct to
#: those that show whether it is useful.
WIDTHS: Final = (0.001, 0.005, 0.02, 0.05, 0.1)
#: Number of points of each line around which secants are taken.
CENTRES: Final = 9
#: Fraction of a line left free at both ends, so that the widest secants fit.
_MARGIN: Final = 0.25
#: What tells the points apart: their columns in the table, beside those of the parameters.
_INDEX: Final = {
    "line": "parameter that changes along the line",
    "centre": "of a secant's end: position in the line of its middle; else -1",
    "width": "of a secant's end: share of the parameter's bounds; else 0",
    "side": "of a secant's end: -1 or 1; else 0",
}


def points_along(tuning: Tuning, points: int, span: float) -> dict[str, np.ndarray]:
    """Lines through the given start over the bounds, each with its secants: the columns `_INDEX` and parameters, (n,).

    Args:
        points: of each line, ends included; they come first, from low to high.
        span: length of each line, as a fraction of the bounds; shorter ones lie about the start.
    """
    rows: list[tuple[str, int, float, int, float]] = []
    for tuned in tuning.tuned:
        bounds = tuned.high - tuned.low
        # Like a tuner's points, these stop short of the bounds.
        low, high = tuned.low + FURTHEST * bounds, tuned.high - FURTHEST * bounds
        length = span * (high - low)
        first = min(max(tuned.start - length / 2, low), high - length)
        line = np.linspace(first, first + length, points).round(14) + 0.0  # 0 and not -4e-16
        rows += [(tuned.name, -1, 0.0, 0, x) for x in line]
        # Evenly spread, as far from the line's ends as the widest secants reach.
        margin = min(0.5 * max(WIDTHS) * bounds, _MARGIN * (line[-1] - line[0]))
        inner = np.flatnonzero((line - line[0] >= margin) & (line[-1] - line >= margin))
        middles = np.unique(inner[np.linspace(0, len(inner) - 1, CENTRES).round().astype(int)]).tolist()
        for middle, share in itertools.product(middles, WIDTHS):
            ends = [(tuned.name, middle, share, side, line[middle] + side * 0.5 * share * bounds) for side in (-1, 1)]
            rows += ends if low <= ends[0][-1] and ends[1][-1] <= high else []
    *index, x = map(np.array, zip(*rows, strict=True))
    columns = dict(zip(_INDEX, index, strict=True))
    return columns | {each.name: np.where(columns["line"] == each.name, x, each.start) for each in tuning.tuned}


# ---
# The lines of a landscape: values and exact slopes along a parameter, and how well secants of each width agree.


#: Neighbouring points of a line to which a parabola is fitted, to separate ripple from shape.
_WINDOW: Final = 7


@dataclasses.dataclass(frozen=True)
class Slice:
    """One parameter's line through the start.

    Attributes:
        tuned: the parameter.
        x: its values (N,), increasing; value, slope: objective and its exact derivative (N,), NaN where the robot fell.
        secants: of each of `WIDTHS` (k, 4): in the middle of each the parameter, its slope, the exact one, and the
            residual of a parabola through all points within the width; none with an end at which the robot fell.
    """

    tuned: Tuned
    x: Float[np.ndarray, " N"]
    value: Float[np.ndarray, " N"]
    slope: Float[np.ndarray, " N"]
    secants: dict[float, Float[np.ndarray, "k 4"]]

    def measures(self, share: float) -> dict[str, Any]:
        """Of secants of a width, for landscape.json: the error is the median of |slope - secant| / |secant|."""
        _, secant, slope, residual = self.secants[share].T
        apart, size, count = np.abs(slope - secant), np.abs(secant), len(secant)
        # A flat place, where both are 0, is not an error.
        relative = np.divide(apart, size, out=np.where(apart > 0, np.inf, 0.0), where=size > 0)
        return {
            "share": share,
            "width": share * (self.tuned.high - self.tuned.low),
            "secants": count,
            "median_relative_error": float(np.median(relative)) if count else math.nan,
            "sign_agreement": float(np.mean(np.sign(slope) == np.sign(secant))) if count else math.nan,
            "ripple": _root_mean_square(residual),
        }


def lines_of(tuning: Tuning, table: pa.Table) -> list[Slice]:
    """The lines of a landscape's table, one a tuned parameter."""
    lines = []
    for tuned in tuning.tuned:
        names = ("centre", "width", "side", tuned.name, "objective", f"gradient.{tuned.name}")
        rows = table.filter(pc.equal(table["line"], tuned.name))
        centre, width, side, at, objective, gradient = (rows[name].to_numpy() for name in names)
        x, value, slope = (column[side == 0] for column in (at, objective, gradient))
        secants = {}
        for share in WIDTHS:
            complete = list[tuple[float, ...]]()
            for middle in np.unique(centre[side != 0]).tolist():
                low, high = (np.flatnonzero((centre == middle) & (width == share) & (side == end)) for end in (-1, 1))
                if not len(low) or not np.isfinite([value[middle], *objective[low], *objective[high]]).all():
                    continue
                secant = (objective[high] - objective[low]).item() / (at[high] - at[low]).item()
                near = (centre == middle) & (width <= share)
                residual = _residual(np.append(at[near], x[middle]), np.append(objective[near], value[middle]))
                complete.append((x[middle], secant, slope[middle], residual))
            secants[share] = np.array(complete, float).reshape(-1, 4)
        lines.append(Slice(tuned, x, value, slope, secants))
    return lines


def _residual(x: Float[np.ndarray, " k"], value: Float[np.ndarray, " k"]) -> float:
    """Standard deviation of values about their parabola; NaN from less than five, or where the robot fell."""
    if len(x) < 5 or not np.isfinite(value).all():
        return math.nan
    scaled = (x - x.mean()) / np.ptp(x)
    _, residual, *_ = np.polyfit(scaled, value, 2, full=True)
    return math.sqrt(float(residual.sum()) / (len(x) - 3))


def _root_mean_square(residuals: Float[np.ndarray, " k"]) -> float:
    """Of those that are known; NaN without any."""
    good = residuals[np.isfinite(residuals)]
    return float(np.sqrt(np.mean(good**2))) if len(good) else math.nan


# ---
# The points of a landscape: evaluated in batches of one size, and stored as a table.


#: Files of a directory: all points, and the resolved tuning whose objective they are of.
TABLE: Final = "landscape.parquet"
TUNING: Final = "landscape.yaml"
#: Worlds of a batch at most: a minute of gradients on two cores, and what a device holds.
CPU_BATCH, DEVICE_BATCH = 64, 1024
#: In the metadata of the table: its key, and what that is of.
KEY: Final = "landscape"
IDENTITY: Final = "identity"


def batch_size(count: int) -> int:
    """Worlds of each batch: as even as they can be."""
    most = CPU_BATCH if jax.default_backend() == "cpu" else DEVICE_BATCH
    return math.ceil(count / math.ceil(count / most))


def stored_points(runs: Runs) -> pa.Table:
    """The table of all points, which are there; its metadata is of the batches, `session` of the last one."""
    parts = [stored_table(part.path, "points that can be read any more") for part in runs.parts]
    notes = [{key.decode(): text.decode() for key, text in part.schema.metadata.items()} for part in parts]
    about = max(notes, key=lambda each: json.loads(each["session"])["started"])
    about |= {"wall_seconds": f"{sum(part.seconds for part in runs.parts):.3f}", "batches": str(len(parts))}
    points = joined([part.replace_schema_metadata(None) for part in parts], np.arange(len(runs.numbers)))
    return points.drop_columns(["row", "key"]).replace_schema_metadata(about)


def check_directory(out: Path, wanted: Mapping[str, Any]) -> None:
    """Raise `WrongDirectory` if a directory holds all points of another landscape; see `identity`."""
    if (points := parquet_table(content_of(out / TABLE) or b"")) is None:
        return
    notes = points.schema.metadata or {}
    if notes.get(KEY.encode()) != key(wanted).encode():
        there = json.loads(notes.get(IDENTITY.encode(), b"null")) or wanted
        apart = changes(*({name: each[name] for name in each if name != "digest"} for each in (there, wanted)))
        which = f", with another {', '.join(apart)}" if apart else ""
        raise WrongDirectory(f"{out} holds another landscape{which}; choose another directory.")


def identity(tuning: Tuning, points: int, span: float) -> dict[str, Any]:
    """All that determines the table: not a tuner's path, so not optimizer, starts and seed."""
    walk = tuning.without_path()
    about = walk.identity()
    lines = {"points": points, "span": span, "centres": CENTRES, "widths": list(WIDTHS)}
    return about["fields"] | about["defaults"] | {"recording": about["recording"][:8], "digest": walk.digest()} | lines


def key(identity: Mapping[str, Any]) -> str:
    """A hash of an identity."""
    return digest_of(*(identity[name] for name in ("digest", "points", "span", "centres", "widths")))


def _evaluate(
    tuning: Tuning,
    problem: Problem,
    columns: dict[str, np.ndarray],
    runs: Runs,
    about: dict[str, str],
    code: str,
    watch: Watch,
) -> None:
    """Evaluate the points that are missing, in batches; `about` is noted in the metadata of each."""
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
        about |= {"batch": str(size), "precision": str(np.asarray(results.value).dtype)}
        about |= {"wall_seconds": f"{time.perf_counter() - began:.3f}"}
        keys = keys_of(runs.group, {name: columns[name][rows] for name in names}, len(rows))
        runs.add(keys, batch.replace_schema_metadata(about))
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
# Reports of a landscape: landscape.json for programs, report.md and the terminal's table for readers.


#: If slopes and secants of `JUDGED` agree within this, exact gradients point in the right direction.
JUDGED: Final = (0.02, 0.05)
ERROR: Final = 0.25
SIGNS: Final = 0.9
_NUMBERS: Final = ("width", "of the bounds", "secants", "median error", "same sign", "ripple")
HEADINGS: Final = (("parameter", "left"), *((heading, "right") for heading in _NUMBERS))


def landscape_content(tuning: Tuning, points: pa.Table, lines: Sequence[Slice]) -> dict[str, Any]:
    """Content of landscape.json, in SI units and radians.

    `parameters`: by name `bounds`, `start`, the line `from` and `to`, the lowest and highest objective on it and where
    it is lowest, how many of its points `fell`, the line's `ripple` (residual of parabolas through seven neighbouring
    points), `widths`: for each width of secants its `share` of the bounds, the number of `secants`,
    `median_relative_error` of the slope, `sign_agreement`, `ripple`; and `follows`: whether slope and secants of 2 and
    5 % agree.
    """
    notes = {key.decode(): value.decode() for key, value in (points.schema.metadata or {}).items()}
    parameters = {}
    for line in lines:
        tuned, widths = line.tuned, [line.measures(share) for share in WIDTHS]
        walked = np.isfinite(line.value)
        windows = [slice(i, i + _WINDOW) for i in range(len(line.x) - _WINDOW + 1)]
        ripple = _root_mean_square(np.array([_residual(line.x[part], line.value[part]) for part in windows]))
        judged = [width for width in widths if width["share"] in JUDGED]
        agree = all(s["median_relative_error"] <= ERROR and s["sign_agreement"] >= SIGNS for s in judged)
        parameters[tuned.name] = {
            "unit": tuning.parameters[tuned.name].unit,
            "bounds": [tuned.low, tuned.high],
            "start": tuned.start,
            "from": float(line.x[0]),
            "to": float(line.x[-1]),
            "points": len(line.x),
            "fell": int((~walked).sum()),
            "lowest": float(np.nanmin(line.value)) if walked.any() else math.nan,
            "lowest_at": float(line.x[np.nanargmin(line.value)]) if walked.any() else math.nan,
            "highest": float(np.nanmax(line.value)) if walked.any() else math.nan,
            "ripple": ripple,
            "widths": widths,
            "follows": agree if all(width["secants"] for width in judged) else None,
        }
    return {
        "objective": [written(term) for term in tuning.objective.terms],
        "parameters": parameters,
        "evaluations": points.num_rows,
        "batch": int(notes["batch"]),
        "precision": notes["precision"],
        "wall_seconds": float(notes["wall_seconds"]),
        "plots": [],
        **json.loads(notes["session"]),
    }


def rows_of(content: Mapping[str, Any]) -> list[list[str]]:
    """Rows of texts under `HEADINGS`."""
    rows = []
    for name, about in content["parameters"].items():
        for i, width in enumerate(about["widths"]):
            quantity = shown("", about["unit"], np.asarray(width["width"]))
            shares = (width["median_relative_error"], width["sign_agreement"])
            row = [name if i == 0 else "", quantity.shown(float(quantity.values)), f"{100 * width['share']:g} %"]
            rows.append([*row, str(width["secants"]), *map(_percent, shares), _number(width["ripple"])])
    return rows


def sentences(content: Mapping[str, Any]) -> list[str]:
    """The conclusion, one sentence per parameter."""
    conclusions = []
    for name, about in content["parameters"].items():
        if about["follows"] is None:
            conclusions.append(f"{name}: too few places where the robot walks to the end; nothing can be said.")
            continue
        differs = " and ".join(
            f"{_percent(width['median_relative_error'])} from secants {100 * width['share']:g} % of the bounds wide "
            f"({_percent(width['sign_agreement'])} of one sign)"
            for width in about["widths"]
            if width["share"] in JUDGED and width["secants"]
        )
        follow, mislead = "exact gradients can be followed", "exact gradients may mislead; take secants or CMA-ES"
        conclusions.append(f"{name}: {follow if about['follows'] else mislead}. The slope differs by {differs}.")
    return conclusions


_REPORT: Final = """\
# Can the gradients be trusted?

{conclusions}

A slope is the exact derivative of the objective at a point, a secant the difference quotient over a width about it. \
Narrow secants show whether the derivative is correct; wide ones, as wide as a tuner's steps, whether it is useful. If \
they differ only for wide secants, the landscape is rough: tune with the method `differences` or `cma`. If they differ \
only for narrow ones, the ripple from rounding and contacts is larger than the difference between the two ends.

{table}
Median error: |slope - secant| / |secant|. Same sign: share of the places where the signs agree. Ripple: standard \
deviation of the objective about a parabola through all points within the width.

{parameters}
## What was run

- Objective: {objective}
- {evaluations} walks with gradients in batches of {batch}, {precision}, in {wall_seconds:.0f} s, begun on {begun}
- Command: `{command}`
- Versions: {versions}
- Machine: {machine}
"""


def report_text(content: Mapping[str, Any]) -> str:
    """The text of report.md."""
    sections = ""
    for name, about in content["parameters"].items():
        ends = shown("", about["unit"], np.array([about["from"], about["to"], about["start"], about["lowest_at"]]))
        first, last, start, best = (ends.shown(value) for value in ends.values.tolist())
        fell = f"; at {about['fell']} of {about['points']} points the robot fell" if about["fell"] else ""
        plots = [plot for plot in content["plots"] if plot.endswith(f"-{name}.png")]
        sections += (
            f"## {name}\n\nFrom {first} to {last}, start at {start}. The objective goes from "
            f"{_number(about['lowest'])} (at {best}) to {_number(about['highest'])}; the ripple of neighbouring points "
            f"is {_number(about['ripple'])}{fell}.\n\n"
        ) + "".join(f"![Objective and slope along {name}]({plot})\n\n" for plot in plots)
    texts = {
        "conclusions": "\n".join(f"- {sentence}" for sentence in sentences(content)),
        "table": table(
            [heading for heading, _ in HEADINGS], rows_of(content), "".join(side[0] for _, side in HEADINGS)
        ),
        "parameters": sections.removesuffix("\n"),
        "objective": ", ".join(
            " ".join(f"{key} {each}" for key, each in term.items()) for term in content["objective"]
        ),
        "begun": local_time(content["started"]),
        "versions": listed(content["versions"]),
        "machine": listed(content["machine"]),
    }
    return _REPORT.format(**{**content, **texts})


def _percent(share: float) -> str:
    if not math.isfinite(share):
        return MISSING
    return f"{100 * share:.2g} %" if 0 < share < 0.0995 else f"{100 * share:.0f} %"


def _number(value: float) -> str:
    return f"{value + 0.0:.3g}" if math.isfinite(value) else MISSING


#: Points per line: with the secants around nine of them, 131 walks per parameter.
POINTS = 41


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
    points: int = POINTS,
    span: float = 1.0,
    watch: Watch = SILENT,
    progress: bool = True,
    accept_new_code: bool = False,
) -> LandscapeResult:
    """Measure whether a tuning's gradients can be trusted, on a line along each parameter through the given start.

    Objective and exact slope are found at `points` points of each line, and about nine of them secants of five widths.
    If the slope equals narrow secants, the derivative is correct; if it equals wide ones, it is useful. A
    directory that already contains the points is not evaluated again; one that contains some of them is resumed.

    Args:
        spec: a `Tuning`, a dict with the fields of a tuning file, or the path of one; its optimizer and further
            starts do not matter.
        out: the directory.
        problem: replaces the simulation of the tuning (`nermo_mjx.optimize.problems.WalkProblem`).
        points: of each line, 5 or more.
        span: length of the lines as a fraction of the bounds, in (0, 1]; shorter lines lie about the start.
        watch: is told the points done, and all of them, and what is moved aside.
        progress: whether it is shown where somebody looks, if there is no watch.
        accept_new_code: reuse points that other code evaluated.

    Raises:
        SpecError, ParameterError, DirectoryError, OtherCode, Interrupted: see "Errors of jobs" in
            docs/reference/python.md.
    """
    tuning = dataclasses.replace(Tuning.of(spec), method=Gradient())  # slopes are exact ones, however it is tuned
    if points < 5:
        raise ParameterError(f"points is {points}: allowed is 5 or more.")
    if not 0.0 < span <= 1.0:
        raise ParameterError(f"span is {span:g}: allowed is (0, 1].")
    with RunDirectory(out, "landscape") as held, clear_errors(held.out):
        wanted, columns = identity(tuning, points, span), points_along(tuning, points, span)
        check_directory(held.out, wanted)
        runs = Runs(held.out, key(wanted), warn=watch.warn, held=held)
        there, total = len(runs.numbers), len(columns["line"])
        if there < total:
            made_by = stamp(tuning.setup.load().fingerprint, tuning.engine)
            runs.take_codes([made_by], accept=accept_new_code)
            problem = problem or WalkProblem(tuning)
            held.set_aside("of another landscape", ["landscape.json", "report.md"], watch.warn)
            here = session(points=points, span=span)
            held.note_session(here)
            about = {KEY: key(wanted), IDENTITY: json.dumps(wanted), "session": to_json(here).decode()}
            try:
                _evaluate(tuning, problem, columns, runs, about, made_by.id, watch)
            except KeyboardInterrupt:
                kept = f"{len(runs.numbers)} of {total} walks are kept in {held.out}"
                raise Interrupted(f"stopped; {kept}: run the same command again to resume.") from None
        measured = stored_points(runs)
        held.write(TABLE, parquet_bytes(measured))  # before anything that can still fail
        tuning = keep_recording(held, tuning, watch.warn)
        write_described(held, TUNING, tuning, read_stored, watch.warn)
        with Written(held) as files:  # landscape.json comes last, and marks completion
            lines = lines_of(tuning, measured)
            plots = write_figures(figures_of_lines(tuning, lines), held.out / "plots", files.write)
            content = landscape_content(tuning, measured, lines) | {"plots": [files.name(path) for path in plots]}
            files.write(held.out / "report.md", report_text(content).encode())
            files.write(held.out / "landscape.json", to_json(content))
        if files.aside:
            watch.warn(files.sentence())
        return LandscapeResult(held.out, tuning, measured, content, tuple(plots), total - there)


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
    if points is None or not set(tuning.names) <= set(points.column_names):
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
        centre, value = line.secants[share][:, 0] / per_shown, line.secants[share][:, 1] * per_shown
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


def landscape_status(out: Path) -> Status:
    """How many points of a landscape a directory holds."""
    notes, points = list[str](), out / TABLE
    about = metadata_of(points, notes, "it is made again of the points.")
    complete = about is not None and (out / "landscape.json").exists()
    command = f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out)
    parts = (metadata_of(path, notes, "its points will be evaluated again.") for path in part_files(out))
    done = sum(part.num_rows for part in parts if part)
    return Status("points", done, about and about.num_rows, complete, command, engine_of(out), notes=tuple(notes))
