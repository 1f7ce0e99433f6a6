"""Head control: held relative to the torso, or with its gaze held in the world while the torso sways.

The gaze is a direction d in the world. With the torso's rotation R, read from its IMU and extrapolated with the gyro by
the servos' lag, its direction in the torso's frame is u = R^T d, and the head looks there with

    neck = atan2(u_x, -u_y),        tilt = atan2(-u_z, |(u_x, u_y)|),

which also removes the effect of roll and pitch on the centre of the image. A robot without a servo for the tilt uses
the neck alone.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.control.appendage import AppendageLike, Memoryless, OnCourse
from nermo_mjx.control.sway import Course, Pace
from nermo_mjx.kinematics.attitude import turned_back
from nermo_mjx.robot.interface import Sensors
from nermo_mjx.robot.nearest import choice
from nermo_mjx.robot.quantity import parameter_tree, quantity
from nermo_mjx.shapes import Array, Scalars

GAZE: Final = "gaze"


@parameter_tree
class Head:
    """Direction of the head, and stabilisation of its gaze; the tilt needs a robot with a servo for it."""

    pan: Any = quantity(0.0, "rad", -1.0, 1.0, "neck beside straight ahead, positive left")
    tilt: Any = quantity(0.0, "rad", -1.0, 1.0, "head from level, positive down")
    into_turn: Any = quantity(0.0, "rad", -1.0, 1.0, "how far the neck looks into a full turn")
    gain: Any = quantity(1.0, "1", 0.0, 2.0, "share of the torso's sway that the gaze takes out")
    bandwidth: Any = quantity(0.5, "rad", 0.01, 10.0, "bandwidth of the course that the gaze holds, per gait cycle")
    lead: Any = quantity(0.0, "s", 0.0, 0.2, "how far ahead the gyro carries the torso's rotation, for slow servos")


class HeadAngles(NamedTuple):
    """Commanded servo angles of the head [rad]: of the neck, positive left, and of the tilt, positive down."""

    neck: Scalars
    tilt: Scalars


@runtime_checkable
class HeadLike(AppendageLike[HeadAngles], Protocol):
    """Head control, see `AppendageLike`."""


def held(head: Head, pace: Pace, sensors: Sensors | None = None) -> HeadAngles:
    """Looks in the torso's direction, offset by `head.pan`, `head.tilt` and `head.into_turn`."""
    neck = head.pan + head.into_turn * pace.turn_rate
    return HeadAngles(neck, jnp.zeros_like(neck) + head.tilt)


def gaze(head: Head, pace: Pace, sensors: Sensors, course: Course) -> HeadAngles:
    """Looks along the robot's course and level, with the offsets that `held` has from the torso's direction."""
    offset = held(head, pace)
    seen = turned_back(sensors.orientation, _direction(course.heading + offset.neck, offset.tilt))
    seen = seen + head.lead * jnp.cross(seen, sensors.gyro)
    level = jnp.sqrt(seen[0] ** 2 + seen[1] ** 2 + 1e-12)
    wanted = HeadAngles(jnp.arctan2(seen[0], -seen[1]), jnp.arctan2(-seen[2], level))
    return HeadAngles(*(own + head.gain * (to - own) for own, to in zip(offset, wanted, strict=True)))


_HEADS: Final[dict[str, HeadLike]] = {"none": Memoryless("head", held), GAZE: OnCourse("head", held, gaze)}
HEADS: Final = tuple(_HEADS)


def named_head(name: str = "none") -> HeadLike:
    """The head control of this name in `HEADS`."""
    return _HEADS[choice("head", name, HEADS)]


def _direction(heading: Scalars, down: Scalars) -> Float[Array, " 3"]:
    """The unit vector of a heading [rad], positive left of -y, that points down by an angle [rad]."""
    level = jnp.cos(down)
    return jnp.stack([level * jnp.sin(heading), -level * jnp.cos(heading), -jnp.sin(down)])
