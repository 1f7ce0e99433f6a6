"""The head: a lofted skull that narrows to the snout, round ears, and two cameras for eyes.

In the head's frame: the neck's axis is z, the head looks along -y.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.interpolate import PchipInterpolator

from nermo_mjx.robot.meshes.numbers import MM
from nermo_mjx.robot.meshes.shapes import Shape, ball, block, join, loft, superellipse, turned_part
from nermo_mjx.robot.nermo_41 import TILT_AXIS
from nermo_mjx.robot.parameters import EYE

#: The skull's sections: y, middle z, half-width, half-height [mm].
SECTIONS: Final = (
    (6.4, 13.6, 1.6, 1.6), (5.6, 13.8, 5.6, 5.2), (2.5, 14.2, 9.6, 8.6), (-4.0, 15.0, 12.6, 11.2),
    (-12.0, 15.4, 13.8, 12.2), (-20.0, 14.8, 12.6, 11.4), (-28.0, 13.0, 9.4, 8.9), (-35.0, 11.7, 6.6, 6.3),
    (-41.0, 11.1, 4.5, 4.3), (-45.2, 11.0, 2.9, 2.8), (-46.6, 11.0, 1.2, 1.2),
)  # fmt: skip
RINGS: Final = 14
SIDES: Final = 20
#: The left ear: middle [mm], radius, and its angles outward and backward [rad].
EAR: Final = (12.6, -2.5, 28.0)
EAR_RADIUS: Final = 8.6
EAR_OUT: Final = 0.38
EAR_BACK: Final = 0.18


def head_shapes() -> dict[str, Shape]:
    """Meshes of the head, by file name."""
    return {
        "head_skull": skull(),
        "head_ears": ear(lining=False).with_mirror_image(),
        "head_linings": ear(lining=True).with_mirror_image(),
        "head_cameras": camera().with_mirror_image(),
        "head_rings": ring().with_mirror_image(),
        "head_lenses": lens().with_mirror_image(),
        "head_bracket": bracket(),
        "head_nose": ball((0.0, -46.2, 11.6), (2.3, 1.7, 1.7), 12, 6),
    }


def skull() -> Shape:
    """The shell, and the neck that carries it."""
    stations = np.array(SECTIONS)[::-1]
    smooth = PchipInterpolator(np.arange(len(stations)), stations)
    rings = []
    for y, z, w, h in smooth(np.linspace(0.0, len(stations) - 1, RINGS)):
        section = superellipse(w, h, 2.25, SIDES)
        rings.append(np.column_stack([section[:, 0], np.full(SIDES, y), section[:, 1] + z]))
    neck = turned_part([(0.3, 6.4), (1.2, 6.8), (2.0, 5.2), (8.0, 5.6)], 16)
    return join(loft(rings), Shape(neck.vertices[:, [1, 2, 0]], neck.faces))


def bracket() -> Shape:
    """The bracket of Nermo 4.1 that pans, in the frame of the neck: a disc, a post behind the skull, and its axle."""
    _, y, z = (MM * each for each in TILT_AXIS)
    disc = turned_part([(0.0, 7.0), (2.2, 7.0)], 12)
    disc = Shape(disc.vertices[:, [1, 2, 0]], disc.faces)
    post = block((-3.6, y + 3.2, 1.0), (3.6, y + 6.6, z + 3.6), 0.6)
    axle = turned_part([(-10.4, 2.7), (10.4, 2.7)], 10).moved(y=y, z=z)
    arm = block((-3.0, y - 2.0, z - 2.4), (3.0, y + 4.0, z + 2.4), 0.5)
    return join(disc, post, axle, arm)


def ear(lining: bool) -> Shape:
    """A thin dish that opens forward; `lining` is its inside."""
    r = EAR_RADIUS
    if lining:
        profile = [(1.0, 0.84 * r), (1.9, 0.84 * r), (1.15, 0.45 * r)]
    else:
        profile = [(-0.6, 0.25 * r), (0.3, 0.85 * r), (1.5, r), (2.1, 0.96 * r), (0.5, 0.8 * r)]
    dish = turned_part(profile, 20)
    dish = Shape(dish.vertices * [1.0, 1.0, 1.06], dish.faces)
    # From the lathe's x axis to -y, then outward and back.
    return dish.turned("z", -np.pi / 2).turned("x", -EAR_BACK).turned("z", EAR_OUT).moved(*EAR)


def camera() -> Shape:
    """The barrel that sits in the skull."""
    return _at_eye(turned_part([(-6.0, 3.7), (0.4, 4.1)], 16))


def ring() -> Shape:
    """The ring around the lens."""
    return _at_eye(turned_part([(0.0, 4.35), (0.7, 4.35), (1.15, 4.0), (1.15, 3.4), (0.6, 3.1)], 16))


def lens() -> Shape:
    """The glass dome."""
    t = np.linspace(0.25, np.pi / 2, 4)[::-1]
    profile = [*((0.2 + 1.7 * np.cos(a), 3.25 * np.sin(a)) for a in t)]
    return _at_eye(turned_part(profile, 14))


def _at_eye(shape: Shape) -> Shape:
    turned = shape.turned("z", -np.pi / 2).turned("x", -EYE.up).turned("z", EYE.outward)
    return turned.moved(*(MM * each for each in EYE.place))
