"""Numbers that several parts share: units, thicknesses, and poses along the spine."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from nermo_mjx.robot.geometry import Geometry, dh_table

#: Millimetres in a metre: meshes are in millimetres, the robot's numbers in metres.
MM: Final = 1000.0
#: Radius at which the leg's and the spine's tendons are drawn [mm].
TENDON: Final = 0.5
#: The axes of the stacked hip and knee servos are apart by the pulley's height; a servo fills most of it [mm].
SERVO_WIDTH: Final = 11.0


def dh_pose(first: int, last: int, geometry: Geometry) -> Float[np.ndarray, "4 4"]:
    """Pose of DH row `last` seen from row `first` of the straight spine; lengths in mm."""
    pose = np.eye(4)
    for alpha, a, theta, d in dh_table(geometry)[first + 1 : last + 1]:
        ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
        pose = pose @ np.array(
            [
                [ct, -st, 0.0, MM * a],
                [st * ca, ct * ca, -sa, -MM * d * sa],
                [st * sa, ct * sa, ca, MM * d * ca],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    return pose
