"""Which files of an experiment the program wrote itself: it replaces and removes these, and no others."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from nermo_mjx.runs import RunDirectory
from nermo_mjx.runs.files import clear_errors

T = TypeVar("T")


class Written:
    """Writes files of one experiment; what stands in the way and is not the program's own is moved aside.

    Args:
        held: the directory.
        known: path in the directory -> digest of what the program wrote there.

    Attributes:
        known: the same, with what was written since; it belongs into the experiment's entry.
        aside: new paths of the files that were moved aside.
    """

    def __init__(self, held: RunDirectory, known: Mapping[str, str]) -> None:
        self.held, self.known = held, dict(known)
        self.aside: list[str] = []

    def write(self, path: Path, content: bytes) -> None:
        """Replace a file, by its path with the directory's; whole or not at all.

        Raises:
            DirectoryError: it cannot be written.
        """
        if self._digest_of(path) not in (None, self.known.get(self._name(path)), digest(content)):
            self._move_aside(path)
        self.held.write(self._name(path), content)
        self.known[self._name(path)] = digest(content)

    def make(self, path: Path, maker: Callable[[Path], T]) -> T:
        """Have a file made by a function that writes it, and return what that returns.

        Raises:
            DirectoryError: what stands in the way cannot be moved.
        """
        if self._digest_of(path) not in (None, self.known.get(self._name(path))):
            self._move_aside(path)
        made = maker(path)
        self.known[self._name(path)] = str(self._digest_of(path))
        return made

    def remove(self, names: Iterable[str]) -> None:
        """Remove files, by their paths in the directory, that are as the program wrote them; the others stay."""
        for name in names:
            path, own = self.held.out / name, self.known.pop(name, None)
            if own is not None and self._digest_of(path) == own:
                with clear_errors(self.held.out):
                    path.unlink()

    def clear(self, path: Path) -> None:
        """See that there is no file of this name: the program's own is removed, another one moved aside.

        Raises:
            DirectoryError: it cannot be.
        """
        self.remove([self._name(path)])
        if path.exists():
            self._move_aside(path)

    def sentence(self) -> str:
        """What was moved aside; empty if nothing was."""
        if not self.aside:
            return ""
        more = f" and {len(self.aside) - 1} more" if len(self.aside) > 1 else ""
        what = "Files were in the way that are not as this program wrote them" if more else (
            "A file was in the way that is not as this program wrote it"
        )  # fmt: skip
        return f"{what}: moved aside in {self.held.out}, to {self.aside[0]}{more}."

    def _move_aside(self, path: Path) -> None:
        moved = self.held.move_aside(self._name(path))
        if moved is not None:
            self.aside.append(self._name(moved))

    def _digest_of(self, path: Path) -> str | None:
        """Digest of a file; None if there is none, or a folder's own word."""
        with clear_errors(self.held.out):
            if path.is_dir():
                return "a folder"
            return digest(path.read_bytes()) if path.exists() else None

    def _name(self, path: Path) -> str:
        return path.relative_to(self.held.out).as_posix()


def digest(content: bytes) -> str:
    """A short hash of a file's content."""
    return hashlib.blake2b(content, digest_size=8).hexdigest()
