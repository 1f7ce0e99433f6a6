"""Run a tuning: resume from its directory's latest checkpoint, step until the iterations are done, keep the best."""

from __future__ import annotations

import dataclasses
import functools
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import jax
import numpy as np
import pyarrow as pa

from nermo_mjx.optimize.history import Log, empty_log, history_table, is_done
from nermo_mjx.optimize.methods import GenerationTuner, LineTuner, Tuner, TuneState
from nermo_mjx.optimize.objective import TRAJECTORY_ERROR, Problem
from nermo_mjx.optimize.problems import SharedProblem, SimulatedProblem, WalkProblem, load_reference
from nermo_mjx.optimize.tuning import METHODS, Differences, Generations, Gradient, Tuning
from nermo_mjx.optimize.tuning_directory import TUNING, Directory, start_of
from nermo_mjx.optimize.tuning_figures import Pictures, make_pictures
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout import Simulator
from nermo_mjx.rollout.differentiable import Rollout, choose_mode, cost
from nermo_mjx.rollout.run import START_SPREAD
from nermo_mjx.runs.job import SILENT, JobFailed, Progress, Watch, resumable
from nermo_mjx.runs.text import to_json
from nermo_mjx.runs.workers import LocalWorkers, Workers
from nermo_mjx.sweep.simulating import SimulatorLike, pace

# ---
# Verification of start and best: simulated in MuJoCo C, from starts that the tuning has not seen.


#: Walks of each point.
WALKS: Final = 8
#: Tells these draws from all others of a tuning's seed.
_UNSEEN: Final = 0x5EED


def verified(tuning: Tuning, points: Mapping[str, Mapping[str, float]], simulator: SimulatorLike) -> dict[str, Any]:
    """Results of named points on the engine `c`, each simulated from the same few slightly different starts.

    Starts are spread like those of a sweep's repeats. A walk that is compared with a recording has its start, and is
    simulated once.

    Args:
        points: name -> values of the tuned parameters.

    Returns:
        `engine`, `walks`, and of each point under its name `walks_ok`, the means `objective` and `metrics` over the
        completed walks, and `lowest` and `highest` objective of them; None if there are none.
    """
    alone = TRAJECTORY_ERROR in tuning.objective.metrics
    walks = 1 if alone else WALKS
    problem = SimulatedProblem(tuning, simulator=simulator)
    rng = np.random.default_rng([tuning.seed, _UNSEEN])
    known = {*tuning.constants, *tuning.names}
    spread = {
        name: rng.uniform(-width, width, walks)
        for name, width in START_SPREAD.items()
        if name in tuning.parameters and name not in known and not alone
    }
    at = np.repeat([[each[name] for name in tuning.names] for each in points.values()], walks, axis=0)
    value, metrics, ok = problem.walk(at, {name: np.tile(column, len(points)) for name, column in spread.items()})
    found: dict[str, Any] = {"engine": "c", "walks": walks}
    for i, name in enumerate(points):
        mine = np.arange(i * walks, (i + 1) * walks)
        mine = mine[ok[mine]]
        found[name] = None
        if len(mine):
            found[name] = {
                "walks_ok": len(mine),
                "objective": float(value[mine].mean()),
                "lowest": float(value[mine].min()),
                "highest": float(value[mine].max()),
                "metrics": {metric: float(metrics[metric][mine].mean()) for metric in tuning.objective.metrics},
            }
    return found


@dataclasses.dataclass(frozen=True)
class TuningResult:
    """A tuning's outcome.

    Attributes:
        out: its directory.
        tuning: what was tuned.
        start: the given start as first evaluated (`nermo_mjx.optimize.tuning_directory.start_of`).
        best: content of best.json (`nermo_mjx.optimize.tuning_directory.best_of`).
        history: the history's table (`nermo_mjx.optimize.history`).
        state: after the last iteration.
        iterations_run: evaluations that this call made.
        pictures: figures and video that were made of it, and notes on what could not be made.
    """

    out: Path
    tuning: Tuning
    start: dict[str, Any]
    best: dict[str, Any]
    history: pa.Table
    state: TuneState
    iterations_run: int
    pictures: Pictures


def run_tuning(
    spec: Tuning | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    problem: Problem | None = None,
    simulator: SimulatorLike | None = None,
    watch: Watch = SILENT,
    accept_new_code: bool = False,
    workers: Workers | None = None,
) -> TuningResult:
    """Tune parameters by gradient, or by another method, into a directory, or resume what it contains.

    A tuning evaluates its starts `iterations` + 1 times, the last time where its last step led, or stops when nothing
    more is gained (`nermo_mjx.optimize.history`); every evaluation is one batch of starts x (1 + samples) worlds. After
    each, the state is stored: killing the process loses the iteration in flight, and the resumed tuning ends
    with the same numbers, bit for bit, on the same machine. The best point is verified on the engine `c`, from starts
    that the tuning has not seen (`nermo_mjx.optimize.tuning_run`).

    Args:
        spec: a `Tuning`, a dict with the fields of a tuning file, or the path of one.
        out: the directory; see `nermo_mjx.optimize.tuning_directory`.
        problem: replaces the simulation of the tuning (`nermo_mjx.optimize.problems.WalkProblem`).
        simulator: replaces `Simulator(tuning.setup, "c")`, which walks what pictures show: the landscape behind
            the paths, and the video; and start and best, from starts that the tuning has not seen
            (`nermo_mjx.optimize.tuning_run`). None of this happens if only `problem` is given.
        watch: is told the progress before the first evaluation and after each, what is drawn at the end, and what is
            moved aside.
        accept_new_code: resume a directory that other code started.
        workers: what evaluates the starts; by default this process, else `nermo_mjx.runs.ray_workers.RayWorkers`. With
            several workers numbers differ in their last digits from those of one.

    Raises:
        SpecError: the tuning is wrong; nothing has been written.
        DirectoryError: the directory holds something else, is in use, or cannot be read or written; `OtherCode` if
            other code, or other defaults, made what it holds.
        JobFailed: no robot walks to the end, or all workers are lost.
        Interrupted: Ctrl-C or SIGTERM; the same call resumes.
    """
    tuning = Tuning.of(spec)
    with (
        Directory(out, tuning, watch.warn) as directory,
        resumable(directory.out, f"tune {directory.out / TUNING}") as interruption,
    ):
        state, log = directory.restore(accept=accept_new_code)
        resumed = 0 if log is None else len(log)
        goes_on = not is_done(tuning, log)
        code = directory.take_code(log, accept=accept_new_code) if goes_on else ""
        total = tuning.iterations + 1
        watch.progress(Progress(min(resumed, total) / total, min(resumed, total), total, resumed))
        if goes_on:
            shared = SharedProblem(tuning, problem or simulation_of(tuning), workers or LocalWorkers())
            tuner = tuner_of(tuning, shared, log)
        directory.claim(log)
        tuning = directory.tuning
        if goes_on:
            directory.begin_session(resumed)
        while not is_done(tuning, log):
            began = time.perf_counter()
            state, found = tuner.step(state)
            if found.lost.all() and not np.isfinite(state.best_value).any():
                done = 0 if log is None else len(log)
                raise JobFailed(
                    f"{directory.out}: no world of iteration {done} walked to its end, nor did one before: choose "
                    "other starts or bounds."
                )
            before = empty_log(tuning, tuple(found.metrics)) if log is None else log
            log = before.extended(tuning, found, time.perf_counter() - began, code)
            with interruption.shielded():
                best = directory.keep(state, log)
            numbers: dict[str, float] = {}
            if np.isfinite(found.value).any():
                at = int(np.nanargmin(found.value))
                numbers = {name: float(column[at]) for name, column in found.metrics.items()}
                numbers["objective"] = float(found.value[at])
            if best is not None:
                numbers["simulated_seconds"] = best["simulated_seconds"]
            lowest, evaluated = None if best is None else best["objective"], min(len(log), total)
            watch.progress(Progress(evaluated / total, evaluated, total, resumed, best=lowest, numbers=numbers))
        assert log is not None
        best = directory.publish(log)
        if best is None:
            raise JobFailed(
                f"{directory.out}: the robot walked to the end at no point of this tuning: choose other starts or "
                "bounds."
            )
        start, history = start_of(tuning, log), history_table(tuning, log)
        notes = tuple[str, ...]()
        walker: Callable[[], SimulatorLike] | None = None  # nothing is simulated beside a given problem
        if simulator is not None or problem is None:
            walker = functools.cache(lambda: simulator or Simulator(tuning.setup, "c"))
        if walker is not None:
            watch.progress(Progress(0.0, what="engine c"))
            points = {"start": start["parameters"], "best": best["parameters"]}
            try:
                best |= {"verified": verified(tuning, points, walker())}
                directory.write("best.json", to_json(best))
            except ParameterError as error:
                notes = (f"Start and best are not verified: {error}",)
        pictures = make_pictures(directory, walker, watch, history, start, best)
        pictures = dataclasses.replace(pictures, notes=(*notes, *pictures.notes))
        return TuningResult(directory.out, tuning, start, best, history, state, len(log) - resumed, pictures)


def tuner_of(tuning: Tuning, problem: Problem, log: Log | None = None) -> Tuner:
    """What steps a tuning, after a history so far."""
    if not tuning.method.has_gradient:
        return GenerationTuner(tuning, problem, np.empty((0, tuning.starts)) if log is None else log.values(tuning))
    return (LineTuner if tuning.optimizer.searches else Tuner)(tuning, problem)


def simulation_of(tuning: Tuning) -> Problem:
    """The simulation of a tuning; raises `ParameterError` where its recording does not fit."""
    return WalkProblem(tuning) if tuning.method.engine == "mjx" else SimulatedProblem(tuning)


# ---
# What a tuning costs on this machine by each method, before it starts.


#: Worlds of the probe: enough to keep two cores busy.
_WORLDS: Final = 16
#: How much slower MJX runs on a CPU than MuJoCo C, with this many worlds or more, and with fewer in proportion
#: (docs/benchmarks: 14 simulated seconds per second, and 3.5 with one world, against 136).
MJX_SLOWER: Final = 10.0
MJX_WORLDS: Final = 4


@dataclasses.dataclass(frozen=True)
class MethodCost:
    """The cost of a tuning by one method.

    Attributes:
        method: its name.
        evaluations: walks; of the method `gradient` with their derivatives.
        simulated_seconds: of all walks, gradients at their cost in forward runs [s].
        wall_seconds: at this machine's speed, without compiling [s]; None if unknown, as for MJX on a GPU.
    """

    method: str
    evaluations: int
    simulated_seconds: float
    wall_seconds: float | None


def costs_of(tuning: Tuning) -> list[MethodCost]:
    """The cost of all iterations by each method, that of the tuning first; its estimator counts for the gradient.

    Raises:
        ParameterError: the tuning's recording cannot be compared with its walk.
    """
    seconds = tuning.seconds({each.name: each.low for each in tuning.tuned})
    if tuning.recording is not None:
        load_reference(tuning.recording, Rollout(tuning.setup, tuning.run), seconds)
    here = pace_here(tuning)
    methods = [tuning.method, *(each() for each in METHODS.values() if not isinstance(tuning.method, each))]
    return [_cost(dataclasses.replace(tuning, method=each), seconds, here) for each in methods]


def pace_here(tuning: Tuning) -> float:
    """Simulated seconds per second on the engine `c`, measured now."""
    return pace(Simulator(tuning.setup, "c"), tuning.setup, _WORLDS)


def _cost(tuning: Tuning, seconds: float, here: float) -> MethodCost:
    method, estimator, parameters = tuning.method, tuning.estimator, len(tuning.names)
    rounds, searches = tuning.iterations + 1, tuning.optimizer.searches
    tried = tuning.starts * rounds * (1 + tuning.optimizer.line_search().points) if searches else 0
    if not isinstance(method, Gradient):
        points = tuning.starts * rounds
        if isinstance(method, Generations):
            points = method.population * rounds
        elif isinstance(method, Differences):
            points = tried + points * (1 + method.neighbours(parameters))
        return MethodCost(method.name, points, points * seconds, points * seconds / here)
    # A sampled estimator of a line search leaves the point itself out.
    batch = tuning.starts * (estimator.samples or 1 if searches else estimator.worlds)
    points, times, slower = batch * rounds, 1.0, MJX_SLOWER * max(1.0, MJX_WORLDS / batch)
    if estimator.needs_gradient:
        times = cost(parameters, choose_mode(parameters, tuning.mode))
    elif searches:
        slower = 1.0
    wall = (points * times * slower + tried) * seconds / here if jax.default_backend() == "cpu" else None
    return MethodCost(method.name, points + tried, (points * times + tried) * seconds, wall)
