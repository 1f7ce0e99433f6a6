"""Identification of what the publication does not give: contact, servo gains and damping.

The objective is made of the published speeds on the straight line alone, in the profile `exact`; orientation, turning,
balance and maze are then predictions. A figure's term is its deviation from what is published, in tolerances stated
beforehand: 10 % of a ratio, 2 % of an order. The objective is the root of their mean square. The search is a Sobol
sample, then CMA-ES (Hansen 2016) from its best point, both in the logarithms of the parameters and inside physical
bounds; a generation is one batch.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

import numpy as np
from scipy.stats import qmc

from nermo_mjx.experiments.cases import AMPLITUDE, Case, worlds
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Run, Setup, Simulator


@dataclasses.dataclass(frozen=True)
class Free:
    """A free parameter.

    Attributes:
        names: model parameters that share the value.
        low, high: physical bounds.
        why: where the bounds come from.
    """

    names: tuple[str, ...]
    low: float
    high: float
    why: str


FREE: Final[dict[str, Free]] = {
    "friction": Free(("contact.friction",), 0.7, 1.5, "rubber on a mat"),
    "time_constant": Free(
        ("contact.time_constant",), 0.005, 0.02, "2.5 time steps, above what the integrator resolves, to a soft sole"
    ),
    "damping_ratio": Free(("contact.damping_ratio",), 0.5, 2.0, "rubber hardly bounces, and does not creep"),
    "width": Free(("contact.width",), 0.0003, 0.002, "a seventh of the sole's radius to all of it"),
    "kp": Free(("servo.kp",), 4.5, 14.0, "stall torque at an error of 2 to 0.6 degrees"),
    "kv": Free(("servo.kv",), 0.01, 0.3, "stall torque at 16 to 0.5 rad/s"),
    "leg_damping": Free(
        ("damping.knee", "damping.ankle"), 0.002, 0.03, "printed hinges that creep back within a tenth of a second"
    ),
    "spine_damping": Free(("damping.spine",), 0.003, 0.1, "the same, ten times as stiff"),
}


#: Where the search starts: the values of an earlier prototype of this robot.
START: Final[dict[str, float]] = {
    "contact.friction": 1.0,
    "contact.time_constant": 0.006,
    "contact.damping_ratio": 1.0,
    "contact.width": 0.001,
    "servo.kp": 6.3,
    "servo.kv": 0.03,
    "damping.knee": 0.005,
    "damping.ankle": 0.005,
    "damping.spine": 0.01,
}


@dataclasses.dataclass(frozen=True)
class Target:
    """A published ratio of speeds: its value, or the least of it where only an order is published.

    Attributes:
        low, high: published interval; equal for a value.
        tolerance: deviation of the logarithm that counts as one.
    """

    low: float
    high: float
    tolerance: float

    def residual(self, value: np.ndarray) -> np.ndarray:
        """Deviation from the interval in tolerances, signed; NaN where there is none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.log(value)
        over = np.maximum(logarithm - math.log(self.high), 0.0) if math.isfinite(self.high) else 0.0
        return (over + np.minimum(logarithm - math.log(self.low), 0.0)) / self.tolerance


def _value(ratio: float) -> Target:
    return Target(ratio, ratio, 0.1)


#: An order: at least this ratio.
_ORDER: Final = Target(1.0, math.inf, 0.02)
#: Section 6.2.1 of the publication; the spine makes the trot faster by between 5 % and 22 %, the latter at 0.8 Hz.
TARGETS: Final[dict[str, Target]] = {
    "trt, 0.8 Hz, over theory": _value(0.9),
    "trt, 0.8 Hz, spine over none": _value(1.22),
    "trt, 0.5 Hz, spine over none": Target(1.05, 1.22, 0.1),
    "trt1, 0.8 Hz, spine over none": _ORDER,
    "trt1, 0.5 Hz, spine over none": _ORDER,
    "trt, 0.8 Hz, over lat": _value(1.27),
    "trt with spine, 0.8 Hz, over lat": _value(1.48),
    "trt, 0.8 Hz, over trt1": _ORDER,
    "trt, 0.5 Hz, over trt1": _ORDER,
    "trt1, 0.8 Hz, over lat": _ORDER,
    "trt1, 0.5 Hz, over lat": _ORDER,
}

_CASES: Final = tuple(
    Case(
        {"gait": gait, "frequency": frequency, "spine": spine},
        gait,
        values={"frequency": frequency, "spine.amplitude": AMPLITUDE * spine},
    )
    for frequency in (0.5, 0.8)
    for gait, spine in (("trt", False), ("trt", True), ("trt1", False), ("trt1", True), ("lat", False))
)
#: No-slip speed of the trot at 0.8 Hz (5.22) [m/s].
_THEORY: Final = 0.096
#: Objective of a candidate that falls, diverges, or walks backwards: worse than any that walks.
_FAILED: Final = 10.0
_CYCLES: Final = 8.0


@dataclasses.dataclass(frozen=True)
class Identified:
    """Result of an identification.

    Attributes:
        parameters: model parameter -> value.
        objective: at those; start: at `START`.
        figures, start_figures: target -> (value, residual in tolerances), at those and at `START`.
        costs: objective of every candidate in the order they were tried.
    """

    parameters: dict[str, float]
    objective: float
    start: float
    figures: dict[str, tuple[float, float]]
    start_figures: dict[str, tuple[float, float]]
    costs: tuple[float, ...]


class Memory(Protocol):
    """Keeps what was simulated, so that a search that was killed goes on where it was."""

    def recall(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Speed and whether it was walked, (n, cases) each, of points (n, n_free) seen before; else None."""

    def keep(self, points: np.ndarray, speed: np.ndarray, walked: np.ndarray) -> None:
        """Remember the speeds of points."""


def figures(speed: np.ndarray) -> dict[str, np.ndarray]:
    """The figures of `TARGETS` from speeds of shape (candidates, cases)."""

    def at(gait: str, frequency: float, spine: bool = False) -> np.ndarray:
        cases = [tuple(case.labels.values()) for case in _CASES]
        return np.asarray(speed[:, cases.index((gait, frequency, spine))])

    return {
        "trt, 0.8 Hz, over theory": at("trt", 0.8) / _THEORY,
        "trt, 0.8 Hz, spine over none": at("trt", 0.8, True) / at("trt", 0.8),
        "trt, 0.5 Hz, spine over none": at("trt", 0.5, True) / at("trt", 0.5),
        "trt1, 0.8 Hz, spine over none": at("trt1", 0.8, True) / at("trt1", 0.8),
        "trt1, 0.5 Hz, spine over none": at("trt1", 0.5, True) / at("trt1", 0.5),
        "trt, 0.8 Hz, over lat": at("trt", 0.8) / at("lat", 0.8),
        "trt with spine, 0.8 Hz, over lat": at("trt", 0.8, True) / at("lat", 0.8),
        "trt, 0.8 Hz, over trt1": at("trt", 0.8) / at("trt1", 0.8),
        "trt, 0.5 Hz, over trt1": at("trt", 0.5) / at("trt1", 0.5),
        "trt1, 0.8 Hz, over lat": at("trt1", 0.8) / at("lat", 0.8),
        "trt1, 0.5 Hz, over lat": at("trt1", 0.5) / at("lat", 0.5),
    }


def objective(found: Mapping[str, np.ndarray], failed: np.ndarray) -> np.ndarray:
    """Root of the mean squared residual of each candidate; `failed` ones, and what is not a number, count as 10."""
    squares = np.mean([TARGETS[name].residual(found[name]) ** 2 for name in TARGETS], axis=0)
    return np.where(failed | ~np.isfinite(squares), _FAILED, np.sqrt(squares))


def parameters_of(point: np.ndarray) -> dict[str, Any]:
    """Model parameters at points (..., n_free) of the unit cube, whose axes are the logarithms within the bounds."""
    values: dict[str, Any] = {}
    for axis, free in enumerate(FREE.values()):
        value = free.low * (free.high / free.low) ** np.clip(point[..., axis], 0.0, 1.0)
        values |= dict.fromkeys(free.names, value)
    return values


def point_of(parameters: Mapping[str, float]) -> np.ndarray:
    """Inverse of `parameters_of`, shape (n_free,)."""
    return np.array(
        [
            np.clip(math.log(parameters[free.names[0]] / free.low) / math.log(free.high / free.low), 0.0, 1.0)
            for free in FREE.values()
        ]
    )


def identify(
    *,
    engine: str = "auto",
    samples: int = 96,
    generations: int = 34,
    population: int = 12,
    seed: int = 0,
    memory: Memory | None = None,
    progress: Callable[[float], None] | None = None,
) -> Identified:
    """Search the parameters whose straight-line speeds come nearest to the published ones.

    Args:
        engine: of the simulations.
        samples: of the Sobol sequence.
        generations, population: of CMA-ES.
        seed: of both; the start of the walks is the same for all candidates.
        memory: of what was simulated before, which is not simulated again.
        progress: called with the share done.

    Raises:
        ParameterError: a number is too small.
    """
    import cma

    for name, number, least in (
        ("samples", samples, 1),
        ("generations", generations, 1),
        ("population", population, 4),
    ):
        if number < least:
            raise ParameterError(f"{name} is {number}: allowed is {least} or more.")
    simulator = Simulator(Setup(pilot="straight", spine="stride_extension"), engine=engine)
    cases = worlds(_CASES, simulator.setup.defaults(), profiles=("exact",), seed=seed).values
    search = _Search(simulator, cases, memory)
    start = point_of(START)
    design = qmc.Sobol(len(FREE), rng=seed).random_base2((samples - 1).bit_length())[:samples]
    blocks = np.array_split(np.vstack([start, design]), -(-(samples + 1) // population))
    for done, block in enumerate(blocks, start=1):
        search.evaluate(np.resize(block, (population, len(FREE))))
        if progress:
            progress(done / (len(blocks) + generations))

    options = {"bounds": [0.0, 1.0], "popsize": population, "seed": seed + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(search.best_point, 0.15, options)
    for done in range(len(blocks) + 1, len(blocks) + generations + 1):
        points = np.array(strategy.ask())
        strategy.tell(list(points), search.evaluate(points).tolist())
        if progress:
            progress(done / (len(blocks) + generations))
    return Identified(
        parameters={name: float(value) for name, value in parameters_of(search.best_point).items()},
        objective=search.best,
        start=search.costs[0],
        figures=_with_residuals(search.best_figures),
        start_figures=_with_residuals(search.first_figures),
        costs=tuple(search.costs),
    )


def _with_residuals(found: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    return {name: (value, float(TARGETS[name].residual(np.asarray(value)))) for name, value in found.items()}


class _Search:
    """Evaluates candidates, a batch at a time, and remembers the best."""

    def __init__(self, simulator: Simulator, cases: Mapping[str, np.ndarray], memory: Memory | None) -> None:
        self.simulator, self.cases, self.memory = simulator, cases, memory
        self.costs: list[float] = []
        self.best, self.best_point = math.inf, np.full(len(FREE), 0.5)
        self.first_figures: dict[str, float] = {}
        self.best_figures: dict[str, float] = {}

    def evaluate(self, points: np.ndarray) -> np.ndarray:
        """Objective of points (n, n_free) of the unit cube, (n,)."""
        speed, walked = self._walk(points)
        found = figures(speed)
        costs = objective(found, np.array([not all(row) for row in walked]))
        if not self.costs:
            self.first_figures = {name: float(column[0]) for name, column in found.items()}
        least = int(np.argmin(costs))
        if costs[least] < self.best:
            self.best, self.best_point = float(costs[least]), points[least]
            self.best_figures = {name: float(column[least]) for name, column in found.items()}
        self.costs += costs.tolist()
        return costs

    def _walk(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Speed in each case, and whether it was walked to the end, (n, cases) each."""
        known = None if self.memory is None else self.memory.recall(points)
        if known is not None:
            return known
        values = {name: np.tile(column, len(points)) for name, column in self.cases.items()}
        values |= {name: np.repeat(column, len(_CASES)) for name, column in parameters_of(points).items()}
        result = self.simulator.run(values, Run(cycles=_CYCLES))
        speed, walked = (column.reshape(len(points), -1) for column in (result.metrics["speed"], result.status == "ok"))
        if self.memory is not None:
            self.memory.keep(points, speed, walked)
        return speed, walked
