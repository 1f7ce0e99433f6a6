"""Legs: links with clevis joints, torsion springs at the knees, grooved pulleys and rubber paws.

A left leg in its own frames (x outward): the tendon runs in the plane x = 0, between the two cheeks of the upper leg.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.robot.meshes.numbers import MM, TENDON
from nermo_mjx.robot.meshes.shapes import Shape, ball, block, join, loft, plate, strut, superellipse, tube, turned_part
from nermo_mjx.robot.parameters import FRONT_LEG, REAR_LEG, LegGeometry

#: How much stouter than the front legs the rear legs are.
STOUT: Final = {"front": 1.0, "rear": 1.12}
#: Inner and outer face of a cheek of the upper leg, and half the thickness of the link between the cheeks [mm].
CHEEK: Final = (1.65, 3.1)
TONGUE: Final = 1.35


def leg_shapes() -> dict[str, Shape]:
    """Meshes of both pairs of legs, by file name."""
    shapes = {"leg_pulley": grooved_pulley(MM * FRONT_LEG.pulley_radius, 1.5), "leg_paw": paw()}
    for pair, leg in (("front", FRONT_LEG), ("rear", REAR_LEG)):
        stout = STOUT[pair]
        shapes[f"{pair}_upper"] = upper(leg, stout)
        shapes[f"{pair}_lower"] = lower(leg, stout)
        shapes[f"{pair}_foot"] = foot(leg, stout)
        shapes[f"{pair}_spring"] = knee_spring(leg, stout)
    return shapes


def grooved_pulley(radius: float, half_width: float, tendon: float = TENDON, screws: int = 5) -> Shape:
    """A pulley about the x axis; a tendon of radius `tendon` lies in its groove, its middle at `radius` [mm]."""
    rim, floor, w = radius + 0.8, radius - tendon - 0.1, half_width
    profile = [
        (-w - 0.5, 0.3), (-w - 0.5, 2.4), (-w, 2.8), (-w, 5.2), (-w + 0.35, 5.7), (-w + 0.35, radius - 1.4),
        (-w, radius - 1.1), (-w, rim - 0.15), (-w + 0.2, rim), (-0.55, floor), (0.55, floor),
        (w - 0.2, rim), (w, rim - 0.15), (w, radius - 1.1), (w - 0.35, radius - 1.4), (w - 0.35, 5.7),
        (w, 5.2), (w, 2.8), (w + 0.5, 2.4), (w + 0.5, 0.3),
    ]  # fmt: skip
    angles = 2 * np.pi * np.arange(screws) / screws
    head = turned_part([(-w - 0.3, 0.75), (w + 0.3, 0.75)], 6)
    return join(
        turned_part(np.array(profile) * np.minimum(1.0, [1.0, 1.0]), 28),
        *(head.moved(y=4.0 * np.cos(a), z=4.0 * np.sin(a)) for a in angles),
    )


def upper(leg: LegGeometry, stout: float) -> Shape:
    """From the hip servo's horn to the knee: two cheeks with a bridge between them."""
    length, (near, far) = MM * leg.l1, CHEEK
    outline = strut((0.0, 0.0), (0.0, -length), 3.5 * stout, 2.7 * stout)
    waisted = outline * [[1.0, 1.0]]
    middle = (outline[:, 1] < -2.0) & (outline[:, 1] > 2.0 - length)
    waisted[middle, 0] *= 0.8
    cheeks = [plate(waisted, low, high) for low, high in ((near, far), (-far, -near))]
    # The bridge lies on the side away from the knee's bend, so that the tendon passes.
    bridge = block((-near - 0.4, -0.9, -0.62 * length), (near + 0.4, 0.9, -0.34 * length)).moved(y=0.9 * leg.knee_direction)
    horn = turned_part([(-4.2, 0.3), (-4.2, 3.0), (-far - 0.2, 3.4), (-near, 3.4), (-near, 2.0), (-near + 0.2, 0.3)], 18)
    return join(*cheeks, bridge, horn)


def lower(leg: LegGeometry, stout: float) -> Shape:
    """From the knee to the ankle: a tongue between the cheeks above, a fork below; the tendon is tied at a pin."""
    length, tie = MM * leg.l3, MM * leg.l2
    tongue = plate(strut((0.0, 0.0), (0.0, -length + 4.5), 2.6 * stout, 1.7 * stout), -TONGUE, TONGUE)
    fork = plate(strut((0.0, 5.6 - length), (0.0, -length), 1.8 * stout, 2.0 * stout), 1.1, 2.2, 0.25)
    yoke = block((-2.2, -1.6 * stout, 4.2 - length), (2.2, 1.6 * stout, 7.0 - length), 0.5)
    lug = plate(strut((0.0, -tie), (-1.9 * leg.knee_direction, -tie), 2.0 * stout, 1.4), -TONGUE - 0.25, TONGUE + 0.25)
    return join(tongue, fork, fork.mirrored(), yoke, lug)


def foot(leg: LegGeometry, stout: float) -> Shape:
    """From the ankle into the paw, slimmer where it flexes."""
    length = MM * leg.l4
    stations = ((0.0, 1.9, 1.0), (-2.0, 1.8, 1.0), (-0.35 * length, 1.25, 1.05), (-0.6 * length, 1.2, 1.2), (-length + 1.5, 1.6, 1.9))
    rings = []
    for z, depth, width in stations:
        section = superellipse(width, depth * stout, 3.0, 10)
        rings.append(np.column_stack([section, np.full(10, z)]))
    knuckle = turned_part([(-1.0, 0.4), (-1.0, 1.7 * stout), (-0.8, 1.9 * stout), (0.8, 1.9 * stout), (1.0, 1.7 * stout), (1.0, 0.4)], 16)
    return join(loft(rings), knuckle)


def paw() -> Shape:
    """The rubber sole about its centre: a pad and three toes, 7 mm wide."""
    toes = [ball((x, 0.0, -0.15), (1.35, 2.25, 1.95), 10, 6) for x in (-2.1, 0.0, 2.1)]
    return join(ball((0.0, 0.0, 0.9), (3.0, 2.1, 1.7), 14, 6), *toes)


def knee_spring(leg: LegGeometry, stout: float) -> Shape:
    """A torsion spring on the knee's pin, outside the outer cheek; its end lies along the upper leg."""
    turns, radius, wire, start = 2.6, 2.1 * stout, 0.34, CHEEK[1] + 0.15
    t = np.linspace(0.0, 1.0, int(turns * 12) + 1)
    angle = np.pi / 2 + 2 * np.pi * turns * t * -leg.knee_direction
    coil = np.column_stack([start + wire + 1.25 * t, radius * np.cos(angle), radius * np.sin(angle)])
    leg_end = np.array([[start + wire, 0.35 * leg.knee_direction, 9.0], [start + wire, 0.0, 5.0]]) + [0.0, 0.0, 0.0]
    path = np.concatenate([leg_end, coil + [0.0, 0.0, 0.0]])
    spring = tube(path, (wire, wire), 5, up=(1.0, 0.0, 0.0))
    pin = turned_part([(-CHEEK[1] - 0.5, 0.3), (-CHEEK[1] - 0.5, 1.3), (start + 1.9, 1.3), (start + 2.1, 1.0), (start + 2.1, 0.3)], 12)
    return join(spring, pin).moved(z=0.0)
