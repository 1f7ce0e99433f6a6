"""How far a sweep's directory is."""

from __future__ import annotations

from pathlib import Path

from nermo_mjx.runs.rows import part_files
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.specs.reading import SpecError
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
    for path in part_files(out):
        if about := metadata_of(path, notes, "its runs will be made again."):
            done += about.num_rows
            engines.append((about.metadata or {}).get(b"engine", b"").decode())
    if kept := len(list((out / RECORDINGS).glob("row-*.npz"))):
        notes.append(f"{kept} of its runs {'are' if kept > 1 else 'is'} recorded in {RECORDINGS}/.")
    complete = done == rows and (out / "summary.json").exists()
    # The figures need no simulation; the others are distinguished by the table's columns.
    engine = ", ".join(dict.fromkeys(filter(None, engines))) or None
    return status_of("runs", out, done, rows, complete, command="sweep", spec="sweep.yaml", engine=engine, notes=notes)
