"""Declared fields of spec files: self-describing pydantic models that refuse each wrong value in one sentence.

Pydantic was chosen because its errors are data (where, which value) that can be turned into a sentence, because a
validator can raise such a sentence itself, and because a field may have one of several forms that differ by a key.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Final, TypeVar, get_args, get_type_hints

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import core_schema

from nermo_mjx.robot.quantity import ParameterError, did_you_mean
from nermo_mjx.specs.reading import Document, FieldPath, describe

JsonSchema = dict[str, Any]
M = TypeVar("M", bound="Fields")
#: The dialect that YAML language servers support best; the schemas use nothing newer.
_DIALECT: Final = "http://json-schema.org/draft-07/schema#"
#: Expectations for pydantic's errors about types and ranges.
_TYPES: Final = {
    "float_type": "a number",
    "bool_type": "true or false",
    "string_type": "a name",
    "dict_type": "a mapping",
    "list_type": "a list",
    "tuple_type": "a list",
    "none_required": "nothing",
}
_RANGES: Final = {
    "greater_than": "a finite number above 0",
    "finite_number": "a finite number",
    "greater_than_equal": "a number of at least {ge:g}",
    "less_than_equal": "a number of at most {le:g}",
}


class Refused(ValueError):
    """A validator's message about a wrong value.

    Attributes:
        path: keys from the checked value to the one that the message is about.
        at: further keys, to the place in the file.
    """

    def __init__(self, message: str, *path: str | int, at: FieldPath = ()) -> None:
        super().__init__(message)
        self.path, self.at = path, at


def read(doc: Document, model: type[M]) -> M:
    """The document as a model; raises a `SpecError` about the first field that is wrong."""
    try:
        return model.model_validate(doc.data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    refused = first.get("ctx", {}).get("error")
    path = _place(doc.data, first["loc"])
    value = first["input"]
    if isinstance(refused, Refused):
        path, location, message = (
            (*path, *refused.path),
            (*path, *refused.path, *refused.at),
            str(refused),
        )
    elif isinstance(
        refused, ParameterError
    ):  # of a section's own check; its first word is the section or a field
        name, _, message = str(refused).partition(" ")
        path = location = (
            (*path, *name.split(".")[1:]) if path and name.split(".")[0] == path[-1] else path
        )
    else:
        listing = (
            f"{value:g}"
            if first["type"] in _RANGES and not isinstance(value, str)
            else describe(value)
        )
        allowed = (_TYPES | _RANGES)[first["type"]].format(**first.get("ctx", {}))
        location, message = path, f"is {listing}: expected {allowed}."
    doc.fail(location, message, model.called(path))


def _place(data: Any, location: FieldPath) -> FieldPath:
    """As far as the document goes: what follows are types that a field may have, or belongs to a short form."""
    for i, key in enumerate(location):
        if not (
            key in data
            if isinstance(data, dict)
            else isinstance(data, list) and isinstance(key, int)
        ):
            return location[:i]
        data = data[key]
    return location


def optional(description: str | None = None, *, alias: str | None = None, **schema: Any) -> Any:
    """An optional field: None if missing, which cannot be written in the file. `schema`: additions for an editor."""
    return Field(
        default=None, alias=alias, description=description, json_schema_extra=schema or None
    )


class Section:
    """A mapping with known fields: how the sections of files refuse others, whatever declares them.

    Attributes:
        what: what one of them is, for messages: "a field of a run".
        expected: instead of something that is no mapping.
        example: where a field is missing that must be there.
    """

    what: ClassVar[str]
    expected: ClassVar[str] = ""
    example: ClassVar[str] = ""

    @classmethod
    def declared(cls) -> dict[str, bool]:
        """The fields by their names in the file, and whether each must be there."""
        raise NotImplementedError

    @classmethod
    def required(cls) -> list[str]:
        """Names of the fields without a default."""
        return [name for name, is_required in cls.declared().items() if is_required]

    @classmethod
    def checked(cls, value: Any) -> Any:
        """A mapping with these fields and no others; raises `Refused`."""
        names = cls.declared()
        if not isinstance(value, dict):
            expected = cls.expected or f"a mapping of {', '.join(names) or 'nothing'}"
            raise Refused(f"is {describe(value)}: expected {expected}.")
        for key in value:
            if key not in names:
                cls.refuse(key)
        for name in cls.required():
            if name not in value:
                raise Refused(f"has no '{name}': expected {cls.example}.")
        return value

    @classmethod
    def refuse(cls, key: str) -> None:
        """Raise `Refused` about an unknown field; one that is allowed nevertheless passes."""
        allowed = f"allowed are {', '.join(cls.declared())}" if cls.declared() else "it has none"
        raise Refused(f"is not {cls.what}; {allowed}{did_you_mean(key, cls.declared())}", key)


class Fields(Section, BaseModel):
    """A section that pydantic reads as a model of its own.

    Attributes:
        short: JSON Schemas of the short forms.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")
    short: ClassVar[tuple[JsonSchema, ...]] = ()

    @model_validator(mode="before")
    @classmethod
    def _known(cls, value: Any) -> Any:
        return cls.checked(cls.written_out(value))

    @classmethod
    def declared(cls) -> dict[str, bool]:
        return {
            field.alias or name: field.is_required() for name, field in cls.model_fields.items()
        }

    @classmethod
    def written_out(cls, value: Any) -> Any:
        """The mapping that a short form stands for."""
        return value

    @classmethod
    def called(cls, path: FieldPath) -> str:
        """What messages about a file of these fields call the field at `path`."""
        return ".".join(map(str, path))

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchema:
        reference = handler(schema)
        if cls.short:
            schema_of_field = handler.resolve_ref_schema(reference)
            mapping = dict(schema_of_field)
            schema_of_field.clear()
            schema_of_field["anyOf"] = [*cls.short, mapping]
        return reference


class OneOf(Fields):
    """A mapping of one field, such as {linspace: [0, 1, 5]}.

    Attributes:
        alone: names of fields that may be given without a mapping; by default these are the short forms.
        other: says of a field's name that there is no such field; with `{name}` in it, it is about the whole.
        other_name: the same for a name given alone.
        removed: names of earlier releases, and what a message says of them.
    """

    model_config = ConfigDict(json_schema_extra={"minProperties": 1, "maxProperties": 1})
    alone: ClassVar[tuple[str, ...]] = ()
    other: ClassVar[str]
    other_name: ClassVar[str] = "is the text {name!r}"
    removed: ClassVar[Mapping[str, str]] = {}

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        if cls.alone and not cls.short:
            cls.short = ({"enum": [*cls.alone]},)

    @classmethod
    def written_out(cls, value: Any) -> Any:
        """As a mapping, of exactly one field."""
        for name in (
            (value,) if isinstance(value, str) else value if isinstance(value, dict) else ()
        ):
            if name in cls.removed:
                raise Refused(f"is {name!r}, {cls.removed[name]}.")
        if isinstance(value, str) and value in cls.alone:
            return {value: None}
        if isinstance(value, str) and value in cls.declared():
            model, needs, example = cls.model_fields[value].annotation, "its value", cls.expected
            if isinstance(model, type) and issubclass(model, Fields):
                needs, example = " and ".join(model.required()), model.example
            raise Refused(f"is '{value}' without {needs}: expected {example}.")
        if isinstance(value, str):
            raise Refused(
                f"{cls.other_name.format(name=value)}: expected {cls.expected}{did_you_mean(value, cls.declared())}"
            )
        if isinstance(value, dict) and len(value) != 1:
            raise Refused(f"is {describe(value)}: expected {cls.expected}.")
        return value

    @classmethod
    def refuse(cls, key: str) -> None:
        message = f"{cls.other.format(name=key)}: expected {cls.expected}{did_you_mean(key, cls.declared())}"
        raise Refused(message, at=(key,)) if "{name" in cls.other else Refused(message, key)

    @property
    def chosen(self) -> tuple[str, Any]:
        """The name of the given field, and its value."""
        (name,) = self.model_fields_set
        return name, getattr(self, name)


def documented(cls: type) -> dict[str, Any]:
    """Type and default of a dataclass's fields that have a description, as `create_model` takes them for a file."""
    hints = get_type_hints(cls, include_extras=True)
    fields = {field.name: (hints[field.name], field.default) for field in dataclasses.fields(cls)}
    described = (
        name
        for name in fields
        if any(isinstance(annotation, FieldInfo) for annotation in get_args(hints[name]))
    )
    return {name: fields[name] for name in described}


def schema_of(model: type[Fields]) -> JsonSchema:
    """The JSON Schema of a file with these fields.

    It knows names, types, ranges and forms. What depends on several fields (a parameter without effect, a stride that
    the legs cannot reach) only reading the file finds.
    """
    return {"$schema": _DIALECT, **_plain(model.model_json_schema())}


def _plain(schema: Any) -> Any:
    """Without the titles, which repeat names, and without defaults that cannot be written in a file."""
    if isinstance(schema, list):
        return [_plain(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    left_out = {"title"} | (
        {"default"} if isinstance(schema.get("default"), (dict, type(None))) else set()
    )
    return {key: _plain(value) for key, value in schema.items() if key not in left_out}
