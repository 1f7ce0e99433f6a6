"""Motion of the robot's eyes: yaw and pitch of its head, and the speed of the image; part of the metrics.

The head's attitude is the torso's, turned by the neck, and on Nermo 4.1 tilted by the head's servo. Distant objects
move across the centre of an image as fast as the head turns about its own vertical and lateral axes; a head that
rolls rotates the image about its centre.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.control.head_and_tail import wrapped
from nermo_mjx.kinematics.body import attitude, turned_back
from nermo_mjx.robot import SERVOS, Sensors
from nermo_mjx.robot.parameters import servos_by_count
from nermo_mjx.rollout.path_metrics import root
from nermo_mjx.shapes import Array, Quaternion, Scalar, Spatial

_NECK = SERVOS.index("neck")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EyeState:
    """Accumulators of one world.

    Attributes:
        angles: pitch and yaw of the head at the last tick [rad]; yaw is unwrapped.
        mean, square: Welford's running mean and sum of squared deviations of the angles.
    """

    angles: Float[Array, " 2"]
    mean: Float[Array, " 2"]
    square: Float[Array, " 2"]


def init_eye(sensors: Sensors) -> EyeState:
    """Accumulators before the first tick, from the readings at rest."""
    angles = attitude(head_orientation(sensors))[1:]
    zero = jnp.zeros_like(angles)
    return EyeState(angles, zero, zero)


def update_eye(state: EyeState, sensors: Sensors, weight: Scalar, share: Scalar) -> EyeState:
    """Add one tick, by its last readings, with the length of its measured part [s] and that part's share of the time
    measured so far."""
    angles = state.angles + wrapped(attitude(head_orientation(sensors))[1:] - state.angles)
    deviation = angles - state.mean
    mean = state.mean + share * deviation
    square = state.square + weight * deviation * (angles - mean)
    return EyeState(angles, mean, square)


def eye_result(state: EyeState, time: Scalar) -> dict[str, Scalar]:
    """The metrics by name; `time` is the measured time [s]."""
    metrics: dict[str, Scalar] = {}
    for i, angle in enumerate(("pitch", "yaw")):
        metrics |= {
            f"head_{angle}_mean": state.mean[i],
            f"head_{angle}_std": root(state.square[i] / time),
        }
    return metrics


def head_orientation(sensors: Sensors) -> Quaternion:
    """Attitude of the head (w, x, y, z): the torso's, turned about its vertical axis by the neck, then tilted."""
    half = 0.5 * sensors.servo_angle[..., _NECK]
    c, s = jnp.cos(half), jnp.sin(half)
    w, x, y, z = (sensors.orientation[..., i] for i in range(4))
    panned = jnp.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], axis=-1)
    tilt = _tilt_servo(sensors)
    if tilt is None:
        return panned
    half = 0.5 * sensors.servo_angle[..., tilt]
    c, s = jnp.cos(half), jnp.sin(half)
    w, x, y, z = (panned[..., i] for i in range(4))
    return jnp.stack([w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s], axis=-1)


def _tilt_servo(sensors: Sensors) -> int | None:
    """Index of the servo that tilts the head; None if there is none."""
    names = servos_by_count(sensors.servo_angle.shape[-1])
    return names.index("head") if "head" in names else None


def head_rate(sensors: Sensors) -> Spatial:
    """Angular velocity of the head in its own frame [rad/s]: the gyro's, the neck's, and that of the tilt."""
    half = 0.5 * sensors.servo_angle[..., _NECK]
    zeros = jnp.zeros_like(half)
    torso_rate = turned_back(
        jnp.stack([jnp.cos(half), zeros, zeros, jnp.sin(half)], axis=-1), sensors.gyro
    )
    panned = torso_rate + jnp.stack([zeros, zeros, sensors.servo_velocity[..., _NECK]], axis=-1)
    tilt = _tilt_servo(sensors)
    if tilt is None:
        return panned
    half = 0.5 * sensors.servo_angle[..., tilt]
    torso_rate = turned_back(
        jnp.stack([jnp.cos(half), jnp.sin(half), zeros, zeros], axis=-1), panned
    )
    return torso_rate + jnp.stack([sensors.servo_velocity[..., tilt], zeros, zeros], axis=-1)
