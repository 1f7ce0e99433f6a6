"""The tail: a socket for its pulley, and one bead that is scaled along the tail.

In the tail's frames: y along the tail, the tendons beside it.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.robot.meshes.leg import grooved_pulley
from nermo_mjx.robot.meshes.shapes import Shape, block, join, rotation, turned_part

#: The pulley's radius, spacing of the joints, and distance of the first eyelets from the middle [mm], as in tail.xml.
PULLEY: Final = 6.5
SPACING: Final = 8.0
BESIDE: Final = 5.5
#: Radius at which the tail's tendons are drawn [mm].
TENDON: Final = 0.45


def tail_shapes() -> dict[str, Shape]:
    """Meshes of the tail, by file name."""
    wheel = grooved_pulley(PULLEY, 1.0, TENDON, screws=4)
    return {"tail_base": base(), "tail_segment": segment(), "tail_pulley": wheel.transformed(rotation("y", -np.pi / 2))}


def segment() -> Shape:
    """A bead from joint to joint, with an eyelet for a tendon on each side."""
    end = SPACING - 0.35
    bead = _along([(0.35, 0.4), (0.35, 2.2), (0.9, 3.4), (2.4, 4.3), (4.2, 4.35), (6.4, 3.7), (end - 0.3, 2.5), (end, 0.4)], 16)
    eyelet = _along([(2.9, 0.4), (2.9, 1.0), (5.1, 1.0), (5.1, 0.4)], 10)
    arm = block((3.0, 3.2, -0.7), (BESIDE, 4.8, 0.7), 0.3)
    return join(bead, *(part.moved(x=BESIDE) for part in (eyelet,)), eyelet.moved(x=-BESIDE), arm, arm.mirrored())


def base() -> Shape:
    """The fork around the pulley, and the collar from which the tail comes."""
    collar = _along([(6.9, 0.5), (6.9, 5.2), (7.6, 5.9), (10.6, 5.9), (11.6, 4.6), (11.8, 0.5)], 20)
    eyelet = _along([(9.0, 0.4), (9.0, 1.1), (11.0, 1.1), (11.0, 0.4)], 10)
    cheeks = [block((-4.0, -3.0, z - 0.7), (4.0, 9.5, z + 0.7), 0.4) for z in (-2.6, 2.6)]
    return join(collar, eyelet.moved(x=BESIDE), eyelet.moved(x=-BESIDE), *cheeks)


def _along(profile: list[tuple[float, float]], sides: int) -> Shape:
    return turned_part(profile, sides).transformed(rotation("z", np.pi / 2))
