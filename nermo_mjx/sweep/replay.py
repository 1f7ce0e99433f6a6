"""One row of a sweep's directory run again by itself, recorded, and compared with the table."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.physics import ENGINES, Engine, Session, Trace
from nermo_mjx.rollout import METRICS, History, Simulator
from nermo_mjx.rollout.attitude import uprightness
from nermo_mjx.rollout.metrics import DIVERGED_SPEED, FALLEN_COSINE, FALLEN_HEIGHT
from nermo_mjx.sweep.chunks import batch_size, batch_values, layout_of, simulated_seconds
from nermo_mjx.sweep.reading import SpecError
from nermo_mjx.sweep.run import default_chunk
from nermo_mjx.sweep.sampling import Rows, sample
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import Store, read_chunk

#: Engines in which worlds that stand still cost next to nothing. There a row keeps its place in its chunk's batch: the
#: compiled controller rounds by the shape of the batch and the place in it, so that only this repeats a row's bits.
KEEPS_PLACE: Final = ("c",)


@dataclasses.dataclass(frozen=True)
class SweepRow:
    """A row of a sweep's directory, run or not.

    Attributes:
        out: the directory.
        sweep: what sweep.yaml holds.
        row: position in the sweep.
        rows: all rows of the sweep.
        seconds: simulated time of each row, (rows,) [s].
        engine: the engine that the directory was begun with; None if it has no finished chunk.
        chunk: rows of the chunk that holds the row, (n,), and `worlds`, the size of the batch in which it is run.
        stored: the row as the table has it, by column; None if it is not there.
        outdated: whether it is not there because its chunk was made by another sweep, or with other defaults.
    """

    out: Path
    sweep: Sweep
    row: int
    rows: Rows
    seconds: np.ndarray
    engine: str | None
    chunk: np.ndarray
    worlds: int
    stored: Mapping[str, Any] | None
    outdated: bool

    @property
    def values(self) -> dict[str, float]:
        """Varied and randomized parameters of the row."""
        return {name: float(column[self.row]) for name, column in self.rows.values.items()}

    @property
    def parameters(self) -> dict[str, float]:
        """Every parameter of the row, defaults included."""
        return self.sweep.setup.defaults() | self.sweep.constants | self.values


@dataclasses.dataclass(frozen=True)
class Comparison:
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
        metrics: as described in `METRICS`.
        status: `ok`, `fell` or `diverged`.
        history: of this one world (n = 1), until the run ends or its numbers are lost; every sample is finite, and
            there may be none.
        fell_at, diverged_at: when that was first seen [s]; None if it was not, or not at the end of a control tick.
        comparison: with the table; None if the row is not in it.
    """

    engine: str
    metrics: dict[str, float]
    status: str
    history: History
    fell_at: float | None
    diverged_at: float | None
    comparison: Comparison | None


def find_row(out: str | os.PathLike[str], row: int) -> SweepRow:
    """Look up a row of a sweep's directory; nothing is written, so the sweep may be at work there.

    Raises:
        SpecError: no such directory, none of a sweep, a sweep.yaml that cannot be read, or no such row.
    """
    out = Path(out)
    if not out.is_dir():
        raise SpecError(f"{out}: {'this is a file, not a directory' if out.exists() else 'no such directory'}.")
    if not (out / "sweep.yaml").exists():
        raise SpecError(f"{out}: not the directory of a sweep; allowed is one with a file sweep.yaml.")
    sweep = Sweep.from_file(out / "sweep.yaml")
    count = sweep.variants * sweep.repeats
    if not 0 <= row < count:
        raise SpecError(f"row is {row}: allowed is 0 to {count - 1}.")
    rows, engine = sample(sweep), _begun_with(out, sweep.digest())
    seconds = simulated_seconds(sweep, rows)
    layout = layout_of(seconds, sweep.chunk or default_chunk(engine or "auto"))
    k = next(k for k, index in enumerate(layout) if row in index)
    store = Store(out, sweep)  # never entered: it only reads
    table = store.finished(k, layout[k].tolist())
    return SweepRow(
        out=out, sweep=sweep, row=row, rows=rows, seconds=seconds, engine=engine,
        chunk=layout[k], worlds=batch_size(layout),
        stored=None if table is None else table.slice(layout[k].tolist().index(row), 1).to_pylist()[0],
        outdated=table is None and read_chunk(store.chunk_path(k)) is not None,
    )  # fmt: skip


def replay_row(found: SweepRow, engine: str | None = None, progress: Callable[[float], None] | None = None) -> Replay:
    """Run a row again, as the sweep runs it: its parameters, its start, its length, recorded.

    Args:
        found: the row.
        engine: `auto`, `c` or `mjx`; by default the one that the directory was begun with, if there is such a one.
        progress: called with the share done, in [0, 1].

    Raises:
        ParameterError: an unknown engine.
    """
    sweep = found.sweep
    simulator = Simulator(sweep.setup, engine or (found.engine if found.engine in ENGINES else "auto"))
    ran = simulator.engine.name
    keeps_place = ran in KEEPS_PLACE and found.engine in (None, ran)
    index, worlds = (found.chunk, found.worlds) if keeps_place else (np.array([found.row]), 1)
    place = index.tolist().index(found.row)
    recorder = simulator.engine = _Recorder(simulator.engine, place)
    result = simulator.run(batch_values(sweep, found.rows, index, worlds), sweep.run, progress=progress)
    metrics = {name: float(result.metrics[name][place]) for name in METRICS}
    history = _history(simulator, recorder.traces)
    lost, fallen = _first(_is_lost(history)), _first(_is_fallen(history))
    end = math.ceil(found.seconds[found.row] / simulator.controller.dt - 1e-6)
    return Replay(
        engine=ran,
        metrics=metrics,
        status=str(result.status[place]),
        history=_until(history, end if lost is None else min(end, lost)),
        fell_at=float(history.time[fallen]) if metrics["fell"] and fallen is not None else None,
        diverged_at=float(history.time[lost]) if metrics["diverged"] and lost is not None else None,
        comparison=None if found.stored is None else compare(found.stored, metrics, str(found.engine)),
    )


def compare(stored: Mapping[str, Any], metrics: Mapping[str, float], engine: str) -> Comparison:
    """A row of the table beside the metrics of its replay.

    Args:
        stored: columns of the table; a metric that it lacks, because an earlier version made it, is passed over.
        metrics: name -> value.
        engine: which engine made the table's row.
    """
    differences = {name: _difference(stored[name], metrics[name]) for name in metrics if name in stored}
    worst = max(differences, key=differences.__getitem__)
    if differences[worst] == 0.0:
        return Comparison(engine, equal=True)
    return Comparison(engine, False, worst, differences[worst], float(stored[worst]), float(metrics[worst]))


def _difference(a: float, b: float) -> float:
    if a == b or (math.isnan(a) and math.isnan(b)):
        return 0.0
    return math.inf if math.isnan(a) or math.isnan(b) else abs(a - b) / max(abs(a), abs(b))


def _begun_with(out: Path, digest: str) -> str | None:
    """Engine of the first readable chunk of this sweep; a directory keeps its engine."""
    for path in sorted(out.glob("results/chunk-*.parquet")):
        try:
            about = pq.read_schema(path).metadata or {}
        except (OSError, pa.ArrowException, ValueError):
            continue
        if about.get(b"sweep") == digest.encode():
            return about[b"engine"].decode()
    return None


class _Recorder:
    """An engine of which one world moves, and is recorded until it is retired; the others stay where they start.

    A simulator that records runs on in whole blocks, past the end of the run: a robot that falls there fell in the
    recording, but not in the table. Here the simulator runs as it does for a sweep, and the recording is made below it.
    """

    def __init__(self, engine: Engine, world: int) -> None:
        self.engine, self.world, self.name = engine, world, engine.name
        self.traces: list[Trace] = []

    def open(self, params: Any, qpos: np.ndarray, fields: dict[str, np.ndarray]) -> _RecordedSession:
        """See `Engine.open`."""
        session = self.engine.open(params, qpos, fields)
        return _RecordedSession(session, np.arange(len(qpos)) == self.world, self.traces)


class _RecordedSession:
    """A session of `_Recorder`; see `Session`.

    Args:
        session: the engine's own.
        moves: which world moves, (n,).
        traces: grows by a trace of that world with each `advance`, (1, ticks, ...).
    """

    def __init__(self, session: Session, moves: np.ndarray, traces: list[Trace]) -> None:
        self._session, self._moves, self._traces = session, moves, traces
        self._over = False
        session.retire(~moves)

    @property
    def loop_state(self) -> Any:
        """See `Session.loop_state`."""
        return self._session.loop_state

    def advance(self, ticks: int) -> None:
        """See `Session.advance`."""
        trace = self.record(ticks)
        if not self._over:
            self._traces.append(trace)

    def record(self, ticks: int) -> Trace:
        """See `Session.record`, but only the world that moves."""
        # Tick by tick: each other length would be one more program to compile.
        return _join([_pick(self._session.record(1), self._moves) for _ in range(ticks)])

    def retire(self, done: np.ndarray) -> None:
        """See `Session.retire`."""
        self._over = bool(done[self._moves].all())
        self._session.retire(done | ~self._moves)


def _pick(trace: Trace, worlds: np.ndarray) -> Trace:
    return Trace(**{field.name: getattr(trace, field.name)[worlds] for field in dataclasses.fields(Trace)})


def _join(traces: list[Trace]) -> Trace:
    names = [field.name for field in dataclasses.fields(Trace)]
    return Trace(**{name: np.concatenate([getattr(trace, name) for trace in traces], axis=1) for name in names})


def _history(simulator: Simulator, traces: list[Trace]) -> History:
    trace = _join(traces)
    read = simulator.robot.sensors(trace.sensordata)
    sensors = {field.name: np.asarray(getattr(read, field.name)) for field in dataclasses.fields(read)}
    time = (1 + np.arange(trace.qpos.shape[1])) * simulator.controller.dt
    return History(time, trace.qpos, trace.qvel, trace.ctrl, sensors)


def _until(history: History, ticks: int) -> History:
    """The first ticks of a history."""
    sensors = {name: values[:, :ticks] for name, values in history.sensors.items()}
    arrays = {name: getattr(history, name)[:, :ticks] for name in ("qpos", "qvel", "ctrl")}
    return History(time=history.time[:ticks], **arrays, sensors=sensors)


def _is_lost(history: History) -> np.ndarray:
    """Ticks at whose end some number is not finite, or no robot's, (ticks,) bool; see `rollout.metrics`."""
    arrays = (history.qpos, history.qvel, history.ctrl, *history.sensors.values())
    finite = [np.isfinite(values[0]).reshape(len(history.time), -1).all(axis=1) for values in arrays]
    fast = np.abs(history.sensors["linear_velocity"][0]).max(axis=-1) > DIVERGED_SPEED
    return ~np.logical_and.reduce(finite) | fast


def _is_fallen(history: History) -> np.ndarray:
    """Ticks at whose end the robot lies, (ticks,) bool; see `rollout.metrics`."""
    tilted = np.asarray(uprightness(history.sensors["orientation"][0])) < FALLEN_COSINE
    return tilted | (history.sensors["position"][0, :, 2] < FALLEN_HEIGHT)


def _first(flags: np.ndarray) -> int | None:
    return int(np.argmax(flags)) if flags.any() else None
