"""Terms of the reward: each has a name, a unit and a meaning, and is summed over a control step.

The reward of a step is the sum of the terms, each times its weight in `Task.rewards`. Terms are what a step adds: the
distance in metres, not the speed; so a return does not depend on the length of a control step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.robot import ParameterError, Sensors
from nermo_mjx.robot.nearest import nearest
from nermo_mjx.rollout.metrics import MetricState
from nermo_mjx.shapes import Array, Scalar, Truth

#: Errors at which the terms that track a command have fallen to 1/e: speed [m/s], yaw rate [rad/s].
SPEED_WIDTH: Final = 0.05
YAW_RATE_WIDTH: Final = 0.3


class Moment(NamedTuple):
    """A control step of one world that has just ended.

    Attributes:
        before, now: metrics at its start and its end.
        sensors: readings at its end.
        seconds: its length [s].
        speed: smoothed over a gait cycle [m/s].
        command: name -> value commanded, for `speed` [m/s] and `yaw_rate` [rad/s].
        action, last_action: of this step and the one before.
        failed, arrived: whether the episode ends with it.
    """

    before: MetricState
    now: MetricState
    sensors: Sensors
    seconds: Scalar
    speed: Scalar
    command: Mapping[str, Scalar]
    action: Float[Array, " a"]
    last_action: Float[Array, " a"]
    failed: Truth
    arrived: Truth


@dataclasses.dataclass(frozen=True)
class Term:
    """A term of the reward.

    Attributes:
        name: in `Task.rewards`, and of its column.
        unit: of its value.
        doc: what it is.
        value: of a `Moment`, pure JAX, unbatched.
        needs: the command without which it is meaningless.
    """

    name: str
    unit: str
    doc: str
    value: Callable[[Moment], Scalar]
    needs: str | None = None


def _kernel(error: Scalar, width: float) -> Scalar:
    return jnp.exp(-((error / width) ** 2))


def _sum_square(values: Array) -> Scalar:
    return jnp.sum(values**2)


_TERMS: Final = (
    Term("progress", "m", "distance along the path, or along the smoothed heading",
         lambda m: m.now.travelled - m.before.travelled),
    Term("speed", "s", f"time at the commanded speed: exp(-(error / {SPEED_WIDTH:g} m/s)^2)",
         lambda m: m.seconds * _kernel(m.speed - m.command["speed"], SPEED_WIDTH), "speed"),
    Term("headway", "s", f"time, times tanh(speed / ({SPEED_WIDTH:g} m/s)): being stuck costs more than haste earns",
         lambda m: m.seconds * jnp.tanh(m.speed / SPEED_WIDTH)),
    Term("yaw_rate", "s", f"time at the commanded yaw rate: exp(-(error / {YAW_RATE_WIDTH:g} rad/s)^2)",
         lambda m: m.seconds * _kernel(m.now.turning - m.command["yaw_rate"], YAW_RATE_WIDTH), "yaw_rate"),
    Term("deviation", "m s", "distance from the path, over time", lambda m: m.seconds * jnp.abs(m.now.readings[3])),
    Term("tilt", "rad^2 s", "roll and pitch, squared, over time",
         lambda m: m.seconds * _sum_square(m.now.readings[:2])),
    Term("sway", "rad^2/s", "angular velocity about roll and pitch, squared, over time",
         lambda m: m.seconds * _sum_square(m.sensors.gyro[:2])),
    Term("work", "J", "mechanical work of the servos", lambda m: m.now.work - m.before.work),
    Term("torque", "N^2 m^2 s", "torques of the servos, squared, over time",
         lambda m: m.seconds * _sum_square(m.sensors.servo_torque)),
    Term("slip", "m", "distance that loaded feet slide, the sum of all four",
         lambda m: jnp.sum(m.now.slid - m.before.slid)),
    Term("dragging", "s", "time in which feet are loaded in their commanded swing, the sum of all four",
         lambda m: jnp.sum(m.now.swing_loaded - m.before.swing_loaded)),
    Term("tail", "s", "time in which the tail bears load", lambda m: m.now.tail_loaded - m.before.tail_loaded),
    Term("action", "1", "the action, squared", lambda m: _sum_square(m.action)),
    Term("action_change", "1", "the action's change since the last step, squared",
         lambda m: _sum_square(m.action - m.last_action)),
    Term("alive", "s", "time", lambda m: jnp.asarray(m.seconds)),
    Term("failed", "1", "1 where the robot fell, lost its way, or the simulation diverged",
         lambda m: jnp.asarray(m.failed, m.speed.dtype)),
    Term("arrived", "1", "1 where the robot has walked its distance",
         lambda m: jnp.asarray(m.arrived, m.speed.dtype)),
)  # fmt: skip
#: All terms, by name.
TERMS: Final[Mapping[str, Term]] = {term.name: term for term in _TERMS}


def chosen_terms(weights: Mapping[str | Term, float], commands: tuple[str, ...]) -> dict[Term, float]:
    """The terms of a task and their weights.

    Args:
        weights: name of one of `TERMS`, or a custom term, and its weight.
        commands: what the task commands.

    Raises:
        ParameterError: there is no such term, it needs a command that the task does not give, or its weight is no
            number.
    """
    found: dict[Term, float] = {}
    for given, weight in weights.items():
        name = given.name if isinstance(given, Term) else given
        if not isinstance(given, Term) and name not in TERMS:
            near = nearest(str(name), list(TERMS))
            hint = f"did you mean {near!r}? " if near else ""
            raise ParameterError(f"rewards has {name!r}: {hint}allowed is one of {', '.join(TERMS)}, or a Term.")
        term = given if isinstance(given, Term) else TERMS[name]
        if term.needs is not None and term.needs not in commands:
            raise ParameterError(
                f"rewards has {name!r}, and nothing is commanded: name command.{term.needs} under set or randomize."
            )
        if not isinstance(weight, (int, float)) or not jnp.isfinite(weight):
            raise ParameterError(f"rewards.{name} is {weight!r}: expected a number.")
        found[term] = float(weight)
    if len({term.name for term in found}) < len(found):
        raise ParameterError("rewards has two terms of one name: give one of them another.")
    return found
