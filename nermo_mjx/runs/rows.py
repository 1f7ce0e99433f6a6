"""The store of finished runs: `Runs` finds a run by its key, in a folder of Parquet files to which any process may add.

A run is a row of a table. Its key is the hash of everything that determines its result (`keys_of`). A part is one
Parquet file with the runs that were stored together. A job asks the store for keys, and simulates the runs that are
missing; the store does not depend on how the job came to need them (resumed, extended, sharded or merged).

DIR/results/part-GROUP-DIGEST.parquet   runs, with their keys in the column `key`; DIGEST is the digest of the content
DIR/series/part-GROUP-DIGEST.parquet    their time series, if the job saves any; the metadata of the part of the runs
                                        contains the name of this file
DIR/former/                             results/ and series/ of other jobs, such as a sweep before it was extended
DIR/results.aside/, series.aside/       damaged parts, and the time series that belonged to them

GROUP is the digest of the job that wrote a part. The column `row` contains the row number of a run in that job. If the
same job runs again, it uses its parts as they are. Another job finds the runs by their keys, and stores them again
with its own row numbers.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from nermo_mjx.files import MAX_FILE_BYTES, read_bytes
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import OtherCode, RunDirectory, codes_of, digest
from nermo_mjx.runs.files import (
    DirectoryError,
    clear_errors,
    parquet_bytes,
    parquet_file,
    parquet_table,
    sync_folder,
)
from nermo_mjx.trust import one_line

RESULTS, SERIES, FORMER = "results", "series", "former"
#: Number of part tables in the cache: the runs of consecutive requests are usually in a few parts.
_MAX_CACHED_TABLES: Final = 32
#: Number of arrays of row numbers above which they are joined: one array uses less memory than many small ones.
_MAX_SEPARATE_ARRAYS: Final = 32
#: Name of a part: its group and its digest.
_PART_NAME: Final = re.compile(r"part-([0-9a-f]+)-([0-9a-f]{16})\.parquet")
Warn = Callable[[str], None]


def keys_of(identity: str, values: Mapping[str, np.ndarray], runs: int) -> np.ndarray:
    """The keys of runs, (runs,) of 32 bytes; two runs have the same key if their identity and all values are equal.

    >>> keys_of("c", {"a": np.array([0.0, -0.0, 1.0])}, 3)[:2].tolist() == [keys_of("c", {"a": np.zeros(1)}, 1)[0]] * 2
    True

    Args:
        identity: Text that is equal for all of these runs: structure and length, and also code or engine if they matter.
        values: Values that differ between the runs, name -> (runs,) floats, in any order; NaN if a run has no such value.
        runs: Number of runs.
    """
    names, keys = sorted(values), np.empty(runs, "S32")
    identity_hash = hashlib.blake2b(identity.encode(), digest_size=16)
    # Adding 0.0 turns -0.0 into 0.0.
    columns = [(np.asarray(values[name], float) + 0.0).tolist() for name in names]
    for i in range(runs):
        run_hash = identity_hash.copy()
        lines = (
            f"{name} {column[i]!r}"
            for name, column in zip(names, columns, strict=True)
            if not math.isnan(column[i])
        )
        run_hash.update("\n".join(lines).encode())
        keys[i] = run_hash.hexdigest().encode()
    return keys


@dataclasses.dataclass(frozen=True, slots=True)
class PartFile:
    """A part: where its file is, and the contents of its metadata. It is small, because a job may have ten thousand.

    Attributes:
        folder, name: Folder and name of the file.
        rows: Number of runs in it.
        engine: Engine that simulated them.
        steps: Number of physics steps of all its runs.
        seconds: Time that the simulation took [s].
        series_name: Name of the file with the time series of the runs; empty if they have none.
    """

    folder: Path
    name: str
    rows: int
    engine: str
    steps: float
    seconds: float
    series_name: str

    @classmethod
    def of(cls, path: Path, rows: int, metadata: Mapping[bytes, bytes]) -> PartFile:
        """The part at `path` with a number of rows and the metadata of its file."""
        part_metadata = {
            key: metadata.get(key, b"").decode()
            for key in (b"engine", b"steps", b"wall_seconds", b"series")
        }
        engine, steps, seconds, series = part_metadata.values()
        effort = float(steps or 0), float(seconds or 0)
        return cls(_shared(path.parent), path.name, rows, sys.intern(engine), *effort, series)

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self.folder / self.name

    @property
    def group(self) -> str:
        """Digest of the job that wrote the part."""
        return self.name.split("-")[1]

    @property
    def directory(self) -> Path:
        """The run directory that contains the part, DIR above."""
        return (
            self.folder.parent.parent if self.folder.parent.name == FORMER else self.folder.parent
        )

    @property
    def series(self) -> Path | None:
        """The file with the time series of the runs, None if they have none.

        The file is usually next to the part. If a process was killed between moving the one and the other, it is in
        another folder.
        """
        if not self.series_name:
            return None
        folders = (
            self.folder.parent / SERIES,
            self.directory / FORMER / SERIES,
            self.directory / SERIES,
        )
        candidates = (folder / self.series_name for folder in folders)
        return next((path for path in candidates if path.exists()), folders[0] / self.series_name)


@functools.lru_cache
def _shared(folder: Path) -> Path:
    """The same object for equal folders, so that thousands of parts share the memory of one path."""
    return folder


class _Index(NamedTuple):
    """The keys of all runs, and where each run is stored.

    Attributes:
        keys: Keys in ascending order, (n,) of 32 bytes.
        locations: Index of the part in `parts`, and index of the run in the table of this part, (n, 2).
        parts: The parts.
    """

    keys: np.ndarray
    locations: np.ndarray
    parts: list[PartFile]


class Runs:
    """The runs of a job in a run directory, and runs of other jobs that it may reuse.

    Args:
        out: The run directory.
        group: Hexadecimal digest of the job, see GROUP above.
        sources: Other run directories, which are only read. If several contain a run, the first one is used;
            `out` comes before all of them.
        warn: Function that receives a message about each part that cannot be used.
        series: Whether a run counts as missing if its time series are missing or damaged.
        directory: The locked run directory; None if this process only reads.

    Attributes:
        directory: See above.
        parts: The intact parts of this job.
        other_parts: The intact parts of other jobs, in `out` and in `sources`.

    Raises:
        DirectoryError: A folder cannot be read.
    """

    def __init__(
        self,
        out: Path,
        group: str,
        sources: Sequence[Path] = (),
        warn: Warn | None = None,
        series: bool = False,
        directory: RunDirectory | None = None,
    ) -> None:
        self.out, self.group, self.directory, self._sources = out, group, directory, tuple(sources)
        self._warn, self._needs_series = warn or (lambda _: None), series
        if directory is not None:
            with clear_errors(out):
                (out / RESULTS).mkdir(exist_ok=True)
                for folder in (SERIES, RESULTS):
                    _move(
                        out / FORMER / folder, out / folder, lambda file_group: file_group == group
                    )
        self.other_parts = [
            part
            for source in (out, *self._sources)
            for part in self._intact_parts(source, of_this_job=False)
        ]
        self.survey()

    def survey(self) -> None:
        """Read all parts of this job again, and compare their contents with their digests.

        A damaged part is moved to `results.aside`, and its runs count as missing.
        """
        self._row_numbers: list[np.ndarray] = []
        self.parts = self._intact_parts(self.out, of_this_job=True)
        if self.directory is not None and self.directory.shard is None:
            series_names = {part.series_name for part in self.parts}
            for path in part_files(self.out, self.group, SERIES):
                # The part with the runs of other time series was damaged, or was never written.
                if path.name not in series_names:
                    self.directory.move_aside(path.relative_to(self.out), f"{SERIES}.aside")
        self.__dict__.pop("_index", None)
        self._table.cache_clear()

    def _intact_parts(self, out: Path, of_this_job: bool) -> list[PartFile]:
        """The intact parts of a run directory, either of this job or of all other jobs; damaged ones are moved aside."""
        parts = []
        with clear_errors(out):
            for path in (*part_files(out), *part_files(out / FORMER)):
                if (out == self.out and path.name.split("-")[1] == self.group) != of_this_job:
                    continue
                content, flaw = _content_or_flaw(path)
                if content is not None:
                    with parquet_file(pa.BufferReader(content)) as file:
                        part = PartFile.of(
                            path, file.metadata.num_rows, file.metadata.metadata or {}
                        )
                        row = file.read(["row"])["row"]
                        flaw = "has rows without a number" if row.null_count else ""
                        row_numbers = row.to_numpy() if of_this_job and not flaw else None
                    if (
                        not flaw
                        and self._needs_series
                        and (part.series is None or _content_or_flaw(part.series)[0] is None)
                    ):
                        flaw = "has no time series, or damaged ones"
                if not flaw:
                    parts.append(part)
                    if row_numbers is not None:
                        self._add_row_numbers(row_numbers)
                elif self.directory is None or path.parent != self.out / RESULTS:
                    self._warn(f"{path} {flaw}; its runs are not used.")
                elif (
                    self.directory.move_aside(path.relative_to(out), f"{RESULTS}.aside") is not None
                ):
                    self._warn(
                        f"{path} {flaw}; it is kept in {RESULTS}.aside, and its runs are made again."
                    )
        return parts

    @property
    def row_numbers(self) -> np.ndarray:
        """Row numbers of the runs of this job that are stored, (n,), as in the column `row`."""
        self._row_numbers = [np.concatenate([np.empty(0, np.int32), *self._row_numbers])]
        return self._row_numbers[0]

    def _add_row_numbers(self, row_numbers: np.ndarray) -> None:
        self._row_numbers.append(row_numbers.astype(np.int32))
        if len(self._row_numbers) > _MAX_SEPARATE_ARRAYS:
            _ = self.row_numbers  # joins the arrays

    def find(self, keys: np.ndarray) -> np.ndarray:
        """Positions of runs in the index, (n,) int, for `take` and `series`; -1 for runs that are not stored."""
        index_keys = self._index.keys
        if not len(index_keys):
            return np.full(len(keys), -1)
        positions = np.minimum(np.searchsorted(index_keys, keys), len(index_keys) - 1)
        return np.where(index_keys[positions] == keys, positions, -1)

    def take(self, positions: np.ndarray) -> pa.Table:
        """The stored runs at positions from `find`, in this order.

        Returns:
            All columns of their parts, including `key`; a cell is null if the part of its run lacks the column. The
            metadata contains the `engine` of the first run, and `steps` and `wall_seconds` in proportion to the
            number of runs taken from each part.
        """
        part_indices, rows = self._index.locations[positions].T
        steps = seconds = 0.0
        tables, order = [], []
        for part_index in np.unique(part_indices).tolist():
            requests, part = (
                np.flatnonzero(part_indices == part_index),
                self._index.parts[part_index],
            )
            steps += part.steps * len(requests) / part.rows
            seconds += part.seconds * len(requests) / part.rows
            tables.append(self._table(part.path).take(rows[requests]).replace_schema_metadata(None))
            order.append(requests)
        table = pa.concat_tables(tables, promote_options="default").take(
            np.argsort(np.concatenate(order))
        )
        engine = self._index.parts[int(part_indices[0])].engine
        return table.replace_schema_metadata(
            {"engine": engine, "steps": str(steps), "wall_seconds": str(seconds)}
        )

    def series(self, positions: np.ndarray) -> Iterator[pa.Table]:
        """The time series of each run; its column `row` contains the row number in the job that simulated the run."""
        for part_index, row in self._index.locations[positions].tolist():
            part = self._index.parts[part_index]
            assert part.series is not None
            row_number = self._table(part.path).column("row")[row].as_py()
            yield self._table(part.series).filter(
                pc.equal(self._table(part.series).column("row"), row_number)
            )

    def add(self, keys: np.ndarray, table: pa.Table, series: pa.Table | None = None) -> PartFile:
        """Store runs, atomically and durably: other processes see all of them, with their time series, or none.

        Args:
            keys: Keys of the runs, (n,) of 32 bytes.
            table: Table of n rows; its metadata contains `engine`, `steps` and `wall_seconds`.
            series: Table of time series with a row for each sample; its column `row` is that of `table`.

        Raises:
            DirectoryError: The files cannot be written.
        """
        metadata = dict(table.schema.metadata or {})
        if series is not None:
            metadata[b"series"] = self._write(SERIES, series).name.encode()
        column = pa.field(
            "key",
            pa.string(),
            metadata={"unit": "1", "description": "what decides it", "role": "key"},
        )
        table = table.append_column(column, pa.array(keys.astype(str))).replace_schema_metadata(
            metadata
        )
        part = PartFile.of(self._write(RESULTS, table), table.num_rows, metadata)
        self._add_row_numbers(table["row"].to_numpy())
        self.parts.append(part)
        return part

    def take_codes(
        self, stamps: Sequence[CodeStamp], *, accept: bool, any_model: bool = False
    ) -> None:
        """Record the codes whose runs are about to be added; see `RunDirectory.take_code`, also for the arguments.

        Parts of other jobs are then moved to `former`, because a table is read from all files in `results`.

        Raises:
            OtherCode: Another code made the runs that are stored.
        """
        assert self.directory is not None
        has_rows = any(
            part.path.is_relative_to(self.out) for part in (*self.parts, *self.other_parts)
        )
        for stamp in stamps:
            self.directory.take_code(stamp, holds_rows=has_rows, accept=accept, any_model=any_model)
            has_rows = True
        if retire(self.directory, self.group):
            self._warn(
                f"{self.out} has parts of another job, or made with other defaults: now in {FORMER}."
            )

        def moved(part: PartFile) -> PartFile:
            was_moved = part.group != self.group and part.folder == self.out / RESULTS
            return (
                dataclasses.replace(part, folder=self.out / FORMER / RESULTS) if was_moved else part
            )

        self.other_parts = [moved(part) for part in self.other_parts]
        if "_index" in self.__dict__:
            self._index = self._index._replace(parts=[moved(part) for part in self._index.parts])

    def codes(self, *, accept: bool) -> list[CodeStamp]:
        """The codes that made the runs of other jobs, as recorded in their directories.

        Raises:
            OtherCode: A directory has no record of its code, and `accept` is false.
        """
        stamps: dict[str, CodeStamp] = {}
        for out in dict.fromkeys(part.directory for part in self.other_parts):
            codes = codes_of(out)
            if not codes and not accept:
                raise OtherCode(
                    f"{out} does not say which code made it: its runs are used with --accept-new-code; distinguish "
                    "them by their column code."
                )
            stamps |= codes
        return list(stamps.values())

    def _write(self, folder: str, table: pa.Table) -> Path:
        """Write a table as a part into `results` or `series`; the path of its file."""
        assert self.directory is not None
        content = parquet_bytes(table)
        path = self.out / folder / f"part-{self.group}-{digest(content)}.parquet"
        self.directory.write(path.relative_to(self.out), content)
        return path

    @functools.cached_property
    def _index(self) -> _Index:
        """The index of all runs that were stored when it was first used after a survey."""
        parts = [*self.parts, *self.other_parts]
        keys, locations = [np.empty(0, "S32")], [np.empty((0, 2), np.int64)]
        for part_index, part in enumerate(parts):
            with opened_part(part.path) as file:
                file_keys = file.read(["key"])["key"].to_numpy(zero_copy_only=False).astype("S32")
            keys.append(file_keys)
            locations.append(
                np.column_stack([np.full(len(file_keys), part_index), np.arange(len(file_keys))])
            )
        unique, first = np.unique(np.concatenate(keys), return_index=True)
        return _Index(unique, np.concatenate(locations)[first], parts)

    @functools.lru_cache(_MAX_CACHED_TABLES)  # noqa: B019 - the store lives as long as the job
    def _table(self, path: Path) -> pa.Table:
        """The table in a part's file."""
        table = parquet_table(path)
        if table is None:
            raise DirectoryError(f"{path} cannot be read any more: run the same command again.")
        return table


def part_files(out: Path, group: str = "*", folder: str = RESULTS) -> list[Path]:
    """The part files of one job or of all jobs in a run directory, sorted by name; their contents are not checked."""
    return sorted(
        path
        for path in out.glob(f"{folder}/part-{group}-*.parquet")
        if _PART_NAME.fullmatch(path.name)
    )


@contextlib.contextmanager
def opened_part(path: Path) -> Iterator[pq.ParquetFile]:
    """The open file of a part, whose pages are checked as they are read.

    Raises:
        DirectoryError: The file cannot be read, now or inside of the `with` statement.
    """
    try:
        with parquet_file(path, pre_buffer=False) as file:
            yield file
    except (OSError, pa.ArrowException, ValueError, KeyError) as error:
        reason = one_line(str(error).strip())
        raise DirectoryError(
            f"{path} cannot be read ({reason}): run the same command again."
        ) from None


def retire(directory: RunDirectory, group: str) -> int:
    """Move the parts of other jobs to `former`; when such a job runs again, `Runs` moves its parts back.

    Returns:
        Number of parts with runs that were moved.
    """
    with clear_errors(directory.out):
        return [
            _move(
                directory.out / folder,
                directory.out / FORMER / folder,
                lambda file_group: file_group != group,
            )
            for folder in (SERIES, RESULTS)
        ][1]


def _move(source: Path, target: Path, is_selected: Callable[[str], bool]) -> int:
    """Move the parts of the selected groups, and count them; another process may move the same files meanwhile."""
    files = [path for path in source.glob("part-*.parquet") if is_selected(path.name.split("-")[1])]
    for path in files:
        target.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            path.rename(target / path.name)
    for folder in (source, target) if files else ():
        sync_folder(folder)
    return len(files)


def _content_or_flaw(path: Path) -> tuple[bytes | None, str]:
    """The content of a part and an empty text, or None and a text about the fault of the file."""
    try:
        content = read_bytes(path, MAX_FILE_BYTES)
    except OSError as error:
        return None, f"cannot be read ({error.strerror})"
    match = _PART_NAME.fullmatch(path.name)
    return (
        (content, "") if match is not None and digest(content) == match[2] else (None, "is damaged")
    )


# ---
# Building the table of a part.


class Columns:
    """Collects the columns of a table; the metadata of each column contains its unit, description and role."""

    def __init__(self) -> None:
        self._arrays: dict[str, pa.Array] = {}
        self._fields: list[pa.Field] = []

    def add(
        self,
        name: str,
        values: np.ndarray,
        role: str,
        unit: str,
        description: str,
        *,
        nulls: bool = False,
        **additional: str | None,
    ) -> None:
        """Add a column of (n,) values.

        Args:
            name, values: Name and values of the column.
            role, unit, description: Entries of the metadata of the column; a role is for example `metric` or `index`.
            nulls: Whether a NaN is stored as null.
            additional: Additional entries of the metadata; None or an empty text adds none.
        """
        values = np.asarray(values)
        if values.dtype.kind in "fiu":
            values = values.astype(np.float64 if values.dtype.kind == "f" else np.int64)
        self._arrays[name] = pa.array(
            values.tolist() if values.dtype.kind in "OU" else values, from_pandas=nulls
        )
        metadata = {"unit": unit, "description": description, "role": role}
        metadata |= {key: text for key, text in additional.items() if text}
        self._fields.append(pa.field(name, self._arrays[name].type, metadata=metadata))

    def table(self, table_metadata: Mapping[str, Any]) -> pa.Table:
        """The table of these columns with `table_metadata` as the metadata of its schema."""
        metadata = {key: str(value) for key, value in table_metadata.items()}
        return pa.table(self._arrays, schema=pa.schema(self._fields, metadata=metadata))
