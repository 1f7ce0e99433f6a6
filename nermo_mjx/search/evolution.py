"""CMA-ES with restarts, for one objective: Hansen's `cma`, from the best of a first spread of points."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from nermo_mjx.search.asking import Asked, Optimizer
from nermo_mjx.search.scoring import Scores, ranked_cost
from nermo_mjx.search.space import Space
from nermo_mjx.search.spec import Search
from nermo_mjx.tune.generations import strategy

#: First standard deviation, as a fraction of the bounds.
SIGMA: Final = 0.2
#: Size of the initial sample, in batches: with two, the better half of the bounds is known before the first step.
SPREAD: Final = 2
#: Standard deviation, as a fraction of the bounds, at which a search has converged: no robot is built more precisely.
CONVERGED: Final = 1e-3
#: Populations grow by this, at most so often.
GROWTH: Final = 2.0
MOST_GROWTH: Final = 9


class Evolution(Optimizer):
    """An `Optimizer`. The first batch is a sample; the first CMA-ES starts from its best point.

    When one has converged, the next begins at a random point: with twice the population (IPOP), or either with that
    or with a small one and a small step, depending on which has had fewer evaluations (BIPOP, Hansen 2009).
    """

    def __init__(self, space: Space, search: Search, batch: int) -> None:
        self._space, self._batch = space, batch
        self._sigma = float(search.options.get("sigma", SIGMA))
        self._restarts = str(search.options.get("restarts", "bipop"))
        self._rng = np.random.default_rng([search.sweep.seed, 1])
        self._strategy: Any = None
        self._points = np.empty((0, space.dimensions))
        self._worst, self._grown = 0.0, 0
        self._used = {"large": 0, "small": 0}
        self._regime = "large"

    def ask(self) -> Asked:
        if self._strategy is None:
            return Asked(self._space.spread(SPREAD * self._batch))
        self._points = np.array(self._strategy.ask())
        return Asked(self._space.shares(self._points))

    def tell(self, found: Scores) -> None:
        if found.allowed.any():
            self._worst = max(self._worst, float(found.cost[found.allowed, 0].max()))
        cost = ranked_cost(found, self._worst)
        if self._strategy is None:
            first = self._space.spread(SPREAD * self._batch)[int(np.argmin(cost))]
            self._begin(first, self._sigma, self._batch)
            return
        self._used[self._regime] += len(cost)
        self._strategy.tell(self._points.tolist(), cost.tolist())
        if self._restarts != "none" and self._strategy.stop():
            self._restart()

    def _restart(self) -> None:
        start = self._rng.random(self._space.dimensions)
        small = self._restarts == "bipop" and self._grown > 0 and self._used["small"] < self._used["large"]
        self._regime = "small" if small else "large"
        if small:
            grown = GROWTH**self._grown
            share = self._rng.random(2)
            population = self._batch * (0.5 * grown) ** (share[0] ** 2)
            self._begin(start, self._sigma * 10.0 ** (-2.0 * share[1]), int(population))
        else:
            self._grown = min(self._grown + 1, MOST_GROWTH)
            self._begin(start, self._sigma, int(self._batch * GROWTH**self._grown))

    def _begin(self, start: np.ndarray, sigma: float, population: int) -> None:
        self._strategy = strategy(start, sigma, population, self._rng, tolx=CONVERGED)
