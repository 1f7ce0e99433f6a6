"""How far a tuning's directory is, and a landscape's."""

from __future__ import annotations

import contextlib
import json
import shlex
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.runs import engine_of
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
    best = None
    with contextlib.suppress(OSError, ValueError):
        best = json.loads((out / "best.json").read_text(encoding="utf-8"))
    if isinstance(best, dict) and best.get("stopped"):
        rows, notes = done, [*notes, best["stopped"]]
    complete = rows is not None and done >= rows and best is not None
    return status_of("evaluations", out, done, rows, complete, command="tune", spec="tuning.yaml",
                     engine=engine_of(out), notes=notes)  # fmt: skip


def landscape_status(out: Path) -> Status:
    """How many points of a landscape a directory holds: in its table, or in the batches of an unfinished one."""
    notes, sessions, table = list[str](), list[dict[str, Any]](), out / "landscape.parquet"
    if table.exists():
        try:
            about = pq.read_metadata(table)
            sessions = [json.loads((about.metadata or {}).get(b"session", b"{}"))]
            complete = (out / "landscape.json").exists()
            command = f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out)
            return Status("points", about.num_rows, about.num_rows, complete, command, engine_of(out),
                          sessions=sessions)  # fmt: skip
        except (OSError, pa.ArrowException, ValueError):
            notes.append("landscape.parquet is damaged.")
    done = 0
    for path in out.glob("batches/*.npz"):
        try:
            with np.load(path, allow_pickle=False) as batch:
                done += len(batch["value"])
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            notes.append(f"batches/{path.name} is damaged; it will be evaluated again.")
    return Status("points", done, None, False, last_command(out), engine_of(out), notes=tuple(notes))
