"""Run a tuning: iterate from the latest checkpoint of its directory to the end, and write the results."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import jax
import numpy as np
import pyarrow as pa

from nermo_mjx.optimize.directory import BEST
from nermo_mjx.optimize.objective import TRAJECTORY_ERROR, Problem
from nermo_mjx.optimize.problems import SharedProblem, WalkProblem, load_reference
from nermo_mjx.optimize.tuner import Iterate, Tuner, TuneState
from nermo_mjx.optimize.tuning_directory import TUNING, TuningDirectory
from nermo_mjx.optimize.tuning_figures import make_figures
from nermo_mjx.optimize.tuning_history import TuningHistory
from nermo_mjx.optimize.tuning_spec import TUNING_METHODS, Tuning
from nermo_mjx.progress import shows_progress
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout import Simulator
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.rollout.run import START_SPREAD
from nermo_mjx.runs import session, stamp
from nermo_mjx.runs.files import to_json
from nermo_mjx.runs.job import SILENT, Forecast, JobFailed, Progress, Watch, resumable
from nermo_mjx.runs.workers import LocalWorkers, Workers
from nermo_mjx.sweep.simulating import SimulatorLike, pace

# ---
# A tuning iterates from the latest checkpoint of its directory to the end.


@dataclasses.dataclass(frozen=True)
class TuningResult:
    """The result of a tuning.

    Attributes:
        out: Directory of the tuning.
        tuning: Tuning that was run.
        start: First evaluation of the first start (`TuningHistory.start`).
        best: Content of best.json (`TuningHistory.best`).
        history: Table of the history (`nermo_mjx.optimize.tuning_directory`).
        state: State after the last iteration.
        iterations_run: Number of evaluations of this call.
        plots: Paths of the figures.
        notes: A sentence about each result that could not be made.
    """

    out: Path
    tuning: Tuning
    start: dict[str, Any]
    best: dict[str, Any]
    history: pa.Table
    state: TuneState
    iterations_run: int
    plots: tuple[Path, ...]
    notes: tuple[str, ...]


@shows_progress("tuning", "evaluations")
def run_tuning(
    spec: Tuning | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    problem: Problem | None = None,
    simulator: SimulatorLike | None = None,
    watch: Watch = SILENT,
    progress: bool = True,
    accept_new_code: bool = False,
    workers: Workers | None = None,
) -> TuningResult:
    """Tune parameters by gradient or finite differences into a directory, or resume what it contains.

    A tuning evaluates its starts `iterations` + 1 times, because the points after the last step are evaluated, too. It
    stops earlier if the iterations gain almost nothing (`TuningHistory.is_stalled`). Every evaluation is one batch. The
    state is stored after each evaluation, so that a killed process loses only the iteration in progress, and the resumed
    tuning has the same numbers, bit for bit, on the same machine. The best point is verified on the engine `c`, from
    initial states that are not part of the tuning (`verify_points`).

    Args:
        spec: A `Tuning`, a dict with the fields of a tuning file, or the path of a tuning file.
        out: Directory of the tuning; see `nermo_mjx.optimize.tuning_directory`.
        problem: Replaces the simulation of the tuning (`nermo_mjx.optimize.problems.WalkProblem`).
        simulator: Replaces `Simulator(tuning.setup, "c")`, which verifies the start and the best point, and simulates the
            landscape behind the paths. This step is skipped if only `problem` is given.
        watch: Receiver of the progress before the first evaluation and after each evaluation, of the figures at the end,
            and of messages about files that are moved aside.
        progress: Whether to show a progress bar in a terminal or notebook, if there is no watch.
        accept_new_code: Whether to resume a directory that other code started.
        workers: Workers that evaluate the starts, such as `nermo_mjx.runs.ray_workers.RayWorkers`; by default this
            process. The number of workers changes the last digits of the results.

    Raises:
        SpecError, DirectoryError, OtherCode, JobFailed, Interrupted: see "Errors of jobs" in docs/reference/python.md.
    """
    tuning = Tuning.of(spec)
    with (
        TuningDirectory(out, tuning, watch.warn) as directory,
        resumable(directory.out, f"tune {directory.out / TUNING}") as interruption,
    ):
        state, history = directory.restore(accept=accept_new_code)
        resumed, total = len(history), tuning.iterations + 1

        def report(best: float | None = None, numbers: Mapping[str, float] | None = None) -> None:
            done = min(len(history), total)
            watch.progress(
                Progress(done / total, done, total, resumed, best=best, numbers=numbers or {})
            )

        goes_on = not history.is_done
        if goes_on:
            made_by = stamp(tuning.setup.load().fingerprint, tuning.engine)
            directory.held.take_code(made_by, holds_rows=resumed > 0, accept=accept_new_code)
        report()
        if goes_on:
            shared = SharedProblem(
                tuning, problem or WalkProblem(tuning), workers or LocalWorkers()
            )
            tuner = Tuner(tuning, shared)
        directory.claim(history)
        if goes_on:
            directory.held.note_session(session(begun_at=resumed))
        while not history.is_done:
            began = time.perf_counter()
            state, iterate = tuner.step(state)
            if not iterate.ok.any() and not np.isfinite(state.best_value).any():
                raise JobFailed(
                    f"{directory.out}: no world of iteration {len(history)} walked to its end, nor did one before: "
                    "choose other starts or bounds."
                )
            history = history.extend(iterate, time.perf_counter() - began, made_by.id)
            with interruption.shielded():
                best = directory.keep(state, history)
            report(None if best is None else best["objective"], _numbers(iterate, best))
        walker: Callable[[], SimulatorLike] | None = (
            None  # a given problem replaces all simulations
        )
        if simulator is not None or problem is None:
            walker = functools.cache(lambda: simulator or Simulator(directory.tuning.setup, "c"))
        best, plots, notes = _publish(directory, history, walker, watch)
        start, table = history.start(), history.table()
        run = len(history) - resumed
        return TuningResult(
            directory.out, directory.tuning, start, best, table, state, run, plots, notes
        )


def _numbers(iterate: Iterate, best: Mapping[str, Any] | None) -> dict[str, float]:
    """Metrics of the best start of an iteration, and the simulated time so far, for its progress."""
    numbers: dict[str, float] = {}
    if np.isfinite(iterate.value).any():
        best_start = np.nanargmin(iterate.value)
        columns = iterate.metrics | {"objective": iterate.value}
        numbers = {name: float(column[best_start]) for name, column in columns.items()}
    return numbers | ({} if best is None else {"simulated_seconds": best["simulated_seconds"]})


def _publish(
    directory: TuningDirectory,
    history: TuningHistory,
    walker: Callable[[], SimulatorLike] | None,
    watch: Watch,
) -> tuple[dict[str, Any], tuple[Path, ...], tuple[str, ...]]:
    """Write the results of a complete history: the content of best.json, paths of the figures, and notes."""
    best, start, notes = directory.publish(history), history.start(), tuple[str, ...]()
    if best is None:
        raise JobFailed(
            f"{directory.out}: the robot walked to the end at no point of this tuning: choose other starts or bounds."
        )
    if walker is not None:
        watch.progress(Progress(0.0, what="engine c"))
        points = {"start": start["parameters"], "best": best["parameters"]}
        try:
            best |= {"verified": verify_points(directory.tuning, points, walker())}
            directory.held.write(BEST, to_json(best))
        except ParameterError as error:
            notes = (f"Start and best are not verified: {error}",)
    plots, extra_files = make_figures(directory, walker, watch, history.table(), best)
    return best, plots, (*notes, *extra_files)


#: Number of walks of each point in the verification.
WALKS: Final = 8
#: Key of the verification's initial states, which differs from all other keys of a tuning's seed.
_UNSEEN: Final = 0x5EED


def verify_points(
    tuning: Tuning, points: Mapping[str, Mapping[str, float]], simulator: SimulatorLike
) -> dict[str, Any]:
    """Simulate named points on the engine `c`, each from the same few slightly different initial states.

    The initial states have the spread of a sweep's repeats. A walk that is compared with a recording starts like the
    recording, and is simulated once.

    Args:
        points: Values of the tuned parameters of each point, by name.

    Returns:
        `engine`, `walks`, and for each point under its name `walks_ok`, the means `objective` and `metrics` over the
        completed walks, and their `lowest` and `highest` objective; None if no walk was completed.
    """
    compared = TRAJECTORY_ERROR in tuning.objective.metrics
    walks = 1 if compared else WALKS
    problem = WalkProblem(tuning, simulator=simulator)
    rng = np.random.default_rng([tuning.seed, _UNSEEN])
    names = {*tuning.constants, *tuning.names}
    spread = {
        name: rng.uniform(-width, width, walks)
        for name, width in START_SPREAD.items()
        if name in tuning.parameters and name not in names and not compared
    }
    repeated = np.repeat(
        [[point_values[name] for name in tuning.names] for point_values in points.values()],
        walks,
        axis=0,
    )
    value, metrics, ok = problem.walk(
        repeated, {name: np.tile(column, len(points)) for name, column in spread.items()}
    )
    verification: dict[str, Any] = {"engine": "c", "walks": walks}
    for i, name in enumerate(points):
        mine = i * walks + np.flatnonzero(ok[i * walks : (i + 1) * walks])
        verification[name] = None
        if len(mine):
            verification[name] = {
                "walks_ok": len(mine),
                "objective": float(value[mine].mean()),
                "lowest": float(value[mine].min()),
                "highest": float(value[mine].max()),
                "metrics": {
                    metric: float(metrics[metric][mine].mean())
                    for metric in tuning.objective.metrics
                },
            }
    return verification


# ---
# The cost of a tuning by each method on this machine, before it starts.


#: Number of worlds of the measurement; they keep two cores busy.
_PROBE_WORLDS: Final = 16
#: How much slower MJX runs on a CPU than MuJoCo C, with this many worlds or more, and with fewer in proportion
#: (docs/benchmarks: 14 simulated seconds per second, and 3.5 with one world, against 136).
MJX_SLOWER: Final = 10.0
MJX_WORLDS: Final = 4


def tuning_forecasts(tuning: Tuning) -> list[Forecast]:
    """Estimate the cost of all iterations by each method, starting with the tuning's method; `evaluations` are walks.

    Raises:
        ParameterError: The tuning's recording cannot be compared with its walk, or a library is missing.
    """
    seconds = tuning.seconds({parameter.name: parameter.low for parameter in tuning.tuned})
    if tuning.recording is not None:
        load_reference(tuning.recording, Rollout(tuning.setup, tuning.run), seconds)
    local_pace, forecasts = measure_pace(tuning), []
    others = (
        parameter()
        for parameter in TUNING_METHODS.values()
        if not isinstance(tuning.method, parameter)
    )
    for method in (tuning.method, *others):
        engine = method.engine_for(len(tuning.names))
        points = (tuning.iterations + 1) * tuning.starts
        walks = points * method.gradient_cost(len(tuning.names))
        wall = walks * seconds / local_pace
        if engine != "c":
            slower = MJX_SLOWER * max(1.0, MJX_WORLDS / tuning.starts)
            wall = wall * slower if jax.default_backend() == "cpu" else math.nan
        counts = {"evaluations": round(walks) if engine == "c" else points}
        rate = f"{local_pace:,.0f} simulated seconds/s on the engine c, measured now"
        forecasts.append(Forecast(engine, counts, walks * seconds, wall, rate, method=method.name))
    return forecasts


def measure_pace(tuning: Tuning) -> float:
    """Measure the simulated seconds per second on the engine `c`."""
    return pace(Simulator(tuning.setup, "c"), tuning.setup, _PROBE_WORLDS)
