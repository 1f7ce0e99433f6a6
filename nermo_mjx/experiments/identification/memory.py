"""Candidates of an identification on disk: one line a generation, so that a killed search loses no more than that."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from nermo_mjx.robot.quantity import ParameterError


class CandidateFile:
    """Implements `search.Memory` in a file of JSON lines; the first line says what the search is.

    Args:
        path: the file; made if it does not exist.
        about: settings of the search, engine and versions; with others the speeds would not be the same.

    Raises:
        ParameterError: the file belongs to another search.
        OSError: it cannot be read or written.
    """

    def __init__(self, path: Path, about: dict[str, object]) -> None:
        self.path = path
        self._known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
        text = path.read_text() if path.exists() else ""
        lines = text.splitlines()
        about = json.loads(json.dumps(about))
        if not lines:
            self._append(about)
            return
        if json.loads(lines[0]) != about:
            raise ParameterError(f"{path} belongs to a search with other settings: choose another directory.")
        if not text.endswith("\n"):  # cut off by whatever killed the search: what comes next needs its own line
            with open(path, "a") as file:
                file.write("\n")
        for line in lines[1:]:
            try:
                row = json.loads(line)
            except json.JSONDecodeError:
                continue
            points = np.array(row["points"], float)
            self._known[points.tobytes()] = np.array(row["speed"], float), np.array(row["walked"], bool)

    def recall(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """See `search.Memory.recall`."""
        return self._known.get(np.ascontiguousarray(points, float).tobytes())

    def keep(self, points: np.ndarray, speed: np.ndarray, walked: np.ndarray) -> None:
        """See `search.Memory.keep`."""
        self._append({"points": points.tolist(), "speed": speed.tolist(), "walked": walked.tolist()})

    def _append(self, row: dict[str, object]) -> None:
        with open(self.path, "a") as file:
            file.write(json.dumps(row) + "\n")
            file.flush()
            os.fsync(file.fileno())
