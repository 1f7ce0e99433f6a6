"""Run a sweep: ask for its rows, have those simulated that are missing, then summarize."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from nermo_mjx.plotting.files import write_figures
from nermo_mjx.progress import shows_progress
from nermo_mjx.robot.quantity import require
from nermo_mjx.runs.directory import RunDirectory, engine_of
from nermo_mjx.runs.files import (
    parquet_bytes,
    to_json,
)
from nermo_mjx.runs.job import SILENT, Interruption, TensorBoard, Watch, resumable
from nermo_mjx.runs.work import Work, finish
from nermo_mjx.runs.workers import LocalWorkers, Workers
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.optimum import find_optimum
from nermo_mjx.sweep.plots import figures_of_results, findings
from nermo_mjx.sweep.scalars import BatchLog
from nermo_mjx.sweep.simulating import (
    SimulatorLike,
    SweepSimulator,
    engine_name,
)
from nermo_mjx.sweep.spec import SoughtOptimum, Sweep
from nermo_mjx.sweep.store import SweepRows
from nermo_mjx.sweep.table import (
    Results,
    read_table,
    summarize,
)

# ---
# Running a sweep.


@dataclasses.dataclass(frozen=True)
class SweepResult:
    """A sweep's outcome.

    Attributes:
        out: its directory.
        summary: content of summary.json; empty while rows of other shards are missing.
        plots: files of the figures.
        recordings: files of the rows that are kept.
        complete: whether the directory holds every row of the sweep.
        chunks_run: batches simulated by this call.
        rows_done, rows: finished rows and all rows of the sweep.
        missing: how many rows are missing and how to run them, in words; empty if none is.
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


# The options of the command, each a keyword: a record of them would only rename them.
@shows_progress("sweep", "runs")
# Long because the job passes through all its stages in one place.
# Many parameters because each is an option of the job, most by keyword only.
def run_sweep(
    spec: Sweep | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    watch: Watch = SILENT,
    progress: bool = True,
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

    Memory does not grow with finished work: a batch is written while the next one is simulated, and the summary and the
    figures read a few columns at a time.

    Args:
        spec: a `Sweep`, a dict with the fields of a sweep file, or the path of one.
        out: the directory; see `nermo_mjx.sweep.store`.
        engine: engine of the simulator; "auto" is the one that the directory was started with, if it was.
        watch: is told the progress, of a shard that of its own share; and what is damaged, and is run again.
        progress: whether it is shown where somebody looks, if there is no watch.
        chunk: rows simulated and stored together; a directory keeps the size it was started with.
        shard: (i, n) runs only every n-th chunk, from i in 0..n-1; the table is the same for any split. The
            shard that finds the table complete writes the summary.
        accept_new_code: resume a directory that other code or another engine started; the table's column `code`
            tells the rows apart.
        extend: if the directory contains a sweep that differs only in its rows, turn it into this one, reusing existing
            rows. The result is that of running this sweep in a single pass.
        use: directories of other sweeps whose rows are reused where this sweep has the same ones.
        simulate: whether missing rows are run.
        tensorboard: write scalars after each batch to DIR/tensorboard; needs the extra of this name.
        workers: what simulates; by default this process, else `nermo_mjx.runs.ray_workers.RayWorkers`.
        simulator: replaces `Simulator(spec.setup, engine)`.

    Raises:
        SpecError, OtherCode, DirectoryError, JobFailed, Interrupted: see "Errors of jobs" in docs/reference/python.md.
    """
    rows = SweepRows(Sweep.of(spec))
    _check_options(rows, chunk, shard, extend, tensorboard)
    sources = [Path(source) for source in use]
    rows.check_sources(sources)
    workers = LocalWorkers() if workers is None else workers
    parts = workers.parts * (1 if shard is None else shard[1])
    size = rows.chunk(chunk, engine, parts, simulate)
    with (
        RunDirectory(out, "sweep", shard) as directory,
        resumable(directory.out, f"sweep {directory.out / 'sweep.yaml'}") as interruption,
        contextlib.ExitStack() as stack,
    ):
        watch = interruption.watched(watch)
        rows = rows.claimed(directory, size, extend=extend)
        log = None
        if tensorboard:
            part = "" if shard is None else "shard-{}-of-{}".format(*shard)
            log = BatchLog(stack.enter_context(TensorBoard(directory.out, part))).add
        size = rows.sweep.chunk or size
        work = Work(rows, directory.out, size, sources, shard, watch, directory, log)
        rows.check_room(directory.out, work.unfinished)
        begun_on = engine_of(directory.out) or next((part.engine for part in work.runs.parts), None)
        computer = rows.computer(engine_name(engine, simulator, begun_on), simulator, watch.notify)
        _complete(work, computer, workers if simulate else None, rows.sought, accept_new_code)
        done, summary, plots, recordings = work.done, dict[str, Any](), list[Path](), list[Path]()
        if done.all():
            results = work_results(work)
            summary, plots = _publish(directory, rows, results, work.effort(), watch)
            if rows.sweep.keep is not None:
                recordings = _record(
                    directory, rows, results, computer.used, interruption, watch.warn
                )
        finished, count = work.count
        return SweepResult(
            out=directory.out,
            summary=summary,
            plots=plots,
            recordings=recordings,
            complete=bool(done.all()),
            chunks_run=work.simulated,
            rows_done=finished,
            rows=count,
            missing=work.missing(),
        )


def _check_options(
    rows: SweepRows,
    chunk: int | None,
    shard: tuple[int, int] | None,
    extend: bool,
    tensorboard: bool,
) -> None:
    """Refuse options that do not go together, and those that need a package which is missing."""
    if extend and shard is not None:
        raise SpecError(
            "extend allows a single process: start it on its own; once it is simulating, shards may continue."
        )
    if chunk is not None and chunk < 1:
        raise SpecError(f"chunk is {chunk}: allowed is 1 or more.")
    if shard is not None and not 0 <= shard[0] < shard[1]:
        raise SpecError(f"shard is {shard[0]}/{shard[1]}: allowed is I/N with I from 0 to N - 1.")
    if tensorboard:
        require("tensorboard", "tensorboardX", "tensorboard")
    if rows.sweep.sampler == "saltelli":
        require("sample: saltelli", "SALib", "sensitivity")


def work_results(work: Work) -> Results:
    """The table of the rows that a job has."""
    return Results([part.path for part in work.runs.parts])


def _complete(
    work: Work,
    computer: SweepSimulator,
    workers: Workers | None,
    sought: tuple[SoughtOptimum, int, int] | None,
    accept_new_code: bool,
) -> None:
    """Reuse rows, and simulate what is missing, up to the last further row that an optimum needs.

    Args:
        workers: what simulates; None if nothing may.
        sought: the optimum that is sought, and the repeats and variants of the sweep.
    """
    while True:
        work.reuse(accept_new_code)
        if workers is None:
            return
        collections.deque(finish([work], computer, workers, accept_new_code), maxlen=0)
        if sought is None or not work.done.all():
            return
        further = find_optimum(work_results(work), *sought).further
        if not len(further):
            return
        work.add_further(further)


def _record(
    directory: RunDirectory,
    rows: SweepRows,
    results: Results,
    simulator: SimulatorLike | None,
    interruption: Interruption,
    warn: Callable[[str], None],
) -> list[Path]:
    """Record the rows that are kept; files of their recordings."""
    from nermo_mjx.sweep.replay import record_rows

    keep, also = rows.sweep.keep, dict[int, str]()
    assert keep is not None
    if rows.sought is not None and keep.optimum:
        also = find_optimum(results, *rows.sought).shown_rows()
    check = interruption.check
    return record_rows(directory, rows.group, results, keep, simulator, check, warn, also)


def _publish(
    directory: RunDirectory,
    rows: SweepRows,
    results: Results,
    effort: Mapping[str, Any],
    watch: Watch,
) -> tuple[dict[str, Any], list[Path]]:
    """Write what is made of a complete table; the content of summary.json, and the files of the figures."""
    summary, figures = {**summarize(results), **effort}, figures_of_results(results)
    comparison = None if rows.sweep.compare is None else rows.sweep.compare.written()
    for name, table, description, figures_of_table, files in findings(
        results, comparison, rows.sought, notify=watch.warn
    ):
        directory.write(f"{name}.parquet", parquet_bytes(table))
        for file, content in files.items():
            directory.write(file, content)
        summary[name] = description
        figures = itertools.chain(figures, figures_of_table)
    directory.write("summary.json", to_json(summary))
    return summary, write_figures(figures, directory.out / "plots") if rows.sweep.plots else []
