"""The directory of the published experiments: the results of each one, and its settings.

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
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.table import outcome_of, table_of
from nermo_mjx.recording import Recording
from nermo_mjx.runs import Written
from nermo_mjx.runs.files import DirectoryError, clear_errors, parquet_bytes, parquet_table, replace_file
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
    """Files of a directory; paths in `entry`s are relative to it."""

    def __init__(self, out: str | os.PathLike[str]) -> None:
        self.out = Path(out)

    def write(self, path: Path, content: bytes) -> None:
        """Replace a file of the directory, atomically.

        Raises:
            DirectoryError: it cannot be written.
        """
        with clear_errors(self.out):
            replace_file(path, content)

    def save(self, outcome: Outcome, about: Mapping[str, Any], written: Written) -> Stored:
        """Store an experiment's results, replacing earlier ones; the table is written last and makes them valid.

        Args:
            about: `code`, `settings`, `engine`, `wall_seconds` and the session.
            written: the experiment's files.
        """
        table = self._table(outcome.experiment)
        written.clear(table)
        # Without the lines of earlier results, which belong to the old table.
        self.write_entry(outcome.experiment, {})
        own = tuple(f"{folder}/{outcome.experiment}" for folder in ("recordings", "videos"))
        written.remove([name for name in written.known if name.startswith(own)])
        files: dict[str, Path] = {}
        for name, recording in outcome.recordings.items():
            path = self.out / "recordings" / f"{outcome.experiment}-{_slug(name, outcome.experiment)}.npz"
            files[name] = path if path not in files.values() else path.with_stem(f"{path.stem}-{len(files)}")
            written.make(files[name], recording.save)
        notes = {**about, "recordings": {name: path.name for name, path in files.items()}}
        written.write(table, _content(outcome, notes))
        written.note()
        return _read_back(self.load(outcome.experiment), table)

    def save_bodies(self, outcome: Outcome, about: Mapping[str, Any], written: Written) -> Stored:
        """Store the results of the identified bodies, beside the experiment's own; arguments as for `save`."""
        path = self._bodies(outcome.experiment)
        written.write(path, _content(outcome, {**about, "recordings": {}}))
        written.note()
        return _read_back(self.load_bodies(outcome.experiment), path)

    def discard_bodies(self, experiment: str, written: Written) -> None:
        """Remove the results of the identified bodies, or move them aside if modified."""
        written.clear(self._bodies(experiment))

    def holds_rows(self) -> bool:
        """Whether it contains a table of any experiment."""
        return any((self.out / "results").glob("*.parquet"))

    def load(self, experiment: str) -> Stored | None:
        """The directory's results of an experiment; None if absent or damaged."""
        return self._load(self._table(experiment))

    def load_bodies(self, experiment: str) -> Stored | None:
        """The directory's results of the identified bodies in an experiment; None if absent or damaged."""
        return self._load(self._bodies(experiment))

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
        """Store an experiment's lines, its settings, and whether all derived files exist (`finished`)."""
        self.write(self.out / "results" / f"{experiment}.json", to_json(entry))

    def entry(self, experiment: str) -> dict[str, Any] | None:
        """The entry that `write_entry` stored for an experiment, or None."""
        try:
            entry = json.loads((self.out / "results" / f"{experiment}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return entry if isinstance(entry, dict) and "lines" in entry else None

    def _table(self, experiment: str) -> Path:
        return self.out / "results" / f"{experiment}.parquet"

    def _bodies(self, experiment: str) -> Path:
        return self.out / "results" / f"{experiment}-bodies.parquet"


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


def _content(outcome: Outcome, about: Mapping[str, Any]) -> bytes:
    return parquet_bytes(table_of(outcome, {"about": to_json(about).decode()}, about["code"]))


def _read_back(stored: Stored | None, path: Path) -> Stored:
    if stored is None:
        raise DirectoryError(f"{path} was written but cannot be read back: run the same command again.")
    return stored


def _slug(name: str, experiment: str) -> str:
    """A recording's name as part of a file name: "trt, 0.67 Hz, with spine" is trt-0.67-hz-with-spine."""
    slug = re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-.")
    return slug.removeprefix(f"{experiment}-") or "run"
