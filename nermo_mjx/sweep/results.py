"""Reading the result table: as a whole, or a few columns at a time if it would not fit into memory."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NotRequired

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from typing_extensions import TypedDict

from nermo_mjx.files import FileError, read_as
from nermo_mjx.runs.files import DirectoryError, content_of
from nermo_mjx.runs.rows import opened, part_files
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.trust import one_line

#: Schema metadata that differs between the parts of one table.
PART_KEYS = (b"chunk", b"series", b"steps", b"wall_seconds", b"engine", b"code")
#: Numbers held at once when several columns are wanted one after the other (each 8 bytes).
HELD = 24_000_000
#: Files whose columns are joined at once: ten thousand small arrays would take more memory than their numbers.
_JOINED = 500


#: What a directory says of its sweep for those who only read it.
RECORD: Final = "sweep.json"
#: Its folder of the rows that are kept.
RECORDINGS: Final = "recordings"


_Asked = TypedDict("_Asked", {"by": str, "base": NotRequired[str | float | None], "for": Sequence[str]})


@dataclasses.dataclass(frozen=True)
class SweepRecord:
    """A directory's sweep.json: what readers need of a sweep, so that none of them runs the code that it may name.

    Attributes:
        rows: of the whole sweep.
        fields: of the first structure's walk, as in a file; code by its digest.
        labelled: names of the varied structures.
        parameters: value of each parameter that is not varied, None where structures differ or do not read it.
        comparison: the section `compare`, if there is one.
    """

    rows: int
    fields: Mapping[str, Any]
    labelled: Sequence[str]
    parameters: Mapping[str, float | None]
    comparison: _Asked | None

    @classmethod
    def of_directory(cls, out: Path) -> SweepRecord | None:
        """What a directory has; None if it has none.

        Raises:
            DirectoryError: it is damaged.
        """
        if (content := content_of(out / RECORD)) is None:
            return None
        try:
            found: SweepRecord = read_as(content, cls, out / RECORD)
            if isinstance(found.fields.get("set"), dict):
                return found
        except FileError:
            pass
        raise DirectoryError(f"{out / RECORD} is damaged: run nermo-mjx sweep {out / 'sweep.yaml'} --out {out} again.")


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
            source: a table, or files of one; a column that other code did not know is null in its files.

        Raises:
            DirectoryError: a file cannot be read, now or when a column is asked for.
        """
        self._source, self._called = source, "the table" if isinstance(source, pa.Table) else source[0]
        self._names: dict[str, tuple[str, ...]] = {}
        if isinstance(source, pa.Table):
            schema = source.schema
        else:
            with opened(source[0]) as file:
                schema = file.schema_arrow
                schema = pa.schema([field for field in schema if field.name != "key"], schema.metadata)
        self.schema = schema.with_metadata(_common(schema))
        for name, is_kind in (("row", pa.types.is_integer), ("status", pa.types.is_string)):
            if name not in schema.names or not is_kind(schema.field(name).type):
                raise DirectoryError(
                    f"{self._called} has no column {name!r}, as results have: run the same command again."
                )
        table = self._read(["row", "status"])
        self._order = _order(table, once=not isinstance(source, pa.Table))
        self.rows, status = len(self._order), table.column("status").take(self._order)
        self.well = pc.equal(status, "ok").to_numpy()
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
                with opened(path) as file:
                    # With `row`, which each has: without any column it would have no rows.
                    read = file.read([*dict.fromkeys(["row", *names])], use_threads=False)
                    few.append(read.replace_schema_metadata(None))
            joined.append(joined_tables(few, path).select(names).combine_chunks())
        return pa.concat_tables(joined)


def read_table(out: str | os.PathLike[str]) -> pa.Table:
    """The result table of a sweep's directory, or a search's, as far as it is complete, in the order of its rows.

    Each field's metadata has `unit`, `description` and `role` (index, varied, randomized, metric, status,
    code). Where several codes made the rows, what one of them did not know is null in its rows.

    Raises:
        DirectoryError: no readable part is there.
    """
    parts = []
    for path in part_files(Path(out)):
        with contextlib.suppress(DirectoryError), opened(path) as file:  # a damaged one is left out
            parts.append(file.read([name for name in file.schema_arrow.names if name != "key"]))
    if not parts:
        raise DirectoryError(f"{out} holds no results of a sweep.")
    metadata = _common(parts[0].schema)
    table = joined_tables([part.replace_schema_metadata(metadata) for part in parts], out)
    del parts
    if "row" not in table.column_names or not pa.types.is_integer(table.schema.field("row").type):
        raise DirectoryError(
            f"{out} has results without their numbers, in the column 'row': run the same command again."
        )
    order = _order(table, once=True)
    if len(order) < table.num_rows:
        table, order = table.take(order), np.arange(len(order))
    for place, field in enumerate(table.schema):  # column by column, so that none but one is there twice
        table = table.set_column(place, field, table.column(place).combine_chunks().take(order))
    return table


def joined_tables(tables: Sequence[pa.Table], where: object) -> pa.Table:
    """Tables under one another; what one of them has not is null.

    Raises:
        DirectoryError: a column has different types in them.
    """
    try:
        return pa.concat_tables(tables, promote_options="default")
    except pa.ArrowException as error:
        reason = one_line(str(error).strip())
        raise DirectoryError(
            f"{where}: the files of its table differ ({reason}): run the same command again."
        ) from None


def _order(table: pa.Table, *, once: bool) -> np.ndarray:
    """Places of the rows in their order, (rows,); with `once` a row that two processes made counts once."""
    number = table.column("row").to_numpy()
    order = np.argsort(number, kind="stable")
    first = np.append(True, np.diff(number[order]) > 0)[: len(order)]
    return order[first] if once and not first.all() else order


def _common(schema: pa.Schema) -> dict[bytes, bytes]:
    """Metadata of the table, whatever its files have."""
    return {key: value for key, value in (schema.metadata or {}).items() if key not in PART_KEYS}


# ---
# How far a sweep's directory is.


def status(out: Path) -> Status:
    """How many runs of its sweep a directory holds."""
    notes, rows, done, engines = list[str](), None, 0, list[str]()
    try:
        sweep = SweepRecord.of_directory(out)
        rows = None if sweep is None else sweep.rows
    except DirectoryError as error:
        notes.append(str(error))
    for path in part_files(out):
        if about := metadata_of(path, notes, "its runs will be made again."):
            done += about.num_rows
            engines.append((about.metadata or {}).get(b"engine", b"").decode())
    if kept := len(list((out / RECORDINGS).glob("row-*.npz"))):
        notes.append(f"{kept} of its runs {'are' if kept > 1 else 'is'} recorded in {RECORDINGS}/.")
    complete = done == rows and (out / "summary.json").exists()
    # The figures need no simulation; the others are distinguished by the table's columns.
    engine = ", ".join(dict.fromkeys(filter(None, engines))) or None
    return status_of("runs", out, done, rows, complete, command="sweep", spec="sweep.yaml", engine=engine, notes=notes)
