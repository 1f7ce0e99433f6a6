"""Identification of parameters that the publication does not give: servo gain and damping, and joint damping.

The objective uses only the published speeds on the straight line, in one profile. A figure's term is its
deviation from the published value, in tolerances stated beforehand: 10 % of a ratio, 2 % of an order. The objective is
the root of their mean square. The search is a Sobol sample, then CMA-ES (Hansen 2016) from its best point, both in the
logarithms of the parameters and inside physical bounds; a generation is one batch. It is followed by an ensemble of all
bodies within the tolerance. A directory of it holds identification.json, a report, plots, and the walks of all
candidates (`nermo_mjx.runs.rows`).
"""

from __future__ import annotations

import dataclasses
import math
import os
import shlex
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from matplotlib.figure import Figure
from pydantic import BaseModel, Field, FiniteFloat
from scipy.stats import qmc

from nermo_mjx.control.parameters import AS_PUBLISHED_BODY, body_values, robot_choices
from nermo_mjx.experiments import ensemble
from nermo_mjx.experiments.cases import AMPLITUDE, Case, CaseRuns, Column, Settings, columns_about, texts, worlds
from nermo_mjx.experiments.report import REPEAT, published_text, rounded, table_of
from nermo_mjx.files import FileError, json_of
from nermo_mjx.optimize.methods import strategy
from nermo_mjx.physics.making import resolve_engine
from nermo_mjx.plotting.charts import page as blank_page
from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.plotting.style import BAND, BEST, LINE, MUTED, SHADE
from nermo_mjx.plotting.style import MISSING as GREY
from nermo_mjx.progress import shows_progress
from nermo_mjx.robot import ModelParameters, ParameterError
from nermo_mjx.robot.quantity import choice, quantities
from nermo_mjx.rollout import Run, Setup
from nermo_mjx.runs import RunDirectory, Written, codes_of, engine_of, session
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import SessionRecord
from nermo_mjx.runs.files import (
    MISSING,
    DirectoryError,
    content_of,
    listed,
    stored_json,
    table,
    to_json,
)
from nermo_mjx.runs.job import SILENT, Progress, Watch, resumable
from nermo_mjx.runs.rows import Runs, keys_of, opened_part, part_files
from nermo_mjx.runs.status import Status, last_command, metadata_of
from nermo_mjx.runs.workers import LocalWorkers, TaskFailed, Workers
from nermo_mjx.specs.described import digest_of
from nermo_mjx.specs.reading import changes
from nermo_mjx.specs.walk import WalkSpec
from nermo_mjx.sweep.simulating import Simulated, SweepSimulator

#: Where the search starts, by profile: the values of an earlier prototype of this robot, or the author's.
START: Final[dict[str, float]] = texts("identification")["start"]
STARTS: Final = {"exact": START, "as_published": {name: AS_PUBLISHED_BODY[name] for name in START}}

# --- targets


@dataclasses.dataclass(frozen=True)
class Target:
    """A published ratio of speeds: an interval, whose ends are equal for a value, and infinite for an order; and the
    deviation of the logarithm that counts as one."""

    low: float
    high: float
    tolerance: float = 0.1

    def residual(self, value: np.ndarray) -> np.ndarray:
        """Deviation from the interval in tolerances, signed; NaN if undefined."""
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.log(value)
        over = np.maximum(logarithm - math.log(self.high), 0.0) if math.isfinite(self.high) else 0.0
        return (over + np.minimum(logarithm - math.log(self.low), 0.0)) / self.tolerance


#: A target is the speed of one walk (gait, frequency, with the spine) over that of another, or over the theory's.
_RATIOS: Final[dict[str, tuple[Target, Any, Any]]] = {
    name: (Target(low, high, tolerance), tuple(one), other and tuple(other))
    for name, (low, high, tolerance, one, other) in texts("identification")["targets"].items()
}
TARGETS: Final = {name: target for name, (target, _, _) in _RATIOS.items()}
#: Without the author's PD pilot, as on the straight line.
_NO_PILOT: Final = {"pilot.error_gain": 0.0, "pilot.change_gain": 0.0}
CASES: Final = tuple(
    Case(
        {"gait": gait, "frequency": frequency, "spine": spine},
        gait,
        values={"frequency": frequency, "spine.amplitude": AMPLITUDE * spine, **_NO_PILOT},
    )
    for frequency in (0.5, 0.8)
    for gait, spine in (
        ("trot", False),
        ("trot", True),
        ("walking_trot", False),
        ("walking_trot", True),
        ("lateral_walk", False),
    )
)
#: No-slip speed of the trot at 0.8 Hz (5.22) [m/s].
_THEORY: Final = 0.096
#: Objective of a candidate that falls, diverges, or walks backwards: worse than any completed walk.
FAILED: Final = 10.0


def speed_figures(speed: np.ndarray) -> dict[str, np.ndarray]:
    """The figures of `TARGETS` from speeds of shape (candidates, cases)."""
    at = {tuple(case.labels.values()): speed[:, i] for i, case in enumerate(CASES)}
    return {name: at[one] / (_THEORY if other is None else at[other]) for name, (_, one, other) in _RATIOS.items()}


def objective(found: Mapping[str, np.ndarray], failed: np.ndarray) -> np.ndarray:
    """Root of the mean squared residual of each candidate; `failed` ones, and what is not a number, count as 10."""
    squares = np.mean([TARGETS[name].residual(found[name]) ** 2 for name in TARGETS], axis=0)
    return np.where(failed | ~np.isfinite(squares), FAILED, np.sqrt(squares))


# --- candidates: walked in batches of one size and scored; each batch is a part of the directory's runs

#: The walk of the candidates.
WALKS: Final = Setup(pilot="straight", spine="stride_extension")
_CYCLES: Final = 8.0
#: Result of a finished search; and where an earlier version kept candidates.
RESULT, FORMER_CANDIDATES = "identification.json", "candidates.jsonl"


def walking(engine: str, profile: str) -> SweepSimulator:
    """What simulates batches of candidates, with the robot of the profile."""
    own: Any = {name: str(chosen) for name, chosen in robot_choices(profile).items()}
    return SweepSimulator([WalkSpec(dataclasses.replace(WALKS, **own), Run(cycles=_CYCLES), {}, {})], engine)


class Candidates:
    """Walks candidates in batches of one size. Each batch is stored, a row for each walk, and not walked again.

    Args:
        workers: simulate; they begin `walking`.
        cases: parameters of `CASES`, (cases,) each; those outside the space that is searched keep these values.
        batch: number of candidates simulated together; one shape compiles once.
        report: called after each batch.
        runs: where walks are stored, and were; None stores nothing.
        code: what walks.

    Raises:
        DirectoryError: what is stored cannot be read.
    """

    def __init__(
        self,
        workers: Workers,
        cases: Mapping[str, np.ndarray],
        batch: int,
        report: Callable[[], None],
        runs: Runs | None,
        code: CodeStamp,
    ) -> None:
        self._workers, self._cases, self._batch, self._report = workers, cases, batch, report
        self._runs, self._code = runs, code
        #: Key of a walk -> its speed [m/s], and whether it was completed.
        self._known: dict[bytes, tuple[float, bool]] = {}
        for part in runs.parts if runs else ():
            with opened_part(part.path) as file:
                table = file.read(["key", "speed", "status"])
            keys = table["key"].to_numpy(zero_copy_only=False).astype("S32")
            self._note(keys, table["speed"].to_numpy(), np.array(table["status"].to_pylist()))

    def walk(self, points: np.ndarray, space: Mapping[str, ensemble.Free]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """The figures and the objective of points (n, d) of the unit cube, whose axes are a space; (n,) each.

        Raises:
            WorkersLost: no worker is left; finished walks are kept.
        """
        blocks = np.array_split(points, -(-len(points) // self._batch))
        named = [_of_each_case(block, space) for block in blocks]
        keys = [keys_of("", each, len(block) * len(CASES)) for each, block in zip(named, blocks, strict=True)]
        missing = [k for k, own in enumerate(keys) if not self._known.keys() >= set(own.tolist())]
        for _ in range(len(blocks) - len(missing)):
            self._report()

        def tasks() -> Iterator[tuple[int, tuple[int, dict[str, np.ndarray]]]]:
            for k in missing:  # a batch that is not full is padded with its own points
                own = _of_each_case(np.resize(blocks[k], (self._batch, len(space))), space)
                del own["case"]
                yield k, (0, {name: np.tile(column, self._batch) for name, column in self._cases.items()} | own)

        try:
            for k, result in self._workers.results(tasks(), lambda key, share: None):
                self._store(keys[k], named[k], result)
                self._report()
        except TaskFailed as failed:
            raise failed.error from None
        walks = np.array([self._known[key] for own in keys for key in own.tolist()])
        speed, walked = (column.reshape(len(points), -1) for column in walks.T)
        found = speed_figures(speed * self._cases.get("tracking.clock_ratio", 1.0))
        return found, objective(found, np.logical_not(walked.all(axis=1)))

    def _store(self, keys: np.ndarray, named: Mapping[str, np.ndarray], found: Simulated) -> None:
        count = len(keys)
        metrics = {name: column[:count] for name, column in found.metrics.items()}
        self._note(keys, metrics["speed"], found.status[:count])
        if self._runs is None:
            return
        labels = {name: np.array([case.labels[name] for case in CASES])[named["case"]] for name in CASES[0].labels}
        columns = {"row": len(self._runs.numbers) + np.arange(count), **named, **labels, REPEAT: np.zeros(count, int)}
        units = {name: Column(about.unit, about.doc) for name, about in quantities(ModelParameters)}
        units |= {"row": Column("1", "position among the walks"), "case": Column("1", "which of a candidate's walks")}
        outcome = CaseRuns(
            "identification",
            columns | metrics | {"status": found.status[:count]},
            columns_about("straight-line") | units,
            {},
        )
        about = {
            "engine": self._code.engine,
            "code": self._code.id,
            "steps": found.steps,
            "wall_seconds": found.seconds,
        }
        self._runs.add(keys, table_of(outcome, about, self._code.id))

    def _note(self, keys: np.ndarray, speed: np.ndarray, status: np.ndarray) -> None:
        self._known |= zip(keys.tolist(), zip(speed.tolist(), (status == "ok").tolist(), strict=True), strict=True)


def _of_each_case(points: np.ndarray, space: Mapping[str, ensemble.Free]) -> dict[str, np.ndarray]:
    """What tells the walks of points (n, d) apart: parameter or `case` -> (n x cases,)."""
    own = {name: np.repeat(column, len(CASES)) for name, column in ensemble.parameters_of(points, space).items()}
    return own | {"case": np.tile(np.arange(len(CASES)), len(points))}


# --- search


@dataclasses.dataclass(frozen=True)
class Identified:
    """Result of an identification.

    Attributes:
        parameters: model parameter -> value.
        objective: at those; start: at `START`.
        figures, start_figures: target -> (value, residual in tolerances), at those and at `START`.
        costs: objective of every candidate of the search in the order they were tried.
        bodies: the ensemble; None if it was not requested.
    """

    parameters: dict[str, float]
    objective: float
    start: float
    figures: dict[str, tuple[float, float]]
    start_figures: dict[str, tuple[float, float]]
    costs: tuple[float, ...]
    bodies: ensemble.Bodies | None = None


@dataclasses.dataclass(frozen=True)
class IdentificationSearch:
    """Extent of the search.

    Attributes:
        samples: of the Sobol sequence.
        generations, population: of CMA-ES; as many candidates as a population are simulated together throughout.
        bodies: size of the ensemble, including the best one; 0 to omit it.
        sweeps: maximum number for the ensemble; each tries as many candidates as bodies are requested.
        tolerance: maximum objective of a body in the ensemble.
        seed: of all three; the start of the walks is the same for all candidates.
        profile: the set-up, exact or as_published, which made the targets.

    Raises:
        ParameterError: a number is too small, or another profile.
    """

    samples: int = 64
    generations: int = 25
    population: int = 12
    bodies: int = 256
    sweeps: int = 5
    tolerance: float = ensemble.TOLERANCE
    seed: int = 0
    profile: str = "exact"

    def __post_init__(self) -> None:
        choice("profile", self.profile, ensemble.FREE_IN)
        least = {"samples": 1, "generations": 1, "population": 4, "sweeps": 1, "bodies": 8 if self.bodies else 0}
        for name, lowest in least.items():
            if getattr(self, name) < lowest:
                raise ParameterError(f"{name} is {getattr(self, name)}: allowed is {lowest} or more.")
        if not self.tolerance > 0:
            raise ParameterError(f"tolerance is {self.tolerance:g}: allowed is more than 0.")

    def digest(self) -> str:
        """A hash of what determines the candidates; the ensemble's settings decide only their number."""
        begun = {name: getattr(self, name) for name in ("samples", "generations", "population", "seed", "profile")}
        return digest_of(begun, WALKS.defaults())


def identify(
    wanted: IdentificationSearch,
    engine: str = "auto",
    runs: Runs | None = None,
    watch: Watch = SILENT,
    workers: Workers | None = None,
) -> Identified:
    """Find the parameters whose straight-line speeds match the published ones best, then all within the tolerance.

    Args:
        engine: of the simulations.
        runs: what is stored in it is not simulated again; see `Candidates`.
        watch: is told the share done.
        workers: what simulates; by default this process. The numbers are the same: a task is a batch, and results are
            processed in the order of the batches.

    Raises:
        DirectoryError: as for `Candidates`.
        WorkersLost: no worker is left.
    """
    population, bodies, seed, free = wanted.population, wanted.bodies, wanted.seed, ensemble.FREE_IN[wanted.profile]
    computer, workers = walking(resolve_engine(engine), wanted.profile), workers or LocalWorkers()
    defaults = WALKS.defaults() | body_values(wanted.profile)
    cases = worlds(CASES, defaults, Settings((wanted.profile,), repeats=1, seed=seed)).values
    batches = -(-(wanted.samples + 1) // population) + wanted.generations
    batches, done = batches + (wanted.sweeps + 1) * -(-bodies // population), 0

    def report() -> None:
        nonlocal done
        done += 1
        watch.progress(Progress(done / batches))

    candidates = Candidates(workers, cases, population, report, runs, computer.stamp())
    workers.begin(computer)
    tried: list[tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]] = []

    def evaluate(points: np.ndarray) -> np.ndarray:
        tried.append((points, *candidates.walk(points, free)))
        return tried[-1][-1]

    def so_far() -> tuple[np.ndarray, np.ndarray, int]:
        costs = np.concatenate([objectives for _, _, objectives in tried])
        return np.concatenate([points for points, _, _ in tried]), costs, int(np.argmin(costs))

    design = qmc.Sobol(len(free), rng=seed).random_base2((wanted.samples - 1).bit_length())[: wanted.samples]
    evaluate(np.vstack([ensemble.point_of(STARTS[wanted.profile], free), design]))
    points, costs, least = so_far()
    evolution = strategy(points[least], 0.15, population, np.random.default_rng(seed + 1), bounds=[0.0, 1.0])
    for _ in range(wanted.generations):
        asked = np.array(evolution.ask())
        evolution.tell(list(asked), evaluate(asked).tolist())
    points, costs, least = so_far()
    best = {name: float(value) for name, value in ensemble.parameters_of(points[least], free).items()}
    several = None
    if bodies:
        space, tolerance = free | ensemble.UNCERTAIN, wanted.tolerance
        # The first sweep also starts around the search's points within the tolerance, at the default frictions.
        near = points[costs <= tolerance]
        friction = np.tile(ensemble.point_of(defaults, ensemble.UNCERTAIN), (len(near), 1))
        found = ensemble.sample_bodies(
            lambda points: candidates.walk(points, space)[1],
            len(space),
            tolerance=tolerance,
            size=bodies,
            sweeps=wanted.sweeps,
            seed=seed,
            seeds=np.hstack([near, friction]),
        )
        with_best = bool(costs[least] <= tolerance)
        kept = ensemble.thin(found, bodies - with_best, seed)
        drawn, objectives, weights = ensemble.parameters_of(kept.points, space), kept.costs, kept.weights
        values = {name: drawn[name] for name in ensemble.free_names(space)}
        if with_best:  # it is the first, with the average weight of the others
            values = {name: np.append(best.get(name, defaults[name]), column) for name, column in values.items()}
            objectives = np.append(costs[least], objectives)
            weights = np.append(1.0, weights * len(weights)) / (1 + len(weights))
        several = ensemble.Bodies(values, objectives, weights, tolerance, found)
    watch.progress(Progress(1.0))

    def with_residuals(which: int) -> dict[str, tuple[float, float]]:
        columns = {name: np.concatenate([found[name] for _, found, _ in tried]) for name in TARGETS}
        return {name: (float(of[which]), float(TARGETS[name].residual(of[which]))) for name, of in columns.items()}

    every = tuple(costs.tolist())
    return Identified(best, every[least], every[0], with_residuals(least), with_residuals(0), every, several)


# --- a directory

FORMULA: Final = (
    "root of the mean over all targets of r^2, where r = ln(value / published) / tolerance, of an interval its nearer "
    "end; r = 0 inside it, and where an order (published: at least 1) is met; 10 for a candidate that falls, diverges "
    "or goes backwards"
)
TARGET_HEADINGS: Final = (
    ("ratio of speeds", "left"),
    *((name, "right") for name in ("published", "tolerance", "before", "identified", "residual [tolerances]")),
)
PARAMETER_HEADINGS: Final = tuple(
    (name, "right" if name in ("start", "identified") else "left")
    for name in ("parameter", "start", "identified", "bounds", "why these")
)
#: A parameter is at a bound if it is closer to it than this share of the range of its logarithm.
_AT_BOUND: Final = 0.01


@shows_progress("identification")
def run_identification(
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    accept_new_code: bool = False,
    watch: Watch = SILENT,
    progress: bool = True,
    workers: Workers | None = None,
    **wanted: Any,
) -> dict[str, Any]:
    """Identify, and write the result into a directory; an interrupted search there is resumed.

    Args:
        out: the directory.
        engine: of the simulations; `auto` is the one that the directory was started with, if any.
        accept_new_code: reuse candidates of other code; the file's `code` tells them apart.
        watch: is told the share done, and of conflicting files.
        progress: whether it is shown where somebody looks, if there is no watch.
        workers: what simulates; by default this process. The result is the same.
        wanted: of `Search`.

    Returns:
        Content of identification.json.

    Raises:
        ParameterError: wrong arguments, or a directory that holds an identification or a search with other settings.
        OtherCode: other code made the candidates that the directory holds.
        DirectoryError: the directory holds something else, is in use, or cannot be written.
        JobFailed: no worker is left; the same command resumes.
    """
    resolve_engine(engine)
    folder = Path(out)
    search = IdentificationSearch(**wanted)
    settings = dataclasses.asdict(search)
    with RunDirectory(folder, "identification") as held, Written(held) as written, resumable(folder):
        if content := _result(folder):
            if apart := changes(content["settings"], settings):
                raise ParameterError(
                    f"{folder} holds an identification with another {', '.join(apart)}; choose another directory."
                )
            return _publish(written, content, watch)
        if engine == "auto":
            engine = engine_of(folder) or engine
        if (folder / FORMER_CANDIDATES).exists():
            raise DirectoryError(f"{folder} holds candidates of an earlier version: choose another directory.")
        code, defaults = walking(resolve_engine(engine), search.profile).stamp(), WALKS.defaults()
        runs = Runs(folder, search.digest(), warn=watch.warn, held=held)
        if runs.others:
            raise ParameterError(f"{folder} belongs to a search with other settings: choose another directory.")
        runs.take_codes([code], accept=accept_new_code)
        about = session(settings=settings, engine=code.engine)
        held.note_session(about)
        started = time.monotonic()
        identified = identify(search, code.engine, runs, watch, workers)
        made = {"model": code.model, "defaults": defaults, "codes": list(codes_of(folder))}
        content = {**_content(identified, search.profile), **made, **about, "wall_seconds": time.monotonic() - started}
        # The result first: whatever happens to the plots, the search is not lost.
        held.write(RESULT, to_json(content))
        return _publish(written, content, watch)


def _publish(written: Written, content: dict[str, Any], watch: Watch) -> dict[str, Any]:
    """Create the rest of the directory from its result, which has `plots` when everything exists."""
    folder = written.held.out
    if content["ensemble"] and content["ensemble"]["size"]:
        written.write(folder / "ensemble.csv", ensemble.csv_text(content).encode())
    plots = write_figures(figures_of_identification(content), folder / "plots", written.write)
    content = content | {"plots": [written.name(path) for path in plots]}
    page = texts("report")["identification"].format(
        **content,
        target_table=table([name for name, _ in TARGET_HEADINGS], target_rows(content), "lrrrrr"),
        parameter_table=table([name for name, _ in PARAMETER_HEADINGS], parameter_rows(content), "lrrll"),
        ensemble_section=ensemble.ensemble_section(content),
        pictures="".join(f"![{Path(p).stem}]({p})\n\n" for p in content["plots"] if p.endswith(".png")),
        code_names=", ".join(content["codes"]),
        version_names=listed(content["versions"]),
        machine_names=listed(content["machine"]),
    )
    written.write(folder / "identification.md", page.encode())
    written.held.write(RESULT, to_json(content))
    if written.aside:
        watch.warn(written.sentence())
    return content


def _content(found: Identified, profile: str) -> dict[str, Any]:
    """The search and its result."""
    known = dict(quantities(ModelParameters))
    targets = {}
    for name, target in TARGETS.items():
        ends = [target.low, target.high if math.isfinite(target.high) else None]
        (value, residual), (start, start_residual) = found.figures[name], found.start_figures[name]
        targets[name] = {"published": target.low if target.low == target.high else ends, "tolerance": target.tolerance}
        targets[name] |= {"value": value, "residual": residual, "start": start, "start_residual": start_residual}
    free = {}
    for name, about in ensemble.FREE_IN[profile].items():
        value = found.parameters[about.names[0]]
        place = math.log(value / about.low) / math.log(about.high / about.low)
        free[name] = {
            "parameters": list(about.names),
            "unit": known[about.names[0]].unit,
            "low": about.low,
            "high": about.high,
            "why": about.why,
            "default": [STARTS[profile][each] for each in about.names],
            "value": value,
            "at_bound": "lower" if place < _AT_BOUND else "upper" if place > 1 - _AT_BOUND else None,
        }
    rounded = {name: f"{value:.4g}" for name, value in found.parameters.items()}
    return {
        "parameters": found.parameters,
        "options": " ".join(f"--set {name}={value}" for name, value in rounded.items()),
        "yaml": "set:\n" + "".join(f"  {name}: {value}\n" for name, value in rounded.items()),
        "objective": {"formula": FORMULA, "start": found.start, "end": found.objective},
        "targets": targets,
        "free": free,
        "candidates": len(found.costs),
        "costs": list(found.costs),
        "ensemble": None
        if found.bodies is None
        else ensemble.ensemble_content(found.bodies, ensemble.FREE_IN[profile] | ensemble.UNCERTAIN),
    }


def target_rows(content: Mapping[str, Any]) -> list[list[str]]:
    """Rows of texts under `TARGET_HEADINGS`."""
    rows = []
    for name, target in content["targets"].items():
        published, residual = target["published"], target["residual"]
        order = isinstance(published, list) and published[1] is None
        values = [MISSING if target[key] is None else rounded(target[key]) for key in ("start", "value")]
        away = MISSING if residual is None else f"{residual + 0.0:+.2f}"
        text = f"at least {published[0]:g}" if order else published_text(published)
        rows.append([name, text, f"{target['tolerance']:.0%}", *values, away])
    return rows


def parameter_rows(content: Mapping[str, Any]) -> list[list[str]]:
    """Rows of texts under `PARAMETER_HEADINGS`."""
    rows = []
    for free in content["free"].values():
        names = ", ".join(free["parameters"]) + (f" [{free['unit']}]" if free["unit"] != "1" else "")
        value = rounded(free["value"]) + (f" (at its {free['at_bound']} bound)" if free["at_bound"] else "")
        default = ", ".join(dict.fromkeys(f"{value:g}" for value in free["default"]))
        rows.append([names, default, value, f"{free['low']:g} to {free['high']:g}", free["why"]])
    return rows


def identification_status(out: Path) -> Status:
    """Number of candidates that an identification has simulated."""
    notes, content = list[str](), stored_json(out / RESULT, _Content) or {}
    complete = "plots" in content  # comes last
    if complete:
        drawn = content["ensemble"] or {}
        done = len(content["costs"]) + sum(each["candidates"] for each in drawn.get("sweeps", ()))
    else:
        parts = [metadata_of(path, notes, "its candidates will be walked again.") for path in part_files(out)]
        done = sum(about.num_rows for about in parts if about is not None) // len(CASES)
        notes += ["Its candidates are of an earlier version."] if (out / FORMER_CANDIDATES).exists() else []
    command = f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out)
    sessions = [content] if content else []
    total = done if complete else None
    return Status("candidates", done, total, complete, command, engine_of(out), sessions=sessions, notes=tuple(notes))


# --- figures

#: Costs above this multiple of the start's are cut off: for candidates that fell, only that fact matters.
_SHOWN: Final = 2.0


def figures_of_identification(content: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """The figures of identification.json's content."""
    profile = f"profile {content['settings'].get('profile', 'exact')}"
    yield "identification-search", _search(content, profile)
    yield "identification-residuals", _residuals(content, profile)
    if (several := content.get("ensemble")) and several["size"]:
        yield "identification-ensemble", ensemble.ensemble_figure(several, profile)


def drawn(out: Path) -> Figures:
    """The figures of an identification's directory.

    Raises:
        DirectoryError: its result cannot be read.
    """
    content = _result(out)
    if content is None:
        raise DirectoryError(f"{out / RESULT} is missing: run the identification again.")
    return figures_of_identification(content)


class _Target(BaseModel, extra="allow"):
    residual: float | None
    start_residual: float | None


class _Ends(BaseModel, extra="allow"):
    start: FiniteFloat
    end: FiniteFloat


class _Settings(BaseModel, extra="allow"):
    generations: int
    population: int


class _Drawn(BaseModel, extra="allow"):
    low: Annotated[FiniteFloat, Field(gt=0)]
    high: Annotated[FiniteFloat, Field(gt=0)]
    quantiles: Annotated[list[FiniteFloat], Field(min_length=1)] | None = None


class _Round(BaseModel, extra="allow"):
    candidates: int


class _Ensemble(BaseModel, extra="allow"):
    size: int
    tolerance: FiniteFloat
    parameters: dict[str, _Drawn]
    sweeps: list[_Round] = Field(default_factory=list)
    bodies: dict[str, list[FiniteFloat]] = Field(default_factory=dict)


class _Content(SessionRecord):
    """What identification.json says, as far as it is read."""

    settings: _Settings
    costs: list[float | None]
    objective: _Ends
    targets: dict[str, _Target]
    ensemble: _Ensemble | None
    plots: list[str] | None = None


def _result(out: Path) -> dict[str, Any] | None:
    """The content of identification.json; None if there is none.

    Raises:
        DirectoryError: it is damaged, or cannot be read now.
    """
    content = content_of(out / RESULT)
    try:
        found: dict[str, Any] | None = None if content is None else json_of(content, _Content, out / RESULT)
        if found and (drawn := found["ensemble"]) and drawn["size"]:
            lengths = [
                len(drawn.get("bodies", {}).get(name, ())) for name in (*drawn["parameters"], "objective", "weight")
            ]
            if {*lengths} != {drawn["size"]} or not all(each.get("quantiles") for each in drawn["parameters"].values()):
                raise FileError(f"{out / RESULT}: its ensemble has not {drawn['size']} bodies")
        return found
    except FileError as error:
        raise DirectoryError(f"{str(error).rstrip('.')}: move it away, and run the identification again.") from None


def _search(content: Mapping[str, Any], note: str) -> Figure:
    costs, end = np.asarray(content["costs"], float), content["objective"]
    figure = blank_page("Objective of every candidate, in the order tried", 7.0, 3.6, note)
    ax = figure.subplots()
    top = _SHOWN * max(end["start"], end["end"])
    ax.scatter(np.arange(len(costs)), np.minimum(costs, top), s=9, color=BAND, lw=0, label="candidate")
    ax.step(np.arange(len(costs)), np.minimum.accumulate(costs), where="post", color=LINE, lw=1.6, label="best so far")
    ax.axhline(end["start"], color=MUTED, lw=0.9, ls="--", label="at the start")
    # The initial Sobol search fills whole batches: its length is the total minus the generations.
    sampled = len(costs) - content["settings"]["generations"] * content["settings"]["population"]
    if 0 < sampled < len(costs):
        ax.axvline(sampled - 0.5, color=GREY, lw=1)
        ax.annotate("CMA-ES", (sampled, top), xytext=(4, -2), textcoords="offset points", va="top", color=MUTED)
    ax.set(xlabel="candidate [1]", ylabel="objective [1]", ylim=(0, 1.03 * top), xlim=(-1, len(costs)))
    ax.legend(loc="upper right", ncols=3, bbox_to_anchor=(1.0, 1.14))
    return figure


def _residuals(content: Mapping[str, Any], note: str) -> Figure:
    targets = content["targets"]
    figure = blank_page("Deviation from the published speeds", 7.0, 1.5 + 0.3 * len(targets), note)
    ax, y = figure.subplots(), np.arange(len(targets))
    for shift, key, colour, label in (
        (-0.18, "start_residual", BAND, "at the start"),
        (0.18, "residual", LINE, "identified"),
    ):
        values = [np.nan if target[key] is None else target[key] for target in targets.values()]
        ax.barh(y + shift, values, 0.36, color=colour, label=label)
    ax.axvspan(-1, 1, color=SHADE, lw=0, zorder=-5, label="within the tolerance")
    ax.axvline(0, color=BEST, lw=0.9)
    ax.set_yticks(y, list(targets))
    ax.set(xlabel="residual [tolerances]", ylim=(len(targets) - 0.4, -0.6))
    ax.tick_params(axis="y", length=0)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower right", ncols=3)
    return figure
