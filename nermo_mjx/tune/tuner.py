"""One iteration of a tuning: place the worlds, evaluate them all in one batch, estimate gradients, step."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nermo_mjx.tune.bounds import Bounds, confine, from_unconstrained, slope
from nermo_mjx.tune.estimators import Estimate, estimate
from nermo_mjx.tune.evaluation import Problem
from nermo_mjx.tune.optimizer import Optimizer
from nermo_mjx.tune.sampling import Estimator, offsets, perturbations
from nermo_mjx.tune.spec import Tuning
from nermo_mjx.tune.state import TuneState


@dataclasses.dataclass(frozen=True)
class Iterate:
    """What an iteration found at the points it began with; numpy arrays, one entry per start.

    Attributes:
        points: parameters in their own units (starts, p).
        value: objective (starts,); NaN where the robot did not walk to the end.
        ok: whether it did (starts,).
        gradient, error, first_order: the estimate (starts, p) per unit of each parameter: with the chain rule's slope
            at the point, a smoothed gradient is one in u that is written per unit of x.
        discarded: worlds that were left out of the estimate (starts,).
        lost: whether there was nothing to estimate from (starts,).
        metrics: name -> (starts,).
        simulated_seconds: simulated time that the iteration took, gradients at their cost in forward runs [s].
    """

    points: np.ndarray
    value: np.ndarray
    ok: np.ndarray
    gradient: np.ndarray
    error: np.ndarray
    first_order: np.ndarray
    discarded: np.ndarray
    lost: np.ndarray
    metrics: dict[str, np.ndarray]
    simulated_seconds: float


class Tuner:
    """Steps a tuning on a problem; two small programs, which tunings share, run before and after its large one."""

    def __init__(self, tuning: Tuning, problem: Problem) -> None:
        assert tuple(problem.names) == tuning.names, "a problem takes the tuned parameters in the order of the file"
        self.tuning, self.problem, self.bounds = tuning, problem, tuning.bounds

    def step(self, state: TuneState) -> tuple[TuneState, Iterate]:
        """Evaluate the points of a state and take one step from them."""
        estimator, starts = self.tuning.estimator, len(state.u)
        points = placed(estimator, self.bounds, state)
        found = self.problem.evaluate(points, estimator.needs_gradient)
        after, est, ok, scale = _advanced(
            estimator, self.tuning.optimizer, self.bounds, state, found.value, found.gradient, found.ok
        )
        cost = self.problem.gradient_cost if estimator.needs_gradient else 1.0
        centres = np.arange(starts) * estimator.worlds
        value, well, dx = (np.asarray(each) for each in (found.value, ok, scale))
        return after, Iterate(
            points=np.asarray(points, float)[centres],
            value=np.where(well, value[centres], np.nan),
            ok=well,
            gradient=np.asarray(est.gradient, float) / dx,
            error=np.asarray(est.error, float) / dx,
            first_order=np.asarray(est.first_order, float),
            discarded=np.asarray(est.discarded),
            lost=np.asarray(est.lost),
            metrics={name: np.asarray(column, float)[centres] for name, column in found.metrics.items()},
            simulated_seconds=len(value) * self.problem.simulated_seconds * cost,
        )


def noise(estimator: Estimator, state: TuneState) -> Float[Array, "starts k p"]:
    """The perturbations e of an iteration."""
    return perturbations(estimator, state.key, state.iteration, *state.u.shape)


def coordinates(estimator: Estimator, state: TuneState) -> Float[Array, "starts worlds p"]:
    """All worlds of an iteration in coordinates u; the first of each start is its point."""
    return state.u[:, None] + offsets(estimator, noise(estimator, state))


@functools.partial(jax.jit, static_argnums=0)
def placed(estimator: Estimator, bounds: Bounds, state: TuneState) -> Float[Array, "n p"]:
    """Parameters of all worlds, start by start; the first of each start is its point."""
    return from_unconstrained(bounds, coordinates(estimator, state)).reshape(-1, state.u.shape[1])


@functools.partial(jax.jit, static_argnums=(0, 1))
def _advanced(
    estimator: Estimator,
    optimizer: Optimizer,
    bounds: Bounds,
    state: TuneState,
    value: Float[Array, " n"],
    gradient: Float[Array, "n p"] | None,
    ok: Bool[Array, " n"],
) -> tuple[TuneState, Estimate, Bool[Array, " starts"], Float[Array, "starts p"]]:
    """The state after the iteration, the gradient it stepped along (to u), whether each point is ok, and its dx/du.

    A start without a completed walk has no gradient: it moves halfway back to its best point, and
    its optimizer is not updated; an optimizer that uses values reacts by itself.
    """
    update, at = optimizer.build().update, coordinates(estimator, state)
    value, ok = value.reshape(at.shape[:2]), (ok & jnp.isfinite(value)).reshape(at.shape[:2])
    if gradient is not None:
        gradient = gradient.reshape(at.shape) * slope(bounds, at)
        ok = ok & jnp.isfinite(gradient).all(axis=-1)
    found = estimate(estimator, noise(estimator, state), value, gradient, ok)
    better = ok[:, 0] & (value[:, 0] < state.best_value)
    best_u = jnp.where(better[:, None], state.u, state.best_u)
    lost = found.lost
    # What a smoothed gradient is the gradient of: the mean over the worlds; of an exact one, the point itself.
    level = jnp.where(lost, jnp.inf, jnp.where(ok, value, 0.0).sum(axis=1) / jnp.maximum(ok.sum(axis=1), 1))
    step, updated = jax.vmap(lambda gradient, past, u, value: update(gradient, past, u, value=value))(
        found.gradient, state.optimizer, state.u, level
    )
    forward = confine(bounds, state.u + step)
    waits = lost & (not optimizer.reads_values)
    after = TuneState(
        u=jnp.where(waits[:, None], 0.5 * (state.u + best_u), forward),
        optimizer=jax.tree.map(lambda new, old: jnp.where(_like(waits, new), old, new), updated, state.optimizer),
        iteration=state.iteration + 1,
        key=state.key,
        best_u=best_u,
        best_value=jnp.where(better, value[:, 0], state.best_value),
        best_iteration=jnp.where(better, state.iteration, state.best_iteration),
    )
    return after, found, ok[:, 0], slope(bounds, state.u)


def _like(flags: Bool[Array, " starts"], leaf: Array) -> Bool[Array, " starts *1"]:
    """Flags with as many axes as a leaf."""
    return flags.reshape(-1, *[1] * (leaf.ndim - 1))
