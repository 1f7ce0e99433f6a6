"""Structures: what a sweep varies by name (gait, spine, pilot, robot...). Each combination is a separate setup."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import functools
import hashlib
import io
import itertools
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, NamedTuple, NoReturn

import numpy as np
import pyarrow as pa
from pydantic import ConfigDict, GetCoreSchemaHandler, create_model
from pydantic_core import core_schema
from pydantic_core.core_schema import CoreSchema

from nermo_mjx.files import read_bytes
from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.robot.scene import is_mjcf, scene_name
from nermo_mjx.rollout import METRICS, Setup
from nermo_mjx.rollout.metric_table import RUN_COLUMNS, TRANSITION
from nermo_mjx.runs.files import parquet_bytes, parquet_table
from nermo_mjx.specs.controllers import code_identity
from nermo_mjx.specs.fields import Fields, JsonSchema, Refused, optional, read
from nermo_mjx.specs.reading import Document, FieldPath, SpecError, describe, read_text
from nermo_mjx.specs.values import Checked, by_parameter, refuse_parameter
from nermo_mjx.specs.walk import PilotFields, SetupFields, WalkFields, WalkSpec, read_walk, unread
from nermo_mjx.sweep.sampling import Axis, settled
from nermo_mjx.trust import shortened

#: Combinations in one sweep: each is a simulator, and is checked before anything runs.
MOST_STRUCTURES: Final = 1_000
_ABOUT: Final = {**SetupFields.model_fields, "pilot": WalkFields.model_fields["pilot"]}


@dataclasses.dataclass(frozen=True)
class Structure(WalkSpec):
    """One combination of the varied structures: a walk of its own.

    Attributes:
        labels: what stands in the table, by the name of the structure; empty where none is varied.
    """

    labels: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def identity(self) -> str:
        """All that decides a run apart from named values: fields, defaults, content of custom code."""
        fields = {name: value for name, value in self.walk_fields().items() if name != "set"}
        return json.dumps(
            [fields | code_identity(self.setup), self.setup.defaults()], sort_keys=True
        )

    def written(self, name: str) -> Any:
        """A structure as it stands in a file."""
        return self.walk_fields()[name]


class Listed(Checked):
    """Values of a varied structure: [a, b, ...] or {values: [a, b, ...]}."""

    def __init__(self, name: str) -> None:
        self.name = name

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.any_schema()

    def check(self, value: Any) -> list[Any]:
        path: FieldPath = ()
        if isinstance(value, dict) and list(value) == ["values"]:
            value, path = value["values"], ("values",)
        if not isinstance(value, list):
            raise Refused(
                f"is {describe(value)}: expected the list [a, b, ...] of what '{self.name}' may be.",
                at=path,
            )
        if not value:
            raise Refused(
                "is an empty list, so the grid is empty: give at least one value.", at=path
            )
        return value

    def schema(self, base: JsonSchema) -> JsonSchema:
        item = _ABOUT[self.name].json_schema_extra
        if self.name == "pilot":
            item = {
                "anyOf": [
                    *PilotFields.short,
                    {"type": "object", "minProperties": 1, "maxProperties": 1},
                ]
            }
        listed = {"type": "array", "items": item, "minItems": 1}
        values = {
            "properties": {"values": listed},
            "required": ["values"],
            "additionalProperties": False,
        }
        return {"anyOf": [listed, {"type": "object", **values}]}


def also_parameters(schema: dict[str, Any]) -> None:
    """Tell an editor the names of the parameters, beside the declared fields."""
    listed = by_parameter(schema.pop("additionalProperties"))
    schema |= {**listed, "properties": schema["properties"] | listed["properties"]}


#: Fields of a walk that may vary; in this order they stand in a message.
STRUCTURES: Final = (
    "gait",
    "spine",
    "steering",
    "pilot",
    "profile",
    "trajectory",
    "head",
    "tail_motion",
    "routing",
    "scene",
    "tail",
    "physics",
    "robot",
)
_STRUCTURE_FIELDS: Final[dict[str, Any]] = {
    name: (
        Annotated[Any, Listed(name)],
        optional(f"{_ABOUT[name].description}: these, each as a setup of its own"),
    )
    for name in STRUCTURES
}
_Structures: Any = create_model("_Structures", __base__=Fields, **_STRUCTURE_FIELDS)


class Vary(_Structures):
    """What is varied: structures, and parameters by name."""

    __pydantic_extra__: dict[str, Axis]
    model_config = ConfigDict(extra="allow", json_schema_extra=also_parameters)
    expected: ClassVar = "a mapping of structures and parameters to their values"

    @classmethod
    def refuse(cls, key: str) -> None:
        refuse_parameter(key, additional=STRUCTURES)


class StructureValue(NamedTuple):
    """A structure's value in a file, its path there, and `file:line` where it is another file than the sweep's."""

    value: Any
    path: FieldPath
    place: str = ""


@dataclasses.dataclass(frozen=True)
class _Alone(Document):
    """A file with one combination in the place of what varies.

    Attributes:
        chosen: what is chosen, by the name of the structure.
    """

    chosen: Mapping[str, StructureValue] = dataclasses.field(default_factory=dict)

    def where(self, path: FieldPath) -> str:
        if path[:1] and path[0] in self.chosen:
            choice = self.chosen[str(path[0])]
            return choice.place or super().where(choice.path)
        return super().where(path)


def about_structure(name: str) -> str:
    """What a structure is, in words."""
    return str(_ABOUT[name].description)


def choices_of(name: str) -> list[str]:
    """The names that a structure may have; a pilot may have options, too, and a scene be the path of an MJCF file."""
    extra: Any = PilotFields.short[0] if name == "pilot" else _ABOUT[name].json_schema_extra
    return list((extra["anyOf"][0] if "anyOf" in extra else extra)["enum"])


def combinations_of(doc: Document, vary: Vary) -> list[dict[str, StructureValue]]:
    """Every combination of the varied structures, the first of the file slowest; one, of nothing, where none varies."""
    listed: dict[str, list[StructureValue]] = {}
    for name, values in doc.data.get("vary", {}).items():
        if name in STRUCTURES:
            path = ("vary", name, "values") if isinstance(values, Mapping) else ("vary", name)
            listed[name] = [
                StructureValue(value, (*path, i)) for i, value in enumerate(getattr(vary, name))
            ]
    count = math.prod(map(len, listed.values()))
    if count > MOST_STRUCTURES:
        doc.fail(
            ("vary",),
            f"makes {count:,} combinations of structures; allowed are {MOST_STRUCTURES:,}.",
        )
    return [
        dict(zip(listed, combination, strict=True))
        for combination in itertools.product(*listed.values())
    ]


def read_structures(
    doc: Document, model: type[WalkFields], combinations: Sequence[Mapping[str, StructureValue]]
) -> list[Structure]:
    """The walk of each combination, checked as if it stood in a file of its own.

    Args:
        doc: the file.
        model: its fields.
        combinations: what is chosen in each; no field of the file has it, too.

    Raises:
        SpecError: a structure has two sources, or cannot be.
    """
    for name, choice in combinations[0].items() if combinations else ():
        if name in doc.data:
            raise SpecError(
                f"{choice.place or doc.where(choice.path)}: field '{name}' is varied and also given as "
                f"'{name}': give it one source."
            )
    structures = []
    for combination in combinations:
        data = {
            key: value
            for key, value in doc.data.items()
            if not combination or key not in ("vary", "rows", "sample")
        }
        data |= {name: choice.value for name, choice in combination.items()}
        single = _Alone(doc.source, data, doc.lines, combination)
        walk = read_walk(single, read(single, model))
        fields = WalkSpec(**walk).walk_fields() if combination else {}
        structures.append(
            Structure(**walk, labels={name: label_of(fields[name]) for name in combination})
        )
    return structures


def check_repeats(
    doc: Document,
    combinations: Sequence[Mapping[str, StructureValue]],
    structures: Sequence[Structure],
) -> None:
    """Fail where a structure lists a value twice."""
    paths: dict[tuple[str, str], FieldPath] = {}
    for combination, structure in zip(combinations, structures, strict=True):
        for name, label in structure.labels.items():
            path = combination[name].path
            if paths.setdefault((name, label), path) != path:
                doc.fail(path, f"lists {label} twice: every variant would be run twice.", name)


def label_of(written: Any) -> str:
    """A structure's value as a table has it: a name, `{arc: {radius: 0.5}}`, an own scene by name and digest.

    >>> label_of({"arc": {"radius": 0.5}})
    '{arc: {radius: 0.5}}'
    """
    if isinstance(written, Mapping):
        ((name, options),) = written.items()
        return f"{{{name}: {{{', '.join(f'{key}: {json.dumps(options[key])}' for key in sorted(options))}}}}}"
    if is_mjcf(written):
        return f"{scene_name(written)} {hashlib.sha256(written.encode()).hexdigest()[:8]}"
    return str(written)


def value_of(text: str) -> Any:
    """What a text of a table stands for in a file: `label_of` backwards, but for custom scenes.

    >>> value_of("{arc: {radius: 0.5}}")
    {'arc': {'radius': 0.5}}
    """
    return read_text(text, "rows").data if text.startswith("{") else text


# ---
# Rows that are given one by one, in the sweep's file or in a table: exactly these variants, instead of a grid.


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
        raise SpecError(f"{self.place(row)}: field '{shortened(name, 200)}' {message}") from None

    def combinations(self) -> tuple[list[dict[str, StructureValue]], np.ndarray]:
        """The different combinations of structures, and which one each row has, (n,)."""
        names = [name for name in self.columns if name in STRUCTURES]
        index_of_text: dict[str, int] = {}
        selected: list[dict[str, StructureValue]] = []
        combination_of_row = np.zeros(self.rows, int)
        for row in range(self.rows):
            row_values = {name: self.columns[name][row] for name in names}
            row_values = {
                name: str(getattr(Setup, name)) if value is None else value
                for name, value in row_values.items()
            }
            for name, value in row_values.items():
                if not isinstance(value, (str, Mapping)):
                    self.fail(row, name, f"is {describe(value)}: expected a name.")
            combination_of_row[row] = index_of_text.setdefault(
                json.dumps(row_values), len(index_of_text)
            )
            if len(index_of_text) > len(selected):
                values = {
                    name: value_of(value) if isinstance(value, str) else value
                    for name, value in row_values.items()
                }
                location = ("rows", row), self.place(row)
                selected.append(
                    {name: StructureValue(value, *location) for name, value in values.items()}
                )
        return selected, combination_of_row


def read_row_table(doc: Document, value: Any) -> RowTable:
    """The rows of a file's field `rows`, whose columns all are structures or parameters.

    Raises:
        SpecError: with the place of what is wrong.
    """
    if isinstance(value, list):
        names = list(dict.fromkeys(name for row in value for name in row))
        table = RowTable(
            {name: [row.get(name) for row in value] for name in names},
            lambda row: doc.where(("rows", max(row, 0))),
            exact=True,
        )
    else:
        path = Path(doc.source).parent / value if doc.lines else Path(value)
        path = path if path.exists() else Path(value)
        if not path.is_file():
            raise SpecError(
                f"{doc.where(('rows',))}: field 'rows' is {value!r}: there is no such file."
            )
        table = _read_csv(path) if path.suffix == ".csv" else _read_parquet(path)
    for name in table.columns:
        if name in STRUCTURES:
            continue
        try:
            refuse_parameter(name, additional=STRUCTURES)
        except Refused as refused:
            message = str(refused)
            if name in METRICS or name in TRANSITION or name in RUN_COLUMNS:
                message = (
                    "is a column of results, and the file does not say which columns are parameters (a table that "
                    "pandas or polars wrote has lost it): keep only the parameters' columns, or filter "
                    "nermo_mjx.read_table(DIR), which knows them."
                )
            table.fail(-1, name, message)
    if not table.rows:
        raise SpecError(f"{doc.where(('rows',))}: field 'rows' holds no rows: give at least one.")
    return table


#: Bytes of a file of rows as text.
_MOST_CSV: Final = 1 << 26


def _read_csv(path: Path) -> RowTable:
    lines: list[int] = []
    rows: list[list[str]] = []
    try:
        text = read_bytes(path, _MOST_CSV).decode("utf-8-sig")
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append([cell.strip() for cell in row])
                lines.append(reader.line_num)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SpecError(
            f"{path}: cannot be read as CSV ({getattr(error, 'strerror', error)})."
        ) from None
    if not rows:
        raise SpecError(
            f"{path}: an empty file: expected a line of names, and a line for each row."
        )
    header = rows[0]
    for name in header:
        for mark in ";\t|":
            if mark in name:
                raise SpecError(
                    f"{path}:{lines[0]}: columns are separated by {mark!r}: allowed is ',' between "
                    "columns, and '.' in numbers."
                )
        if not name or header.count(name) > 1:
            wrong = f"column {name!r} stands twice" if name else "a column has no name"
            raise SpecError(f"{path}:{lines[0]}: {wrong}.")
    for row, line in zip(rows, lines, strict=True):
        if len(row) != len(header):
            hint = " (a decimal comma separates, too: write 0.8)" if len(row) > len(header) else ""
            raise SpecError(
                f"{path}:{line}: has {len(row)} values, and the first line {len(header)} names{hint}."
            )
    columns = {name: [row[i] or None for row in rows[1:]] for i, name in enumerate(header)}
    return RowTable(columns, lambda row: f"{path}:{lines[row + 1]}", exact=True)


def _read_parquet(path: Path) -> RowTable:
    table = parquet_table(path, ours=False)
    if table is None:
        raise SpecError(f"{path}: cannot be read as Parquet.")
    roles = {
        field.name: (field.metadata or {}).get(b"role", b"").decode() for field in table.schema
    }
    ours = any(roles.values())
    names = [name for name, role in roles.items() if role == "varied" or not ours]
    if ours and not names:
        raise SpecError(
            f"{path}: a table of results in which nothing is varied: there are no variants to take."
        )
    if twice := [name for name in names if table.column_names.count(name) > 1]:
        raise SpecError(f"{path}: column {twice[0]!r} stands twice.")
    columns = {name: table.column(name).to_pylist() for name in names}
    nan = {
        name: [None if value != value else value for value in column]
        for name, column in columns.items()
    }
    return RowTable(
        nan, lambda row: f"{path}: row {row}" if row >= 0 else str(path), exact=not ours
    )


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

    def schema(self, base: JsonSchema) -> JsonSchema:
        row = by_parameter({})
        row["properties"] = {name: {"type": ["string", "object"]} for name in STRUCTURES} | row[
            "properties"
        ]
        file = {"type": "string", "pattern": r"\.(csv|parquet)$"}
        return {
            "anyOf": [file, {"type": "array", "items": {"type": "object", **row}, "minItems": 1}]
        }


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

    def __eq__(self, candidate: object) -> bool:
        return isinstance(candidate, RowList) and self.fingerprint == candidate.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    @functools.cached_property
    def fingerprint(self) -> str:
        """A hash of all values and structures; structures are distinguished by their numbers."""
        total = hashlib.sha256(
            json.dumps([*self.values]).encode() + self.structure.astype("<i8").tobytes()
        )
        for column in self.values.values():
            total.update(np.ascontiguousarray(column, "<f8").tobytes())
        return total.hexdigest()[:16]

    def written(self, structures: Sequence[Structure]) -> list[dict[str, Any]]:
        """The rows as they stand in a sweep file."""
        labels = [
            {name: structure.written(name) for name in structure.labels} for structure in structures
        ]
        columns = {name: column.tolist() for name, column in self.values.items()}
        return [
            labels[structure_index]
            | {name: column[i] for name, column in columns.items() if column[i] == column[i]}
            for i, structure_index in enumerate(self.structure.tolist())
        ]

    def file(self, structures: Sequence[Structure]) -> tuple[str, bytes]:
        """Name and content of a Parquet file with the rows, for a directory; its name tells its content."""
        arrays: dict[str, pa.Array] = {}
        for name in structures[0].labels:
            labels = [structure.written(name) for structure in structures]
            texts = np.array(
                [label_of(text) if isinstance(text, Mapping) else text for text in labels], object
            )
            arrays[name] = pa.array(texts[self.structure].tolist(), pa.string())
        for name, column in self.values.items():
            arrays[name] = pa.array(column, pa.float64(), from_pandas=True)
        fields = [
            pa.field(name, structure.type, metadata={"role": "varied"})
            for name, structure in arrays.items()
        ]
        content = parquet_bytes(pa.table(arrays, schema=pa.schema(fields)))
        return f"rows-{hashlib.sha256(content).hexdigest()[:8]}.parquet", content


def listed_rows(
    table: RowTable,
    structures: Sequence[Structure],
    structure: np.ndarray,
    parameters: Mapping[str, Quantity],
) -> RowList:
    """The rows of a table as numbers, each within its range and read by its structure.

    Args:
        structures: the different ones, and `structure` which one each row has, (n,).
        parameters: every one that there is, with its range.

    What a row leaves out has its default.

    Raises:
        SpecError: a value is not a number, out of range, or without effect, or a row comes twice.
    """
    values = {
        name: _numbers(table, name, parameters[name])
        for name in table.columns
        if name not in STRUCTURES
    }
    for structure_index, walk in enumerate(structures):
        for name, column in values.items():
            lacks, is_given = (
                unread(walk.setup, name),
                (structure == structure_index) & ~np.isnan(column),
            )
            if lacks is None:
                column[(structure == structure_index) & ~is_given] = walk.setup.defaults()[name]
            elif is_given.any():
                why = f"it is read only with {lacks[0]}: {lacks[1]}, and {lacks[0]} is {getattr(walk.setup, lacks[0])}"
                table.fail(
                    int(is_given.argmax()), name, f"has no effect: {why}; leave it out here."
                )
    content = np.column_stack([structure.astype(float), *values.values()])
    first: dict[bytes, int] = {}
    for row in range(len(content)):
        former_row = first.setdefault(content[row].tobytes(), row)
        if former_row != row and table.exact:
            raise SpecError(
                f"{table.place(row)}: a row is the same as that of {table.place(former_row)}: "
                "every run would be made twice; for repeats use randomize.repeats."
            )
    kept_rows = np.array(list(first.values()))
    return RowList(
        {name: column[kept_rows] for name, column in values.items()}, structure[kept_rows]
    )


def _numbers(table: RowTable, name: str, declaration: Quantity) -> np.ndarray:
    column = np.full(table.rows, math.nan)
    for row, value in enumerate(table.columns[name]):
        if value is None:
            continue
        try:
            if isinstance(value, (bool, bytes)):
                raise ValueError
            number = declaration.number(value) if isinstance(value, str) else None
            column[row] = settled(float(value if number is None else number))
        except (TypeError, ValueError, OverflowError):
            comma = re.fullmatch(r"\s*-?\d*,\d+\s*", str(value))
            expected = "expected a number with a point." if comma else declaration.expected
            table.fail(row, name, f"is {describe(value)}: {expected}")
    given_rows = np.flatnonzero(~np.isnan(column))
    with contextlib.suppress(ParameterError):
        declaration.check(name, column[given_rows])
        return column
    for row in given_rows.tolist():
        try:
            declaration.check(name, column[row])
        except ParameterError as error:
            table.fail(row, name, str(error).removeprefix(f"{name} "))
    return column
