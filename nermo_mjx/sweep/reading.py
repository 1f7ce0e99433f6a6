"""Files of a sweep or a tuning as plain values that still know where they stood: each message's `file:line`."""

from __future__ import annotations

import dataclasses
import difflib
import io
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.constructor import DuplicateKeyError
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from nermo_mjx.robot.quantity import ParameterError

#: Keys (and list positions) from the top of a document to one of its fields.
FieldPath = tuple["str | int", ...]


class SpecError(ParameterError):
    """A file that cannot be run; the message is one sentence with file, line, field, value and what is allowed."""


@dataclasses.dataclass(frozen=True)
class Document:
    """A file as plain values, and the line of each of its fields.

    Attributes:
        source: what messages call it: the file's path, or "sweep" or "tuning" for a dict.
        data: the top-level mapping.
        lines: 1-based line of each field, by its path of keys; empty for a dict.
    """

    source: str
    data: dict[str, Any]
    lines: Mapping[FieldPath, int] = dataclasses.field(default_factory=dict)

    def fail(self, path: FieldPath, message: str, field: str | None = None) -> NoReturn:
        """Raise a `SpecError` about the field at `path`: `source:line: field 'name' <message>`."""
        name = ".".join(map(str, path)) if field is None else field
        subject = f"field '{name}' " if name else ""
        raise SpecError(f"{self.where(path)}: {subject}{message}") from None

    def where(self, path: FieldPath) -> str:
        """`source:line` of the innermost enclosing field whose line is known."""
        for length in range(len(path), -1, -1):
            if path[:length] in self.lines:
                return f"{self.source}:{self.lines[path[:length]]}"
        return self.source


def read_file(path: str | os.PathLike[str], what: str = "sweep") -> Document:
    """Read a YAML file; every way in which it is no YAML mapping is a `SpecError`. `what` names its kind."""
    source = os.fspath(path)
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SpecError(f"{source}: there is no such file.") from None
    except UnicodeDecodeError as error:
        raise SpecError(f"{source}: not a text file in UTF-8 ({error.reason} at byte {error.start}).") from None
    except OSError as error:
        raise SpecError(f"{source}: cannot be read ({error.strerror}).") from None
    return read_text(text, source, what)


def read_text(text: str, source: str, what: str = "sweep") -> Document:
    """Read YAML text; see `read_file`."""
    try:
        root = YAML(typ="rt").load(text)
    except DuplicateKeyError as error:
        key = (error.problem or "").split('"')[1:2] or ["?"]
        raise SpecError(f"{_mark(source, error)}: field '{key[0]}' stands twice; keep one of them.") from None
    except MarkedYAMLError as error:
        what = " ".join(part for part in (error.context, error.problem) if part)
        raise SpecError(f"{_mark(source, error)}: not valid YAML: {what}.") from None
    except (YAMLError, ValueError) as error:
        raise SpecError(f"{source}: not valid YAML: {str(error).splitlines()[0]}.") from None
    lines: dict[FieldPath, int] = {(): 1}
    data = _plain(root, (), lines)
    if not isinstance(data, dict):
        raise SpecError(f"{source}:1: a {what} is a mapping of fields, but this file holds {describe(data)}.")
    return Document(source, data, lines)


def read_mapping(data: Mapping[str, Any], what: str = "sweep") -> Document:
    """A document of a dict given in Python; arrays and tuples count as lists. `what` names its kind."""
    if not isinstance(data, Mapping):
        raise SpecError(f"{what}: a {what} is a mapping of fields, not {describe(data)}.")
    return Document(what, _plain(data, (), {}))


def dump(data: Mapping[str, Any]) -> str:
    """YAML text of plain values, lists in one line each."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.width = 120
    stream = io.StringIO()
    yaml.dump(dict(data), stream)
    return stream.getvalue()


def describe(value: Any) -> str:
    """A value in words for a message: what it is, and what kind of thing."""
    if value is None:
        return "nothing"
    kinds = {bool: "the truth value", int: "the number", float: "the number", str: "the text", list: "the list"}
    if isinstance(value, Mapping):
        return "a mapping" + (f" of {', '.join(map(str, value))}" if value else " without fields")
    shown = str(value).lower() if isinstance(value, bool) else repr(value)
    return f"{kinds.get(type(value), type(value).__name__)} {shown if len(shown) <= 60 else shown[:57] + '...'}"


def nearest(name: str, allowed: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the nearest allowed name, or a full stop where none is near."""
    names = list(allowed)
    found = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    if not found:  # `amplitude` for `spine.amplitude`
        found = [full for full in names if full.rpartition(".")[2] == name.rpartition(".")[2]][:1]
    return f"; did you mean '{found[0]}'?" if found else "."


def _mark(source: str, error: MarkedYAMLError) -> str:
    mark = error.problem_mark or error.context_mark
    return f"{source}:{mark.line + 1}" if mark is not None else source


def _plain(value: Any, path: FieldPath, lines: dict[FieldPath, int]) -> Any:
    """Plain dicts, lists, strings and numbers; notes the line of each key on the way."""
    if isinstance(value, Mapping):
        if isinstance(value, CommentedMap):
            lines |= {(*path, str(key)): value.lc.key(key)[0] + 1 for key in value}
        return {str(key): _plain(item, (*path, str(key)), lines) for key, item in value.items()}
    if isinstance(value, CommentedSeq):
        lines |= {(*path, i): value.lc.item(i)[0] + 1 for i in range(len(value))}
    if isinstance(value, (list, tuple)):
        return [_plain(item, (*path, i), lines) for i, item in enumerate(value)]
    if hasattr(value, "tolist"):  # numpy and JAX arrays and scalars
        return value.tolist()
    for kind in (bool, int, float, str):  # ruamel's ScalarFloat, ScalarInt, quoted strings
        if isinstance(value, kind):
            return kind(value)
    return value
