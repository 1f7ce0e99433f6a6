"""The hip: the bracket of the rear legs' stacked servos and of the spine's servo, and the tail's support.

In the frame of the spine end: x left, y back, z up.
"""

from __future__ import annotations

import numpy as np

from nermo_mjx.robot.meshes.numbers import MM, SERVO_WIDTH
from nermo_mjx.robot.meshes.servo import BEFORE, BEHIND
from nermo_mjx.robot.meshes.shapes import Shape, block, join, loft, rounded_rectangle
from nermo_mjx.robot.parameters import BODY, REAR_LEG


def hip_shapes() -> dict[str, Shape]:
    """Meshes of the hip, by file name."""
    return {"hip_frame": frame()}


def frame() -> Shape:
    """Plates around the servos, the block between them, and the neck toward the spine."""
    x, y, z = (MM * value for value in BODY.hip)
    upper = z + MM * REAR_LEG.pulley_height
    w, low, high = SERVO_WIDTH / 2, y - BEFORE, y + BEHIND
    side, inner = x - 5.0, x - 23.4
    plates = [block((-side, low + 0.6, z + w), (side, high - 0.6, upper - w), 0.4)]
    plates += [block((-side, low + 0.6, z - w - 1.4), (side, high - 0.6, z - w), 0.5)]
    lids = [block((inner, low + 0.6, upper + w), (side, high - 0.6, upper + w + 1.4), 0.5)]
    walls = [block((inner - 1.2, low, z - w - 1.4), (inner, high, upper + w + 1.4), 0.4)]
    both = [part.with_mirror_image() for part in (*lids, *walls)]
    core = block((-11.0, low + 3.0, z - w - 1.0), (11.0, high + 2.5, z + w + 1.0), 1.2)
    stations = ((0.5, 0.6, 4.0, 3.4), (3.0, -2.2, 5.0, 2.4), (7.0, -4.2, 7.0, 1.8), (11.0, -4.4, 8.0, 1.6))
    neck = loft([np.column_stack([p[:, 0], np.full(8, at), up + p[:, 1]]) for at, up, a, b in stations for p in [rounded_rectangle(a, b, 0.9)]])
    rump = loft(
        [
            np.column_stack([p[:, 0], np.full(8, at), up + p[:, 1]])
            for at, up, a, b in ((20.0, -9.4, 11.0, 6.6), (25.0, -8.6, 10.0, 6.0), (29.5, -7.0, 7.0, 4.6), (32.0, -5.8, 3.6, 2.6))
            for p in [rounded_rectangle(a, b, 2.4)]
        ]
    )
    mast = block((-4.5, 19.5, -6.0), (4.5, 29.0, 3.6), 1.2)
    return join(*plates, *both, core, neck, rump, mast)
