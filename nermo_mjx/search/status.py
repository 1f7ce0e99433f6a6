"""How far a search's directory is."""

from __future__ import annotations

from pathlib import Path

from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.files import stored_json
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.search.batches import BEST, SEARCH
from nermo_mjx.search.spec import Search
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.results import chunk_files


def status(out: Path) -> Status:
    """How many points of its search a directory holds."""
    notes, search, runs = list[str](), None, 0
    try:
        search = Search.from_file(out / SEARCH)
    except (SpecError, OSError) as error:
        notes.append(f"Its search cannot be read: {error}")
    for path in chunk_files(out).values():
        if about := metadata_of(path, notes, "it will be run again."):
            runs += about.num_rows
    done, budget = runs // (1 if search is None else search.repeats), None if search is None else search.evaluations
    reached = False
    try:
        best = stored_json(out / BEST) or {}
        spent = 0.0 if search is None else search.reached(best["evaluations"], best["simulated_seconds"])
        reached = bool(best["complete"]) and spent >= 1.0 and best["evaluations"] == done
    except (TypeError, KeyError):
        pass
    return status_of("evaluations", out, done, budget, reached, command="search", spec=SEARCH, engine=engine_of(out),
                     notes=notes)  # fmt: skip
