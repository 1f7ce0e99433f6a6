"""What the servos draw, how long a battery lasts, how much of their work dampers and contact take, and how long they
stand at their torque limit.

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
from typing import Any, Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.robot import LIMBS, Robot
from nermo_mjx.robot.model_parameters import (
    NOMINAL_VOLTAGE,
    Battery,
    Damping,
    ModelParameters,
    Servo,
)
from nermo_mjx.shapes import Array, Scalar


class Supply(NamedTuple):
    """What the electrical metrics of a world depend on beside its motion."""

    servo: Servo
    battery: Battery
    damping: Damping
    joint_damping: Float[Array, "*batch n"] | np.ndarray | float = 0.0

    @classmethod
    def of(cls, body: ModelParameters, robot: Robot | None = None) -> Supply:
        """The supply of a body; without the robot its compliant joints count as undamped."""
        return cls(
            body.servo,
            body.battery,
            body.damping,
            robot.joint_damping(body.damping) if robot else 0.0,
        )


#: Torque of the servos (n,), before what the back-EMF takes [N m], their velocity, that of the compliant joints (m,)
#: [rad/s].
Driven = tuple[Array, Array, Array]
#: Integrals of `drawn`.
DRAWN: Final = ("servos", "torque", "energy")
#: Groups of servos whose time at the torque limit is counted, as places among `SERVOS`.
GROUPS: Final = {
    "front_hips": (0, 1),
    "rear_hips": (2, 3),
    "front_knees": (4, 5),
    "rear_knees": (6, 7),
    "spine": (8,),
}
#: Share of its limit from which a servo counts as standing at it; single precision rounds.
AT_LIMIT: Final = 0.9999


def spent(previous: Driven, now: Driven, servo: Servo) -> dict[str, Array]:
    """Means over a tick: net power of the servos [W], what a damper of 1 N m s/rad takes of hips and of all others (2,)
    and of each compliant joint (m,) [W], and the shares of `GROUPS` at their torque limit (5,).

    Work is force times the mean speed of a step, and MuJoCo damps by the speed at its end, so that the sum over all
    forces is the change of energy. The tick is that of the readings, one step earlier.

    Args:
        previous: in the step before, without leading axes.
        now: with a leading axis (steps,).
        servo: parameters.
    """
    torque, velocity, joints = now
    driven, motion, bent = (
        jnp.vstack([old, column[:-1]]) for old, column in zip(previous, now, strict=True)
    )
    mean = 0.5 * (motion + velocity)
    damped = (mean * velocity).mean(axis=0)
    limit = servo.stall_torque * jnp.ones(torque.shape[-1]).at[jnp.array(GROUPS["spine"])].set(
        servo.spine_torque
    )
    limited = (jnp.abs(torque) >= AT_LIMIT * limit).mean(axis=0)
    return {
        "net_work": (driven * mean).sum(axis=-1).mean(),
        "damped": jnp.stack([damped[: len(LIMBS)].sum(), damped[len(LIMBS) :].sum()]),
        "bent": (0.5 * (bent + joints) * joints).mean(axis=0),
        "limited": jnp.stack([limited[jnp.array(group)].mean() for group in GROUPS.values()]),
    }


def unspent(dtype: Any, joints: int) -> dict[str, Array]:
    """The integrals of `spent` before the first tick, for a number of compliant joints."""
    shapes = {"damped": 2, "bent": joints, "limited": len(GROUPS)}
    return {"net_work": jnp.zeros((), dtype)} | {
        name: jnp.zeros(size, dtype) for name, size in shapes.items()
    }


def budget(sums: Mapping[str, Array], time: Scalar, supply: Supply) -> dict[str, Scalar]:
    """Metrics of the servos' work and limits, from the integrals of `spent` over the measured time [s].

    What is left is taken by constraints or stored: the sum over all forces is the change of energy.
    """
    damping = (
        jnp.stack([jnp.asarray(supply.damping.hip), jnp.asarray(supply.damping.pulley)])
        + supply.servo.brake
    )
    shares = {f"limited_{name}": sums["limited"][i] / time for i, name in enumerate(GROUPS)}
    work = {"servo_net_work": sums["net_work"], "servo_damper_work": damping @ sums["damped"]}
    work["joint_damper_work"] = (supply.joint_damping * sums["bent"]).sum()
    left = work["servo_net_work"] - work["servo_damper_work"] - work["joint_damper_work"]
    return work | {"constraint_work": left} | shares


def power_sums(
    torque: Float[Array, "steps n"], velocity: Float[Array, "steps n"], servo: Servo
) -> dict[str, Scalar]:
    """Means over a tick of sums over the servos: their number, the motors' |torque| [N m], the power beside idle [W].

    Args:
        torque: of the motors, after what the back-EMF takes (`Servo.brake`) [N m].
        velocity: of the servos [rad/s].
        servo: parameters.
    """
    per_torque = (servo.stall_current - servo.idle_current) / servo.torque_limit
    heat = NOMINAL_VOLTAGE * per_torque / servo.torque_limit * torque**2
    power = heat + jnp.maximum(1.0, servo.back_emf * per_torque) * torque * velocity
    terms = jnp.ones_like(torque), jnp.abs(torque), jnp.maximum(power, 0.0)
    return {name: values.sum(axis=-1).mean() for name, values in zip(DRAWN, terms, strict=True)}


def electrical_result(
    sums: Mapping[str, Scalar], time: Scalar, supply: Supply
) -> dict[str, Scalar]:
    """The electrical metrics, from the integrals of `drawn` over the measured time [s]."""
    servo, battery = supply.servo, supply.battery
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
