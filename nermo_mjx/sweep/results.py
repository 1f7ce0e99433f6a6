"""Reading the result table: as a whole, or a few columns at a time if it would not fit into memory."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from nermo_mjx.runs.files import DirectoryError, parquet_table

#: Schema metadata that differs between the chunks of one table.
CHUNK_KEYS = (b"chunk", b"chunks", b"rows", b"steps", b"wall_seconds", b"engine", b"code")
#: Numbers held at once when several columns are wanted one after the other (each 8 bytes).
HELD = 24_000_000
#: Files whose columns are joined at once: ten thousand small arrays would take more memory than their numbers.
_JOINED = 500


class Results:
    """A result table whose columns are read on demand, in the order of its rows.

    Attributes:
        schema: names, types and metadata of the columns, and of the table.
        rows: how many there are.
        well: which runs succeeded, (rows,) bool.
        statuses: how often each status occurs.
    """

    def __init__(self, source: pa.Table | Sequence[Path]) -> None:
        """
        Args:
            source: a table, or chunks of one; a column that other code did not know is null in its chunks.

        Raises:
            DirectoryError: a chunk cannot be read, now or when a column is asked for.
        """
        self._source = source
        self._names: dict[str, tuple[str, ...]] = {}
        if isinstance(source, pa.Table):
            schema = source.schema
        else:
            with _opened(source[0]) as file:
                schema = file.schema_arrow
        self.schema = schema.with_metadata(_common(schema))
        table = self._read(["row", "status"])
        self._order = np.argsort(table.column("row").to_numpy(), kind="stable")
        self.rows, status = len(self._order), table.column("status")
        self.well = pc.equal(status, "ok").to_numpy()[self._order]
        counts = {each["values"]: each["counts"] for each in pc.value_counts(status).to_pylist()}
        self.statuses: dict[str, int] = dict(sorted(counts.items()))

    @property
    def is_grid(self) -> bool:
        """Whether the varied parameters are a grid's."""
        return (self.schema.metadata or {}).get(b"sampler") == b"grid"

    def names(self, column: str) -> tuple[str, ...]:
        """The different texts of a column, in the order in which they come."""
        if column not in self._names:
            self._names[column] = tuple(dict.fromkeys(self.column(column).tolist()))
        return self._names[column]

    def columns(self, names: Sequence[str]) -> Iterator[tuple[str, np.ndarray]]:
        """Columns one after the other, (rows,) each; the files are read as few times as memory allows."""
        at_once = max(1, HELD // max(self.rows, 1))
        for start in range(0, len(names), at_once):
            table = self._read(names[start : start + at_once])
            for name in table.column_names:
                yield name, table.column(name).to_numpy()[self._order]
                table = table.drop([name])

    def column(self, name: str) -> np.ndarray:
        """One column, (rows,)."""
        return next(self.columns([name]))[1]

    def _read(self, names: Sequence[str]) -> pa.Table:
        """Some columns, in the order of the files."""
        if isinstance(self._source, pa.Table):
            return self._source.select(names)
        wanted = pa.schema([self.schema.field(name) for name in names]).empty_table()
        joined = [wanted]
        for start in range(0, len(self._source), _JOINED):
            few = [wanted]
            for path in self._source[start : start + _JOINED]:
                with _opened(path) as file:
                    few.append(file.read(list(names), use_threads=False).replace_schema_metadata(None))
            joined.append(pa.concat_tables(few, promote_options="default").combine_chunks())
        return pa.concat_tables(joined)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[pq.ParquetFile]:
    """A chunk's file, whose pages are checked as they are read; what is wrong with it is a `DirectoryError`."""
    try:
        with pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True) as file:
            yield file
    except (OSError, pa.ArrowException) as error:
        raise DirectoryError(f"{path} cannot be read ({error}): run the same command again.") from None


def chunk_files(out: str | os.PathLike[str]) -> dict[int, Path]:
    """The files of a directory's chunks by their numbers, in order, whatever is in them."""
    found = ((re.fullmatch(r"chunk-(\d+)\.parquet", path.name), path) for path in Path(out).glob("results/*"))
    return dict(sorted((int(name[1]), path) for name, path in found if name))


def digests_of(out: Path) -> dict[str, str]:
    """File by digest, as all manifests of a directory have them; of a chunk that was run again there are several."""
    texts = [path.read_text(errors="replace") for path in out.glob("manifest*.sha256")]
    lines = (line.partition("  ") for text in texts for line in text.splitlines())
    return {digest: name for digest, _, name in lines}


def read_table(out: str | os.PathLike[str]) -> pa.Table:
    """The result table of a sweep's directory, as far as it is complete, in the order of its rows.

    Each field's metadata has `unit`, `description` and `role` (index, varied, randomized, metric, status,
    code). Where several codes made the rows, what one of them did not know is null in its rows.

    Raises:
        DirectoryError: no readable chunk is there.
    """
    chunks = [table for path in chunk_files(out).values() if (table := parquet_table(path)) is not None]
    if not chunks:
        raise DirectoryError(f"{out} holds no results of a sweep.")
    metadata = _common(chunks[0].schema)
    table = pa.concat_tables((chunk.replace_schema_metadata(metadata) for chunk in chunks), promote_options="default")
    del chunks
    order = pc.sort_indices(table.column("row"))
    for place, field in enumerate(table.schema):  # column by column, so that none but one is there twice
        table = table.set_column(place, field, table.column(place).combine_chunks().take(order))
    return table


def _common(schema: pa.Schema) -> dict[bytes, bytes]:
    """Metadata of the table, whatever its chunks were."""
    return {key: value for key, value in (schema.metadata or {}).items() if key not in CHUNK_KEYS}
