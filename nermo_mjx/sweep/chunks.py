"""The chunks of a sweep: which ones are done, and how the others are run."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.provenance import session
from nermo_mjx.runs.workers import TaskFailed, Workers, WorkersLost
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.layout import batch_size, batch_values, listed, rows_digest
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.series import series_table
from nermo_mjx.sweep.simulating import BatchSimulator, Simulated
from nermo_mjx.sweep.store import ChunkNote, Store
from nermo_mjx.sweep.table import chunk_table
from nermo_mjx.sweep.tally import Tally

#: How JAX, CUDA and Warp say that a batch does not fit.
_NO_MEMORY = re.compile("RESOURCE_EXHAUSTED|out of memory|failed to allocate", re.IGNORECASE)


class SweepError(RuntimeError):
    """A sweep that cannot be finished; the message is one sentence that says why, and how to go on."""


class Work:
    """The chunks of a sweep, and which of them are done.

    Attributes:
        store: where they are kept.
        rows: of the whole sweep.
        layout: rows of each chunk.
        tally: is told of what is done.
        done: which ones are finished, (chunks,) bool.
        mine: which ones this process runs, (chunks,) bool.
        engines: of the finished chunks.
        steps, seconds: physics steps of the finished chunks, and the time they took, summed [s].
        chunks_run: how many this process has had simulated.
    """

    def __init__(self, store: Store, rows: Sample, layout: list[np.ndarray], tally: Tally) -> None:
        self.store, self.rows, self.layout, self.tally = store, rows, layout, tally
        shard, shards = store.shard or (0, 1)
        self.mine = np.arange(len(layout)) % shards == shard
        self.chunks_run = 0
        self._forget()

    def survey(self, warn: Callable[[str], None] | None) -> None:
        """Look at every chunk's file; one with a flaw counts as missing, which is told if this process runs it."""
        self._forget()
        flawed: dict[str, list[int]] = {}
        for k, (note, flaw) in self.store.states(self.layout):
            if note is not None:
                self._finish(k, note)
            elif self.mine[k] and flaw:
                flawed.setdefault(flaw, []).append(k)
        say = warn or (lambda _: None)
        for flaw, chunks in flawed.items():
            named = f"chunk {chunks[0]} of {self.store.out}"
            if len(chunks) > 1:
                named = f"chunks {listed(np.array(chunks))} of {self.store.out}: each"
            say(f"{named} {flaw}; it is kept in results.aside, and run again.")

    def effort(self) -> dict[str, Any]:
        """Engine, physics steps and the time they took, over all sessions."""
        return {
            "engine": ", ".join(self.engines),
            "chunks": int(self.done.sum()),
            "steps": int(self.steps),
            "wall_seconds": round(self.seconds, 3),
            "steps_per_second": round(self.steps / self.seconds, 1) if self.seconds else math.nan,
        }

    def rows_of(self, chunks: np.ndarray) -> int:
        """How many rows some chunks hold."""
        return sum(len(self.layout[k]) for k in chunks.tolist())

    def missing(self) -> str:
        """Which chunks are not there, and how to run them, in a sentence; empty if none is missing."""
        chunks = np.flatnonzero(~self.done)
        if not len(chunks):
            return ""
        named = f"chunk{'s' if len(chunks) > 1 else ''} {listed(chunks)}"
        own, shards = self.store.shard or (0, 1)
        others = sorted(set((chunks % shards).tolist()) - {own})
        shares = " and ".join(f"--shard {shard}/{shards}" for shard in others)
        return (f"{named} ({self.rows_of(chunks):,} runs) of {len(self.layout):,} are missing; unless they are being "
                f"run, run them with {shares}.")  # fmt: skip

    def simulate(self, simulator: BatchSimulator, workers: Workers, accept_new_code: bool) -> None:
        """Have the missing chunks of this process simulated; each is written while the next one is simulated.

        Raises:
            SpecError: a parameter is refused.
            SweepError: a simulation failed.
            DirectoryError: a chunk cannot be written, or the rows that are there were made by other code.
        """
        self.tally.finish(np.flatnonzero(self.done).tolist(), resumed=not self.chunks_run)
        self.tally.tell()
        missing = np.flatnonzero(self.mine & ~self.done).tolist()
        if not missing:
            return
        stamp = workers.begin(simulator)
        self.store.take_code(stamp, accept=accept_new_code)
        shard = "" if self.store.shard is None else "{}/{}".format(*self.store.shard)
        about = session(engine=simulator.engine, code=stamp.id, shard=shard, chunks=len(missing))
        self.store.directory.note_session(about)
        with ThreadPoolExecutor(1, "sweep-writer") as writer:
            written: Future[None] | None = None
            for k, result in self._results(missing, workers):
                before, written = written, writer.submit(self._write, k, result, stamp)
                self.chunks_run += 1
                self.tally.finish([k])
                self.tally.tell()
                if before is not None:
                    before.result()
            if written is not None:
                written.result()

    def _results(self, chunks: list[int], workers: Workers) -> Iterator[tuple[int, Simulated]]:
        """Results of chunks, as they come."""
        worlds = batch_size(self.layout)

        def tasks() -> Iterator[tuple[int, Mapping[str, np.ndarray]]]:
            for k in chunks:
                yield k, batch_values(self.store.sweep, self.rows.take(self.layout[k]), worlds)

        try:
            yield from workers.results(tasks(), self.tally.tell)
        except TaskFailed as failed:
            error, named = failed.__cause__, f"chunk {failed.key} (rows {listed(self.layout[failed.key])})"
            if isinstance(error, ParameterError):
                raise SpecError(f"{named} is refused: {error}") from error
            raise SweepError(self._failure(named, error)) from error
        except WorkersLost as lost:
            raise SweepError(
                f"{lost} What is finished is kept in {self.store.out}: run the same command again."
            ) from None

    def _write(self, k: int, result: Simulated, stamp: CodeStamp) -> None:
        index = self.layout[k]
        metrics = {name: values[: len(index)] for name, values in result.metrics.items()}
        about = {
            "engine": stamp.engine,
            "code": stamp.id,
            "chunk": k,
            "chunks": len(self.layout),
            "rows": rows_digest(index),
            "steps": result.steps,
            "wall_seconds": result.seconds,
        }
        table = chunk_table(
            self.store.sweep, self.rows.take(index), index, metrics, result.status[: len(index)], stamp.id, about
        )
        series = None if result.series is None else series_table(self.store.sweep, index, result.series)
        self.store.write_chunk(k, table, series)
        self._finish(k, ChunkNote(stamp.engine, result.steps, result.seconds))

    def _forget(self) -> None:
        self.done = np.zeros(len(self.layout), bool)
        self.engines: list[str] = []
        self.steps = self.seconds = 0.0

    def _finish(self, k: int, note: ChunkNote) -> None:
        self.done[k] = True
        if note.engine not in self.engines:
            self.engines.append(note.engine)
        self.steps += note.steps
        self.seconds += note.seconds

    def _failure(self, chunk: str, error: BaseException | None) -> str:
        """What happened in a chunk, in a sentence."""
        reason = (str(error).strip().splitlines() or [""])[0].rstrip(".")[:300]
        short = isinstance(error, MemoryError) or _NO_MEMORY.search(reason) is not None
        remedy = (
            "take a smaller --chunk in another directory" if short else "run the same command again when it is mended"
        )
        return (f"{chunk} failed: {type(error).__name__}{f': {reason}' if reason else ''}. What is finished is kept in "
                f"{self.store.out}: {remedy}.")  # fmt: skip
