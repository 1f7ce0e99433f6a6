"""The directories of published experiments, and their rows.

DIR/run.json                        kind, code stamps, sessions, and files of the program
DIR/report.json, DIR/report.md      all experiments that the directory holds
DIR/plots/, DIR/videos/             made from the rows and the recordings
DIR/<experiment>/                   rows, one per world, for `view`, `compare` and `plot`
DIR/<experiment>-bodies/            rows of identified bodies, if they were requested
    results/                        see `nermo_mjx.runs.rows`
    recordings/row-000012.npz       runs of plots and videos; the file of a case without a row has the name of the case
    experiment.json                 the settings of the run, and its recordings by name
    report.json                     lines of the report
"""

from __future__ import annotations

import collections
import dataclasses
import hashlib
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from pydantic import BaseModel

from nermo_mjx.experiments.cases import BODY, CaseRuns, Settings
from nermo_mjx.experiments.published import Experiment
from nermo_mjx.experiments.report import collect, outcome_of, report_page, table_of
from nermo_mjx.files import FileError
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ParameterError
from nermo_mjx.runs import CodeStamp, DirectoryError, JobFailed, Written
from nermo_mjx.runs.directory import SessionRecord
from nermo_mjx.runs.files import clear_errors, replace_file, stored_json, to_json
from nermo_mjx.runs.rows import PartFile, keys_of, opened_part, part_files
from nermo_mjx.runs.work import RowBatch, RowJob
from nermo_mjx.sweep.table import read_table

#: Names of the files with the record of a run, and with the lines of the report.
RECORD: Final = "experiment.json"
REPORT: Final = "report.json"


class Record(SessionRecord):
    """The content of `RECORD`.

    Attributes:
        settings: Settings of the run.
        bodies, drawn: Number of identified bodies, and their digest.
        rows: Number of rows of the complete run.
        recordings: Name of a recording -> its file.
    """

    settings: dict[str, Any]
    rows: int
    bodies: int | None = None
    drawn: str | None = None
    recordings: dict[str, str]


class _Entry(BaseModel, extra="allow"):
    lines: list[dict[str, Any]]
    finished: bool = False


class _Recordings(collections.UserDict[str, Any]):
    """Recordings by name, each read from its file on first access."""

    def __getitem__(self, name: str) -> Recording:
        if isinstance(self.data[name], Path):
            self.data[name] = Recording.load(self.data[name])
        return self.data[name]


@dataclasses.dataclass(frozen=True)
class Stored:
    """An experiment stored in a directory.

    Attributes:
        outcome: Table of the experiment; recordings are read on demand.
        about: Record of the run, and `engine`, `code` and `wall_seconds` of its rows.
        table: Folder of the table.
        recordings: Files of the recordings.
    """

    outcome: CaseRuns
    about: dict[str, Any]
    table: Path
    recordings: tuple[Path, ...]


class Directory:
    """A directory of experiments."""

    def __init__(self, out: str | os.PathLike[str]) -> None:
        self.out = Path(out)

    def folder(self, experiment: str, *, bodies: bool = False) -> Path:
        """The directory of the rows of an experiment, or of the rows of identified bodies in it."""
        return self.out / f"{experiment}{'-bodies' if bodies else ''}"

    def refuse_former_layout(self) -> None:
        """Reject a directory of a former release.

        Raises:
            DirectoryError: The directory contains tables of a former release.
        """
        if any((self.out / "results").glob("*.parquet")):
            raise DirectoryError(
                f"{self.out} holds experiments of a former release, whose tables are in {self.out / 'results'}: choose "
                "another directory, or use the release that made it, named in run.json."
            )

    def record(self, experiment: str, *, bodies: bool = False) -> dict[str, Any]:
        """The record of a run; empty if there is none."""
        return stored_json(self.folder(experiment, bodies=bodies) / RECORD, Record) or {}

    def load(self, experiment: str, *, bodies: bool = False) -> Stored | None:
        """The complete results of an experiment, or of the identified bodies in it; None if absent or damaged.

        The results of bodies count only if the settings are those of the run of the experiment.
        """
        folder = self.folder(experiment, bodies=bodies)
        record = self.record(experiment, bodies=bodies)
        own_record = self.record(experiment) if bodies else record
        if not record or record["settings"] != own_record.get("settings"):
            return None
        try:
            table = read_table(folder)
            files = {name: folder / file for name, file in record["recordings"].items()}
            if table.num_rows < record["rows"] or not all(map(Path.exists, files.values())):
                return None
            outcome = outcome_of(table, _Recordings(files))
            parts = list(map(_part, part_files(folder)))
        except (KeyError, FileError):
            return None
        columns_made = {
            "engine": parts[0].engine,
            "code": table["code"][0].as_py(),
            "wall_seconds": sum(part.seconds for part in parts),
        }
        return Stored(outcome, record | columns_made, folder / "results", tuple(files.values()))

    def write_entry(self, experiment: str, entry: Mapping[str, Any]) -> None:
        """Store an experiment's lines, its settings, and whether all derived files exist (`finished`).

        Raises:
            DirectoryError: The file cannot be written.
        """
        with clear_errors(self.out):
            replace_file(self.folder(experiment) / REPORT, to_json(entry))

    def entry(self, experiment: str) -> dict[str, Any] | None:
        """The entry that `write_entry` stored for an experiment, or None."""
        entry: dict[str, Any] | None = stored_json(self.folder(experiment) / REPORT, _Entry)
        return entry or None

    def report(self, written: Written, experiments: Mapping[str, Experiment]) -> dict[str, Any]:
        """Write the report of all experiments in the directory, and return the content of report.json."""
        entries = {name: entry for name in experiments if (entry := self.entry(name)) is not None}
        content = collect(entries)
        outcomes = {
            name: stored.outcome for name in entries if (stored := self.load(name)) is not None
        }
        written.write(self.out / "report.json", to_json(content))
        written.write(self.out / "report.md", report_page(content, experiments, outcomes).encode())
        written.note()
        return content


def _part(path: Path) -> PartFile:
    with opened_part(path) as file:
        return PartFile.of(path, file.metadata.num_rows, file.schema_arrow.metadata)


# --- the rows of an experiment that a job requests


class ExperimentRows(RowJob):
    """The rows of an experiment, or of identified bodies in it; a `nermo_mjx.runs.work.RowJob`.

    Args:
        experiment: Experiment of the rows.
        parts: Settings of the worlds that are simulated together, without the engine; each part has some of the bodies.
        directory: Directory of experiments.
        written: Files of the directory.
        record: Record of the run.
    """

    command = "experiment"

    def __init__(
        self,
        experiment: Experiment,
        parts: Sequence[Settings],
        directory: Directory,
        written: Written,
        record: Mapping[str, Any],
    ) -> None:
        self.name, self._run, self._parts = experiment.name, experiment.run, parts
        self._directory, self._written = directory, written
        counts = [experiment.rows(part) for part in parts]
        self._begins, self.structures = (
            np.cumsum([0, *counts]),
            np.repeat(range(len(parts)), counts),
        )
        self.seconds, self.size = np.ones(len(self.structures)), max(counts)
        self._bodies = record.get("bodies")
        self.label = f"{self.name}, {self._bodies} bodies" if self._bodies else self.name
        self.folder = directory.folder(self.name, bodies=bool(self._bodies))
        decisive = {name: record.get(name) for name in ("settings", "drawn")}
        self.group = hashlib.sha256(json.dumps([self.name, decisive]).encode()).hexdigest()[:16]
        self._record = dict(record) | {"rows": len(self.structures), "recordings": {}}

    def write_record(self) -> None:
        """Write the record of the run into the directory of the rows."""
        with clear_errors(self.folder):
            replace_file(self.folder / RECORD, to_json(self._record))

    def keys(self, index: np.ndarray) -> np.ndarray:
        """See `RowJob`."""
        return keys_of(self.group, {"row": index}, len(index))

    def task(self, batch: RowBatch) -> tuple[Callable[[Settings], CaseRuns], Settings]:
        """See `RowJob`; the task of a `Simulation`."""
        return self._run, self._parts[batch.structure]

    def tables(
        self, index: np.ndarray, result: tuple[CaseRuns, float], stamp: CodeStamp
    ) -> tuple[pa.Table, None]:
        """See `RowJob`; recordings are written before the rows, because only rows make them valid."""
        outcome, seconds = result
        part_index = int(self.structures[index[0]])
        part, begin = self._parts[part_index], int(self._begins[part_index])
        if self._bodies:  # each part is numbered from the position of its first body
            first = part.seed - self._parts[0].seed
            columns = {**outcome.columns, BODY: outcome.columns[BODY] + first}
            outcome = dataclasses.replace(outcome, columns=columns, recordings={})
        else:
            self._keep(outcome)
        # Variants of a profile have the same numbers in all of its parts.
        profile = next(
            i for i, other_part in enumerate(self._parts) if other_part.profiles == part.profiles
        )
        metadata = {"engine": stamp.engine, "steps": 0, "wall_seconds": seconds}
        table = table_of(outcome, begin, int(self._begins[profile]), part.seed, stamp.id, metadata)
        return table.take(index - begin), None

    def failure(self, index: np.ndarray, error: BaseException, out: Path) -> Exception:
        """See `RowJob`; errors of this package become `JobFailed`, all other errors remain."""
        text = f"{self.name} failed: {error} What was done before is kept in {self._directory.out}."
        assert isinstance(error, Exception)
        if isinstance(error, ParameterError) or not isinstance(
            error, (ValueError, RuntimeError, OSError)
        ):
            return error
        if type(error).__module__.startswith("nermo_mjx"):
            return JobFailed(text)
        error.add_note(text)
        return error

    def _keep(self, outcome: CaseRuns) -> None:
        """Write the recordings of an outcome, and remove the recordings and lines of earlier results."""
        written, folder = self._written, self.folder / "recordings"
        self._directory.write_entry(self.name, {})
        former = (f"{written.name(folder)}/", f"videos/{self.name}")
        written.remove([name for name in written.known if name.startswith(former)])
        files: dict[str, Path] = {}
        for title, recording in outcome.recordings.items():
            labels = recording.metadata.get("labels", {})
            alike = outcome.where(**labels) if set(labels) <= set(outcome.columns) else np.zeros(1)
            row = f"row-{int(np.argmax(alike)):06d}.npz"
            # "trot, 0.67 Hz, with spine" is trot-0.67-hz-with-spine.
            slug = re.sub(r"[^a-z0-9.]+", "-", title.lower()).strip("-.") or "run"
            path = folder / (
                row
                if labels and alike.any() and folder / row not in files.values()
                else f"{slug}.npz"
            )
            if path in files.values():
                path = path.with_stem(f"{path.stem}-{len(files)}")
            files[title] = path
            written.write(path, recording.content())
        written.note()
        self._record["recordings"] = {
            title: path.relative_to(self.folder).as_posix() for title, path in files.items()
        }
        self.write_record()
