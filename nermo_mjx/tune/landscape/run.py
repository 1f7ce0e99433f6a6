"""Measure a landscape into a directory: the table first, then everything that is made of it.

DIR/landscape.yaml      the resolved tuning whose objective it is
DIR/landscape.parquet   one row per point: parameters, objective, exact gradient, metrics
DIR/batches/            until the table is whole: what was evaluated so far
DIR/recording.npz       the tuning's reference recording, if any
DIR/run.json            which code made it; versions, machine and command of each session that evaluated points
DIR/landscape.json      how well slopes and secants agree, by parameter and width; versions, machine, command
DIR/report.md           the same to read, with its figures
DIR/plots/              a figure for each parameter
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs import RunDirectory, Written, session, stamp
from nermo_mjx.runs.files import clear_errors, parquet_bytes
from nermo_mjx.runs.text import to_json
from nermo_mjx.specs.described import write_described
from nermo_mjx.tune.directory import keep_recording, read_stored
from nermo_mjx.tune.landscape.batches import Batches, any_batch
from nermo_mjx.tune.landscape.lines import lines_of
from nermo_mjx.tune.landscape.plan import Plan, plan
from nermo_mjx.tune.landscape.points import IDENTITY, KEY, TABLE, TUNING, batch_size, evaluate, identity, key, read
from nermo_mjx.tune.landscape.report import content_of, page
from nermo_mjx.tune.methods import Method
from nermo_mjx.tune.objective import Problem
from nermo_mjx.tune.run import simulation_of
from nermo_mjx.tune.spec import Tuning

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
        table: all points, see `nermo_mjx.tune.landscape.points`.
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
    progress: Callable[[int, int], None] | None = None,
    warn: Callable[[str], None] | None = None,
    accept_new_code: bool = False,
) -> LandscapeResult:
    """Measure whether a tuning's gradients can be trusted, on a line along each parameter through the given start.

    Objective and exact slope are found at `points` points of each line, and about nine of them secants of five widths.
    If the slope equals narrow secants, the derivative is correct; if it equals wide ones, it is useful. A
    directory that already contains the points is not evaluated again; one that contains some of them is resumed.

    Args:
        spec: a `Tuning`, a dict with the fields of a tuning file, or the path of one; its optimizer, estimator and
            further starts do not matter.
        out: the directory.
        problem: replaces the simulation of the tuning (`nermo_mjx.tune.problems.WalkProblem`).
        points: of each line, 5 or more.
        span: length of the lines as a fraction of the bounds, in (0, 1]; shorter lines lie about the start.
        progress: called with the points done, and all of them.
        warn: called with a message about each thing that is moved aside.
        accept_new_code: reuse points that other code evaluated.

    Raises:
        SpecError: the tuning is wrong; nothing has been written.
        ParameterError: points or span is not allowed.
        DirectoryError: the directory holds another landscape, is in use, or cannot be written; `OtherCode` if other
            code began it.
    """
    tuning = dataclasses.replace(Tuning.of(spec), method=Method())  # slopes are exact ones, however it is tuned
    if points < 5:
        raise ParameterError(f"points is {points}: allowed is 5 or more.")
    if not 0.0 < span <= 1.0:
        raise ParameterError(f"span is {span:g}: allowed is (0, 1].")
    say = warn or (lambda _: None)
    with RunDirectory(out, "landscape") as held, clear_errors(held.out):
        wanted = identity(tuning, points, span)
        table, evaluated = read(held.out / TABLE, wanted), 0
        if table is None:
            made_by, begun = stamp(tuning.setup.load().fingerprint, tuning.method.engine), any_batch(held.out)
            # A directory without points can be claimed by any landscape.
            held.take_code(made_by, holds_rows=begun, accept=accept_new_code or not begun)
            problem = problem or simulation_of(tuning)
            held.set_aside("of another landscape", _MADE, say)
            chosen = plan(tuning, points, span)
            batches = Batches(held, key(wanted), batch_size(len(chosen)), made_by.id, say)
            here = session(points=points, span=span)
            held.note_session(here)
            about = {KEY: key(wanted), IDENTITY: json.dumps(wanted), "session": to_json(here).decode()}
            table, evaluated = _evaluate(tuning, problem, chosen, progress, about, batches)
            held.write(TABLE, parquet_bytes(table))  # before anything that can still fail
            batches.clear()
        tuning = keep_recording(held, tuning, say)
        write_described(held, TUNING, tuning, read_stored, say)
        with Written(held) as written:
            result = _publish(written, tuning, table, evaluated)
        if written.aside:
            say(written.sentence())
        return result


def _evaluate(
    tuning: Tuning,
    problem: Problem,
    chosen: Plan,
    progress: Callable[[int, int], None] | None,
    about: dict[str, str],
    batches: Batches,
) -> tuple[pa.Table, int]:
    """As `table.evaluate`; an interruption reports the progress."""
    done = 0

    def count(so_far: int, of_all: int) -> None:
        nonlocal done
        done = so_far
        if progress is not None:
            progress(so_far, of_all)

    try:
        return evaluate(tuning, problem, chosen, count, about, batches)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"stopped; {done} of {len(chosen)} walks are kept in {batches.out}: run the same command again to resume."
        ) from None


def _publish(written: Written, tuning: Tuning, table: pa.Table, evaluated: int) -> LandscapeResult:
    """Make everything else from the table; landscape.json comes last, and marks completion."""
    from nermo_mjx.plotting.files import write_figures
    from nermo_mjx.tune.landscape.plots import figures_of

    out, lines = written.held.out, lines_of(tuning, table)
    plots = write_figures(figures_of(tuning, lines), out / "plots", written.write)
    content = content_of(tuning, table, lines) | {"plots": [written.name(path) for path in plots]}
    written.write(out / "report.md", page(content).encode())
    written.write(out / "landscape.json", to_json(content))
    return LandscapeResult(out, tuning, table, content, tuple(plots), evaluated)
