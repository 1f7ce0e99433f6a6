"""Run a sweep: divide its rows into chunks, simulate what the directory lacks, then summarize."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.plotting.files import write_figures
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.files import parquet_bytes
from nermo_mjx.runs.interruption import resumable
from nermo_mjx.runs.provenance import session
from nermo_mjx.runs.tensorboard import TensorBoard, require_tensorboard
from nermo_mjx.runs.text import to_json
from nermo_mjx.runs.workers import LocalWorkers, TaskFailed, Workers, WorkersLost
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.chunk_log import ChunkLog
from nermo_mjx.sweep.findings import findings
from nermo_mjx.sweep.plots import figures_of
from nermo_mjx.sweep.results import Results, read_table
from nermo_mjx.sweep.row_cache import Batch, BatchPlan, KnownRows, check_source, plan_batches, with_former
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.series import check_room, chunk_with_series, joined_series, record_rows, series_table
from nermo_mjx.sweep.simulating import Simulated, SimulatorLike, SweepSimulator, chunk_rows_here, engine_name
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import (
    ChunkNote,
    DirectoryError,
    Store,
    SweepProgress,
    Tally,
    batch_values,
    layout_of,
    listed,
    rows_digest,
    simulated_seconds,
)
from nermo_mjx.sweep.table import chunk_table, joined, summarize

# ---
# The chunks of a sweep: which ones are done, and running the others.


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


#: How often to rerun a chunk that is damaged each time it is read back.
ATTEMPTS = 2


class SweepInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM; the message says how to resume."""


@dataclasses.dataclass(frozen=True)
class SweepResult:
    """A sweep's outcome.

    Attributes:
        out: its directory.
        summary: content of summary.json; empty while chunks of other shards are missing.
        plots: files of the figures.
        recordings: files of the rows that are kept.
        complete: whether the directory holds every row of the sweep.
        chunks_run: chunks simulated by this call.
        rows_done, rows: finished rows and all rows of the sweep.
        missing: which chunks are missing and how to run them, in words; empty if none is.
    """

    out: Path
    summary: dict[str, Any]
    plots: list[Path]
    recordings: list[Path]
    complete: bool
    chunks_run: int
    rows_done: int
    rows: int
    missing: str

    @property
    def table(self) -> pa.Table:
        """The result table, read from the directory at each use; see `read_table`."""
        return read_table(self.out)


def run_sweep(
    spec: Sweep | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    progress: Callable[[SweepProgress], None] | None = None,
    notify: Callable[[str], None] | None = None,
    warn: Callable[[str], None] | None = None,
    chunk: int | None = None,
    shard: tuple[int, int] | None = None,
    accept_new_code: bool = False,
    extend: bool = False,
    use: Sequence[str | os.PathLike[str]] = (),
    simulate: bool = True,
    tensorboard: bool = False,
    workers: Workers | None = None,
    simulator: SimulatorLike | None = None,
) -> SweepResult:
    """Run every variant of a sweep into a directory, or resume what it contains.

    >>> import tempfile
    >>> spec = {"vary": {"frequency": [0.6, 0.8]}, "run": {"duration": 0.2}, "plots": False}
    >>> run_sweep(spec, tempfile.mkdtemp(), engine="c").table.column("status").to_pylist()
    ['ok', 'ok']

    Memory does not grow with finished work: a chunk is written while the next one is simulated, and the summary and the
    figures read a few columns at a time.

    Args:
        spec: a `Sweep`, a dict with the fields of a sweep file, or the path of one.
        out: the directory; see `nermo_mjx.sweep.store`.
        engine: engine of the simulator; "auto" is the one that the directory was started with, if it was.
        progress: called from time to time with a `SweepProgress`.
        notify: called with a message if something takes long (compilation).
        warn: called with a message if something in the directory is damaged, and is run again.
        chunk: rows simulated and stored together; a directory keeps the size it was started with.
        shard: (i, n) runs only every n-th chunk, from i in 0..n-1; the table is the same for any split. The
            shard that finds the table complete writes the summary.
        accept_new_code: resume a directory that other code or another engine started; the table's column `code`
            tells the rows apart.
        extend: if the directory contains a sweep that differs only in its rows, turn it into this one, reusing existing
            rows. The result is that of running this sweep in a single pass.
        use: directories of other sweeps whose rows are reused where this sweep has the same ones.
        simulate: whether missing rows are run.
        tensorboard: write scalars after each chunk to DIR/tensorboard; needs the extra of this name.
        workers: what simulates; by default this process, else `nermo_mjx.runs.ray_workers.RayWorkers`.
        simulator: replaces `Simulator(spec.setup, engine)`.

    Raises:
        SpecError: the sweep is wrong; nothing has been written.
        OtherCode: other code, another model or another engine made rows of the directory.
        DirectoryError: the directory holds something else, is in use, or cannot be written.
        SweepError: a simulation failed, or all workers are lost; what is finished is kept.
        SweepInterrupted: Ctrl-C or SIGTERM; the same call resumes.
    """
    sweep = Sweep.of(spec)
    _check(chunk, shard, extend)
    if tensorboard:
        require_tensorboard()
    sources = [Path(each) for each in use]
    for source in sources:
        check_source(source, sweep)
    workers = LocalWorkers() if workers is None else workers
    parts = workers.parts * (1 if shard is None else shard[1])
    size = chunk_with_series(
        sweep, chunk or sweep.chunk, lambda: chunk_rows_here(engine, sweep.variants * sweep.repeats, parts)
    )
    wanted = Store(out, dataclasses.replace(sweep, chunk=size), shard, extend=extend)
    with (
        wanted as store,
        resumable("sweep", store.out / "sweep.yaml", SweepInterrupted) as interruption,
        contextlib.ExitStack() as stack,
    ):

        def report(share: SweepProgress) -> None:
            interruption.check()
            if progress is not None:
                progress(share)

        rows = Sample(store.sweep)
        seconds = simulated_seconds(store.sweep, rows)
        layout = layout_of(seconds, store.sweep.chunk or size, rows.structures())
        first, step = shard or (0, 1)
        work = Work(store, rows, layout, Tally(layout, seconds, range(first, len(layout), step), report))
        work.survey(warn)
        check_room(sweep, store.out, seconds, [layout[k] for k in (work.mine & ~work.done).nonzero()[0]])
        if tensorboard:
            part = "" if shard is None else "shard-{}-of-{}".format(*shard)
            board = stack.enter_context(TensorBoard(store.out, part))
            work.log = ChunkLog(board, map(pq.read_table, work.finished()))
        begun = engine_of(store.out) or next(iter(work.engines), None)
        ran = engine_name(engine, simulator, begun)
        simulates = SweepSimulator(sweep.structures, ran, simulator, notify, sweep.save)
        places = [*store.former(), *(place for source in sources for place in with_former(source))]
        known = None
        if places and not work.done[work.mine].all():
            known = KnownRows(places, warn, series=sweep.save is not None)
        if simulate:
            _finish(work, simulates, workers, accept_new_code, known, warn)
        elif known is not None:
            work.take(known, accept_new_code)
        complete = bool(work.done.all())
        results = Results([store.chunk_path(k) for k in range(len(layout))]) if complete else None
        summary, plots = ({}, []) if results is None else _sum_up(work, results, warn)
        kept = (
            []
            if results is None or sweep.keep is None
            else record_rows(store, results, sweep.keep, simulates.used, interruption.check, warn)
        )
        return SweepResult(
            out=store.out, summary=summary, plots=plots, recordings=kept, complete=complete, chunks_run=work.chunks_run,
            rows_done=work.rows_of(work.done.nonzero()[0]), rows=len(rows), missing=work.missing(),
        )  # fmt: skip


def _check(chunk: int | None, shard: tuple[int, int] | None, extend: bool) -> None:
    if extend and shard is not None:
        raise SpecError(
            "extend allows a single process: start it on its own; once it is simulating, shards may continue."
        )
    if chunk is not None and chunk < 1:
        raise SpecError(f"chunk is {chunk}: allowed is 1 or more.")
    if shard is not None and not 0 <= shard[0] < shard[1]:
        raise SpecError(f"shard is {shard[0]}/{shard[1]}: allowed is I/N with I from 0 to N - 1.")


def _finish(
    work: Work,
    simulator: SweepSimulator,
    workers: Workers,
    accept_new_code: bool,
    known: KnownRows | None,
    warn: Callable[[str], None] | None,
) -> None:
    """Run what is missing of this process's share, and verify that it is stored."""
    for _ in range(ATTEMPTS):
        complete = work.done.all()
        work.simulate(simulator, workers, accept_new_code, known)
        if complete:
            return
        work.survey(warn)
        if work.done[work.mine].all():
            return
    raise DirectoryError(f"{work.store.out} loses what is written to it: chunks are damaged again and again.")


def _sum_up(work: Work, results: Results, warn: Callable[[str], None] | None) -> tuple[dict[str, Any], list[Path]]:
    """Write the summary and the figures of a complete table."""
    store = work.store
    summary, figures = {**summarize(results), **work.effort()}, figures_of(results)
    for finding in findings(results, store.sweep, notify=warn):
        store.directory.write(f"{finding.name}.parquet", parquet_bytes(finding.table))
        summary[finding.name] = finding.about
        figures = itertools.chain(figures, finding.figures)
    store.directory.write("summary.json", to_json(summary))
    if not store.sweep.plots:
        return summary, []
    return summary, write_figures(figures, store.plots)
