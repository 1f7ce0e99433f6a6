"""NSGA-II with constraints, for several objectives: pymoo's, driven by ask and tell."""

from __future__ import annotations

import numpy as np

from nermo_mjx.search.asking import Asked, Optimizer
from nermo_mjx.search.scoring import Scores
from nermo_mjx.search.space import Space
from nermo_mjx.search.spec import Search

#: Violation of a point that fell: more than any other, so that every walk to the end is better.
_FALLEN = 1e9


class Genetic(Optimizer):
    """An `Optimizer`. Generations are as large as a batch; the first is a spread of points."""

    def __init__(self, space: Space, search: Search, batch: int) -> None:
        from pymoo.algorithms.moo.nsga2 import NSGA2
        from pymoo.config import Config
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination

        Config.warnings["not_compiled"] = False
        objectives = len(search.aim.objective.terms)
        problem = Problem(n_var=space.dimensions, n_obj=objectives, n_ieq_constr=1, xl=0.0, xu=1.0)
        self._algorithm = NSGA2(pop_size=batch, sampling=space.spread(batch))
        # Without an end of its own: the budget is the search's.
        self._algorithm.setup(problem, termination=NoTermination(), seed=search.sweep.seed, verbose=False)

    def ask(self) -> Asked:
        self._population = self._algorithm.ask()
        return Asked(np.clip(self._population.get("X").astype(float), 0.0, 1.0))

    def tell(self, found: Scores) -> None:
        self._population.set("F", np.where(found.ok[:, None], found.cost, 0.0))
        self._population.set("G", np.where(found.ok, found.violation, _FALLEN)[:, None])
        for individual in self._population:
            individual.evaluated.update(["F", "G"])
        self._algorithm.tell(infills=self._population)
