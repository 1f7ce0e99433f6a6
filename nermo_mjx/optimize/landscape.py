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
import hashlib
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
from jaxtyping import Bool, Float, Int
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
from nermo_mjx.runs.rows import Runs, keys_of, part_files
from nermo_mjx.runs.status import Status, last_command, metadata_of
from nermo_mjx.specs.described import write_described
from nermo_mjx.specs.model import written
from nermo_mjx.specs.reading import changes
from nermo_mjx.sweep.table import Columns, joined, profile_text

# ---
# Which points a landscape is measured at: a line along each parameter, and pairs of points about some of them.


#: Widths of the secants, as fractions of a parameter's range: from those that show whether a derivative is correct to
#: those that show whether it is useful.
WIDTHS: Final = (0.001, 0.005, 0.02, 0.05, 0.1)
#: Number of points of each line around which secants are taken.
CENTRES: Final = 9
#: Fraction of a line left free at both ends, so that the widest secants fit.
_MARGIN: Final = 0.25


@dataclasses.dataclass(frozen=True)
class Plan:
    """The n points of a landscape of p parameters, line by line; of each line first its own points, from low to high.

    Attributes:
        points: (n, p); line: which parameter changes (n,).
        centre, width, side: of a secant's end the point of its line in the middle, the share of the range, and -1 or 1
            (n,); of a point of the line itself -1, 0 and 0.
    """

    points: Float[np.ndarray, "n p"]
    line: Int[np.ndarray, " n"]
    centre: Int[np.ndarray, " n"]
    width: Float[np.ndarray, " n"]
    side: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.points)


def plan(tuning: Tuning, points: int, span: float) -> Plan:
    """Lines through the given start over the bounds.

    Args:
        points: of each line, ends included.
        span: length of each line, as a fraction of the bounds; shorter ones lie about the start.
    """
    start = np.array([each.start for each in tuning.tuned])
    rows: list[tuple[float, int, int, float, int]] = []
    for i, each in enumerate(tuning.tuned):
        bounds = each.high - each.low
        # Like a tuner's points, these stop short of the bounds.
        low, high = each.low + FURTHEST * bounds, each.high - FURTHEST * bounds
        length = span * (high - low)
        first = min(max(each.start - length / 2, low), high - length)
        line = np.linspace(first, first + length, points)
        rows += [(x, i, -1, 0.0, 0) for x in line]
        # Evenly spread, as far from the line's ends as the widest secants reach.
        margin = min(0.5 * max(WIDTHS) * bounds, _MARGIN * (line[-1] - line[0]))
        inner = np.flatnonzero((line - line[0] >= margin) & (line[-1] - line >= margin))
        middles = np.unique(inner[np.linspace(0, len(inner) - 1, CENTRES).round().astype(int)]).tolist()
        for middle, share in itertools.product(middles, WIDTHS):
            ends = [(line[middle] + side * 0.5 * share * bounds, i, middle, share, side) for side in (-1, 1)]
            rows += ends if low <= ends[0][0] and ends[1][0] <= high else []
    x, which, centre, width, side = map(np.array, zip(*rows, strict=True))
    where = np.tile(start, (len(rows), 1))
    where[np.arange(len(rows)), which] = x
    return Plan(where, which, centre, width, side)


# ---
# The lines of a landscape: values and exact slopes along a parameter, and how well secants of each width agree.


#: Neighbouring points of a line to which a parabola is fitted, to separate ripple from shape.
_WINDOW: Final = 7


@dataclasses.dataclass(frozen=True)
class Secants:
    """Secants of one width on one line, one per centre; those with an end at which the robot fell are left out.

    Attributes:
        share, width: distance of the ends, as a fraction of the parameter's bounds and in its unit.
        centre: middles (k,), in the parameter's unit.
        secant, slope: slopes of the secants, and exact ones at the middles (k,).
        ripple: root mean square, over the centres, of the residual standard deviation of a parabola through all points
            within the width; NaN where there are too few of them.
    """

    share: float
    width: float
    centre: Float[np.ndarray, " k"]
    secant: Float[np.ndarray, " k"]
    slope: Float[np.ndarray, " k"]
    ripple: float

    @property
    def error(self) -> float:
        """Median of |slope - secant| / |secant|; NaN without secants."""
        if not len(self.secant):
            return math.nan
        apart, size = np.abs(self.slope - self.secant), np.abs(self.secant)
        # A flat place, where both are 0, is not an error.
        relative = np.divide(apart, size, out=np.where(apart > 0, np.inf, 0.0), where=size > 0)
        return float(np.median(relative))

    @property
    def sign_agreement(self) -> float:
        """Share of the centres where slope and secant have one sign; NaN without secants."""
        return float(np.mean(np.sign(self.slope) == np.sign(self.secant))) if len(self.secant) else math.nan

    @property
    def measures(self) -> dict[str, Any]:
        """For landscape.json."""
        of_all = {"median_relative_error": self.error, "sign_agreement": self.sign_agreement, "ripple": self.ripple}
        return {"share": self.share, "width": self.width, "secants": len(self.secant)} | of_all


@dataclasses.dataclass(frozen=True)
class Slice:
    """One parameter's line through the start.

    Attributes:
        tuned: the parameter.
        x: its values (N,), increasing; value, slope: objective and its exact derivative (N,), NaN where the robot fell.
        secants: of each width.
    """

    tuned: Tuned
    x: Float[np.ndarray, " N"]
    value: Float[np.ndarray, " N"]
    slope: Float[np.ndarray, " N"]
    secants: tuple[Secants, ...]

    @property
    def ok(self) -> Bool[np.ndarray, " N"]:
        """Where the robot walked to the end."""
        return np.isfinite(self.value)

    @property
    def ripple(self) -> float:
        """Like that of the secants, of parabolas through neighbouring points of the line."""
        windows = [slice(i, i + _WINDOW) for i in range(len(self.x) - _WINDOW + 1)]
        return _root_mean_square([_residual(self.x[part], self.value[part]) for part in windows])


def lines_of(tuning: Tuning, table: pa.Table) -> list[Slice]:
    """The lines of a landscape's table, one a tuned parameter."""
    names = np.array(table.column("line").to_pylist())
    columns = {name: table.column(name).to_numpy() for name in ("centre", "width", "side", "objective")}
    lines = []
    for tuned in tuning.tuned:
        here = names == tuned.name
        of_line = here & (columns["side"] == 0)
        x, slope = (table.column(name).to_numpy() for name in (tuned.name, f"gradient.{tuned.name}"))
        line = Slice(tuned, x[of_line], columns["objective"][of_line], slope[of_line], ())
        ends = {name: column[here & ~of_line] for name, column in (columns | {"x": x}).items()}
        secants = tuple(_secants(line, ends, share) for share in WIDTHS)
        lines.append(dataclasses.replace(line, secants=secants))
    return lines


def _secants(line: Slice, ends: dict[str, np.ndarray], share: float) -> Secants:
    """The secants of one width from the ends (m,) of all of a line's secants."""
    found, ripple = [], []
    bounds = line.tuned.high - line.tuned.low
    for centre in np.unique(ends["centre"]).tolist():
        own = ends["centre"] == centre
        low, high = (own & (ends["width"] == share) & (ends["side"] == side) for side in (-1, 1))
        if not low.any() or not line.ok[centre] or not np.isfinite(ends["objective"][low | high]).all():
            continue
        rise, run = ((ends[name][high] - ends[name][low]).item() for name in ("objective", "x"))
        found.append((line.x[centre], rise / run, line.slope[centre]))
        near = own & (ends["width"] <= share)
        x, value = np.append(ends["x"][near], line.x[centre]), np.append(ends["objective"][near], line.value[centre])
        ripple.append(_residual(x, value))
    centre_x, secant, slope = np.array(found, float).reshape(-1, 3).T
    return Secants(share, share * bounds, centre_x, secant, slope, _root_mean_square(ripple))


def _residual(x: Float[np.ndarray, " k"], value: Float[np.ndarray, " k"]) -> float:
    """Standard deviation of values about their parabola; NaN from less than five, or where the robot fell."""
    if len(x) < 5 or not np.isfinite(value).all():
        return math.nan
    scaled = (x - x.mean()) / np.ptp(x)
    _, residual, *_ = np.polyfit(scaled, value, 2, full=True)
    return math.sqrt(float(residual.sum()) / (len(x) - 3))


def _root_mean_square(values: list[float]) -> float:
    good = np.array(values)[np.isfinite(values)] if values else np.array([])
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


def points_of(runs: Runs) -> pa.Table:
    """The table of all points, which are there; its metadata is of the batches, `session` of the last one."""
    parts = [stored_table(part.path, "points that can be read any more") for part in runs.parts]
    notes = [{key.decode(): text.decode() for key, text in part.schema.metadata.items()} for part in parts]
    about = max(notes, key=lambda each: json.loads(each["session"])["started"])
    about |= {"wall_seconds": f"{sum(part.seconds for part in runs.parts):.3f}", "batches": str(len(parts))}
    table = joined([part.replace_schema_metadata(None) for part in parts], np.arange(len(runs.numbers)))
    return table.drop_columns(["row", "key"]).replace_schema_metadata(about)


def check_directory(out: Path, wanted: Mapping[str, Any]) -> None:
    """Raise `WrongDirectory` if a directory holds all points of another landscape; see `identity`."""
    content = content_of(out / TABLE)
    table = None if content is None else parquet_table(content)
    notes = {} if table is None else table.schema.metadata or {}
    if table is not None and notes.get(KEY.encode()) != key(wanted).encode():
        known = json.loads(notes.get(IDENTITY.encode(), b"null")) or wanted
        apart = changes(*({name: each[name] for name in each if name != "digest"} for each in (known, wanted)))
        which = f", with another {', '.join(apart)}" if apart else ""
        raise WrongDirectory(f"{out} holds another landscape{which}; choose another directory.")


def identity(tuning: Tuning, points: int, span: float) -> dict[str, Any]:
    """All that determines the table: not a tuner's path, so not optimizer, starts and seed."""
    walk = tuning.without_path()
    about = walk.identity()
    lines = {"points": points, "span": span, "centres": CENTRES, "widths": list(WIDTHS)}
    recorded = {"recording": about["recording"][:8], "digest": walk.digest()}
    return about["fields"] | about["defaults"] | recorded | lines


def key(identity: Mapping[str, Any]) -> str:
    """A hash of an identity."""
    decisive = [identity[name] for name in ("digest", "points", "span", "centres", "widths")]
    return hashlib.sha256(json.dumps(decisive).encode()).hexdigest()[:16]


def _table(tuning: Tuning, plan: Plan, rows: np.ndarray, points: np.ndarray, found: Evaluation, code: str) -> pa.Table:
    """The table of some rows of the plan, the first ones of a batch at these points (n, p)."""
    table, parameters, own = Columns(), tuning.parameters, slice(len(rows))
    table.add("row", rows, "index", "1", "position in the plan")
    names = np.array(tuning.names, dtype=object)
    table.add("line", names[plan.line[rows]], "index", "1", "parameter that changes along the line")
    about = "of a secant's end: position in the line of its middle; else -1"
    table.add("centre", plan.centre[rows], "index", "1", about)
    table.add("width", plan.width[rows], "index", "1", "of a secant's end: share of the parameter's bounds; else 0")
    table.add("side", plan.side[rows], "index", "1", "of a secant's end: -1 or 1; else 0")
    for i, name in enumerate(tuning.names):
        table.add(name, points[own, i], "parameter", parameters[name].unit, parameters[name].doc)
    ok, slopes = np.asarray(found.ok, bool)[own], np.asarray(found.gradient)[own]
    value = np.where(ok, found.value[own], np.nan)
    table.add("objective", value, "objective", "1", "value that is minimized; NaN where the robot fell")
    for i, name in enumerate(tuning.names):
        unit = "1" if parameters[name].unit == "1" else f"1/({parameters[name].unit})"
        slope = np.where(ok, slopes[:, i], np.nan)
        table.add(f"gradient.{name}", slope, "gradient", unit, f"exact d objective / d {name}")
    for name, values in found.metrics.items():
        metric = (tuning.metrics | tuning.objective_metrics)[name]
        table.add(name, np.asarray(values)[own], "metric", metric.unit, metric.doc)
    table.add("ok", ok, "status", "1", "whether the robot walked to the end, with a finite gradient")
    made_by = "which code made the row, by its name in run.json; empty: not known"
    table.add("code", np.full(len(rows), code), "code", "1", made_by)
    return table.table({})


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
        tuned, good = line.tuned, line.value[line.ok]
        judged = [secants for secants in line.secants if secants.share in JUDGED]
        known = all(len(secants.secant) for secants in judged)
        parameters[tuned.name] = {
            "unit": tuning.parameters[tuned.name].unit,
            "bounds": [tuned.low, tuned.high],
            "start": tuned.start,
            "from": float(line.x[0]),
            "to": float(line.x[-1]),
            "points": len(line.x),
            "fell": int((~line.ok).sum()),
            "lowest": float(good.min()) if len(good) else math.nan,
            "lowest_at": float(line.x[np.nanargmin(line.value)]) if len(good) else math.nan,
            "highest": float(good.max()) if len(good) else math.nan,
            "ripple": line.ripple,
            "widths": [secants.measures for secants in line.secants],
            "follows": all(s.error <= ERROR and s.sign_agreement >= SIGNS for s in judged) if known else None,
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
    found = []
    for name, about in content["parameters"].items():
        if about["follows"] is None:
            found.append(f"{name}: too few places where the robot walks to the end; nothing can be said.")
            continue
        differs = " and ".join(
            f"{_percent(width['median_relative_error'])} from secants {100 * width['share']:g} % of the bounds wide "
            f"({_percent(width['sign_agreement'])} of one sign)"
            for width in about["widths"]
            if width["share"] in JUDGED and width["secants"]
        )
        follow, mislead = "exact gradients can be followed", "exact gradients may mislead; take secants or CMA-ES"
        found.append(f"{name}: {follow if about['follows'] else mislead}. The slope differs by {differs}.")
    return found


def report_text(content: Mapping[str, Any]) -> str:
    """The text of report.md."""
    lines = ["# Can the gradients be trusted?\n", "\n".join(f"- {sentence}" for sentence in sentences(content)) + "\n"]
    lines.append(
        "A slope is the exact derivative of the objective at a point, a secant the difference quotient over a width "
        "about it. Narrow secants show whether the derivative is correct; wide ones, as wide as a tuner's steps, "
        "whether it is useful. If they differ only for wide secants, the landscape is rough: tune with the "
        "method `differences` or `cma`. If they differ only for narrow ones, the ripple from "
        "rounding and contacts is larger than the difference between the two ends.\n"
    )
    lines.append(
        table([heading for heading, _ in HEADINGS], rows_of(content), "".join(side[0] for _, side in HEADINGS))
    )
    lines.append(
        "Median error: |slope - secant| / |secant|. Same sign: share of the places where the signs agree. Ripple: "
        "standard deviation of the objective about a parabola through all points within the width.\n"
    )
    for name, about in content["parameters"].items():
        ends = shown("", about["unit"], np.array([about["from"], about["to"], about["start"], about["lowest_at"]]))
        first, last, start, best = (ends.shown(value) for value in ends.values.tolist())
        fell = f"; at {about['fell']} of {about['points']} points the robot fell" if about["fell"] else ""
        lines += [
            f"## {name}\n",
            f"From {first} to {last}, start at {start}. The objective goes from {_number(about['lowest'])} (at {best}) "
            f"to {_number(about['highest'])}; the ripple of neighbouring points is {_number(about['ripple'])}{fell}.\n",
        ]
        plots = [plot for plot in content["plots"] if plot.endswith(f"-{name}.png")]
        lines += [f"![Objective and slope along {name}]({plot})\n" for plot in plots]
    terms = ", ".join(" ".join(f"{key} {value}" for key, value in term.items()) for term in content["objective"])
    lines += [
        "## What was run\n",
        f"- Objective: {terms}",
        f"- {content['evaluations']} walks with gradients in batches of {content['batch']}, {content['precision']}, in "
        f"{content['wall_seconds']:.0f} s, begun on {local_time(content['started'])}",
        f"- Command: `{content['command']}`",
        f"- Versions: {listed(content['versions'])}",
        f"- Machine: {listed(content['machine'])}",
    ]
    return "\n".join(lines).rstrip() + "\n"


def _percent(share: float) -> str:
    if not math.isfinite(share):
        return MISSING
    return f"{100 * share:.2g} %" if 0 < share < 0.0995 else f"{100 * share:.0f} %"


def _number(value: float) -> str:
    return f"{value + 0.0:.3g}" if math.isfinite(value) else MISSING


#: Points per line: with the secants around nine of them, 131 walks per parameter.
POINTS = 41
#: What is made from the table.
_MADE = ("landscape.json", "report.md")


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


def run_landscape(
    spec: Tuning | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    problem: Problem | None = None,
    points: int = POINTS,
    span: float = 1.0,
    watch: Watch = SILENT,
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
        accept_new_code: reuse points that other code evaluated.

    Raises:
        SpecError: the tuning is wrong; nothing has been written.
        ParameterError: points or span is not allowed.
        DirectoryError: the directory holds another landscape, is in use, or cannot be written; `OtherCode` if other
            code began it.
        Interrupted: Ctrl-C; the same call resumes.
    """
    tuning = dataclasses.replace(Tuning.of(spec), method=Gradient())  # slopes are exact ones, however it is tuned
    if points < 5:
        raise ParameterError(f"points is {points}: allowed is 5 or more.")
    if not 0.0 < span <= 1.0:
        raise ParameterError(f"span is {span:g}: allowed is (0, 1].")
    say = watch.warn
    with RunDirectory(out, "landscape") as held, clear_errors(held.out):
        wanted, chosen, evaluated = identity(tuning, points, span), plan(tuning, points, span), 0
        check_directory(held.out, wanted)
        runs = Runs(held.out, key(wanted), warn=say, held=held)
        if len(runs.numbers) < len(chosen):
            made_by = stamp(tuning.setup.load().fingerprint, tuning.engine)
            runs.take_codes([made_by], accept=accept_new_code)
            problem = problem or WalkProblem(tuning)
            held.set_aside("of another landscape", _MADE, say)
            here = session(points=points, span=span)
            held.note_session(here)
            about = {KEY: key(wanted), IDENTITY: json.dumps(wanted), "session": to_json(here).decode()}
            there, total, size = len(runs.numbers), len(chosen), batch_size(len(chosen))
            watch.progress(Progress(there / total, there, total, there))
            missing = np.setdiff1d(np.arange(total), runs.numbers)
            try:
                for first in range(0, len(missing), size):
                    began, rows = time.perf_counter(), missing[first : first + size]
                    # The last batch is filled up, so that one program is compiled. In double precision, but at the very
                    # points that are evaluated: a secant divides by their distance.
                    points_in = jnp.asarray(chosen.points[np.pad(rows, (0, size - len(rows)), mode="edge")], float)
                    found = problem.evaluate(points_in, True)
                    batch = _table(tuning, chosen, rows, np.asarray(points_in, float), found, made_by.id)
                    about |= {"batch": str(size), "precision": str(np.asarray(found.value).dtype)}
                    about |= {"wall_seconds": f"{time.perf_counter() - began:.3f}"}
                    values = {name: chosen.points[rows, i] for i, name in enumerate(tuning.names)}
                    runs.add(keys_of(runs.group, values, len(rows)), batch.replace_schema_metadata(about))
                    evaluated += len(rows)
                    done = there + evaluated
                    watch.progress(Progress(done / total, done, total, there))
            except KeyboardInterrupt:
                kept = f"{len(runs.numbers)} of {total} walks are kept in {held.out}"
                raise Interrupted(f"stopped; {kept}: run the same command again to resume.") from None
        table = points_of(runs)
        held.write(TABLE, parquet_bytes(table))  # before anything that can still fail
        tuning = keep_recording(held, tuning, say)
        write_described(held, TUNING, tuning, read_stored, say)
        with Written(held) as files:  # landscape.json comes last, and marks completion
            out, lines = held.out, lines_of(tuning, table)
            plots = write_figures(figures_of(tuning, lines), out / "plots", files.write)
            content = landscape_content(tuning, table, lines) | {"plots": [files.name(path) for path in plots]}
            files.write(out / "report.md", report_text(content).encode())
            files.write(out / "landscape.json", to_json(content))
        if files.aside:
            say(files.sentence())
        return LandscapeResult(out, tuning, table, content, tuple(plots), evaluated)


# ---
# Figures of a landscape: the objective along each parameter with its exact tangents, and its slope beside secants.


#: From narrow secants to wide ones.
_SECANTS: Final = ("#fcae12", "#e55c30", "#ba3655", "#781c6d", "#230c4c")  # of the even colour map inferno
#: Length of a tangent, in distances of two points.
_TANGENT: Final = 0.8
#: Slopes further from the middle than this multiple of the exact ones' spread are cut off.
_CUT: Final = 2.5


def figures_of(tuning: Tuning, lines: Sequence[Slice]) -> Iterator[tuple[str, Figure]]:
    """A figure for each line; one on which the robot nowhere walks has none."""
    for line in lines:
        if line.ok.any():
            yield f"line-{line.tuned.name}", line_figure(tuning, line)


def figures(out: Path) -> Figures:
    """The figures of a landscape's directory, from its table.

    Raises:
        SpecError: its landscape.yaml cannot be read.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    tuning, content = Tuning.from_file(out / TUNING, recorded=False), content_of(out / TABLE)
    table = None if content is None else parquet_table(content)
    if table is None or not set(tuning.names) <= set(table.column_names):
        raise DirectoryError(
            f"{out / TABLE} is missing, damaged, or another landscape's: run nermo-mjx landscape again."
        )
    return figures_of(tuning, lines_of(tuning, table))


def line_figure(tuning: Tuning, line: Slice) -> Figure:
    """One line: the objective with a tangent at each point; below it the slope, and each secant over its width."""
    known = tuning.parameters
    starts = {each.name: shown(each.name, known[each.name].unit, np.array(each.start)) for each in tuning.tuned}
    others = [f"{name} {q.shown(float(q.values))}" for name, q in starts.items() if name != line.tuned.name]
    note = "above: objective with its exact tangents, star: lowest; below: exact slope, and secants over their width"
    note += f"; {profile_text([tuning.setup.profile])}"
    note += "; dashed: the given start" + (f"; there, and here, {', '.join(others)}" if others else "")
    x = shown(line.tuned.name, known[line.tuned.name].unit, line.x)
    figure = page(f"Objective and slope along {spoken(line.tuned.name)}", 7.4, 5.6, note)
    above, below = figure.subplots(2, 1, sharex=True)
    _draw_objective(above, line, x)
    _draw_slopes(below, line, x)
    for ax in (above, below):
        horizontal_grid(ax)
        ax.axvline(float(starts[line.tuned.name].values), color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=1)
    set_scales(below, x)
    above.set_ylabel("objective [1]")
    below.set(xlabel=x.label, ylabel=f"slope [1/{x.unit}]" if x.unit else "slope [1]")
    return figure


def _draw_objective(ax: Axes, line: Slice, x: ShownValues) -> None:
    """Points with tangents, their lowest a star, and a cross where the robot fell."""
    per_shown = np.ptp(line.x) / np.ptp(x.values)
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
    fell = x.values[~line.ok]
    if len(fell):
        top = np.full(len(fell), 0.97)
        ax.plot(fell, top, "x", transform=ax.get_xaxis_transform(), color=INK, ms=5, mew=1.3, label="fell")
        legend(ax)


def _draw_slopes(ax: Axes, line: Slice, x: ShownValues) -> None:
    """Exact slopes as a line, each secant as a bar over its width."""
    per_shown = np.ptp(line.x) / np.ptp(x.values)
    slope = line.slope * per_shown
    ax.plot(x.values, slope, "-o", color=LINE, lw=1.4, ms=2.8, mec="white", mew=0.4, zorder=2, label="exact slope")
    drawn = []
    for i, (secants, colour) in enumerate(zip(line.secants, _SECANTS, strict=True)):
        centre, value, half = secants.centre / per_shown, secants.secant * per_shown, 0.5 * secants.width / per_shown
        # The narrow ones lie on top, smaller, so that those that agree are all seen.
        ax.hlines(value, centre - half, centre + half, color=colour, lw=2.0, zorder=4 - 0.1 * i)
        look: dict[str, Any] = {
            "color": colour,
            "mec": "white",
            "mew": 0.4,
            "label": f"secants of {100 * secants.share:g} %",
        }
        ax.plot(centre, value, "D", ms=3.0 + 1.1 * i, zorder=5 - 0.1 * i, **look)
        drawn.append(value)
    ax.axhline(0.0, color=MUTED, lw=0.8, zorder=1)
    # What lies so far off that the slope could not be seen is left out, and counted.
    known = slope[np.isfinite(slope)]
    low, high = np.quantile(known, [0.02, 0.98])
    room, everything = _CUT * max(high - low, 1e-9 + 1e-3 * abs(low)), np.concatenate([known, *drawn])
    inside = everything[(everything >= low - room) & (everything <= high + room)]
    margin = 0.06 * (np.ptp(inside) or 1.0)
    ax.set_ylim(min(inside.min(), 0.0) - margin, max(inside.max(), 0.0) + margin)
    if outside := len(everything) - len(inside):
        corner(ax, f"{outside} outside", 1.0)
    legend(ax)


def status(out: Path) -> Status:
    """How many points of a landscape a directory holds."""
    notes, table = list[str](), out / TABLE
    about = metadata_of(table, notes, "it is made again of the points.")
    complete = about is not None and (out / "landscape.json").exists()
    command = f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out)
    parts = (metadata_of(path, notes, "its points will be evaluated again.") for path in part_files(out))
    done = sum(part.num_rows for part in parts if part)
    return Status("points", done, about and about.num_rows, complete, command, engine_of(out), notes=tuple(notes))
