"""The iteration of a tuning, which moves the points of several starts along their gradients."""

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
# The state of a tuning is one pytree of arrays with all inputs of the next iteration.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TuneState:
    """The state of a tuning of p parameters from several starts, before an iteration.

    Attributes:
        u: Points in unbounded coordinates (starts, p), see `nermo_mjx.optimize.objective`.
        optimizer: State of the optimizer, whose leaves have a leading axis of starts.
        iteration: Number of completed iterations.
        best_u: Best point of each start so far (starts, p); the initial point before the first completed walk.
        best_value: Objective at the best point (starts,); infinite before the first completed walk.
        best_iteration: Iteration that evaluated the best point (starts,); -1 before the first completed walk.
    """

    u: Float[Array, "starts p"]
    optimizer: Any
    iteration: Int[Array, ""]
    best_u: Float[Array, "starts p"]
    best_value: Float[Array, " starts"]
    best_iteration: Int[Array, " starts"]

    def advance(self, u: Any, optimizer: Any, better: Any, better_u: Any, value: Any) -> TuneState:
        """The state one iteration later, at the points u (starts, p).

        Args:
            optimizer: State of the optimizer.
            better, better_u, value: Whether each start found a better point (starts,), this point and its objective.
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
    """Results of an iteration at its initial points, in NumPy arrays with one entry per start.

    Attributes:
        points: Parameters in their units (starts, p).
        value: Objective (starts,); NaN if the robot did not walk to the end.
        ok: Whether the robot walked to the end (starts,).
        gradient: Derivative of the value with respect to the parameters (starts, p); NaN if there is none.
        metrics: Metrics (starts,) by name.
        simulated_seconds: Simulated time of the iteration [s], where a gradient counts as its cost in forward runs.
    """

    points: np.ndarray
    value: np.ndarray
    ok: np.ndarray
    gradient: np.ndarray
    metrics: dict[str, np.ndarray]
    simulated_seconds: float


class Tuner:
    """Runs the iterations of a tuning. Two small programs run before and after the large program of the problem."""

    def __init__(self, tuning: Tuning, problem: Problem) -> None:
        assert tuple(problem.names) == tuning.names, (
            "a problem takes the tuned parameters in the order of the file"
        )
        self.tuning, self.problem, self.bounds = tuning, problem, tuning.bounds
        self.seconds, self.cost = problem.simulated_seconds, problem.gradient_cost

    def step(self, state: TuneState) -> tuple[TuneState, Iterate]:
        """Evaluate the points of a state and take one step from them."""
        points = point_parameters(self.bounds, state)
        evaluation = self.problem.evaluate(points, True)
        next_state, ok = _advance(
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
def point_parameters(bounds: Bounds, state: TuneState) -> Float[Array, "starts p"]:
    """Parameters of all starts, in their units."""
    return from_unconstrained(bounds, state.u)


@functools.partial(jax.jit, static_argnums=0)
def _advance(
    optimizer: Optimizer,
    bounds: Bounds,
    state: TuneState,
    value: Float[Array, " starts"],
    gradient: Float[Array, "starts p"],
    ok: Bool[Array, " starts"],
) -> tuple[TuneState, Bool[Array, " starts"]]:
    """The state after the iteration, and whether each point has a value and a gradient.

    A start without a completed walk has no gradient. It moves halfway back to its best point, and its optimizer is not
    updated, unless the optimizer uses values and therefore handles this case itself.
    """
    update = optimizer.build().update
    ok = ok & jnp.isfinite(value) & jnp.isfinite(gradient).all(axis=-1)
    # Invalid values are replaced before the computation, so that products contain no NaN.
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
    return state.advance(u, next_parts, better, state.u, value), ok
