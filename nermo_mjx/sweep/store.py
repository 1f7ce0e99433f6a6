"""A sweep's directory: chunks of the result table, what they belong to, and who may write them.

DIR/sweep.yaml                    the resolved sweep
DIR/run.json                      versions, machine and command of each session that worked on it
DIR/results/chunk-00000.parquet   rows of one chunk, written whole or not at all
DIR/summary.json, DIR/plots/      made from the table when it is complete
"""

from __future__ import annotations

import dataclasses
import os
import re
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.runs.directory import remove_leftovers
from nermo_mjx.runs.files import DirectoryError, clear_errors, create_file, parquet_bytes, replace_file
from nermo_mjx.runs.lock import hold
from nermo_mjx.runs.provenance import with_session
from nermo_mjx.sweep.difference import differences
from nermo_mjx.sweep.layout import rows_digest
from nermo_mjx.sweep.reading import SpecError
from nermo_mjx.sweep.seal import is_intact, seal
from nermo_mjx.sweep.spec import Sweep


class ChunkNote(NamedTuple):
    """What a finished chunk says about itself: its engine, physics steps, and the time they took [s]."""

    engine: str
    steps: float
    seconds: float


class ChunkState(NamedTuple):
    """A chunk's note if it is finished; else what is wrong with its file, empty if there is none."""

    note: ChunkNote | None
    flaw: str = ""


class Store:
    """A directory held by this process for one sweep; use it in a `with` statement.

    Args:
        out: the directory; made if it does not exist.
        sweep: what the directory is for.
        part: (i, n) if this process works on every n-th chunk only, beside others. Without it nobody else may write.

    Raises:
        DirectoryError: the directory holds another sweep, is in use, or cannot be written.
    """

    def __init__(self, out: str | os.PathLike[str], sweep: Sweep, part: tuple[int, int] | None = None) -> None:
        self.out, self.sweep, self.part = Path(out), sweep, part
        self.results, self.plots = self.out / "results", self.out / "plots"
        self._digest = sweep.digest().encode()
        self._locks: list[int] = []

    def __enter__(self) -> Store:
        with clear_errors(self.out):
            self.results.mkdir(parents=True, exist_ok=True)
            try:
                self._lock()
                self._claim()
                for folder in (self.out, self.results, self.plots):
                    if self.part is None:
                        remove_leftovers(folder)
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

    def present(self) -> set[int]:
        """The chunks that have a file, whatever is in it."""
        with clear_errors(self.out):
            names = (re.fullmatch(r"chunk-(\d+)\.parquet", entry.name) for entry in os.scandir(self.results))
            return {int(name[1]) for name in names if name}

    def inspect(self, chunk: int, rows: np.ndarray) -> ChunkState:
        """Whether a chunk is there, undamaged to the last bit, and holds exactly these rows of this sweep.

        Its numbers are not read, only its bytes.
        """
        try:
            content = self.chunk_path(chunk).read_bytes()
        except FileNotFoundError:
            return ChunkState(None)
        except OSError as error:
            return ChunkState(None, f"cannot be read ({error.strerror})")
        if not is_intact(content):
            return ChunkState(None, "is damaged")
        about = pq.read_metadata(pa.BufferReader(content)).metadata
        if about[b"sweep"] != self._digest:
            return ChunkState(None, "was made by another sweep, or with other defaults")
        if about[b"rows"].decode() != rows_digest(rows):
            return ChunkState(None, "holds other rows")
        return ChunkState(ChunkNote(about[b"engine"].decode(), float(about[b"steps"]), float(about[b"wall_seconds"])))

    def write_chunk(self, chunk: int, table: pa.Table) -> None:
        """Store a chunk whole: whoever looks sees all of it or nothing of it."""
        self.write(self.chunk_path(chunk), seal(parquet_bytes(table)))

    def write(self, path: Path, content: bytes) -> None:
        """Replace a file of the directory by new content, atomically and durably."""
        with clear_errors(self.out):
            replace_file(path, content)

    def note_session(self, session: dict[str, Any]) -> None:
        """Add what runs here, and where, to run.json; several processes take turns."""
        path = self.out / "run.json"
        with clear_errors(self.out):
            held = hold(self.out, ".lock-run", wait=True)
            try:
                self.write(path, with_session(path, session))
            finally:
                os.close(held)

    def _claim(self) -> None:
        """Make the directory this sweep's, or refuse. A directory keeps the chunks it was begun with."""
        path = self.out / "sweep.yaml"
        if not path.exists():
            if any(self.results.glob("*.parquet")):
                raise self._foreign("results of an unknown sweep (it has no sweep.yaml); choose another directory")
            create_file(path, self.sweep.to_yaml().encode())
        # Even if it was written just now: another part may have been faster, and have chosen other chunks.
        try:
            begun = Sweep.from_file(path)
        except SpecError as error:
            raise self._foreign(f"a sweep that cannot be read ({error}); choose another directory") from None
        if begun.digest() != self.sweep.digest():
            raise self._foreign(
                f"the results of another sweep: {differences(begun, self.sweep)}; choose another directory, or go on "
                f"with {path}"
            )
        self.sweep = dataclasses.replace(self.sweep, chunk=begun.chunk or self.sweep.chunk)

    def _foreign(self, content: str) -> DirectoryError:
        return DirectoryError(f"{self.out} holds {content}.")

    def _lock(self) -> None:
        """An exclusive lock; parts share the first one and hold a second one of their own."""
        self._locks.append(hold(self.out, shared=self.part is not None))
        if self.part is not None:
            self._locks.append(hold(self.out, f".lock-{self.part[0]}-of-{self.part[1]}"))

    def _unlock(self) -> None:
        while self._locks:
            os.close(self._locks.pop())


def read_chunk(path: Path) -> pa.Table | None:
    """A chunk file, every page checked; None where it is absent or damaged."""
    try:
        return pq.read_table(path, page_checksum_verification=True, partitioning=None)
    except (OSError, pa.ArrowException, ValueError):
        return None
