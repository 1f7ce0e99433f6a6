"""Tail control: held still, swinging with the gait, or moving against the sway of the body.

The swing is that of the author's software, min(4.5 v^2, 0.5) cos(2 pi phase) at the commanded speed v. His positive
angle bends the tail's tip to the right (measured on his model), here it is the left: hence `tail.swing_phase` is pi.

Against the yaw of the body it takes up angular momentum: when the torso turns to the left, so does the tail, which
moves its tip to the right. Against roll it acts as a prop, since its tip touches the ground: it moves to the side to
which the torso leans. As a counterweight it would move to the other side, with which the simulated robot rolls more.
"""

from __future__ import annotations

from typing import Any, Final, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np

from nermo_mjx.control import sway
from nermo_mjx.control.appendage import AppendageLike, Memoryless, OnCourse
from nermo_mjx.control.sway import Course, Pace
from nermo_mjx.kinematics.attitude import attitude
from nermo_mjx.robot.interface import Sensors
from nermo_mjx.robot.nearest import choice
from nermo_mjx.robot.quantity import parameter_tree, quantity
from nermo_mjx.shapes import Scalars

SWING, COUNTER_YAW, COUNTER_ROLL = "swing", "counter_yaw", "counter_roll"


@parameter_tree
class Tail:
    """How the articulated tail moves; a positive servo angle moves the tip to the left."""

    angle: Any = quantity(0.0, "rad", -1.0, 1.0, "servo angle about which it moves")
    swing_amplitude: Any = quantity(0.5, "rad", 0.0, 1.0, "largest servo amplitude of the swing")
    swing_gain: Any = quantity(
        4.5, "rad s^2/m^2", 0.0, 1e4, "servo amplitude of the swing over the square of gait.speed"
    )
    swing_phase: Any = quantity(
        np.pi, "rad", -2 * np.pi, 2 * np.pi, "of the swing A cos(2 pi phase + tail.swing_phase)"
    )
    # Both were chosen by sweeps of the trot at 0.8 Hz (docs/control.md): with higher values the robot rolls or slows
    # down.
    yaw_gain: Any = quantity(2.0, "1", -10.0, 10.0, "servo angle against the torso's yaw off course")
    roll_gain: Any = quantity(2.0, "1", -10.0, 10.0, "servo angle over the torso's roll")
    bandwidth: Any = quantity(
        0.5, "rad", 0.01, 10.0, "bandwidth of the course that yaw is counted from, per gait cycle"
    )


@runtime_checkable
class TailLike(AppendageLike[Scalars], Protocol):
    """Tail control, see `AppendageLike`: its angle is that of the tail's servo, positive bends the tip to the left
    [rad]."""


def held(tail: Tail, pace: Pace, sensors: Sensors | None = None) -> Scalars:
    """Stays at `tail.angle`."""
    return jnp.zeros_like(pace.phase) + tail.angle


def swing(tail: Tail, pace: Pace, sensors: Sensors | None = None) -> Scalars:
    """Swings once per gait cycle about `tail.angle`, as in the author's software."""
    amplitude = jnp.minimum(tail.swing_gain * pace.speed**2, tail.swing_amplitude)
    return held(tail, pace) + amplitude * jnp.cos(2.0 * jnp.pi * pace.phase + tail.swing_phase)


def counter_yaw(tail: Tail, pace: Pace, sensors: Sensors, course: Course) -> Scalars:
    """Bends to the right by `tail.yaw_gain` times the torso's yaw to the left of the robot's course."""
    return tail.angle - tail.yaw_gain * sway.wrapped(attitude(sensors.orientation)[2] - course.heading)


def counter_roll(tail: Tail, pace: Pace, sensors: Sensors | None = None) -> Scalars:
    """Bends to the side to which the torso leans, by `tail.roll_gain` times its roll."""
    return held(tail, pace) if sensors is None else tail.angle + tail.roll_gain * attitude(sensors.orientation)[0]


_TAILS: Final[dict[str, TailLike]] = {
    "none": Memoryless("tail", held),
    SWING: Memoryless("tail", swing),
    COUNTER_YAW: OnCourse("tail", held, counter_yaw),
    COUNTER_ROLL: Memoryless("tail", counter_roll),
}
TAIL_MOTIONS: Final = tuple(_TAILS)


def named_tail(name: str = "none") -> TailLike:
    """The tail control of this name in `TAIL_MOTIONS`."""
    return _TAILS[choice("tail_motion", name, TAIL_MOTIONS)]
