"""Rows that are given one by one, in the sweep's file or in a table: exactly these variants, instead of a grid."""

from __future__ import annotations

import csv
import dataclasses
import functools
import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np
import pyarrow as pa
from pydantic import GetCoreSchemaHandler
from pydantic_core import core_schema
from pydantic_core.core_schema import CoreSchema

from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.rollout import METRICS, Setup
from nermo_mjx.runs.files import parquet_bytes, parquet_table
from nermo_mjx.specs.fields import JsonSchema, Refused
from nermo_mjx.specs.reading import Document, SpecError, describe
from nermo_mjx.specs.values import Checked, by_parameter, refuse_parameter
from nermo_mjx.specs.walk import unread
from nermo_mjx.sweep.structures import STRUCTURES, Choice, Structure, label_of, value_of

# ---
# Tables of rows that a sweep's file names or holds, as they were given: columns, and where each row stands.


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


class RowsForm(Checked):
    """The field `rows`: the path of a table, or a list of mappings."""

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.any_schema()

    def check(self, value: Any) -> Any:
        expected = "expected the path of a .csv or .parquet file, or a list of mappings such as [{frequency: 0.8}, ...]"
        if isinstance(value, str) and Path(value).suffix in (".csv", ".parquet"):
            return value
        if not isinstance(value, list):
            raise Refused(f"is {describe(value)}: {expected}.")
        for i, row in enumerate(value):
            if not isinstance(row, dict):
                raise Refused(f"is {describe(row)}: {expected}.", at=(i,))
        return value

    def schema(self, own: JsonSchema) -> JsonSchema:
        row = by_parameter({})
        row["properties"] = {name: {"type": ["string", "object"]} for name in STRUCTURES} | row["properties"]
        file = {"type": "string", "pattern": r"\.(csv|parquet)$"}
        return {"anyOf": [file, {"type": "array", "items": {"type": "object", **row}, "minItems": 1}]}


@dataclasses.dataclass(frozen=True, eq=False)
class RowList:
    """Variants one by one.

    Attributes:
        values: of the parameters by name, (n,) each; NaN where nothing reads one in a variant's structure.
        structure: place of each one's structure in the sweep's, (n,) int.
    """

    values: Mapping[str, np.ndarray]
    structure: np.ndarray

    def __len__(self) -> int:
        return len(self.structure)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RowList) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    @functools.cached_property
    def fingerprint(self) -> str:
        """A hash of all values and structures; structures are distinguished by their numbers."""
        total = hashlib.sha256(json.dumps([*self.values]).encode() + self.structure.astype("<i8").tobytes())
        for column in self.values.values():
            total.update(np.ascontiguousarray(column, "<f8").tobytes())
        return total.hexdigest()[:16]

    def is_product(self) -> bool:
        """Whether these are every combination of their values, as a grid's."""
        columns = [self.structure, *self.values.values()]
        return math.prod(len(np.unique(column)) for column in columns) == len(self)

    def written(self, structures: Sequence[Structure]) -> list[dict[str, Any]]:
        """The rows as they stand in a sweep file."""
        chosen = [{name: each.written(name) for name in each.labels} for each in structures]
        numbers = [dict(zip(self.values, row, strict=True)) for row in zip(*(v.tolist() for v in self.values.values()),
                                                                           strict=True)]  # fmt: skip
        return [
            chosen[at] | {name: value for name, value in row.items() if value == value}
            for at, row in zip(self.structure.tolist(), numbers or [{}] * len(self), strict=True)
        ]

    def file(self, structures: Sequence[Structure]) -> tuple[str, bytes]:
        """Name and content of a Parquet file with the rows, for a directory; its name tells its content."""
        arrays: dict[str, pa.Array] = {}
        for name in structures[0].labels:
            texts = [each.written(name) for each in structures]
            texts = [label_of(text) if isinstance(text, Mapping) else text for text in texts]
            arrays[name] = pa.array(np.array(texts, object)[self.structure].tolist(), pa.string())
        for name, column in self.values.items():
            arrays[name] = pa.array(column, pa.float64(), from_pandas=True)
        fields = [pa.field(name, each.type, metadata={"role": "varied"}) for name, each in arrays.items()]
        content = parquet_bytes(pa.table(arrays, schema=pa.schema(fields)))
        return f"rows-{hashlib.sha256(content).hexdigest()[:8]}.parquet", content


def listed_rows(
    table: RowTable, structures: Sequence[Structure], structure: np.ndarray, parameters: Mapping[str, Quantity]
) -> RowList:
    """The rows of a table as numbers, each within its range and read by its structure.

    Args:
        structures: the different ones, and `structure` which one each row has, (n,).
        parameters: every one that there is, with its range.

    What a row leaves out has its default.

    Raises:
        SpecError: a value is not a number, out of range, or without effect, or a row comes twice.
    """
    values = {name: _numbers(table, name, parameters[name]) for name in table.columns if name not in STRUCTURES}
    for at, each in enumerate(structures):
        for name, column in values.items():
            lacks, given = unread(each.setup, name), np.flatnonzero((structure == at) & ~np.isnan(column))
            if lacks and len(given):
                choice, wanted = lacks
                table.fail(int(given[0]), name, f"has no effect: it is read only with {choice}: {wanted}, and {choice} "
                                                f"is {getattr(each.setup, choice)}; leave it out here.")  # fmt: skip
        for name, column in values.items():
            if unread(each.setup, name) is None:
                column[(structure == at) & np.isnan(column)] = each.setup.defaults()[name]
    content = np.column_stack([structure.astype(float), *values.values()])
    first: dict[bytes, int] = {}
    for row in range(len(content)):
        before = first.setdefault(content[row].tobytes(), row)
        if before != row and table.exact:
            raise SpecError(f"{table.place(row)}: a row is the same as that of {table.place(before)}: "
                            "every run would be made twice; for repeats use randomize.repeats." )  # fmt: skip
    kept = np.array(list(first.values()))
    return RowList({name: column[kept] for name, column in values.items()}, structure[kept])


def _numbers(table: RowTable, name: str, about: Quantity) -> np.ndarray:
    column = np.full(table.rows, math.nan)
    for row, value in enumerate(table.columns[name]):
        if value is None:
            continue
        try:
            column[row] = math.inf if isinstance(value, bool) else float(value)
        except (TypeError, ValueError):
            table.fail(row, name, f"is {describe(value)}: expected a number.")
    given = column[~np.isnan(column)]
    try:
        about.check(name, given)
    except ParameterError:
        for place in np.flatnonzero(~np.isnan(column)).tolist():
            try:
                about.check(name, column[place])
            except ParameterError as error:
                table.fail(place, name, str(error).removeprefix(f"{name} "))
    return column
