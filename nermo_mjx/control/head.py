"""Head control: held relative to the torso, or with its gaze held in the world while the torso sways.

The gaze is a direction d in the world. With the torso's rotation R, read from its IMU and extrapolated with the gyro by
the servos' lag, its direction in the torso's frame is u = R^T d, and the head looks there with

    neck = atan2(u_x, -u_y),        tilt = atan2(-u_z, |(u_x, u_y)|),

which also removes the effect of roll and pitch on the centre of the image. A robot without a servo for the tilt uses
the neck alone.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.control import sway
from nermo_mjx.control.parameters import ControlParameters, Head, choice
from nermo_mjx.control.sway import Course, Pace
from nermo_mjx.kinematics.attitude import turned_back
from nermo_mjx.robot.geometry import geometry_of
from nermo_mjx.robot.interface import Sensors
from nermo_mjx.shapes import Array, Scalars

GAZE: Final = "gaze"
HEADS: Final = ("none", GAZE)


class HeadAngles(NamedTuple):
    """Commanded servo angles of the head [rad]: of the neck, positive left, and of the tilt, positive down."""

    neck: Scalars
    tilt: Scalars


@runtime_checkable
class HeadLike(Protocol):
    """Head control: pure functions of parameters and their own memory, any pytree. Values are unbatched."""

    def start(self, params: Any, pace: Pace) -> tuple[Any, HeadAngles]:
        """Memory and angles before the first sensor reading; the start pose is built from them."""

    def init(self, params: Any, memory: Any, sensors: Sensors) -> Any:
        """The memory of `start` updated with the first readings."""

    def update(self, params: Any, memory: Any, sensors: Sensors, pace: Pace, dt: float) -> tuple[Any, HeadAngles]:
        """Memory and angles one control tick of `dt` seconds later."""


def named_head(name: str) -> HeadLike:
    """The head control of this name in `HEADS`."""
    return Gaze() if choice("head", name, HEADS) == GAZE else HeldHead()


@dataclasses.dataclass(frozen=True)
class HeldHead:
    """Looks in the torso's direction, offset by `head.pan`, `head.tilt` and `head.into_turn`."""

    def start(self, params: ControlParameters, pace: Pace) -> tuple[Any, HeadAngles]:
        """See `HeadLike`."""
        return (), _held(params.head, pace)

    def init(self, params: ControlParameters, memory: Any, sensors: Sensors) -> Any:
        """See `HeadLike`."""
        return memory

    def update(
        self, params: ControlParameters, memory: Any, sensors: Sensors, pace: Pace, dt: float
    ) -> tuple[Any, HeadAngles]:
        """See `HeadLike`."""
        return self.start(params, pace)


@dataclasses.dataclass(frozen=True)
class Gaze:
    """Looks along the robot's course and level, with the offsets that `HeldHead` has from the torso's direction."""

    def start(self, params: ControlParameters, pace: Pace) -> tuple[Course, HeadAngles]:
        """See `HeadLike`."""
        return Course(jnp.zeros(()), jnp.zeros(())), _held(params.head, pace)

    def init(self, params: ControlParameters, memory: Course, sensors: Sensors) -> Course:
        """See `HeadLike`."""
        return sway.begin(sensors, geometry_of(params))

    def update(
        self, params: ControlParameters, memory: Course, sensors: Sensors, pace: Pace, dt: float
    ) -> tuple[Course, HeadAngles]:
        """See `HeadLike`."""
        head, held = params.head, _held(params.head, pace)
        course = sway.observe(memory, sensors, head.bandwidth * pace.cycle_rate, dt, geometry_of(params))
        seen = turned_back(sensors.orientation, _direction(course.heading + held.neck, held.tilt))
        seen = seen + head.lead * jnp.cross(seen, sensors.gyro)
        level = jnp.sqrt(seen[0] ** 2 + seen[1] ** 2 + 1e-12)
        wanted = HeadAngles(jnp.arctan2(seen[0], -seen[1]), jnp.arctan2(-seen[2], level))
        return course, HeadAngles(*(own + head.gain * (to - own) for own, to in zip(held, wanted, strict=True)))


def _held(head: Head, pace: Pace) -> HeadAngles:
    neck = head.pan + head.into_turn * pace.turn_rate
    return HeadAngles(neck, jnp.zeros_like(neck) + head.tilt)


def _direction(heading: Scalars, down: Scalars) -> Float[Array, " 3"]:
    """The unit vector of a heading [rad], positive left of -y, that points down by an angle [rad]."""
    level = jnp.cos(down)
    return jnp.stack([level * jnp.sin(heading), -level * jnp.cos(heading), -jnp.sin(down)])
