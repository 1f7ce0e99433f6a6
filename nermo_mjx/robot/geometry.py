"""The robot's geometry as parameters that may differ between worlds, and the numbers derived from them.

Defaults are the published numbers of `parameters`; all other dimensions are the same in all worlds. Trunk and servos
keep their masses and their centres of mass; the links of legs, spine and tail keep their masses, and their centres of
mass and boxes of inertia stretch with them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import Any, Final

import jax.numpy as jnp
import numpy as np

from nermo_mjx.robot.parameters import (
    BODY_GEOMETRY,
    FOOT_RADIUS,
    FRONT_LEG,
    IDLER_RADIUS,
    LEGS,
    PULLEY_RIM,
    REAR_LEG,
    ROUTINGS,
    SERVO_DEPTH,
    SERVO_INSET,
    SPINE_GEOMETRY,
    TAIL_GEOMETRY,
    LegGeometry,
)
from nermo_mjx.robot.quantity import ParameterError, choice, group, parameter_tree, quantity

#: Rows of the DH table that lead from one lateral joint to the next; each covers half a segment.
SEGMENT_ROWS: Final = range(
    SPINE_GEOMETRY.lateral_joints[0] + 1, SPINE_GEOMETRY.lateral_joints[-1] + 1
)


def _link(length: float, doc: str) -> Any:
    return quantity(length, "m", round(0.6 * length, 4), round(1.6 * length, 4), doc)


@parameter_tree
class FrontLeg:
    """Links of both front legs, in their sagittal plane."""

    upper: Any = _link(FRONT_LEG.l1, "l1, shoulder to knee")
    attachment: Any = _link(
        FRONT_LEG.l2, "l2, knee to where the tendon is tied; at most to the ankle"
    )
    lower: Any = _link(FRONT_LEG.l3, "l3, knee to ankle")
    foot: Any = _link(FRONT_LEG.l4, "l4, ankle to the sole's centre")


@parameter_tree
class RearLeg:
    """Links of both rear legs, in their sagittal plane."""

    upper: Any = _link(REAR_LEG.l1, "l1, hip to knee")
    attachment: Any = _link(
        REAR_LEG.l2, "l2, knee to where the tendon is tied; at most to the ankle"
    )
    lower: Any = _link(REAR_LEG.l3, "l3, knee to ankle")
    foot: Any = _link(REAR_LEG.l4, "l4, ankle to the sole's centre")


@parameter_tree
class Shoulder:
    """Axis of the left shoulder from the spine base; the right one mirrors x."""

    x: Any = quantity(BODY_GEOMETRY.shoulder[0], "m", 0.03, 0.06, "to the left")
    y: Any = quantity(BODY_GEOMETRY.shoulder[1], "m", -0.085, -0.04, "backward")
    z: Any = quantity(BODY_GEOMETRY.shoulder[2], "m", -0.045, -0.02, "up")


@parameter_tree
class Hip:
    """Axis of the left hip from the spine end; the right one mirrors x."""

    x: Any = quantity(BODY_GEOMETRY.hip[0], "m", 0.03, 0.06, "to the left")
    y: Any = quantity(BODY_GEOMETRY.hip[1], "m", -0.005, 0.025, "backward")
    z: Any = quantity(BODY_GEOMETRY.hip[2], "m", -0.022, 0.002, "up")


@parameter_tree
class Foot:
    """All feet."""

    radius: Any = quantity(FOOT_RADIUS, "m", 0.001, 0.005, "of the sole, a sphere")


@parameter_tree
class SpineLengths:
    """The spine's joints and its servo."""

    segment: Any = quantity(
        2 * SPINE_GEOMETRY.dh[SEGMENT_ROWS[0]][1],
        "m",
        0.01,
        0.022,
        "one lateral joint to the next; behind the third 2.2 mm more",
    )
    pulley_radius: Any = quantity(
        SPINE_GEOMETRY.pulley_radius, "m", 0.004, 0.008, "of the spine servo's pulley"
    )


@parameter_tree
class TailPlacement:
    """The tail, which is moved and stretched as a whole; its segments stay as wide as they are."""

    y: Any = quantity(
        TAIL_GEOMETRY.position[0], "m", 0.04, 0.075, "first joint behind the last one of the spine"
    )
    z: Any = quantity(TAIL_GEOMETRY.position[1], "m", -0.032, -0.012, "the same, up")
    length: Any = quantity(
        TAIL_GEOMETRY.length, "m", 0.05, 0.2, "first joint to the centre of the tip, backward"
    )


@parameter_tree
class Geometry:
    """Lengths and positions that may differ between worlds."""

    front_leg: FrontLeg = group(FrontLeg)
    rear_leg: RearLeg = group(RearLeg)
    shoulder: Shoulder = group(Shoulder)
    hip: Hip = group(Hip)
    foot: Foot = group(Foot)
    spine: SpineLengths = group(SpineLengths)
    tail: TailPlacement = group(TailPlacement)


def geometry_of(params: Any) -> Geometry:
    """The geometry in a set of parameters, such as a controller's; the published one if they contain none."""
    geometry: Geometry = getattr(params, "geometry", None) or Geometry()
    return geometry


def names_geometry(names: Iterable[str]) -> bool:
    """Whether any of these parameters is a length or a position."""
    return any(name.startswith("geometry.") for name in names)


def check_geometry(geometry: Geometry) -> None:
    """Reject a geometry whose parts overlap; `control.controller.check_workspace` checks the legs' reach.

    Args:
        geometry: not traced; leaves of shapes that broadcast.

    Raises:
        ParameterError: with the numbers of the first such world.
    """
    for pair, leg in (("front", geometry.front_leg), ("rear", geometry.rear_leg)):
        tied, length = _first(leg.attachment, leg.lower, lambda tied, length: tied > length)
        if tied:
            raise ParameterError(
                f"geometry.{pair}_leg.attachment is {tied:g} m: the tendon would be tied beyond the ankle; allowed is "
                f"at most geometry.{pair}_leg.lower, {length:g} m."
            )
    inside = SERVO_INSET + SERVO_DEPTH + PULLEY_RIM
    lateral_offset, radius = _first(
        geometry.hip.x, geometry.spine.pulley_radius, lambda x, radius: x < inside + radius
    )
    if lateral_offset:
        raise ParameterError(
            f"geometry.hip.x is {lateral_offset:g} m: the hips' servos would overlap the spine's pulley, whose radius is "
            f"{radius:g} m; allowed is at least {inside + radius:g} m."
        )


def _first(
    first_values: Any, second_values: Any, wrong: Callable[[Any, Any], Any]
) -> tuple[float, float]:
    """The first invalid pair of numbers; zeros if all are valid."""
    first_values, second_values = (
        np.ravel(values)
        for values in np.broadcast_arrays(
            np.asarray(first_values, float), np.asarray(second_values, float)
        )
    )
    (indices,) = np.nonzero(wrong(first_values, second_values))
    return (
        (float(first_values[indices[0]]), float(second_values[indices[0]]))
        if len(indices)
        else (0.0, 0.0)
    )


def leg_geometry(geometry: Geometry, pair: str, xp: Any = math) -> LegGeometry:
    """The numbers of a leg of the pair `front` or `rear`, with the links of `geometry`, of the type that they have
    there.

    The tendon's length follows the leg: at servo angle 0 the knee has the same angle as on the published robot.

    Args:
        geometry: leaves may have leading axes where `xp` allows them.
        pair: of legs.
        xp: `math`, `numpy` or `jax.numpy`.
    """
    leg: LegGeometry = LEGS[pair]
    links = geometry.front_leg if pair == "front" else geometry.rear_leg
    cosine = (leg.tendon_length**2 - leg.l1**2 - leg.l2**2) / (2 * leg.l1 * leg.l2)

    def squared(l1: Any, l2: Any) -> Any:
        return l1**2 + l2**2 + 2 * l1 * l2 * cosine

    stretch = xp.sqrt(squared(links.upper, links.attachment) / squared(leg.l1, leg.l2))
    return dataclasses.replace(
        leg,
        l1=links.upper,
        l2=links.attachment,
        l3=links.lower,
        l4=links.foot,
        tendon_length=leg.tendon_length * stretch,
    )


def dh_table(geometry: Geometry) -> list[tuple[float, Any, float, float]]:
    """Rows (alpha_prev [rad], a_prev [m], theta [rad], d [m]) of Table 5.3, with the geometry's spine segment."""
    longer = geometry.spine.segment / 2 - SPINE_GEOMETRY.dh[SEGMENT_ROWS[0]][1]
    return [
        (alpha, a + longer if i in SEGMENT_ROWS else a, theta, d)
        for i, (alpha, a, theta, d) in enumerate(SPINE_GEOMETRY.dh)
    ]


# ---
# Closed forms in a leg's sagittal plane, for both NumPy and JAX, shared by assembly and kinematics.
#
# Coordinates (y, z) and angles are those of `kinematics.leg`. A leg is anything with the fields of `LegGeometry`.


#: Lower limit of lengths in denominators [m].
SMALLEST_LENGTH_METRES: Final = 1e-4


def check_routing(routing: str) -> None:
    """Raise `ParameterError` unless `routing` is one of `ROUTINGS`."""
    choice("routing", routing, ROUTINGS)


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
        return xp.sqrt(xp.maximum(squared, SMALLEST_LENGTH_METRES**2))
    hip = leg.knee_direction * q1
    y = leg.l1 * xp.sin(hip) + leg.l2 * xp.sin(hip + knee_angle)
    z = -leg.l1 * xp.cos(hip) - leg.l2 * xp.cos(hip + knee_angle)
    if routing == "type2":
        guide = xp.asarray(leg.guide)
        y, z = y - leg.knee_direction * guide[..., 0], z - guide[..., 1]
        return xp.sqrt(xp.maximum(y**2 + z**2, SMALLEST_LENGTH_METRES**2))
    if routing == "type3_idler":
        y, down, radius = -y, -z, IDLER_RADIUS
    else:
        down, radius = leg.pulley_height - z, leg.pulley_radius
    outside = y**2 + down**2 > radius**2 + SMALLEST_LENGTH_METRES**2
    y, down = xp.where(outside, y, 0.0), xp.where(outside, down, radius + 1.0)
    tangent = xp.sqrt(y**2 + down**2 - radius**2)
    # theta_2 = atan(l_t/r_p) - th_s of the spiral model; th_s = pi/2 - atan2(y, down) puts its cut above the pulley.
    wrap = xp.arctan2(tangent, radius) - math.pi / 2 + xp.arctan2(y, down)
    length = tangent - radius * wrap
    if (
        routing == "type3_idler"
    ):  # behind which B may pull it straight, from where it crosses the leg's axis
        height = lead_height(leg)
        touch = xp.arcsin(IDLER_RADIUS / height)
        straight = (
            xp.sqrt(y**2 + (down + height) ** 2) - xp.sqrt(height**2 - radius**2) - radius * touch
        )
        length = xp.where(wrap > touch, straight, length)
    return xp.where(outside, length, 0.0)


def standing(leg: LegGeometry, routing: str) -> tuple[float, float, float]:
    """Hip, knee and pulley angle [rad] that put the foot of one leg at its `neutral_foot`, the tendon just taut.

    O-A-H is a planar two-link arm: the cosine rule, as in `kinematics.leg.inverse_kinematics`.
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
    )
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
    return math.sqrt(distance**2 - radius**2), math.atan2(point[1], point[0]) + turn * math.acos(
        radius / distance
    )
