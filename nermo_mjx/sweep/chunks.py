"""The chunks of a sweep: which ones are done, and how the others are run."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Run, Simulator
from nermo_mjx.runs.provenance import session
from nermo_mjx.sweep.layout import batch_size, batch_values, listed, rows_digest
from nermo_mjx.sweep.reading import SpecError
from nermo_mjx.sweep.sampling import Rows, Sample
from nermo_mjx.sweep.store import ChunkNote, DirectoryError, Store
from nermo_mjx.sweep.table import chunk_table
from nermo_mjx.sweep.tally import Tally
from nermo_mjx.sweep.writer import Writer

#: Seconds between two looks at what other processes have done.
LOOK = 2.0


#: How JAX, CUDA and Warp say that a batch does not fit.
_NO_MEMORY = re.compile("RESOURCE_EXHAUSTED|out of memory|failed to allocate", re.IGNORECASE)


class SweepError(RuntimeError):
    """A sweep that cannot be finished; the message is one sentence that says why, and how to go on."""


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


class Work:
    """The chunks of a sweep, and which of them are done.

    Attributes:
        store: where they are kept.
        layout: rows of each chunk.
        done: which ones are finished, (chunks,) bool.
        mine: which ones this process runs, (chunks,) bool.
        steps, seconds: physics steps of the finished chunks, and the time they took, summed [s].
        chunks_run: how many this process has simulated.
    """

    def __init__(
        self, store: Store, rows: Sample, layout: list[np.ndarray], tally: Tally, *, watches: bool = False
    ) -> None:
        """
        Args:
            rows: of the whole sweep.
            tally: is told of what is done.
            watches: whether it counts what other processes do, too.
        """
        self.store, self.rows, self.layout, self.tally = store, rows, layout, tally
        self._watches, self._looked = watches, time.monotonic()
        part, parts = store.part or (0, 1)
        self.mine = np.arange(len(layout)) % parts == part
        self.done = np.zeros(len(layout), bool)
        self.engine: str | None = None
        self.steps = self.seconds = 0.0
        self.chunks_run = 0

    def survey(self, warn: Callable[[str], None] | None) -> None:
        """Look at every chunk's file; one with a flaw counts as missing, which is told if this process runs it."""
        self.done[:] = False
        self.engine, self.steps, self.seconds = None, 0.0, 0.0
        flawed: dict[str, list[int]] = {}
        for k, flaw in self.look().items():
            if self.mine[k]:
                flawed.setdefault(flaw, []).append(k)
        for flaw, chunks in flawed.items():
            named = f"chunk {chunks[0]} of {self.store.out}"
            if len(chunks) > 1:
                named = f"chunks {listed(np.array(chunks))} of {self.store.out}: each"
            if warn:
                warn(f"{named} {flaw}, and is run again.")

    def look(self) -> dict[int, str]:
        """Look for chunks that have come, from whichever process; what is wrong with those that do not count."""
        flawed = {}
        for k in sorted(self.store.present()):
            if k < len(self.layout) and not self.done[k]:
                note, flaw = self.store.inspect(k, self.layout[k])
                if note is not None:
                    self._finish(k, note)
                elif flaw:
                    flawed[k] = flaw
        return flawed

    def effort(self) -> dict[str, Any]:
        """Engine, physics steps and the time they took, over all sessions."""
        return {
            "engine": self.engine,
            "chunks": int(self.done.sum()),
            "steps": int(self.steps),
            "wall_seconds": round(self.seconds, 3),
            "steps_per_second": round(self.steps / self.seconds, 1) if self.seconds else math.nan,
        }

    def rows_of(self, chunks: np.ndarray) -> int:
        """How many rows some chunks hold."""
        return sum(len(self.layout[k]) for k in chunks.tolist())

    def simulate(self, engine: str, simulator: SimulatorLike | None, notify: Callable[[str], None] | None) -> None:
        """Simulate the missing chunks of this process; each is written while the next one is simulated.

        Raises:
            SweepError: a simulation failed.
            DirectoryError: a chunk cannot be written, or the engine is not that of the directory.
        """
        self.tally.finish(np.flatnonzero(self.done).tolist(), resumed=not self.chunks_run)
        self._tell()
        missing = np.flatnonzero(self.mine & ~self.done).tolist()
        if not missing:
            return
        engine = self._same_engine(engine)
        simulator = simulator or Simulator(self.store.sweep.setup, engine)
        worlds = batch_size(self.layout)
        part = "" if self.store.part is None else "{}/{}".format(*self.store.part)
        self.store.note_session(session(engine=engine, shard=part, chunks=len(missing)))
        with Writer() as writer:
            for k in missing:
                # The program is compiled once, for the first chunk.
                writer.put(self._run(k, simulator, worlds, None if self.chunks_run else notify))
                self.chunks_run += 1
                self.tally.finish([k])
                self._tell()

    def _run(
        self, k: int, simulator: SimulatorLike, worlds: int, notify: Callable[[str], None] | None
    ) -> Callable[[], None]:
        """Simulate a chunk, and return what stores it."""
        started, rows = time.perf_counter(), self.rows.take(self.layout[k])
        values = batch_values(self.store.sweep, rows, worlds)
        try:
            result = simulator.run(
                values, self.store.sweep.run, progress=lambda done: self._tell(k, done), notify=notify
            )
        except ParameterError as error:
            raise SpecError(f"{self._named(k)} is refused: {error}") from error
        except Exception as error:
            raise SweepError(_failure(self._named(k), error, self.store)) from error
        self._same_engine(result.engine)
        note = ChunkNote(result.engine, result.steps * worlds, round(time.perf_counter() - started, 3))
        return lambda: self._write(k, rows, result, note)

    def _write(self, k: int, rows: Rows, result: Any, note: ChunkNote) -> None:
        index = self.layout[k]
        metrics = {name: np.asarray(values)[: len(index)] for name, values in result.metrics.items()}
        about = {
            "engine": note.engine,
            "chunk": k,
            "chunks": len(self.layout),
            "rows": rows_digest(index),
            "steps": note.steps,
            "wall_seconds": note.seconds,
        }
        status = np.asarray(result.status)[: len(index)]
        self.store.write_chunk(k, chunk_table(self.store.sweep, rows, index, metrics, status, about))
        self._finish(k, note)

    def _tell(self, k: int | None = None, share: float = 0.0) -> None:
        """Report progress, a share of one chunk included."""
        if self._watches and time.monotonic() - self._looked > LOOK:
            self.look()
            self.tally.finish(np.flatnonzero(self.done & ~self.mine).tolist())
            self._looked = time.monotonic()
        self.tally.tell(k, share)

    def _finish(self, k: int, note: ChunkNote) -> None:
        if self.done[k]:
            return
        self.done[k] = True
        self.engine = self.engine or note.engine
        self.steps += note.steps
        self.seconds += note.seconds

    def _same_engine(self, engine: str) -> str:
        """The engine that the directory was begun with, if it agrees with the wanted one."""
        if self.engine is not None and engine not in ("auto", self.engine):
            raise DirectoryError(f"{self.store.out} was begun with the engine '{self.engine}', not '{engine}': go on with "
                             f"'{self.engine}', or choose another directory.")  # fmt: skip
        return self.engine or engine

    def _named(self, k: int) -> str:
        return f"chunk {k} (rows {listed(self.layout[k])})"


def _failure(chunk: str, error: Exception, store: Store) -> str:
    """What happened in a chunk, in a sentence."""
    reason = (str(error).strip().splitlines() or [""])[0].rstrip(".")[:300]
    short = isinstance(error, MemoryError) or _NO_MEMORY.search(reason) is not None
    remedy = "take a smaller --chunk in another directory" if short else "run the same command again when it is mended"
    return (f"{chunk} failed: {type(error).__name__}{f': {reason}' if reason else ''}. What is finished is kept in "
            f"{store.out}: {remedy}.")  # fmt: skip
