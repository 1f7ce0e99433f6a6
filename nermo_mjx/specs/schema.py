"""The JSON Schema of a spec file, by which an editor completes and checks it while it is written."""

from __future__ import annotations

from typing import Any, Final

from nermo_mjx.specs.fields import Fields, JsonSchema

#: The dialect that the language servers of YAML know best; nothing in the schemas is newer.
_DIALECT: Final = "http://json-schema.org/draft-07/schema#"


def schema_of(model: type[Fields]) -> JsonSchema:
    """The JSON Schema of a file with these fields.

    It knows names, types, ranges and forms. What depends on several fields (a parameter without effect, a stride that
    the legs cannot reach) only reading the file finds.
    """
    return {"$schema": _DIALECT, **_plain(model.model_json_schema())}


def _plain(schema: Any) -> Any:
    """Without the titles, which repeat names, and without defaults that cannot stand in a file."""
    if isinstance(schema, list):
        return [_plain(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    left_out = {"title"} | ({"default"} if isinstance(schema.get("default"), (dict, type(None))) else set())
    return {key: _plain(value) for key, value in schema.items() if key not in left_out}
