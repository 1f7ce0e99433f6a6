"""Dead band and backlash of the servos, which engines compute before each step of physics if one of them is named.

A servo measures the angle q of its output, and does not respond to an error of less than its dead band d. Its motor
turns the output through gears with a free travel b, so that the motor's angle m, seen at the output, is within b / 2 of
q. With the target u,

    e = u - q,   a = e - clip(e, -d, d),   tau = clip(kp a - kv w, -T, T),
    dm/dt = v tau / T,   m within [q - b / 2, q + b / 2],

and the output receives tau while m is at the end that it moves to, or else nothing. A reversed torque reaches it only
after the motor has crossed the play, at the share tau / T of its no-load speed v, `Servo.top_speed`. A step in which
the motor arrives counts with its remainder, so that the torque is continuous in the time of arrival. The motor's
inertia, and the damping by its back-EMF, stay with the joint while it crosses. MuJoCo's position actuator has the
torque clip(kp (c - q) - kv w, -T, T): a control c gives either, and neither a new actuator nor a new joint is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from nermo_mjx.robot.model_parameters import Servo

#: Key of a packed `Play` among the fields of a batch; it is not a field of MuJoCo's model.
SERVO_PLAY: Final = "servo_play"
#: Fields that servos with play need. The range of the controls is wide, because the targets are limited instead.
PLAY_FIELDS: Final = (SERVO_PLAY, "actuator_ctrlrange")
#: Bound of the range of the controls [rad].
UNLIMITED_RANGE_RAD: Final = 1e6

T = TypeVar("T")


class Play(NamedTuple):
    """The servos of one world, or of several with leading axes.

    Attributes:
        dead_band, backlash: Half of the insensitive range of errors, and free travel of the gears [rad].
        kp, kv, stall_torque: Gains [N m/rad, N m s/rad] and torque limit [N m] of the servo.
        speed: Speed of the motor without load [rad/s].
    """

    dead_band: Any
    backlash: Any
    kp: Any
    kv: Any
    stall_torque: Any
    speed: Any

    @classmethod
    def of(cls, servo: Servo) -> Play:
        """The play of servos with these parameters."""
        return cls(
            servo.dead_band, servo.backlash, servo.kp, servo.kv, servo.stall_torque, servo.top_speed
        )

    @property
    def packed(self) -> Any:
        """The fields as one array of JAX (..., 6)."""
        return jnp.stack([jnp.asarray(leaf, float) for leaf in self], axis=-1)

    @classmethod
    def unpacked(cls, packed: Any) -> Play:
        """The play from an array (..., 6), with leaves (..., 1), which broadcast over servos."""
        return cls(*(packed[..., i, None] for i in range(len(cls._fields))))


def played(
    play: Play, motor: Any, target: Any, angle: Any, velocity: Any, timestep: float, xp: Any = jnp
) -> tuple[Any, Any]:
    """Controls of the position actuators for one step of physics, and the angles of the motors after it.

    Args:
        play: Play of the servos.
        motor: Angles of the motors from the middle of their play (..., n_servos) [rad].
        target: Targets of the servos [rad].
        angle, velocity: Angles and velocities of the outputs [rad, rad/s].
        timestep: Time step of the physics [s].
        xp: `jax.numpy` or `numpy`.
    """
    error = target - angle
    effective_error = error - xp.clip(error, -play.dead_band, play.dead_band)
    drive = xp.clip((play.kp * effective_error - play.kv * velocity) / play.stall_torque, -1.0, 1.0)
    half = play.backlash / 2
    shift = timestep * (play.speed * drive - velocity)
    ahead = xp.where(shift < 0.0, half + motor, half - motor)
    share = xp.clip(1.0 - ahead / xp.maximum(xp.abs(shift), 1e-12), 0.0, 1.0)
    control = angle + (share * drive * play.stall_torque + play.kv * velocity) / play.kp
    return control, xp.clip(motor + shift, -half, half)


def without_play(fields: Mapping[str, T]) -> dict[str, T]:
    """The fields of MuJoCo's model."""
    return {name: value for name, value in fields.items() if name != SERVO_PLAY}


def servo_addresses(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Addresses in `qpos` and `qvel` of the joints that servos turn, in the order of `ctrl`."""
    joints = np.asarray(model.actuator_trnid)[:, 0]
    return np.asarray(model.jnt_qposadr)[joints], np.asarray(model.jnt_dofadr)[joints]


class ServosWithPlay:
    """The servos of n worlds on the CPU, and the angles of their motors in their play (n, n_servos) [rad]."""

    def __init__(self, model: Any, play: Play, worlds: int) -> None:
        self.play, self._timestep = play, float(model.opt.timestep)
        self._qpos, self._dofs = servo_addresses(model)
        self.motor = np.zeros((worlds, model.nu))

    def controls(self, target: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Compute the controls of the next step (n, n_servos), and move the motors."""
        angle, velocity = qpos[:, self._qpos], qvel[:, self._dofs]
        control, self.motor = played(
            self.play, self.motor, target, angle, velocity, self._timestep, np
        )
        return control
