"""The chunks of a sweep: which rows each one holds, which ones are done, and how the others are run."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import pyarrow as pa

from nermo_mjx.rollout import Run, Simulator
from nermo_mjx.sweep.provenance import session
from nermo_mjx.sweep.sampling import Rows
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import Store, StoreError
from nermo_mjx.sweep.table import chunk_table


class SimulatorLike(Protocol):
    """What a sweep needs of a simulator; see `nermo_mjx.rollout.Simulator`."""

    def run(
        self,
        values: Mapping[str, np.ndarray],
        run: Run,
        *,
        progress: Callable[[float], None] | None = None,
        notify: Callable[[str], None] | None = None,
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


class Work:
    """The chunks of a sweep, and which of them are done."""

    def __init__(
        self,
        store: Store,
        rows: Rows,
        seconds: np.ndarray,
        layout: list[np.ndarray],
        progress: Callable[[Progress], None] | None,
        notify: Callable[[str], None] | None,
    ) -> None:
        self.store, self.rows, self.layout = store, rows, layout
        self.progress, self.notify = progress, notify
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

    def simulate(self, engine: str, simulator: SimulatorLike | None) -> None:
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
        rows, full = self.rows.take(index), batch_size(self.layout)
        result = simulator.run(
            batch_values(sweep, self.rows, index, full),
            sweep.run,
            progress=lambda done: self._report(done, k),
            notify=None if self.chunks_run else self.notify,  # compiled once, for the first chunk
        )
        self._same_engine(result.engine)
        metrics = {name: np.asarray(values)[: len(index)] for name, values in result.metrics.items()}
        about = {
            "engine": result.engine,
            "chunk": k,
            "chunks": len(self.layout),
            "steps": result.steps * full,
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


def simulated_seconds(sweep: Sweep, rows: Rows) -> np.ndarray:
    """How long each row is simulated, (n,)."""
    parameters, known = sweep.parameters, {**sweep.constants, **rows.values}
    wanted = ("frequency", "tracking.clock_ratio")
    frequency, ratio = (known.get(name, parameters[name].default) for name in wanted)
    _, end = sweep.run.seconds(np.asarray(frequency, dtype=float), np.asarray(ratio, dtype=float))
    return np.broadcast_to(np.asarray(end, dtype=float), len(rows))


def layout_of(seconds: np.ndarray, size: int) -> list[np.ndarray]:
    """Rows of each chunk: chunk-mates last alike long, and chunks are alike large (to one row)."""
    order = np.argsort(seconds, kind="stable")
    return np.array_split(order, math.ceil(len(order) / size))


def batch_size(layout: list[np.ndarray]) -> int:
    """Worlds of every chunk's batch: one shape for all chunks, so that no engine compiles twice."""
    return max(map(len, layout))


def batch_values(sweep: Sweep, rows: Rows, index: np.ndarray, worlds: int) -> dict[str, np.ndarray]:
    """Values of every parameter that the sweep names, for a simulator: name -> (worlds,).

    Args:
        rows: all rows of the sweep.
        index: which of them, (n,); the last one is repeated until the batch is full.
        worlds: size of the batch, n or more.
    """
    padded = rows.take(np.pad(index, (0, worlds - len(index)), mode="edge"))
    constants = {name: np.full(worlds, value) for name, value in sweep.constants.items()}
    return {**constants, **padded.values}
