"""The robot's heading without its sway, from the attitude of its torso and the bend of its spine.

Head and tail react to the torso's deviation from its course. The course is the heading of the body, half-way between
torso and hip, followed by a critically damped observer: with x the measured heading, b the bandwidth and T the tick,

    e = wrap(x - (c + T r)),    c <- c + T r + 2 T b e,    r <- r + T b^2 e,

so that it has no lag in a steady turn.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from nermo_mjx.kinematics.attitude import attitude
from nermo_mjx.kinematics.spine import joint_angle, yaw
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.interface import SERVOS, Sensors
from nermo_mjx.shapes import Array, Scalar, Scalars


class Pace(NamedTuple):
    """Inputs of head and tail control, in addition to the sensors.

    Attributes:
        phase: of the gait cycle.
        speed: commanded [m/s of the controller's clock].
        turn_rate: commanded, in [-1, 1], positive left.
        cycle_rate: gait cycles per simulated second [1/s].
    """

    phase: Scalars
    speed: Scalars
    turn_rate: Scalars
    cycle_rate: Any


class Course(NamedTuple):
    """Estimate of the robot's course.

    Attributes:
        heading: positive left, 0 along -y; unwrapped [rad].
        rate: of its change [rad/s].
    """

    heading: Scalar
    rate: Scalar


def body_heading(sensors: Sensors, geometry: Geometry) -> Scalar:
    """Heading of the body [rad], in (-pi, pi]: a bent spine turns torso and hip to opposite sides of it."""
    bend = yaw(joint_angle(sensors.servo_angle[SERVOS.index("spine")], geometry))
    return attitude(sensors.orientation)[2] - 0.5 * bend


def begin(sensors: Sensors, geometry: Geometry) -> Course:
    """The course at the start."""
    heading = body_heading(sensors, geometry)
    return Course(heading, jnp.zeros_like(heading))


def observe(course: Course, sensors: Sensors, bandwidth: Any, dt: float, geometry: Geometry) -> Course:
    """The course one tick later.

    Args:
        course: before.
        sensors: read now.
        bandwidth: b [rad/s]; faster motion counts as sway.
        dt: T, since the last tick [s].
        geometry: of the robot.
    """
    expected = course.heading + dt * course.rate
    surprise = wrapped(body_heading(sensors, geometry) - expected)
    gain = dt * bandwidth
    return Course(expected + 2.0 * gain * surprise, course.rate + gain * bandwidth * surprise)


def wrapped(angle: Array) -> Array:
    """The angle, wrapped to (-pi, pi] [rad]."""
    return angle - 2.0 * jnp.pi * jnp.round(angle / (2.0 * jnp.pi))
