"""Closed forms in a leg's sagittal plane, for both NumPy and JAX, shared by assembly and kinematics.

Coordinates (y, z) and angles are those of `kinematics.leg`. A leg is anything with the fields of `LegGeometry`.
"""

from __future__ import annotations

import math
from typing import Any, Final

import jax.numpy as jnp
import numpy as np

from nermo_mjx.robot.parameters import IDLER_RADIUS, ROUTINGS, LegGeometry
from nermo_mjx.robot.quantity import ParameterError

#: Lower limit of lengths in denominators [m].
TINY: Final = 1e-4


def check_routing(routing: str) -> None:
    """Raise `ParameterError` unless `routing` is one of `ROUTINGS`."""
    if routing not in ROUTINGS:
        raise ParameterError(f"routing is {routing!r}: allowed is one of {', '.join(ROUTINGS)}.")


def shank(leg: Any, xp: Any = jnp) -> tuple[Any, Any]:
    """Length L [m] of the rigid link from knee to foot, and the angle gamma [rad] by which theta_3 turns it back."""
    along = leg.l3 + leg.l4 * xp.cos(leg.theta3)
    across = leg.l4 * xp.sin(leg.theta3)
    return xp.sqrt(along**2 + across**2), xp.arctan2(across, along)


def pull(leg: Any, q1: Any, knee_angle: Any, routing: str, xp: Any = jnp) -> Any:
    """Tendon length without its wrap on the pulley, l_t - r_p theta_2 [m]; it decreases as the knee flexes.

    Type 3 leads through the hip axis: |OB|, whatever q1. Type 2 leads through the guide point: |CB|. Both have
    theta_2 = 0. Type 1 is the tangent from the pulley to B, whose tangent point moves with the leg (5.3-5.11). Type 3
    with an idler passes the hip axis on the other side: the tangent from the idler to B, and what it winds up there.

    Lengths are worked out in a frame whose y is multiplied by the knee direction s: in it every knee bends towards +y,
    the tendon leaves the pulley on the +y side, and the same equations hold for front and rear legs.

    Args:
        leg: its fields broadcast with the angles.
        q1, knee_angle: hip angle and theta_1 [rad].
        routing: of the tendon.
        xp: `numpy` or `jax.numpy`.
    """
    check_routing(routing)
    if routing == "type3":
        squared = leg.l1**2 + leg.l2**2 + 2 * leg.l1 * leg.l2 * xp.cos(knee_angle)
        return xp.sqrt(xp.maximum(squared, TINY**2))
    hip = leg.knee_direction * q1
    y = leg.l1 * xp.sin(hip) + leg.l2 * xp.sin(hip + knee_angle)
    z = -leg.l1 * xp.cos(hip) - leg.l2 * xp.cos(hip + knee_angle)
    if routing == "type2":
        guide = xp.asarray(leg.guide)
        y, z = y - leg.knee_direction * guide[..., 0], z - guide[..., 1]
        return xp.sqrt(xp.maximum(y**2 + z**2, TINY**2))
    if routing == "type3_idler":
        y, down, radius = -y, -z, IDLER_RADIUS
    else:
        down, radius = leg.pulley_height - z, leg.pulley_radius
    outside = y**2 + down**2 > radius**2 + TINY**2
    y, down = xp.where(outside, y, 0.0), xp.where(outside, down, radius + 1.0)
    tangent = xp.sqrt(y**2 + down**2 - radius**2)
    # theta_2 = atan(l_t/r_p) - th_s of the spiral model; th_s = pi/2 - atan2(y, down) puts its cut above the pulley.
    wrap = xp.arctan2(tangent, radius) - math.pi / 2 + xp.arctan2(y, down)
    length = tangent - radius * wrap
    if routing == "type3_idler":  # behind which B may pull it straight, from where it crosses the leg's axis
        height = lead_height(leg)
        touch = xp.arcsin(IDLER_RADIUS / height)
        straight = xp.sqrt(y**2 + (down + height) ** 2) - xp.sqrt(height**2 - radius**2) - radius * touch
        length = xp.where(wrap > touch, straight, length)
    return xp.where(outside, length, 0.0)


def standing(leg: LegGeometry, routing: str) -> tuple[float, float, float]:
    """Hip, knee and pulley angle [rad] that put the foot of one leg at its `neutral_foot`, the tendon just taut.

    O-A-H is a planar two-link arm: the cosine rule, as in `kinematics.leg.inverse`.
    """
    (y, z), side = leg.neutral_foot, leg.knee_direction
    link, bend = shank(leg, np)
    arm = math.acos((y**2 + z**2 - leg.l1**2 - link**2) / (2 * leg.l1 * link))
    along, across = leg.l1 + link * math.cos(arm), side * link * math.sin(arm)
    hip, knee = math.atan2(y * along + z * across, y * across - z * along), arm + side * bend
    length = float(pull(leg, hip, knee, routing, np))
    return hip, knee, (length - leg.tendon_length) / (leg.servo_direction * leg.pulley_radius)


def tendon_limit(leg: LegGeometry, routing: str) -> float:
    """Length of a leg's tendon at pulley angle 0 and l_t = l_t0 [m]: from its tie, around the pulley, to its
    attachment.

    As its upper limit it holds l_t <= l_t0 + r_p (theta_2 + k q2). Types 2 and 3 leave the pulley towards a point fixed
    to the body; type 1 towards the attachment, where theta_2 counts from the pulley's forward side.
    """
    check_routing(routing)
    turn, radius = -leg.knee_direction, leg.pulley_radius
    if routing == "type1":
        forward = 0.0 if leg.knee_direction > 0 else math.pi
        free, touch = _tangent(leg.tie_type1, radius, turn)
        return free + radius * ((turn * (forward - touch)) % math.tau) + leg.tendon_length
    y, z = {"type2": leg.guide, "type3_idler": (0.0, lead_height(leg))}.get(routing, (0.0, 0.0))
    (tied, start), (free, end) = (
        _tangent(leg.tie_idler if routing == "type3_idler" else leg.tie, radius, turn),
        _tangent((y, z - leg.pulley_height), radius, -turn),
    )  # fmt: skip
    length = tied + radius * ((turn * (end - start)) % math.tau) + free + leg.tendon_length
    if routing != "type3_idler":
        return length
    # The crossed tangent has the angle a to the leg's axis, sin(a) = (r_p + r_i) / d_1; the wrap counts from the
    # idler's rear point in front, and from its front point behind.
    return length + math.sqrt(z**2 - IDLER_RADIUS**2) + IDLER_RADIUS * math.asin(IDLER_RADIUS / z)


def lead_height(leg: Any) -> Any:
    """Height above the hip axis [m] at which a tendon between pulley and idler crosses the line through their
    centres."""
    return leg.pulley_height * IDLER_RADIUS / (leg.pulley_radius + IDLER_RADIUS)


def _tangent(point: tuple[float, float], radius: float, turn: float) -> tuple[float, float]:
    """Length of the tangent from a point to a circle about the origin, and the angle of the tangent point."""
    distance = math.hypot(*point)
    return math.sqrt(distance**2 - radius**2), math.atan2(point[1], point[0]) + turn * math.acos(radius / distance)
