"""The routings of the knee tendon from the servo's pulley to the shin, and the knee angles each can hold.

All obey one law, l_t = l_t0 + r_p (theta_2 + k q2). `pull` is the length less the wrap, l_t - r_p theta_2, which
depends on hip and knee angle alone (`robot.leg_plane`); the servo angle is then (pull - l_t0) / (k r_p). As there,
lengths are worked out in a frame whose y is multiplied by the knee direction s.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import jax.numpy as jnp
from jax.typing import ArrayLike

from nermo_mjx.robot.leg_plane import TINY, check_routing, lead_height, shank
from nermo_mjx.robot.parameters import IDLER_RADIUS
from nermo_mjx.shapes import Array

if TYPE_CHECKING:
    from nermo_mjx.kinematics.leg import Leg

#: Margin to the singular ends of the knee's range, where the foot or the tendon no longer determines the knee [rad].
KNEE_MARGIN: Final = 0.05


def knee_range(leg: Leg, q1: ArrayLike, routing: str) -> tuple[Array, Array, Array]:
    """Lowest and highest knee angle theta_1 [rad] at hip angle q1, and whether the routing works there.

    Two conditions bound it, each with a margin of `KNEE_MARGIN`. The foot must determine the knee (`arm_range`),
    and the tendon must flex it: the tendon's lever on the knee vanishes where B lies on the line from A to the hip axis
    (type 3, at 0 and pi), to the guide point (type 2) or along the tangent to the pulley (type 1). Between these two
    dead centres `pull` is monotonic. With type 3 the range is 0.05 to 2.93 rad in front and 0.54 to 3.09 rad behind.
    Type 1 works while the pulley is farther from the knee than B, which fails only with the leg turned upward.
    """
    low, high = arm_range(leg)
    limit, works = _dead_centre(leg, q1, routing)
    low = jnp.maximum(low, limit - math.pi + KNEE_MARGIN)
    high = jnp.maximum(jnp.minimum(high, limit - KNEE_MARGIN), low + KNEE_MARGIN)
    return low, high, works


def arm_range(leg: Leg) -> tuple[Array, Array]:
    """Lowest and highest knee angle [rad] at which the foot's distance from O determines the knee, independent of the
    tendon.

    From knee and arm O-A-H both stretched to both folded; they differ because the ankle turns H by gamma off the shin.
    """
    bend = leg.knee_direction * shank(leg)[1]
    low = jnp.maximum(bend, 0.0) + KNEE_MARGIN
    return low, jnp.minimum(bend, 0.0) + math.pi - KNEE_MARGIN


def _dead_centre(leg: Leg, q1: ArrayLike, routing: str) -> tuple[Array, Array]:
    """Folded knee angle at which the tendon's line passes through the knee; it is pi for type 3."""
    check_routing(routing)
    if routing == "type3":
        return jnp.full(jnp.shape(leg.l1), math.pi), jnp.asarray(True)
    if routing == "type2":
        y, z = leg.knee_direction * leg.guide[..., 0], leg.guide[..., 1]
    elif routing == "type3_idler":
        y, z = 0.0, lead_height(leg)
    else:
        y, z = 0.0, leg.pulley_height
    sin, cos = jnp.sin(leg.knee_direction * q1), jnp.cos(q1)
    # From the knee A to the guide point or pulley centre: along the upper leg towards O, and across it.
    towards = leg.l1 - (y * sin - z * cos)
    across = -(y * cos + z * sin)
    angle = math.pi + jnp.arctan2(across, towards)
    if routing == "type2":
        return angle, jnp.asarray(True)
    if routing == "type3_idler":  # on the other side of the axis than type 1 of the pulley, or straight past the idler
        return jnp.maximum(math.pi + jnp.arcsin(IDLER_RADIUS / leg.l1), angle), jnp.asarray(True)
    distance = jnp.sqrt(jnp.maximum(towards**2 + across**2, TINY**2))
    turned = jnp.arcsin(jnp.minimum(leg.pulley_radius / distance, 0.9))
    return angle - turned, distance**2 > (leg.l2 + TINY) ** 2 + leg.pulley_radius**2
