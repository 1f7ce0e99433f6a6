"""The job that runs the published experiments into a directory, and its resumption.

The results of an experiment are stored as soon as it is complete. A later call with the same settings keeps them, so that
an interrupted run continues where it stopped. The experiments of a directory can have different settings; the report
lists the differences. `nermo_mjx.experiments.store` describes the files.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import math
import os
import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from nermo_mjx.experiments import balance, cases, stands, walks
from nermo_mjx.experiments.cases import PROFILES, CaseRuns, ReplacementPolicy, Settings
from nermo_mjx.experiments.published import Experiment, Line, Shot, published_lines
from nermo_mjx.experiments.report import differences, entry_of
from nermo_mjx.experiments.store import Directory, ExperimentRows, Stored
from nermo_mjx.files import MAX_FILE_BYTES, TEMPORARY_SUFFIX, read_bytes
from nermo_mjx.physics.making import resolve_engine
from nermo_mjx.plotting.files import Figures
from nermo_mjx.progress import shows_progress
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
from nermo_mjx.runs.directory import read_record
from nermo_mjx.runs.job import SILENT, Progress, Watch, resumable
from nermo_mjx.runs.rows import part_files
from nermo_mjx.runs.status import Status, last_command
from nermo_mjx.runs.work import Work, finish
from nermo_mjx.runs.workers import LocalWorkers, Workers
from nermo_mjx.view import RecordingError, VideoError, render, robot_of

# --- the experiments by name


def _catalogue() -> Iterator[Experiment]:
    def counted(design: Callable[[Settings], Sequence[cases.Case]]) -> Callable[[Settings], int]:
        return lambda settings: cases.world_count(design(settings), settings)

    def walking(run: Any, design: Any, some: Sequence[cases.Case]) -> tuple[Any, ...]:
        return functools.partial(cases.in_each_robot, run), counted(design), cases.settable(some)

    def line(settings: Settings) -> Sequence[cases.Case]:
        return walks.line_cases(settings.quick)

    def maze(settings: Settings) -> Sequence[cases.Case]:
        return walks.maze_cases()

    tested = functools.partial(cases.in_each_robot, balance.run)
    for name, (run, rows, settable) in {
        "straight-line": walking(walks.walk_line, line, walks.line_cases()),
        "turning": walking(walks.walk_turns, walks.walked_turns, walks.turn_cases()),
        "balance": (tested, balance.balance_world_count, balance.SETTABLE),
        "maze": walking(walks.walk_maze, maze, walks.maze_cases()),
        "body": (stands.run_body, stands.world_counter([{}]), stands.BODY_SETTABLE),
        "leg-stand": (
            stands.run_leg,
            stands.world_counter(stands.LEG_CASES),
            stands.STAND_SETTABLE,
        ),
        "spine-stand": (
            stands.run_spine,
            stands.world_counter(stands.SPINE_CASES),
            stands.STAND_SETTABLE,
        ),
    }.items():
        catalogue_texts = cases.texts("catalogue")[name]
        walks_here = name in ("straight-line", "turning", "maze")
        shot = Shot(**catalogue_texts.get("shot", {}))
        yield Experiment(
            name, run, rows, settable, walks=walks_here, **catalogue_texts | {"shot": shot}
        )


EXPERIMENTS: Final[dict[str, Experiment]] = {
    experiment.name: experiment for experiment in _catalogue()
}

# --- a directory: its status and its figures


def experiments_status(out: Path) -> Status:
    """The experiments in a directory, out of the requested ones."""
    directory, sessions = Directory(out), read_record(out).get("sessions", [])
    directory.refuse_former_layout()
    stored_experiments = {
        name: stored for name in EXPERIMENTS if (stored := directory.load(name)) is not None
    }
    bodies = {
        name: stored
        for name in stored_experiments
        if (stored := directory.load(name, bodies=True)) is not None
    }
    requested = {
        name: None for entry in sessions for name in entry.get("experiments", [])
    } or stored_experiments
    # Files derived from the tables are made last.
    missing_names = [
        name
        for name in requested
        if name not in stored_experiments or not (directory.entry(name) or {}).get("finished")
    ]
    notes = []
    for name, stored in stored_experiments.items():
        metadata, runs = stored.about, f"{name}: {len(stored.outcome)} runs"
        runs += f", and {len(bodies[name].outcome)} of identified bodies" if name in bodies else ""
        code = f", code {metadata['code']}" if "code" in metadata else ""
        notes.append(
            f"{runs}, of {local_time(metadata['started'])}, engine {metadata['engine']}{code}."
        )
    rows = sum(len(stored.outcome) for stored in (*stored_experiments.values(), *bodies.values()))
    complete = bool(stored_experiments) and not missing_names
    command = f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out)
    engine = ", ".join(
        dict.fromkeys(stored.about["engine"] for stored in stored_experiments.values())
    ) or engine_of(out)
    notes += [f"{name} is not finished." for name in missing_names]
    all_metadata = [stored.about for stored in stored_experiments.values()]
    total = rows if complete else None
    return Status(
        "runs",
        rows,
        total,
        complete,
        command,
        engine=engine,
        sessions=all_metadata,
        notes=tuple(notes),
    )


def experiment_status(out: Path) -> Status:
    """The number of rows of an experiment in its directory; identified bodies have a separate directory."""
    name = out.name.removesuffix("-bodies")
    stored = Directory(out.parent).load(name, bodies=name != out.name)
    rows = None if stored is None else len(stored.outcome)
    command = f"nermo-mjx plot {shlex.quote(str(out))}" if rows else last_command(out)
    return Status("runs", rows or 0, rows, rows is not None, command, engine=engine_of(out))


def images(out: Path) -> Figures:
    """The figures of all experiments in a directory, by name.

    Raises:
        DirectoryError: The directory contains no readable experiment.
    """
    from nermo_mjx.experiments.plots import figures_of_experiment

    directory = Directory(out)
    directory.refuse_former_layout()
    stored_experiments = {
        name: stored.outcome for name in EXPERIMENTS if (stored := directory.load(name)) is not None
    }
    if not stored_experiments:
        raise DirectoryError(
            f"{out} holds no experiment whose table and recordings can be read: run it again."
        )
    return (
        image
        for name, outcome in stored_experiments.items()
        for image in figures_of_experiment(
            outcome, published_lines(outcome, None, EXPERIMENTS[name].figures)
        )
    )


# --- a call


@dataclasses.dataclass(frozen=True)
class ExperimentResult:
    """The result of one experiment.

    Attributes:
        name: Name of the experiment.
        out: Directory.
        outcome: Table, and recordings, which are loaded on first access.
        lines: Lines of the report.
        table, plots, recordings, videos: Files of the experiment.
        kept: Whether the directory already contained the result, so that nothing was simulated.
        notes: Sentences about outputs that could not be made.
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
    """The results of several experiments in their order, and the content of report.json."""

    out: Path
    results: tuple[ExperimentResult, ...]
    report: dict[str, Any]


def run_experiment(name: str, out: str | os.PathLike[str], **options: Any) -> ExperimentResult:
    """Run one experiment into a directory; arguments and errors as for `run_experiments`."""
    return run_experiments([name], out, **options).results[0]


@shows_progress("experiments")
# Long because the job passes through all its stages in one place.
# Many parameters because each is an option of the job, most by keyword only.
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
        names: Names from `EXPERIMENTS`.
        out: Directory; see `nermo_mjx.experiments.store`.
        engine: `auto`, `c` or `mjx`; `auto` is the engine of the first call in the directory, if there was one.
        profiles: Names from `PROFILES`.
        repeats: Number of worlds of each case, with randomly shifted initial states; by default 3, or 1 in a quick run.
        seed: Seed of the shifts.
        quick: Whether to run fewer cases, without video.
        values: Name of a parameter -> its value in all worlds, for example another friction.
        controller: File of a policy (`nermo-mjx train`), which acts on top of the published controller in every case;
            full lock is omitted if the policy observes a path. The directory contains a copy.
        bodies: Number of parameter sets of the identified ensemble that run as well, once each and with different
            initial states, in the profiles that are judged. The report then lists the 90 % interval of each line over
            parameter sets and initial states. None uses the parameter sets in the directory.
        video: Whether to make the videos.
        again: Whether to rerun these experiments and to replace their results in the directory, made by any code.
        accept_new_code: Whether to resume a directory that other code started; the column `code` identifies the code.
        watch: Functions that receive the present part (`Progress.what`), its completed share, and warnings.
        progress: Whether a terminal shows the progress if there is no watch.
        workers: Processes that simulate; by default this process, one experiment after the other. With
            `nermo_mjx.runs.ray_workers.RayWorkers`, the results are the same.

    Raises:
        ParameterError: Arguments are wrong, or the directory contains an experiment with other settings. No simulation
            has run.
        OtherCode: Other code made the results in the directory. No simulation has run.
        JobFailed: An experiment failed, or all workers are lost. Earlier results are kept.
        DirectoryError: The directory contains other files, is in use, or cannot be written.
        Interrupted: Ctrl-C or SIGTERM; the same call resumes.
    """
    requested = [
        EXPERIMENTS[choice("experiment", name, EXPERIMENTS)] for name in dict.fromkeys(names)
    ]
    if repeats is None:
        repeats = cases.QUICK_REPEATS if quick else cases.REPEATS
    policy = None if controller is None else ReplacementPolicy.of(os.fspath(controller))
    settings = Settings(profiles, repeats, seed, quick, values or {}, policy)
    # Values set for all worlds also apply to the bodies.
    several = {} if bodies is None else draw(bodies, seed)
    several = {
        name: body_values for name, body_values in several.items() if name not in settings.values
    }
    _check_values(requested, settings)
    resolve_engine(engine)
    directory = Directory(out)
    with (
        RunDirectory(out, "experiments") as run_directory,
        resumable(directory.out),
        contextlib.ExitStack() as stack,
    ):
        directory.refuse_former_layout()
        if engine == "auto" and not again:
            engine = engine_of(directory.out) or engine
        computer = Simulation(resolve_engine(engine))
        call = _Call(
            Written(run_directory), directory, settings, several, again, video and not quick, watch
        )
        # All experiments are loaded before the first simulation, so that an error costs no simulation.
        stored = {
            experiment.name: None if again else call.stored(experiment) for experiment in requested
        }
        holds_rows = any(directory.out.glob("*/results/*.parquet"))
        code, accept = computer.stamp(), again or accept_new_code
        run_directory.take_code(code, holds_rows=holds_rows, accept=accept)
        if policy is not None:
            run_directory.write(policy.file, policy.content)
        if several or None in stored.values():
            run_directory.note_session(session(experiments=list(stored)))
        works = [
            work
            for experiment in requested
            for work in call.works(experiment, stored[experiment.name], stack)
        ]
        finished, remaining, results = (
            finish(works, computer, workers or LocalWorkers(), accept),
            list(works),
            [],
        )
        for experiment in requested:
            while any(work.job.label.partition(",")[0] == experiment.name for work in remaining):
                remaining.remove(next(finished))
            results.append(call.result(experiment, stored[experiment.name], code))
        report = directory.report(call.written, EXPERIMENTS)
        return ExperimentsResult(directory.out, tuple(results), report)


def _check_values(requested: Sequence[Experiment], settings: Settings) -> None:
    """Reject a controller or values that do not apply to an experiment."""
    for experiment in requested:
        if settings.controller is not None and not experiment.walks:
            walking = ", ".join(name for name, candidate in EXPERIMENTS.items() if candidate.walks)
            raise ParameterError(
                f"controller does not apply to {experiment.name}, where nothing walks: allowed is {walking}."
            )
        for name in settings.values:
            if name not in experiment.settable:
                raise ParameterError(
                    f"{name} cannot be set for {experiment.name}, whose cases decide it or do not use it."
                )


# --- simulation: the task of a worker is an experiment with the default parameters, or with a batch of identified ones

#: Number of bodies in a batch, whose recordings in the maze and the balance test need half a gigabyte.
BATCH_BODIES: Final = 16


def draw(bodies: int, seed: int) -> dict[str, np.ndarray]:
    """Sample parameter sets of the identified ensemble: name of a parameter -> values (bodies,).

    Raises:
        ParameterError: `bodies` is not a whole number of at least 1, or the ensemble is smaller.
    """
    from nermo_mjx.robot import identified

    cases.check_whole("bodies", bodies, 1)
    return identified.choose(bodies, seed)


@dataclasses.dataclass(frozen=True)
class Simulation:
    """Simulates one part after the other; a `nermo_mjx.runs.work.RowComputer`."""

    engine: str

    def warm(self) -> None:
        """Do nothing, because each experiment makes its own simulator."""

    def stamp(self, structure: int = 0) -> CodeStamp:
        """Stamp of the code, the model and the engine that simulate here."""
        return stamp(load_robot().fingerprint, self.engine)

    def __call__(
        self,
        task: tuple[Callable[[Settings], CaseRuns], Settings],
        /,
        progress: Callable[[float], None] | None = None,
    ) -> tuple[CaseRuns, float]:
        """Simulate a part, and return its outcome and duration [s]."""
        begun = time.monotonic()
        run, settings = task
        outcome = run(settings.but(engine=self.engine, progress=progress or (lambda share: None)))
        return outcome, time.monotonic() - begun


def _set_aside(path: Path) -> None:
    """Rename a file of rows as a backup, so that an interruption loses no result."""
    path.replace(path.with_suffix(".replaced"))


@dataclasses.dataclass(frozen=True)
class _Call:
    """The data that all experiments of one call share; `bodies` is empty if none are requested."""

    written: Written
    directory: Directory
    settings: Settings
    bodies: Mapping[str, np.ndarray]
    again: bool
    video: bool
    watch: Watch

    def stored(self, experiment: Experiment) -> Stored | None:
        """The results of an experiment in the directory, or None; raises `ParameterError` if their settings differ."""
        stored = self.directory.load(experiment.name)
        if stored is not None and (
            differing := differences(stored.about["settings"], self.settings.as_dict())
        ):
            raise ParameterError(
                f"{self.directory.out} holds {experiment.name} run with other settings ({'; '.join(differing)}): choose "
                "another directory, or replace it with --again (again=True)."
            )
        return stored

    def works(
        self, experiment: Experiment, stored: Stored | None, stack: contextlib.ExitStack
    ) -> Iterator[Work]:
        """The work that remains for an experiment: its rows, and the rows of identified bodies."""
        record = session() | {"settings": self.settings.as_dict()}
        if stored is None:
            yield self._work(experiment, [self.settings], record, stack)
        if self.again:
            for path in part_files(self.directory.folder(experiment.name, bodies=True)):
                _set_aside(path)
        if not self.bodies:
            return
        record |= {"bodies": len(next(iter(self.bodies.values()))), "drawn": self.drawn}
        several = self.directory.load(experiment.name, bodies=True)
        if several is None or several.about["drawn"] != self.drawn:
            yield self._work(experiment, self._body_parts(experiment), record, stack)

    def _body_parts(self, experiment: Experiment) -> list[Settings]:
        """Batches of bodies, in the profiles in which figures are judged; each body runs once."""
        judged = {figure.profile for figure in experiment.figures}
        profiles = [name for name in self.settings.profiles if name in judged]
        return [
            self.settings.but(
                profiles=[profile],
                repeats=1,
                seed=self.settings.seed + first,
                bodies={
                    name: values[first : first + BATCH_BODIES]
                    for name, values in self.bodies.items()
                },
            )
            for profile in profiles or self.settings.profiles
            for first in range(0, len(next(iter(self.bodies.values()))), BATCH_BODIES)
        ]

    def _work(
        self,
        experiment: Experiment,
        parts: Sequence[Settings],
        record: Mapping[str, Any],
        stack: contextlib.ExitStack,
    ) -> Work:
        rows = ExperimentRows(experiment, parts, self.directory, self.written, record)
        run_directory = stack.enter_context(RunDirectory(rows.folder, "experiment"))
        rows.write_record()
        work = Work(rows, run_directory.out, rows.size, watch=self.watch, directory=run_directory)
        if self.again or not len(work.unfinished):  # to replace, or without recordings
            for part in (*work.runs.parts, *work.runs.other_parts):
                _set_aside(part.path)
            work.runs.survey()
        return work

    @property
    def drawn(self) -> str:
        """Hash of the bodies, to identify those in a directory."""
        values = {
            name: np.asarray(samples, float).tolist()
            for name, samples in sorted(self.bodies.items())
        }
        content = dict.fromkeys(sorted(PROFILES), values)
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]

    def result(
        self, experiment: Experiment, former_result: Stored | None, code: CodeStamp
    ) -> ExperimentResult:
        """Write the files that are derived from new or stored results, and return the result."""
        written_files, out, name = self.written, self.directory.out, experiment.name
        stored = former_result or self.directory.load(name)
        if stored is None:
            raise DirectoryError(
                f"{self.directory.folder(name)} was written but cannot be read back: run the same command again."
            )
        if former_result is not None:
            self._warn_of_code(name, former_result, code)
        several = self.directory.load(name, bodies=True)
        lines = published_lines(
            stored.outcome, several.outcome if several else None, experiment.figures
        )
        if stored.about["settings"].get(
            "controller"
        ):  # the reasons apply to the published controller
            lines = [dataclasses.replace(line, reason="") for line in lines]
        former = (self.directory.entry(name) if former_result is not None else None) or {}
        # The files derived from the results are added once they exist.
        entry = entry_of(experiment.title, stored.outcome, stored.about, lines) | {
            "table": written_files.name(stored.table),
            "recordings": [written_files.name(path) for path in stored.recordings],
            "bodies": several.about["bodies"] if several else None,
            "finished": False,
            **{key: former.get(key, []) for key in ("plots", "videos", "notes")},
        }
        self._publish(experiment, entry)
        plots = self._plots(experiment, stored.outcome, lines)
        entry["plots"] = [written_files.name(plot) for plot in plots]
        old = [file for file in written_files.known if file.startswith(f"plots/{name}-")]
        written_files.remove([file for file in old if file not in entry["plots"]])
        entry["videos"], entry["notes"] = self._videos(experiment, stored.outcome, entry["videos"])
        self._publish(experiment, entry | {"finished": True})
        if written_files.aside:
            self.watch.warn(f"{name}: {written_files.sentence()}")
            written_files.aside.clear()
        return ExperimentResult(
            name=name,
            out=out,
            outcome=stored.outcome,
            lines=tuple(lines),
            table=stored.table,
            plots=tuple(plots),
            recordings=stored.recordings,
            videos=tuple(out / video["file"] for video in entry["videos"]),
            kept=former_result is not None,
            notes=tuple(entry["notes"]),
        )

    def _warn_of_code(self, name: str, former: Stored, code: CodeStamp) -> None:
        """Report that results are kept, and whether other code made them."""
        former_code = codes_of(self.directory.out).get(former.about["code"])
        unlike = "" if former_code is None else former_code.unlike(code)
        code_note = f" by other code ({unlike})" if unlike else ""
        code_note = " by code that is not known" if former_code is None else code_note
        self.watch.warn(
            f"{name}: kept as run on {local_time(former.about['started'])}{code_note}; --again reruns it."
        )

    def _plots(
        self, experiment: Experiment, outcome: CaseRuns, lines: Sequence[Line]
    ) -> list[Path]:
        from nermo_mjx.experiments.plots import figures_of_experiment
        from nermo_mjx.plotting.files import write_figures

        self._tell(f"{experiment.name}, plots", 0.0)
        figures = figures_of_experiment(outcome, lines)
        return write_figures(figures, self.directory.out / "plots", self.written.write)

    def _tell(self, what: str, share: float) -> None:
        self.watch.progress(Progress(share, what=what))

    def _publish(self, experiment: Experiment, entry: dict[str, Any]) -> None:
        """Store an experiment's entry, and the report of the whole directory."""
        self.directory.write_entry(experiment.name, entry)
        self.directory.report(self.written, EXPERIMENTS)

    def _videos(
        self, experiment: Experiment, outcome: CaseRuns, videos: list[dict[str, Any]]
    ) -> tuple[list[dict[str, Any]], list[str]]:
        """The video's file, content and speed, and a note if it should exist but does not."""
        if videos and all((self.directory.out / video["file"]).exists() for video in videos):
            return videos, []
        shows = experiment.shot.choose(outcome)
        if not self.video or shows is None:
            return [], []
        path = self.directory.out / "videos" / f"{experiment.name}.mp4"
        partial = path.with_name(f".{experiment.name}{TEMPORARY_SUFFIX}.mp4")
        try:
            speed = shoot(
                outcome,
                experiment.shot,
                partial,
                lambda share: self._tell(f"{experiment.name}, video", share),
            )
            self.written.write(path, read_bytes(partial, MAX_FILE_BYTES))
        except (VideoError, RecordingError) as error:
            note = f"There is no video of {experiment.name}. {error}"
            self.watch.warn(note)
            return [], [note]
        finally:
            partial.unlink(missing_ok=True)
        return [{"file": self.written.name(path), "shows": shows, "speed": speed}], []


#: Frames per second, size in pixels, and maximum duration of a video [s]. Without a graphics card, a frame needs 0.1 to
#: 0.15 s of one core, so that a video needs at most 25 s.
FPS, WIDTH, HEIGHT, LONGEST = 20, 480, 360, 8.0


def shoot(
    outcome: CaseRuns, shot: Shot, path: Path, progress: Callable[[float], None] | None = None
) -> float:
    """Render the video of an experiment that has a recording, and return its speed.

    Raises:
        VideoError: This machine cannot render or encode.
        RecordingError: The recording was made with another version of the model.
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
    excerpt = recording.between(began, began + min(speed * LONGEST, end))
    report = None if progress is None else lambda frame, frames: progress(frame / frames)
    look: dict[str, Any] = {
        "fps": FPS,
        "width": WIDTH,
        "height": HEIGHT,
        "camera": shot.camera,
        "speed": speed,
    }
    render(excerpt, robot_of(recording).model, path, progress=report, **look)
    return speed
