"""The iteration of a tuning, which steps the points of several starts along their gradients."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nermo_mjx.optimize.objective import (
    Bounds,
    Problem,
    confine,
    from_unconstrained,
    slope,
    to_unconstrained,
)
from nermo_mjx.optimize.optimizers import Optimizer
from nermo_mjx.optimize.tuning_spec import Tuning

# ---
# State of a tuning: everything that its next iteration depends on, as one pytree of arrays.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TuneState:
    """A tuning of p parameters from several starts, before an iteration.

    Attributes:
        u: points in unbounded coordinates (starts, p), see `nermo_mjx.optimize.objective`.
        optimizer: state of the optimizer, every leaf with a leading axis of starts.
        iteration: iterations done.
        best_u: the best point of each start so far (starts, p); its beginning, where none walked to the end yet.
        best_value: objective there (starts,); infinite, where none walked to the end yet.
        best_iteration: iteration that evaluated it (starts,); -1, where none walked to the end yet.
    """

    u: Float[Array, "starts p"]
    optimizer: Any
    iteration: Int[Array, ""]
    best_u: Float[Array, "starts p"]
    best_value: Float[Array, " starts"]
    best_iteration: Int[Array, " starts"]

    def after(self, u: Any, optimizer: Any, better: Any, better_u: Any, value: Any) -> TuneState:
        """The state one iteration later, at u.

        Args:
            better, better_u, value: which starts found a better point (starts,), the point and its objective.
        """
        return TuneState(
            u=u,
            optimizer=optimizer,
            iteration=self.iteration + 1,
            best_u=jnp.where(better[:, None], better_u, self.best_u),
            best_value=jnp.where(better, value, self.best_value).astype(self.best_value.dtype),
            best_iteration=jnp.where(better, self.iteration, self.best_iteration),
        )


def initial_state(tuning: Tuning) -> TuneState:
    """The state before the first iteration."""
    u = to_unconstrained(tuning.bounds, jnp.asarray(tuning.start_points(), float))
    return TuneState(
        u=u,
        optimizer=jax.vmap(tuning.optimizer.build().init)(u),
        iteration=jnp.zeros((), int),
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
        gradient: d value / d parameters (starts, p); NaN without one.
        metrics: name -> (starts,).
        simulated_seconds: simulated time that the iteration took, gradients at their cost in forward runs [s].
    """

    points: np.ndarray
    value: np.ndarray
    ok: np.ndarray
    gradient: np.ndarray
    metrics: dict[str, np.ndarray]
    simulated_seconds: float


class Tuner:
    """Steps a tuning on a problem along gradients; two small programs run before and after the problem's large one."""

    def __init__(self, tuning: Tuning, problem: Problem) -> None:
        assert tuple(problem.names) == tuning.names, (
            "a problem takes the tuned parameters in the order of the file"
        )
        self.tuning, self.problem, self.bounds = tuning, problem, tuning.bounds
        self.seconds, self.cost = problem.simulated_seconds, problem.gradient_cost

    def step(self, state: TuneState) -> tuple[TuneState, Iterate]:
        """Evaluate the points of a state and take one step from them."""
        points = placed(self.bounds, state)
        evaluation = self.problem.evaluate(points, True)
        next_state, ok = _advanced(
            self.tuning.optimizer,
            self.bounds,
            state,
            evaluation.value,
            evaluation.gradient,
            evaluation.ok,
        )
        ok = np.asarray(ok)
        return next_state, Iterate(
            points=np.asarray(points, float),
            value=np.where(ok, np.asarray(evaluation.value, float), np.nan),
            ok=ok,
            gradient=np.where(ok[:, None], np.asarray(evaluation.gradient, float), np.nan),
            metrics={
                name: np.asarray(column, float) for name, column in evaluation.metrics.items()
            },
            simulated_seconds=len(ok) * self.seconds * self.cost,
        )


@jax.jit
def placed(bounds: Bounds, state: TuneState) -> Float[Array, "starts p"]:
    """Parameters of all starts."""
    return from_unconstrained(bounds, state.u)


@functools.partial(jax.jit, static_argnums=0)
def _advanced(
    optimizer: Optimizer,
    bounds: Bounds,
    state: TuneState,
    value: Float[Array, " starts"],
    gradient: Float[Array, "starts p"],
    ok: Bool[Array, " starts"],
) -> tuple[TuneState, Bool[Array, " starts"]]:
    """The state after the iteration, and whether each point has a value and a gradient.

    A start without a completed walk has no gradient: it moves halfway back to its best point, and
    its optimizer is not updated; an optimizer that uses values reacts by itself.
    """
    update = optimizer.build().update
    ok = ok & jnp.isfinite(value) & jnp.isfinite(gradient).all(axis=-1)
    # What does not count is replaced before anything is computed from it, so that no NaN can come through a product.
    gradient = jnp.where(ok[:, None], gradient, 0.0) * slope(bounds, state.u)
    better = ok & (value < state.best_value)
    best_u = jnp.where(better[:, None], state.u, state.best_u)
    step, updated = jax.vmap(
        lambda gradient, former_state, u, value: update(gradient, former_state, u, value=value)
    )(gradient, state.optimizer, state.u, jnp.where(ok, value, jnp.inf))
    forward = confine(bounds, state.u + step)
    waits = ~ok & (not optimizer.reads_values)
    u = jnp.where(waits[:, None], 0.5 * (state.u + best_u), forward)
    next_parts = jax.tree.map(
        lambda new, old: jnp.where(waits.reshape(-1, *[1] * (new.ndim - 1)), old, new),
        updated,
        state.optimizer,
    )
    return state.after(u, next_parts, better, state.u, value), ok
