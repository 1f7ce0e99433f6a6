"""How far a training's directory is."""

from __future__ import annotations

import shlex
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.learn.directory import SPEC, SUMMARY
from nermo_mjx.learn.history import FILE
from nermo_mjx.learn.spec import Training
from nermo_mjx.runs import engine_of
from nermo_mjx.runs.status import Status
from nermo_mjx.specs.reading import SpecError


def status(out: Path) -> Status:
    """How many iterations the history of a training's directory has."""
    notes, rows, done = list[str](), None, 0
    try:
        rows = Training.from_file(out / SPEC).iterations
    except (SpecError, OSError) as error:
        notes.append(f"Its training cannot be read: {error}")
    if (out / FILE).exists():
        try:
            done = pq.read_metadata(out / FILE).num_rows
        except (OSError, pa.ArrowException, ValueError):
            notes.append(f"{FILE} is damaged; it is made again of the checkpoints.")
    complete = rows is not None and done >= rows and (out / SUMMARY).exists()
    go_on = ["plot", str(out)] if complete else ["train", str(out / SPEC), "--out", str(out)]
    return Status("iterations", done, rows, complete, f"nermo-mjx {shlex.join(go_on)}", engine=engine_of(out),
                  notes=tuple(notes))  # fmt: skip
