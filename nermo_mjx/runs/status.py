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
        unit: Unit of its rows, such as "runs".
        rows_done: Number of existing rows.
        rows: Number of rows of the complete directory; None if it depends on results.
        complete: Whether the job is complete.
        command: Command that resumes the job, or redraws the figures of a complete one; empty if it is unknown.
        engine: Engine that made the rows; None if it is unknown.
        code: Short names of the codes that made the rows, if run.json contains none.
        sessions: Sessions that made the directory, if run.json contains none.
        notes: Additional sentences.
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
    """Metadata of a Parquet file; None if it is absent, or damaged, which adds a note with the remedy."""
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
