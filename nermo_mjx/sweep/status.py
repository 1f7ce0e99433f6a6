"""How far a sweep's directory is."""

from __future__ import annotations

from pathlib import Path

from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.runs.rows import part_files
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.sweep.results import SweepRecord
from nermo_mjx.sweep.store import RECORDINGS


def status(out: Path) -> Status:
    """How many runs of its sweep a directory holds."""
    notes, rows, done, engines = list[str](), None, 0, list[str]()
    try:
        sweep = SweepRecord.of_directory(out)
        rows = None if sweep is None else sweep.rows
    except DirectoryError as error:
        notes.append(str(error))
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
