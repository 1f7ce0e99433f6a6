"""Candidates of an identification: simulated in batches of one size and scored by the objective; the best is kept."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Final

import numpy as np

from nermo_mjx.experiments.identification.memory import CandidateFile
from nermo_mjx.experiments.identification.space import Free, parameters_of
from nermo_mjx.experiments.identification.targets import CASES, figures, objective
from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.runs.code import CodeStamp, stamp
from nermo_mjx.runs.workers import TaskFailed, Workers

#: The walk of the candidates.
WALKS: Final = Setup(pilot="straight", spine="stride_extension")
_CYCLES: Final = 8.0


@dataclasses.dataclass
class Walking:
    """Simulates batches of candidates on an engine; a `nermo_mjx.runs.workers.Computer`."""

    engine: str

    def warm(self) -> None:
        """Make the simulator; it compiles with the first batch."""
        self._simulator = Simulator(WALKS, engine=self.engine)

    def stamp(self) -> CodeStamp:
        """Stamp of the code, the model and the engine that simulate here."""
        return stamp(WALKS.load().fingerprint, self.engine)

    def __call__(
        self, values: Mapping[str, np.ndarray], progress: Callable[[float], None] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Speed of worlds with these parameters, and whether their walks were completed, (n,) each."""
        result = self._simulator.run(values, Run(cycles=_CYCLES))
        return result.metrics["speed"], np.asarray(result.status) == "ok"


class Candidates:
    """Evaluates points of a space, and records all of them and the best.

    Args:
        workers: that have started `Walking`; parameters outside the space keep their defaults.
        cases: parameters of `CASES`, (cases,) each.
        space: d free parameters, the axes of the unit cube.
        batch: number of candidates simulated together; one shape compiles once.
        memory: of earlier simulations.
        report: called after each batch.
    """

    def __init__(
        self,
        workers: Workers,
        cases: Mapping[str, np.ndarray],
        space: Mapping[str, Free],
        batch: int,
        memory: CandidateFile | None,
        report: Callable[[], None],
    ) -> None:
        self.workers, self.cases, self.space, self.batch = workers, cases, space, batch
        self.memory, self.report = memory, report
        self.points: list[np.ndarray] = []
        self.costs: list[float] = []
        self.best, self.best_point = math.inf, np.full(len(space), 0.5)
        self.first_figures: dict[str, float] = {}
        self.best_figures: dict[str, float] = {}

    def evaluate(self, points: np.ndarray) -> np.ndarray:
        """Objective of points (n, d) of the unit cube, (n,); in batches of as equal a size as possible.

        Raises:
            WorkersLost: no worker is left; finished walks are kept.
        """
        blocks = np.array_split(points, -(-len(points) // self.batch))
        walked = self._walk(blocks)
        return np.concatenate([self._judge(block, *walked[k]) for k, block in enumerate(blocks)])

    def near(self, tolerance: float) -> np.ndarray:
        """Points within a tolerance of the objective, (k, d), in the order they were tried."""
        within = [point for point, cost in zip(self.points, self.costs, strict=True) if cost <= tolerance]
        return np.reshape(within, (len(within), len(self.space)))

    def _judge(self, points: np.ndarray, speed: np.ndarray, walked: np.ndarray) -> np.ndarray:
        found = figures(speed[: len(points)])
        costs = objective(found, ~np.all(walked[: len(points)], axis=1))
        if not self.costs:
            self.first_figures = {name: float(column[0]) for name, column in found.items()}
        least = int(np.argmin(costs))
        if costs[least] < self.best:
            self.best, self.best_point = float(costs[least]), points[least]
            self.best_figures = {name: float(column[least]) for name, column in found.items()}
        self.points += list(points)
        self.costs += costs.tolist()
        return costs

    def _walk(self, blocks: list[np.ndarray]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """For each block, padded to a batch: speed in each case, and whether the walk was completed, (n, cases)."""
        # An incomplete batch is padded with its own points.
        batches = [np.resize(block, (self.batch, len(self.space))) for block in blocks]
        found = {}
        for k, points in enumerate(batches):
            if self.memory is not None and (known := self.memory.recall(points)) is not None:
                found[k] = known
                self.report()

        def tasks() -> Iterator[tuple[int, dict[str, np.ndarray]]]:
            for k in range(len(batches)):
                if k not in found:
                    yield k, self._values(batches[k])

        try:
            for k, columns in self.workers.results(tasks(), lambda key, share: None):
                speed, walked = (column.reshape(self.batch, -1) for column in columns)
                found[k] = speed, walked
                if self.memory is not None:
                    self.memory.keep(batches[k], speed, walked)
                self.report()
        except TaskFailed as failed:
            raise failed.error from None
        return found

    def _values(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Parameters of every case of every point, (n * cases,) each."""
        values = {name: np.tile(column, len(points)) for name, column in self.cases.items()}
        own = parameters_of(points, self.space)
        return values | {name: np.repeat(column, len(CASES)) for name, column in own.items()}
