"""Theoretical speeds and turning radii of the publication.

All formulas assume feet that do not slip; `control.turning` and `kinematics` contain them.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from nermo_mjx.control import turning
from nermo_mjx.control.parameters import STEERING, ControlParameters
from nermo_mjx.control.trajectory import neutral_feet
from nermo_mjx.kinematics.body import feet_positions, stride_gain
from nermo_mjx.kinematics.spine import joint_angle, transform
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import SPINE_GEOMETRY

#: Number of times in a stance over which `equal_stride_radius` averages.
_MOMENTS: Final = 41
#: Geometry of the published robot.
_ROBOT: Final = Geometry()
#: The feet of each diagonal, front first, by their indices in `LIMBS`.
_DIAGONALS: Final = ((0, 3), (1, 2))


def speed(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Speed without slip (5.21, 5.22), with the stride lengthened by the spine (5.33) [m/s of simulated time].

    Args:
        values: parameters by name, (n,) each: frequency, gait_factor, stride, stance.max_stride, spine.amplitude and
            tracking.clock_ratio.
    """
    gain = np.asarray(_stride_gain(values["spine.amplitude"]), float)
    stride = values["stride"] * values["stance.max_stride"] + gain
    return values["frequency"] * values["gait_factor"] * stride / values["tracking.clock_ratio"]


def stride_gain_of(servo: float) -> float:
    """Stride gained without slip by swinging the spine by this servo angle [rad] to both sides (5.33) [m]."""
    return float(_stride_gain(servo))


@jax.jit
def _stride_gain(servo: ArrayLike) -> Array:
    return stride_gain(joint_angle(servo, _ROBOT), _ROBOT)


@functools.cache
def theory_radius(steering: str, stride: float = 0.06) -> float:
    """Radius at full lock without slip [m]: (5.40-5.42) for `leg` and `mix`, the shoulder axis (5.43) for `spine`.

    (5.43) assumes shorter steps of the inner feet than of the outer ones, as wheels on two axles do; the strides of
    spine-based turning are equal. For those, see `equal_stride_radius`.

    Args:
        steering: of `STEERING`.
        stride: l_s [m].
    """
    legs, spine = STEERING[steering]
    theta_v = spine * SPINE_GEOMETRY.max_joint_angle
    if not legs:
        return float(
            turning.spine_radius(
                jnp.asarray(theta_v), *map(jnp.asarray, turning.spine_lengths(_ROBOT))
            )[0]
        )
    return float(_smallest_radius(stride, theta_v))


@jax.jit
def _smallest_radius(stride: ArrayLike, theta_v: ArrayLike) -> Array:
    return turning.smallest_radius(
        jnp.asarray(stride), ControlParameters().stance, jnp.asarray(theta_v), _ROBOT
    )


@functools.cache
def equal_stride_radius(servo: float, stride: float = 0.06) -> float:
    """Radius of the spine base's path in a trot with a bent spine and four equal strides, with least slip [m].

    Two point feet stand at a time. The front one moves back along the torso, the rear one along the turned hip, at the
    same speed, and the body moves so that the sum of their squared slip speeds is minimal. Feet whose connecting line
    is not perpendicular to the path can turn the body only by the velocity component across that line: 0.441 m at 0.4
    rad of servo, where (5.43) has 0.281 m. The body's motion is averaged over both diagonals and the stance.

    Args:
        servo: angle of the spine servo, not 0 [rad].
        stride: l_s [m]; it has little effect.
    """
    theta_v = joint_angle(jnp.asarray(servo), _ROBOT)
    back = np.stack([[0.0, 1.0], np.asarray(transform(theta_v, _ROBOT), float)[:2, 1]])
    neutral = np.asarray(neutral_feet(ControlParameters().stance), float)
    motions, moments = [], np.linspace(-0.5, 0.5, _MOMENTS) * stride
    all_feet = feet_positions(
        theta_v, neutral + np.stack([moments, 0.0 * moments], axis=-1)[:, None], _ROBOT
    )
    for feet in np.asarray(all_feet, float)[..., :2]:
        for pair in _DIAGONALS:
            # Rows: speed of a foot on the ground, along x and y, for the body's speeds along x and y and its turn.
            rows = np.array([[[1.0, 0.0, -y], [0.0, 1.0, x]] for x, y in feet[list(pair)]]).reshape(
                4, 3
            )
            motions.append(np.linalg.lstsq(rows, -back.ravel(), rcond=None)[0])
    along_x, along_y, turn = np.mean(motions, axis=0)
    return float(np.hypot(along_x, along_y) / abs(turn))
