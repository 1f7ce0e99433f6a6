"""Candidates of an identification on disk: one line per generation, so that a killed search loses at most one
generation."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.files import append_line, clear_errors

#: Files of an identification's directory: the candidates, and the result of a finished search.
FILE: Final = "candidates.jsonl"
RESULT: Final = "identification.json"


class CandidateFile:
    """Earlier walks, in a file of JSON lines; the first line describes the search.

    Args:
        path: the file; created if it does not exist.
        about: settings of the search and the robot, which determine the candidates.
        code: short name of the code that adds candidates, see `nermo_mjx.runs.code`.

    Raises:
        ParameterError: the file belongs to another search.
        DirectoryError: it cannot be written.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path, about: dict[str, object], code: str) -> None:
        self.path, self.code = path, code
        self._known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
        lines = path.read_text().splitlines() if path.exists() else []
        about = json.loads(json.dumps(about))
        if not lines:
            self._append(about)
            return
        # Earlier releases also stored versions and engine here; the directory checks whether they match.
        begun = _parsed(lines[0])
        if {name: begun.get(name) for name in about} != about:
            raise ParameterError(f"{path} belongs to a search with other settings: choose another directory.")
        for row in candidates(lines[1:]):
            points = np.array(row["points"], float)
            self._known[points.tobytes()] = np.array(row["speed"], float), np.array(row["walked"], bool)

    def recall(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Speed and whether the walk was completed, (n, cases) each, of known points (n, d); else None."""
        return self._known.get(np.ascontiguousarray(points, float).tobytes())

    def keep(self, points: np.ndarray, speed: np.ndarray, walked: np.ndarray) -> None:
        """Remember the speeds of points."""
        found = {"points": points.tolist(), "speed": speed.tolist(), "walked": walked.tolist()}
        self._append({"code": self.code, **found})

    def _append(self, row: dict[str, object]) -> None:
        with clear_errors(self.path.parent):
            append_line(self.path, json.dumps(row))


def candidates(lines: Iterable[str]) -> Iterator[dict[str, Any]]:
    """The generations in the lines after the first; a truncated one was being written when the search was killed."""
    for line in lines:
        row = _parsed(line)
        if {"points", "speed", "walked"} <= set(row):
            yield row


def _parsed(line: str) -> dict[str, Any]:
    try:
        row = json.loads(line)
    except ValueError:
        return {}
    return row if isinstance(row, dict) else {}
