"""Run a sweep: divide its rows into chunks, simulate what the directory lacks, then summarize."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.plotting.files import write_figures
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.files import parquet_bytes
from nermo_mjx.runs.interruption import resumable
from nermo_mjx.runs.tensorboard import TensorBoard, require_tensorboard
from nermo_mjx.runs.text import to_json
from nermo_mjx.runs.workers import LocalWorkers, Workers
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.chunk_log import ChunkLog
from nermo_mjx.sweep.chunk_size import chunk_rows_here
from nermo_mjx.sweep.chunks import Work
from nermo_mjx.sweep.findings import findings
from nermo_mjx.sweep.keeping import record_rows
from nermo_mjx.sweep.known import KnownRows, check_source, with_former
from nermo_mjx.sweep.layout import layout_of, simulated_seconds
from nermo_mjx.sweep.plots import figures_of
from nermo_mjx.sweep.results import Results, read_table
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.series import check_room, chunk_with_series
from nermo_mjx.sweep.simulating import SimulatorLike, SweepSimulator, engine_name
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import DirectoryError, Store
from nermo_mjx.sweep.summary import summarize
from nermo_mjx.sweep.tally import SweepProgress, Tally

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
