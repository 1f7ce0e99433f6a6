"""Roots of monotonic scalar equations: a fixed number of safeguarded Newton steps, an implicit derivative."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

#: Ten steps reach rounding everywhere in the workspace, in double precision; the rest is in reserve.
STEPS: Final = 14


def bracketed_root(
    residual: Callable[[Array], Array], low: ArrayLike, high: ArrayLike, slope_floor: float
) -> Float[Array, "*batch"]:
    """The x in [low, high] with residual(x) = 0, element by element.

    Args:
        residual: elementwise and monotonic (rising or falling) in x, of opposite signs (or zero) at the ends; it
            broadcasts over leading axes of x. It may close over traced arrays; derivatives flow to them by the
            implicit function theorem.
        low, high: ends of the bracket, of any shapes that broadcast with the residual's. The root's derivative does not
            depend on them.
        slope_floor: smallest slope of the residual that counts as one; keeps the derivative finite where it is flat.
    """
    low, high = jnp.broadcast_arrays(low, high)
    value = jax.eval_shape(residual, low)
    shape, dtype = jnp.broadcast_shapes(low.shape, value.shape), jnp.promote_types(low.dtype, value.dtype)
    low, high = (jax.lax.stop_gradient(jnp.broadcast_to(end.astype(dtype), shape)) for end in (low, high))
    slack = 8 * jnp.finfo(dtype).eps

    def divide(value: Array, slope: Array) -> Array:
        return value / jnp.where(jnp.abs(slope) < slope_floor, jnp.where(slope < 0, -slope_floor, slope_floor), slope)

    def solve(f: Callable[[Array], Array], start: Array) -> Array:
        at_low, at_high = f(jnp.stack([low, high]))
        rising = at_high >= at_low

        def step(i: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            a, b, x = state
            value, slope = jax.jvp(f, (x,), (jnp.ones_like(x),))
            above = jnp.where(rising, value, -value)
            a, b = jnp.where(above <= 0, x, a), jnp.where(above >= 0, x, b)
            newton = x - divide(value, slope)
            inside = (newton >= a - slack) & (newton <= b + slack)
            # A step out of the bracket goes to its end, where a saturated root lies, and by turns to its middle.
            safe = jnp.where(i % 2 == 0, jnp.clip(newton, a, b), 0.5 * (a + b))
            return a, b, jnp.where(inside, jnp.clip(newton, a, b), safe)

        return jax.lax.fori_loop(0, STEPS, step, (low, high, start))[2]

    def tangent_solve(linear: Callable[[Array], Array], value: Array) -> Array:
        return divide(value, linear(jnp.ones_like(value)))

    def broadcast_residual(x: Array) -> Array:
        return jnp.broadcast_to(residual(x), x.shape).astype(dtype)

    return jax.lax.custom_root(broadcast_residual, 0.5 * (low + high), solve, tangent_solve)
