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

import numpy as np

from nermo_mjx.robot.parameters import (
    BODY,
    FOOT_RADIUS,
    FRONT_LEG,
    LEGS,
    PULLEY_RIM,
    REAR_LEG,
    SERVO_DEPTH,
    SERVO_INSIDE,
    SPINE,
    TAIL,
    LegGeometry,
)
from nermo_mjx.robot.quantity import ParameterError, group, parameter_tree, quantity

#: Rows of the DH table that lead from one lateral joint to the next; each covers half a segment.
SEGMENT_ROWS: Final = range(SPINE.lateral_joints[0] + 1, SPINE.lateral_joints[-1] + 1)


def _link(length: float, doc: str) -> Any:
    return quantity(length, "m", round(0.6 * length, 4), round(1.6 * length, 4), doc)


@parameter_tree
class FrontLeg:
    """Links of both front legs, in their sagittal plane."""

    upper: Any = _link(FRONT_LEG.l1, "l1, shoulder to knee")
    attachment: Any = _link(FRONT_LEG.l2, "l2, knee to where the tendon is tied; at most to the ankle")
    lower: Any = _link(FRONT_LEG.l3, "l3, knee to ankle")
    foot: Any = _link(FRONT_LEG.l4, "l4, ankle to the sole's centre")


@parameter_tree
class RearLeg:
    """Links of both rear legs, in their sagittal plane."""

    upper: Any = _link(REAR_LEG.l1, "l1, hip to knee")
    attachment: Any = _link(REAR_LEG.l2, "l2, knee to where the tendon is tied; at most to the ankle")
    lower: Any = _link(REAR_LEG.l3, "l3, knee to ankle")
    foot: Any = _link(REAR_LEG.l4, "l4, ankle to the sole's centre")


@parameter_tree
class Shoulder:
    """Axis of the left shoulder from the spine base; the right one mirrors x."""

    x: Any = quantity(BODY.shoulder[0], "m", 0.03, 0.06, "to the left")
    y: Any = quantity(BODY.shoulder[1], "m", -0.085, -0.04, "backward")
    z: Any = quantity(BODY.shoulder[2], "m", -0.045, -0.02, "up")


@parameter_tree
class Hip:
    """Axis of the left hip from the spine end; the right one mirrors x."""

    x: Any = quantity(BODY.hip[0], "m", 0.03, 0.06, "to the left")
    y: Any = quantity(BODY.hip[1], "m", -0.005, 0.025, "backward")
    z: Any = quantity(BODY.hip[2], "m", -0.022, 0.002, "up")


@parameter_tree
class Foot:
    """All feet."""

    radius: Any = quantity(FOOT_RADIUS, "m", 0.001, 0.005, "of the sole, a sphere")


@parameter_tree
class SpineLengths:
    """The spine's joints and its servo."""

    segment: Any = quantity(
        2 * SPINE.dh[SEGMENT_ROWS[0]][1],
        "m",
        0.01,
        0.022,
        "one lateral joint to the next; behind the third 2.2 mm more",
    )
    pulley_radius: Any = quantity(SPINE.pulley_radius, "m", 0.004, 0.008, "of the spine servo's pulley")


@parameter_tree
class TailLength:
    """The tail, which is stretched as a whole; its segments stay as wide as they are."""

    length: Any = quantity(TAIL.length, "m", 0.05, 0.2, "first joint to the centre of the tip, backward")


@parameter_tree
class Geometry:
    """Lengths and positions that may differ between worlds."""

    front_leg: FrontLeg = group(FrontLeg)
    rear_leg: RearLeg = group(RearLeg)
    shoulder: Shoulder = group(Shoulder)
    hip: Hip = group(Hip)
    foot: Foot = group(Foot)
    spine: SpineLengths = group(SpineLengths)
    tail: TailLength = group(TailLength)


def geometry_of(params: Any) -> Geometry:
    """The geometry in a set of parameters, such as a controller's; the published one if they contain none."""
    geometry: Geometry = getattr(params, "geometry", None) or Geometry()
    return geometry


def names_geometry(names: Iterable[str]) -> bool:
    """Whether any of these parameters is a length or a position."""
    return any(name.startswith("geometry.") for name in names)


def check_geometry(geometry: Geometry) -> None:
    """Reject a geometry whose parts overlap; `control.build.check_workspace` checks the legs' reach.

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
    inside = SERVO_INSIDE + SERVO_DEPTH + PULLEY_RIM
    beside, radius = _first(geometry.hip.x, geometry.spine.pulley_radius, lambda x, radius: x < inside + radius)
    if beside:
        raise ParameterError(
            f"geometry.hip.x is {beside:g} m: the hips' servos would overlap the spine's pulley, whose radius is "
            f"{radius:g} m; allowed is at least {inside + radius:g} m."
        )


def _first(one: Any, other: Any, wrong: Callable[[Any, Any], Any]) -> tuple[float, float]:
    """The first invalid pair of numbers; zeros if all are valid."""
    one, other = (np.ravel(each) for each in np.broadcast_arrays(np.asarray(one, float), np.asarray(other, float)))
    (found,) = np.nonzero(wrong(one, other))
    return (float(one[found[0]]), float(other[found[0]])) if len(found) else (0.0, 0.0)


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
        leg, l1=links.upper, l2=links.attachment, l3=links.lower, l4=links.foot,
        tendon_length=leg.tendon_length * stretch,
    )  # fmt: skip


def dh_table(geometry: Geometry) -> list[tuple[float, Any, float, float]]:
    """Rows (alpha_prev [rad], a_prev [m], theta [rad], d [m]) of Table 5.3, with the geometry's spine segment."""
    longer = geometry.spine.segment / 2 - SPINE.dh[SEGMENT_ROWS[0]][1]
    return [
        (alpha, a + longer if i in SEGMENT_ROWS else a, theta, d) for i, (alpha, a, theta, d) in enumerate(SPINE.dh)
    ]
