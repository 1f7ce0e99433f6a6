"""Candidates of an identification: walked in batches of one size, judged by the objective, the best remembered."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final, Protocol

import numpy as np

from nermo_mjx.experiments.identification.space import Free, parameters_of
from nermo_mjx.experiments.identification.targets import CASES, figures, objective
from nermo_mjx.rollout import Run, Simulator

_CYCLES: Final = 8.0


class Memory(Protocol):
    """Keeps what was simulated, so that a search that was killed goes on where it was."""

    def recall(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Speed and whether it was walked, (n, cases) each, of points (n, d) seen before; else None."""

    def keep(self, points: np.ndarray, speed: np.ndarray, walked: np.ndarray) -> None:
        """Remember the speeds of points."""


class Candidates:
    """Evaluates points of a space, and remembers all of them and the best.

    Args:
        simulator: of the walks; parameters outside the space keep its defaults.
        cases: parameters of `CASES`, (cases,) each.
        space: d free parameters, the axes of the unit cube.
        batch: candidates that are simulated together; one shape compiles once.
        memory: of what was simulated before.
        report: called after each batch.
    """

    def __init__(
        self,
        simulator: Simulator,
        cases: Mapping[str, np.ndarray],
        space: Mapping[str, Free],
        batch: int,
        memory: Memory | None,
        report: Callable[[], None],
    ) -> None:
        self.simulator, self.cases, self.space, self.batch = simulator, cases, space, batch
        self.memory, self.report = memory, report
        self.points: list[np.ndarray] = []
        self.costs: list[float] = []
        self.best, self.best_point = math.inf, np.full(len(space), 0.5)
        self.first_figures: dict[str, float] = {}
        self.best_figures: dict[str, float] = {}

    def evaluate(self, points: np.ndarray) -> np.ndarray:
        """Objective of points (n, d) of the unit cube, (n,); batches are as alike in size as they can be."""
        blocks = np.array_split(points, -(-len(points) // self.batch))
        return np.concatenate([self._evaluate(block) for block in blocks])

    def near(self, tolerance: float) -> np.ndarray:
        """Points within a tolerance of the objective, (k, d), in the order they were tried."""
        within = [point for point, cost in zip(self.points, self.costs, strict=True) if cost <= tolerance]
        return np.reshape(within, (len(within), len(self.space)))

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        # A batch that is not full is filled up with its own points.
        speed, walked = (each[: len(points)] for each in self._walk(np.resize(points, (self.batch, len(self.space)))))
        found = figures(speed)
        costs = objective(found, ~np.all(walked, axis=1))
        if not self.costs:
            self.first_figures = {name: float(column[0]) for name, column in found.items()}
        least = int(np.argmin(costs))
        if costs[least] < self.best:
            self.best, self.best_point = float(costs[least]), points[least]
            self.best_figures = {name: float(column[least]) for name, column in found.items()}
        self.points += list(points)
        self.costs += costs.tolist()
        self.report()
        return costs

    def _walk(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Speed in each case, and whether it was walked to the end, (n, cases) each."""
        known = None if self.memory is None else self.memory.recall(points)
        if known is not None:
            return known
        values = {name: np.tile(column, len(points)) for name, column in self.cases.items()}
        own = parameters_of(points, self.space)
        values |= {name: np.repeat(column, len(CASES)) for name, column in own.items()}
        result = self.simulator.run(values, Run(cycles=_CYCLES))
        speed, walked = (column.reshape(len(points), -1) for column in (result.metrics["speed"], result.status == "ok"))
        if self.memory is not None:
            self.memory.keep(points, speed, walked)
        return speed, walked
