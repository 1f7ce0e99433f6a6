"""CMA-ES as the steps of a tuning: an iteration is a generation, rebuilt from the history on resuming."""

from __future__ import annotations

import dataclasses
import math
import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np

from nermo_mjx.tune.objective import Problem, from_unconstrained, to_unconstrained
from nermo_mjx.tune.spec import Tuning
from nermo_mjx.tune.tuner import Iterate, TuneState


def strategy(start: np.ndarray, sigma: float, population: int, rng: np.random.Generator, **options: Any) -> Any:
    """Hansen's CMA-ES with its own random generator, since NumPy's global one is shared.

    Args:
        start: where it begins (p,).
        options: of `cma.CMAEvolutionStrategy`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import cma

    own = np.random.default_rng(rng.integers(2**63))
    common = {"popsize": max(population, 4), "randn": lambda *shape: own.standard_normal(shape), "seed": math.nan,
              "verbose": -9, "maxiter": math.inf}  # fmt: skip
    return cma.CMAEvolutionStrategy(start, sigma, common | options)


class GenerationTuner:
    """Steps a tuning by generations, as `tuner.Tuner` does by gradients.

    The points of the population replace the starts: the first point of the first generation is the given one.
    A point whose walk is not completed counts as worse than all others. Coordinates are those of
    `nermo_mjx.tune.objective`.
    """

    def __init__(self, tuning: Tuning, problem: Problem, values: np.ndarray) -> None:
        """
        Args:
            values: objectives of the generations so far (iterations, starts), which are replayed.
        """
        assert tuple(problem.names) == tuning.names, "a problem takes the tuned parameters in the order of the file"
        self.tuning, self.problem = tuning, problem
        given = jnp.array([each.start for each in tuning.tuned], float)
        self._given = np.asarray(to_unconstrained(tuning.bounds, given), float)
        rng = np.random.default_rng(tuning.seed)
        self._strategy = strategy(self._given, tuning.method.sigma, tuning.starts, rng)
        self._points, self._first = np.empty((0, len(tuning.names))), True
        for value in values:
            self._ask()
            self._tell(value)

    def step(self, state: TuneState) -> tuple[TuneState, Iterate]:
        """Evaluate a generation."""
        u = self._ask()
        points = from_unconstrained(self.tuning.bounds, jnp.asarray(u, state.u.dtype))
        found = self.problem.evaluate(points, False)
        ok = np.asarray(found.ok) & np.isfinite(np.asarray(found.value))
        value = np.where(ok, np.asarray(found.value, float), np.nan)
        self._tell(value)
        better = np.where(ok, value, np.inf) < np.asarray(state.best_value)
        after = dataclasses.replace(
            state,
            u=jnp.asarray(u, state.u.dtype),
            iteration=state.iteration + 1,
            best_u=jnp.where(jnp.asarray(better)[:, None], jnp.asarray(u, state.u.dtype), state.best_u),
            best_value=jnp.where(jnp.asarray(better), jnp.asarray(value, state.best_value.dtype), state.best_value),
            best_iteration=jnp.where(jnp.asarray(better), state.iteration, state.best_iteration),
        )
        nothing = np.full(u.shape, np.nan)
        return after, Iterate(
            points=np.asarray(points, float), value=value, ok=ok, gradient=nothing, error=nothing, first_order=nothing,
            discarded=(~ok).astype(int), lost=~ok,
            metrics={name: np.asarray(column, float) for name, column in found.metrics.items()},
            simulated_seconds=len(value) * self.problem.simulated_seconds,
        )  # fmt: skip

    def _ask(self) -> np.ndarray:
        self._points = np.array(self._strategy.ask())
        if self._first:
            self._points[0] = self._given
        self._first = False
        return self._points

    def _tell(self, value: np.ndarray) -> None:
        known = value[np.isfinite(value)]
        worst = known.max() + max(np.ptp(known), 1.0) if len(known) else 0.0
        self._strategy.tell(self._points.tolist(), np.where(np.isfinite(value), value, worst).tolist())
