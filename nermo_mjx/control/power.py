"""x^t with a finite slope everywhere, which the published curves need at their ends."""

from __future__ import annotations

import jax.numpy as jnp

from nermo_mjx.shapes import Broadcastable


def signed_power(base: Broadcastable, exponent: Broadcastable, linear_below: float) -> Broadcastable:
    """sign(x)|x|^t for |x| >= linear_below, and the line through the origin to that point below it.

    Continuous in x and t. With t < 1 the plain power has an infinite slope at 0, and a gradient through it is NaN.

    Args:
        base: x.
        exponent: t > 0.
        linear_below: end of the linear part; the largest slope is linear_below^(t - 1).
    """
    return base * jnp.maximum(jnp.abs(base), linear_below) ** (exponent - 1.0)
