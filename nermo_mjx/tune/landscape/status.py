"""How far a landscape's directory is."""

from __future__ import annotations

import json
import shlex
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.runs import engine_of
from nermo_mjx.runs.status import Status, last_command


def status(out: Path) -> Status:
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
