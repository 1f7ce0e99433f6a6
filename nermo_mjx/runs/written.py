"""Which files of a directory the program wrote itself: it replaces and removes only these."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from nermo_mjx.runs.directory import RunDirectory, read_record
from nermo_mjx.runs.files import clear_errors

T = TypeVar("T")


class Written:
    """Writes files of a directory; files in the way that are not the program's own are moved aside.

    Use it in a `with` statement: what was written is noted in run.json, as `files`, path -> digest.

    Args:
        held: the directory.

    Attributes:
        known: path in the directory -> digest of what the program wrote there.
        aside: new paths of the files that were moved aside.
    """

    def __init__(self, held: RunDirectory) -> None:
        self.held = held
        self.known: dict[str, str] = dict(read_record(held.out).get("files", {}))
        self.aside: list[str] = []

    def __enter__(self) -> Written:
        return self

    def __exit__(self, *_: object) -> None:
        self.note()

    def note(self) -> None:
        """Record now what was written, so that the files are recognized even if the process is killed later."""
        self.held.note_files(self.known)

    def write(self, path: Path, content: bytes) -> None:
        """Replace a file, by its path with the directory's; atomically.

        Raises:
            DirectoryError: it cannot be written.
        """
        if self._digest_of(path) not in (None, self.known.get(self.name(path)), digest(content)):
            self._move_aside(path)
        self.held.write(self.name(path), content)
        self.known[self.name(path)] = digest(content)

    def make(self, path: Path, maker: Callable[[Path], T]) -> T:
        """Call a function that writes a file, and return its result.

        Raises:
            DirectoryError: what stands in the way cannot be moved.
        """
        if self._digest_of(path) not in (None, self.known.get(self.name(path))):
            self._move_aside(path)
        made = maker(path)
        self.known[self.name(path)] = str(self._digest_of(path))
        return made

    def remove(self, names: Iterable[str]) -> None:
        """Remove files, by their paths in the directory, if they are unmodified; the others are kept."""
        for name in names:
            path, own = self.held.out / name, self.known.pop(name, None)
            if own is not None and self._digest_of(path) == own:
                with clear_errors(self.held.out):
                    path.unlink()

    def clear(self, path: Path) -> None:
        """Make way for a file of this name: the program's own file is removed, any other one moved aside.

        Raises:
            DirectoryError: it cannot be.
        """
        self.remove([self.name(path)])
        if path.exists():
            self._move_aside(path)

    def sentence(self) -> str:
        """What was moved aside; empty if nothing was."""
        if not self.aside:
            return ""
        more = f" and {len(self.aside) - 1} more" if len(self.aside) > 1 else ""
        what = (
            "Files in the way were not as this program wrote them"
            if more
            else ("A file in the way was not as this program wrote it")
        )
        return f"{what}: moved aside in {self.held.out}, to {self.aside[0]}{more}."

    def name(self, path: Path) -> str:
        """The path of a file from the directory, for links as well."""
        return path.relative_to(self.held.out).as_posix()

    def _move_aside(self, path: Path) -> None:
        moved = self.held.move_aside(self.name(path))
        if moved is not None:
            self.aside.append(self.name(moved))

    def _digest_of(self, path: Path) -> str | None:
        """Digest of a file; None if it does not exist, a marker for a folder."""
        with clear_errors(self.held.out):
            if path.is_dir():
                return "a folder"
            return digest(path.read_bytes()) if path.exists() else None


def digest(content: bytes) -> str:
    """A short hash of a file's content."""
    return hashlib.blake2b(content, digest_size=8).hexdigest()
