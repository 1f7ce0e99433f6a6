"""How far a sweep's directory is."""

from __future__ import annotations

import shlex
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.runs.status import Status
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.results import chunk_files
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import RECORDINGS


def status(out: Path) -> Status:
    """How many runs of its sweep a directory holds."""
    notes, rows, done, engines = list[str](), None, 0, list[str]()
    try:
        rows = len(Sample(Sweep.from_directory(out)))
    except (SpecError, OSError) as error:
        notes.append(f"Its sweep cannot be read: {error}")
    for path in chunk_files(out).values():
        try:
            about = pq.read_metadata(path)
        except (OSError, pa.ArrowException, ValueError):
            notes.append(f"results/{path.name} is damaged; it will be run again.")
            continue
        done += about.num_rows
        engines.append((about.metadata or {}).get(b"engine", b"").decode())
    if kept := len(list((out / RECORDINGS).glob("row-*.npz"))):
        notes.append(f"{kept} of its runs {'are' if kept > 1 else 'is'} recorded in {RECORDINGS}/.")
    complete = done == rows and (out / "summary.json").exists()
    # The figures need no simulation; the others are distinguished by the table's columns.
    go_on = ["plot", str(out)] if complete else ["sweep", str(out / "sweep.yaml"), "--out", str(out)]
    return Status("runs", done, rows, complete, f"nermo-mjx {shlex.join(go_on)}",
                  engine=", ".join(dict.fromkeys(filter(None, engines))) or None, notes=tuple(notes))  # fmt: skip
