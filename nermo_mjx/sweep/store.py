"""A sweep's directory: chunks of the result table, what they belong to, and who may write them.

DIR/sweep.yaml                    the resolved sweep
DIR/run.json                      versions, machine and command of each session that worked on it
DIR/results/chunk-00000.parquet   rows of one chunk, written whole or not at all
DIR/summary.json, DIR/plots/      made from the table when it is complete
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.sweep.files import StoreError, clear_errors, parquet_bytes, replace_file
from nermo_mjx.sweep.lock import hold
from nermo_mjx.sweep.provenance import with_session
from nermo_mjx.sweep.reading import SpecError
from nermo_mjx.sweep.spec import Sweep

#: Schema metadata that differs between the chunks of one table.
CHUNK_KEYS = (b"chunk", b"chunks", b"steps", b"wall_seconds")


class Store:
    """A directory held by this process for one sweep; use it in a `with` statement.

    Args:
        out: the directory; made if it does not exist.
        sweep: what the directory is for.
        shard: (i, n) if this process works on every n-th chunk only, beside others. Without it nobody else may write.

    Raises:
        StoreError: the directory holds another sweep, is in use, or cannot be written.
    """

    def __init__(self, out: str | os.PathLike[str], sweep: Sweep, shard: tuple[int, int] | None = None) -> None:
        self.out, self.sweep, self.shard = Path(out), sweep, shard
        self.results, self.plots = self.out / "results", self.out / "plots"
        self._locks: list[int] = []

    def __enter__(self) -> Store:
        with clear_errors(self.out):
            self.results.mkdir(parents=True, exist_ok=True)
            try:
                self._lock()
                self._claim()
                for leftover in self.results.glob(f".*{self._suffix}"):
                    leftover.unlink()
            except BaseException:
                self._unlock()
                raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._unlock()

    def chunk_path(self, chunk: int) -> Path:
        """Where a chunk's rows are kept."""
        return self.results / f"chunk-{chunk:05d}.parquet"

    def finished(self, chunk: int, rows: Sequence[int]) -> pa.Table | None:
        """The stored chunk, or None if it is absent, damaged, or does not hold exactly these rows of this sweep."""
        table = read_chunk(self.chunk_path(chunk))
        if table is None or (table.schema.metadata or {}).get(b"sweep") != self.sweep.digest().encode():
            return None
        return table if table.column("row").to_pylist() == list(rows) else None

    def write_chunk(self, chunk: int, table: pa.Table) -> None:
        """Store a chunk whole: whoever looks sees all of it or nothing of it."""
        self.write(self.chunk_path(chunk), parquet_bytes(table))

    def write(self, path: Path, content: bytes) -> None:
        """Replace a file of the directory by new content, atomically and durably."""
        with clear_errors(self.out):
            replace_file(path, content, self._suffix)

    def note_session(self, session: dict[str, Any]) -> None:
        """Add what ran here, and where, to run.json."""
        path = self.out / "run.json"
        self.write(path, with_session(path, session))

    @property
    def _suffix(self) -> str:
        return ".tmp" if self.shard is None else f".{self.shard[0]}-of-{self.shard[1]}.tmp"

    def _claim(self) -> None:
        """Make the directory this sweep's, or refuse. A directory keeps the chunks it was begun with."""
        path = self.out / "sweep.yaml"
        if path.exists():
            try:
                begun = Sweep.from_file(path)
            except SpecError as error:
                raise self._foreign(f"a sweep that cannot be read ({error})") from None
            if begun.digest() != self.sweep.digest():
                raise self._foreign(f"the results of another sweep (see {path})")
            self.sweep = dataclasses.replace(self.sweep, chunk=begun.chunk or self.sweep.chunk)
        elif any(self.results.glob("*.parquet")):
            raise self._foreign("results of an unknown sweep (it has no sweep.yaml)")
        else:
            self.write(path, self.sweep.to_yaml().encode())

    def _foreign(self, content: str) -> StoreError:
        return StoreError(f"{self.out} holds {content}; choose another directory.")

    def _lock(self) -> None:
        """An exclusive lock; shards share the first one and hold a second one of their own."""
        self._locks.append(hold(self.out, shared=self.shard is not None))
        if self.shard is not None:
            self._locks.append(hold(self.out, f".lock-{self.shard[0]}-of-{self.shard[1]}"))

    def _unlock(self) -> None:
        while self._locks:
            os.close(self._locks.pop())


def read_chunk(path: Path) -> pa.Table | None:
    """A chunk file, every page checked; None where it is absent or damaged."""
    try:
        return pq.read_table(path, page_checksum_verification=True, partitioning=None)
    except (OSError, pa.ArrowException, ValueError):
        return None


def join(chunks: Sequence[pa.Table]) -> pa.Table:
    """One table of all chunks, in the order of its rows, whatever the chunks were."""
    metadata = {key: value for key, value in (chunks[0].schema.metadata or {}).items() if key not in CHUNK_KEYS}
    table = pa.concat_tables([chunk.replace_schema_metadata(metadata) for chunk in chunks])
    return table.sort_by("row").combine_chunks()


def read_table(out: str | os.PathLike[str]) -> pa.Table:
    """The result table of a sweep's directory, as far as it is finished, in the order of its rows.

    Each field's metadata has `unit`, `description` and `role` (index, varied, randomized, metric, status).

    Raises:
        StoreError: no readable chunk is there.
    """
    tables = [read_chunk(path) for path in sorted(Path(out).glob("results/chunk-*.parquet"))]
    chunks = [table for table in tables if table is not None]
    if not chunks:
        raise StoreError(f"{out} holds no results of a sweep.")
    return join(chunks)
