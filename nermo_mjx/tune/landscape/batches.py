"""Batches of an unfinished landscape, as files beside its table: what was evaluated outlives an interruption."""

from __future__ import annotations

import contextlib
import io
import zipfile
from pathlib import Path
from typing import Final

import numpy as np

from nermo_mjx.runs.files import replace_file

_FOLDER: Final = "batches"


class Batches:
    """What is there of one landscape in a directory.

    Args:
        out: the directory.
        wanted: the landscape's key; batches of another one are not touched by `read` and `write`.
        size: of a batch; another machine's differ.
    """

    def __init__(self, out: Path, wanted: str, size: int) -> None:
        self._folder, self._name = out / _FOLDER, f"{wanted}-{size}"

    def read(self, first: int) -> dict[str, np.ndarray] | None:
        """The columns of the batch that begins with this point; None if it is not there, or damaged."""
        try:
            with np.load(self._path(first), allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None

    def write(self, first: int, columns: dict[str, np.ndarray]) -> None:
        """Keep a batch; raises `OSError`."""
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **columns)
        replace_file(self._path(first), content.getvalue())

    def clear(self) -> None:
        """Remove them, once the table is written."""
        with contextlib.suppress(OSError):
            for path in self._folder.glob(f"{self._name}-*.npz"):
                path.unlink()
            self._folder.rmdir()

    def _path(self, first: int) -> Path:
        return self._folder / f"{self._name}-{first:06d}.npz"
