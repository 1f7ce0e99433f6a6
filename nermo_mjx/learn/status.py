"""How far a training's directory is."""

from __future__ import annotations

from pathlib import Path

from nermo_mjx.learn.directory import SPEC, SUMMARY
from nermo_mjx.learn.history import FILE
from nermo_mjx.learn.spec import Training
from nermo_mjx.runs import engine_of
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.specs.reading import SpecError


def status(out: Path) -> Status:
    """How many iterations the history of a training's directory has."""
    notes, rows, done = list[str](), None, 0
    try:
        rows = Training.from_file(out / SPEC).iterations
    except (SpecError, OSError) as error:
        notes.append(f"Its training cannot be read: {error}")
    if about := metadata_of(out / FILE, notes, "it is made again of the checkpoints."):
        done = about.num_rows
    complete = rows is not None and done >= rows and (out / SUMMARY).exists()
    return status_of("iterations", out, done, rows, complete, command="train", spec=SPEC, engine=engine_of(out),
                     notes=notes)  # fmt: skip
