"""Identification of what the publication does not give, from its speeds: `nermo-mjx identify` without a log.

The published speeds on the straight line, in one profile, are what was measured: ratios of speeds, whose noise is a
tolerance stated beforehand, 10 % of a ratio and 2 % of an order. The objective is the root of the mean squared
deviation in tolerances. CMA-ES searches servo and damping within physical bounds, at the default frictions. Then bodies
are taken evenly within the bounds, those of the frictions included, in logarithms: the ones whose objective is within
the tolerance are equally likely, and are the posterior (rejection sampling). It is done by `Estimation`, and
reported, like the identification from a log.
"""

from __future__ import annotations

import dataclasses
import functools
import html
import itertools
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from nermo_mjx.control.parameters import body_values, robot_choices
from nermo_mjx.experiments import determinacy, log_report
from nermo_mjx.experiments.cases import AMPLITUDE, Case, Settings, texts, worlds
from nermo_mjx.experiments.determinacy import Estimation, Fit, Kept, LoggedSamples, Parameter, ParameterSpace, percent
from nermo_mjx.experiments.report import published_text, rounded
from nermo_mjx.physics.making import resolve_engine
from nermo_mjx.plotting.charts import pair_scatters
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.plotting.shown import shown
from nermo_mjx.progress import shows_progress
from nermo_mjx.robot import ModelParameters, ParameterError
from nermo_mjx.robot.quantity import choice, quantities, require
from nermo_mjx.rollout import Run, Setup
from nermo_mjx.runs import RunDirectory, Written, engine_of, session
from nermo_mjx.runs.files import MISSING, stored_json, to_json
from nermo_mjx.runs.job import SILENT, Progress, Watch, resumable
from nermo_mjx.runs.status import last_command
from nermo_mjx.runs.workers import LocalWorkers, TaskFailed, Workers
from nermo_mjx.specs.described import digest_of
from nermo_mjx.specs.walk import WalkSpec
from nermo_mjx.sweep.simulating import Simulated, SweepSimulator

# --- targets

#: Target -> its interval, whose ends are equal for a value and of which the high one is infinite for an order; its
#: tolerance; and the walk (gait, frequency, whether with the spine) whose speed is compared with another's, or with the
#: theory's.
TARGETS: Final[dict[str, tuple[float, float, float, list, list | None]]] = texts("identification")["targets"]
_LOW, _HIGH, _TOLERANCE = np.array([target[:3] for target in TARGETS.values()], float).T
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


def speed_figures(speed: np.ndarray) -> np.ndarray:
    """The figures of `TARGETS` from speeds of shape (n, cases): (n, targets)."""
    at = {tuple(case.labels.values()): speed[:, i] for i, case in enumerate(CASES)}
    pairs = [(one, other) for *_, one, other in TARGETS.values()]
    return np.stack([at[tuple(one)] / (_THEORY if other is None else at[tuple(other)]) for one, other in pairs], axis=1)


def deviations(figures: np.ndarray) -> np.ndarray:
    """Deviations of figures (n, targets) from the intervals of `TARGETS` in tolerances; NaN if one is not positive."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithm = np.log(np.where(figures > 0, figures, np.nan))
    over, under = np.maximum(logarithm - np.log(_HIGH), 0.0), np.minimum(logarithm - np.log(_LOW), 0.0)
    return (over + under) / _TOLERANCE


def objective(figures: np.ndarray) -> np.ndarray:
    """Root of the mean squared deviation of each body (n,); infinite if it falls, diverges or walks backwards."""
    return np.nan_to_num(np.sqrt(np.mean(deviations(figures) ** 2, axis=1)), nan=math.inf)


# --- what is free, and what bodies deviate by

#: The walk of the candidates.
WALKS: Final = Setup(pilot="straight", spine="stride_extension")
_CYCLES: Final = 8.0
#: Parameters with the value of another one.
SHARED: Final = {"damping.ankle": "damping.knee"}
#: Bodies that are simulated together.
BATCH: Final = 12
#: Fewest bodies that tell anything of a distribution.
FEWEST: Final = 8
#: To four significant digits, as their decimal text reads, so that printed and shipped values are the simulated ones.
_to_four_digits: Final = np.vectorize(lambda value: float(f"{value:.4g}"), otypes=[float])


def free_parameters(profile: str) -> list[Parameter]:
    """What is estimated in a profile: first what is searched, then what is only uncertain, its `kind`."""
    about, known = texts("identification"), dict(quantities(ModelParameters))
    defaults = WALKS.defaults() | body_values(profile)
    ranges = {kind: dict(about[kind]) for kind in ("searched", "uncertain")}
    ranges["searched"] |= about["stiff"] if profile == "as_published" else {}
    return [
        Parameter(name, kind, known[name].unit, float(defaults[name]), neutral=math.nan, **of)
        for kind, each in ranges.items()
        for name, of in each.items()
    ]


class PublishedSpeeds:
    """Walks bodies and compares them with the published speeds: a problem of `Estimation`.

    Args:
        parameters: of the bodies.
        wanted: profile and seed.
        engine: its name.
        watch: is told the share done.
        workers: simulate.
        kept: see `kept_in`.

    Attributes:
        measured: no deviation from any target; one channel.
        bodies: all that were walked, values of the parameters (n, p).
        figures: theirs (n, targets); NaN of those that did not walk to the end.
    """

    def __init__(
        self,
        parameters: list[Parameter],
        wanted: IdentificationSearch,
        engine: str,
        watch: Watch,
        workers: Workers,
        kept: Kept,
    ) -> None:
        count, defaults = len(TARGETS), WALKS.defaults() | body_values(wanted.profile)
        self.measured = LoggedSamples(np.zeros(count), np.zeros(count, int), np.arange(count, dtype=float), np.zeros(1))
        self.bodies, self.figures = np.empty((0, len(parameters))), np.empty((0, count))
        self._names, self._values = [each.name for each in parameters], [each.value for each in parameters]
        self._cases = worlds(CASES, defaults, Settings((wanted.profile,), repeats=1, seed=wanted.seed)).values
        self._wanted, self._watch, self._workers, self._kept = wanted, watch, workers, kept
        workers.begin(walking(engine, wanted.profile))

    def predict(self, values: np.ndarray) -> np.ndarray:
        """Deviations from the targets (k, targets) of bodies (k, q); parameters after the first q have their defaults.

        Raises:
            WorkersLost: no worker is left; what is finished is kept.
        """
        bodies = np.tile(self._values, (len(values), 1))
        bodies[:, : values.shape[1]] = _to_four_digits(values)
        batches = np.array_split(bodies, -(-len(bodies) // BATCH))
        results, found = None, dict[int, np.ndarray]()

        def walked(k: int) -> np.ndarray:
            nonlocal results
            if results is None:  # the first that is not kept: its successors are not, either
                tasks = ((i, (0, self._worlds(batches[i]))) for i in range(k, len(batches)))
                results = self._workers.results(tasks, lambda key, share: None)
            while k not in found:
                i, result = next(results)
                found[i] = self._figures(result)[: len(batches[i])]
            return found.pop(k)

        for k, batch in enumerate(batches):
            try:
                figures = self._kept(functools.partial(walked, k))
            except TaskFailed as failed:
                raise failed.error from None
            self.bodies, self.figures = np.vstack([self.bodies, batch]), np.vstack([self.figures, figures])
            self._watch.progress(Progress(min(len(self.bodies) / self._wanted.candidates, 1.0)))
        return deviations(self.figures[-len(bodies) :])

    def _worlds(self, batch: np.ndarray) -> dict[str, np.ndarray]:
        """The walks of a batch of bodies (n, p), of always as many: their number changes the last bits of a walk."""
        values = {name: np.tile(column, BATCH) for name, column in self._cases.items()}
        each = np.repeat(np.resize(batch, (BATCH, batch.shape[1])), len(CASES), axis=0)
        own = dict(zip(self._names, each.T, strict=True))
        return values | own | {name: own[other] for name, other in SHARED.items()}

    def _figures(self, result: Simulated) -> np.ndarray:
        speed, ok = (each.reshape(-1, len(CASES)) for each in (result.metrics["speed"], result.status == "ok"))
        found = speed_figures(speed * self._cases.get("tracking.clock_ratio", np.ones(1))[0])
        return np.where(ok.all(axis=1, keepdims=True), found, np.nan)


def walking(engine: str, profile: str) -> SweepSimulator:
    """What simulates batches of bodies, with the robot of the profile."""
    own: Any = {name: str(chosen) for name, chosen in robot_choices(profile).items()}
    return SweepSimulator([WalkSpec(dataclasses.replace(WALKS, **own), Run(cycles=_CYCLES), {}, {})], engine)


# --- search


@dataclasses.dataclass(frozen=True)
class IdentificationSearch:
    """Extent of the search.

    Attributes:
        generations: of CMA-ES, for the best body.
        samples: bodies that are tried for the ensemble, evenly within the bounds.
        tolerance: maximum objective of a body in the ensemble; by default half of the deviation declared acceptable,
            at which all targets are off by one tolerance each.
        seed: of all; the start of the walks is the same for all bodies.
        profile: the set-up, exact or as_published, which made the targets.

    Raises:
        ParameterError: a number is too small, or another profile.
    """

    generations: int = 10
    samples: int = 256
    tolerance: float = 0.5
    seed: int = 0
    profile: str = "exact"

    def __post_init__(self) -> None:
        choice("profile", self.profile, ("exact", "as_published"))
        for name, least in (("generations", 1), ("samples", FEWEST)):
            if getattr(self, name) < least:
                raise ParameterError(f"{name} is {getattr(self, name)}: allowed is {least} or more.")
        if not self.tolerance > 0:
            raise ParameterError(f"tolerance is {self.tolerance:g}: allowed is more than 0.")

    @property
    def candidates(self) -> int:
        """How many bodies are walked: the default one, those of the search, and the samples."""
        return 1 + self.generations * determinacy.POPULATION + self.samples


@dataclasses.dataclass(frozen=True)
class Identified:
    """Result of an identification.

    Attributes:
        wanted: of what search.
        fit: the best body of the search, with the ensemble as draws; with the whole sample, if that is too small.
        figures: of the profile's body, and of the best (2, targets).
        costs: objective of all candidates, the profile's body, those of the search, and the samples (n,).
        bodies: values of the best, and of those within the tolerance (m, p).
        objective: theirs (m,).
    """

    wanted: IdentificationSearch
    fit: Fit
    figures: np.ndarray
    costs: np.ndarray
    bodies: np.ndarray
    objective: np.ndarray

    @property
    def values(self) -> np.ndarray:
        """Of the best body (p,)."""
        return self.bodies[0]

    @property
    def intervals(self) -> np.ndarray:
        """Ends of the 90 % intervals (p, 2)."""
        return self.fit.intervals

    def sentences(self) -> list[str]:
        """The verdict in words."""
        size, of = len(self.bodies) - 1, self.wanted
        better = int(np.sum(self.objective[1:] < self.objective[0]))
        said = [
            f"Objective {self.costs[0]:.3f} with the body of the profile, {self.objective[0]:.3f} with the best of "
            f"{len(self.costs) - of.samples} of CMA-ES, at the default frictions.",
            f"{size} of {of.samples} bodies within the bounds, {percent(size / of.samples)}, have an objective of at "
            f"most {of.tolerance:g}; {better} of them are nearer to the published speeds than the best.",
        ]
        few = f"These are fewer than {FEWEST}, too few for intervals: those shown are of all within the bounds."
        return said + ([few] if size < FEWEST else determinacy.determinacy_sentences(self.fit))


def identify(
    wanted: IdentificationSearch,
    engine: str = "auto",
    watch: Watch = SILENT,
    workers: Workers | None = None,
    kept: Kept = lambda compute: compute(),
) -> Identified:
    """Find the body whose straight-line speeds match the published ones best, and all within the tolerance.

    Args:
        wanted: extent.
        engine: of the simulations.
        watch: is told the share done.
        workers: what simulates; by default this process. The numbers are the same.
        kept: of what computes an array, that array: computed, or kept from before; the order is always the same.

    Raises:
        WorkersLost: no worker is left.
    """
    parameters = free_parameters(wanted.profile)
    space = ParameterSpace(parameters)
    problem = PublishedSpeeds(parameters, wanted, resolve_engine(engine), watch, workers or LocalWorkers(), kept)
    problem.predict(np.array([[each.value for each in parameters]]))
    search = Estimation(ParameterSpace([each for each in parameters if each.kind == "searched"]), problem)
    for _ in search.sought(wanted.generations, wanted.generations, wanted.seed):
        pass  # the problem keeps all bodies that it is asked for
    Estimation(space, problem).scanned(wanted.samples, wanted.seed)
    costs = objective(problem.figures)
    sampled = len(costs) - wanted.samples
    least, within = int(np.argmin(costs[:sampled])), sampled + np.flatnonzero(costs[sampled:] <= wanted.tolerance)
    draws = space.coordinates(problem.bodies[within if len(within) >= FEWEST else slice(sampled, None)])
    variances, directions = np.linalg.eigh(np.cov(draws.T))
    residual = deviations(problem.figures[[least]])[0]
    x, no_jacobian = space.coordinates(problem.bodies[least]), np.empty((0, len(space)))
    fit = Fit(
        space, x, residual, np.ones(1), no_jacobian, np.sqrt(np.maximum(variances, 0.0)), directions, draws, draws[:0]
    )
    chosen = [least, *within]
    return Identified(wanted, fit, problem.figures[[0, least]], costs, problem.bodies[chosen], costs[chosen])


# --- a directory

FORMULA: Final = (
    "root of the mean over all targets of r^2, where r = ln(value / published) / tolerance, of an interval its nearer "
    "end; r = 0 inside it, and where an order (published: at least 1) is met"
)
TARGET_HEADINGS: Final = (
    "ratio of speeds", "published", "tolerance", "before", "identified", "residual [tolerances]",
)  # fmt: skip


@shows_progress("identification")
def run_identification(
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    watch: Watch = SILENT,
    progress: bool = True,
    workers: Workers | None = None,
    **wanted: Any,
) -> tuple[Identified, dict[str, Any]]:
    """Identify, and write the result into a directory; an interrupted search there is resumed.

    Args:
        out: the directory.
        engine: of the simulations; `auto` is the one that the directory was started with, if any.
        watch: is told the share done, and of conflicting files.
        progress: whether it is shown where somebody looks, if there is no watch.
        workers: what simulates; by default this process. The result is the same.
        wanted: of `IdentificationSearch`.

    Returns:
        The result, and the content of identification.json.

    Raises:
        ParameterError: wrong arguments, or a directory with an identification with other settings or by other code.
        DirectoryError: the directory holds something else, is in use, or cannot be written.
        JobFailed: no worker is left; the same command resumes.
    """
    resolve_engine(engine)
    require("identify", "cma", "cma")
    folder, search = Path(out), IdentificationSearch(**wanted)
    with RunDirectory(folder, "identification") as held, Written(held) as written, resumable(folder):
        begun = engine_of(folder) if engine == "auto" else None
        code = walking(begun or resolve_engine(engine), search.profile).stamp()
        decides = digest_of(dataclasses.asdict(search), code.fields(), WALKS.defaults())
        steps = stored_json(folder / log_report.STEPS, log_report.KeptSteps)
        if (folder / log_report.RESULT).exists() if steps is None else steps["decides"] != decides:
            raise ParameterError(
                f"{folder} holds an identification with other settings or by other code: choose another directory."
            )
        held.take_code(code, holds_rows=False)
        about = session(settings=dataclasses.asdict(search), engine=code.engine)
        held.note_session(about)
        found = identify(search, code.engine, watch, workers, log_report.kept_in(folder, decides))
        content = {**_content(found), "defaults": WALKS.defaults(), "code": code.fields(), **about}
        written.write(folder / "ensemble.csv", _ensemble(found, about))
        plots = write_figures(figures_of_identification(found), folder / "plots", written.write)
        content["plots"] = [written.name(path) for path in plots]
        targets = log_report.html_table(TARGET_HEADINGS, target_rows(found))
        parts = [f"<h2>Published speeds</h2>{targets}<p>Objective: {html.escape(FORMULA)}.</p>"]
        title = f"Bodies that walk as published, {found.wanted.profile}"
        told = (content["sentences"], parts, found, last_command(folder))
        page = log_report.identification_page(title, *told, figures_of_identification(found))
        written.write(folder / "report.html", page)
        held.write(log_report.RESULT, to_json(content))
        if written.aside:
            watch.warn(written.sentence())
        return found, content


def _content(found: Identified) -> dict[str, Any]:
    """The search and its result."""
    targets = {}
    for i, (name, (low, high, tolerance, *_)) in enumerate(TARGETS.items()):
        (start, value), (before, after) = found.figures[:, i], deviations(found.figures)[:, i]
        published = low if low == high else [low, high]
        targets[name] = {"published": published, "tolerance": tolerance, "value": value, "residual": after}
        targets[name] |= {"start": start, "start_residual": before}
    return {
        "sentences": found.sentences(),
        "parameters": log_report.estimates(found),
        "options": " ".join(f"--set {name}={value[0]:.4g}" for name, value in _columns(found).items()),
        "objective": {"formula": FORMULA, "start": found.costs[0], "end": found.objective[0]},
        "targets": targets,
        "costs": found.costs,
        "ensemble": {"size": len(found.bodies) - 1, "samples": found.wanted.samples},
    }


def _columns(found: Identified) -> dict[str, np.ndarray]:
    """Parameter -> values of the bodies (m,), with those that have the value of another."""
    columns = dict(zip([each.name for each in found.fit.space.parameters], found.bodies.T, strict=True))
    return columns | {name: columns[other] for name, other in SHARED.items()}


def _ensemble(found: Identified, about: dict[str, Any]) -> bytes:
    """ensemble.csv, as `nermo_mjx.robot.identified` reads it."""
    options = " ".join(f"--{name} {value}" for name, value in about["settings"].items())
    size, wanted = len(found.bodies) - 1, found.wanted
    return log_report.ensemble_text(
        f"Bodies whose objective on the straight line, in the profile {wanted.profile}, is at most "
        f"{wanted.tolerance:g}: {size} of {wanted.samples}; the best of the search goes before them.\n"
        f"Made by: nermo-mjx identify {options}\n"
        f"Engine {about['engine']}, MuJoCo {about['versions']['mujoco']}. SI units.",
        _columns(found),
        found.objective,
    )


def target_rows(found: Identified) -> list[list[str]]:
    """Rows of texts under `TARGET_HEADINGS`."""
    rows = []
    for i, (name, (low, high, tolerance, *_)) in enumerate(TARGETS.items()):
        published = f"at least {low:g}" if math.isinf(high) else published_text(low if low == high else [low, high])
        numbers = [MISSING if np.isnan(value) else rounded(value) for value in found.figures[:, i]]
        away = MISSING if np.isnan(found.fit.residual[i]) else f"{found.fit.residual[i] + 0.0:+.2f}"
        rows.append([name, published, f"{tolerance:.0%}", *numbers, away])
    return rows


def figures_of_identification(found: Identified) -> Iterator[tuple[str, Figure]]:
    """The figures of a result: intervals, and the bodies over each pair of parameters."""
    note = f"{len(found.bodies) - 1} bodies within {found.wanted.tolerance:g}, profile {found.wanted.profile}"
    yield "intervals", log_report.intervals_figure(found, note)
    if len(found.bodies) > FEWEST:
        about = zip(found.fit.space.parameters, found.bodies.T, strict=True)
        pairs = list(itertools.combinations([shown(each.name, each.unit, of, log=True) for each, of in about], 2))
        cost = shown("objective", "1", found.objective, side="min")
        yield "ensemble", pair_scatters(pairs, cost, "Bodies that walk as published within the tolerance", f"{note}; ")
