"""The result table as a reader sees it: whole, or a few columns at a time where it would not fit into memory."""

from __future__ import annotations

import collections
import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.sweep.store import read_chunk

#: Schema metadata that differs between the chunks of one table.
CHUNK_KEYS = (b"chunk", b"chunks", b"rows", b"steps", b"wall_seconds", b"engine", b"code")
#: Numbers held at once when several columns are wanted one after the other (each 8 bytes).
HELD = 32_000_000


class Part(NamedTuple):
    """Some rows of a table: their places in its order, (n,), and some of their columns."""

    places: np.ndarray
    columns: pa.Table


class Results:
    """A result table whose columns are read when they are asked for, in the order of its rows.

    Attributes:
        schema: names, types and metadata of the columns, and of the table.
        rows: how many.
    """

    def __init__(self, schema: pa.Schema, rows: int, parts: Callable[[Sequence[str]], Iterator[Part]]) -> None:
        """
        Args:
            parts: the table bit by bit, with the named columns.
        """
        self.schema, self.rows, self._parts = schema, rows, parts

    @classmethod
    def of_table(cls, table: pa.Table) -> Results:
        """A table that is in memory anyway."""
        return cls(table.schema, table.num_rows, lambda names: iter([_whole(table, names)]))

    @classmethod
    def of_files(cls, files: Sequence[Path], rows: int) -> Results:
        """The chunks of a complete table of so many rows."""
        schema = pq.read_schema(files[0])
        return cls(schema.with_metadata(_common(schema)), rows, lambda names: _read(files, names))

    @classmethod
    def of_present(cls, files: Sequence[Path]) -> Results:
        """The chunks that are there of a table that may have more; their rows in the order of the files.

        Raises:
            DirectoryError: a chunk cannot be read.
        """
        with _clear(files[0]):
            schema = pq.read_schema(files[0])
        counts = []
        for path in files:
            with _clear(path):
                counts.append(pq.read_metadata(path).num_rows)
        begins = np.cumsum([0, *counts])

        def parts(names: Sequence[str]) -> Iterator[Part]:
            for begin, part in zip(begins, _read(files, names), strict=False):
                yield Part(begin + np.arange(len(part.places)), part.columns)

        return cls(schema.with_metadata(_common(schema)), int(begins[-1]), parts)

    def columns(self, names: Sequence[str]) -> Iterator[tuple[str, np.ndarray]]:
        """Columns of numbers one after the other, (rows,) each; the files are read as few times as memory allows."""
        at_once = max(1, HELD // max(self.rows, 1))
        for start in range(0, len(names), at_once):
            group = list(names[start : start + at_once])
            kinds = [self.schema.field(name).type.to_pandas_dtype() for name in group]
            held = {name: np.empty(self.rows, kind) for name, kind in zip(group, kinds, strict=True)}
            for part in self._parts(group):
                for name in group:
                    held[name][part.places] = part.columns.column(name).to_numpy()
            for name in group:
                yield name, held.pop(name)

    def column(self, name: str) -> np.ndarray:
        """One column of numbers, (rows,)."""
        return next(self.columns([name]))[1]

    def statuses(self) -> tuple[np.ndarray, dict[str, int]]:
        """Which runs went well, (rows,) bool, and how often each status occurs."""
        well, counts = np.zeros(self.rows, bool), collections.Counter[str]()
        for part in self._parts(["status"]):
            status = part.columns.column("status")
            well[part.places] = pc.equal(status, "ok").to_numpy()
            counts.update({each["values"]: each["counts"] for each in pc.value_counts(status).to_pylist()})
        return well, dict(sorted(counts.items()))


def read_table(out: str | os.PathLike[str]) -> pa.Table:
    """The result table of a sweep's directory, as far as it is finished, in the order of its rows.

    Each field's metadata has `unit`, `description` and `role` (index, varied, randomized, metric, status,
    code). Where several releases made the rows, what one of them did not know is null in its rows.

    Raises:
        DirectoryError: no readable chunk is there.
    """
    tables = [read_chunk(path) for path in sorted(Path(out).glob("results/chunk-*.parquet"))]
    chunks = [table for table in tables if table is not None]
    if not chunks:
        raise DirectoryError(f"{out} holds no results of a sweep.")
    metadata = _common(chunks[0].schema)
    chunks = [chunk.replace_schema_metadata(metadata) for chunk in chunks]
    return pa.concat_tables(chunks, promote_options="default").sort_by("row").combine_chunks()


def _common(schema: pa.Schema) -> dict[bytes, bytes]:
    """Metadata of the table, whatever its chunks were."""
    return {key: value for key, value in (schema.metadata or {}).items() if key not in CHUNK_KEYS}


def _whole(table: pa.Table, names: Sequence[str]) -> Part:
    return Part(np.arange(table.num_rows), table.select(list(names)))


def _read(files: Sequence[Path], names: Sequence[str]) -> Iterator[Part]:
    for path in files:
        with _clear(path), pq.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read(columns=[*names, "row"], use_threads=False)
        for name in set(names) - set(table.column_names):  # an earlier release made this chunk, and did not know it
            table = table.append_column(name, pa.nulls(len(table), pa.float64()))
        yield Part(table.column("row").to_numpy(), table)


@contextlib.contextmanager
def _clear(path: Path) -> Iterator[None]:
    """Turn what is wrong with a file into a `DirectoryError`."""
    try:
        yield
    except (OSError, pa.ArrowException) as error:
        raise DirectoryError(f"{path} cannot be read ({error}): run the same command again.") from None
