"""Values of spec files: markers that check a file's values, and describe to an editor what is allowed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from contextvars import ContextVar
from typing import Annotated, Any, Final

from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import core_schema
from pydantic_core.core_schema import CoreSchema

from nermo_mjx.control.protocol import OBJECT_FORM, named_object
from nermo_mjx.robot import identified
from nermo_mjx.robot.quantity import ParameterError, Quantity, did_you_mean, quantities
from nermo_mjx.rollout.metric_table import METRICS, Metric
from nermo_mjx.rollout.setup import WorldParameters
from nermo_mjx.specs.fields import JsonSchema, Refused
from nermo_mjx.specs.reading import Document, FieldPath, describe

#: Every parameter, for a file without a setup; each setup has the same names.
PARAMETERS: Final[dict[str, Quantity]] = dict(quantities(WorldParameters))
#: Parameters that the current file may name: a custom controller has others.
FILE_PARAMETERS: Final[ContextVar[Mapping[str, Quantity]]] = ContextVar(
    "FILE_PARAMETERS", default=PARAMETERS
)
#: Metrics of the current file's runs: with custom metrics there are more.
FILE_METRICS: Final[ContextVar[Mapping[str, Metric]]] = ContextVar("FILE_METRICS", default=METRICS)
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
#: A parameter's number to an editor: a text may have a unit.
QUANTITY_SCHEMA: Final[JsonSchema] = {"type": ["number", "string"], "pattern": r"^\s*[-+]?\.?[0-9]"}
FiniteInUnits = Annotated[Finite, Field(json_schema_extra=QUANTITY_SCHEMA)]
Share = Annotated[float, Field(ge=0, le=1)]


class Checked:
    """A marker whose function `check` follows pydantic's own check, and whose `schema` changes pydantic's own."""

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """What is checked before."""
        return handler(source)

    def check(self, value: Any) -> Any:
        """The value; raises `Refused`."""
        return value

    def schema(self, base: JsonSchema) -> JsonSchema:
        """The schema for an editor."""
        return base

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, self.inner(source, handler))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchema:
        return self.schema(handler(schema))


@dataclasses.dataclass(frozen=True)
class Whole(Checked):
    """A whole number within bounds; 8.0 is one."""

    low: int
    high: int
    even: bool = False

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.float_schema(strict=True)

    def check(self, value: float) -> int:
        if not self.low <= value <= self.high or value != int(value):
            raise Refused(
                f"is {value:g}: expected a whole number from {self.low} to {self.high:,}."
            )
        if self.even and value % 2:
            raise Refused(f"is {value:g}: expected an even number, because samples come in pairs.")
        return int(value)

    def schema(self, base: JsonSchema) -> JsonSchema:
        even = {"multipleOf": 2} if self.even else {}
        return {"type": "integer", "minimum": self.low, "maximum": self.high, **even}


@dataclasses.dataclass(frozen=True)
class Choice(Checked):
    """One of these names; some of them had a former one."""

    names: tuple[str, ...]
    former: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.any_schema()

    def check(self, value: Any) -> str:
        value = self.former.get(value, value) if isinstance(value, str) else value
        if not isinstance(value, str) or value not in self.names:
            allowed = f"allowed {'are' if len(self.names) > 1 else 'is'} {', '.join(self.names)}"
            raise Refused(f"is {describe(value)}: {allowed}{did_you_mean(str(value), self.names)}")
        return value

    def schema(self, base: JsonSchema) -> JsonSchema:
        return {"enum": list(self.names)}


class OwnOr(Choice):
    """One of these names, if there are any, or code of one's own by FILE.py:NAME or MODULE:NAME."""

    def check(self, value: Any) -> Any:
        if isinstance(value, str) and ":" in value:
            try:
                named_object("it is", value)
            except ParameterError:
                raise Refused(f"is {value!r}: expected {OBJECT_FORM}.") from None
            return value
        if not self.names or not isinstance(value, str):
            raise Refused(f"is {describe(value)}: expected {OBJECT_FORM}.")
        return super().check(value)

    def schema(self, base: JsonSchema) -> JsonSchema:
        reference = {"type": "string", "pattern": ":", "description": OBJECT_FORM}
        return {"anyOf": [{"enum": list(self.names)}, reference]} if self.names else reference


class BodiesField(Checked):
    """Where bodies are drawn from: identified, or the directory of an identification; true and false in a task."""

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.any_schema()

    def check(self, value: Any) -> str:
        if isinstance(value, bool):
            return identified.IDENTIFIED_ENSEMBLE if value else ""
        if not isinstance(value, str) or (
            "/" not in value and value not in ("", identified.IDENTIFIED_ENSEMBLE)
        ):
            suggestion = did_you_mean(str(value), (identified.IDENTIFIED_ENSEMBLE,))
            raise Refused(
                f"is {describe(value)}: allowed is identified, or DIR such as runs/mine{suggestion}"
            )
        try:
            identified.bodies(value) if value else None
        except ParameterError as error:
            raise Refused(f"is {value!r}: {error}") from None
        return value

    def schema(self, base: JsonSchema) -> JsonSchema:
        return {"anyOf": [{"type": "string", "pattern": "^$|^identified$|/"}, {"type": "boolean"}]}


@dataclasses.dataclass(frozen=True)
class Numbers(Checked):
    """A list of numbers, `written` such as "[low, high]"; those of a parameter may have units."""

    written: str
    least: int
    most: int | None = None
    of_parameter: bool = True

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        numbers = core_schema.list_schema(core_schema.float_schema(strict=True))
        return core_schema.no_info_before_validator_function(self._listed, numbers)

    def _listed(self, value: Any) -> Any:
        if not isinstance(value, list) or (
            self.most is not None and not self.least <= len(value) <= self.most
        ):
            raise Refused(f"is {describe(value)}: expected the list {self.written}.")
        return value

    def schema(self, base: JsonSchema) -> JsonSchema:
        limits = {} if self.most is None else {"maxItems": self.most}
        items = {"items": QUANTITY_SCHEMA} if self.of_parameter else {}
        return {**base, **items, "minItems": self.least, **limits, "description": self.written}


@dataclasses.dataclass(frozen=True)
class _Ends(Numbers):
    """Two numbers as a tuple; their order is checked where they are used."""

    def check(self, value: list[float]) -> tuple[float, float]:
        low, high = value
        return low, high


#: A range [low, high] of a parameter.
Ends = Annotated[tuple[float, float], _Ends("[low, high]", 2, 2)]


@dataclasses.dataclass(frozen=True)
class InUnits(Checked):
    """A number with a unit, which may be a text such as "300 mm"."""

    about: Quantity

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(self._number, handler(source))

    def _number(self, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if (number := self.about.number(value)) is None:
            raise Refused(f"is {describe(value)}: {self.about.expected}")
        return number

    def schema(self, base: JsonSchema) -> JsonSchema:
        return {**base, "type": ["number", "string"], "pattern": self.about.pattern}


Metres = Annotated[float, InUnits(Quantity(1.0, "m", -math.inf, math.inf, "a length"))]
Way = Annotated[Metres, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, InUnits(Quantity(1.0, "s", -math.inf, math.inf, "a time"))]


class ByParameter(Checked):
    """A mapping whose keys are names of parameters.

    Args:
        numbers: whether its values are the parameters' own, so that an editor can know their ranges.
    """

    def __init__(self, *, numbers: bool = False) -> None:
        self.numbers = numbers

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(self._named, handler(source))

    def _named(self, value: Any) -> Any:
        for name in value if isinstance(value, dict) else ():
            refuse_parameter(name)
        return value

    def schema(self, base: JsonSchema) -> JsonSchema:
        value = base.pop("additionalProperties")
        return {**base, **by_parameter({} if self.numbers else value)}


def by_parameter(value: JsonSchema) -> JsonSchema:
    """Schema of a mapping by parameters: each with its description, and the given schema or that of a number.

    A pattern of names (`patterns`) is allowed in a name's place.
    """
    numbers = {name: number_of(name) for name in PARAMETERS}
    names = {
        name: {**(value or number), "description": number["description"]}
        for name, number in numbers.items()
    }
    patterns = {r"[*?\[]": value or QUANTITY_SCHEMA}
    return {"properties": names, "patternProperties": patterns, "additionalProperties": False}


def number_of(name: str) -> JsonSchema:
    """The schema of a parameter's value: its range, and in words its meaning, unit and default."""
    declaration = PARAMETERS[name]
    unit = "" if declaration.unit == "1" else f" {declaration.unit}"
    description = (
        f"{declaration.doc}; default {declaration.default:g}{unit}, allowed {declaration.allowed()}"
    )
    bounds = (
        ("Minimum", declaration.low, declaration.open_low),
        ("Maximum", declaration.high, declaration.open_high),
    )
    limits = {
        f"exclusive{end}" if is_open else end.lower(): float(bound)
        for end, bound, is_open in bounds
        if math.isfinite(bound)
    }
    return {
        "type": ["number", "string"],
        **limits,
        "pattern": declaration.pattern,
        "description": description,
    }


def check_value(
    doc: Document, path: FieldPath, name: str, declaration: Quantity, value: Any
) -> None:
    """Fail at `path` unless every number is finite and within the parameter's range."""
    try:
        declaration.check(name, value)
    except ParameterError as error:
        doc.fail(path, str(error).removeprefix(f"{name} "), name)


def refuse_parameter(name: str, additional: Iterable[str] = ()) -> None:
    """Raise `Refused` unless there is such a parameter, with the names near it: of its group, or of all groups.

    Args:
        name: of the parameter.
        additional: names of what is allowed beside parameters.
    """
    names = FILE_PARAMETERS.get()
    if name in names:
        return
    group = name.rpartition(".")[0]
    mates = [
        name_in_group for name_in_group in names if group and name_in_group.startswith(f"{group}.")
    ]
    if not mates:
        mates = [name_in_group for name_in_group in names if "." not in name_in_group]
        mates += dict.fromkeys(
            f"{name_in_group.partition('.')[0]}.*"
            for name_in_group in names
            if "." in name_in_group
        )
    mates += additional if "." not in name else ()
    listed = f"allowed are {', '.join(mates)} (nermo-mjx sweep --list-parameters prints all)"
    reason = (
        "is a metric, and not a parameter" if name in FILE_METRICS.get() else "is not a parameter"
    )
    raise Refused(f"{reason}; {listed}{did_you_mean(name, [*additional, *names])}", name)
