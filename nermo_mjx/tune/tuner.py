"""One iteration of a tuning: place the worlds, evaluate them all in one batch, estimate gradients, step."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from nermo_mjx.tune.estimators import Estimate, Estimator, estimate, offsets, perturbations
from nermo_mjx.tune.objective import Bounds, Problem, confine, from_unconstrained, slope, to_unconstrained
from nermo_mjx.tune.optimizer import LineSearch, LineState, Optimizer
from nermo_mjx.tune.spec import Tuning

# ---
# State of a tuning: everything that its next iteration depends on, as one pytree of arrays.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TuneState:
    """A tuning of p parameters from several starts, before an iteration.

    Attributes:
        u: points in unbounded coordinates (starts, p), see `nermo_mjx.tune.objective`.
        optimizer: state of the optimizer, every leaf with a leading axis of starts.
        iteration: iterations done.
        key: data of the random key (2,); an iteration's perturbations follow from it and the iteration's number.
        best_u: the best point of each start so far (starts, p); its beginning, where none walked to the end yet.
        best_value: objective there (starts,); infinite, where none walked to the end yet.
        best_iteration: iteration that evaluated it (starts,); -1, where none walked to the end yet.
    """

    u: Float[Array, "starts p"]
    optimizer: Any
    iteration: Int[Array, ""]
    key: UInt[Array, " 2"]
    best_u: Float[Array, "starts p"]
    best_value: Float[Array, " starts"]
    best_iteration: Int[Array, " starts"]


def initial_state(tuning: Tuning) -> TuneState:
    """The state before the first iteration."""
    u = to_unconstrained(tuning.bounds, jnp.asarray(tuning.start_points(), float))
    return TuneState(
        u=u,
        optimizer=jax.vmap(tuning.optimizer.init)(u),
        iteration=jnp.zeros((), int),
        key=jax.random.key_data(jax.random.key(tuning.seed)),
        best_u=u,
        best_value=jnp.full(len(u), jnp.inf, u.dtype),
        best_iteration=jnp.full(len(u), -1),
    )


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


# ---
# One iteration of a tuning by line search: a gradient from a few worlds, then walks along it without gradients.


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
