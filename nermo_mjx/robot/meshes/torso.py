"""The chest: a back beam and a breastbone joined by flexible ribs, electronics inside, the shoulders' bracket ahead.

In the torso's frame, the spine base: x left, y back, z up.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.meshes.numbers import MM, SERVO_WIDTH
from nermo_mjx.robot.meshes.servo import BEFORE, BEHIND
from nermo_mjx.robot.meshes.shapes import Shape, beam, block, join, loft, rounded_rectangle, tube, turned_part
from nermo_mjx.robot.parameters import BODY, FRONT_LEG

#: Where the neck's servo turns the head [mm].
NECK: Final = tuple(MM * value for value in BODY.neck)
#: The back beam: y, middle z, half-width, half-height [mm].
BEAM: Final = (
    (-2.0, -0.6, 5.2, 3.0), (-9.0, -1.8, 4.4, 2.4), (-24.0, -4.4, 3.8, 2.0), (-44.0, -7.4, 4.0, 2.0),
    (-62.0, -10.2, 5.2, 2.2), (-74.0, -12.0, 6.0, 2.2),
)  # fmt: skip
#: The breastbone, likewise.
BREASTBONE: Final = (
    (-11.0, -44.5, 1.6, 1.1), (-17.0, -46.3, 2.6, 1.1), (-34.0, -49.8, 3.2, 1.1), (-50.0, -49.6, 3.6, 1.1),
    (-60.0, -44.0, 4.0, 1.1), (-63.0, -38.0, 4.0, 1.1),
)  # fmt: skip
#: Ribs: y at the back beam, half-width, lowest z, and how far its breastbone end lies in front of its back end [mm].
RIBS: Final = (
    (-13.0, 19.5, -45.5, 3.0),
    (-21.5, 21.8, -48.5, 2.5),
    (-30.0, 22.8, -50.0, 2.0),
    (-38.5, 22.6, -50.5, 1.5),
)


def torso_shapes(geometry: Geometry) -> dict[str, Shape]:
    """Meshes of the torso, by file name."""
    return {
        "torso_frame": frame(geometry),
        "torso_ribs": join(*(rib(*numbers) for numbers in RIBS)),
        "torso_board": board(),
        "torso_chips": chips(),
        "torso_battery": battery(),
    }


def back(y: float) -> float:
    """Height of the back beam's middle at y [mm]."""
    stations = np.array(BEAM)[::-1]
    return float(np.interp(y, stations[:, 0], stations[:, 1]))


def rib(y: float, width: float, bottom: float, forward: float) -> Shape:
    """A closed hoop of flat strip from the back beam around to the breastbone."""
    top = back(y) - 0.4
    t = 2 * np.pi * np.arange(24) / 24
    middle, half = (top + bottom) / 2, (top - bottom) / 2
    x = width * np.sign(np.sin(t)) * np.abs(np.sin(t)) ** 0.8
    path = np.column_stack([x, y - forward * (1 - np.cos(t)) / 2, middle + half * np.cos(t)])
    return tube(path, (1.6, 0.7), 4, up=(0.0, 1.0, 0.0), closed=True)


def frame(geometry: Geometry) -> Shape:
    """Back beam with its crests, breastbone, and the bracket that holds four servos and the neck's."""
    crests = [crest(y) for y in (*(numbers[0] for numbers in RIBS), -47.0, -55.0)]
    return join(beam(BEAM, 1.0), *crests, beam(BREASTBONE, 0.5), *shoulders(geometry))


def crest(y: float) -> Shape:
    """A fin on the back beam, where a rib is clamped."""
    rings = []
    for up, reach, width, lean in ((0.5, 2.6, 2.0, 0.0), (2.6, 2.0, 1.4, 0.5), (4.4, 1.0, 0.8, 1.6)):
        section = rounded_rectangle(width, reach, 0.5)
        rings.append(np.column_stack([section[:, 0], section[:, 1] + y + lean, np.full(8, back(y) + up)]))
    return loft(rings)


def shoulders(geometry: Geometry) -> list[Shape]:
    """The bracket between and around the stacked servos of both front legs."""
    place = geometry.shoulder
    x, y, z = (MM * float(value) for value in (place.x, place.y, place.z))
    upper = z + MM * FRONT_LEG.pulley_height
    w, low, high = SERVO_WIDTH / 2, y - BEFORE, y + BEHIND
    side = x - 5.0
    plates = [
        block((-side, low + 0.8, upper + w), (side, high - 0.8, upper + w + 1.4), 0.5),
        block((-side, low + 0.8, z + w), (side, high - 0.8, upper - w), 0.4),
        block((-side, low + 0.8, z - w - 1.4), (side, high - 0.8, z - w), 0.5),
    ]
    core = block((-13.6, low, z - w - 1.0), (13.6, high, upper + w + 1.0), 1.0)
    post = block((-5.6, low - 1.5, upper + w - 1.0), (5.6, high, back(-60.0) + 1.0), 1.0)
    # The neck's servo stands upright before the bracket; its clamp reaches around it.
    clamp = block((-7.0, NECK[1] - 8.0, NECK[2] - 17.0), (7.0, low + 2.0, NECK[2] - 8.5), 1.2)
    collar = turned_part([(-2.2, 7.2), (-1.7, 7.6), (-0.5, 7.6), (0.0, 7.0)], 18)
    return [*plates, core, post, clamp, Shape(collar.vertices[:, [1, 2, 0]] + NECK, collar.faces)]


def board() -> Shape:
    """The circuit board across the chest."""
    return block((-13.5, -47.0, -24.2), (13.5, -12.0, -22.8), 0.3)


def chips() -> Shape:
    """The components on the board."""
    return join(
        block((-5.0, -33.0, -23.0), (5.0, -23.0, -21.2), 0.3),
        block((-11.5, -44.0, -23.0), (-6.5, -38.0, -21.4), 0.3),
        block((5.0, -45.0, -23.0), (11.5, -38.5, -19.8), 0.4),
        block((-9.0, -17.0, -23.0), (9.0, -13.2, -19.6), 0.4),
        block((8.0, -34.0, -23.0), (11.0, -22.0, -21.8), 0.3),
    )


def battery() -> Shape:
    """The pack below the board."""
    return block((-13.0, -46.0, -43.0), (13.0, -12.5, -26.5), 2.0)
