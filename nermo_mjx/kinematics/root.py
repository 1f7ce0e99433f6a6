"""Roots of monotonic scalar equations: safeguarded Newton iteration with an implicit derivative."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from nermo_mjx.shapes import Array, Scalars

#: Maximum number of steps: ten reach rounding everywhere in the workspace, in double precision; the rest is a margin.
STEPS: Final = 14


class _Search(NamedTuple):
    """Number of steps, the bracket's ends, the current estimate of the root, and where it has converged."""

    steps: Array
    low: Array
    high: Array
    root: Array
    found: Array


def bracketed_root(
    residual: Callable[[Array], Array],
    low: ArrayLike,
    high: ArrayLike,
    slope_floor: float,
    start: ArrayLike | None = None,
) -> Scalars:
    """The x in [low, high] with residual(x) = 0, element by element.

    Args:
        residual: elementwise and monotonic (rising or falling) in x, of opposite signs (or zero) at the ends; it
            broadcasts over leading axes of x. It may close over traced arrays; derivatives flow to them by the
            implicit function theorem.
        low, high: ends of the bracket, of any shapes that broadcast with the residual's. The root's derivative does not
            depend on them. An end that is a root takes no step.
        slope_floor: lower limit of the residual's slope; keeps the derivative finite where it is flat.
        start: a guess in [low, high]; without one, the middle. A good one only saves steps.
    """
    low, high = jnp.broadcast_arrays(low, high)
    value = jax.eval_shape(residual, low)
    shape, dtype = jnp.broadcast_shapes(low.shape, value.shape), jnp.promote_types(low.dtype, value.dtype)
    low, high = (jax.lax.stop_gradient(jnp.broadcast_to(end.astype(dtype), shape)) for end in (low, high))
    guess = 0.5 * (low + high) if start is None else jax.lax.stop_gradient(jnp.broadcast_to(start, shape).astype(dtype))
    slack, small = 8 * jnp.finfo(dtype).eps, 0.1 * float(jnp.finfo(dtype).eps) ** 0.5

    def divide(value: Array, slope: Array) -> Array:
        return value / jnp.where(jnp.abs(slope) < slope_floor, jnp.where(slope < 0, -slope_floor, slope_floor), slope)

    def solve(f: Callable[[Array], Array], start: Array) -> Array:
        at_low, at_high = f(low), f(high)
        rising = at_high >= at_low

        def goes_on(state: _Search) -> Array:
            return (state.steps < STEPS) & ~state.found.all()

        def step(state: _Search) -> _Search:
            i, a, b, x, found = state
            value, slope = jax.jvp(f, (x,), (jnp.ones_like(x),))
            above = jnp.where(rising, value, -value)
            a, b = jnp.where(above <= 0, x, a), jnp.where(above >= 0, x, b)
            newton = x - divide(value, slope)
            inside = (newton >= a - slack) & (newton <= b + slack)
            # A step out of the bracket goes to its end, where saturated roots lie, or to its middle, alternately.
            safe = jnp.where(i % 2 == 0, jnp.clip(newton, a, b), 0.5 * (a + b))
            after = jnp.where(inside, jnp.clip(newton, a, b), safe)
            # Newton's error after a step goes like the square of the step. Converged elements are left unchanged, so
            # that no element depends on the others.
            near = inside & (jnp.abs(after - x) <= small * jnp.maximum(jnp.abs(x), 1e-3))
            return _Search(i + 1, a, b, jnp.where(found, x, after), found | near)

        at_end = (at_low == 0) | (at_high == 0)
        start = jnp.where(at_low == 0, low, jnp.where(at_high == 0, high, start))
        first = _Search(jnp.int32(0), low, high, start, at_end)
        # Gives the same root. On an accelerator a loop of unknown length waits for the host in each step.
        return jax.lax.platform_dependent(
            first,
            cpu=lambda search: jax.lax.while_loop(goes_on, step, search).root,
            default=lambda search: jax.lax.fori_loop(0, STEPS, lambda _, each: step(each), search).root,
        )

    def tangent_solve(linear: Callable[[Array], Array], value: Array) -> Array:
        return divide(value, linear(jnp.ones_like(value)))

    def broadcast_residual(x: Array) -> Array:
        return jnp.broadcast_to(residual(x), x.shape).astype(dtype)

    return jax.lax.custom_root(broadcast_residual, guess, solve, tangent_solve)
