"""The three ways to lead the knee tendon from the servo's pulley to the shin, and the knee angles each can hold.

All three obey one law, l_t = l_t0 + r_p (theta_2 + k q2). `pull` is the length less the wrap, l_t - r_p theta_2, which
depends on hip and knee angle alone; the servo angle is then (pull - l_t0) / (k r_p).

Lengths are worked out in a frame whose y is multiplied by the knee direction s: in it every knee bends towards +y, the
tendon leaves the pulley on the +y side, and front and rear leg are one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import jax.numpy as jnp
from jax.typing import ArrayLike

from nermo_mjx.robot.parameters import ROUTINGS
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.shapes import Array, Scalars

if TYPE_CHECKING:
    from nermo_mjx.kinematics.leg import Leg

#: Distance kept from the singular ends of the knee's range, where the foot or the tendon loses its grip on it [rad].
KNEE_MARGIN: Final = 0.05
#: Shortest length that is divided by [m].
_TINY: Final = 1e-4


def check_routing(routing: str) -> None:
    """Raise `ParameterError` unless `routing` is one of `ROUTINGS`."""
    if routing not in ROUTINGS:
        raise ParameterError(f"routing is {routing!r}: allowed is one of {', '.join(ROUTINGS)}.")


def pull(leg: Leg, q1: ArrayLike, knee_angle: ArrayLike, routing: str) -> Scalars:
    """Tendon length less its wrap on the pulley, l_t - r_p theta_2 [m]; it falls as the knee flexes.

    Type 3 leads through the hip axis: |OB|, whatever q1. Type 2 leads through the guide point: |CB|. Both have
    theta_2 = 0. Type 1 is the tangent from the pulley to B, whose touching point moves with the leg (5.3-5.11).
    """
    check_routing(routing)
    if routing == "type3":
        squared = leg.l1**2 + leg.l2**2 + 2 * leg.l1 * leg.l2 * jnp.cos(knee_angle)
        return jnp.sqrt(jnp.maximum(squared, _TINY**2))
    hip = leg.knee_direction * q1
    y = leg.l1 * jnp.sin(hip) + leg.l2 * jnp.sin(hip + knee_angle)
    z = -leg.l1 * jnp.cos(hip) - leg.l2 * jnp.cos(hip + knee_angle)
    if routing == "type2":
        y, z = y - leg.knee_direction * leg.guide[..., 0], z - leg.guide[..., 1]
        return jnp.sqrt(jnp.maximum(y**2 + z**2, _TINY**2))
    down = leg.pulley_height - z
    outside = y**2 + down**2 > leg.pulley_radius**2 + _TINY**2
    y, down = jnp.where(outside, y, 0.0), jnp.where(outside, down, leg.pulley_radius + 1.0)
    tangent = jnp.sqrt(y**2 + down**2 - leg.pulley_radius**2)
    # theta_2 = atan(l_t/r_p) - th_s of the spiral model; th_s = pi/2 - atan2(y, down) puts its cut above the pulley.
    wrap = jnp.arctan2(tangent, leg.pulley_radius) - math.pi / 2 + jnp.arctan2(y, down)
    return jnp.where(outside, tangent - leg.pulley_radius * wrap, 0.0)


def knee_range(leg: Leg, q1: ArrayLike, routing: str) -> tuple[Array, Array, Array]:
    """Lowest and highest knee angle theta_1 [rad] at hip angle q1, and whether the routing works there at all.

    Two conditions bound it, each kept at a distance of `KNEE_MARGIN`. The foot must determine the knee (`arm_range`),
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
    """Lowest and highest knee angle [rad] at which the foot's distance from O determines the knee, whatever the tendon.

    From knee and arm O-A-H both stretched to both folded; they differ because the ankle turns H by gamma off the shin.
    """
    bend = leg.knee_direction * shank(leg)[1]
    low = jnp.maximum(bend, 0.0) + KNEE_MARGIN
    return low, jnp.minimum(bend, 0.0) + math.pi - KNEE_MARGIN


def shank(leg: Leg) -> tuple[Array, Array]:
    """Length L [m] of the rigid link from knee to foot, and the angle gamma [rad] by which theta_3 turns it back."""
    along = leg.l3 + leg.l4 * jnp.cos(leg.theta3)
    across = leg.l4 * jnp.sin(leg.theta3)
    return jnp.sqrt(along**2 + across**2), jnp.arctan2(across, along)


def _dead_centre(leg: Leg, q1: ArrayLike, routing: str) -> tuple[Array, Array]:
    """Folded knee angle at which the tendon's line passes through the knee; it is pi for type 3."""
    check_routing(routing)
    if routing == "type3":
        return jnp.full(jnp.shape(leg.l1), math.pi), jnp.asarray(True)
    if routing == "type2":
        y, z = leg.knee_direction * leg.guide[..., 0], leg.guide[..., 1]
    else:
        y, z = 0.0, leg.pulley_height
    sin, cos = jnp.sin(leg.knee_direction * q1), jnp.cos(q1)
    # From the knee A to the guide point or pulley centre: along the upper leg towards O, and across it.
    towards = leg.l1 - (y * sin - z * cos)
    across = -(y * cos + z * sin)
    angle = math.pi + jnp.arctan2(across, towards)
    if routing == "type2":
        return angle, jnp.asarray(True)
    distance = jnp.sqrt(jnp.maximum(towards**2 + across**2, _TINY**2))
    turned = jnp.arcsin(jnp.minimum(leg.pulley_radius / distance, 0.9))
    return angle - turned, distance**2 > (leg.l2 + _TINY) ** 2 + leg.pulley_radius**2
