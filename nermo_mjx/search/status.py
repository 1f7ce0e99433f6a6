"""How far a search's directory is."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.status import Status
from nermo_mjx.search.batches import SEARCH
from nermo_mjx.search.outcome import BEST
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
        try:
            runs += pq.read_metadata(path).num_rows
        except (OSError, pa.ArrowException, ValueError):
            notes.append(f"results/{path.name} is damaged; it will be run again.")
    done, budget = runs // (1 if search is None else search.repeats), None if search is None else search.evaluations
    reached = False
    try:
        best = json.loads((out / BEST).read_text(encoding="utf-8"))
        spent = 0.0 if search is None else search.reached(best["evaluations"], best["simulated_seconds"])
        reached = bool(best["complete"]) and spent >= 1.0 and best["evaluations"] == done
    except (OSError, ValueError, KeyError):
        pass
    go_on = ["plot", str(out)] if reached else ["search", str(out / SEARCH), "--out", str(out)]
    return Status("evaluations", done, budget, reached, f"nermo-mjx {shlex.join(go_on)}", engine=engine_of(out),
                  notes=tuple(notes))  # fmt: skip
