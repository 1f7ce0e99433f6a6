"""Patterns in place of parameter names, so that 64 parameters take one line: `foot.*_left.y?`, `spine.harmonics.*`.

Shell-style patterns: `*` matches anything, `?` one character, `[1-4]` one of these. A pattern means every
parameter whose name it matches, as if each were listed with the given value.
"""

from __future__ import annotations

import dataclasses
import fnmatch
from collections.abc import Iterable
from typing import Any, Final

from nermo_mjx.specs.reading import Document, FieldPath
from nermo_mjx.specs.values import NAMES

#: Sections of files whose keys are names of parameters.
_SECTIONS: Final = ("set", "vary", "tune", "randomize")


def matches(pattern: str, names: Iterable[str]) -> list[str]:
    """The names that a pattern matches, in their order.

    >>> matches("spine.*e", ["spine.amplitude", "spine.harmonics.cos1", "stance.front_y"])
    ['spine.amplitude']
    """
    return [name for name in names if fnmatch.fnmatchcase(name, pattern)]


def is_pattern(key: str) -> bool:
    """Whether a key is a pattern rather than a name."""
    return any(mark in key for mark in "*?[")


def written_out(doc: Document) -> Document:
    """The document with its patterns expanded to the names that they match.

    A name given explicitly takes precedence over patterns.

    Raises:
        SpecError: a pattern matches nothing, or two patterns match one name.
    """
    data, lines = dict(doc.data), dict(doc.lines)
    for section in _SECTIONS:
        given = data.get(section)
        if isinstance(given, dict) and any(map(is_pattern, given)):
            origin = _origins(doc, section, given)
            data[section] = {name: given[key] for name, key in origin.items()}
            lines |= _lines(doc, section, origin)
    return dataclasses.replace(doc, data=data, lines=lines)


def _origins(doc: Document, section: str, given: dict[str, Any]) -> dict[str, str]:
    """Each name, and the key of the file that it has its value from."""
    origin: dict[str, str] = {}
    for key in given:
        if not is_pattern(key):
            origin[key] = key
            continue
        found = matches(key, NAMES.get())
        if not found:
            doc.fail((section, key), "matches no parameter (nermo-mjx sweep --list-parameters prints all).", key)
        for name in found:
            if name in origin and name not in given:
                doc.fail((section, key), f"and '{origin[name]}' both match {name}: give it one source.", key)
            if name not in given:
                origin[name] = key
    return origin


def _lines(doc: Document, section: str, origin: dict[str, str]) -> dict[FieldPath, int]:
    """The line numbers under a pattern, for each name that it matches."""
    moved: dict[FieldPath, int] = {}
    below: dict[str, list[FieldPath]] = {}
    for path in doc.lines:
        if len(path) > 1 and path[0] == section:
            below.setdefault(str(path[1]), []).append(path)
    for name, key in origin.items():
        moved |= {(section, name, *path[2:]): doc.lines[path] for path in below.get(key, ())}
    return moved
