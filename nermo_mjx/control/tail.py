"""Tail control: held still, swinging with the gait, or moving against the sway of the body.

The swing is that of the author's software, min(4.5 v^2, 0.5) cos(2 pi phase) at the commanded speed v. His positive
angle bends the tail's tip to the right (measured on his model), here it is the left: hence `tail.swing_phase` is pi.

Against the yaw of the body it takes up angular momentum: when the torso turns to the left, so does the tail, which
moves its tip to the right. Against roll it acts as a prop, since its tip touches the ground: it moves to the side to
which the torso leans. As a counterweight it would move to the other side, with which the simulated robot rolls more.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final, Protocol, runtime_checkable

import jax.numpy as jnp

from nermo_mjx.control import sway
from nermo_mjx.control.parameters import ControlParameters, choice
from nermo_mjx.control.sway import Course, Pace
from nermo_mjx.kinematics.attitude import attitude
from nermo_mjx.robot.geometry import geometry_of
from nermo_mjx.robot.interface import Sensors
from nermo_mjx.shapes import Scalars

SWING, COUNTER_YAW, COUNTER_ROLL = "swing", "counter_yaw", "counter_roll"
TAIL_MOTIONS: Final = ("none", SWING, COUNTER_YAW, COUNTER_ROLL)


@runtime_checkable
class TailLike(Protocol):
    """Tail control: pure functions of parameters and their own memory, any pytree. Values are unbatched.

    An angle is that of the tail's servo, positive bends the tip to the left [rad].
    """

    def start(self, params: Any, pace: Pace) -> tuple[Any, Scalars]:
        """Memory and angle before the first sensor reading; the start pose is built from them."""

    def init(self, params: Any, memory: Any, sensors: Sensors) -> Any:
        """The memory of `start` updated with the first readings."""

    def update(self, params: Any, memory: Any, sensors: Sensors, pace: Pace, dt: float) -> tuple[Any, Scalars]:
        """Memory and angle one control tick of `dt` seconds later."""


def named_tail(name: str) -> TailLike:
    """The tail control of this name in `TAIL_MOTIONS`."""
    parts: dict[str, TailLike] = {
        "none": HeldTail(), SWING: TailSwing(), COUNTER_YAW: CounterYaw(), COUNTER_ROLL: CounterRoll(),
    }  # fmt: skip
    return parts[choice("tail_motion", name, TAIL_MOTIONS)]


@dataclasses.dataclass(frozen=True)
class HeldTail:
    """Stays at `tail.angle`."""

    def start(self, params: ControlParameters, pace: Pace) -> tuple[Any, Scalars]:
        """See `TailLike`."""
        return (), _held(params, pace)

    def init(self, params: ControlParameters, memory: Any, sensors: Sensors) -> Any:
        """See `TailLike`."""
        return memory

    def update(
        self, params: ControlParameters, memory: Any, sensors: Sensors, pace: Pace, dt: float
    ) -> tuple[Any, Scalars]:
        """See `TailLike`."""
        return self.start(params, pace)


@dataclasses.dataclass(frozen=True)
class TailSwing:
    """Swings once per gait cycle about `tail.angle`, as in the author's software."""

    def start(self, params: ControlParameters, pace: Pace) -> tuple[Any, Scalars]:
        """See `TailLike`."""
        tail = params.tail
        amplitude = jnp.minimum(tail.swing_gain * pace.speed**2, tail.swing_amplitude)
        return (), _held(params, pace) + amplitude * jnp.cos(2.0 * jnp.pi * pace.phase + tail.swing_phase)

    def init(self, params: ControlParameters, memory: Any, sensors: Sensors) -> Any:
        """See `TailLike`."""
        return memory

    def update(
        self, params: ControlParameters, memory: Any, sensors: Sensors, pace: Pace, dt: float
    ) -> tuple[Any, Scalars]:
        """See `TailLike`."""
        return self.start(params, pace)


@dataclasses.dataclass(frozen=True)
class CounterYaw:
    """Bends to the right by `tail.yaw_gain` times the torso's yaw to the left of the robot's course."""

    def start(self, params: ControlParameters, pace: Pace) -> tuple[Course, Scalars]:
        """See `TailLike`."""
        return Course(jnp.zeros(()), jnp.zeros(())), _held(params, pace)

    def init(self, params: ControlParameters, memory: Course, sensors: Sensors) -> Course:
        """See `TailLike`."""
        return sway.begin(sensors, geometry_of(params))

    def update(
        self, params: ControlParameters, memory: Course, sensors: Sensors, pace: Pace, dt: float
    ) -> tuple[Course, Scalars]:
        """See `TailLike`."""
        tail = params.tail
        course = sway.observe(memory, sensors, tail.bandwidth * pace.cycle_rate, dt, geometry_of(params))
        beside = sway.wrapped(attitude(sensors.orientation)[2] - course.heading)
        return course, tail.angle - tail.yaw_gain * beside


@dataclasses.dataclass(frozen=True)
class CounterRoll:
    """Bends to the side to which the torso leans, by `tail.roll_gain` times its roll."""

    def start(self, params: ControlParameters, pace: Pace) -> tuple[Any, Scalars]:
        """See `TailLike`."""
        return (), _held(params, pace)

    def init(self, params: ControlParameters, memory: Any, sensors: Sensors) -> Any:
        """See `TailLike`."""
        return memory

    def update(
        self, params: ControlParameters, memory: Any, sensors: Sensors, pace: Pace, dt: float
    ) -> tuple[Any, Scalars]:
        """See `TailLike`."""
        return memory, params.tail.angle + params.tail.roll_gain * attitude(sensors.orientation)[0]


def _held(params: ControlParameters, pace: Pace) -> Scalars:
    return jnp.zeros_like(pace.phase) + params.tail.angle
