"""Electrical metrics: what the servos draw, and how long a battery lasts.

At its nominal voltage V0 a servo's motor draws a current that rises linearly with its torque, from I0 at rest to the
stall current Is at the stall torque T:

    i = I0 + (Is - I0) |tau| / T.

Its winding, of the resistance V0 / (Is - I0), turns i^2 of it into heat; the rest drives the load at the speed w:

    P = V I0 + max(0, V0 (Is - I0) tau^2 / T^2 + max(1, k (Is - I0) / T) tau w).

With a back-EMF constant k above the torque per current, T / (Is - I0), gears lose the difference, and P is what
electronics draw that switch the supply voltage on for the share u of the time (`Servo`). With a smaller one, such as
the default of 0, the motor would give more than it takes: it takes what it gives. So power is never less than
mechanical work. Power that would flow back into the battery is not counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.robot.model_parameters import NOMINAL_VOLTAGE, Battery, ModelParameters, Servo
from nermo_mjx.shapes import Array, Scalar


class Supply(NamedTuple):
    """What the electrical metrics of a world depend on beside its motion."""

    servo: Servo
    battery: Battery

    @classmethod
    def of(cls, body: ModelParameters) -> Supply:
        """The supply of a body."""
        return cls(body.servo, body.battery)


#: Integrals of `drawn`.
DRAWN: Final = ("servos", "torque", "energy")


def drawn(torque: Float[Array, "steps n"], velocity: Float[Array, "steps n"], servo: Servo) -> dict[str, Scalar]:
    """Means over a tick of sums over the servos: their number, the motors' |torque| [N m], the power beside idle [W].

    Args:
        torque: of the motors, after what the back-EMF takes (`Servo.brake`) [N m].
        velocity: of the servos [rad/s].
        servo: parameters.
    """
    per_torque = (servo.stall_current - servo.idle_current) / servo.torque_limit
    heat = NOMINAL_VOLTAGE * per_torque / servo.torque_limit * torque**2
    power = heat + jnp.maximum(1.0, servo.back_emf * per_torque) * torque * velocity
    each = jnp.ones_like(torque), jnp.abs(torque), jnp.maximum(power, 0.0)
    return {name: values.sum(axis=-1).mean() for name, values in zip(DRAWN, each, strict=True)}


def result(sums: Mapping[str, Scalar], time: Scalar, supply: Supply) -> dict[str, Scalar]:
    """The electrical metrics, from the integrals of `drawn` over the measured time [s]."""
    servo, battery = supply
    per_torque = (servo.stall_current - servo.idle_current) / servo.torque_limit
    idle = servo.idle_current * sums["servos"] / time
    current = idle + sums["energy"] / time / servo.supply_voltage
    seconds = 3600.0 * battery.capacity / (current + battery.electronics_current)
    return {
        "motor_current": idle + per_torque * sums["torque"] / time,
        "servo_current": current,
        "electrical_power": servo.supply_voltage * current,
        "charge": current * time,
        "battery_time": seconds,
    }
