"""Rows of a sweep's directory rerun on their own, compared with the table, and recorded."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.physics import ENGINES
from nermo_mjx.plotting.shown import cost
from nermo_mjx.recording import Recording, RecordingError, recording_of
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import History, Setup, Simulator
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.runs.files import DirectoryError, plain_json
from nermo_mjx.runs.rows import opened_part, part_files
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.counting import Variants, counts
from nermo_mjx.sweep.spec import Keep, Rows, Sample, Sweep
from nermo_mjx.sweep.store import known
from nermo_mjx.sweep.structures import Structure
from nermo_mjx.sweep.table import RECORDINGS, Results, sides_in


@dataclasses.dataclass(frozen=True)
class SweepRow:
    """A row of a sweep's directory, run or not.

    Attributes:
        out: the directory.
        sweep: what sweep.yaml holds.
        row: position in the sweep.
        line: its parameters and draws.
        engine: the engine that made the row, or else other rows of the directory; None if it has none.
        stored: the row as the table has it, by column; None if it is not there.
        outdated: whether it is there as another sweep made it, or other defaults.
    """

    out: Path
    sweep: Sweep
    row: int
    line: Rows
    engine: str | None = None
    stored: Mapping[str, Any] | None = None
    outdated: bool = False

    @property
    def values(self) -> dict[str, float]:
        """Varied and randomized parameters of the row, as far as its structure reads them."""
        return {name: float(column[0]) for name, column in known(self.line.values).items()}

    @functools.cached_property
    def span(self) -> tuple[float, float]:
        """When measuring begins, and when the run ends, if not at a distance [s]."""
        begin, end = self.walk.run.seconds(
            self.walk.setup.cycle_rate(self.walk.constants | self.values)
        )
        return float(begin), float(end)

    @property
    def walk(self) -> Structure:
        """The setup, length and fixed parameters of the row's structure, and what it is called in the table."""
        return self.sweep.structures[int(self.line.structure[0])]

    @property
    def runs_on(self) -> str:
        """The engine that the row, or else its directory, was started with; `auto` if that no longer exists."""
        return self.engine if self.engine in ENGINES else "auto"

    @property
    def parameters(self) -> dict[str, float]:
        """Every parameter of the row, defaults included."""
        return self.walk.setup.defaults() | self.walk.constants | self.values


@dataclasses.dataclass(frozen=True)
class Agreement:
    """A replayed row beside the table's.

    Attributes:
        engine: which engine made the table's row.
        equal: whether all metrics are equal, bit for bit (NaN equals NaN).
        metric: the metric with the largest relative difference; None if they are equal.
        relative_difference: |stored - replayed| over the larger magnitude; infinite if only one of them is known.
        stored, replayed: that metric's two values; None if all are equal.
    """

    engine: str
    equal: bool
    metric: str | None = None
    relative_difference: float = 0.0
    stored: float | None = None
    replayed: float | None = None


@dataclasses.dataclass(frozen=True)
class Replay:
    """What a row did.

    Attributes:
        engine: which engine ran.
        metrics: name -> value, as `all_metrics` describes them.
        status: `ok`, `fell` or `diverged`.
        history: of this one world (n = 1), until the run ends or it diverges; every sample is finite, and
            there may be none.
        about: the row's metrics, parameters, setup, run, engine and versions, see `RunResult.about`.
        model: of the robot in its scene.
        comparison: with the table; None if the row is not in it.
    """

    engine: str
    metrics: dict[str, float]
    status: str
    history: History
    about: Mapping[str, Any]
    model: mujoco.MjModel
    comparison: Agreement | None

    def recording(self) -> Recording:
        """The recording of the run.

        Raises:
            RecordingError: it was lost in its first tick.
        """
        return recording_of(self.history, self.model, metadata=plain_json(self.about))


def find_row(out: str | os.PathLike[str], row: int) -> SweepRow:
    """Look up a row of a sweep's directory; nothing is written, so the sweep may be at work there.

    Raises:
        SpecError: no such directory, none of a sweep, a sweep.yaml that cannot be read, or no such row.
    """
    out = Path(out)
    if not out.is_dir():
        raise SpecError(
            f"{out}: {'this is a file, not a directory' if out.exists() else 'no such directory'}."
        )
    if not (out / "sweep.yaml").exists():
        raise SpecError(
            f"{out}: not the directory of a sweep or a search; allowed is one with a file sweep.yaml or search.yaml."
        )
    sweep = Sweep.from_directory(out)
    digest, rows, stored, engines, outdated = (
        sweep.digest(),
        Sample(sweep),
        dict[str, Any](),
        list[str](),
        False,
    )
    if not 0 <= row < len(rows) and not (sweep.optimum and row >= len(rows)):
        raise SpecError(f"row is {row}: allowed is 0 to {len(rows) - 1}.")
    for path in part_files(out):
        with (
            contextlib.suppress(DirectoryError),
            opened_part(path) as file,
        ):  # a damaged part has no rows
            file_metadata, span = (
                file.metadata.metadata,
                file.metadata.row_group(0).column(0).statistics,
            )
            skipped = span is not None and span.has_min_max and not span.min <= row <= span.max
            here = (
                np.empty(0, int)
                if skipped
                else np.flatnonzero(file.read(["row"])["row"].to_numpy() == row)
            )
            if file_metadata[b"sweep"].decode() != digest:
                outdated |= len(here) > 0
                continue
            engines.append(file_metadata[b"engine"].decode())
            if len(here):
                stored, engines = file.read().slice(int(here[0]), 1).to_pylist()[0], engines[-1:]
                break
    line, engine = rows.take(np.array([row])), engines[0] if engines else None
    return SweepRow(out, sweep, row, line, engine, stored or None, outdated and not stored)


def replay_row(
    sweep_row: SweepRow,
    engine: str | None = None,
    progress: Callable[[float], None] | None = None,
    simulator: Simulator | None = None,
) -> Replay:
    """Run a row again, as the sweep runs it: its parameters, its start, its length, recorded.

    Args:
        sweep_row: the row.
        engine: `auto`, `c` or `mjx`; by default the one with which the directory was started, if any.
        progress: called with the share done, in [0, 1].
        simulator: that of the row's setup and engine, where there is one already.

    Raises:
        ParameterError: an unknown engine.
    """
    if simulator is None:
        simulator = Simulator(sweep_row.walk.setup, engine or sweep_row.runs_on)
    values = {
        name: np.array([value])
        for name, value in (sweep_row.walk.constants | sweep_row.values).items()
    }
    result = simulator.run(values, sweep_row.walk.run, record=True, progress=progress)
    metrics = {name: float(values[0]) for name, values in result.metrics.items()}
    status = str(result.status[0])
    # A run that has covered its distance is over; one that fell is shown to its end, one that is lost until then.
    whole = sweep_row.span[0] + metrics["duration"]
    ends = dict.fromkeys(("ok", "unsolved", "sank", "floated"), whole) | {
        "diverged": metrics["failure_time"] - simulator.controller.dt
    }
    ticks = math.ceil(ends.get(status, sweep_row.span[1]) / simulator.controller.dt - 1e-3)
    trace = result.trace
    assert trace is not None
    return Replay(
        engine=result.engine,
        metrics=metrics,
        status=status,
        history=trace.until(ticks),
        about=result.about(),
        model=simulator.robot.model,
        comparison=None
        if sweep_row.stored is None
        else agreement(sweep_row.stored, metrics, str(sweep_row.engine)),
    )


def report_of(sweep_row: SweepRow, replay: Replay) -> dict[str, Any]:
    """The result of a replay: the fields of `walk --json`, the row's own, and the comparison with the table."""
    line = sweep_row.line
    return {
        "directory": str(sweep_row.out),
        "row": sweep_row.row,
        "variant": int(line.variant[0]),
        "repeat": int(line.repeat[0]),
        "seed": int(line.seed[0]),
        "comparison": None if replay.comparison is None else dataclasses.asdict(replay.comparison),
        "compared": compared(sweep_row, replay),
        **replay.about,
    }


def compared(sweep_row: SweepRow, replay: Replay) -> str:
    """The comparison of the replay with the table, in a sentence."""
    comparison = replay.comparison
    if comparison is None and sweep_row.outdated:
        return "Not compared: the row in the table was made by another sweep.yaml, or with other defaults."
    if comparison is None:
        return "Not compared: the sweep has not run this row yet."
    if comparison.equal:
        return f"All metrics equal the table's (engine {comparison.engine}), to the last bit."
    is_finite = math.isfinite(comparison.relative_difference)
    return (
        f"The metrics differ from the table's (engine {comparison.engine}), most of all {comparison.metric}: "
        f"{comparison.replayed:.6g} instead of {comparison.stored:.6g}"
        + (f", a share of {comparison.relative_difference:.2g}." if is_finite else ".")
    )


def agreement(stored: Mapping[str, Any], metrics: Mapping[str, float], engine: str) -> Agreement:
    """A row of the table beside the metrics of its replay.

    Args:
        stored: columns of the table; a metric that it lacks, because other code made it, is passed over.
        metrics: name -> value.
        engine: which engine made the table's row.
    """

    def apart(a: float, b: float) -> float:
        if a == b or (math.isnan(a) and math.isnan(b)):
            return 0.0
        return math.inf if math.isnan(a) or math.isnan(b) else abs(a - b) / max(abs(a), abs(b))

    differences = {name: apart(stored[name], metrics[name]) for name in metrics if name in stored}
    worst = max(differences, key=differences.__getitem__)
    if differences[worst] == 0.0:
        return Agreement(engine, equal=True)
    return Agreement(
        engine, False, worst, differences[worst], float(stored[worst]), float(metrics[worst])
    )


# ---
# Rows of a complete sweep that are kept as recordings: each is replayed and recorded once.


#: Kinds of rows that are kept by their outcome.
_STATUSES: Final = ("fell", "diverged", "unsolved")


def recording_file(out: Path, row: int) -> Path:
    """Where a row of a directory is recorded, if it is kept."""
    return out / RECORDINGS / f"row-{row:06d}.npz"


def kept_rows(results: Results, keep: Keep) -> dict[int, str]:
    """The rows of a complete table that are kept, and why.

    First come the best variants by their means, each as the run that is nearest to its mean, of two the better one; a
    variant with lost runs is chosen after those with fewer. Then come other outcomes, the first ones in the table.
    """
    reasons: dict[int, str] = {}
    if keep.best:
        side, values = sides_in(results.schema)[keep.metric], results.column(keep.metric)
        variants, good = (
            Variants.of(results.column("variant")),
            counts(keep.metric, values, results.well),
        )
        tally = variants.tally(values, good)
        far = np.where(good, np.abs(values - tally.mean[variants.place]), np.inf)
        for i, variant_index in enumerate(tally.ranked(side)[: keep.best].tolist(), 1):
            variant_rows = np.flatnonzero(variants.place == variant_index)
            near = variant_rows[far[variant_rows] <= far[variant_rows].min() * (1 + 1e-9)]
            reasons[int(near[np.argmin(cost(side, values[near]))])] = f"number {i} by {keep.metric}"
        reasons = dict(sorted(reasons.items()))
    status = results.column("status")
    for word in _STATUSES:
        for row in np.flatnonzero(status == word)[: getattr(keep, word)]:
            reasons.setdefault(int(row), word)
    return reasons


def record_rows(
    directory: RunDirectory,
    digest: str,
    results: Results,
    keep: Keep,
    used: Any = None,
    check: Callable[[], None] = lambda: None,
    warn: Callable[[str], None] = lambda _: None,
    also: Mapping[int, str] | None = None,
) -> list[Path]:
    """Record the rows to keep that are not recorded yet; returns the files of all of them, in the order of the rows.

    Args:
        directory: the directory of the complete table.
        digest: of its sweep.
        results: the table.
        keep: which rows.
        used: what simulated the table in this process, if anything; a `Simulator` has its programs compiled.
        check: called often; may raise an interruption. What is recorded until then stays.
        also: other rows, and why.
        warn: called with a message if a replay does not give the table's numbers, or nothing can be recorded.

    Raises:
        DirectoryError: a file cannot be written.
    """
    files = []

    @functools.lru_cache
    def simulator(setup: Setup, engine: str) -> Simulator:
        if (getattr(used, "setup", None), getattr(getattr(used, "engine", None), "name", "")) == (
            setup,
            engine,
        ):
            return used
        try:
            return Simulator(setup, engine)
        except ParameterError:
            warn(
                f"the engine {engine} cannot run here: rows that are kept are replayed on the engine c."
            )
            return Simulator(setup, "c")

    for row, why in sorted((kept_rows(results, keep) | dict(also or {})).items()):
        path = recording_file(directory.out, row)
        with contextlib.suppress(RecordingError):  # absent, or damaged
            stored_metadata = Recording.load(path).metadata
            if (stored_metadata.get("row"), stored_metadata.get("sweep")) == (row, digest):
                files.append(path)
                continue
        check()
        sweep_row = find_row(directory.out, row)
        walker = simulator(sweep_row.walk.setup, sweep_row.runs_on)
        replay = replay_row(sweep_row, progress=lambda _: check(), simulator=walker)
        if not len(replay.history.time):
            warn(f"row {row} diverged in its first tick: there is nothing to record.")
            continue
        report = report_of(sweep_row, replay)
        if replay.comparison is not None and not replay.comparison.equal:
            warn(f"row {row} as it is recorded: {report['compared']}")
        row_metadata = {**report, "kept": why, "sweep": digest}
        content = dataclasses.replace(
            replay.recording(), metadata=plain_json(row_metadata)
        ).content()
        directory.move_aside(path.relative_to(directory.out))
        directory.write(path.relative_to(directory.out), content)
        files.append(path)
    return files
