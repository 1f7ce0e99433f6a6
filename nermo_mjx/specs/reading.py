"""Spec files as plain values that keep their line numbers, for the `file:line` of each message."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NoReturn

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from nermo_mjx.files import read_bytes
from nermo_mjx.robot.quantity import ParameterError, of_type
from nermo_mjx.trust import FileError, shortened

#: Keys (and list positions) from the top of a document to one of its fields.
FieldPath = tuple["str | int", ...]
#: Prefix of YAML's own tags, and the tags of plain values; all other tags are refused.
_TAG_PREFIX: Final = "tag:yaml.org,2002:"
_PLAIN_TAGS: Final = frozenset(
    _TAG_PREFIX + name for name in ("map", "seq", "str", "int", "float", "bool", "null")
)
_MERGE_TAG: Final = f"{_TAG_PREFIX}merge"
#: Values that a file's aliases may stand for, in all.
_MAX_ALIAS_VALUES: Final = 100_000
#: Bytes of a file, and lists, mappings, their ends, and plain values in it.
_MAX_YAML_BYTES: Final = 1 << 23
_MAX_YAML_VALUES: Final = 50_000


class SpecError(ParameterError, FileError):
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
        subject = f"field '{shortened(name, 200)}' " if name else ""
        raise SpecError(f"{self.where(path)}: {subject}{message}") from None

    def where(self, path: FieldPath) -> str:
        """`source:line` of the innermost enclosing field whose line is known."""
        for length in range(len(path), -1, -1):
            if path[:length] in self.lines:
                return f"{self.source}:{self.lines[path[:length]]}"
        return self.source


#: Brackets that may be open at once.
_MAX_BRACKETS: Final = 200


def read_file(path: str | os.PathLike[str], kind: str = "sweep") -> Document:
    """Read a YAML file; raises a `SpecError` if it is not a YAML mapping. `what` names its kind."""
    source = os.fspath(of_type("path", path, (str, os.PathLike), "the path of a file"))
    try:
        text = read_bytes(Path(path), _MAX_YAML_BYTES).decode()
    except FileNotFoundError:
        raise SpecError(f"{source}: there is no such file.") from None
    except UnicodeDecodeError as error:
        raise SpecError(
            f"{source}: not a text file in UTF-8 ({error.reason} at byte {error.start})."
        ) from None
    except OSError as error:
        raise SpecError(f"{source}: cannot be read ({error.strerror}).") from None
    return read_text(text, source, kind)


def read_text(text: str, source: str, kind: str = "sweep") -> Document:
    """Read YAML text; see `read_file`."""
    of_type("text", text, str, "YAML text")
    yaml = YAML(typ="safe", pure=True)
    try:
        opened = 0
        for text_line in text.splitlines():  # the parser takes minutes to find out
            opened += sum(map(text_line.count, "[{")) - sum(map(text_line.count, "]}"))
            if opened > _MAX_BRACKETS:
                raise RecursionError
        if (
            len(text) > _MAX_YAML_VALUES
            and len(list(itertools.islice(yaml.parse(text), _MAX_YAML_VALUES))) == _MAX_YAML_VALUES
        ):
            raise SpecError(
                f"{source}: it holds more than {_MAX_YAML_VALUES:,} values: allowed are fewer; rows can stand in a table."
            )
        root = yaml.compose(text)
        reader = _NodeReader(source, kind, yaml)
        data = None if root is None else reader.value(root, ())
    except RecursionError:
        depths = [
            len(line) - len(line.lstrip()) + line.count("[") + line.count("{")
            for line in text.splitlines()
        ]
        deepest = depths.index(max(depths)) + 1
        raise SpecError(
            f"{source}:{deepest}: lists or mappings stand too deep in one another: close the brackets."
        ) from None
    except MarkedYAMLError as error:
        wrong = " ".join(part for part in (error.context, error.problem) if part)
        mark = error.problem_mark or error.context_mark
        location = f"{source}:{mark.line + 1}" if mark is not None else source
        raise SpecError(f"{location}: not valid YAML: {wrong}.") from None
    except SpecError:
        raise
    except (YAMLError, ValueError) as error:
        raise SpecError(f"{source}: not valid YAML: {str(error).splitlines()[0]}.") from None
    if not isinstance(data, dict):
        raise SpecError(
            f"{source}:1: a {kind} is a mapping of fields, but this file holds {describe(data)}."
        )
    return Document(source, data, reader.lines)


def read_mapping(data: Mapping[str, Any], kind: str = "sweep") -> Document:
    """A document of a dict given in Python; arrays and tuples count as lists. `what` names its kind."""
    if not isinstance(data, Mapping):
        raise SpecError(f"{kind}: a {kind} is a mapping of fields, not {describe(data)}.")
    return Document(kind, plain_data(data))


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
    """A value in words for a message, with its kind."""
    if value is None:
        return "nothing"
    kinds = {
        bool: "the truth value",
        int: "the number",
        float: "the number",
        str: "the text",
        list: "the list",
    }
    if isinstance(value, Mapping):
        return "a mapping" + (f" of {', '.join(map(str, value))}" if value else " without fields")
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return f"{kinds.get(type(value), type(value).__name__)} {text if len(text) <= 60 else text[:57] + '...'}"


class _NodeReader:
    """Plain values of YAML's nodes: aliases and merge keys are resolved, and each field's line is noted."""

    def __init__(self, source: str, kind: str, yaml: YAML) -> None:
        self.source, self.what, self._scalars = source, kind, yaml.constructor
        self.lines: dict[FieldPath, int] = {(): 1}
        self._open: list[Node] = []
        self._seen: set[int] = set()
        self._repeated = 0

    def value(self, node: Node, path: FieldPath) -> Any:
        """The plain value of a node, which belongs to the field at `path`."""
        self._repeated += id(node) in self._seen
        self._seen.add(id(node))
        if self._repeated > _MAX_ALIAS_VALUES:
            self._refuse(
                node,
                f"aliases stand for more than {_MAX_ALIAS_VALUES:,} values: write out what is meant.",
            )
        if node.tag not in _PLAIN_TAGS:
            self._refuse(
                node,
                f"{self._subject(path)} is {_tagged(node)}: allowed are texts (in quotes where needed), numbers, "
                "true, false, lists and mappings.",
            )
        if isinstance(node, ScalarNode):
            try:
                return self._scalars.construct_object(node)
            except (ValueError, YAMLError):
                self._refuse(node, f"{self._subject(path)} is {_tagged(node)}, which it is not.")
        with self._opened(node, path):
            if isinstance(node, SequenceNode):
                return [self._item(item, (*path, i), item) for i, item in enumerate(node.value)]
            return {
                name: self._item(item, (*path, name), key)
                for name, (key, item) in self._fields(node, path).items()
            }

    def _item(self, node: Node, path: FieldPath, parent: Node) -> Any:
        """The value of a field, whose line is that of `place`."""
        self.lines[path] = parent.start_mark.line + 1
        return self.value(node, path)

    def _fields(self, node: Node, path: FieldPath) -> dict[str, tuple[Node, Node]]:
        """Key and value of each field of a mapping; those of merged mappings come first and are overridden."""
        entries: dict[str, tuple[Node, Node]] = {}
        merged: dict[str, tuple[Node, Node]] = {}
        bases = None
        for key, item in node.value:
            if key.tag == _MERGE_TAG:
                if bases is not None:
                    self._refuse(
                        key, f"{self._subject((*path, '<<'))} stands twice; merge a list instead."
                    )
                bases = item.value if isinstance(item, SequenceNode) else [item]
                for base in bases:
                    for name, field in self._base(base, (*path, "<<")).items():
                        merged.setdefault(name, field)
                continue
            name = self._name(key, path)
            if name in entries:
                self._refuse(key, f"{self._subject((*path, name))} stands twice; keep one of them.")
            entries[name] = key, item
        return {**merged, **entries}

    def _base(self, node: Node, path: FieldPath) -> dict[str, tuple[Node, Node]]:
        """The fields of a mapping that is merged."""
        if not isinstance(node, MappingNode) or node.tag not in _PLAIN_TAGS:
            description = describe(self.value(node, path))
            self._refuse(
                node,
                f"{self._subject(path)} is {description}: expected a mapping or a list of mappings.",
            )
        with self._opened(node, path):
            return self._fields(node, path)

    def _name(self, key: Node, path: FieldPath) -> str:
        """The name of a field of the mapping at `path`."""
        if isinstance(key, ScalarNode) and key.tag == f"{_TAG_PREFIX}str":
            return str(key.value)
        plain = isinstance(key, ScalarNode) and key.tag in _PLAIN_TAGS
        description = describe(self.value(key, path)) if plain else _tagged(key)
        self._refuse(key, f"the name of a field is {description}: expected a text.")

    @contextlib.contextmanager
    def _opened(self, node: Node, path: FieldPath) -> Iterator[None]:
        """While a node is being read, an alias to it would be circular."""
        if any(node is ancestor for ancestor in self._open):
            self._refuse(node, f"{self._subject(path)} contains itself through an alias.")
        self._open.append(node)
        yield
        self._open.pop()

    def _subject(self, path: FieldPath) -> str:
        return f"field '{shortened('.'.join(map(str, path)), 200)}'" if path else f"the {self.what}"

    def _refuse(self, node: Node, message: str) -> NoReturn:
        raise SpecError(f"{self.source}:{node.start_mark.line + 1}: {message}") from None


def _tagged(node: Node) -> str:
    """A node in words, with its tag unless it is a list or mapping."""
    tag = str(node.tag).replace(_TAG_PREFIX, "!!")
    if isinstance(node, ScalarNode):
        return f"'{node.value}' with the tag {tag}"
    kind = "a list" if isinstance(node, SequenceNode) else "a mapping"
    return kind if node.tag in _PLAIN_TAGS else f"{kind} with the tag {tag}"


def plain_data(value: Any) -> Any:
    """Plain dicts, lists, strings and numbers of what Python gave."""
    if isinstance(value, Mapping):
        return {str(key): plain_data(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_data(item) for item in value]
    if hasattr(value, "tolist"):  # numpy and JAX arrays and scalars
        return value.tolist()
    for kind in (bool, int, float, str):  # and what derives from them
        if isinstance(value, kind):
            return kind(value)
    return value


def changes(former: Mapping[str, Any], current: Mapping[str, Any]) -> list[str]:
    """Where two mappings of fields differ, as "seed (3 there, 4 here)"."""
    return [
        f"{name} ({old} there, {now} here)"
        for name, (old, now) in differing(former, current).items()
    ]


def differing(former: Mapping[str, Any], current: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Both values of each field in which two mappings differ, by its dotted name; or the word absent."""
    old, now = dict(_leaves(former)), dict(_leaves(current))
    shared = {name: (old.get(name, "absent"), now.get(name, "absent")) for name in {**old, **now}}
    return {name: (a, b) for name, (a, b) in shared.items() if a != b}


def _leaves(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in data.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
