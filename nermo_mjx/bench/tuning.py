"""Gradient tuning with a tenth of a dense sweep's simulated time, compared with CMA-ES on the same budget."""

from __future__ import annotations

import time
import warnings
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.rollout.length import Run
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.rollout.simulator import Simulator
from nermo_mjx.tune.bounds import from_unconstrained, to_unconstrained
from nermo_mjx.tune.problem import WalkProblem
from nermo_mjx.tune.spec import Tuning
from nermo_mjx.tune.state import initial_state
from nermo_mjx.tune.tuner import Tuner

#: Points of the dense sweep along amplitude and phase, and its share that a search may simulate.
GRID: Final = (21, 24)
BUDGET: Final = 0.1
#: Starts of a search: an almost stiff spine [rad], a quarter turn before and after the best phase [rad].
AMPLITUDE: Final = 0.05
ASIDE: Final = (np.pi / 2, -np.pi / 2)
#: Like `sweeps/tune_speed.yaml`, at any frequency.
OPTIMIZER: Final = {"name": "adam", "learning_rate": 0.5, "b1": 0.8, "b2": 0.9}
#: Initial standard deviation of CMA-ES in the same coordinates, the best of five between 0.25 and 2, and number of
#: seeds.
CMA_STEP: Final = 2.0
SEEDS: Final = 5


def tuning_case(frequency: float) -> dict[str, Any]:
    """Spine amplitude and phase for the speed of a trot: a dense sweep, then both searches from two starts.

    All reported speeds are from the C engine, over the same run of 6 gait cycles of which 2 are warm-up.

    Args:
        frequency: of the gait [Hz].
    """
    trot = Trot(frequency)
    dense = trot.dense()
    runs = int(BUDGET * dense["dense_runs"])
    case: dict[str, Any] = {**dense, "budget_runs": runs, "searches": []}
    for aside in ASIDE:
        phase = float((dense["dense_phase"] + aside + np.pi) % (2 * np.pi) - np.pi)
        start = (AMPLITUDE, phase)
        for search in [_by_gradient(trot, start, runs), *(_by_cma(trot, start, runs, seed) for seed in range(SEEDS))]:
            case["searches"].append(search | {"start_phase": phase, "share": search["speed"] / case["dense_speed"]})
    return case


class Trot:
    """The tuned walk, as a batch on the C engine and as a tuning."""

    def __init__(self, frequency: float) -> None:
        self.frequency, self.run = frequency, Run(cycles=6, warmup_cycles=2)
        self.simulator = Simulator(Setup(spine="stride_extension"), "c")

    def speeds(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Mean speed at amplitudes and phases [m/s]; 0 for a walk that ended in a fall."""
        values = {"spine.amplitude": points[:, 0], "spine.phase": points[:, 1]}
        result = self.simulator.run({"frequency": np.full(len(points), self.frequency), **values}, self.run)
        return np.where(result.status == "ok", result.metrics["speed"], 0.0)

    def dense(self) -> dict[str, Any]:
        """The best of a dense sweep of amplitude and phase, and its cost."""
        amplitudes, phases = np.linspace(0.0, 0.4, GRID[0]), np.linspace(-np.pi, np.pi, GRID[1], endpoint=False)
        points = np.stack(np.meshgrid(amplitudes, phases, indexing="ij"), axis=-1).reshape(-1, 2)
        began = time.perf_counter()
        speeds = self.speeds(points)
        best = points[speeds.argmax()]
        return {
            "frequency": self.frequency, "dense_runs": len(points), "dense_s": time.perf_counter() - began,
            "dense_speed": float(speeds.max()), "dense_amplitude": float(best[0]), "dense_phase": float(best[1]),
        }  # fmt: skip

    def tuning(self, start: tuple[float, float], iterations: int) -> Tuning:
        """The tuning from a start."""
        return Tuning.from_dict({
            "gait": "trt", "spine": "stride_extension", "run": {"cycles": 6, "warmup_cycles": 2},
            "set": {"frequency": self.frequency},
            "tune": {
                "spine.amplitude": {"bounds": [0.0, 0.4], "start": start[0]},
                "spine.phase": {"bounds": [-np.pi, np.pi], "start": start[1], "periodic": True},
            },
            "objective": [{"maximize": "speed", "scale": 0.1}], "optimizer": OPTIMIZER, "iterations": iterations,
        })  # fmt: skip


def _by_gradient(trot: Trot, start: tuple[float, float], runs: int) -> dict[str, Any]:
    """As many iterations as the budget allows, with gradients at their cost in runs; the best point is kept."""
    problem = WalkProblem(trot.tuning(start, 1))
    iterations = int(runs / problem.gradient_cost)
    tuning = trot.tuning(start, iterations)
    tuner, state = Tuner(tuning, problem), initial_state(tuning)
    began = time.perf_counter()
    for _ in range(iterations):
        state, _ = tuner.step(state)
    found = np.asarray(from_unconstrained(tuning.bounds, state.best_u))
    used = iterations * problem.gradient_cost
    return _search("gradient", found, trot, used, time.perf_counter() - began) | {"iterations": iterations}


def _by_cma(trot: Trot, start: tuple[float, float], runs: int, seed: int) -> dict[str, Any]:
    """CMA-ES (Hansen's `cma`) in the same coordinates, with its own population; the best sample is kept."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import cma

    bounds = trot.tuning(start, 1).bounds
    first = np.asarray(to_unconstrained(bounds, jnp.asarray([start])))[0]
    strategy = cma.CMAEvolutionStrategy(first, CMA_STEP, {"seed": seed + 1, "verbose": -9})
    best, speed, used = first, -np.inf, 0
    began = time.perf_counter()
    while used + strategy.popsize <= runs:
        samples = np.array(strategy.ask())
        speeds = trot.speeds(np.asarray(from_unconstrained(bounds, jnp.asarray(samples)), float))
        strategy.tell(samples.tolist(), (-speeds).tolist())
        used += len(samples)
        if speeds.max() > speed:
            best, speed = samples[speeds.argmax()], speeds.max()
    found = np.asarray(from_unconstrained(bounds, jnp.asarray(best[None])), float)
    return _search("cma-es", found, trot, used, time.perf_counter() - began) | {"seed": seed}


def _search(name: str, found: np.ndarray, trot: Trot, used: float, wall: float) -> dict[str, Any]:
    """A search's result, measured like the dense sweep."""
    amplitude, phase = map(float, found[0])
    return {
        "search": name, "amplitude": amplitude, "phase": phase, "speed": float(trot.speeds(found)[0]),
        "runs": used, "wall_s": wall,
    }  # fmt: skip
