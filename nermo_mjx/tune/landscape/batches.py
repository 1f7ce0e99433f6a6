"""Batches of an unfinished landscape, stored as files, so that evaluations survive an interruption."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from nermo_mjx.files import FileError, arrays_of
from nermo_mjx.runs import RunDirectory
from nermo_mjx.runs.files import content_of

_FOLDER: Final = "batches"


class Batches:
    """Stored batches of one landscape in a directory.

    Args:
        held: the directory.
        wanted: the landscape's key; batches of another one are not touched.
        size: of a batch; another machine's differ.
        code: short name of the code that evaluates here.
        warn: called with a message about each batch that is moved aside.
    """

    def __init__(
        self, held: RunDirectory, wanted: str, size: int, code: str, warn: Callable[[str], None] = lambda _: None
    ) -> None:
        self.out, self.size = held.out, size
        self._held, self._name, self._code, self._warn = held, f"{wanted}-{size}", code, warn

    def read(self, first: int) -> dict[str, np.ndarray] | None:
        """The columns of the batch that begins with this point; None if it is not there, or damaged and set aside.

        Raises:
            DirectoryError: it cannot be read now.
        """
        content = content_of(self.out / self._path(first))
        if content is None:
            return None
        try:
            return arrays_of(content, self._path(first))
        except FileError:
            self._held.set_aside("damaged", [self._path(first)], self._warn)
            return None

    def write(self, first: int, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Store a batch with the code that made it; returns its columns, as read back."""
        columns = {"code": np.full(len(columns["value"]), self._code), **columns}
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **columns)
        self._held.write(self._path(first), content.getvalue())
        return columns

    def clear(self) -> None:
        """Remove them after the table has been written."""
        folder = self.out / _FOLDER
        with contextlib.suppress(OSError):
            for path in folder.glob(f"{self._name}-*.npz"):
                path.unlink()
            folder.rmdir()

    def _path(self, first: int) -> str:
        return f"{_FOLDER}/{self._name}-{first:06d}.npz"


def any_batch(out: Path) -> bool:
    """Whether a directory holds batches of any landscape."""
    return any((out / _FOLDER).glob("*.npz"))
