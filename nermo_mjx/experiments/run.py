"""Run the published experiments into a directory: each one's results are stored as soon as it is done.

A directory is resumed where it was interrupted: an experiment in it, run with the same settings, is not run again.
Experiments of one directory may have been run with different settings; each keeps its own, and the report says so.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np

from nermo_mjx.control.parameters import PROFILES
from nermo_mjx.experiments.cases import (
    BODY,
    QUICK_REPEATS,
    REPEATS,
    Outcome,
    Settings,
    Substitute,
    body_count,
    check_whole,
    joined,
)
from nermo_mjx.experiments.catalogue import EXPERIMENTS, Experiment, Shot, experiment
from nermo_mjx.experiments.directory import Directory, Stored
from nermo_mjx.experiments.lines import Line, compare
from nermo_mjx.experiments.report import differences, entry_of
from nermo_mjx.physics.making import resolve_engine
from nermo_mjx.robot import ParameterError, load_robot
from nermo_mjx.runs import CodeStamp, RunDirectory, Written, codes_of, engine_of, session
from nermo_mjx.runs.code import stamp
from nermo_mjx.runs.directory import remove_leftovers
from nermo_mjx.runs.workers import LocalWorkers, TaskFailed, Workers, WorkersLost
from nermo_mjx.view import RecordingError, VideoError, render, robot_of

#: Bodies per batch: their recordings in the maze and the balance test take half a gigabyte.
AT_ONCE: Final = 16
#: A frame takes 0.1 to 0.15 s of one core without a graphics card, so that a video takes 25 s at most.
FPS, WIDTH, HEIGHT, LONGEST = 20, 480, 360, 8.0
#: Files derived from the results, which are added to an experiment's entry once they exist.
_MADE_LATER: Final = ("plots", "videos", "notes")


class ExperimentError(RuntimeError):
    """A failed experiment; the message names it and says what is kept."""


class ExperimentsInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM; the message says how to resume."""


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
    outcome: Outcome
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
    progress: Callable[[str, float], None] | None = None,
    notify: Callable[[str], None] | None = None,
    workers: Workers | None = None,
) -> ExperimentsResult:
    """Run experiments; each is stored when it finishes, and the report is rewritten after each.

    Args:
        names: of `EXPERIMENTS`.
        out: the directory; see `nermo_mjx.experiments.directory`.
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
        progress: called with the current activity and its finished share.
        notify: called with a message about anything unusual.
        workers: what simulates; by default this process, one experiment after the other, else
            `nermo_mjx.runs.ray_workers.RayWorkers`. The numbers are the same.

    Raises:
        ParameterError: wrong arguments, or a directory that holds one of them with other settings; nothing has run.
        OtherCode: other code made what the directory holds; nothing has run.
        ExperimentError: an experiment failed, or all workers are lost; what was done before is kept.
        DirectoryError: the directory holds something else, is in use, or cannot be written.
        ExperimentsInterrupted: Ctrl-C or SIGTERM; the same call resumes.
    """
    chosen = [experiment(name) for name in dict.fromkeys(names)]
    if repeats is None:
        repeats = QUICK_REPEATS if quick else REPEATS
    substitute = None if controller is None else Substitute.of(os.fspath(controller))
    settings = Settings(profiles, repeats, seed, quick, values or {}, substitute)
    drawn = None if bodies is None else draw(bodies, seed)
    _check_applicable(chosen, settings)
    resolve_engine(engine)
    directory = Directory(out)
    with RunDirectory(out, "experiments") as held, _stoppable(directory.out):
        for folder in ("results", "plots"):
            remove_leftovers(directory.out / folder)
        if engine == "auto" and not again:
            engine = engine_of(directory.out) or engine
        code = Simulation(resolve_engine(engine)).stamp()
        work = _Work(Written(held), directory, settings, code, drawn, again, video and not quick, progress or _ignore,
                     notify or _ignore)  # fmt: skip
        # All are looked up before anything runs, so that an error costs no simulation.
        kept = {each.name: None if again else work.kept(each) for each in chosen}
        held.take_code(code, holds_rows=directory.holds_rows(), accept=again or accept_new_code)
        if substitute is not None:
            held.write(substitute.file, substitute.content)
        if drawn is not None or None in kept.values():
            held.note_session(session(experiments=list(kept)))
        parts = [part for each in chosen for part in work.missing(each, kept[each.name])]
        stored, left, results = work.simulated(parts, workers or LocalWorkers()), {part.label for part in parts}, []
        for each in chosen:
            while any(part.name == each.name and part.label in left for part in parts):
                left.remove(next(stored))
            results.append(work.finish(each, kept[each.name]))
        return ExperimentsResult(directory.out, tuple(results), directory.report(work.written))


def draw(bodies: int, seed: int) -> dict[str, dict[str, np.ndarray]]:
    """Bodies that walk as published in the set-up of each profile: profile -> parameter name -> (bodies,) values.

    Raises:
        ParameterError: not a whole number of at least 1, or there are fewer.
    """
    from nermo_mjx.robot import identified

    check_whole("bodies", bodies, 1)
    own, published = (identified.choose(bodies, seed, profile) for profile in ("exact", "as_published"))
    return {"exact": own, "as_published": published, "as_built": own}


def _check_applicable(chosen: Sequence[Experiment], settings: Settings) -> None:
    """Reject a parameter that an experiment sets itself, case by case, or does not have, and a controller without a
    walk."""
    for each in chosen:
        if settings.controller is not None and not each.walks:
            walks = ", ".join(name for name, other in EXPERIMENTS.items() if other.walks)
            raise ParameterError(f"controller does not apply to {each.name}, where nothing walks: allowed is {walks}.")
        for name in settings.values:
            if name not in each.settable:
                raise ParameterError(f"{name} cannot be set for {each.name}, whose cases decide it or do not use it.")


# --- simulation: a worker's task is an experiment with its own body, or with a batch of identified ones


@dataclasses.dataclass(frozen=True)
class Part:
    """A task: all worlds of an experiment, or those of some identified bodies.

    Attributes:
        name: of the experiment.
        run: simulates it; settings: its settings, except for the engine.
        begin, bodies: the first of these bodies, and their number; both 0 for the experiment's own.
        before, total: bodies of all profiles before these, and in all.
        drawn: fingerprint of all of them.
    """

    name: str
    run: Callable[[Settings], Outcome]
    settings: Settings
    begin: int = 0
    bodies: int = 0
    before: int = 0
    total: int = 0
    drawn: str = ""

    @property
    def label(self) -> str:
        """Description of the task."""
        return f"{self.name}, {self.bodies} bodies" if self.bodies else self.name

    def share(self, done: float) -> float:
        """Share of all bodies that is finished, given the share of these."""
        return (self.before + done * body_count(self.settings.bodies)) / self.total if self.bodies else done


def of_bodies(
    chosen: Experiment, bodies: Mapping[str, Mapping[str, np.ndarray]], settings: Settings
) -> list[Part]:  # fmt: skip
    """An experiment of every body, once each in the profiles in which its figures are judged, in batches."""
    judged = {figure.profile for figure in chosen.figures}
    profiles = [name for name in settings.profiles if name in judged] or list(settings.profiles)
    count, drawn, parts = body_count(bodies[profiles[0]]), fingerprint(bodies), []
    for number, profile in enumerate(profiles):
        for k in range(0, count, AT_ONCE):
            some = {name: of[k : k + AT_ONCE] for name, of in bodies[profile].items()}
            once = settings.but(profiles=[profile], repeats=1, seed=settings.seed + k, bodies=some)
            before, total = number * count + k, len(profiles) * count
            parts.append(Part(chosen.name, chosen.run, once, k, count, before, total, drawn))
    return parts


def fingerprint(bodies: Mapping[str, Mapping[str, np.ndarray]]) -> str:
    """Hash of bodies by profile, to identify those in a directory."""
    content = {profile: {name: np.asarray(of, float).tolist() for name, of in sorted(values.items())}
               for profile, values in sorted(bodies.items())}  # fmt: skip
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


@dataclasses.dataclass(frozen=True)
class Simulated:
    """Results of an experiment, or of all its bodies: the session that started it, and its total duration [s]."""

    part: Part
    outcome: Outcome
    session: dict[str, Any]
    seconds: float


def simulate(
    parts: Sequence[Part], engine: str, workers: Workers, progress: Callable[[str, float], None]
) -> Iterator[Simulated]:
    """Simulate parts as workers become free; a result in several parts is yielded when the last of them has arrived.

    Raises:
        TaskFailed: a part failed; its key is the part's index.
        WorkersLost: no worker is left.
    """
    if not parts:
        return
    workers.begin(Simulation(engine))
    sessions: dict[str, dict[str, Any]] = {}
    came: dict[str, dict[int, tuple[Outcome, float]]] = collections.defaultdict(dict)
    bodies: collections.Counter[str] = collections.Counter()

    def tasks() -> Iterator[tuple[int, Part]]:
        for key, part in enumerate(parts):
            sessions.setdefault(part.label, session())
            yield key, part

    def tell(key: int, share: float) -> None:
        progress(parts[key].label, parts[key].share(share))

    for key, found in workers.results(tasks(), tell):
        part = parts[key]
        several = came[part.label]
        several[key] = found
        bodies[part.label] += body_count(part.settings.bodies)
        # Remote workers do not report progress.
        progress(part.label, bodies[part.label] / part.total if part.bodies else 1.0)
        if len(several) == sum(each.label == part.label for each in parts):
            outcome = found[0]
            if part.bodies:
                outcome = _numbered([(parts[k].begin, several[k][0]) for k in sorted(several)])
            yield Simulated(part, outcome, sessions[part.label], sum(seconds for _, seconds in several.values()))


def _numbered(parts: Sequence[tuple[int, Outcome]]) -> Outcome:
    """Results of all bodies, from batches with the position of their first body; `BODY` distinguishes them."""
    several = []
    for begin, part in parts:
        columns = {name: column + begin if name == BODY else column for name, column in part.columns.items()}
        several.append(dataclasses.replace(part, columns=columns, recordings={}))
    return joined(several)


@dataclasses.dataclass(frozen=True)
class Simulation:
    """Simulates one part after the other; a `nermo_mjx.runs.workers.Computer`."""

    engine: str

    def warm(self) -> None:
        """Each experiment makes its own simulator."""

    def stamp(self) -> CodeStamp:
        """Stamp of the code, the model and the engine that simulate here."""
        return stamp(load_robot().fingerprint, self.engine)

    def __call__(self, part: Part, progress: Callable[[float], None] | None = None) -> tuple[Outcome, float]:
        """The result of a part, and its duration [s]."""
        begun = time.monotonic()
        outcome = part.run(part.settings.but(engine=self.engine, progress=progress or _ignore))
        return outcome, time.monotonic() - begun


# --- a call: what is kept, what is missing, what is made of it


@dataclasses.dataclass(frozen=True)
class _Work:
    """What all experiments of one call share."""

    written: Written
    directory: Directory
    settings: Settings
    code: CodeStamp
    bodies: Mapping[str, Mapping[str, np.ndarray]] | None
    again: bool
    video: bool
    progress: Callable[[str, float], None]
    notify: Callable[[str], None]

    def kept(self, chosen: Experiment) -> Stored | None:
        """The directory's results of an experiment, if they match the request; raises otherwise."""
        stored = self.directory.load(chosen.name)
        if stored is None:
            return None
        differing = differences(stored.about["settings"], self.settings.as_dict())
        if differing:
            raise ParameterError(
                f"{self.directory.out} holds {chosen.name} run with other settings ({'; '.join(differing)}): choose "
                "another directory, or replace it with --again (again=True)."
            )
        return stored

    def missing(self, chosen: Experiment, kept: Stored | None) -> list[Part]:
        """The parts of an experiment to simulate: itself, identified bodies, both or neither."""
        parts = [Part(chosen.name, chosen.run, self.settings)] if kept is None else []
        if self.bodies is None:
            return parts
        # Values set for all worlds also apply to the bodies.
        bodies = {
            profile: {name: of for name, of in values.items() if name not in self.settings.values}
            for profile, values in self.bodies.items()
        }
        held = self.directory.load(chosen.name, bodies=True)
        fits = held is not None and held.about["drawn"] == fingerprint(bodies)
        if fits and not (parts and self._outdated(held)):
            return parts
        return parts + of_bodies(chosen, bodies, self.settings)

    def simulated(self, parts: Sequence[Part], workers: Workers) -> Iterator[str]:
        """Simulate parts and store their results; yields the label of each stored result."""
        fresh = set()  # experiments whose bodies finished first
        try:
            for each in simulate(parts, self.code.engine, workers, self.progress):
                part = each.part
                about = each.session | {"settings": self.settings.as_dict(), "engine": self.code.engine,
                                        "code": self.code.id, "wall_seconds": each.seconds}  # fmt: skip
                if part.bodies:
                    about |= {"bodies": part.bodies, "drawn": part.drawn}
                    self.directory.save_bodies(each.outcome, about, self.written)
                    fresh.add(part.name)
                else:
                    if part.name not in fresh and self._outdated(self.directory.load(part.name, bodies=True)):
                        self.written.clear(self.directory.path(part.name, bodies=True))
                    self.directory.save(each.outcome, about, self.written)
                yield part.label
        except TaskFailed as failed:
            self._explain(parts[failed.key].name, failed.error)
        except WorkersLost as lost:
            raise ExperimentError(lost.kept_in(self.directory.out)) from None

    def _outdated(self, bodies: Stored | None) -> bool:
        """Whether there are bodies that do not match the current simulation."""
        return self.again or bodies is None or bodies.about["settings"] != self.settings.as_dict()

    def finish(self, chosen: Experiment, kept: Stored | None) -> ExperimentResult:
        """Everything derived from new or stored results."""
        written, stored = self.written, kept or self.directory.load(chosen.name)
        assert stored is not None, "it was read back when it was saved"
        if kept is not None:
            self.notify(f"{chosen.name}: kept as run on {kept.about['started']}{self._other_code(kept)}; --again "
                        "reruns it.")  # fmt: skip
        several = self.directory.load(chosen.name, bodies=True)
        lines = compare(stored.outcome, several.outcome if several else None, chosen.figures)
        if stored.about["settings"].get("controller"):  # reasons were found for the published controller
            lines = [dataclasses.replace(line, reason="") for line in lines]
        former = self.directory.entry(chosen.name) if kept is not None else None
        entry = entry_of(chosen.title, stored.outcome, stored.about, lines) | {
            "table": self._name(stored.table), "recordings": [self._name(path) for path in stored.recordings],
            "bodies": several.about["bodies"] if several else None, "finished": False,
            **{name: (former or {}).get(name, []) for name in _MADE_LATER},
        }  # fmt: skip
        self._publish(chosen, entry)
        plots = self._plots(chosen, stored.outcome, lines)
        entry["plots"] = [self._name(plot) for plot in plots]
        entry["videos"], entry["notes"] = self._videos(chosen, stored.outcome, entry["videos"])
        self._publish(chosen, entry | {"finished": True})
        if written.aside:
            self.notify(f"{chosen.name}: {written.sentence()}")
            written.aside.clear()
        return ExperimentResult(
            chosen.name, self.directory.out, stored.outcome, tuple(lines), stored.table, tuple(plots),
            stored.recordings, tuple(self.directory.out / video["file"] for video in entry["videos"]),
            kept is not None, tuple(entry["notes"]),
        )  # fmt: skip

    def _name(self, path: Path) -> str:
        return self.written.name(path)

    def _other_code(self, kept: Stored) -> str:
        """The difference between the stored results' code and this one, for a sentence; empty if there is none."""
        made = codes_of(self.directory.out).get(kept.about.get("code", ""))
        if made is None:
            return " by code that is not known"
        return f" by other code ({unlike})" if (unlike := made.unlike(self.code)) else ""

    def _explain(self, name: str, error: BaseException) -> NoReturn:
        """Raise the error of a failed part, with a sentence that names the experiment and what is kept."""
        text = f"{name} failed: {error} What was done before is kept in {self.directory.out}."
        if isinstance(error, (ValueError, RuntimeError, OSError)) and not isinstance(error, ParameterError):
            if type(error).__module__.startswith("nermo_mjx"):
                raise ExperimentError(text) from error
            error.add_note(text)
        raise error

    def _publish(self, chosen: Experiment, entry: dict[str, Any]) -> None:
        """Store an experiment's entry, and the report of the whole directory."""
        self.directory.write_entry(chosen.name, entry)
        self.directory.report(self.written)

    def _plots(self, chosen: Experiment, outcome: Outcome, lines: Sequence[Line]) -> list[Path]:
        from nermo_mjx.experiments.plots import figures_of
        from nermo_mjx.plotting.files import write_figures

        self.progress(f"{chosen.name}, plots", 0.0)
        plots = write_figures(figures_of(outcome, lines), self.directory.out / "plots", self.written.write)
        made, own = {self._name(plot) for plot in plots}, f"plots/{chosen.name}-"
        self.written.remove([name for name in self.written.known if name.startswith(own) and name not in made])
        return plots

    def _videos(
        self, chosen: Experiment, outcome: Outcome, made: list[dict[str, Any]]
    ) -> tuple[list[dict[str, Any]], list[str]]:
        """The video's file, content and speed, and a note if it should exist but does not."""
        if made and all((self.directory.out / video["file"]).exists() for video in made):
            return made, []
        shows = chosen.shot.choose(outcome)
        if not self.video or shows is None:
            return [], []
        path = self.directory.out / "videos" / f"{chosen.name}.mp4"

        def make(path: Path) -> float:
            return shoot(outcome, chosen.shot, path, lambda share: self.progress(f"{chosen.name}, video", share))

        try:
            speed = self.written.make(path, make)
        except (VideoError, RecordingError) as error:
            note = f"There is no video of {chosen.name}. {error}"
            self.notify(note)
            return [], [note]
        return [{"file": self._name(path), "shows": shows, "speed": speed}], []


def shoot(outcome: Outcome, shot: Shot, path: Path, progress: Callable[[float], None] | None = None) -> float:
    """Render the video of an experiment that has a recording, and return its speed.

    Raises:
        VideoError: this machine cannot draw or encode.
        RecordingError: the recording was made with another version of the model.
    """
    name = shot.choose(outcome)
    assert name is not None
    recording = outcome.recordings[name]
    robot = robot_of(recording)
    labels, end = recording.metadata.get("labels", {}), math.nan
    if shot.until in outcome.columns and set(labels) <= set(outcome.columns):
        end = outcome.mean(shot.until, **labels) + 1.0
    speed = max(shot.speed, float(math.ceil(end / LONGEST)) if math.isfinite(end) else 0.0)
    began = float(recording.time[0])
    render(
        recording.between(began, began + min(speed * LONGEST, end if math.isfinite(end) else math.inf)), robot.model,
        path, fps=FPS, width=WIDTH, height=HEIGHT, camera=shot.camera, speed=speed,
        progress=None if progress is None else lambda done, frames: progress(done / frames),
    )  # fmt: skip
    return speed


def _ignore(*_: Any) -> None:
    """Stands in for a callback that was not given."""


@contextlib.contextmanager
def _stoppable(out: Path) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        raise ExperimentsInterrupted(
            f"stopped; the experiments that are finished are kept in {out}. To resume, run the same command again."
        ) from None
