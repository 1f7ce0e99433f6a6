"""Structures: what a sweep varies by name (gait, spine, pilot, robot...). Each combination is a separate setup."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Final, NamedTuple

from pydantic import ConfigDict, GetCoreSchemaHandler
from pydantic_core import core_schema
from pydantic_core.core_schema import CoreSchema

from nermo_mjx.robot.scene import is_mjcf, scene_name
from nermo_mjx.specs.controllers import code_identity
from nermo_mjx.specs.fields import Fields, JsonSchema, Refused, optional, read
from nermo_mjx.specs.reading import Document, FieldPath, SpecError, describe, read_text
from nermo_mjx.specs.values import Checked, by_parameter, refuse_parameter
from nermo_mjx.specs.walk import Pilot, SetupFields, WalkFields, WalkSpec, read_walk
from nermo_mjx.sweep.axes import AxisForm

#: Fields of a walk that may vary; in this order they stand in a message.
STRUCTURES: Final = (
    "gait", "spine", "steering", "pilot", "profile", "trajectory", "head", "tail_motion", "routing", "scene", "tail",
    "physics", "robot",
)  # fmt: skip
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
        return json.dumps([fields | code_identity(self.setup), self.setup.defaults()], sort_keys=True)

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
            raise Refused(f"is {describe(value)}: expected the list [a, b, ...] of what '{self.name}' may be.", at=path)
        if not value:
            raise Refused("is an empty list, so the grid is empty: give at least one value.", at=path)
        return value

    def schema(self, own: JsonSchema) -> JsonSchema:
        item = _ABOUT[self.name].json_schema_extra
        if self.name == "pilot":
            item = {"anyOf": [*Pilot.short, {"type": "object", "minProperties": 1, "maxProperties": 1}]}
        listed = {"type": "array", "items": item, "minItems": 1}
        mapping = {"type": "object", "properties": {"values": listed}, "required": ["values"],
                   "additionalProperties": False}  # fmt: skip
        return {"anyOf": [listed, mapping]}


def _also_parameters(schema: dict[str, Any]) -> None:
    """Tell an editor the names of the parameters, beside the structures."""
    listed = by_parameter(schema.pop("additionalProperties"))
    schema |= {**listed, "properties": schema["properties"] | listed["properties"]}


def _varied(name: str) -> Any:
    return optional(f"{_ABOUT[name].description}: these, each as a setup of its own")


class Vary(Fields):
    """What is varied: structures, and parameters by name."""

    __pydantic_extra__: dict[str, AxisForm]
    model_config = ConfigDict(extra="allow", json_schema_extra=_also_parameters)
    expected: ClassVar = "a mapping of structures and parameters to their values"
    gait: Annotated[Any, Listed("gait")] = _varied("gait")
    spine: Annotated[Any, Listed("spine")] = _varied("spine")
    steering: Annotated[Any, Listed("steering")] = _varied("steering")
    pilot: Annotated[Any, Listed("pilot")] = _varied("pilot")
    profile: Annotated[Any, Listed("profile")] = _varied("profile")
    trajectory: Annotated[Any, Listed("trajectory")] = _varied("trajectory")
    head: Annotated[Any, Listed("head")] = _varied("head")
    tail_motion: Annotated[Any, Listed("tail_motion")] = _varied("tail_motion")
    routing: Annotated[Any, Listed("routing")] = _varied("routing")
    scene: Annotated[Any, Listed("scene")] = _varied("scene")
    tail: Annotated[Any, Listed("tail")] = _varied("tail")
    physics: Annotated[Any, Listed("physics")] = _varied("physics")
    robot: Annotated[Any, Listed("robot")] = _varied("robot")

    @classmethod
    def refuse(cls, key: str) -> None:
        refuse_parameter(key, more=STRUCTURES)


class Choice(NamedTuple):
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

    chosen: Mapping[str, Choice] = dataclasses.field(default_factory=dict)

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
    extra: Any = Pilot.short[0] if name == "pilot" else _ABOUT[name].json_schema_extra
    return list((extra["anyOf"][0] if "anyOf" in extra else extra)["enum"])


def combinations_of(doc: Document, vary: Vary) -> list[dict[str, Choice]]:
    """Every combination of the varied structures, the first of the file slowest; one, of nothing, where none varies."""
    listed: dict[str, list[Choice]] = {}
    for name, given in doc.data.get("vary", {}).items():
        if name in STRUCTURES:
            path = ("vary", name, "values") if isinstance(given, Mapping) else ("vary", name)
            listed[name] = [Choice(value, (*path, i)) for i, value in enumerate(getattr(vary, name))]
    count = math.prod(map(len, listed.values()))
    if count > MOST_STRUCTURES:
        doc.fail(("vary",), f"makes {count:,} combinations of structures; allowed are {MOST_STRUCTURES:,}.")
    return [dict(zip(listed, each, strict=True)) for each in itertools.product(*listed.values())]


def read_structures(
    doc: Document, model: type[WalkFields], combinations: Sequence[Mapping[str, Choice]]
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
            raise SpecError(f"{choice.place or doc.where(choice.path)}: field '{name}' is varied and also given as "
                            f"'{name}': give it one source.")  # fmt: skip
    found = []
    for chosen in combinations:
        single = _alone(doc, chosen)
        walk = read_walk(single, read(single, model))
        fields = WalkSpec(**walk).walk_fields() if chosen else {}
        found.append(Structure(**walk, labels={name: label_of(fields[name]) for name in chosen}))
    return found


def check_repeats(doc: Document, combinations: Sequence[Mapping[str, Choice]], found: Sequence[Structure]) -> None:
    """Fail where a structure lists a value twice."""
    seen: dict[tuple[str, str], FieldPath] = {}
    for chosen, structure in zip(combinations, found, strict=True):
        for name, label in structure.labels.items():
            path = chosen[name].path
            if seen.setdefault((name, label), path) != path:
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


def _alone(doc: Document, chosen: Mapping[str, Choice]) -> Document:
    """The file with one combination in the place of what varies."""
    if not chosen:
        return doc
    data = {key: value for key, value in doc.data.items() if key not in ("vary", "rows", "sample")}
    data |= {name: choice.value for name, choice in chosen.items()}
    return _Alone(doc.source, data, doc.lines, chosen)
