"""Status of a directory of experiments, and of an identification."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

from nermo_mjx.experiments.catalogue import EXPERIMENTS
from nermo_mjx.experiments.directory import Directory, Stored
from nermo_mjx.runs import engine_of
from nermo_mjx.runs.directory import read_record
from nermo_mjx.runs.status import Status, last_command


def status(out: Path) -> Status:
    """The experiments in a directory, out of the requested ones."""
    directory, sessions = Directory(out), read_record(out).get("sessions", [])
    found = {name: stored for name in EXPERIMENTS if (stored := directory.load(name)) is not None}
    bodies = {name: stored for name in found if (stored := directory.load_bodies(name)) is not None}
    asked = {name: None for session in sessions for name in session.get("experiments", [])} or found
    # Files derived from the tables are made last; directories of earlier releases do not record whether they exist.
    entries = {name: directory.entry(name) or {"finished": False} for name in asked}
    missing = [name for name in asked if name not in found or not entries[name].get("finished", True)]
    rows = sum(_rows(stored) for stored in (*found.values(), *bodies.values()))
    notes = [_note(name, stored, bodies.get(name)) for name, stored in found.items()]
    notes += [f"{name} is not finished." for name in missing]
    complete = bool(found) and not missing
    engines = dict.fromkeys(stored.about["engine"] for stored in found.values())
    return Status(
        "runs", rows, rows if complete else None, complete,
        f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out),
        engine=", ".join(engines) or engine_of(out), sessions=[stored.about for stored in found.values()],
        notes=tuple(notes),
    )  # fmt: skip


def identification_status(out: Path) -> Status:
    """Number of candidates that an identification has simulated."""
    from nermo_mjx.experiments.identification.memory import FILE, RESULT, candidates

    lines = (out / FILE).read_text().splitlines() if (out / FILE).exists() else []
    # A batch that was padded contains some of its points twice.
    done = len({tuple(point) for row in candidates(lines[1:]) for point in row["points"]})
    try:
        content: dict[str, Any] = json.loads((out / RESULT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        content = {}
    complete = "plots" in content  # comes last
    engine = engine_of(out) or content.get("engine") or (_engine(lines[0]) if lines else None)
    return Status(
        "candidates", done, done if complete else None, complete,
        f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out), engine,
        sessions=[content] if content else [],
    )  # fmt: skip


def _rows(stored: Stored) -> int:
    return len(next(iter(stored.outcome.columns.values())))


def _note(name: str, stored: Stored, bodies: Stored | None) -> str:
    besides = f", and {_rows(bodies)} of identified bodies" if bodies is not None else ""
    made = stored.about
    code = f", code {made['code']}" if "code" in made else ""
    return f"{name}: {_rows(stored)} runs{besides}, of {made['started'][:16]}, engine {made['engine']}{code}."


def _engine(first: str) -> str | None:
    """The engine in the first line of candidates, where earlier releases stored it."""
    try:
        engine = json.loads(first).get("engine")
    except (ValueError, AttributeError):
        return None
    return str(engine) if engine else None
