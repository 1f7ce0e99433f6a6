"""Run a sweep: ask for its rows, have those simulated that are missing, then summarize; and merge directories."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import json
import math
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from nermo_mjx.physics import resolve_engine
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.plotting.shown import cost
from nermo_mjx.progress import shows_progress
from nermo_mjx.robot.quantity import ParameterError, of_type, require
from nermo_mjx.rollout import METRICS, Simulator
from nermo_mjx.rollout.metric_table import SIDES
from nermo_mjx.rollout.run import too_many
from nermo_mjx.runs.code import session
from nermo_mjx.runs.directory import RunDirectory, engine_of
from nermo_mjx.runs.files import (
    DirectoryError,
    WrongDirectory,
    parquet_bytes,
    parquet_table,
    to_json,
)
from nermo_mjx.runs.job import SILENT, Forecast, JobFailed, Progress, TensorBoard, Watch, resumable
from nermo_mjx.runs.rows import Runs
from nermo_mjx.runs.workers import LocalWorkers, TaskFailed, Workers
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.specs.walk import unread
from nermo_mjx.sweep.counting import counts
from nermo_mjx.sweep.optimum import find_optimum
from nermo_mjx.sweep.plots import figures_of_results, findings
from nermo_mjx.sweep.simulating import (
    PROBE,
    WORLD_BYTES,
    Simulated,
    SimulatorLike,
    SweepSimulator,
    chunk_rows_here,
    engine_name,
    pace,
)
from nermo_mjx.sweep.spec import Sample, Sweep, varied_values
from nermo_mjx.sweep.store import (
    batch_values,
    check_room,
    check_source,
    chunk_with_series,
    claim,
    first_few,
    fixed_differences,
    keys_of_rows,
    refusal,
    series_table,
    simulated_seconds,
    sweep_differences,
    sweep_in,
)
from nermo_mjx.sweep.table import (
    HELD,
    Results,
    better,
    chunk_table,
    columns_of,
    read_table,
    summarize,
)
from nermo_mjx.trust import only_reading

# ---
# The rows of a sweep: which are there, and which are simulated, in batches of equal size.


#: How JAX, CUDA and Warp say that a batch does not fit.
_NO_MEMORY = re.compile("RESOURCE_EXHAUSTED|out of memory|failed to allocate", re.IGNORECASE)
#: Rows that are taken from other directories at once, if they have no time series.
_TAKEN: Final = 65_536
#: How often rows are simulated again that are damaged each time they are read back.
ATTEMPTS: Final = 2


class RowBatch(NamedTuple):
    """Rows that are simulated together (n,), all of one structure, in so many worlds, n or more."""

    structure: int
    rows: np.ndarray
    worlds: int


class Work:
    """The rows of a sweep, as far as one process cares for them.

    Args:
        sweep: whose rows.
        out: the directory, which need not be there.
        size: rows of a batch, at most.
        sources: directories of other sweeps whose rows are reused.
        shard: (i, n): this process simulates every n-th batch, from i.
        watch: is told the progress of this process's share, and of damaged files.
        held: the directory as this process holds it; without it nothing is written.
        board: is told of each batch that is written.

    Attributes:
        rows: all of them.
        seconds: how long each is simulated, (rows,) [s].
        layout: the rows of each batch, if the whole sweep is simulated in one go.
        runs: the store that has them, or not.
        simulated, reused: batches that this process has simulated, and rows that it has taken from elsewhere.
    """

    def __init__(
        self,
        sweep: Sweep,
        out: Path,
        size: int,
        sources: Sequence[Path] = (),
        shard: tuple[int, int] | None = None,
        watch: Watch = SILENT,
        held: RunDirectory | None = None,
        board: TensorBoard | None = None,
    ) -> None:
        self.sweep, self.out, self.rows, self._size, self._watch = (
            sweep,
            out,
            Sample(sweep),
            size,
            watch,
        )
        self._structure, self.seconds = self.rows.structures(), simulated_seconds(sweep, self.rows)
        # Rows of one batch share structure and duration; batches are of equal size, to one row.
        order, self.layout = np.argsort(self.seconds, kind="stable"), list[np.ndarray]()
        for at in np.unique(self._structure):
            alike = order[self._structure[order] == at]
            self.layout += np.array_split(alike, math.ceil(len(alike) / size))
        self._shard = shard or (0, 1)
        self._share = np.concatenate(
            self.layout[self._shard[0] :: self._shard[1]] or [np.empty(0, int)]
        )
        self.runs = Runs(out, sweep.digest(), sources, watch.warn, sweep.save is not None, held)
        self._log = None if board is None else BatchLog(board)
        if self._log is not None:
            for table in (
                parquet_table(part.path) for part in self.runs.parts
            ):  # of earlier sessions
                if table is not None and np.isin(table["row"].to_numpy(), self._share).any():
                    self._log.add(table)
        self._resumed, self.simulated, self.reused = len(self._share) - len(self.unfinished), 0, 0
        self._finished, self._left, self._further = 0, 0.0, np.empty(0, int)

    @property
    def done(self) -> np.ndarray:
        """Which rows are there, (rows,) bool."""
        return self._there[: len(self.rows)]

    @property
    def _there(self) -> np.ndarray:
        """The same of all numbers up to that of the last further row."""
        there, numbers = np.zeros(len(self.seconds), bool), self.runs.numbers
        there[numbers[numbers < len(there)]] = True
        return there

    def add_further(self, index: np.ndarray) -> None:
        """Make this process care for further repeats of some variants, by the numbers of their rows, (n,)."""
        self._further = np.union1d(self._further, index)
        size, own = int(self._further[-1]) + 1, len(self.rows)
        self._structure, self.seconds = (
            np.resize(each[:own], size) for each in (self._structure, self.seconds)
        )
        self._structure[self._further] = self.rows.take(self._further).structure
        self.seconds[self._further] = simulated_seconds(self.sweep, self.rows, self._further)
        self._share = np.concatenate([self._share[self._share < own], self._further])

    @property
    def count(self) -> tuple[int, int]:
        """How many rows are there, and are to be there: the sweep's and further ones."""
        return int(self.done.sum() + self._there[self._further].sum()), len(self.rows) + len(
            self._further
        )

    @property
    def unfinished(self) -> np.ndarray:
        """The rows of this process that are not there, (n,), those of one batch together."""
        return self._share[~self._there[self._share]]

    def effort(self) -> dict[str, Any]:
        """Engines, physics steps and the time they took, over all sessions."""
        steps, seconds = np.sum(
            [(0.0, 0.0), *((part.steps, part.seconds) for part in self.runs.parts)], axis=0
        ).tolist()
        return {
            "engine": ", ".join(sorted({part.engine for part in self.runs.parts})),
            "chunks": len(self.runs.parts),
            "steps": int(steps),
            "wall_seconds": round(seconds, 3),
            "steps_per_second": round(steps / seconds, 1) if seconds else math.nan,
        }

    def missing(self) -> str:
        """How many rows are not there, and how to run them, in a sentence; empty if none is missing."""
        done, (own, shards) = self.done, self._shard
        if done.all():
            return ""
        lacking = {k % shards for k, rows in enumerate(self.layout) if not done[rows].all()}
        shares = " and ".join(f"--shard {shard}/{shards}" for shard in sorted(lacking - {own}))
        how = f"with {shares}" if shares else "by the command sweep"
        return f"{(~done).sum():,} of {len(done):,} runs are missing; unless they are being run, run them {how}."

    def known(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Unfinished rows that are in other directories or in former parts, some at a time (n,), and where (n,)."""
        unfinished = self.unfinished if self.runs.others else np.empty(0, int)
        at_once = _TAKEN if self.sweep.save is None else len(self.layout[0])
        for start in range(0, len(unfinished), at_once):
            index = unfinished[start : start + at_once]
            places = self.runs.find(keys_of_rows(self.sweep, self.rows.take(index)))
            if (places >= 0).any():
                yield index[places >= 0], places[places >= 0]

    def batches(self, rows: np.ndarray, reused: int = 0) -> list[RowBatch]:
        """The batches for some rows, of few shapes, so that no engine compiles again.

        Args:
            rows: (n,), as `unfinished` orders them.
            reused: how many rows of the sweep are not simulated at all; then there may be few others.
        """
        whole = dict[int, int]()
        for each in self.layout:
            at = int(self._structure[each[0]])
            whole[at] = max(whole.get(at, 0), len(each))
        batches = []
        for at in np.unique(self._structure[rows]).tolist():
            own = rows[self._structure[rows] == at]
            split = np.array_split(own, math.ceil(len(own) / (self._size if reused else whole[at])))
            worlds = len(split[0]) if reused else whole[at]
            batches += [RowBatch(at, index, worlds) for index in split]
        return batches

    def reuse(self, accept_new_code: bool) -> None:
        """Take unfinished rows from other directories and former parts.

        Raises:
            OtherCode: other code made them.
            DirectoryError: they cannot be written.
        """
        for index, places in self.known():
            if not self.reused:
                codes = self.runs.codes(accept=accept_new_code)
                self.runs.take_codes(codes, accept=accept_new_code, any_model=True)
            table = self.runs.take(places)
            metrics = {name: table[name].to_numpy() for name in columns_of(table, "metric")}
            status, code = (
                np.array(table[name].to_pylist(), object) for name in ("status", "code")
            )
            about = {key.decode(): text.decode() for key, text in table.schema.metadata.items()}
            series = None
            if self.sweep.save is not None:
                each = zip(self.runs.series(places), index.tolist(), strict=True)
                series = pa.concat_tables(
                    own.set_column(0, own.schema.field("row"), pa.array(np.full(len(own), row)))
                    for own, row in each
                ).replace_schema_metadata({"sweep": self.sweep.digest()})
            self._add(index, metrics, status, code, about | {"code": str(code[0])}, series)
            self.reused += len(index)

    def finish(self, computer: SweepSimulator, workers: Workers, accept_new_code: bool) -> None:
        """Simulate what is missing, and once more what was damaged on its way to the disk; see `simulate`."""
        for _ in range(ATTEMPTS):
            before = self.simulated
            self.simulate(computer, workers, accept_new_code)
            if self.simulated == before:
                return
            self.runs.survey()
            if not len(self.unfinished):
                return
        raise DirectoryError(
            f"{self.out} loses what is written to it: it is damaged again and again."
        )

    def simulate(self, simulator: SweepSimulator, workers: Workers, accept_new_code: bool) -> None:
        """Simulate what is unfinished; each batch is written while the next one is simulated.

        Raises:
            SpecError: a parameter is refused.
            JobFailed: a simulation failed, or all workers are lost.
            OtherCode: other code made the rows that are there.
            DirectoryError: a batch cannot be written.
        """
        unfinished = self.unfinished
        # On the engine c nothing is compiled, and the few further rows fill no batch.
        batches = self.batches(
            unfinished, self.reused or (simulator.engine == "c" and len(self._further))
        )
        self._finished, self._left = (
            len(self._share) - len(unfinished),
            float(self.seconds[unfinished].sum()),
        )
        self._tell()
        if not batches:
            return
        workers.begin(simulator)
        stamps = {
            at: simulator.stamp(at) for at in dict.fromkeys(batch.structure for batch in batches)
        }
        several = bool(self.runs.others) or len(self.sweep.structures) > 1
        self.runs.take_codes(list(stamps.values()), accept=accept_new_code, any_model=several)
        first, held = next(iter(stamps.values())), self.runs.held
        assert held is not None
        shard = "" if held.shard is None else "{}/{}".format(*held.shard)
        held.note_session(
            session(engine=simulator.engine, code=first.id, shard=shard, chunks=len(batches))
        )

        def tasks() -> Iterator[tuple[int, tuple[int, Mapping[str, np.ndarray]]]]:
            for k, batch in enumerate(batches):
                walk = self.sweep.structures[batch.structure]
                yield (
                    k,
                    (batch.structure, batch_values(walk, self.rows.take(batch.rows), batch.worlds)),
                )

        def tell(k: int, share: float) -> None:
            self._tell(self.seconds[batches[k].rows].sum() * min(max(float(share), 0.0), 1.0))

        try:
            with ThreadPoolExecutor(1, "sweep-writer") as writer:
                written: Future[None] | None = None
                for k, result in workers.results(tasks(), tell):
                    before, written = (
                        written,
                        writer.submit(self._write, batches[k], result, stamps),
                    )
                    self.simulated += 1
                    self._finished += len(batches[k].rows)
                    self._left -= float(self.seconds[batches[k].rows].sum())
                    self._tell()
                    if before is not None:
                        before.result()
                if written is not None:
                    written.result()
        except TaskFailed as failed:
            rows, error = f"rows {first_few(batches[failed.key].rows)}", failed.__cause__
            if isinstance(error, ParameterError):
                raise SpecError(f"{rows} are refused: {error}") from error
            reason = (str(error).strip().splitlines() or [""])[0].rstrip(".")[:300]
            remedy = "run the same command again when it is fixed"
            if isinstance(error, MemoryError) or _NO_MEMORY.search(reason):
                remedy = "take a smaller --chunk in another directory"
            raise JobFailed(
                f"{rows} failed: {type(error).__name__}{f': {reason}' if reason else ''}. What is finished is kept in "
                f"{self.out}: {remedy}."
            ) from error

    def _tell(self, current: float = 0.0) -> None:
        """Report the progress, with the simulated time that the batches at work have done [s]."""
        whole, count = float(self.seconds[self._share].sum()), len(self._share)
        fraction = 1.0 if self._finished == count else 1.0 - (self._left - current) / whole
        self._watch.progress(Progress(fraction, self._finished, count, self._resumed + self.reused))

    def _write(self, batch: RowBatch, result: Simulated, stamps: Mapping[int, Any]) -> None:
        stamp, count = stamps[batch.structure], len(batch.rows)
        about = {
            "engine": stamp.engine,
            "code": stamp.id,
            "steps": result.steps,
            "wall_seconds": result.seconds,
        }
        metrics = {name: column[:count] for name, column in result.metrics.items()}
        series = (
            None if result.series is None else series_table(self.sweep, batch.rows, result.series)
        )
        table = self._add(batch.rows, metrics, result.status[:count], stamp.id, about, series)
        if self._log is not None:
            self._log.add(table, result.steps / result.seconds if result.seconds else math.nan)

    def _add(
        self,
        index: np.ndarray,
        metrics: Mapping[str, np.ndarray],
        status: np.ndarray,
        code: str | np.ndarray,
        about: Mapping[str, Any],
        series: pa.Table | None,
    ) -> pa.Table:
        rows = self.rows.take(index)
        table = chunk_table(self.sweep, rows, index, metrics, status, code, about)
        self.runs.add(keys_of_rows(self.sweep, rows), table, series)
        return table


class BatchLog:
    """Scalars for TensorBoard, summed up as batches come: best and mean of each metric, statuses, steps per second.

    Args:
        board: where they go.
    """

    def __init__(self, board: TensorBoard) -> None:
        self._board, self._rows = board, 0
        self._statuses: collections.Counter[str] = collections.Counter()
        self._sums: collections.Counter[str] = collections.Counter()
        self._counts: collections.Counter[str] = collections.Counter()
        self._best: dict[str, float] = {}

    def add(self, table: pa.Table, steps_per_second: float | None = None) -> None:
        """Add a batch's rows, and report the state if this session made them; only successful runs count in best and
        mean. The step is the number of rows."""
        self._rows += table.num_rows
        self._statuses.update(table.column("status").to_pylist())
        well = pc.equal(table.column("status"), "ok").to_numpy()
        for name in columns_of(table, "metric"):
            values = np.asarray(table.column(name).to_numpy(), float)
            values = values[counts(name, values, well)]
            if not len(values):
                continue
            self._sums[name] += float(values.sum())  # type: ignore[assignment]
            self._counts[name] += len(values)
            if side := better(table.schema.field(name)):
                candidates = np.append(self._best.get(name, values[0]), values)
                self._best[name] = float(candidates[np.argmin(cost(SIDES[side], candidates))])
        if steps_per_second is None:
            return
        numbers = {
            "rows": float(self._rows),
            "steps_per_second": steps_per_second,
            **{f"status/{name}": float(count) for name, count in self._statuses.items()},
            **{f"mean/{name}": self._sums[name] / count for name, count in self._counts.items()},
            **{f"best/{name}": value for name, value in self._best.items()},
        }
        self._board.log(self._rows, numbers)


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


@shows_progress("sweep", "runs")
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
    sweep = Sweep.of(spec)
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
    if sweep.sampler == "saltelli":
        require("sample: saltelli", "SALib", "sensitivity")
    sources = [Path(each) for each in use]
    for source in sources:
        check_source(source, sweep)
    workers = LocalWorkers() if workers is None else workers
    parts = workers.parts * (1 if shard is None else shard[1])
    size = chunk_with_series(
        sweep,
        chunk or sweep.chunk,
        lambda: chunk_rows_here(engine, sweep.variants * sweep.repeats, parts),
    )
    if simulate and (wrong := too_many(min(size, sweep.variants * sweep.repeats))):
        raise SpecError(f"chunk is {size:,}: {wrong}")
    with (
        RunDirectory(out, "sweep", shard) as directory,
        resumable(directory.out, f"sweep {directory.out / 'sweep.yaml'}") as interruption,
        contextlib.ExitStack() as stack,
    ):
        watch = interruption.watched(watch)
        sweep = claim(directory, dataclasses.replace(sweep, chunk=size), extend=extend)
        board = None
        if tensorboard:
            part = "" if shard is None else "shard-{}-of-{}".format(*shard)
            board = stack.enter_context(TensorBoard(directory.out, part))
        work = Work(
            sweep, directory.out, sweep.chunk or size, sources, shard, watch, directory, board
        )
        check_room(sweep, directory.out, work.seconds[work.unfinished])
        begun_on = engine_of(directory.out) or next((part.engine for part in work.runs.parts), None)
        name = engine_name(engine, simulator, begun_on)
        computer = SweepSimulator(sweep.structures, name, simulator, watch.notify, sweep.save)
        work.reuse(accept_new_code)
        if simulate:
            work.finish(computer, workers, accept_new_code)
        sought = None if sweep.optimum is None else (sweep.optimum, sweep.repeats, sweep.variants)
        while simulate and sought is not None and work.done.all():
            further = find_optimum(
                Results([part.path for part in work.runs.parts]), *sought
            ).further
            if not len(further):
                break
            work.add_further(further)
            work.reuse(accept_new_code)
            work.finish(computer, workers, accept_new_code)
        done, summary, plots, recordings = work.done, dict[str, Any](), list[Path](), list[Path]()
        if done.all():
            results = Results([part.path for part in work.runs.parts])
            summary, plots = _publish(directory, sweep, results, work.effort(), watch)
            if sweep.keep is not None:
                from nermo_mjx.sweep.replay import record_rows

                also = dict[int, str]()
                if sought is not None and sweep.keep.optimum:
                    also = find_optimum(results, *sought).shown_rows()
                recordings = record_rows(
                    directory,
                    sweep.digest(),
                    results,
                    sweep.keep,
                    computer.used,
                    interruption.check,
                    watch.warn,
                    also,
                )
        rows: dict[str, Any] = {
            "rows_done": work.count[0],
            "rows": work.count[1],
            "missing": work.missing(),
        }
        return SweepResult(
            directory.out, summary, plots, recordings, bool(done.all()), work.simulated, **rows
        )


def _publish(
    directory: RunDirectory, sweep: Sweep, results: Results, effort: Mapping[str, Any], watch: Watch
) -> tuple[dict[str, Any], list[Path]]:
    """Write what is made of a complete table; the content of summary.json, and the files of the figures."""
    summary, figures = {**summarize(results), **effort}, figures_of_results(results)
    comparison = None if sweep.compare is None else sweep.compare.written()
    sought = None if sweep.optimum is None else (sweep.optimum, sweep.repeats, sweep.variants)
    for name, table, about, drawn, files in findings(
        results, comparison, sought, notify=watch.warn
    ):
        directory.write(f"{name}.parquet", parquet_bytes(table))
        for file, content in files.items():
            directory.write(file, content)
        summary[name] = about
        figures = itertools.chain(figures, drawn)
    directory.write("summary.json", to_json(summary))
    return summary, write_figures(figures, directory.out / "plots") if sweep.plots else []


# ---
# Merging directories: the rows of all of them, each once, in a new directory.


def merge_sweeps(
    sources: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    accept_new_code: bool = False,
    watch: Watch = SILENT,
) -> SweepResult:
    """Merge directories of sweeps into a new one; nothing is simulated, and they stay as they are.

    >>> merge_sweeps(["runs/slow", "runs/slow"], "runs/slow")
    Traceback (most recent call last):
    nermo_mjx.specs.reading.SpecError: runs/slow is one of the directories that are merged: choose another one.

    Its sweep lists the variants of all of them as `rows`, with as many repeats as the one that has most. A row that is
    in several is taken from the first. Rows that none has are missing, and `sweep` runs them.

    No code of the directories is run: metrics are known by their names; sweeps of another controller are refused, and
    `run_sweep` takes their rows by `use`.

    Args:
        sources: the directories, two at least.
        out: where the result goes.
        accept_new_code: merge what different code made; the table's column `code` tells the rows apart.
        watch: is told if a part cannot be used.

    Raises:
        SpecError: there are less than two, or the result would go into one of them.
        DirectoryError: they differ in more than their rows, or cannot be read.
        OtherCode: different code made them.
    """
    about = "a list of directories"
    listed = of_type("sources", sources, (list, tuple), about)
    places = [Path(of_type("sources", source, (str, os.PathLike), about)) for source in listed]
    if len(places) < 2:
        raise SpecError("merge takes two directories or more.")
    if Path(out).resolve() in [place.resolve() for place in places]:
        raise SpecError(f"{out} is one of the directories that are merged: choose another one.")
    with only_reading():
        return run_sweep(
            merged(places),
            out,
            use=places,
            simulate=False,
            accept_new_code=accept_new_code,
            watch=watch,
        )


def merged(places: Sequence[Path]) -> Sweep:
    """The sweep whose rows are those of all directories.

    Raises:
        DirectoryError: they differ in more than their rows, or have draws that do not go together.
    """
    sweeps = [sweep_in(place) for place in places]
    for place, sweep in zip(places, sweeps, strict=True):
        if apart := fixed_differences(sweeps[0], sweep):
            raise DirectoryError(f"{places[0]} and {place} cannot be merged: {apart}.")
        alone = set(sweep.varied) ^ set(sweeps[0].varied)
        if alone and any(each.draws or each.bodies for each in sweeps):
            raise DirectoryError(
                f"{places[0]} and {place} cannot be merged: only one of them varies "
                f"{', '.join(sorted(alone))}, on which the draws depend."
            )
    labelled = list(dict.fromkeys(name for sweep in sweeps for name in sweep.labelled))
    varied = list(dict.fromkeys(name for sweep in sweeps for name in sweep.varied))
    rows: dict[str, dict[str, Any]] = {}
    for place, sweep in zip(places, sweeps, strict=True):
        for row in _rows(place, sweep, labelled, varied):
            same = {
                name: f"{value:.12g}" if isinstance(value, float) else value
                for name, value in row.items()
            }
            rows.setdefault(json.dumps(same), row)
    repeats = max(sweep.repeats for sweep in sweeps)
    data = {
        name: value
        for name, value in sweeps[0].resolved().items()
        if name not in ("vary", "sample", "rows", "optimum", *labelled)
    }
    data["set"] = {name: value for name, value in data["set"].items() if name not in varied}
    if "physics" in labelled:
        data.pop("timestep", None)
    data["randomize"]["repeats"] = repeats
    data["plots"] = any(sweep.plots for sweep in sweeps)
    return Sweep.from_dict(data | {"rows": list(rows.values())})


def _rows(
    place: Path, sweep: Sweep, labelled: Sequence[str], varied: Sequence[str]
) -> list[dict[str, Any]]:
    """The variants of a sweep as rows that name all structures and parameters that any of them varies."""
    variants = Sample(sweep).take(np.arange(sweep.variants) * sweep.repeats)
    fixed = []
    for each in sweep.structures:
        whole: dict[str, Any] = {name: each.written(name) for name in labelled}
        for name in varied:
            if name not in sweep.varied and unread(each.setup, name) is None:
                if name not in each.fixed:
                    raise DirectoryError(
                        f"{place} cannot be merged: it neither varies nor sets {name}, which another one varies."
                    )
                whole[name] = each.fixed[name]
        fixed.append(whole)
    own = {name: variants.values[name].tolist() for name in sweep.varied}
    result = []
    for i, at in enumerate(variants.structure.tolist()):
        values = {name: column[i] for name, column in own.items() if column[i] == column[i]}
        values = {
            name: value
            for name, value in (fixed[at] | values).items()
            if name in labelled or value == value
        }
        result.append({name: values[name] for name in (*labelled, *varied) if name in values})
    return result


# ---
# What a sweep would cost: rows, time, disk and memory, before anything runs. Nothing is written.


#: Memory of a process apart from its batch: Python, JAX, MuJoCo, the compiled controller, matplotlib [bytes].
PROCESS_BYTES: Final = 600_000_000
#: A world of the engine c: MuJoCo's data, the controller's state and what the metrics sum up [bytes]. Both as measured.
C_WORLD_BYTES: Final = 100_000
#: Worlds of the measurement.
_WORLDS: Final = 64


def sweep_forecast(
    sweep: Sweep,
    out: str | os.PathLike[str] | None = None,
    *,
    engine: str = "auto",
    chunk: int | None = None,
    shard: tuple[int, int] | None = None,
    extend: bool = False,
    use: Sequence[str | os.PathLike[str]] = (),
    parts: int = 1,
    measure: Callable[[Sweep, str], float] | None = None,
) -> Forecast:
    """What it would cost to run a sweep, or to resume it; see `run_sweep` for the arguments.

    The rate is that of the directory's rows, if it has any; otherwise 64 worlds of the engine `c` are simulated for
    half a second, which takes some seconds in all. For other engines it is then not known, since they compile for
    minutes. The counts are `rows` and `chunks` of the sweep in one go, the `rows_left` to be simulated (the others are
    in the directory, or known from other directories), their `batches`, the `structures` that are compiled, one after
    the other, and physics `steps`.

    Args:
        out: the directory, which need not be there.
        parts: processes that share the chunks.
        measure: replaces the measurement: steps per second of a sweep on an engine.

    Raises:
        DirectoryError, SpecError: the directory holds another sweep, or one named under `use` no rows of such a sweep.
    """
    sources = [Path(each) for each in use]
    for source in sources:
        check_source(source, sweep)
    notes: list[str] = []
    folder = None if out is None else Path(out)
    begun = None
    if folder is not None and (folder / "sweep.yaml").exists():
        begun = Sweep.from_directory(folder)
        if begun.digest() != sweep.digest() and ((why := refusal(begun, sweep)) or not extend):
            hint = why or f"{sweep_differences(begun, sweep)}; --extend would extend it"
            raise WrongDirectory(f"{folder} holds the results of another sweep: {hint}.")
    wanted = (
        engine
        if engine != "auto"
        else (engine_of(folder) if folder is not None else None) or "auto"
    )
    runs = resolve_engine(wanted)
    size = (begun.chunk if begun is not None else None) or chunk or sweep.chunk
    size = size or chunk_rows_here(
        runs, sweep.variants * sweep.repeats, parts * (1 if shard is None else shard[1])
    )
    work = Work(sweep, folder or Path(), size, sources, shard, Watch(warn=notes.append))
    unfinished = work.unfinished
    left = np.setdiff1d(
        unfinished, np.concatenate([np.empty(0, int), *(index for index, _ in work.known())])
    )
    left = unfinished[np.isin(unfinished, left)]
    batches = work.batches(left, len(unfinished) - len(left))
    # Each batch lasts as long as its longest row, in all of its worlds.
    seconds = np.array([batch.worlds * float(work.seconds[batch.rows].max()) for batch in batches])
    steps = float(
        sum(
            seconds / [float(sweep.structures[batch.structure].setup.timestep) for batch in batches]
        )
    )
    if sweep.optimum is not None:  # rows beyond the sweep's own last as long as those do on average
        known = varied_values(sweep)
        groups = math.prod(len(known[name] or ()) for name in sweep.optimum.grouped(known))
        more = groups * (sweep.optimum.budget + 2 * sweep.optimum.fresh)
        more = max(more - int((work.runs.numbers >= len(work.rows)).sum()), 0)
        steps += more * float(work.seconds.mean()) / float(sweep.setup.timestep)
        notes.append(f"The optimum takes up to {more:,} further runs, which the time contains.")
    rate, rate_from = math.nan, "not needed: nothing is left to be simulated"
    there = [
        part
        for part in (*work.runs.parts, *work.runs.others)
        if folder is not None and part.directory == folder
    ]
    done = np.array(
        [(part.steps, part.seconds) for part in there if part.engine == runs and part.seconds > 0]
    )
    if len(done):
        rate = float(done[:, 0].sum() / done[:, 1].sum())
        rate_from = f"{rate:,.0f} steps/s, measured: {len(done):,} chunks of the directory"
    elif steps and runs == "c":
        setup = sweep.setup
        rate = (
            measure(sweep, runs)
            if measure
            else pace(Simulator(setup, runs), setup, _WORLDS) / setup.timestep
        )
        rate_from = f"{rate:,.0f} steps/s, measured now: {_WORLDS} worlds for {PROBE:g} simulated s"
    elif steps:
        rate_from = f"not known: no chunk of the engine {runs} has been measured in the directory"
    if there:  # as much per row as those take
        disk = math.ceil(
            len(left)
            * sum(part.path.stat().st_size for part in there)
            / sum(part.rows for part in there)
        )
    else:  # as in a batch of noise
        index, rng = np.arange(min(size, len(work.rows))), np.random.default_rng(0)
        metrics = {name: rng.random(len(index)) for name in METRICS}
        some = work.rows.take(index)
        table = chunk_table(
            sweep, some, index, metrics, np.full(len(index), "ok"), "00000000", {"engine": "c"}
        )
        key = pa.array(keys_of_rows(sweep, some).astype(str))
        disk = math.ceil(
            len(left) * len(parquet_bytes(table.append_column("key", key))) / len(index)
        )
    above = (folder or Path.cwd()).absolute()
    free = shutil.disk_usage(next(each for each in (above, *above.parents) if each.is_dir())).free
    notes.append(
        f"{'There is no room for it: ' if disk > free else ''}{free / 1e9:,.1f} GB are free."
    )
    worlds = max((batch.worlds for batch in batches), default=0)
    points = 0 if sweep.sampler in ("grid", "rows") else sweep.variants * len(sweep.axes) * 8
    summary = min(len(work.rows) * 8 * (len(METRICS) + len(sweep.axes)), HELD * 8) * 2
    memory = (
        PROCESS_BYTES
        + worlds * C_WORLD_BYTES * (runs == "c")
        + len(work.rows) * 24
        + points
        + summary
    )
    notes.append(f"The process takes about {memory / 1e9:.1f} GB of memory.")
    if runs != "c" and worlds:
        notes.append(
            f"The batch of {worlds:,} worlds takes about {worlds * WORLD_BYTES[runs] / 1e9:.2g} GB of the devices' "
            "memory, besides."
        )
    counts = {
        "rows": len(work.rows),
        "rows_left": len(left),
        "chunks": len(work.layout),
        "batches": len(batches),
    }
    counts |= {"structures": len({batch.structure for batch in batches}), "steps": round(steps)}
    wall = steps / rate if rate > 0 else math.nan if steps else 0.0
    return Forecast(runs, counts, float(seconds.sum()), wall, rate_from, disk, notes=tuple(notes))
