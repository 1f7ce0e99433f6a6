"""One iteration of a tuning by line search: a gradient from a few worlds, then walks along it without gradients."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nermo_mjx.tune.bounds import Bounds, confine, from_unconstrained, slope
from nermo_mjx.tune.estimators import Estimate, estimate
from nermo_mjx.tune.evaluation import Problem
from nermo_mjx.tune.line_search import LineSearch, LineState
from nermo_mjx.tune.sampling import Estimator
from nermo_mjx.tune.spec import Tuning
from nermo_mjx.tune.state import TuneState
from nermo_mjx.tune.tuner import Iterate, coordinates, noise, placed


class LineTuner:
    """Steps a tuning as `tuner.Tuner` does, to the best of the points that its line search tries.

    What counts is the objective without gradients: the engine `c` walks the point itself and those along the lines. A
    sampled estimator therefore needs no gradient at the point, which is left out of the batch of gradients.
    """

    def __init__(self, tuning: Tuning, problem: Problem) -> None:
        assert tuple(problem.names) == tuning.names, "a problem takes the tuned parameters in the order of the file"
        self.tuning, self.problem, self.bounds = tuning, problem, tuning.bounds
        self.search = tuning.optimizer.line_search()

    def step(self, state: TuneState) -> tuple[TuneState, Iterate]:
        """Estimate the gradients at the points of a state, and search along them."""
        estimator, (starts, p) = self.tuning.estimator, state.u.shape
        around = placed(estimator, self.bounds, state).reshape(starts, -1, p)[:, min(estimator.samples, 1) :]
        found = self.problem.evaluate(around.reshape(-1, p), estimator.needs_gradient)
        est, tried, points, line, scale = _directed(
            estimator, self.search, self.bounds, state, found.value, found.gradient, found.ok
        )
        walked = self.problem.evaluate(points.reshape(-1, p), False)
        after, well, left_out = _moved(self.search, state, line, tried, walked.value, walked.ok, found.ok)
        centres, dx = np.arange(starts) * tried.shape[1], np.asarray(scale)
        cost = self.problem.gradient_cost if estimator.needs_gradient else 1.0
        return after, Iterate(
            points=np.asarray(points, float)[:, 0],
            value=np.where(well, np.asarray(walked.value, float)[centres], np.nan),
            ok=np.asarray(well),
            gradient=np.asarray(est.gradient, float) / dx,
            error=np.asarray(est.error, float) / dx,
            first_order=np.asarray(est.first_order, float),
            discarded=np.asarray(left_out),
            lost=np.asarray(est.lost),
            metrics={name: np.asarray(column, float)[centres] for name, column in walked.metrics.items()},
            simulated_seconds=(len(found.value) * cost + len(walked.value)) * self.problem.simulated_seconds,
        )


@functools.partial(jax.jit, static_argnums=(0, 1))
def _directed(
    estimator: Estimator,
    search: LineSearch,
    bounds: Bounds,
    state: TuneState,
    value: Float[Array, " n"],
    gradient: Float[Array, "n p"] | None,
    ok: Bool[Array, " n"],
) -> tuple[
    Estimate, Float[Array, "starts tried p"], Float[Array, "starts tried p"], LineState, Float[Array, "starts p"]
]:
    """The gradients (to u), the points to be walked in u and in their own units, first the present one, the state of
    the search, and dx/du."""
    at = coordinates(estimator, state)
    missing = min(estimator.samples, 1)
    value, ok = (each.reshape(len(at), -1) for each in (value, ok & jnp.isfinite(value)))
    if gradient is not None:
        gradient = gradient.reshape(len(at), -1, at.shape[-1]) * slope(bounds, at[:, missing:])
        ok = ok & jnp.isfinite(gradient).all(axis=-1)
        gradient = jnp.pad(gradient, ((0, 0), (missing, 0), (0, 0)))
    if missing:  # the point itself is known from the search that led to it, but for the first one
        value = jnp.concatenate([state.best_value[:, None], value], axis=1)
        ok = jnp.concatenate([jnp.isfinite(state.best_value)[:, None], ok], axis=1)
    est = estimate(estimator, noise(estimator, state), value, gradient, ok)
    line, tried = jax.vmap(search.along)(state.optimizer, state.u, est.gradient)
    tried = jnp.concatenate([state.u[:, None], confine(bounds, tried)], axis=1)
    return est, tried, from_unconstrained(bounds, tried), line, slope(bounds, state.u)


@functools.partial(jax.jit, static_argnums=0)
def _moved(
    search: LineSearch,
    state: TuneState,
    line: LineState,
    tried: Float[Array, "starts tried p"],
    value: Float[Array, " n"],
    ok: Bool[Array, " n"],
    used: Bool[Array, " m"],
) -> tuple[TuneState, Bool[Array, " starts"], Array]:
    """The state at the best of the points, whether the present one is ok, and the worlds left out of its gradient."""
    value = jnp.where(ok & jnp.isfinite(value), value, jnp.inf).reshape(tried.shape[:2])
    chosen = value.argmin(axis=1)
    lowest = jnp.take_along_axis(value, chosen[:, None], axis=1)[:, 0]
    u = jnp.take_along_axis(tried, chosen[:, None, None], axis=1)[:, 0]
    better = lowest < state.best_value
    after = TuneState(
        u=u,
        optimizer=jax.vmap(search.taken)(line, chosen > 0, jnp.linalg.norm(u - state.u, axis=1)),
        iteration=state.iteration + 1,
        key=state.key,
        best_u=jnp.where(better[:, None], u, state.best_u),
        best_value=jnp.where(better, lowest, state.best_value).astype(state.best_value.dtype),
        best_iteration=jnp.where(better, state.iteration, state.best_iteration),
    )
    return after, jnp.isfinite(value[:, 0]), (~used).reshape(len(u), -1).sum(axis=1)
