"""Rows that are given one by one, in the sweep's file or in a table: exactly these variants, instead of a grid."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import GetCoreSchemaHandler
from pydantic_core import core_schema
from pydantic_core.core_schema import CoreSchema

from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.runs.files import parquet_bytes
from nermo_mjx.specs.fields import JsonSchema, Refused
from nermo_mjx.specs.reading import SpecError, describe
from nermo_mjx.specs.unread import unread
from nermo_mjx.specs.values import Checked, by_parameter
from nermo_mjx.sweep.row_tables import RowTable
from nermo_mjx.sweep.structures import STRUCTURES, Structure, label_of


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
