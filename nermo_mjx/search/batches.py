"""A search's directory: one chunk of its table for each batch, written before the next batch is requested.

DIR/search.yaml                   the resolved search, and the size of its batches
DIR/controller.py                 a copy of the file of another controller, if the search names one
DIR/run.json                      which codes made the rows; each session's versions, machine and command
DIR/results/chunk-00000.parquet   rows of one batch, written atomically
DIR/manifest.sha256               a digest of each chunk, as `sha256sum` writes it, noted before the chunk is there
DIR/results.aside/                chunks that were damaged, or hold other points, when they are run again
DIR/best.json, DIR/best.yaml, DIR/atlas.parquet, DIR/recordings/, DIR/plots/   made from the table
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.runs import RunDirectory
from nermo_mjx.runs.directory import remove_leftovers
from nermo_mjx.runs.files import (
    DirectoryError,
    WrongDirectory,
    append_line,
    clear_errors,
    content_of,
    create_file,
    parquet_bytes,
    parquet_table,
)
from nermo_mjx.search.optimizers import made_by
from nermo_mjx.search.spec import Search
from nermo_mjx.specs.controllers import with_code_copied
from nermo_mjx.specs.reading import SpecError, changes
from nermo_mjx.sweep.results import chunk_files
from nermo_mjx.sweep.sampling import Rows
from nermo_mjx.sweep.simulating import Simulated
from nermo_mjx.sweep.table import chunk_table

SEARCH: Final = "search.yaml"
MANIFEST: Final = "manifest.sha256"
#: How far points of a stored batch may be from those that are asked for, as a fraction of the bounds: another machine's
#: eigenvectors differ in their last digits.
APART: Final = 1e-6
#: Column of a gradient: `gradient.METRIC.PARAMETER`; of the objective, METRIC is `quality`.
GRADIENT: Final = "gradient.{}.{}"


@dataclasses.dataclass(frozen=True)
class Stored:
    """A batch as the table has it.

    Attributes:
        table: its rows in order.
        flaw: what is wrong with its file, in words; empty if nothing is.
    """

    table: pa.Table | None
    flaw: str = ""


class Batches:
    """A directory held by this process for one search; use it in a `with` statement.

    Args:
        out: the directory; made if it does not exist.
        search: what the directory is for; `search.batch` is what it was started with, once it is entered.

    Raises:
        DirectoryError: the directory holds another search, is in use, or cannot be written.
    """

    def __init__(self, out: str | os.PathLike[str], search: Search) -> None:
        self.out, self.search = Path(out), search
        self.directory = RunDirectory(out, "search")
        self.results = self.out / "results"

    def __enter__(self) -> Batches:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self.directory)
            with clear_errors(self.out):
                self.results.mkdir(exist_ok=True)
                for folder in (self.results, self.out / "plots", self.out / "recordings"):
                    remove_leftovers(folder)
            stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.directory.__exit__()

    def begun_batch(self) -> int | None:
        """The size of batches that the directory was started with; None if it is new."""
        return begun.batch if (begun := self._begun()) is not None else None

    def claim(self, search: Search) -> None:
        """Make the directory this search's, or refuse."""
        path, folder = self.out / SEARCH, self.out.resolve()
        self.search = search = dataclasses.replace(
            search, sweep=dataclasses.replace(
                search.sweep, setup=with_code_copied(search.setup, folder, self.directory.write)
            )
        )  # fmt: skip
        begun = self._begun()
        if begun is None:
            if any(self.results.glob("*.parquet")):
                raise WrongDirectory(
                    f"{self.out} holds results of an unknown search (it has no {SEARCH}); choose another directory."
                )
            with clear_errors(self.out):
                create_file(path, search.to_yaml(folder).encode())
        elif begun.digest() != search.digest():
            apart = changes(begun.decisive(), search.decisive()) or ["parameters under vary stand in another order"]
            raise WrongDirectory(
                f"{self.out} holds another search, with another {', '.join(apart[:3])}; choose another directory, or "
                f"resume with {path}."
            )
        elif begun.to_yaml(folder) != search.to_yaml(folder):  # another budget, or more recordings
            self.directory.write(SEARCH, search.to_yaml(folder).encode())

    @property
    def holds_rows(self) -> bool:
        """Whether there is a chunk, whatever is in it."""
        return bool(chunk_files(self.out))

    def read(self, batch: int, rows: Rows) -> Stored:
        """A batch, if its file is whole and holds these rows; see `APART`.

        Raises:
            DirectoryError: another version of the library asked for its points.
        """
        path = self.chunk_path(batch)
        content = content_of(path)
        if content is None:
            return Stored(None)
        digest = hashlib.sha256(content).hexdigest()
        table = parquet_table(content) if digest in (content_of(self.out / MANIFEST) or b"").decode() else None
        if table is None:
            return Stored(None, "is damaged")
        about = table.schema.metadata or {}
        if about.get(b"search") != self.search.digest().encode():
            return Stored(None, "was made by another search, or with other defaults")
        if table.column("variant").to_pylist() == rows.variant.tolist() and self._near(table, rows):
            return Stored(table)
        before, now = about.get(b"optimizer", b"").decode(), made_by(self.search.method)
        if before != now:
            raise DirectoryError(f"{path} holds points that {before} asked for, and {now} asks for others: install "
                                 f"{before}, or choose another directory.")  # fmt: skip
        return Stored(None, "holds other points than those that follow from the batches before it")

    def write(
        self, batch: int, rows: Rows, first: int, found: Simulated, stamp: Any, gradients: np.ndarray | None
    ) -> pa.Table:
        """Store a batch atomically; a file already in its place is moved aside.

        Args:
            rows: its runs, of which `first` is the first one's place in the table.
            found: at least one result a run.
            stamp: of the code that simulated.
            gradients: (g, 1 + m, p) of its first g points, or None.
        """
        index, count = first + np.arange(len(rows)), len(rows)
        about = {
            "engine": stamp.engine, "code": stamp.id, "chunk": batch, "steps": found.steps,
            "wall_seconds": found.seconds, "search": self.search.digest(), "optimizer": made_by(self.search.method),
        }  # fmt: skip
        metrics = {name: values[:count] for name, values in found.metrics.items()}
        table = chunk_table(self.search.sweep, rows, index, metrics, found.status[:count], stamp.id, about)
        about_batch = {"unit": "1", "description": "batch that the run was part of", "role": "index"}
        table = table.add_column(1, pa.field("batch", pa.int64(), metadata=about_batch), pa.array([batch] * count))
        table = self._with_gradients(table, gradients)
        name, content = f"results/chunk-{batch:05d}.parquet", parquet_bytes(table)
        with clear_errors(self.out):
            append_line(self.out / MANIFEST, f"{hashlib.sha256(content).hexdigest()}  {name}")
        self.directory.move_aside(name, "results.aside")
        self.directory.write(name, content)
        return table

    def chunk_path(self, batch: int) -> Path:
        """Where a batch's rows are kept."""
        return self.results / f"chunk-{batch:05d}.parquet"

    def gradients(self, table: pa.Table, points: int) -> np.ndarray:
        """The gradients of a batch's first points, from its table: (points, 1 + m, p)."""
        columns = [[GRADIENT.format(metric, name) for name in self.search.names] for metric in self._differentiated]
        rows = slice(0, points * self.search.repeats, self.search.repeats)
        return np.stack([np.stack([table.column(name).to_numpy()[rows] for name in line], -1) for line in columns], 1)

    @property
    def _differentiated(self) -> tuple[str, ...]:
        return ("quality", *(each.metric for each in self.search.aim.measures))

    def _with_gradients(self, table: pa.Table, gradients: np.ndarray | None) -> pa.Table:
        """The table with columns of gradients, NaN where none was asked for, if the method asks for some at all."""
        if self.search.method != "cma_mega":
            return table
        for i, metric in enumerate(self._differentiated):
            for j, name in enumerate(self.search.names):
                values = np.full(table.num_rows, np.nan)
                if gradients is not None:
                    values[: len(gradients) * self.search.repeats] = np.repeat(gradients[:, i, j], self.search.repeats)
                meaning = f"d {metric} / d share of the bounds of {name}"
                about = {"unit": "1", "role": "gradient", "description": meaning}
                field = pa.field(GRADIENT.format(metric, name), pa.float64(), metadata=about)
                table = table.append_column(field, pa.array(values))
        return table

    def _near(self, table: pa.Table, rows: Rows) -> bool:
        """Whether the table's points are those of the rows, but for rounding."""
        for axis in self.search.sweep.axes:
            low, high = axis.numbers[:2]
            there = table.column(axis.name).to_numpy()
            if not np.allclose(there, rows.values[axis.name], rtol=0.0, atol=APART * (high - low)):
                return False
        return True

    def _begun(self) -> Search | None:
        """The search that the directory was started for, if it was."""
        path = self.out / SEARCH
        if not path.exists():
            return None
        try:
            return Search.from_file(path)
        except SpecError as error:
            raise WrongDirectory(
                f"{self.out} holds a search that cannot be read ({error}); choose another directory."
            ) from None
