"""`run_sweep` simulates the missing rows of a sweep, and then writes its summary, figures and recordings.

`SweepRows` defines the rows, `Work` reports which of them are missing, and a `SweepSimulator` simulates these in chunks.
A chunk is a batch of rows that are simulated and stored together. If the sweep asks for an optimum, it may need further
rows: additional repeats of the variants that may be the best ones.
"""

from __future__ import annotations

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


@dataclasses.dataclass(frozen=True)
class SweepResult:
    """Result of a sweep.

    Attributes:
        out: Run directory of the sweep.
        summary: Content of summary.json; empty while rows are missing.
        plots: Files of the figures.
        recordings: Files with the recordings of the rows that `keep` selects.
        complete: Whether the directory contains every row of the sweep.
        chunks_run: Number of chunks that this call has simulated.
        rows_done: Number of finished rows, including further rows for an optimum.
        rows: Number of all rows, including further rows for an optimum.
        missing: Sentence about the number of missing rows and the command that runs them; empty if none is missing.
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


@shows_progress("sweep", "runs")
# Long because the job passes through all its stages in one place.
# Many parameters because each is an option of the command: a record of them would only rename them.
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
    """Run every variant of a sweep into a directory, or resume the sweep that the directory contains.

    >>> import tempfile
    >>> spec = {"vary": {"frequency": [0.6, 0.8]}, "run": {"duration": 0.2}, "plots": False}
    >>> run_sweep(spec, tempfile.mkdtemp(), engine="c").table.column("status").to_pylist()
    ['ok', 'ok']

    Memory does not grow with finished work: a chunk is written while the next one is simulated, and the summary and the
    figures read a few columns at a time.

    Args:
        spec: A `Sweep`, a dict with the fields of a sweep file, or the path of a sweep file.
        out: The run directory; `nermo_mjx.sweep.directory` and `nermo_mjx.runs.rows` describe its files.
        engine: Engine of the simulator; "auto" continues with the engine of the directory, if it contains rows.
        watch: Functions that receive the progress (with `shard`, the progress of this shard) and warnings, for example
            about a damaged file whose rows are run again.
        progress: Whether to show the progress on a terminal or in a notebook, if there is no `watch`.
        chunk: Number of rows that are simulated and stored together; a directory keeps the number of its first run.
        shard: (i, n) runs only every n-th chunk, from chunk i in 0..n-1; the table is the same for any n. The
            shard that finishes last writes the summary.
        accept_new_code: Whether to resume a directory that other code or another engine started; the column `code` of
            the table then distinguishes the rows.
        extend: Whether a sweep in the directory that differs from this one only in its rows becomes this one, with its
            rows reused. The result is the same as if this sweep had been run in a single pass.
        use: Directories of other sweeps; rows that they have in common with this sweep are reused.
        simulate: Whether to simulate missing rows.
        tensorboard: Whether to write scalars after each chunk to DIR/tensorboard, which requires the extra `tensorboard`.
        workers: Processes that simulate: this process by default, or for example
            `nermo_mjx.runs.ray_workers.RayWorkers`.
        simulator: Simulator that replaces `Simulator(spec.setup, engine)`.

    Raises:
        SpecError, OtherCode, DirectoryError, JobFailed, Interrupted: See "Errors of jobs" in docs/reference/python.md.
    """
    rows = SweepRows(Sweep.of(spec))
    _check_options(rows, chunk, shard, extend, tensorboard)
    sources = [Path(source) for source in use]
    rows.check_sources(sources)
    workers = LocalWorkers() if workers is None else workers
    process_count = workers.parts * (1 if shard is None else shard[1])
    chunk_rows = rows.chunk(chunk, engine, process_count, simulate)
    with (
        RunDirectory(out, "sweep", shard) as directory,
        resumable(directory.out, f"sweep {directory.out / 'sweep.yaml'}") as interruption,
        contextlib.ExitStack() as stack,
    ):
        watch = interruption.watched(watch)
        # A directory that was started earlier has its own sweep.yaml, which is checked against this sweep.
        rows = rows.claimed(directory, chunk_rows, extend=extend)
        log = None
        if tensorboard:
            log_name = "" if shard is None else "shard-{}-of-{}".format(*shard)
            log = BatchLog(stack.enter_context(TensorBoard(directory.out, log_name))).add
        # A directory that was started earlier has its own size of chunks.
        chunk_rows = rows.sweep.chunk or chunk_rows
        work = Work(rows, directory.out, chunk_rows, sources, shard, watch, directory, log)
        # Raises an error if the time series of the missing rows do not fit on the disk.
        rows.check_room(directory.out, work.unfinished)
        former_engine = engine_of(directory.out) or next(
            (part.engine for part in work.runs.parts), None
        )
        computer = rows.computer(
            engine_name(engine, simulator, former_engine), simulator, watch.notify
        )
        _complete(work, computer, workers if simulate else None, rows.sought, accept_new_code)
        is_done = work.done
        summary, plots, recordings = dict[str, Any](), list[Path](), list[Path]()
        if is_done.all():
            results = work_results(work)
            summary, plots = _publish(directory, rows, results, work.effort(), watch)
            if rows.sweep.keep is not None:
                recordings = _record(
                    directory, rows, results, computer.used, interruption, watch.warn
                )
        finished_count, row_count = work.count
        return SweepResult(
            out=directory.out,
            summary=summary,
            plots=plots,
            recordings=recordings,
            complete=bool(is_done.all()),
            chunks_run=work.simulated,
            rows_done=finished_count,
            rows=row_count,
            missing=work.missing(),
        )


def _check_options(
    rows: SweepRows,
    chunk: int | None,
    shard: tuple[int, int] | None,
    extend: bool,
    tensorboard: bool,
) -> None:
    """Reject options that cannot be combined, and options that need a package which is not installed."""
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
    """The result table of all rows of a job that are stored."""
    return Results([part.path for part in work.runs.parts])


def _complete(
    work: Work,
    computer: SweepSimulator,
    workers: Workers | None,
    sought: tuple[SoughtOptimum, int, int] | None,
    accept_new_code: bool,
) -> None:
    """Reuse rows of other directories and simulate missing rows, until an optimum needs no further rows.

    Args:
        work: Rows of the sweep.
        computer: Simulator of the rows.
        workers: Processes that simulate; None to simulate nothing.
        sought: The optimum to find, the number of repeats and the number of variants; None without an optimum.
        accept_new_code: See `run_sweep`.
    """
    while True:
        work.reuse(accept_new_code)
        if workers is None:
            return
        for _ in finish([work], computer, workers, accept_new_code):
            pass  # `finish` is a generator, which yields each finished job
        if sought is None or not work.done.all():
            return
        further_rows = find_optimum(work_results(work), *sought).further
        if not len(further_rows):
            return
        work.add_further(further_rows)


def _record(
    directory: RunDirectory,
    rows: SweepRows,
    results: Results,
    simulator: SimulatorLike | None,
    interruption: Interruption,
    warn: Callable[[str], None],
) -> list[Path]:
    """Record the rows that the field `keep` of the sweep selects; returns the files of their recordings."""
    from nermo_mjx.sweep.replay import record_rows

    keep, optimum_rows = rows.sweep.keep, dict[int, str]()
    assert keep is not None
    if rows.sought is not None and keep.optimum:
        optimum_rows = find_optimum(results, *rows.sought).shown_rows()
    check = interruption.check
    return record_rows(directory, rows.group, results, keep, simulator, check, warn, optimum_rows)


def _publish(
    directory: RunDirectory,
    rows: SweepRows,
    results: Results,
    effort: Mapping[str, Any],
    watch: Watch,
) -> tuple[dict[str, Any], list[Path]]:
    """Write summary, figures and findings of a complete table; returns the content of summary.json and the figures' files.

    A finding is an analysis of the table with a table of its own: the optimum, the comparison, the sensitivity.
    """
    summary, figures = {**summarize(results), **effort}, figures_of_results(results)
    comparison = None if rows.sweep.compare is None else rows.sweep.compare.written()
    for name, table, description, finding_figures, files in findings(
        results, comparison, rows.sought, notify=watch.warn
    ):
        directory.write(f"{name}.parquet", parquet_bytes(table))
        for file, content in files.items():
            directory.write(file, content)
        summary[name] = description
        figures = itertools.chain(figures, finding_figures)
    directory.write("summary.json", to_json(summary))
    return summary, write_figures(figures, directory.out / "plots") if rows.sweep.plots else []
