"""Unbounded coordinates for bounded parameters, so that every step of an optimizer stays within bounds.

A parameter x in (low, high) is the smooth image of a coordinate u that may take any value:

    x = low + (high - low) sigmoid(u),         dx/du = (high - low) sigmoid(u) (1 - sigmoid(u))

A periodic parameter (an angle whose bounds are a whole turn) has no bounds to stay away from. Its coordinate is
proportional to it, and x wraps around to the other side:

    x = low + (high - low) frac(1/2 + u/4),    dx/du = (high - low) / 4

In the middle of the bounds both have the slope (high - low) / 4: a unit of u is the same fraction of every parameter's
range, so that one learning rate and one standard deviation suit all.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

#: A point nearer to a bound than this share of the range is moved in: on the bound itself u is infinite and dx/du zero.
EDGE: Final = 0.01
#: No step leads nearer to a bound than this share of the range: from beyond, returning would take forever.
FURTHEST: Final = 0.001


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Bounds:
    """Bounds of p parameters, in the parameters' own units.

    Attributes:
        low, high: ends of each range (p,); of a periodic parameter they are one period apart.
        periodic: whether the ends are the same place (p,).
    """

    low: Float[Array, " p"]
    high: Float[Array, " p"]
    periodic: Bool[Array, " p"]


def to_unconstrained(bounds: Bounds, x: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """Coordinates u of parameters x within their bounds.

    A bounded parameter on its bound, or within `EDGE` of it, is taken as `EDGE` inside: 1 % of the range, where the
    slope is a 25th of that in the middle. u is never infinite, so that a start on a bound can leave it.
    """
    share = (x - bounds.low) / (bounds.high - bounds.low)
    inside = jnp.clip(share, EDGE, 1.0 - EDGE)
    return jnp.where(bounds.periodic, 4.0 * (share - 0.5), jnp.log(inside) - jnp.log1p(-inside))


def from_unconstrained(bounds: Bounds, u: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """Parameters x at coordinates u; within the bounds for every finite u."""
    turn = 0.5 + 0.25 * u
    share = jnp.where(bounds.periodic, turn - jnp.floor(turn), jax.nn.sigmoid(u))
    return jnp.clip(bounds.low + (bounds.high - bounds.low) * share, bounds.low, bounds.high)


def slope(bounds: Bounds, u: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """dx/du at u.

    By the chain rule d value/du = d value/dx dx/du, a gradient to the parameters times this is one to the coordinates.
    """
    share = jax.nn.sigmoid(u)
    return (bounds.high - bounds.low) * jnp.where(bounds.periodic, 0.25, share * (1.0 - share))


def confine(bounds: Bounds, u: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """Coordinates that a step may end at: not nearer to a bound than `FURTHEST`; a periodic one may be anywhere."""
    limit = jnp.log((1.0 - FURTHEST) / FURTHEST)
    return jnp.where(bounds.periodic, u, jnp.clip(u, -limit, limit))
