"""Run the published experiments into a directory: each one's results are stored as soon as it is done.

A directory is resumed where it was interrupted: an experiment in it, run with the same settings, is not run again.
Experiments of one directory may have been run with different settings; each keeps its own, and the report says so.

DIR/results/<experiment>.parquet    one row per world; the settings and the provenance are in the schema's metadata
DIR/results/<experiment>-bodies.parquet   the same for identified bodies, if requested
DIR/results/<experiment>.json       its lines of the report, and the settings of the run
DIR/recordings/<experiment>-*.npz   runs shown in plots and videos
DIR/plots/, DIR/videos/             made from the above
DIR/report.json, DIR/report.md      all experiments that the directory holds
DIR/run.json                        which code made the rows (their column `code`), each session, the program's files
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import hashlib
import json
import math
import os
import re
import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import BaseModel

from nermo_mjx.experiments import balance, cases, stands, walks
from nermo_mjx.experiments.cases import BODY, PROFILES, CaseRuns, ReplacementPolicy, Settings
from nermo_mjx.experiments.published import Experiment, Line, Shot, published_lines
from nermo_mjx.experiments.report import (
    collect,
    differences,
    entry_of,
    outcome_of,
    report_page,
    table_of,
)
from nermo_mjx.files import MAX_FILE_BYTES, TEMPORARY_SUFFIX, FileError, json_of, read_bytes
from nermo_mjx.physics.making import resolve_engine
from nermo_mjx.plotting.files import Figures
from nermo_mjx.progress import shows_progress
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ParameterError, load_robot
from nermo_mjx.robot.quantity import choice
from nermo_mjx.runs import (
    CodeStamp,
    DirectoryError,
    RunDirectory,
    Written,
    codes_of,
    engine_of,
    session,
    stamp,
)
from nermo_mjx.runs.code import local_time
from nermo_mjx.runs.directory import SessionRecord, read_record
from nermo_mjx.runs.files import (
    clear_errors,
    parquet_bytes,
    parquet_table,
    replace_file,
    stored_json,
    to_json,
)
from nermo_mjx.runs.job import SILENT, JobFailed, Progress, Watch, resumable
from nermo_mjx.runs.status import Status, last_command
from nermo_mjx.runs.workers import LocalWorkers, TaskFailed, Workers
from nermo_mjx.view import RecordingError, VideoError, render, robot_of

# --- the experiments by name


def _catalogue() -> Iterator[Experiment]:
    for name, run, settable, walking in (
        ("straight-line", walks.walk_line, cases.settable(walks.line_cases()), True),
        ("turning", walks.walk_turns, cases.settable(walks.turn_cases()), True),
        ("balance", balance.run, balance.SETTABLE, False),
        ("maze", walks.walk_maze, cases.settable(walks.maze_cases()), True),
        ("body", stands.run_body, stands.BODY_SETTABLE, False),
        ("leg-stand", stands.run_leg, stands.STAND_SETTABLE, False),
        ("spine-stand", stands.run_spine, stands.STAND_SETTABLE, False),
    ):
        about = cases.texts("catalogue")[name]
        run = (
            run
            if run.__module__ == stands.__name__
            else functools.partial(cases.in_each_robot, run)
        )
        yield Experiment(
            name, run, settable, walks=walking, **about | {"shot": Shot(**about.get("shot", {}))}
        )


EXPERIMENTS: Final[dict[str, Experiment]] = {each.name: each for each in _catalogue()}

# --- a directory: the results of each experiment, its settings, and how far it is


@dataclasses.dataclass(frozen=True)
class Stored:
    """An experiment stored in a directory.

    Attributes:
        outcome: its table; recordings are read on demand.
        about: `settings`, `engine`, `code`, `wall_seconds`, and `started`, `command`, `versions`, `machine` of the run.
        table: the file of the table; recordings: those of the recordings.
    """

    outcome: CaseRuns
    about: dict[str, Any]
    table: Path
    recordings: tuple[Path, ...]


class _About(SessionRecord):
    """What a table says of its run."""

    started: str
    engine: str
    code: str = ""
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


class Directory:
    """Files of a directory; paths in an `entry` are relative to it."""

    def __init__(self, out: str | os.PathLike[str]) -> None:
        self.out = Path(out)

    def path(self, experiment: str, *, bodies: bool = False) -> Path:
        """The table of an experiment, or of the identified bodies in it."""
        return self.out / "results" / f"{experiment}{'-bodies' if bodies else ''}.parquet"

    def save(
        self, outcome: CaseRuns, about: Mapping[str, Any], written: Written, *, bodies: bool = False
    ) -> Stored:
        """Store an experiment's results, replacing earlier ones; the table is written last and makes them valid.

        Args:
            about: `code`, `settings`, `engine`, `wall_seconds` and the session.
            written: the experiment's files.
            bodies: whether they are those of the identified bodies, beside the experiment's own.
        """
        name, path = outcome.experiment, self.path(outcome.experiment, bodies=bodies)
        files: dict[str, Path] = {}
        if not bodies:
            written.clear(path)
            # Without the lines of earlier results, which belong to the old table.
            self.write_entry(name, {})
            own = tuple(f"{folder}/{name}" for folder in ("recordings", "videos"))
            written.remove([file for file in written.known if file.startswith(own)])
            for title, recording in outcome.recordings.items():
                # "trot, 0.67 Hz, with spine" is trot-0.67-hz-with-spine.
                slug = (
                    re.sub(r"[^a-z0-9.]+", "-", title.lower()).strip("-.").removeprefix(f"{name}-")
                    or "run"
                )
                file = self.out / "recordings" / f"{name}-{slug}.npz"
                files[title] = (
                    file
                    if file not in files.values()
                    else file.with_stem(f"{file.stem}-{len(files)}")
                )
                written.write(files[title], recording.content())
        notes = to_json(
            {**about, "recordings": {title: file.name for title, file in files.items()}}
        ).decode()
        written.write(path, parquet_bytes(table_of(outcome, {"about": notes}, about["code"])))
        written.note()
        stored = self.load(name, bodies=bodies)
        if stored is None:
            raise DirectoryError(
                f"{path} was written but cannot be read back: run the same command again."
            )
        return stored

    def load(self, experiment: str, *, bodies: bool = False) -> Stored | None:
        """The directory's results of an experiment, or of the identified bodies in it; None if absent or damaged."""
        path = self.path(experiment, bodies=bodies)
        table = parquet_table(path)
        if table is None:
            return None
        try:
            about = json_of((table.schema.metadata or {})[b"about"], _About, path)
            files = {
                name: self.out / "recordings" / Path(file).name
                for name, file in about["recordings"].items()
            }
            outcome = outcome_of(table, _Recordings(files))
        except (KeyError, FileError):
            return None
        if not all(file.exists() for file in files.values()):
            return None
        return Stored(outcome, about, path, tuple(files.values()))

    def write_entry(self, experiment: str, entry: Mapping[str, Any]) -> None:
        """Store an experiment's lines, its settings, and whether all derived files exist (`finished`).

        Raises:
            DirectoryError: it cannot be written.
        """
        with clear_errors(self.out):
            replace_file(self.out / "results" / f"{experiment}.json", to_json(entry))

    def entry(self, experiment: str) -> dict[str, Any] | None:
        """The entry that `write_entry` stored for an experiment, or None."""
        entry: dict[str, Any] | None = stored_json(
            self.out / "results" / f"{experiment}.json", _Entry
        )
        return entry or None

    def report(self, written: Written) -> dict[str, Any]:
        """Write the report of all experiments that the directory holds, and return the content of report.json."""
        entries = {name: entry for name in EXPERIMENTS if (entry := self.entry(name)) is not None}
        content = collect(entries)
        outcomes = {
            name: stored.outcome for name in entries if (stored := self.load(name)) is not None
        }
        written.write(self.out / "report.json", to_json(content))
        written.write(self.out / "report.md", report_page(content, EXPERIMENTS, outcomes).encode())
        written.note()
        return content


def experiments_status(out: Path) -> Status:
    """The experiments in a directory, out of the requested ones."""
    directory, sessions = Directory(out), read_record(out).get("sessions", [])
    found = {name: stored for name in EXPERIMENTS if (stored := directory.load(name)) is not None}
    bodies = {
        name: stored for name in found if (stored := directory.load(name, bodies=True)) is not None
    }
    requested = {name: None for each in sessions for name in each.get("experiments", [])} or found
    # Files derived from the tables are made last.
    missing = [
        name
        for name in requested
        if name not in found or not (directory.entry(name) or {}).get("finished")
    ]
    notes = []
    for name, stored in found.items():
        about, runs = stored.about, f"{name}: {len(stored.outcome)} runs"
        runs += f", and {len(bodies[name].outcome)} of identified bodies" if name in bodies else ""
        code = f", code {about['code']}" if "code" in about else ""
        notes.append(f"{runs}, of {local_time(about['started'])}, engine {about['engine']}{code}.")
    rows = sum(len(stored.outcome) for stored in (*found.values(), *bodies.values()))
    complete = bool(found) and not missing
    command = f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out)
    engine = ", ".join(
        dict.fromkeys(stored.about["engine"] for stored in found.values())
    ) or engine_of(out)
    notes += [f"{name} is not finished." for name in missing]
    made = [stored.about for stored in found.values()]
    total = rows if complete else None
    return Status(
        "runs", rows, total, complete, command, engine=engine, sessions=made, notes=tuple(notes)
    )


def images(out: Path) -> Figures:
    """The figures of all experiments that a directory holds, by name.

    Raises:
        DirectoryError: it contains no readable experiment.
    """
    from nermo_mjx.experiments.plots import figures_of_experiment

    directory = Directory(out)
    found = {
        name: stored.outcome for name in EXPERIMENTS if (stored := directory.load(name)) is not None
    }
    if not found:
        raise DirectoryError(
            f"{out} holds no experiment whose table and recordings can be read: run it again."
        )
    return (
        named
        for name, outcome in found.items()
        for named in figures_of_experiment(
            outcome, published_lines(outcome, None, EXPERIMENTS[name].figures)
        )
    )


# --- a call


@dataclasses.dataclass(frozen=True)
class ExperimentResult:
    """The result of one experiment.

    Attributes:
        name: of the experiment; out: the directory.
        outcome: its table, and recordings, which are loaded on first access.
        lines: of the report.
        table, plots, recordings, videos: its files.
        kept: whether it was already in the directory, so that nothing was simulated.
        notes: sentences on outputs that could not be made.
    """

    name: str
    out: Path
    outcome: CaseRuns
    lines: tuple[Line, ...]
    table: Path
    plots: tuple[Path, ...]
    recordings: tuple[Path, ...]
    videos: tuple[Path, ...]
    kept: bool
    notes: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class ExperimentsResult:
    """The results of several experiments in the order run, and the content of report.json."""

    out: Path
    results: tuple[ExperimentResult, ...]
    report: dict[str, Any]


def run_experiment(name: str, out: str | os.PathLike[str], **options: Any) -> ExperimentResult:
    """Run one experiment into a directory; arguments and errors as for `run_experiments`."""
    return run_experiments([name], out, **options).results[0]


@shows_progress("experiments")
def run_experiments(
    names: Sequence[str],
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    profiles: Sequence[str] = PROFILES,
    repeats: int | None = None,
    seed: int = 0,
    quick: bool = False,
    values: Mapping[str, float] | None = None,
    controller: str | os.PathLike[str] | None = None,
    bodies: int | None = None,
    video: bool = True,
    again: bool = False,
    accept_new_code: bool = False,
    watch: Watch = SILENT,
    progress: bool = True,
    workers: Workers | None = None,
) -> ExperimentsResult:
    """Run experiments; each is stored when it finishes, and the report is rewritten after each.

    Args:
        names: of `EXPERIMENTS`.
        out: the directory; see the module.
        engine: `auto`, `c` or `mjx`; `auto` is the one that the directory was started with, if any.
        profiles: of `PROFILES`.
        repeats: worlds of each case, from starts that differ by a seeded shift; by default 3, or 1 in a quick run.
        seed: of the shifts.
        quick: run fewer cases, without video.
        values: parameters for all worlds, by name, such as another friction.
        controller: file of a policy (`nermo-mjx train`), which walks in every case in place of the published controller
            and acts upon it; full lock is left out if it observes a path. A copy is kept in the directory.
        bodies: members of the identified ensemble to run as well, once each and each from a start of its own, in the
            profiles that are judged; the report then gives each line's 90 % interval over bodies and starts. None uses
            those in the directory.
        video: whether to make the videos.
        again: rerun and replace the directory's results of these experiments, regardless of the code that made them.
        accept_new_code: resume a directory that other code started; the tables' column `code` tells the rows apart.
        watch: is told what is at work (`Progress.what`) and its finished share, and anything unusual.
        progress: whether it is shown where somebody looks, if there is no watch.
        workers: what simulates; by default this process, one experiment after the other, else
            `nermo_mjx.runs.ray_workers.RayWorkers`. The numbers are the same.

    Raises:
        ParameterError: wrong arguments, or a directory that holds one of them with other settings; nothing has run.
        OtherCode: other code made what the directory holds; nothing has run.
        JobFailed: an experiment failed, or all workers are lost; what was done before is kept.
        DirectoryError: the directory holds something else, is in use, or cannot be written.
        Interrupted: Ctrl-C or SIGTERM; the same call resumes.
    """
    chosen = [EXPERIMENTS[choice("experiment", name, EXPERIMENTS)] for name in dict.fromkeys(names)]
    if repeats is None:
        repeats = cases.QUICK_REPEATS if quick else cases.REPEATS
    policy = None if controller is None else ReplacementPolicy.of(os.fspath(controller))
    settings = Settings(profiles, repeats, seed, quick, values or {}, policy)
    # Values set for all worlds also apply to the bodies.
    several = {} if bodies is None else draw(bodies, seed)
    several = {name: of for name, of in several.items() if name not in settings.values}
    for each in chosen:
        if policy is not None and not each.walks:
            walking = ", ".join(name for name, other in EXPERIMENTS.items() if other.walks)
            raise ParameterError(
                f"controller does not apply to {each.name}, where nothing walks: allowed is {walking}."
            )
        for name in settings.values:
            if name not in each.settable:
                raise ParameterError(
                    f"{name} cannot be set for {each.name}, whose cases decide it or do not use it."
                )
    resolve_engine(engine)
    directory = Directory(out)
    with RunDirectory(out, "experiments") as held, resumable(directory.out):
        if engine == "auto" and not again:
            engine = engine_of(directory.out) or engine
        code = Simulation(resolve_engine(engine)).stamp()
        call = _Call(
            Written(held), directory, settings, code, several, again, video and not quick, watch
        )
        # All are looked up before anything runs, so that an error costs no simulation.
        kept = {each.name: None if again else call.kept(each) for each in chosen}
        holds_rows = any((directory.out / "results").glob("*.parquet"))
        held.take_code(code, holds_rows=holds_rows, accept=again or accept_new_code)
        if policy is not None:
            held.write(policy.file, policy.content)
        if several or None in kept.values():
            held.note_session(session(experiments=list(kept)))
        parts = [part for each in chosen for part in call.missing(each, kept[each.name])]
        stored, left, results = (
            call.simulated(parts, workers or LocalWorkers()),
            {part.label for part in parts},
            [],
        )
        for each in chosen:
            while any(part.name == each.name and part.label in left for part in parts):
                left.remove(next(stored))
            results.append(call.finish(each, kept[each.name]))
        return ExperimentsResult(directory.out, tuple(results), directory.report(call.written))


# --- simulation: a worker's task is an experiment with its own body, or with a batch of identified ones

#: Bodies per batch: their recordings in the maze and the balance test take half a gigabyte.
AT_ONCE: Final = 16


def draw(bodies: int, seed: int) -> dict[str, np.ndarray]:
    """Bodies that walk as published in the set-up of the tests, for all profiles: parameter name -> (bodies,) values.

    Raises:
        ParameterError: not a whole number of at least 1, or there are fewer.
    """
    from nermo_mjx.robot import identified

    cases.check_whole("bodies", bodies, 1)
    return identified.choose(bodies, seed)


@dataclasses.dataclass(frozen=True)
class Part:
    """A task: all worlds of an experiment, or those of some identified bodies.

    Attributes:
        name: of the experiment.
        run: simulates it; settings: its settings, except for the engine.
        bodies: number of all bodies of a profile; 0 for the experiment's own. begin: the first of these.
    """

    name: str
    run: Callable[[Settings], CaseRuns]
    settings: Settings
    bodies: int = 0
    begin: int = 0

    @property
    def worlds(self) -> int:
        """Its share of the work of all parts of a label."""
        return max(self.settings.body_count, 1)

    @property
    def label(self) -> str:
        """Description of the task."""
        return f"{self.name}, {self.bodies} bodies" if self.bodies else self.name


@dataclasses.dataclass(frozen=True)
class Simulation:
    """Simulates one part after the other; a `nermo_mjx.runs.workers.Computer`."""

    engine: str

    def warm(self) -> None:
        """Each experiment makes its own simulator."""

    def stamp(self) -> CodeStamp:
        """Stamp of the code, the model and the engine that simulate here."""
        return stamp(load_robot().fingerprint, self.engine)

    def __call__(
        self, part: Part, progress: Callable[[float], None] | None = None
    ) -> tuple[CaseRuns, float]:
        """The result of a part, and its duration [s]."""
        begun = time.monotonic()
        outcome = part.run(
            part.settings.but(engine=self.engine, progress=progress or (lambda share: None))
        )
        return outcome, time.monotonic() - begun


@dataclasses.dataclass(frozen=True)
class _Call:
    """What all experiments of one call share; `bodies` if any are requested."""

    written: Written
    directory: Directory
    settings: Settings
    code: CodeStamp
    bodies: Mapping[str, np.ndarray]
    again: bool
    video: bool
    watch: Watch

    def kept(self, chosen: Experiment) -> Stored | None:
        """The directory's results of an experiment, if they match the request; raises otherwise."""
        stored = self.directory.load(chosen.name)
        if stored is not None and (
            differing := differences(stored.about["settings"], self.settings.as_dict())
        ):
            raise ParameterError(
                f"{self.directory.out} holds {chosen.name} run with other settings ({'; '.join(differing)}): choose "
                "another directory, or replace it with --again (again=True)."
            )
        return stored

    def missing(self, chosen: Experiment, kept: Stored | None) -> list[Part]:
        """The parts of an experiment to simulate: itself, identified bodies, both or neither.

        Each body runs once in the profiles in which the figures are judged, in batches.
        """
        parts = [Part(chosen.name, chosen.run, self.settings)] if kept is None else []
        if not self.bodies:
            return parts
        held = self.directory.load(chosen.name, bodies=True)
        if (
            held is not None
            and held.about["drawn"] == self.drawn
            and not (parts and self._outdated(held))
        ):
            return parts
        judged = {figure.profile for figure in chosen.figures}
        profiles = [name for name in self.settings.profiles if name in judged] or list(
            self.settings.profiles
        )
        count = self.settings.but(bodies=self.bodies).body_count
        for profile in profiles:
            for k in range(0, count, AT_ONCE):
                some = {name: of[k : k + AT_ONCE] for name, of in self.bodies.items()}
                once = self.settings.but(
                    profiles=[profile], repeats=1, seed=self.settings.seed + k, bodies=some
                )
                parts.append(Part(chosen.name, chosen.run, once, count, k))
        return parts

    @property
    def drawn(self) -> str:
        """Hash of the bodies, to identify those in a directory."""
        values = {name: np.asarray(of, float).tolist() for name, of in sorted(self.bodies.items())}
        content = dict.fromkeys(sorted(PROFILES), values)
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]

    def _outdated(self, bodies: Stored | None) -> bool:
        """Whether there are bodies that do not match the current simulation."""
        return self.again or bodies is None or bodies.about["settings"] != self.settings.as_dict()

    def simulated(self, parts: Sequence[Part], workers: Workers) -> Iterator[str]:
        """Simulate parts as workers become free; yields the label of each result once it is stored.

        A result in several parts is stored when the last of them has arrived.
        """
        sessions: dict[str, dict[str, Any]] = {}
        came: dict[str, dict[int, tuple[CaseRuns, float]]] = collections.defaultdict(dict)
        fresh = set()  # experiments whose bodies finished first

        def tasks() -> Iterator[tuple[int, Part]]:
            for key, part in enumerate(parts):
                sessions.setdefault(part.label, session())
                yield key, part

        def tell(key: int, share: float) -> None:
            label = parts[key].label
            total = sum(part.worlds for part in parts if part.label == label)
            done = sum(parts[k].worlds for k in came[label]) + share * parts[key].worlds * (
                key not in came[label]
            )
            self._tell(label, done / total)

        try:
            if parts:
                workers.begin(Simulation(self.code.engine))
            for key, found in workers.results(tasks(), tell) if parts else ():
                part = parts[key]
                several = came[part.label]
                several[key] = found
                tell(key, 1.0)  # remote workers do not report progress
                if len(several) < sum(each.label == part.label for each in parts):
                    continue
                seconds = sum(seconds for _, seconds in several.values())
                made = {"engine": self.code.engine, "code": self.code.id, "wall_seconds": seconds}
                about = sessions[part.label] | {"settings": self.settings.as_dict(), **made}
                if part.bodies:
                    about |= {"bodies": part.bodies, "drawn": self.drawn}
                    batches = [(several[k][0].columns, parts[k].begin) for k in sorted(several)]
                    columns = {
                        name: np.concatenate([of[name] for of, _ in batches])
                        for name in batches[0][0]
                    }
                    # Each batch is numbered from the position of its first body.
                    columns[BODY] = np.concatenate([of[BODY] + begin for of, begin in batches])
                    outcome = dataclasses.replace(
                        several[min(several)][0], columns=columns, recordings={}
                    )
                    self.directory.save(outcome, about, self.written, bodies=True)
                    fresh.add(part.name)
                else:
                    if part.name not in fresh and self._outdated(
                        self.directory.load(part.name, bodies=True)
                    ):
                        self.written.clear(self.directory.path(part.name, bodies=True))
                    self.directory.save(found[0], about, self.written)
                yield part.label
        except TaskFailed as failed:
            error = failed.error
            text = f"{parts[failed.key].name} failed: {error} What was done before is kept in {self.directory.out}."
            if isinstance(error, (ValueError, RuntimeError, OSError)) and not isinstance(
                error, ParameterError
            ):
                if type(error).__module__.startswith("nermo_mjx"):
                    raise JobFailed(text) from error
                error.add_note(text)
            raise error from None

    def finish(self, chosen: Experiment, kept: Stored | None) -> ExperimentResult:
        """Everything derived from new or stored results."""
        from nermo_mjx.experiments.plots import figures_of_experiment
        from nermo_mjx.plotting.files import write_figures

        written, out, stored = (
            self.written,
            self.directory.out,
            kept or self.directory.load(chosen.name),
        )
        assert stored is not None, "it was read back when it was saved"
        if kept is not None:
            made = codes_of(out).get(kept.about.get("code", ""))
            unlike = "" if made is None else made.unlike(self.code)
            other = (
                " by code that is not known"
                if made is None
                else f" by other code ({unlike})"
                if unlike
                else ""
            )
            self.watch.warn(
                f"{chosen.name}: kept as run on {local_time(kept.about['started'])}{other}; --again reruns it."
            )
        several = self.directory.load(chosen.name, bodies=True)
        lines = published_lines(
            stored.outcome, several.outcome if several else None, chosen.figures
        )
        if stored.about["settings"].get(
            "controller"
        ):  # reasons were found for the published controller
            lines = [dataclasses.replace(line, reason="") for line in lines]
        former = (self.directory.entry(chosen.name) if kept is not None else None) or {}
        # The files derived from the results are added once they exist.
        entry = entry_of(chosen.title, stored.outcome, stored.about, lines) | {
            "table": written.name(stored.table),
            "recordings": [written.name(path) for path in stored.recordings],
            "bodies": several.about["bodies"] if several else None,
            "finished": False,
            **{name: former.get(name, []) for name in ("plots", "videos", "notes")},
        }
        self._publish(chosen, entry)
        self._tell(f"{chosen.name}, plots", 0.0)
        plots = write_figures(
            figures_of_experiment(stored.outcome, lines), out / "plots", written.write
        )
        entry["plots"] = [written.name(plot) for plot in plots]
        old = [name for name in written.known if name.startswith(f"plots/{chosen.name}-")]
        written.remove([name for name in old if name not in entry["plots"]])
        entry["videos"], entry["notes"] = self._videos(chosen, stored.outcome, entry["videos"])
        self._publish(chosen, entry | {"finished": True})
        if written.aside:
            self.watch.warn(f"{chosen.name}: {written.sentence()}")
            written.aside.clear()
        videos = tuple(out / video["file"] for video in entry["videos"])
        files = (stored.table, tuple(plots), stored.recordings, videos)
        result = (chosen.name, out, stored.outcome, tuple(lines), *files)
        return ExperimentResult(*result, kept is not None, tuple(entry["notes"]))

    def _tell(self, what: str, share: float) -> None:
        self.watch.progress(Progress(share, what=what))

    def _publish(self, chosen: Experiment, entry: dict[str, Any]) -> None:
        """Store an experiment's entry, and the report of the whole directory."""
        self.directory.write_entry(chosen.name, entry)
        self.directory.report(self.written)

    def _videos(
        self, chosen: Experiment, outcome: CaseRuns, made: list[dict[str, Any]]
    ) -> tuple[list[dict[str, Any]], list[str]]:
        """The video's file, content and speed, and a note if it should exist but does not."""
        if made and all((self.directory.out / video["file"]).exists() for video in made):
            return made, []
        shows = chosen.shot.choose(outcome)
        if not self.video or shows is None:
            return [], []
        path = self.directory.out / "videos" / f"{chosen.name}.mp4"
        partial = path.with_name(f".{chosen.name}{TEMPORARY_SUFFIX}.mp4")
        try:
            speed = shoot(
                outcome,
                chosen.shot,
                partial,
                lambda share: self._tell(f"{chosen.name}, video", share),
            )
            self.written.write(path, read_bytes(partial, MAX_FILE_BYTES))
        except (VideoError, RecordingError) as error:
            note = f"There is no video of {chosen.name}. {error}"
            self.watch.warn(note)
            return [], [note]
        finally:
            partial.unlink(missing_ok=True)
        return [{"file": self.written.name(path), "shows": shows, "speed": speed}], []


#: A frame takes 0.1 to 0.15 s of one core without a graphics card, so that a video takes 25 s at most.
FPS, WIDTH, HEIGHT, LONGEST = 20, 480, 360, 8.0


def shoot(
    outcome: CaseRuns, shot: Shot, path: Path, progress: Callable[[float], None] | None = None
) -> float:
    """Render the video of an experiment that has a recording, and return its speed.

    Raises:
        VideoError: this machine cannot draw or encode.
        RecordingError: the recording was made with another version of the model.
    """
    name = shot.choose(outcome)
    assert name is not None
    recording = outcome.recordings[name]
    labels, end = recording.metadata.get("labels", {}), math.inf
    if shot.until in outcome.columns and set(labels) <= set(outcome.columns):
        reached = outcome.mean(shot.until, **labels) + 1.0
        end = reached if math.isfinite(reached) else end
    speed = max(shot.speed, float(math.ceil(end / LONGEST)) if math.isfinite(end) else 0.0)
    began = float(recording.time[0])
    shown = recording.between(began, began + min(speed * LONGEST, end))
    report = None if progress is None else lambda done, frames: progress(done / frames)
    look: dict[str, Any] = {
        "fps": FPS,
        "width": WIDTH,
        "height": HEIGHT,
        "camera": shot.camera,
        "speed": speed,
    }
    render(shown, robot_of(recording).model, path, progress=report, **look)
    return speed
