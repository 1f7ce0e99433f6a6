"""How far a training's directory is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nermo_mjx.files import FileError, json_of
from nermo_mjx.learn.directory import SPEC, SUMMARY
from nermo_mjx.learn.history import FILE
from nermo_mjx.learn.spec import Training
from nermo_mjx.runs import engine_of
from nermo_mjx.runs.files import content_of
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.specs.reading import SpecError


def status(out: Path) -> Status:
    """How many iterations the history of a training's directory has."""
    notes, rows, done, until = list[str](), None, 0, None
    try:
        training = Training.from_file(out / SPEC)
        rows, until = training.iterations, training.until
    except (SpecError, OSError) as error:
        notes.append(f"Its training cannot be read: {error}")
    if about := metadata_of(out / FILE, notes, "it is made again of the checkpoints."):
        done = about.num_rows
        # One that was good enough before has no more of them.
        rows = done if until is not None and _complete(out) else rows
    complete = rows is not None and done >= rows and (out / SUMMARY).exists()
    return status_of(
        "iterations", out, done, rows, complete, command="train", spec=SPEC, engine=engine_of(out), notes=notes
    )


def _complete(out: Path) -> bool:
    """Whether a training's summary says that it has ended."""
    try:
        summary = json_of(content_of(out / SUMMARY) or b"{}", dict[str, Any], out / SUMMARY)
    except FileError:
        return False
    return summary.get("complete") is True
