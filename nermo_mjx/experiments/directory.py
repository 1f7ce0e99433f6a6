"""The directory of the published experiments: the results of each one, its settings, and how far it is.

DIR/results/<experiment>.parquet    one row per world; the settings and the provenance are in the schema's metadata
DIR/results/<experiment>-bodies.parquet   the same for identified bodies, if requested
DIR/results/<experiment>.json       its lines of the report, and the settings of the run
DIR/recordings/<experiment>-*.npz   runs shown in plots and videos
DIR/plots/, DIR/videos/             made from the above
DIR/report.json, DIR/report.md      all experiments that the directory holds
DIR/run.json                        which code made the rows (their column `code`), each session, the program's files
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from nermo_mjx.experiments.cases import Outcome
from nermo_mjx.experiments.catalogue import EXPERIMENTS
from nermo_mjx.experiments.report import collect, outcome_of, page, table_of
from nermo_mjx.recording import Recording
from nermo_mjx.runs import Written, engine_of
from nermo_mjx.runs.directory import read_record
from nermo_mjx.runs.files import DirectoryError, clear_errors, parquet_bytes, parquet_table, replace_file
from nermo_mjx.runs.status import Status, last_command
from nermo_mjx.runs.text import to_json

_NOTES = b"about"


@dataclasses.dataclass(frozen=True)
class Stored:
    """An experiment stored in a directory.

    Attributes:
        outcome: its table; recordings are read on demand.
        about: `settings`, `engine`, `code`, `wall_seconds`, and `started`, `command`, `versions`, `machine` of the run.
        table: the file of the table; recordings: those of the recordings.
    """

    outcome: Outcome
    about: dict[str, Any]
    table: Path
    recordings: tuple[Path, ...]


class Directory:
    """Files of a directory; paths in an `entry` are relative to it."""

    def __init__(self, out: str | os.PathLike[str]) -> None:
        self.out = Path(out)

    def save(self, outcome: Outcome, about: Mapping[str, Any], written: Written) -> Stored:
        """Store an experiment's results, replacing earlier ones; the table is written last and makes them valid.

        Args:
            about: `code`, `settings`, `engine`, `wall_seconds` and the session.
            written: the experiment's files.
        """
        path = self.path(outcome.experiment)
        written.clear(path)
        # Without the lines of earlier results, which belong to the old table.
        self.write_entry(outcome.experiment, {})
        own = tuple(f"{folder}/{outcome.experiment}" for folder in ("recordings", "videos"))
        written.remove([name for name in written.known if name.startswith(own)])
        files: dict[str, Path] = {}
        for name, recording in outcome.recordings.items():
            file = self.out / "recordings" / f"{outcome.experiment}-{_slug(name, outcome.experiment)}.npz"
            files[name] = file if file not in files.values() else file.with_stem(f"{file.stem}-{len(files)}")
            written.make(files[name], recording.save)
        return self._put(path, outcome, {**about, "recordings": {name: p.name for name, p in files.items()}}, written)

    def save_bodies(self, outcome: Outcome, about: Mapping[str, Any], written: Written) -> Stored:
        """Store the results of the identified bodies, beside the experiment's own; arguments as for `save`."""
        return self._put(self.path(outcome.experiment, bodies=True), outcome, {**about, "recordings": {}}, written)

    def _put(self, path: Path, outcome: Outcome, about: Mapping[str, Any], written: Written) -> Stored:
        table = table_of(outcome, {"about": to_json(about).decode()}, about["code"])
        written.write(path, parquet_bytes(table))
        written.note()
        stored = self._load(path)
        if stored is None:
            raise DirectoryError(f"{path} was written but cannot be read back: run the same command again.")
        return stored

    def holds_rows(self) -> bool:
        """Whether it contains a table of any experiment."""
        return any((self.out / "results").glob("*.parquet"))

    def load(self, experiment: str, *, bodies: bool = False) -> Stored | None:
        """The directory's results of an experiment, or of the identified bodies in it; None if absent or damaged."""
        return self._load(self.path(experiment, bodies=bodies))

    def _load(self, path: Path) -> Stored | None:
        table = parquet_table(path)
        if table is None:
            return None
        try:
            about = json.loads(table.schema.metadata[_NOTES])
            files = {name: self.out / "recordings" / file for name, file in about["recordings"].items()}
        except (KeyError, TypeError, ValueError):
            return None
        if not all(file.exists() for file in files.values()):
            return None
        return Stored(outcome_of(table, _Recordings(files)), about, path, tuple(files.values()))

    def write_entry(self, experiment: str, entry: Mapping[str, Any]) -> None:
        """Store an experiment's lines, its settings, and whether all derived files exist (`finished`).

        Raises:
            DirectoryError: it cannot be written.
        """
        with clear_errors(self.out):
            replace_file(self.out / "results" / f"{experiment}.json", to_json(entry))

    def entry(self, experiment: str) -> dict[str, Any] | None:
        """The entry that `write_entry` stored for an experiment, or None."""
        try:
            entry = json.loads((self.out / "results" / f"{experiment}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return entry if isinstance(entry, dict) and "lines" in entry else None

    def report(self, written: Written) -> dict[str, Any]:
        """Write the report of all experiments that the directory holds, and return the content of report.json."""
        entries = {name: entry for name in EXPERIMENTS if (entry := self.entry(name)) is not None}
        content = collect(entries)
        outcomes = {name: stored.outcome for name in entries if (stored := self.load(name)) is not None}
        written.write(self.out / "report.json", to_json(content))
        written.write(self.out / "report.md", page(content, EXPERIMENTS, outcomes).encode())
        written.note()
        return content

    def path(self, experiment: str, *, bodies: bool = False) -> Path:
        """The table of an experiment, or of the identified bodies in it."""
        return self.out / "results" / f"{experiment}{'-bodies' if bodies else ''}.parquet"


class _Recordings(Mapping[str, Recording]):
    """Recordings by name, each read from its file on first access."""

    def __init__(self, files: Mapping[str, Path]) -> None:
        self._files = files
        self._read: dict[str, Recording] = {}

    def __getitem__(self, name: str) -> Recording:
        if name not in self._read:
            self._read[name] = Recording.load(self._files[name])
        return self._read[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def _slug(name: str, experiment: str) -> str:
    """A recording's name as part of a file name: "trt, 0.67 Hz, with spine" is trt-0.67-hz-with-spine."""
    slug = re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-.")
    return slug.removeprefix(f"{experiment}-") or "run"


def status(out: Path) -> Status:
    """The experiments in a directory, out of the requested ones."""
    directory, sessions = Directory(out), read_record(out).get("sessions", [])
    found = {name: stored for name in EXPERIMENTS if (stored := directory.load(name)) is not None}
    bodies = {name: stored for name in found if (stored := directory.load(name, bodies=True)) is not None}
    asked = {name: None for each in sessions for name in each.get("experiments", [])} or found
    # Files derived from the tables are made last.
    missing = [name for name in asked if name not in found or not (directory.entry(name) or {}).get("finished")]
    notes = []
    for name, stored in found.items():
        besides = f", and {len(bodies[name].outcome)} of identified bodies" if name in bodies else ""
        made = stored.about
        code = f", code {made['code']}" if "code" in made else ""
        notes.append(
            f"{name}: {len(stored.outcome)} runs{besides}, of {made['started'][:16]}, engine {made['engine']}{code}."
        )
    notes += [f"{name} is not finished." for name in missing]
    rows = sum(len(stored.outcome) for stored in (*found.values(), *bodies.values()))
    complete = bool(found) and not missing
    engines = dict.fromkeys(stored.about["engine"] for stored in found.values())
    return Status(
        "runs", rows, rows if complete else None, complete,
        f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out),
        engine=", ".join(engines) or engine_of(out), sessions=[stored.about for stored in found.values()],
        notes=tuple(notes),
    )  # fmt: skip
