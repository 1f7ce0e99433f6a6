"""The chunks of a sweep: which ones are done, and running the others."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.provenance import session
from nermo_mjx.runs.workers import TaskFailed, Workers, WorkersLost
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.batches import Batch, BatchPlan, plan_batches
from nermo_mjx.sweep.chunk_log import ChunkLog
from nermo_mjx.sweep.known import KnownRows
from nermo_mjx.sweep.layout import batch_values, listed, rows_digest
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.series import joined_series, series_table
from nermo_mjx.sweep.simulating import Simulated, SweepSimulator
from nermo_mjx.sweep.store import ChunkNote, Store
from nermo_mjx.sweep.table import chunk_table, joined
from nermo_mjx.sweep.tally import Tally

#: How JAX, CUDA and Warp say that a batch does not fit.
_NO_MEMORY = re.compile("RESOURCE_EXHAUSTED|out of memory|failed to allocate", re.IGNORECASE)


class SweepError(RuntimeError):
    """A sweep that cannot be finished; the message is one sentence that says why, and how to resume."""


class Work:
    """The chunks of a sweep, and which of them are done.

    Attributes:
        store: where they are kept.
        rows: of the whole sweep.
        layout: rows of each chunk.
        tally: is notified of finished work.
        log: is notified of each chunk that is written.
        done: which ones are finished, (chunks,) bool.
        mine: which ones this process runs, (chunks,) bool.
        engines: of the finished chunks.
        steps, seconds: physics steps of the finished chunks, and the time they took, summed [s].
        chunks_run: number simulated by this process.
    """

    def __init__(
        self,
        store: Store,
        rows: Sample,
        layout: list[np.ndarray],
        tally: Tally,
        log: ChunkLog | None = None,
    ) -> None:
        self.log = log
        self.store, self.rows, self.layout, self.tally = store, rows, layout, tally
        shard, shards = store.shard or (0, 1)
        self.mine = np.arange(len(layout)) % shards == shard
        self.chunks_run = 0
        self._forget()

    def survey(self, warn: Callable[[str], None] | None) -> None:
        """Check every chunk's file; a defective one counts as missing, and is reported if this process runs it."""
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

    def finished(self) -> list[Path]:
        """The files of the chunks of this process that are finished."""
        return [self.store.chunk_path(int(k)) for k in np.flatnonzero(self.mine & self.done)]

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

    def simulate(
        self, simulator: SweepSimulator, workers: Workers, accept_new_code: bool, known: KnownRows | None = None
    ) -> None:
        """Simulate this process's missing chunks; each is written while the next one is simulated.

        Args:
            simulator, workers: compute.
            accept_new_code: see `run_sweep`.
            known: rows that are reused instead of simulated.

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
        plan = self.take(known, accept_new_code)
        if not plan.batches:
            return
        missing = np.flatnonzero(self.mine & ~self.done).tolist()
        workers.begin(simulator)
        stamps = {at: simulator.stamp(at) for at in dict.fromkeys(batch.structure for batch in plan.batches)}
        self.store.take_codes(list(stamps.values()), accept=accept_new_code)
        first, shard = next(iter(stamps.values())), self.store.shard
        about = session(engine=simulator.engine, code=first.id, shard="" if shard is None else "{}/{}".format(*shard),
                        chunks=len(missing))  # fmt: skip
        self.store.directory.note_session(about)
        with ThreadPoolExecutor(1, "sweep-writer") as writer:
            written: list[Future[None]] = []
            for batch, result in self._results(plan, workers):
                before, written = (
                    written,
                    [
                        writer.submit(self._write, k, plan, known, part, stamps[batch.structure])
                        for k, part in batch.parts(plan, result)
                    ],
                )
                self.chunks_run += len(batch.chunks)
                self.tally.finish(batch.chunks)
                self.tally.tell()
                for each in before:
                    each.result()
            for each in written:
                each.result()

    def take(self, known: KnownRows | None, accept_new_code: bool) -> BatchPlan:
        """Write the missing chunks whose rows are all known; returns what is left to simulate."""
        missing = np.flatnonzero(self.mine & ~self.done).tolist()
        plan = plan_batches(self.store.sweep, self.rows, self.layout, missing, known)
        if known is not None and plan.known:
            self.store.take_codes(known.codes(accept=accept_new_code), accept=accept_new_code)
            for k in missing:
                if not len(plan.unknown(k)):
                    self._write(k, plan, known, None, None)
                    self.tally.finish([k], resumed=True)
        return plan

    def _results(self, plan: BatchPlan, workers: Workers) -> Iterator[tuple[Batch, Simulated]]:
        """Results of batches, as they come."""
        batches, sweep = {batch.chunks[0]: batch for batch in plan.batches}, self.store.sweep

        def tasks() -> Iterator[tuple[int, tuple[int, Mapping[str, np.ndarray]]]]:
            for k, batch in batches.items():
                index = np.concatenate([plan.unknown(chunk) for chunk in batch.chunks])
                walk, worlds = sweep.structures[batch.structure], plan.worlds[batch.structure]
                yield k, (batch.structure, batch_values(walk, self.rows.take(index), worlds))

        try:
            for k, result in workers.results(tasks(), self.tally.tell):
                yield batches[k], result
        except TaskFailed as failed:
            error, chunks = failed.__cause__, batches[failed.key].chunks
            rows = np.concatenate([self.layout[k] for k in chunks])
            some = f"chunk {chunks[0]}" if len(chunks) == 1 else f"chunks {listed(np.array(chunks))}"
            named = f"{some} (rows {listed(rows)})"
            if isinstance(error, ParameterError):
                raise SpecError(f"{named} is refused: {error}") from error
            raise SweepError(self._failure(named, error)) from error
        except WorkersLost as lost:
            raise SweepError(lost.kept_in(self.store.out)) from None

    def _write(
        self, k: int, plan: BatchPlan, known: KnownRows | None, result: Simulated | None, stamp: CodeStamp | None
    ) -> None:
        """Write a chunk from what was simulated for it, and from the rows that are known."""
        index, places = self.layout[k], plan.known.get(k)
        taken = None if places is None or known is None else known.take(places[places >= 0])
        steps = sum(each.steps for each in (result, taken) if each is not None)
        seconds = sum(each.seconds for each in (result, taken) if each is not None)
        engine = stamp.engine if stamp is not None else taken.engine if taken is not None else ""
        code = stamp.id if stamp is not None else str(taken.code[0]) if taken is not None else ""
        about = {
            "engine": engine,
            "code": code,
            "chunk": k,
            "chunks": len(self.layout),
            "rows": rows_digest(index),
            "steps": steps,
            "wall_seconds": seconds,
        }
        parts: list[pa.Table] = []
        for here, each, by in ((plan.unknown(k), result, code), (plan.found(k), taken, None)):
            if each is not None:
                made = taken.code if by is None and taken is not None else code
                rows = self.rows.take(here)
                parts.append(chunk_table(self.store.sweep, rows, here, each.metrics, each.status, made, about))
        table = parts[0] if len(parts) == 1 else joined(parts, index)
        series: list[pa.Table] = []
        if result is not None and result.series is not None:
            series.append(series_table(self.store.sweep, plan.unknown(k), result.series))
        if known is not None and places is not None and self.store.sweep.save is not None:
            series.append(known.series(places[places >= 0], plan.found(k)))
        self.store.write_chunk(k, table, joined_series(self.store.sweep, series, index) if series else None)
        if self.log is not None:
            self.log.tell(table, steps / seconds if seconds else math.nan)
        self._finish(k, ChunkNote(engine, steps, seconds))

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
            "take a smaller --chunk in another directory" if short else "run the same command again when it is fixed"
        )
        return (f"{chunk} failed: {type(error).__name__}{f': {reason}' if reason else ''}. What is finished is kept in "
                f"{self.store.out}: {remedy}.")  # fmt: skip
