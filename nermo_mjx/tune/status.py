"""How far a tuning's directory is."""

from __future__ import annotations

import shlex
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.runs import engine_of
from nermo_mjx.runs.status import Status
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
    if (out / FILE).exists():
        try:
            done = pq.read_metadata(out / FILE).num_rows
        except (OSError, pa.ArrowException, ValueError):
            notes.append(f"{FILE} is damaged; it is made again of the checkpoints.")
    complete = rows is not None and done >= rows and (out / "best.json").exists()
    go_on = ["plot", str(out)] if complete else ["tune", str(out / "tuning.yaml"), "--out", str(out)]
    return Status("evaluations", done, rows, complete, f"nermo-mjx {shlex.join(go_on)}", engine=engine_of(out),
                  notes=tuple(notes))  # fmt: skip
