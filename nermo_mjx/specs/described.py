"""What the YAML files describe: each kind is read from a file, a text or a dict, and written out in full."""

from __future__ import annotations

import abc
import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from nermo_mjx.files import MAX_JSON_BYTES, read_bytes
from nermo_mjx.robot.quantity import of_type
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.specs.reading import Document, SpecError, dump, read_file, read_mapping, read_text
from nermo_mjx.specs.walk import with_body


class Described(abc.ABC):
    """Base of the four kinds; each says how a document is read (`of_document`) and written (`resolved`)."""

    kind: ClassVar[str]  #: in messages

    @classmethod
    @abc.abstractmethod
    def of_document(cls, doc: Document) -> Self:
        """The checked content of a document; raises `SpecError`."""

    @abc.abstractmethod
    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        """All fields with their defaults written out; they read back as the same.

        Args:
            folder: where the file is to stand, resolved: files in it are named from there.
        """

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], body: str | None = None) -> Self:
        """Read a YAML file; raises `SpecError`.

        Args:
            path: of the file.
            body: directory of an identification, whose best body stands under `set`; see `with_body`.
        """
        return cls.of_document(with_body(read_file(path, cls.kind), body))

    @classmethod
    def from_text(cls, text: str, source: str = "") -> Self:
        """Read YAML text; `source` is its name in messages. Raises `SpecError`."""
        return cls.of_document(read_text(text, source or cls.kind, cls.kind))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Read a dict with the fields of a file; raises `SpecError`."""
        return cls.of_document(read_mapping(data, cls.kind))

    @classmethod
    def of(cls, source: Self | Mapping[str, Any] | str | os.PathLike[str]) -> Self:
        """What is given, or the content of a dict or of a file; raises `SpecError`."""
        if isinstance(source, cls):
            return source
        of_type(
            cls.kind,
            source,
            (Mapping, str, os.PathLike),
            f"a {cls.__name__}, its fields, or the path of a file",
        )
        return cls.from_dict(source) if isinstance(source, Mapping) else cls.from_file(source)  # type: ignore[arg-type]

    def to_yaml(self, folder: Path | None = None) -> str:
        """The file with all defaults written out, see `resolved`."""
        return dump(self.resolved(folder))


D = TypeVar("D", bound=Described)


def write_described(
    directory: RunDirectory,
    name: str,
    description: D,
    read: Callable[[Path], D],
    warn: Callable[[str], None],
) -> None:
    """Write a resolved file into a directory; a user's own file there is moved aside.

    Args:
        directory: the directory.
        name: of the file.
        description: its content.
        read: reads the file that is there.
        warn: called with a message about a file that is moved aside.
    """
    former, folder, path = None, directory.out.resolve(), directory.out / name
    with contextlib.suppress(SpecError):
        former = read(path)
    if former == description:
        return
    if former is None or former.to_yaml(folder).encode() != read_bytes(path, MAX_JSON_BYTES):
        directory.set_aside("another", [name], warn)
    directory.write(name, description.to_yaml(folder).encode())


def digest_of(*parts: Any) -> str:
    """A short hash of plain values."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]
