"""Status of a directory: its progress, by kind, and how to resume it. Nothing here writes."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.runs.directory import read_record
from nermo_mjx.runs.files import parquet_file


@dataclasses.dataclass(frozen=True)
class Status:
    """Status of a directory.

    Attributes:
        unit: what its rows are, such as "runs".
        rows_done: rows that it holds.
        rows: rows that it will have; None while that is decided by what is found.
        complete: whether all that it was started for is there.
        command: that resumes it, or redraws the figures if nothing is left to do; empty if unknown.
        engine: that made the rows; None if it is not known.
        code: short names of what made the rows, where the directory has no codes of its own.
        sessions: that made it, where run.json has none.
        notes: sentences.
    """

    unit: str
    rows_done: int
    rows: int | None
    complete: bool
    command: str
    engine: str | None = None
    code: tuple[str, ...] = ()
    sessions: Sequence[Mapping[str, Any]] = ()
    notes: tuple[str, ...] = ()


# Many parameters because each is a part of the status that every job reports.
def status_of(
    unit: str,
    out: Path,
    done: int,
    rows: int | None,
    complete: bool,
    *,
    command: str,
    spec: str,
    engine: str | None,
    notes: Sequence[str],
) -> Status:
    """The status of a directory that `command` fills, and resumes by the file `spec` in it."""
    words = ["plot", str(out)] if complete else [command, str(out / spec), "--out", str(out)]
    return Status(
        unit, done, rows, complete, f"nermo-mjx {shlex.join(words)}", engine, notes=tuple(notes)
    )


def metadata_of(path: Path, notes: list[str], remedy: str) -> pq.FileMetaData | None:
    """What a Parquet file says of itself; None if it is absent or damaged, with a note and its remedy."""
    try:
        if not path.exists():
            return None
        with parquet_file(path) as file:
            return file.metadata
    except (OSError, pa.ArrowException, ValueError):
        notes.append(
            f"{path.name if path.parent.name != 'results' else f'results/{path.name}'} is damaged; {remedy}"
        )
        return None


def last_command(out: Path) -> str:
    """The command of the last session in a directory, with its current path; empty if unknown."""
    sessions = read_record(out).get("sessions", [])
    try:
        words = shlex.split(sessions[-1].get("command") or "") if sessions else []
    except ValueError:  # a quote that is not closed
        words = []
    if not words or not words[1:]:
        return ""
    if Path(words[0]).name in ("nermo-mjx", "__main__.py"):
        words[0] = "nermo-mjx"
    for option in ("--out", "--into"):
        if option in words[:-1]:
            words[words.index(option) + 1] = str(out)
    return shlex.join(words)
