"""Runs that were made, each found by what it is: a folder of Parquet parts, of which any process may add one.

A run has a key, the hash of all that decides it (`keys_of`). What asks for runs is of no concern here: a job that is
resumed, extended, sharded or merged asks for keys, and has those that are missing simulated.

DIR/results/part-GROUP-DIGEST.parquet   runs, their keys in the column `key`; the name has the digest of the content
DIR/series/part-GROUP-DIGEST.parquet    their time series, if any are kept; the metadata of the runs' part names it
DIR/former/                             results/ and series/ of other jobs, such as a sweep before it was extended
DIR/results.aside/, series.aside/       parts that were damaged, and what belonged to them

GROUP is the digest of the job that wrote a part. Columns such as `row` are numbered by that job: the rows of an equal
job are taken as they are, those of any other are found by their keys, and written again under its own numbers.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
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
#: Tables of parts that are held at once: the runs that are wanted next lie in a few of them.
_MAX_HELD_TABLES: Final = 32
_NAME: Final = re.compile(r"part-([0-9a-f]+)-([0-9a-f]{16})\.parquet")
Warn = Callable[[str], None]


def keys_of(identity: str, values: Mapping[str, np.ndarray], runs: int) -> np.ndarray:
    """The keys of runs, (runs,) of 32 bytes: equal where the identity and all values are.

    >>> keys_of("c", {"a": np.array([0.0, -0.0, 1.0])}, 3)[:2].tolist() == [keys_of("c", {"a": np.zeros(1)}, 1)[0]] * 2
    True

    Args:
        identity: all that decides them alike, as text: structure, length, code or engine where these count.
        values: what else does, name -> (runs,) floats, in any order; a NaN is a value that the run does not have.
    """
    names, keys = sorted(values), np.empty(runs, "S32")
    base = hashlib.blake2b(identity.encode(), digest_size=16)
    columns = [(np.asarray(values[name], float) + 0.0).tolist() for name in names]
    for i in range(runs):
        total = base.copy()
        versions = (
            f"{name} {column[i]!r}"
            for name, column in zip(names, columns, strict=True)
            if column[i] == column[i]
        )
        total.update("\n".join(versions).encode())
        keys[i] = total.hexdigest().encode()
    return keys


@dataclasses.dataclass(frozen=True, slots=True)
class PartFile:
    """A part's file, of which ten thousand may be held.

    Attributes:
        folder, name: of the file.
        rows: how many runs it has.
        engine, steps, seconds: what made them, physics steps of all, and the time they took [s].
        series_name: file of their time series; empty if they have none.
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
        """With what a file's metadata says."""
        part_metadata = {
            key: metadata.get(key, b"").decode()
            for key in (b"engine", b"steps", b"wall_seconds", b"series")
        }
        engine, steps, seconds, series = part_metadata.values()
        effort = float(steps or 0), float(seconds or 0)
        return cls(_shared(path.parent), path.name, rows, sys.intern(engine), *effort, series)

    @property
    def path(self) -> Path:
        return self.folder / self.name

    @property
    def group(self) -> str:
        return self.name.split("-")[1]

    @property
    def directory(self) -> Path:
        """The directory of runs that it is in."""
        return (
            self.folder.parent.parent if self.folder.parent.name == FORMER else self.folder.parent
        )

    @property
    def series(self) -> Path | None:
        """The file of the runs' time series, if they have any; a process that is killed moves the two one by one."""
        if not self.series_name:
            return None
        places = (
            self.folder.parent / SERIES,
            self.directory / FORMER / SERIES,
            self.directory / SERIES,
        )
        candidates = (folder / self.series_name for folder in places)
        return next((path for path in candidates if path.exists()), places[0] / self.series_name)


@functools.lru_cache
def _shared(folder: Path) -> Path:
    """The folder as one object for all of its parts."""
    return folder


class Runs:
    """The runs of a directory, and of others that are only read.

    Args:
        out: the directory.
        group: digest of the job, see above; hexadecimal.
        also: other directories; a run that is in several is taken from the first, this one before them.
        warn: called with a message about each part that cannot be used.
        series: whether runs without intact time series count as missing.
        held: the directory as this process holds it; without it nothing is written.

    Attributes:
        parts: the intact parts of the job itself.
        others: the intact parts of other jobs, here and in `also`.

    Raises:
        DirectoryError: a folder cannot be read.
    """

    def __init__(
        self,
        out: Path,
        group: str,
        also: Sequence[Path] = (),
        warn: Warn | None = None,
        series: bool = False,
        directory: RunDirectory | None = None,
    ) -> None:
        self.out, self.group, self.held, self._also = out, group, directory, tuple(also)
        self._warn, self._series = warn or (lambda _: None), series
        if directory is not None:
            with clear_errors(out):
                (out / RESULTS).mkdir(exist_ok=True)
                for folder in (SERIES, RESULTS):
                    _move(
                        out / FORMER / folder, out / folder, lambda file_group: file_group == group
                    )
        self.others = [
            part
            for part_folder in (out, *self._also)
            for part in self._intact(part_folder, is_own=False)
        ]
        self.survey()

    def survey(self) -> None:
        """Read the job's own parts again, every byte. A damaged one is moved aside: its runs are missing."""
        self._numbers: list[np.ndarray] = []
        self.parts = self._intact(self.out, is_own=True)
        if self.held is not None and self.held.shard is None:
            named = {part.series_name for part in self.parts}
            for path in part_files(self.out, self.group, SERIES):
                if path.name not in named:  # of a part that was damaged, or that was never written
                    self.held.move_aside(path.relative_to(self.out), f"{SERIES}.aside")
        self.__dict__.pop("_index", None)
        self._table.cache_clear()

    def _intact(self, out: Path, is_own: bool) -> list[PartFile]:
        """The intact parts of a directory, those of the job itself or the other ones; damaged ones are moved aside."""
        parts = []
        with clear_errors(out):
            for path in (*part_files(out), *part_files(out / FORMER)):
                if (out == self.out and path.name.split("-")[1] == self.group) != is_own:
                    continue
                content, flaw = _content(path)
                if content is not None:
                    with parquet_file(pa.BufferReader(content)) as file:
                        part = PartFile.of(
                            path, file.metadata.num_rows, file.metadata.metadata or {}
                        )
                        row = file.read(["row"])["row"]
                        flaw = "has rows without a number" if row.null_count else ""
                        numbers = row.to_numpy() if is_own and not flaw else None
                    if (
                        not flaw
                        and self._series
                        and (part.series is None or _content(part.series)[0] is None)
                    ):
                        flaw = "has no time series, or damaged ones"
                if not flaw:
                    parts.append(part)
                    if numbers is not None:
                        self._note(numbers)
                elif self.held is None or path.parent != self.out / RESULTS:
                    self._warn(f"{path} {flaw}; its runs are not used.")
                elif self.held.move_aside(path.relative_to(out), f"{RESULTS}.aside") is not None:
                    self._warn(
                        f"{path} {flaw}; it is kept in {RESULTS}.aside, and its runs are made again."
                    )
        return parts

    @property
    def numbers(self) -> np.ndarray:
        """Which runs of the job are there, by the numbers in the column `row`, (n,)."""
        self._numbers = [np.concatenate([np.empty(0, np.int32), *self._numbers])]
        return self._numbers[0]

    def _note(self, numbers: np.ndarray) -> None:
        self._numbers.append(numbers.astype(np.int32))
        if len(self._numbers) > _MAX_HELD_TABLES:  # one array takes less than many small ones
            _ = self.numbers

    def find(self, keys: np.ndarray) -> np.ndarray:
        """Where runs are, (n,) int; -1 where they have not been made."""
        index_keys = self._index.keys
        if not len(index_keys):
            return np.full(len(keys), -1)
        positions = np.minimum(np.searchsorted(index_keys, keys), len(index_keys) - 1)
        return np.where(index_keys[positions] == keys, positions, -1)

    def take(self, places: np.ndarray) -> pa.Table:
        """Runs as they are stored, in this order; what one part does not know is null.

        Returns:
            The columns of the parts, `key` included; of the metadata `engine` is that of the first run, `steps` and
            `wall_seconds` are the runs' shares of their parts'.
        """
        files, rows = self._index.places[places].T
        steps = seconds = 0.0
        tables, order = [], []
        for file in np.unique(files).tolist():
            rows_here, part = np.flatnonzero(files == file), self._index.parts[file]
            steps += part.steps * len(rows_here) / part.rows
            seconds += part.seconds * len(rows_here) / part.rows
            tables.append(
                self._table(part.path).take(rows[rows_here]).replace_schema_metadata(None)
            )
            order.append(rows_here)
        table = pa.concat_tables(tables, promote_options="default").take(
            np.argsort(np.concatenate(order))
        )
        engine = self._index.parts[int(files[0])].engine
        return table.replace_schema_metadata(
            {"engine": engine, "steps": str(steps), "wall_seconds": str(seconds)}
        )

    def series(self, places: np.ndarray) -> Iterator[pa.Table]:
        """The time series of runs, one after the other, with the numbers `row` of the job that made them."""
        for file, row in self._index.places[places].tolist():
            part = self._index.parts[file]
            assert part.series is not None
            number = self._table(part.path).column("row")[row].as_py()
            yield self._table(part.series).filter(
                pc.equal(self._table(part.series).column("row"), number)
            )

    def add(self, keys: np.ndarray, table: pa.Table, series: pa.Table | None = None) -> PartFile:
        """Store runs, atomically and durably: other processes see all of them, with their time series, or none.

        Args:
            keys: (n,) of 32 bytes.
            table: n rows; its metadata tells the engine, the steps and the time they took.
            series: a row for each sample, with a column `row` as the table has.

        Raises:
            DirectoryError: they cannot be written.
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
        self._note(table["row"].to_numpy())
        self.parts.append(part)
        return part

    def take_codes(
        self, stamps: Sequence[CodeStamp], *, accept: bool, any_model: bool = False
    ) -> None:
        """Record which codes are about to add runs, or refuse; see `RunDirectory.take_code`.

        Parts of other jobs leave the folder then, which readers take whole.
        """
        assert self.held is not None
        holds = any(part.path.is_relative_to(self.out) for part in (*self.parts, *self.others))
        for stamp in stamps:
            self.held.take_code(stamp, holds_rows=holds, accept=accept, any_model=any_model)
            holds = True
        if retire(self.held, self.group):
            self._warn(
                f"{self.out} has parts of another job, or made with other defaults: now in {FORMER}."
            )

        def moved(part: PartFile) -> PartFile:
            here = part.group != self.group and part.folder == self.out / RESULTS
            return dataclasses.replace(part, folder=self.out / FORMER / RESULTS) if here else part

        self.others = [moved(part) for part in self.others]
        if "_index" in self.__dict__:
            self._index = self._index._replace(parts=[moved(part) for part in self._index.parts])

    def codes(self, *, accept: bool) -> list[CodeStamp]:
        """Which codes made the runs of other jobs, as far as their directories say.

        Raises:
            OtherCode: one does not, and `accept` is not given.
        """
        stamps: dict[str, CodeStamp] = {}
        for out in dict.fromkeys(part.directory for part in self.others):
            codes = codes_of(out)
            if not codes and not accept:
                raise OtherCode(
                    f"{out} does not say which code made it: its runs are used with --accept-new-code; distinguish "
                    "them by their column code."
                )
            stamps |= codes
        return list(stamps.values())

    def _write(self, folder: str, table: pa.Table) -> Path:
        assert self.held is not None
        content = parquet_bytes(table)
        path = self.out / folder / f"part-{self.group}-{digest(content)}.parquet"
        self.held.write(path.relative_to(self.out), content)
        return path

    @functools.cached_property
    def _index(self) -> _Index:
        """All keys that were there at the first question after a survey."""
        parts = [*self.parts, *self.others]
        keys, places = [np.empty(0, "S32")], [np.empty((0, 2), np.int64)]
        for number, part in enumerate(parts):
            with opened_part(part.path) as file:
                file_keys = file.read(["key"])["key"].to_numpy(zero_copy_only=False).astype("S32")
            keys.append(file_keys)
            places.append(
                np.column_stack([np.full(len(file_keys), number), np.arange(len(file_keys))])
            )
        unique, first = np.unique(np.concatenate(keys), return_index=True)
        return _Index(unique, np.concatenate(places)[first], parts)

    @functools.lru_cache(_MAX_HELD_TABLES)  # noqa: B019 - the store lives as long as the job
    def _table(self, path: Path) -> pa.Table:
        table = parquet_table(path)
        if table is None:
            raise DirectoryError(f"{path} cannot be read any more: run the same command again.")
        return table


def part_files(out: Path, group: str = "*", folder: str = RESULTS) -> list[Path]:
    """The files of a directory's parts, of one job or of all, whatever is in them; in the order of their names."""
    return sorted(
        path for path in out.glob(f"{folder}/part-{group}-*.parquet") if _NAME.fullmatch(path.name)
    )


@contextlib.contextmanager
def opened_part(path: Path) -> Iterator[pq.ParquetFile]:
    """A part's file, whose pages are checked as they are read; what is wrong with it is a `DirectoryError`."""
    try:
        with parquet_file(path, pre_buffer=False) as file:
            yield file
    except (OSError, pa.ArrowException, ValueError, KeyError) as error:
        reason = one_line(str(error).strip())
        raise DirectoryError(
            f"{path} cannot be read ({reason}): run the same command again."
        ) from None


def retire(directory: RunDirectory, group: str) -> int:
    """Move the parts of other jobs out of the folders that are read whole; their own job takes them back.

    Returns:
        How many parts of runs were moved.
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
    """Move parts whose job is wanted, and count them; another process may be doing the same."""
    files = [path for path in source.glob("part-*.parquet") if is_selected(path.name.split("-")[1])]
    for path in files:
        target.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            path.rename(target / path.name)
    for folder in (source, target) if files else ():
        sync_folder(folder)
    return len(files)


def _content(path: Path) -> tuple[bytes | None, str]:
    """The content of a file whose name has its digest, or what is wrong with it."""
    try:
        content = read_bytes(path, MAX_FILE_BYTES)
    except OSError as error:
        return None, f"cannot be read ({error.strerror})"
    match = _NAME.fullmatch(path.name)
    return (
        (content, "") if match is not None and digest(content) == match[2] else (None, "is damaged")
    )


class _Index(NamedTuple):
    """Keys in order, of each the part and the row in it, (n, 2), and the parts."""

    keys: np.ndarray
    places: np.ndarray
    parts: list[PartFile]


class Columns:
    """Collects the columns of a table; each field's metadata has its unit, its description and its role."""

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
        """Add a column of (n,) values; with `nulls` a NaN is one."""
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
        """The table, and what to note in its schema's metadata."""
        metadata = {key: str(value) for key, value in table_metadata.items()}
        return pa.table(self._arrays, schema=pa.schema(self._fields, metadata=metadata))
