"""A sweep's directory: chunks of the result table, what they belong to, and who may write them.

DIR/sweep.yaml                    the resolved sweep
DIR/run.json                      which codes made the rows; each session's versions, machine and command
DIR/results/chunk-00000.parquet   rows of one chunk, written whole or not at all
DIR/results.aside/                chunks that other defaults made, when they are run again
DIR/summary.json, DIR/plots/      made from the table when it is complete
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import RunDirectory, remove_leftovers
from nermo_mjx.runs.files import DirectoryError, clear_errors, create_file, parquet_bytes
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.difference import differences
from nermo_mjx.sweep.layout import rows_digest
from nermo_mjx.sweep.seal import is_intact, seal
from nermo_mjx.sweep.spec import Sweep


class ChunkNote(NamedTuple):
    """What a finished chunk says about itself: its engine, physics steps, and the time they took [s]."""

    engine: str
    steps: float
    seconds: float


class ChunkState(NamedTuple):
    """A chunk's note if it is finished; else what is wrong with its file, empty if there is none.

    `foreign` tells a whole file that is not this sweep's from a damaged one.
    """

    note: ChunkNote | None
    flaw: str = ""
    foreign: bool = False


class Store:
    """A directory held by this process for one sweep; use it in a `with` statement.

    Args:
        out: the directory; made if it does not exist.
        sweep: what the directory is for.
        shard: (i, n) if this process works on every n-th chunk only, beside others. Without it nobody else may write.

    Raises:
        DirectoryError: the directory holds another sweep, is in use, or cannot be written.
    """

    def __init__(self, out: str | os.PathLike[str], sweep: Sweep, shard: tuple[int, int] | None = None) -> None:
        self.out, self.sweep, self.shard = Path(out), sweep, shard
        self.directory = RunDirectory(out, "sweep", shard)
        self.results, self.plots = self.out / "results", self.out / "plots"
        self._digest = sweep.digest().encode()

    def __enter__(self) -> Store:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self.directory)
            with clear_errors(self.out):
                self.results.mkdir(exist_ok=True)
                self._claim()
                for folder in (self.results, self.plots) if self.shard is None else ():
                    remove_leftovers(folder)
            stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.directory.__exit__(kind, error, trace)

    def chunk_path(self, chunk: int) -> Path:
        """Where a chunk's rows are kept."""
        return self.results / _name(chunk)

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
            return ChunkState(None, "was made by another sweep, or with other defaults", foreign=True)
        if about[b"rows"].decode() != rows_digest(rows):
            return ChunkState(None, "holds other rows", foreign=True)
        return ChunkState(ChunkNote(about[b"engine"].decode(), float(about[b"steps"]), float(about[b"wall_seconds"])))

    def write_chunk(self, chunk: int, table: pa.Table) -> None:
        """Store a chunk whole: whoever looks sees all of it or nothing of it."""
        self.directory.write(f"results/{_name(chunk)}", seal(parquet_bytes(table)))

    def move_chunk_aside(self, chunk: int) -> None:
        """Take a chunk's file out of the table, and keep it."""
        self.directory.move_aside(f"results/{_name(chunk)}", "results.aside")

    def take_code(self, stamp: CodeStamp, *, accept: bool) -> None:
        """See `RunDirectory.take_code`."""
        self.directory.take_code(stamp, holds_rows=bool(self.present()), accept=accept)

    def _claim(self) -> None:
        """Make the directory this sweep's, or refuse. A directory keeps the chunks it was begun with."""
        path = self.out / "sweep.yaml"
        if not path.exists():
            if any(self.results.glob("*.parquet")):
                raise self._foreign("results of an unknown sweep (it has no sweep.yaml); choose another directory")
            create_file(path, self.sweep.to_yaml().encode())
        # Even if it was written just now: another shard may have been faster, and have chosen other chunks.
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


def read_chunk(path: Path) -> pa.Table | None:
    """A chunk file, every page checked; None where it is absent or damaged."""
    try:
        return pq.read_table(path, page_checksum_verification=True, partitioning=None)
    except (OSError, pa.ArrowException, ValueError):
        return None


def _name(chunk: int) -> str:
    return f"chunk-{chunk:05d}.parquet"
