"""Legs: links with clevis joints, torsion springs at the knees, grooved pulleys and rubber paws.

A left leg in its own frames (x outward): the tendon runs in the plane x = 0, between the two cheeks of the upper leg.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.robot.geometry import Geometry, leg_geometry
from nermo_mjx.robot.meshes.numbers import MM, TENDON
from nermo_mjx.robot.meshes.shapes import (
    Shape,
    ball,
    block,
    frame_plate,
    join,
    loft,
    plate,
    strut,
    superellipse,
    tube,
    turned_part,
)
from nermo_mjx.robot.parameters import FRONT_LEG, LEGS, PULLEY_RIM, LegGeometry

#: Ratio of the rear legs' thickness to the front legs'.
STOUT: Final = {"front": 1.0, "rear": 1.12}
#: Inner and outer face of a cheek of the upper leg, and half the thickness of the link between the cheeks [mm].
CHEEK: Final = (1.65, 3.1)
TONGUE: Final = 1.35
#: Half the width of a pulley [mm].
PULLEY_WIDTH: Final = 1.5


def leg_shapes(geometry: Geometry) -> dict[str, Shape]:
    """Meshes of both pairs of legs, by file name."""
    shapes = {"leg_paw": paw()}
    shapes["leg_pulley"] = grooved_pulley(MM * FRONT_LEG.pulley_radius, PULLEY_WIDTH)
    shapes["leg_pulley_holes"] = pulley_holes(MM * FRONT_LEG.pulley_radius, PULLEY_WIDTH)
    for pair in LEGS:
        leg, stout = leg_geometry(geometry, pair), STOUT[pair]
        shapes[f"{pair}_upper"] = upper(leg, stout)
        shapes[f"{pair}_lower"] = lower(leg, stout)
        shapes[f"{pair}_foot"] = foot(leg, stout)
        shapes[f"{pair}_spring"] = knee_spring(leg, stout)
    return shapes


def grooved_pulley(radius: float, half_width: float, tendon: float = TENDON) -> Shape:
    """A pulley about the x axis; a tendon of radius `tendon` lies in its groove, its middle at `radius` [mm]."""
    rim, floor, w = radius + MM * PULLEY_RIM, radius - tendon - 0.1, half_width
    profile = [
        (-w, rim), (-0.55, floor), (0.55, floor), (w - 0.1, rim), (w, radius - 1.0), (w - 0.4, radius - 1.4),
        (w - 0.4, 2.4), (w + 0.4, 2.0),
    ]  # fmt: skip
    return turned_part(profile, 20)


def pulley_holes(radius: float, half_width: float, count: int = 5) -> Shape:
    """Dark discs that look like lightening holes in the pulley and make its rotation visible."""
    middle, size = (radius + 0.9) / 2, (radius - 4.1) / 2.9
    disc = turned_part([(0.0, size), (half_width - 0.36, size)], 8)
    angles = 2 * np.pi * np.arange(count) / count
    return join(*(disc.moved(y=middle * np.cos(a), z=middle * np.sin(a)) for a in angles))


def upper(leg: LegGeometry, stout: float) -> Shape:
    """From the hip servo's horn to the knee: two cheeks with a bridge between them."""
    length, (near, far) = MM * leg.l1, CHEEK
    outline = strut((0.0, 0.0), (0.0, -length), 3.3 * stout, 2.4 * stout)
    window = strut((0.0, -6.2), (0.0, 5.6 - length), 1.5 * stout, 0.9 * stout)
    cheek = frame_plate(outline, window, near, far)
    # The bridge lies on the side away from the tendon.
    bridge = block((-near - 0.3, -0.8, -0.64 * length), (near + 0.3, 0.8, -0.30 * length))
    horn = turned_part([(-4.2, 3.0), (-far - 0.2, 3.3), (-near, 3.3), (-near + 0.2, 2.0)], 16)
    return join(cheek, cheek.mirrored(), bridge.moved(y=-1.5 * leg.knee_direction), horn)


def lower(leg: LegGeometry, stout: float) -> Shape:
    """From the knee to the ankle: a tongue between the cheeks above, a fork below; the tendon is tied to a lug."""
    length, tie, side = MM * leg.l3, MM * leg.l2, leg.knee_direction
    tongue = plate(strut((0.0, 0.0), (0.0, 5.0 - length), 2.2 * stout, 1.5 * stout), -TONGUE, TONGUE)
    fork = plate(strut((0.0, 4.8 - length), (0.0, -length), 1.4 * stout, 1.7 * stout), 1.0, 2.1, 0.25)
    yoke = block((-2.1, -1.35 * stout, 3.6 - length), (2.1, 1.35 * stout, 5.8 - length), 0.4)
    lug = plate(strut((0.0, 0.6 - tie), (1.6 * side, -tie), 1.3, 0.8), -TONGUE + 0.3, TONGUE - 0.3)
    return join(tongue, fork, fork.mirrored(), yoke, lug)


def foot(leg: LegGeometry, stout: float) -> Shape:
    """From the ankle into the paw, slimmer where it flexes."""
    length = MM * leg.l4
    stations = (
        (0.0, 1.9, 1.0),
        (-2.0, 1.8, 1.0),
        (-0.35 * length, 1.25, 1.05),
        (-0.6 * length, 1.2, 1.2),
        (-length + 1.5, 1.6, 1.9),
    )
    rings = []
    for z, depth, width in stations:
        section = superellipse(width, 0.9 * depth * stout, 3.0, 10)
        rings.append(np.column_stack([section, np.full(10, z)]))
    knuckle = turned_part([(-0.95, 1.5 * stout), (-0.75, 1.7 * stout), (0.75, 1.7 * stout), (0.95, 1.5 * stout)], 14)
    return join(loft(rings), knuckle)


def paw() -> Shape:
    """The rubber sole about its centre: a pad and three toes, 7 mm wide."""
    toes = [ball((x, 0.0, -0.3), (1.25, 2.3, 1.75), 8, 5) for x in (-2.15, 0.0, 2.15)]
    return join(ball((0.0, 0.0, 0.5), (3.3, 2.15, 2.1), 10, 5), *toes)


def knee_spring(leg: LegGeometry, stout: float) -> Shape:
    """A torsion spring on the knee's pin, outside the outer cheek; its end lies along the upper leg."""
    turns, radius, wire, start = 3, 2.2 * stout, 0.3, CHEEK[1] + 0.1
    t, side = np.linspace(0.0, 1.0, 8 * turns + 1), leg.knee_direction
    angle = (np.pi if side > 0 else 0.0) + 2 * np.pi * turns * t * side
    coil = np.column_stack([start + wire + 1.3 * t, radius * np.cos(angle), radius * np.sin(angle)])
    end = [start + wire, -radius * side, 8.5 * stout]
    spring = tube(np.concatenate([[end], coil]), (wire, wire), 3, up=(1.0, 0.0, 0.0))
    pin = turned_part([(-CHEEK[1] - 0.4, 1.2), (start + 1.7, 1.2), (start + 1.9, 0.9)], 10)
    return join(spring, pin)
