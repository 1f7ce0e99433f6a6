"""One declaration for a section of a file: a frozen dataclass that is file, object, defaults, bounds and docs at once.

A section is a dataclass that derives from `Spec`. Its annotations carry the bounds (`specs.values`: `Positive`,
`Whole`, `Numbers`, `Choice`, ...), the text under a field is the field's documentation and its description in the JSON
Schema, and its default stands once. A field of a file declares it by its type, and reads it as the object:

>>> @dataclasses.dataclass(frozen=True)
... class Friction(Spec):
...     what = "a field of the friction"
...     sliding: Annotated[float, Field(gt=0)] = 1.0
...     '''coefficient of dry friction'''
>>> written(Friction(sliding=1.2))
{'sliding': 1.2}

Among several sections a file chooses by name, see `one_of`. Errors are told as for all fields (`specs.fields.read`):
file and line, field, value, what is allowed, and the name that may have been meant.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, create_model
from pydantic_core import core_schema

from nermo_mjx.specs.fields import JsonSchema, OneOf, Refused, Section
from nermo_mjx.specs.reading import plain_data


class Spec(Section):
    """A section of a file, to be derived from by a frozen dataclass.

    Attributes:
        elsewhere: fields of the object that stand in another section of the file.
    """

    __pydantic_config__: ClassVar = ConfigDict(
        strict=True, extra="forbid", use_attribute_docstrings=True
    )
    elsewhere: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def declared(cls) -> dict[str, bool]:
        fields: tuple[dataclasses.Field[Any], ...] = dataclasses.fields(cls)  # type: ignore[arg-type]
        declared_fields = (field for field in fields if field.name not in cls.elsewhere)
        return {
            field.name: field.default is dataclasses.MISSING is field.default_factory
            for field in declared_fields
        }

    @classmethod
    def _known(cls, value: Any) -> Any:
        if value is None and (needs := " and ".join(cls.required())):
            raise Refused(f"is without {needs}: expected {cls.example}.")
        return value if isinstance(value, cls) else cls.checked(value)

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        schema: dict[str, Any] = {**handler.resolve_ref_schema(handler(source))}
        schema["strict"] = False  # a mapping will do; its values are checked strictly
        # What stands at the reference is this, so that a second field of the same section is checked, too.
        return core_schema.no_info_before_validator_function(
            cls._known, schema, ref=schema.pop("ref", None)
        )

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchema:
        reference = handler(schema)
        fields = handler.resolve_ref_schema(reference)["properties"]
        for name in cls.elsewhere:
            fields.pop(name, None)
        return reference


@dataclasses.dataclass(frozen=True)
class _Chosen:
    """Marks a field that is written as a name, or as the name and its options, and read as the section chosen."""

    form: type[OneOf]
    models: Mapping[str, type[Spec]]

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_after_validator_function(
            self._made, handler.generate_schema(self.form)
        )

    def _made(self, choice: OneOf) -> Spec:
        name, value = choice.chosen
        return self.models[name]() if value is None else value


def one_of(
    form: str, other: str, models: Mapping[str, type[Spec]], removed: Mapping[str, str] = {}
) -> Any:
    """The marker of a field that is one of several sections: NAME, {NAME: } or {NAME: {option: value}}.

    Args:
        form: name of the form in the JSON Schema.
        other: says of another name that there is no such section.
        models: the sections by their names; the first line of each one's docstring describes it to an editor.
        removed: Names of earlier releases, and what a message says of them.
    """
    fields: dict[str, Any] = {
        name: (
            model if model.required() else model | None,
            Field(default=None, description=(model.__doc__ or "").partition("\n")[0]),
        )
        for name, model in models.items()
    }
    model_type: type[OneOf] = create_model(form, __base__=OneOf, **fields)
    *first, last = models
    names = f"{', '.join(first)} or {last}" if first else last
    model_type.expected = f"{names} as a name, or {{name: {{option: value}}}}"
    model_type.other = other
    model_type.other_name = "is {name!r}"
    model_type.alone = tuple(models)
    model_type.removed = removed
    model_type.short = ({"enum": [name for name, model in models.items() if not model.required()]},)
    return _Chosen(model_type, models)


def written(spec: Spec) -> dict[str, Any]:
    """A section as plain values for a file, with defaults; without fields that are None by default."""
    data = {}
    for field in dataclasses.fields(spec):  # type: ignore[arg-type]
        value = getattr(spec, field.name)
        if field.name not in spec.elsewhere and (value is not None or field.default is not None):
            data[field.name] = plain_data(value)
    return data


def named_section(spec: Any, models: Mapping[str, type[Spec]]) -> dict[str, Any]:
    """One of several sections as a file has it, see `one_of`."""
    name = next(name for name, model in models.items() if isinstance(spec, model))
    return {name: written(spec)}
