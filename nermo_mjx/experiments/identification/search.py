"""Identification of parameters that the publication does not give: servo gain and damping, and joint damping.

The objective uses only the published speeds on the straight line, in the profile `exact`; orientation, turning,
balance and maze are then predictions. A figure's term is its deviation from the published value, in tolerances stated
beforehand: 10 % of a ratio, 2 % of an order. The objective is the root of their mean square. The search is a Sobol
sample, then CMA-ES (Hansen 2016) from its best point, both in the logarithms of the parameters and inside physical
bounds; a generation is one batch. It is followed by an ensemble of all bodies within the tolerance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
from scipy.stats import qmc

from nermo_mjx.experiments.cases import worlds
from nermo_mjx.experiments.identification.candidates import WALKS, Candidates, Walking
from nermo_mjx.experiments.identification.ensemble import TOLERANCE, Bodies, find_bodies
from nermo_mjx.experiments.identification.memory import CandidateFile
from nermo_mjx.experiments.identification.space import ALL, FREE, START, parameters_of, point_of
from nermo_mjx.experiments.identification.targets import CASES, TARGETS
from nermo_mjx.experiments.settings import Settings
from nermo_mjx.physics.making import resolve_engine
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.workers import LocalWorkers, Workers


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
    bodies: Bodies | None = None


@dataclasses.dataclass(frozen=True)
class Search:
    """Extent of the search.

    Attributes:
        samples: of the Sobol sequence.
        generations, population: of CMA-ES; as many candidates as a population are simulated together throughout.
        bodies: size of the ensemble, including the best one; 0 to omit it.
        sweeps: maximum number for the ensemble; each tries as many candidates as bodies are requested.
        tolerance: maximum objective of a body in the ensemble.
        seed: of all three; the start of the walks is the same for all candidates.

    Raises:
        ParameterError: a number is too small.
    """

    samples: int = 64
    generations: int = 25
    population: int = 12
    bodies: int = 256
    sweeps: int = 5
    tolerance: float = TOLERANCE
    seed: int = 0

    def __post_init__(self) -> None:
        least = {"samples": 1, "generations": 1, "population": 4, "sweeps": 1, "bodies": 8 if self.bodies else 0}
        for name, number in least.items():
            if getattr(self, name) < number:
                raise ParameterError(f"{name} is {getattr(self, name)}: allowed is {number} or more.")
        if not self.tolerance > 0:
            raise ParameterError(f"tolerance is {self.tolerance:g}: allowed is more than 0.")


def identify(
    wanted: Search,
    engine: str = "auto",
    memory: CandidateFile | None = None,
    progress: Callable[[float], None] | None = None,
    workers: Workers | None = None,
) -> Identified:
    """Find the parameters whose straight-line speeds match the published ones best, then all within the tolerance.

    Args:
        engine: of the simulations.
        memory: of earlier simulations, which are not repeated.
        progress: called with the share done.
        workers: what simulates; by default this process. The numbers are the same: a task is a batch, and results are
            processed in the order of the batches.

    Raises:
        WorkersLost: no worker is left.
    """
    import cma

    population, bodies, seed = wanted.population, wanted.bodies, wanted.seed
    workers, defaults = workers or LocalWorkers(), WALKS.defaults()
    workers.begin(Walking(resolve_engine(engine)))
    cases = worlds(CASES, defaults, Settings(("exact",), repeats=1, seed=seed)).values
    first, swept = -(-(wanted.samples + 1) // population), (wanted.sweeps + 1) * -(-bodies // population)
    batches = first + wanted.generations + swept
    done = 0

    def report() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done / batches)

    search = Candidates(workers, cases, FREE, population, memory, report)
    design = qmc.Sobol(len(FREE), rng=seed).random_base2((wanted.samples - 1).bit_length())[: wanted.samples]
    search.evaluate(np.vstack([point_of(START), design]))
    options = {"bounds": [0.0, 1.0], "popsize": population, "seed": seed + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(search.best_point, 0.15, options)
    for _ in range(wanted.generations):
        points = np.array(strategy.ask())
        strategy.tell(list(points), search.evaluate(points).tolist())
    best = {name: float(value) for name, value in parameters_of(search.best_point).items()}
    ensemble = None
    if bodies:
        wide = Candidates(workers, cases, ALL, population, memory, report)
        ensemble = find_bodies(wide, best, search.best, search.near(wanted.tolerance), defaults=defaults,
                               bodies=bodies, sweeps=wanted.sweeps, tolerance=wanted.tolerance, seed=seed)  # fmt: skip
    if progress:
        progress(1.0)
    return Identified(
        parameters=best,
        objective=search.best,
        start=search.costs[0],
        figures=_with_residuals(search.best_figures),
        start_figures=_with_residuals(search.first_figures),
        costs=tuple(search.costs),
        bodies=ensemble,
    )


def _with_residuals(found: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    return {name: (value, float(TARGETS[name].residual(np.asarray(value)))) for name, value in found.items()}
