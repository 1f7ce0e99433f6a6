"""What control of the head and of the tail have in common: the protocol, and its two published forms.

Both move with the gait, or against the torso's deviation from the robot's course (`sway`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax.numpy as jnp

from nermo_mjx.control import sway
from nermo_mjx.control.sway import Course, Pace
from nermo_mjx.robot.geometry import geometry_of
from nermo_mjx.robot.interface import Sensors

Angles_co = TypeVar("Angles_co", covariant=True)
Angles = TypeVar("Angles")


@runtime_checkable
class AppendageLike(Protocol[Angles_co]):
    """Commands servo angles: pure functions of parameters and their own memory, any pytree. Values are unbatched."""

    def start(self, params: Any, pace: Pace) -> tuple[Any, Angles_co]:
        """Memory and angles before the first sensor reading; the start pose is built from them."""

    def init(self, params: Any, memory: Any, sensors: Sensors) -> Any:
        """The memory of `start` updated with the first readings."""

    def update(self, params: Any, memory: Any, sensors: Sensors, pace: Pace, dt: float) -> tuple[Any, Angles_co]:
        """Memory and angles one control tick of `dt` seconds later."""


@dataclasses.dataclass(frozen=True)
class Memoryless(AppendageLike[Angles]):
    """Angles that depend on the present only.

    Attributes:
        group: name of its parameters among the controller's.
        angles: a function of these parameters, of the pace, and of the sensors, None before the first reading.
    """

    group: str
    angles: Callable[[Any, Pace, Sensors | None], Angles]

    def start(self, params: Any, pace: Pace) -> tuple[Any, Angles]:
        return (), self.angles(getattr(params, self.group), pace, None)

    def init(self, params: Any, memory: Any, sensors: Sensors) -> Any:
        return memory

    def update(self, params: Any, memory: Any, sensors: Sensors, pace: Pace, dt: float) -> tuple[Any, Angles]:
        return memory, self.angles(getattr(params, self.group), pace, sensors)


@dataclasses.dataclass(frozen=True)
class OnCourse(AppendageLike[Angles]):
    """Angles relative to the robot's course, which is observed with the bandwidth among the parameters.

    Attributes:
        group: name of its parameters among the controller's.
        held: the angles before the first reading, a function of these parameters and of the pace.
        angles: a function of these parameters, of the pace, of the sensors and of the course.
    """

    group: str
    held: Callable[[Any, Pace], Angles]
    angles: Callable[[Any, Pace, Sensors, Course], Angles]

    def start(self, params: Any, pace: Pace) -> tuple[Course, Angles]:
        return Course(jnp.zeros(()), jnp.zeros(())), self.held(getattr(params, self.group), pace)

    def init(self, params: Any, memory: Course, sensors: Sensors) -> Course:
        return sway.begin(sensors, geometry_of(params))

    def update(self, params: Any, memory: Course, sensors: Sensors, pace: Pace, dt: float) -> tuple[Course, Angles]:
        own = getattr(params, self.group)
        course = sway.observe(memory, sensors, own.bandwidth * pace.cycle_rate, dt, geometry_of(params))
        return course, self.angles(own, pace, sensors, course)
