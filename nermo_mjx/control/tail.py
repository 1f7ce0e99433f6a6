"""What the tail does: it is held, swings with the gait, or moves against the sway of the body.

The swing is that of the author's software, min(4.5 v^2, 0.5) cos(2 pi phase) at the commanded speed v. His positive
angle bends the tail's tip to the right (measured on his model), here it is the left: hence `tail.swing_phase` is pi.

Against the yaw of the body it takes up angular momentum: where the torso turns to the left, so does the tail, whose tip
goes right. Against the roll it is a prop, since its tip touches the ground: it goes to the side to which the torso
leans. Its weight alone would have it go to the other side, where the simulated robot rolls more.
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
    """What the tail does: pure functions over parameters and a memory of its own, any pytree. Values are unbatched.

    An angle is that of the tail's servo, positive bends the tip to the left [rad].
    """

    def start(self, params: Any, pace: Pace) -> tuple[Any, Scalars]:
        """Memory and angle of a robot that has read no sensor yet; the start pose is made from them."""

    def init(self, params: Any, memory: Any, sensors: Sensors) -> Any:
        """The memory of `start` with the first readings taken in."""

    def update(self, params: Any, memory: Any, sensors: Sensors, pace: Pace, dt: float) -> tuple[Any, Scalars]:
        """Memory and angle one control tick of `dt` seconds later."""


def named_tail(name: str) -> TailLike:
    """What a tail does, by its name in `TAIL_MOTIONS`."""
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
    """Swings once a gait cycle about `tail.angle`, as the author's software has it."""

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
    """Bends to the right by `tail.yaw_gain` times the yaw to the left of the torso from the robot's course."""

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
