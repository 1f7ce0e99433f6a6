"""Run a sweep: cut its rows into chunks, simulate what the directory does not hold yet, then sum up."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import numpy as np
import pyarrow as pa

from nermo_mjx.rollout import Run, Simulator
from nermo_mjx.sweep.plots import draw_plots
from nermo_mjx.sweep.provenance import session
from nermo_mjx.sweep.reading import SpecError
from nermo_mjx.sweep.sampling import Rows, sample
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import Store, StoreError, join, read_table
from nermo_mjx.sweep.summary import summarize, to_json
from nermo_mjx.sweep.table import chunk_table

#: Rows of a chunk, unless the simulator, the sweep or the caller says otherwise.
DEFAULT_CHUNK = 64


class SweepInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM; the message says how to go on."""


class SimulatorLike(Protocol):
    """What a sweep needs of a simulator; see `nermo_mjx.rollout.Simulator`."""

    def run(
        self, values: Mapping[str, np.ndarray], run: Run, progress: Callable[[float], None] | None = None
    ) -> Any: ...


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a sweep is.

    Attributes:
        fraction: share of this process's work that is done, by simulated time, 0 to 1; resumed chunks count as done.
        rows_done, rows: finished rows and all rows of this process's share.
        resumed: rows that an earlier session had finished.
    """

    fraction: float
    rows_done: int
    rows: int
    resumed: int


@dataclasses.dataclass(frozen=True)
class SweepResult:
    """A sweep's outcome.

    Attributes:
        out: its directory.
        table: the result table, in the order of its rows (`read_table`).
        summary: content of summary.json; empty while other shards are missing.
        plots: files of the figures.
        complete: whether the table holds every row of the sweep.
        chunks_run: chunks that this call simulated.
    """

    out: Path
    table: pa.Table
    summary: dict[str, Any]
    plots: list[Path]
    complete: bool
    chunks_run: int


def run_sweep(
    spec: Sweep | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    progress: Callable[[Progress], None] | None = None,
    chunk: int | None = None,
    shard: tuple[int, int] | None = None,
    simulator: SimulatorLike | None = None,
) -> SweepResult:
    """Run every variant of a sweep into a directory, or go on with what it holds.

    Args:
        spec: a `Sweep`, a dict with the fields of a sweep file, or the path of one.
        out: the directory; see `nermo_mjx.sweep.store`.
        engine: engine of the simulator. A directory keeps the engine it was begun with.
        progress: called now and then with a `Progress`.
        chunk: rows simulated and stored together; a directory keeps the size it was begun with.
        shard: (i, n) runs only every n-th chunk, from i in 0..n-1; the table is the same however it was split.
        simulator: stands in for `Simulator(spec.setup, engine)`.

    Raises:
        SpecError: the sweep is wrong; nothing has been written.
        StoreError: the directory holds something else, is in use, or cannot be written.
        SweepInterrupted: Ctrl-C or SIGTERM; the same call goes on.
    """
    sweep = spec if isinstance(spec, Sweep) else _as_sweep(spec)
    if chunk is not None and chunk < 1:
        raise SpecError(f"chunk is {chunk}: allowed is 1 or more.")
    if shard is not None and not 0 <= shard[0] < shard[1]:
        raise SpecError(f"shard is {shard[0]}/{shard[1]}: allowed is I/N with I from 0 to N - 1.")
    rows = sample(sweep)
    seconds = _simulated_seconds(sweep, rows)
    size = chunk or sweep.chunk or int(getattr(simulator or Simulator, "chunk", DEFAULT_CHUNK))
    with Store(out, dataclasses.replace(sweep, chunk=size), shard) as store, _interruptible(store):
        layout = _layout(seconds, store.sweep.chunk or size)
        work = _Work(store, rows, seconds, layout, progress)
        work.run(engine, simulator)
        if not work.complete():
            return SweepResult(store.out, read_table(out), {}, [], complete=False, chunks_run=work.chunks_run)
        tables = [table for table in work.tables if table is not None]
        table = join(tables)
        summary = summarize(table, tables)
        store.write(store.out / "summary.json", to_json(summary))
        plots = draw_plots(table, store.plots, write=store.write) if sweep.plots else []
        return SweepResult(store.out, table, summary, plots, complete=True, chunks_run=work.chunks_run)


class _Work:
    """The chunks of a sweep, and which of them are done."""

    def __init__(
        self,
        store: Store,
        rows: Rows,
        seconds: np.ndarray,
        layout: list[np.ndarray],
        progress: Callable[[Progress], None] | None,
    ) -> None:
        self.store, self.rows, self.layout, self.progress = store, rows, layout, progress
        self.tables = [store.finished(k, index.tolist()) for k, index in enumerate(layout)]
        shard, shards = store.shard or (0, 1)
        self.mine = range(shard, len(layout), shards)
        self.cost = [len(index) * float(seconds[index].max()) for index in layout]
        self.resumed = self._rows_done()
        self.chunks_run = 0

    def complete(self) -> bool:
        """Whether every chunk is there; those of other shards may have come meanwhile."""
        for k, index in enumerate(self.layout):
            if self.tables[k] is None:
                self.tables[k] = self.store.finished(k, index.tolist())
        return all(table is not None for table in self.tables)

    def run(self, engine: str, simulator: SimulatorLike | None) -> None:
        """Simulate the missing chunks of this shard."""
        self._report(0.0, None)
        missing = [k for k in self.mine if self.tables[k] is None]
        if not missing:
            return
        engine = self._same_engine(engine)
        simulator = simulator or Simulator(self.store.sweep.setup, engine)
        shard = "" if self.store.shard is None else f"{self.store.shard[0]}/{self.store.shard[1]}"
        self.store.note_session(session(engine=engine, shard=shard, chunks=len(missing)))
        for k in missing:
            self.tables[k] = self._run_chunk(k, simulator)
            self.store.write_chunk(k, self.tables[k])
            self.chunks_run += 1
            self._report(0.0, None)

    def _run_chunk(self, k: int, simulator: SimulatorLike) -> pa.Table:
        index, sweep, started = self.layout[k], self.store.sweep, time.perf_counter()
        rows, full = self.rows.take(index), max(map(len, self.layout))
        # One shape for all chunks, so that no engine compiles twice: a shorter chunk repeats its last row.
        padded = self.rows.take(np.pad(index, (0, full - len(index)), mode="edge"))
        constants = {name: np.full(full, value) for name, value in sweep.constants.items()}
        result = simulator.run({**constants, **padded.values}, sweep.run, lambda done: self._report(done, k))
        self._same_engine(result.engine)
        metrics = {name: np.asarray(values)[: len(index)] for name, values in result.metrics.items()}
        about = {
            "engine": result.engine,
            "chunk": k,
            "chunks": len(self.layout),
            "steps": result.steps,
            "wall_seconds": round(time.perf_counter() - started, 3),
        }
        return chunk_table(sweep, rows, index, metrics, np.asarray(result.status)[: len(index)], about)

    def _same_engine(self, engine: str) -> str:
        """The engine that the directory was begun with, if it agrees with the wanted one."""
        begun = [(table.schema.metadata or {})[b"engine"].decode() for table in self.tables if table is not None]
        if begun and engine not in ("auto", begun[0]):
            raise StoreError(f"{self.store.out} was begun with the engine '{begun[0]}', not '{engine}': go on with "
                             f"'{begun[0]}', or choose another directory.")  # fmt: skip
        return begun[0] if begun else engine

    def _rows_done(self) -> int:
        return sum(len(self.layout[k]) for k in self.mine if self.tables[k] is not None)

    def _report(self, done: float, k: int | None) -> None:
        if self.progress is None:
            return
        finished = sum(self.cost[i] for i in self.mine if self.tables[i] is not None)
        current = 0.0 if k is None else self.cost[k] * min(max(float(done), 0.0), 1.0)
        total = sum(self.cost[i] for i in self.mine)
        rows = sum(len(self.layout[i]) for i in self.mine)
        self.progress(Progress((finished + current) / total if total else 1.0, self._rows_done(), rows, self.resumed))


def _as_sweep(spec: Mapping[str, Any] | str | os.PathLike[str]) -> Sweep:
    return Sweep.from_dict(spec) if isinstance(spec, Mapping) else Sweep.from_file(spec)


def _simulated_seconds(sweep: Sweep, rows: Rows) -> np.ndarray:
    """How long each row is simulated, (n,)."""
    parameters, known = sweep.parameters, {**sweep.constants, **rows.values}
    wanted = ("frequency", "tracking.clock_ratio")
    frequency, ratio = (known.get(name, parameters[name].default) for name in wanted)
    _, end = sweep.run.seconds(np.asarray(frequency, dtype=float), np.asarray(ratio, dtype=float))
    return np.broadcast_to(np.asarray(end, dtype=float), len(rows))


def _layout(seconds: np.ndarray, size: int) -> list[np.ndarray]:
    """Rows of each chunk: chunk-mates last alike long, and chunks are alike large (to one row)."""
    order = np.argsort(seconds, kind="stable")
    return np.array_split(order, math.ceil(len(order) / size))


@contextlib.contextmanager
def _interruptible(store: Store) -> Iterator[None]:
    """Turn Ctrl-C and SIGTERM into a `SweepInterrupted` that says how to go on."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, stop) if main else None
    try:
        yield
    except KeyboardInterrupt:
        raise SweepInterrupted(
            f"stopped; what is finished is kept in {store.out}. To go on, run the same command again, or: "
            f"nermo-mjx sweep {store.out / 'sweep.yaml'} --out {store.out}"
        ) from None
    finally:
        if main:
            signal.signal(signal.SIGTERM, before)
