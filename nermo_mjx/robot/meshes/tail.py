"""The tail: a stem from the hip with the socket of its pulley, and one bead that is scaled along the tail.

In the tail's frames: y along the tail, the tendons beside it.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.robot.meshes.numbers import MM
from nermo_mjx.robot.meshes.shapes import Shape, beam, block, join, rotation, turned_part
from nermo_mjx.robot.parameters import TAIL

#: Spacing of the joints, and distance of the first eyelets from the middle [mm].
SPACING: Final = MM * TAIL.spacing
BESIDE: Final = MM * TAIL.eyelet
#: The stem, from the rump to the fork around the pulley: y, middle z, half-width, half-height [mm].
STEM: Final = ((-19.0, 0.4, 6.0, 3.0), (-10.0, 0.2, 4.8, 2.8), (-2.0, 0.0, 4.0, 2.6))


def tail_shapes() -> dict[str, Shape]:
    """Meshes of the tail, by file name."""
    return {"tail_base": base(), "tail_segment": segment()}


def segment() -> Shape:
    """A bead from joint to joint, with an eyelet for a tendon on each side."""
    end = SPACING - 0.4
    bead = _along([(0.4, 2.8), (0.9, 3.4), (2.8, 3.75), (5.4, 3.2), (end - 0.4, 2.6), (end, 2.0)], 12)
    bar = block((-BESIDE - 1.0, 3.1, -0.9), (BESIDE + 1.0, 4.9, 0.9), 0.45)
    return join(bead, bar)


def base() -> Shape:
    """The stem, the fork around the pulley, and the collar from which the tail comes."""
    collar = _along([(6.9, 5.0), (7.6, 5.6), (10.6, 5.6), (11.6, 4.4)], 16)
    eyelet = _along([(9.0, 1.1), (11.0, 1.1)], 8)
    cheeks = [block((-4.0, -3.0, z - 0.7), (4.0, 9.5, z + 0.7), 0.4) for z in (-2.6, 2.6)]
    return join(collar, eyelet.moved(x=BESIDE), eyelet.moved(x=-BESIDE), beam(STEM, 1.2), *cheeks)


def _along(profile: list[tuple[float, float]], sides: int) -> Shape:
    return turned_part(profile, sides).transformed(rotation("z", np.pi / 2))
