"""Electrical metrics: what the servos draw, and how long a battery lasts.

At its nominal voltage V0 a servo's motor draws a current that rises linearly with its torque, from I0 at rest to the
stall current Is at the stall torque T:

    i = I0 + (Is - I0) |tau| / T.

The electronics switch the supply voltage V on and off: a servo that needs the share u of it draws the motor's current
for this share of the time,

    I = I0 + u (Is - I0) tau / T,    u = (tau + brake w) / (T V / V0),

with the torque lost to the back-EMF, `Servo.brake`. Current that would flow back into the battery is not counted. At
full voltage, u = 1, where data sheets measure, I is i; a servo that holds a load draws less from the battery than flows
in its motor.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.robot.model_parameters import Battery, ModelParameters, Servo
from nermo_mjx.shapes import Array, Scalar


class Supply(NamedTuple):
    """What the electrical metrics of a world depend on beside its motion."""

    servo: Servo
    battery: Battery

    @classmethod
    def of(cls, body: ModelParameters) -> Supply:
        """The supply of a body."""
        return cls(body.servo, body.battery)


class Drawn(NamedTuple):
    """Sums over all servos, over time.

    Attributes:
        on: number of servos [s].
        torque: of the motors' |tau| [N m s].
        driven: of max(0, (tau + brake w) tau) [N^2 m^2 s].
    """

    on: Scalar
    torque: Scalar
    driven: Scalar


def motor_torque(torque: Array, velocity: Array, brake: Any) -> Array:
    """Torque of a servo's output [N m]; see `update`."""
    return torque if brake is None else torque - brake * velocity


def update(
    drawn: Drawn, torque: Float[Array, "steps n"], velocity: Float[Array, "steps n"], brake: Any, weight: Scalar
) -> Drawn:
    """Add one control tick.

    Args:
        drawn: sums so far.
        torque: of the actuators, before what the back-EMF takes [N m].
        velocity: of the servos [rad/s].
        brake: `Servo.brake`, or None where it is zero.
        weight: how much of the tick is measured [s].
    """
    motor = motor_torque(torque, velocity, brake)
    each = jnp.ones_like(motor), jnp.abs(motor), jnp.maximum(torque * motor, 0.0)
    return Drawn(*(before + weight * now.sum(axis=-1).mean() for before, now in zip(drawn, each, strict=True)))


def result(drawn: Drawn, time: Scalar, supply: Supply) -> dict[str, Scalar]:
    """The electrical metrics.

    Args:
        drawn: sums.
        time: measured [s].
        supply: parameters.
    """
    servo, battery = supply
    per_torque = (servo.stall_current - servo.idle_current) / servo.torque_limit
    idle = servo.idle_current * drawn.on / time
    current = idle + per_torque * drawn.driven / time / servo.stall_torque
    seconds = 3600.0 * battery.capacity / (current + battery.electronics_current)
    return {
        "motor_current": idle + per_torque * drawn.torque / time,
        "servo_current": current,
        "electrical_power": servo.supply_voltage * current,
        "charge": current * time,
        "battery_time": seconds,
    }
