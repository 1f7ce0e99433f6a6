"""What the publication's theory predicts for a case: speed, turning radii, and where the centre of mass lies.

All of it assumes feet that do not slip; the formulas are those of `control.turning` and `kinematics`.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from nermo_mjx.control import turning
from nermo_mjx.control.parameters import STEERING, ControlParameters
from nermo_mjx.kinematics.balance import diagonal_distance
from nermo_mjx.kinematics.body import centre_of_mass, feet_positions, stride_gain
from nermo_mjx.kinematics.spine import joint_angle
from nermo_mjx.robot.mass_model import MassModel
from nermo_mjx.robot.parameters import SPINE


def speed(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Speed without slip (5.21, 5.22), with the stride lengthened by the spine (5.33) [m/s of simulated time].

    Args:
        values: parameters by name, (n,) each: frequency, gait_factor, stride, stance.max_stride, spine.amplitude and
            tracking.clock_ratio.
    """
    gain = np.asarray(stride_gain(joint_angle(values["spine.amplitude"])), float)
    stride = values["stride"] * values["stance.max_stride"] + gain
    return values["frequency"] * values["gait_factor"] * stride / values["tracking.clock_ratio"]


def smallest_radius(steering: str, stride: float = 0.06) -> float:
    """Radius at full lock without slip [m]: (5.40-5.42) for `leg` and `mix`, the shoulder axis (5.43) for `spine`."""
    legs, spine = STEERING[steering]
    theta_v = spine * SPINE.max_joint_angle
    if not legs:
        return float(turning.spine_radius(jnp.asarray(theta_v), *map(jnp.asarray, turning.spine_lengths()))[0])
    stance = ControlParameters().stance
    return float(turning.smallest_radius(jnp.asarray(stride), stance, jnp.asarray(theta_v)))


def stability(masses: MassModel, feet: np.ndarray, limb: int, theta_v: float = 0.0) -> float:
    """How far the centre of mass lies inside the triangle that carries when one leg is lifted (5.35) [m].

    Negative: it lies beyond the diagonal, and the robot tips onto the lifted leg.

    Args:
        masses: of the robot.
        feet: (y, z) of each foot from its axis, (4, 2) [m].
        limb: the lifted one, its place in `LIMBS`.
        theta_v: angle of each spine joint [rad].
    """
    ground = np.asarray(feet_positions(theta_v, feet))[..., :2]
    com = np.asarray(centre_of_mass(masses, theta_v))[:2]
    # The other diagonal carries, and the foot diagonally opposite to the lifted one.
    front, rear = (1, 2) if limb in (0, 3) else (0, 3)
    third = ground[3 - limb]
    side = np.sign(diagonal_distance(third, ground[front], ground[rear]))
    return float(side * diagonal_distance(com, ground[front], ground[rear]))
