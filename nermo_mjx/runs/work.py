"""The rows that a job asks for: which of them are there, and which are simulated, in batches of equal size.

A job says what its rows are (`RowJob`). `Work` finds them in the job's directory, in other directories and in former
parts, and `finish` has those that are missing simulated, of one job or of several at once.
"""

from __future__ import annotations

import collections
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import pyarrow as pa

from nermo_mjx.runs.code import CodeStamp, session
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.runs.files import DirectoryError, parquet_table
from nermo_mjx.runs.job import SILENT, Progress, Watch
from nermo_mjx.runs.rows import Runs
from nermo_mjx.runs.workers import Computer, TaskFailed, Workers

#: Rows that are taken from other directories at once, if they have no time series.
_COPIED_ROWS: Final = 65_536
#: How often rows are simulated again that are damaged each time they are read back.
MAX_READ_ATTEMPTS: Final = 2


class RowBatch(NamedTuple):
    """Rows that are simulated together (n,), all of one structure, in so many worlds, n or more."""

    structure: int
    rows: np.ndarray
    worlds: int


class RowComputer(Computer, Protocol):
    """Simulates the batches of a job."""

    @property
    def engine(self) -> str:
        """Its name."""
        ...

    def stamp(self, structure: int = 0) -> CodeStamp:
        """Stamp of the code, a structure's model and the engine that simulate here."""
        ...


class RowJob:
    """What a job knows of its rows, which have numbers from 0 on; further rows have the numbers after these.

    Further rows and rows of other jobs are for jobs that have them.

    Attributes:
        group: digest of the job, see `nermo_mjx.runs.rows`; hexadecimal.
        command: of the command line, which runs missing rows.
        label: what is at work, in reports of progress; empty: the job itself, whose rows are counted.
        structures: place of the structure of each row, (rows,) int; rows of one batch share it.
        seconds: how long each row is simulated, (rows,) [s].
        with_series: whether the rows have time series.
        several_models: whether structures differ in their models.
    """

    group: str
    command: str
    label: str = ""
    structures: np.ndarray
    seconds: np.ndarray
    with_series: bool = False
    several_models: bool = False

    def further(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Structures and seconds of further rows, by their numbers, (n,) each."""
        raise NotImplementedError

    def keys(self, index: np.ndarray) -> np.ndarray:
        """Keys of rows by their numbers, (n,) of 32 bytes."""
        raise NotImplementedError

    def task(self, batch: RowBatch) -> Any:
        """What the computer gets for a batch."""
        raise NotImplementedError

    def tables(
        self, index: np.ndarray, result: Any, stamp: CodeStamp
    ) -> tuple[pa.Table, pa.Table | None]:
        """The table of simulated rows, by their numbers, and that of their time series."""
        raise NotImplementedError

    def adopted(
        self, index: np.ndarray, table: pa.Table, series: Iterable[pa.Table]
    ) -> tuple[pa.Table, pa.Table | None]:
        """The same of rows that another job has made, as its table has them."""
        raise NotImplementedError

    def failure(self, index: np.ndarray, error: BaseException, out: Path) -> Exception:
        """What is raised where rows cannot be simulated."""
        raise NotImplementedError


class Work:
    """The rows of a job, as far as one process cares for them.

    Args:
        job: whose rows.
        out: the directory, which need not be there.
        size: rows of a batch, at most.
        sources: directories of other jobs whose rows are reused.
        shard: (i, n): this process simulates every n-th batch, from i.
        watch: is told the progress of this process's share, and of damaged files.
        held: the directory as this process holds it; without it nothing is written.
        log: gets the table of each batch, and the physics steps per second, None for those of earlier sessions.

    Attributes:
        seconds: how long each row is simulated, (rows,) [s].
        layout: the rows of each batch, if the whole job is simulated in one go.
        runs: the store that has them, or not.
        simulated, reused: batches that this process has simulated, and rows that it has taken from elsewhere.
    """

    def __init__(
        self,
        job: RowJob,
        out: Path,
        size: int,
        sources: Sequence[Path] = (),
        shard: tuple[int, int] | None = None,
        watch: Watch = SILENT,
        directory: RunDirectory | None = None,
        log: Callable[[pa.Table, float | None], None] | None = None,
    ) -> None:
        self.job, self.out, self._size, self._watch, self._log = job, out, size, watch, log
        self._structure, self.seconds = job.structures, job.seconds
        # Rows of one batch share structure and duration; batches are of equal size, to one row.
        order, self.layout = np.argsort(self.seconds, kind="stable"), list[np.ndarray]()
        for structure in np.unique(self._structure):
            alike = order[self._structure[order] == structure]
            self.layout += np.array_split(alike, math.ceil(len(alike) / size))
        self._shard = shard or (0, 1)
        self._share = np.concatenate(
            self.layout[self._shard[0] :: self._shard[1]] or [np.empty(0, int)]
        )
        self.runs = Runs(out, job.group, sources, watch.warn, job.with_series, directory)
        if log is not None:
            for table in (parquet_table(part.path) for part in self.runs.parts):
                if table is not None and np.isin(table["row"].to_numpy(), self._share).any():
                    log(table, None)
        self._resumed, self.simulated, self.reused = len(self._share) - len(self.unfinished), 0, 0
        self._finished, self._left, self._further = 0, 0.0, np.empty(0, int)
        self._stamps: dict[int, CodeStamp] = {}

    @property
    def done(self) -> np.ndarray:
        """Which rows of the job are there, (rows,) bool."""
        return self._there[: len(self.job.seconds)]

    @property
    def _there(self) -> np.ndarray:
        """The same of all numbers up to that of the last further row."""
        is_there, numbers = np.zeros(len(self.seconds), bool), self.runs.row_numbers
        is_there[numbers[numbers < len(is_there)]] = True
        return is_there

    def add_further(self, index: np.ndarray) -> None:
        """Make this process care for further rows, by their numbers, (n,)."""
        self._further = np.union1d(self._further, index)
        size, row_count = int(self._further[-1]) + 1, len(self.job.seconds)
        self._structure, self.seconds = (
            np.resize(column[:row_count], size) for column in (self._structure, self.seconds)
        )
        self._structure[self._further], self.seconds[self._further] = self.job.further(
            self._further
        )
        self._share = np.concatenate([self._share[self._share < row_count], self._further])

    @property
    def count(self) -> tuple[int, int]:
        """How many rows are there, and are to be there: the job's and further ones."""
        done = int(self.done.sum() + self._there[self._further].sum())
        return done, len(self.job.seconds) + len(self._further)

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
        is_done, (own_shard, shards) = self.done, self._shard
        if is_done.all():
            return ""
        lacking = {k % shards for k, rows in enumerate(self.layout) if not is_done[rows].all()}
        shares = " and ".join(
            f"--shard {shard}/{shards}" for shard in sorted(lacking - {own_shard})
        )
        advice = f"with {shares}" if shares else f"by the command {self.job.command}"
        return f"{(~is_done).sum():,} of {len(is_done):,} runs are missing; unless they are being run, run them {advice}."

    def known(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Unfinished rows that are in other directories or in former parts, some at a time (n,), and where (n,)."""
        unfinished = self.unfinished if self.runs.other_parts else np.empty(0, int)
        at_once = len(self.layout[0]) if self.job.with_series else _COPIED_ROWS
        for start in range(0, len(unfinished), at_once):
            index = unfinished[start : start + at_once]
            places = self.runs.find(self.job.keys(index))
            if (places >= 0).any():
                yield index[places >= 0], places[places >= 0]

    def batches(self, rows: np.ndarray, reused: int = 0) -> list[RowBatch]:
        """The batches for some rows, of few shapes, so that no engine compiles again.

        Args:
            rows: (n,), as `unfinished` orders them.
            reused: how many rows of the job are not simulated at all; then there may be few others.
        """
        batch_sizes = dict[int, int]()
        for members in self.layout:
            structure = int(self._structure[members[0]])
            batch_sizes[structure] = max(batch_sizes.get(structure, 0), len(members))
        batches = []
        for structure in np.unique(self._structure[rows]).tolist():
            structure_rows = rows[self._structure[rows] == structure]
            split = np.array_split(
                structure_rows,
                math.ceil(len(structure_rows) / (self._size if reused else batch_sizes[structure])),
            )
            worlds = len(split[0]) if reused else batch_sizes[structure]
            batches += [RowBatch(structure, index, worlds) for index in split]
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
            series = self.runs.series(places) if self.job.with_series else ()
            self._add(index, *self.job.adopted(index, self.runs.take(places), series))
            self.reused += len(index)

    def start(self, engine: str) -> list[RowBatch]:
        """The batches of what is unfinished."""
        unfinished = self.unfinished
        self._finished = len(self._share) - len(unfinished)
        self._left = float(self.seconds[unfinished].sum())
        self.tell()
        # On the engine c nothing is compiled, and the few further rows fill no batch.
        return self.batches(unfinished, self.reused or (engine == "c" and len(self._further)))

    def take_codes(
        self, computer: RowComputer, batches: Sequence[RowBatch], accept_new_code: bool
    ) -> None:
        """Record which code is about to simulate batches, and this session.

        Raises:
            OtherCode: other code made the rows that are there.
        """
        places = dict.fromkeys(batch.structure for batch in batches)
        self._stamps = {structure: computer.stamp(structure) for structure in places}
        several = bool(self.runs.other_parts) or self.job.several_models
        self.runs.take_codes(list(self._stamps.values()), accept=accept_new_code, any_model=several)
        first, directory = next(iter(self._stamps.values())), self.runs.directory
        assert directory is not None
        shard = "" if directory.shard is None else "{}/{}".format(*directory.shard)
        directory.note_session(
            session(engine=computer.engine, code=first.id, shard=shard, chunks=len(batches))
        )

    def tell(self, batch: RowBatch | None = None, share: float = 0.0) -> None:
        """Report the progress, with the share of a batch at work that is done."""
        current = 0.0
        if batch is not None:
            current = self.seconds[batch.rows].sum() * min(max(float(share), 0.0), 1.0)
        whole, count = float(self.seconds[self._share].sum()), len(self._share)
        fraction = 1.0 if self._finished == count else 1.0 - (self._left - current) / whole
        if self.job.label:
            self._watch.progress(Progress(fraction, what=self.job.label))
        else:
            resumed = self._resumed + self.reused
            self._watch.progress(Progress(fraction, self._finished, count, resumed))

    def pass_batch(self, batch: RowBatch) -> None:
        """Count a batch as simulated."""
        self.simulated += 1
        self._finished += len(batch.rows)
        self._left -= float(self.seconds[batch.rows].sum())
        self.tell()

    def write(self, batch: RowBatch, result: Any) -> None:
        """Store the rows of a batch.

        Raises:
            DirectoryError: they cannot be written.
        """
        table, series = self.job.tables(batch.rows, result, self._stamps[batch.structure])
        self._add(batch.rows, table, series)
        if self._log is not None:
            metadata = table.schema.metadata
            steps, seconds = (float(metadata[name]) for name in (b"steps", b"wall_seconds"))
            self._log(table, steps / seconds if seconds else math.nan)

    def _add(self, index: np.ndarray, table: pa.Table, series: pa.Table | None) -> None:
        self.runs.add(self.job.keys(index), table, series)


def finish(
    works: Sequence[Work], computer: RowComputer, workers: Workers, accept_new_code: bool
) -> Iterator[Work]:
    """Simulate what is missing, and once more what was damaged on its way to the disk; gives each job when it is done.

    Raises:
        OtherCode: other code made the rows that are there.
        DirectoryError: a batch cannot be written.
        WorkersLost: no worker is left.
        Exception: rows cannot be simulated, see `RowJob.failure`.
    """
    for _ in range(MAX_READ_ATTEMPTS):
        for work in _simulated(works, computer, workers, accept_new_code):
            work.runs.survey()
            if not len(work.unfinished):
                yield work
        works = [work for work in works if len(work.unfinished)]
        if not works:
            return
    raise DirectoryError(
        f"{works[0].out} loses what is written to it: it is damaged again and again."
    )


def _simulated(
    works: Sequence[Work], computer: RowComputer, workers: Workers, accept_new_code: bool
) -> Iterator[Work]:
    """Simulate what is unfinished, and give each job whose last batch is written.

    A batch is written while the next one is simulated.
    """
    batches = {work: work.start(computer.engine) for work in works}
    queue = [(work, batch) for work, own_batches in batches.items() for batch in own_batches]
    if not queue:
        return
    workers.begin(computer)
    for work, own_batches in batches.items():
        if own_batches:
            work.take_codes(computer, own_batches, accept_new_code)
    remaining = collections.Counter(work for work, _ in queue)

    def tasks() -> Iterator[tuple[int, Any]]:
        for number, (work, batch) in enumerate(queue):
            yield number, work.job.task(batch)

    def tell(number: int, share: float) -> None:
        work, batch = queue[number]
        work.tell(batch, share)

    try:
        with ThreadPoolExecutor(1, "row-writer") as writer:
            former: Future[None] | None = None
            for number, result in workers.results(tasks(), tell):
                work, batch = queue[number]
                latest = writer.submit(work.write, batch, result)
                work.pass_batch(batch)
                if former is not None:
                    former.result()
                former = latest
                remaining[work] -= 1
                if not remaining[work]:
                    latest.result()
                    yield work
            if former is not None:
                former.result()
    except TaskFailed as failed:
        work, batch = queue[failed.key]
        error = work.job.failure(batch.rows, failed.error, work.out)
        raise error from (None if error is failed.error else failed.error)
