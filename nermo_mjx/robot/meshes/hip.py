"""The hip: the bracket of the rear legs' stacked servos and of the spine's servo, and the tail's support.

The frame is that of the spine end: x left, y back, z up.
"""

from __future__ import annotations

from typing import Final

from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.meshes.numbers import MM, SERVO_WIDTH
from nermo_mjx.robot.meshes.servo import BEFORE, BEHIND
from nermo_mjx.robot.meshes.shapes import Shape, beam, block, join
from nermo_mjx.robot.parameters import REAR_LEG

#: The bar toward the spine, and the rump: y, middle z, half-width, half-height [mm].
NECK: Final = ((0.5, 0.6, 4.0, 3.4), (3.0, -2.2, 5.0, 2.4), (7.0, -4.2, 7.0, 1.8), (11.0, -4.4, 8.0, 1.6))
RUMP: Final = ((20.0, -9.4, 11.0, 6.6), (25.0, -8.6, 10.0, 6.0), (29.5, -7.0, 7.0, 4.6), (32.0, -5.8, 3.6, 2.6))


def hip_shapes(geometry: Geometry) -> dict[str, Shape]:
    """Meshes of the hip, by file name."""
    place = geometry.hip
    x, y, z = (MM * float(value) for value in (place.x, place.y, place.z))
    upper = z + MM * REAR_LEG.pulley_height
    w, low, high = SERVO_WIDTH / 2, y - BEFORE, y + BEHIND
    side, inner = x - 5.0, x - 23.4
    bracket = [
        block((-side, low + 0.6, z + w), (side, high - 0.6, upper - w), 0.4),
        block((-side, low + 0.6, z - w - 1.4), (side, high - 0.6, z - w), 0.5),
    ]
    lid = block((inner, low + 0.6, upper + w), (side, high - 0.6, upper + w + 1.4), 0.5)
    wall = block((inner - 1.2, low, z - w - 1.4), (inner, high, upper + w + 1.4), 0.4)
    core = block((-11.0, low + 3.0, z - w - 1.0), (11.0, high + 2.5, z + w + 1.0), 1.2)
    mast = block((-4.5, 19.5, -6.0), (4.5, 29.0, 3.6), 1.2)
    return {
        "hip_bracket": join(*bracket, lid.with_mirror_image(), wall.with_mirror_image()),
        "hip_core": join(core, beam(NECK, 0.9), beam(RUMP, 2.4), mast),
    }
