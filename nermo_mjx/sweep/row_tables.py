"""Tables of rows that a sweep's file names or holds, as they were given: columns, and where each row stands."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np

from nermo_mjx.rollout import METRICS, Setup
from nermo_mjx.runs.files import parquet_table
from nermo_mjx.specs.fields import Refused
from nermo_mjx.specs.reading import Document, SpecError
from nermo_mjx.specs.values import refuse_parameter
from nermo_mjx.sweep.structures import STRUCTURES, Choice, value_of

#: Columns of a result table that are no parameters, beside its metrics.
_RESULTS: Final = ("row", "variant", "repeat", "seed", "body", "status", "code")


@dataclasses.dataclass(frozen=True)
class RowTable:
    """Rows as they were given, column by column.

    Attributes:
        columns: name -> (n,) values, None where there is none.
        place: `file:line` of a row, or how it is called; of row -1, where the columns' names stand.
        exact: whether a row that comes twice is wrong; in a table of results it is a repeat.
    """

    columns: dict[str, list[Any]]
    place: Callable[[int], str]
    exact: bool

    @property
    def rows(self) -> int:
        return len(next(iter(self.columns.values()), []))

    def fail(self, row: int, name: str, message: str) -> NoReturn:
        """Raise a `SpecError` about a value."""
        raise SpecError(f"{self.place(row)}: field '{name}' {message}") from None

    def combinations(self) -> tuple[list[dict[str, Choice]], np.ndarray]:
        """The different combinations of structures, and which one each row has, (n,)."""
        names = [name for name in self.columns if name in STRUCTURES]
        found: dict[str, int] = {}
        chosen: list[dict[str, Choice]] = []
        which = np.zeros(self.rows, int)
        for row in range(self.rows):
            given = {name: self.columns[name][row] for name in names}
            given = {name: str(getattr(Setup, name)) if value is None else value for name, value in given.items()}
            key = json.dumps(given)
            if key not in found:
                found[key] = len(found)
                chosen.append({name: Choice(value_of(value) if isinstance(value, str) else value, ("rows", row),
                                            self.place(row)) for name, value in given.items()})  # fmt: skip
            which[row] = found[key]
        return chosen, which


def read_row_table(doc: Document, given: Any) -> RowTable:
    """The rows of a file's field `rows`, whose columns all are structures or parameters.

    Raises:
        SpecError: with the place of what is wrong.
    """
    if isinstance(given, list):
        names = list(dict.fromkeys(name for row in given for name in row))
        table = RowTable({name: [row.get(name) for row in given] for name in names},
                         lambda row: doc.where(("rows", max(row, 0))), exact=True)  # fmt: skip
    else:
        path = Path(doc.source).parent / given if doc.lines else Path(given)
        path = path if path.exists() else Path(given)
        if not path.is_file():
            raise SpecError(f"{doc.where(('rows',))}: field 'rows' is {given!r}: there is no such file.")
        table = _read_csv(path) if path.suffix == ".csv" else _read_parquet(path)
    for name in table.columns:
        if name not in STRUCTURES:
            _check_name(table, name)
    if not table.rows:
        raise SpecError(f"{doc.where(('rows',))}: field 'rows' holds no rows: give at least one.")
    return table


def _check_name(table: RowTable, name: str) -> None:
    try:
        refuse_parameter(name, more=STRUCTURES)
    except Refused as refused:
        message = str(refused)
        if name in METRICS or name in _RESULTS:
            message = ("is a column of results, and the file does not say which columns are parameters (a table that "
                       "pandas or polars wrote has lost it): keep only the parameters' columns, or filter "
                       "nermo_mjx.read_table(DIR), which knows them.")  # fmt: skip
        table.fail(-1, name, message)


def _read_csv(path: Path) -> RowTable:
    lines: list[int] = []
    rows: list[list[str]] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            for row in reader:
                if any(cell.strip() for cell in row):
                    rows.append([cell.strip() for cell in row])
                    lines.append(reader.line_num)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SpecError(f"{path}: cannot be read as CSV ({error}).") from None
    if not rows:
        raise SpecError(f"{path}: an empty file: expected a line of names, and a line for each row.")
    header = rows[0]
    for name in header:
        if not name or header.count(name) > 1:
            wrong = f"column {name!r} stands twice" if name else "a column has no name"
            raise SpecError(f"{path}:{lines[0]}: {wrong}.")
    for row, line in zip(rows, lines, strict=True):
        if len(row) != len(header):
            raise SpecError(f"{path}:{line}: has {len(row)} values, and the first line {len(header)} names.")
    columns = {name: [row[i] or None for row in rows[1:]] for i, name in enumerate(header)}
    return RowTable(columns, lambda row: f"{path}:{lines[row + 1]}", exact=True)


def _read_parquet(path: Path) -> RowTable:
    table = parquet_table(path)
    if table is None:
        raise SpecError(f"{path}: cannot be read as Parquet.")
    roles = {field.name: (field.metadata or {}).get(b"role", b"").decode() for field in table.schema}
    ours = any(roles.values())
    names = [name for name, role in roles.items() if role == "varied" or not ours]
    if ours and not names:
        raise SpecError(f"{path}: a table of results in which nothing is varied: there are no variants to take.")
    columns = {name: table.column(name).to_pylist() for name in names}
    nan = {name: [None if value != value else value for value in column] for name, column in columns.items()}
    return RowTable(nan, lambda row: f"{path}: row {row}" if row >= 0 else str(path), exact=not ours)
