"""The interface between controller and robot: sensor readings in, servo angles out."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.robot.parameters import LIMBS
from nermo_mjx.shapes import Array, PerLimb, Quaternion, Scalars, Spatial

#: Servos in the order of `ctrl`: the tail's exists only with the articulated tail, the last two only on Nermo 4.1
#: (`Robot.servos` names those of one robot).
SERVOS: Final = (
    *(f"{limb}_hip" for limb in LIMBS), *(f"{limb}_knee" for limb in LIMBS), "spine", "neck", "tail", "spine_vertical",
    "head",
)  # fmt: skip

#: The servos that a robot lacks, by its number of servos.
_LACKING: Final = {10: ("tail", "spine_vertical", "head"), 11: ("spine_vertical", "head"), 12: ("tail",)}

#: Range of each servo [rad], by kind of servo. A knee's is limited to what its tendon can follow: the wrap stays
#: between 40 and 175 degrees.
SERVO_RANGE: Final = {
    "hip": (-1.6, 1.6), "front_knee": (-1.25, 1.25), "rear_knee": (-0.8, 1.55), "spine": (-0.6, 0.6),
    "neck": (-1.0, 1.0), "tail": (-1.0, 1.0), "spine_vertical": (-0.6, 0.6), "head": (-1.0, 1.0),
}  # fmt: skip


#: The same with routing type 1, whose servo angle includes the tendon's wrap angle, and with an idler, which turns it
#: by a quarter of the hip's angle.
KNEE_RANGE: Final = {
    "type1": {"front_knee": (1.3, 2.8), "rear_knee": (-2.6, -0.35)},
    "type3_idler": {"front_knee": (-1.1, 1.3), "rear_knee": (-0.8, 1.7)},
}


def servos_by_count(count: int) -> tuple[str, ...]:
    """Names of the servos of a robot with this number of them, which is all that a recording knows.

    >>> servos_by_count(12)[8:]
    ('spine', 'neck', 'spine_vertical', 'head')
    """
    return tuple(servo for servo in SERVOS if servo not in _LACKING.get(count, ()))[:count]


def servo_range(servo: str, routing: str = "type3") -> tuple[float, float]:
    """The range of one of `SERVOS` [rad]; commands outside it saturate."""
    kind = servo.replace("left_", "").replace("right_", "")
    ranges = SERVO_RANGE | KNEE_RANGE.get(routing, {})
    return ranges["hip" if kind.endswith("hip") else kind]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ServoAngles:
    """Commanded servo angles [rad], in the published servo convention.

    Attributes:
        hip: q1 of each limb, 0 straight down, positive swings the leg backward.
        knee: q2 of each limb, the angle of the pulley.
        spine: positive turns left.
        neck: positive looks left.
        tail: positive bends the tail's tip to the left.
        spine_vertical: of Nermo 4.1; positive lifts the hip, which extends the spine.
        head: of Nermo 4.1; positive tilts the nose down.
    """

    hip: PerLimb
    knee: PerLimb
    spine: Scalars
    neck: Scalars
    tail: Scalars
    spine_vertical: Scalars | float = 0.0
    head: Scalars | float = 0.0

    def vector(self, servos: Sequence[str]) -> Float[Array, "*batch n"]:
        """The `ctrl` vector of a robot with these servos, `Robot.servos`."""
        legs = 2 * len(LIMBS)
        single = [jnp.broadcast_to(jnp.asarray(getattr(self, name)), self.hip.shape[:-1]) for name in servos[legs:]]
        return jnp.concatenate([self.hip, self.knee, jnp.stack(single, axis=-1)], axis=-1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sensors:
    """Readings of the robot's sensors, from before the physics' last substep.

    Attributes:
        position: IMU in the world [m].
        orientation: IMU quaternion (w, x, y, z); the identity is upright, heading -y.
        linear_velocity: of the IMU in the world [m/s].
        gyro: angular velocity in the IMU's frame [rad/s].
        accelerometer: in the IMU's frame [m/s^2].
        servo_angle, servo_velocity, servo_torque: in the order of `Robot.servos` [rad, rad/s, N m].
        knee_angle: theta_1 of each limb, 0 stretched [rad].
        foot_force: normal contact force of each foot [N].
        foot_position, foot_velocity: of each foot H in the world [m, m/s] (for metrics, not for the controller).
        tail_force: normal contact force of the tail on the ground [N].
    """

    position: Spatial
    orientation: Quaternion
    linear_velocity: Spatial
    gyro: Spatial
    accelerometer: Spatial
    servo_angle: Float[Array, "*batch n"]
    servo_velocity: Float[Array, "*batch n"]
    servo_torque: Float[Array, "*batch n"]
    knee_angle: PerLimb
    foot_force: PerLimb
    foot_position: Float[Array, "*batch 4 3"]
    foot_velocity: Float[Array, "*batch 4 3"]
    tail_force: Scalars
