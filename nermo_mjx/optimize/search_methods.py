"""The methods of a search, which are asked for points (`ask`), and receive their results (`tell`).

A method (CMA-ES with restarts, NSGA-II, CMA-ME, a Sobol sequence) has the results as its only input, so that a search
is repeated, or resumed, by telling it the contents of its table again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import math
import warnings
from collections.abc import Iterator, Mapping
from typing import Any, Final, Protocol

import numpy as np
from scipy.stats import qmc

from nermo_mjx.optimize.search_spec import Aim, Cma, CmaMe, Nsga2, Search, SearchMethod, Sobol
from nermo_mjx.optimize.tuning_spec import is_turn
from nermo_mjx.robot.quantity import require
from nermo_mjx.sweep.counting import counts
from nermo_mjx.sweep.sampling import Axis


@dataclasses.dataclass(frozen=True)
class Request:
    """Points to evaluate.

    Attributes:
        points: Fractions of the bounds in [0, 1] (n, p).
    """

    points: Any


# ---
# Coordinates of a search: fractions of the bounds that may take any value, so that every step is within the bounds.
#
# A bounded parameter is reflected at its bounds: a coordinate of 1.1 is the share 0.9. A periodic parameter, whose
# bounds are a whole turn apart, wraps around: 1.1 is 0.1.


class Space:
    """The p coordinates of a search.

    Attributes:
        periodic: Whether each parameter is periodic (p,).
        published_shares: Shares of the published gait (p,), moved to the bounds if it is outside.
    """

    def __init__(self, search: Search) -> None:
        axes, defaults = search.sweep.axes, search.sweep.parameters
        self.dimensions = len(axes)
        self.periodic = np.array([is_turn(axis.name, *axis.numbers[:2]) for axis in axes])
        self.published_shares = np.array(
            [_share(axis, float(np.asarray(defaults[axis.name].default))) for axis in axes]
        )
        self._seed = search.sweep.seed

    def shares(self, coordinates: np.ndarray) -> np.ndarray:
        """Shares of the bounds (n, p), in [0, 1], at any coordinates (n, p)."""
        turned = coordinates - np.floor(coordinates)
        reflected = 1.0 - np.abs(1.0 - np.mod(coordinates, 2.0))
        return np.clip(np.where(self.periodic, turned, reflected), 0.0, 1.0)

    def initial_shares(self, count: int) -> np.ndarray:
        """Initial shares (count, p): the published gait, then points of a scrambled Sobol sequence."""
        points = qmc.Sobol(self.dimensions, rng=np.random.default_rng(self._seed))
        return np.concatenate(
            [self.published_shares[None], points.random_base2(max(count - 1, 1).bit_length())]
        )[:count]


def _share(axis: Axis, value: float) -> float:
    """The share of a value between the bounds, clipped to [0, 1]."""
    low, high = axis.numbers[:2]
    value = min(max(value, low), high)
    if axis.form.startswith("log"):
        return float(np.log(value / low) / np.log(high / low))
    return (value - low) / (high - low)


# ---
# Scores of points from the runs of a batch: costs, measures, and violations of constraints.


@dataclasses.dataclass(frozen=True)
class Scores:
    """Results of n points.

    Attributes:
        cost: Cost of each objective (n, k); less is better, and NaN means that a run failed.
        measures: Measures of an atlas (n, m); NaN means that a run failed.
        violation: Sum of the violations of all constraints (n,), each in units of its bound; 0 if all are satisfied.
        ok: Whether all runs walked to the end with finite numbers (n,).
    """

    cost: np.ndarray
    measures: np.ndarray
    violation: np.ndarray
    ok: np.ndarray

    def __len__(self) -> int:
        return len(self.ok)

    @property
    def is_allowed(self) -> np.ndarray:
        """Whether each point walked to the end and satisfies the constraints (n,)."""
        return self.ok & (self.violation == 0.0)

    @property
    def quality(self) -> np.ndarray:
        """The negative cost of a single objective (n,); more is better."""
        return -self.cost[:, 0]


def score_points(
    aim: Aim, repeats: int, metrics: Mapping[str, np.ndarray], well: np.ndarray
) -> Scores:
    """The scores of points; the repeats of a point are consecutive runs.

    The score of a metric is its mean over the repeats. A point with a failed run has NaN scores.

    Args:
        metrics: Metrics (n * repeats,) by name, at least the metrics of the aim.
        well: Whether each run succeeded (n * repeats,).
    """
    means = {
        name: np.asarray(metrics[name], float).reshape(-1, repeats).mean(axis=1)
        for name in aim.metrics
    }
    good = [
        counts(name, np.asarray(metrics[name], float), np.asarray(well, bool))
        for name in aim.metrics
    ]
    ok: np.ndarray = np.logical_and.reduce(good).reshape(-1, repeats).all(axis=1)
    terms = [np.asarray(term.value(means[term.metric]), float) for term in aim.objective.terms]
    cost = np.stack(terms, axis=1) if aim.pareto else np.sum(terms, axis=0)[:, None]
    measures = np.empty((len(ok), len(aim.measures)))
    for i, measure in enumerate(aim.measures):
        measures[:, i] = means[measure.metric]
    violation = np.zeros(len(ok))
    for limit in aim.limits:
        value = means[limit.metric]
        unit = max(abs(b) for b in (limit.low, limit.high) if np.isfinite(b)) or 1.0
        violation += (
            np.maximum(value - limit.high, 0.0) / unit + np.maximum(limit.low - value, 0.0) / unit
        )
    ok &= np.isfinite(cost).all(axis=1) & np.isfinite(measures).all(axis=1) & np.isfinite(violation)
    lost = ~ok
    cost[lost], measures[lost], violation[lost] = np.nan, np.nan, np.nan
    return Scores(cost, measures, violation, ok)


def ranked_cost(scores: Scores, worst: float) -> np.ndarray:
    """One finite cost per point (n,) that ranks allowed points first, then violations by their size, then falls.

    Args:
        worst: Highest cost of an allowed point so far, or any finite number before the first one.
    """
    cost = np.where(
        scores.is_allowed, scores.cost[:, 0], worst + 1.0 + np.nan_to_num(scores.violation)
    )
    fallen = worst + 2.0 + np.nanmax(np.append(scores.violation, 0.0))
    return np.where(scores.ok, cost, fallen)


def find_cells(aim: Aim, measures: np.ndarray) -> np.ndarray:
    """The cell of each point of an atlas (n,), with the last measure fastest; -1 outside of the ranges or for NaN.

    Args:
        measures: Measures of the points (n, m).
    """
    cell, inside = np.zeros(len(measures), int), np.isfinite(measures).all(axis=1)
    for values, measure in zip(
        np.where(inside[:, None], measures, 0.0).T, aim.measures, strict=True
    ):
        inside &= (values >= measure.low) & (values <= measure.high)
        cell_index = np.floor((values - measure.low) / (measure.high - measure.low) * measure.cells)
        cell = cell * measure.cells + np.clip(cell_index, 0, measure.cells - 1).astype(int)
    return np.where(inside, cell, -1)


def find_elites(aim: Aim, scores: Scores) -> tuple[np.ndarray, np.ndarray]:
    """The filled cells in order (k,), and the best allowed point of each (k,), the first one of equal points."""
    cell = np.where(scores.is_allowed, find_cells(aim, scores.measures), -1)
    order = np.lexsort((np.arange(len(cell)), -scores.quality, cell))
    order = order[cell[order] >= 0]
    cells, first = np.unique(cell[order], return_index=True)
    return cells, order[first]


# ---
# CMA-ES with restarts, for one objective of a search.


def make_strategy(
    start: np.ndarray, sigma: float, population: int, rng: np.random.Generator, **options: Any
) -> Any:
    """Make a CMA-ES by Hansen's library, with its own random generator, because NumPy's global generator is shared.

    Args:
        start: Initial mean (p,).
        options: Options of `cma.CMAEvolutionStrategy`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import cma

    generator = np.random.default_rng(rng.integers(2**63))
    common = {
        "popsize": max(population, 4),
        "randn": lambda *shape: generator.standard_normal(shape),
        "seed": math.nan,
        "verbose": -9,
        "maxiter": math.inf,
    }
    return cma.CMAEvolutionStrategy(start, sigma, common | options)


class Searcher(Protocol):
    """A method of a search. `ask` and `tell` alternate, and the same results lead to the same requests."""

    def ask(self) -> Request:
        """Request the next batch of points."""
        ...

    def tell(self, scores: Scores) -> None:
        """Receive the results of the batch, in the order of its points."""
        ...


#: Size of the initial sample in batches. Two batches are enough to find the better half of the bounds.
SPREAD: Final = 2
#: Standard deviation of a converged search, as a fraction of the bounds; a robot cannot be built more precisely.
CONVERGED: Final = 1e-3
#: Factor by which populations grow, and the maximum number of times.
GROWTH: Final = 2.0
MOST_GROWTH: Final = 9


class RestartedCma(Searcher):
    """CMA-ES with restarts. The first batch is a sample; the first CMA-ES starts from its best point.

    When a CMA-ES has converged, the next one begins at a random point. With IPOP it has twice the population. With BIPOP
    (Hansen 2009) it has either a large population, or a small one with a small step, whichever had fewer evaluations.
    """

    def __init__(self, space: Space, search: Search, batch: int) -> None:
        assert isinstance(search.method, Cma)
        self._space, self._batch, self._method = space, batch, search.method
        self._rng = np.random.default_rng([search.sweep.seed, 1])
        self._strategy: Any = None
        self._points = np.empty((0, space.dimensions))
        self._worst, self._grown = 0.0, 0
        self._used = {"large": 0, "small": 0}
        self._regime = "large"

    def ask(self) -> Request:
        if self._strategy is None:
            return Request(self._space.initial_shares(SPREAD * self._batch))
        self._points = np.array(self._strategy.ask())
        return Request(self._space.shares(self._points))

    def tell(self, scores: Scores) -> None:
        if scores.is_allowed.any():
            self._worst = max(self._worst, float(scores.cost[scores.is_allowed, 0].max()))
        cost = ranked_cost(scores, self._worst)
        if self._strategy is None:
            first = self._space.initial_shares(SPREAD * self._batch)[int(np.argmin(cost))]
            self._begin(first, self._method.sigma, self._batch)
            return
        self._used[self._regime] += len(cost)
        self._strategy.tell(self._points.tolist(), cost.tolist())
        if self._method.restarts == "none" or not self._strategy.stop():
            return
        start = self._rng.random(self._space.dimensions)
        small = (
            self._method.restarts == "bipop"
            and self._grown > 0
            and self._used["small"] < self._used["large"]
        )
        self._regime = "small" if small else "large"
        if small:
            grown = GROWTH**self._grown
            share = self._rng.random(2)
            population = self._batch * (0.5 * grown) ** (share[0] ** 2)
            self._begin(start, self._method.sigma * 10.0 ** (-2.0 * share[1]), int(population))
        else:
            self._grown = min(self._grown + 1, MOST_GROWTH)
            self._begin(start, self._method.sigma, int(self._batch * GROWTH**self._grown))

    def _begin(self, start: np.ndarray, sigma: float, population: int) -> None:
        self._strategy = make_strategy(start, sigma, population, self._rng, tolx=CONVERGED)


# ---
# NSGA-II with constraints, for several objectives, by the library pymoo.


#: Violation of a point that fell; it is larger than any other violation, so that every complete walk is better.
_FALLEN = 1e9


class GeneticSearch(Searcher):
    """NSGA-II. A generation is a batch; the first one consists of `Space.initial_shares`."""

    def __init__(self, space: Space, search: Search, batch: int) -> None:
        from pymoo.algorithms.moo.nsga2 import NSGA2
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination

        objectives = len(search.aim.objective.terms)
        problem = Problem(n_var=space.dimensions, n_obj=objectives, n_ieq_constr=1, xl=0.0, xu=1.0)
        self._algorithm = NSGA2(pop_size=batch, sampling=space.initial_shares(batch))
        # The algorithm has no termination, because the search has a budget.
        self._algorithm.setup(
            problem, termination=NoTermination(), seed=search.sweep.seed, verbose=False
        )

    def ask(self) -> Request:
        self._population = self._algorithm.ask()
        return Request(np.clip(self._population.get("X").astype(float), 0.0, 1.0))

    def tell(self, scores: Scores) -> None:
        self._population.set("F", np.where(scores.ok[:, None], scores.cost, 0.0))
        self._population.set("G", np.where(scores.ok, scores.violation, _FALLEN)[:, None])
        for individual in self._population:
            individual.evaluated.update(["F", "G"])
        self._algorithm.tell(infills=self._population)


# ---
# CMA-ME, for an atlas, by the library pyribs, whose emitters search for cells that are empty or can be improved.


#: Value of a point outside of the atlas for an emitter.
_WORTHLESS: Final = -1e9


class AtlasEmitters(Searcher):
    """CMA-ME. The first batch consists of `Space.initial_shares`; later batches are divided among emitters.

    Points that are outside of the measures' ranges, fell, or violate a constraint are not in the atlas.
    """

    def __init__(self, space: Space, search: Search, batch: int) -> None:
        with _import_without_numba():
            from ribs.archives import GridArchive

        assert isinstance(search.method, CmaMe)
        self._space = space
        self._aim = search.aim
        self._seed = search.sweep.seed
        self._batch = batch
        self._method, self._count = search.method, max(1, min(search.method.emitters, batch // 2))
        self._archive = GridArchive(
            solution_dim=space.dimensions,
            dims=[measure.cells for measure in search.aim.measures],
            ranges=[(measure.low, measure.high) for measure in search.aim.measures],
            seed=search.sweep.seed,
        )
        self._emitters: list[Any] = []
        self._spreads = 0
        self._shares = np.empty((0, space.dimensions))

    def ask(self) -> Request:
        if not self._emitters:
            first = self._spreads * self._batch
            self._spreads += 1
            self._shares = self._space.initial_shares(first + self._batch)[first:]
            return Request(self._shares)
        points = [emitter.ask() for emitter in self._emitters]
        self._batch_ends = np.cumsum([len(points_of_emitter) for points_of_emitter in points])
        self._shares = self._space.shares(np.concatenate(points))
        return Request(self._shares)

    def tell(self, scores: Scores) -> None:
        inside = scores.is_allowed & (find_cells(self._aim, scores.measures) >= 0)
        status, value = np.zeros(len(inside), np.int32), np.full(len(inside), _WORTHLESS)
        objective = np.where(inside, scores.quality, _WORTHLESS)
        measures = np.where(np.isfinite(scores.measures), scores.measures, 0.0)
        if inside.any():
            info = self._archive.add(self._shares[inside], objective[inside], measures[inside])
            status[inside], value[inside] = info["status"], info["value"]
        if not self._emitters:
            if len(self._archive):
                self._begin()
            return
        parts = np.split(np.arange(len(inside)), self._batch_ends[:-1])
        for emitter, part in zip(self._emitters, parts, strict=True):
            info = {"status": status[part], "value": value[part]}
            emitter.tell(self._shares[part], objective[part], measures[part], info)

    def _begin(self) -> None:
        """Make emitters that start from elites, which are evenly spaced among the filled cells."""
        with _import_without_numba():
            from ribs.emitters import EvolutionStrategyEmitter

        elites = self._archive.data(["solution", "index"], return_type="dict")
        order = np.argsort(elites["index"])
        selected = order[np.linspace(0, len(order) - 1, self._count).round().astype(int)]
        sizes = [len(part) for part in np.array_split(np.arange(self._batch), self._count)]
        for i, (start, size) in enumerate(zip(elites["solution"][selected], sizes, strict=True)):
            common: dict[str, Any] = {
                "x0": start,
                "sigma0": self._method.sigma,
                "batch_size": size,
                "ranker": "2imp",
            }
            common["seed"] = self._seed + i + 1
            self._emitters.append(EvolutionStrategyEmitter(self._archive, **common))


@contextlib.contextmanager
def _import_without_numba() -> Iterator[None]:
    """Import pyribs without compiled functions: they save microseconds per batch but take ten seconds to compile."""
    import numba

    config: Any = numba.config
    before, config.DISABLE_JIT = config.DISABLE_JIT, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        config.DISABLE_JIT = before


class SobolSample(Searcher):
    """Points of one Sobol sequence, starting with the published gait: the baseline for all methods."""

    def __init__(self, space: Space, search: Search, batch: int) -> None:
        self._batch, self._first = batch, space.published_shares
        self._points = qmc.Sobol(space.dimensions, rng=np.random.default_rng(search.sweep.seed))
        self._begun = False

    def ask(self) -> Request:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # one point less than a power of two, because the published gait replaces it
            if self._begun:
                return Request(self._points.random(self._batch))
            self._begun = True
            return Request(
                np.concatenate([self._first[None], self._points.random(self._batch - 1)])
            )

    def tell(self, scores: Scores) -> None:
        """Ignore the results, because the points do not depend on them."""


def searcher(search: Search, batch: int) -> Searcher:
    """The method of a search, before its first batch.

    Args:
        batch: Number of points of a batch; some methods change it during the search.

    Raises:
        ParameterError: The library of the method is not installed.
    """
    check_library(search.method)
    kinds: dict[type[SearchMethod], Any] = {
        Cma: RestartedCma,
        Nsga2: GeneticSearch,
        CmaMe: AtlasEmitters,
        Sobol: SobolSample,
    }
    instance: Searcher = kinds[type(search.method)](Space(search), search, batch)
    return instance


def check_library(method: SearchMethod) -> None:
    """Raise `ParameterError` if the library of a method is not installed."""
    require(
        f"method is {method.name}, which",
        method.library,
        "cma" if method.library == "cma" else "search",
    )


def library_version(method: SearchMethod) -> str:
    """Name and version of the library that chooses the points, for the table's metadata."""
    return f"{method.library} {importlib.metadata.version(method.library)}"
