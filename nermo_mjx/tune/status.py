"""How far a tuning's directory is, and a landscape's."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pyarrow as pa

from nermo_mjx.files import MOST_ARRAYS, FileError, arrays_of, json_of, read_bytes
from nermo_mjx.runs import engine_of
from nermo_mjx.runs.directory import Session
from nermo_mjx.runs.files import parquet_file, stored_json
from nermo_mjx.runs.status import Status, last_command, metadata_of, status_of
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.tune.history import FILE
from nermo_mjx.tune.spec import Tuning


def status(out: Path) -> Status:
    """How many evaluations of its starts the history of a tuning's directory has."""
    notes, rows, done = list[str](), None, 0
    try:
        tuning = Tuning.from_file(out / "tuning.yaml")
        rows = (tuning.iterations + 1) * tuning.starts
    except (SpecError, OSError) as error:
        notes.append(f"Its tuning cannot be read: {error}")
    if about := metadata_of(out / FILE, notes, "it is made again of the checkpoints."):
        done = about.num_rows
    best = stored_json(out / "best.json")
    if best and best.get("stopped"):
        rows, notes = done, [*notes, str(best["stopped"])]
    complete = rows is not None and done >= rows and best is not None
    return status_of("evaluations", out, done, rows, complete, command="tune", spec="tuning.yaml",
                     engine=engine_of(out), notes=notes)  # fmt: skip


def landscape_status(out: Path) -> Status:
    """How many points of a landscape a directory holds: in its table, or in the batches of an unfinished one."""
    notes, sessions, table = list[str](), list[dict[str, Any]](), out / "landscape.parquet"
    if table.exists():
        try:
            with parquet_file(table) as file:
                about = file.metadata
            sessions = [json_of((about.metadata or {}).get(b"session", b"{}"), Session, table)]
            complete = (out / "landscape.json").exists()
            command = f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out)
            return Status("points", about.num_rows, about.num_rows, complete, command, engine_of(out),
                          sessions=sessions)  # fmt: skip
        except (OSError, pa.ArrowException, ValueError, FileError):
            notes.append("landscape.parquet is damaged.")
    done = 0
    for path in out.glob("batches/*.npz"):
        try:
            done += len(arrays_of(read_bytes(path, MOST_ARRAYS), path)["value"])
        except (OSError, FileError, KeyError, TypeError):
            notes.append(f"batches/{path.name} is damaged; it will be evaluated again.")
    return Status("points", done, None, False, last_command(out), engine_of(out), notes=tuple(notes))
