"""Head control: held relative to the torso, or with its gaze held in the world while the torso sways.

The gaze is a direction d in the world. With the torso's rotation R, read from its IMU and extrapolated with the gyro by
the servos' lag, its direction in the torso's frame is u = R^T d, and the head looks there with

    neck = atan2(u_x, -u_y),        tilt = atan2(-u_z, |(u_x, u_y)|),

which also removes the effect of roll and pitch on the centre of the image. A robot without a servo for the tilt uses
the neck alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Final, Literal, NamedTuple, Protocol, TypeVar, get_args, runtime_checkable

import jax.numpy as jnp
import numpy as np

from nermo_mjx.kinematics.body import attitude, turned_back
from nermo_mjx.kinematics.spine import joint_angle, yaw
from nermo_mjx.robot.geometry import Geometry, geometry_of
from nermo_mjx.robot.parameters import SERVOS, Sensors
from nermo_mjx.robot.quantity import choice, parameter_tree, quantity
from nermo_mjx.shapes import Array, Scalar, Scalars

# ---
# The robot's heading without its sway, from the attitude of its torso and the bend of its spine.
#
# Head and tail react to the torso's deviation from its course. The course is the heading of the body, half-way between
# torso and hip, followed by a critically damped observer: with x the measured heading, b the bandwidth and T the tick,
#
#     e = wrap(x - (c + T r)),    c <- c + T r + 2 T b e,    r <- r + T b^2 e,
#
# so that it has no lag in a steady turn.


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


class CourseEstimate(NamedTuple):
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


def observe_course(
    course: CourseEstimate, sensors: Sensors, bandwidth: Any, dt: float, geometry: Geometry
) -> CourseEstimate:
    """The course one tick of T = `dt` [s] later; motion faster than the bandwidth b [rad/s] counts as sway."""
    expected = course.heading + dt * course.rate
    surprise = wrapped(body_heading(sensors, geometry) - expected)
    gain = dt * bandwidth
    return CourseEstimate(
        expected + 2.0 * gain * surprise, course.rate + gain * bandwidth * surprise
    )


def wrapped(angle: Array) -> Array:
    """The angle, wrapped to (-pi, pi] [rad]."""
    return angle - 2.0 * jnp.pi * jnp.round(angle / (2.0 * jnp.pi))


# ---
# Control of the head or of the tail: with the gait, or against the torso's deviation from the robot's course.


Angles_co = TypeVar("Angles_co", covariant=True)
Angles = TypeVar("Angles")


@runtime_checkable
class AppendageLike(Protocol[Angles_co]):
    """Commands servo angles: pure functions of parameters and their own memory, any pytree. Values are unbatched."""

    def start(self, params: Any, pace: Pace) -> tuple[Any, Angles_co]:
        """Memory and angles before the first sensor reading; the start pose is built from them."""

    def init(self, params: Any, memory: Any, sensors: Sensors) -> Any:
        """The memory of `start` updated with the first readings."""

    def update(
        self, params: Any, memory: Any, sensors: Sensors, pace: Pace, dt: float
    ) -> tuple[Any, Angles_co]:
        """Memory and angles one control tick of `dt` seconds later."""


@dataclasses.dataclass(frozen=True)
class Appendage(AppendageLike[Angles]):
    """Angles by functions; their memory is the robot's course, where they need it.

    Attributes:
        group: name of its parameters among the controller's.
        held: angles, a function of these parameters and of the pace.
        moving: angles from the first reading on, also a function of the sensors and of the robot's course.
        on_course: whether the course is observed, with the bandwidth among the parameters; else it is ().
    """

    group: str
    held: Callable[[Any, Pace], Angles]
    moving: Callable[..., Angles] | None = None
    on_course: bool = False

    def start(self, params: Any, pace: Pace) -> tuple[Any, Angles]:
        memory = CourseEstimate(jnp.zeros(()), jnp.zeros(())) if self.on_course else ()
        return memory, self.held(getattr(params, self.group), pace)

    def init(self, params: Any, memory: Any, sensors: Sensors) -> Any:
        if not self.on_course:
            return memory
        heading = body_heading(sensors, geometry_of(params))
        return CourseEstimate(heading, jnp.zeros_like(heading))

    def update(
        self, params: Any, memory: Any, sensors: Sensors, pace: Pace, dt: float
    ) -> tuple[Any, Angles]:
        group = getattr(params, self.group)
        if self.on_course:
            memory = observe_course(
                memory, sensors, group.bandwidth * pace.cycle_rate, dt, geometry_of(params)
            )
        return memory, self.held(group, pace) if self.moving is None else self.moving(
            group, pace, sensors, memory
        )


GAZE: Final = "gaze"


@parameter_tree
class Head:
    """Direction of the head, and stabilisation of its gaze; the tilt needs a robot with a servo for it."""

    pan: Any = quantity(0.0, "rad", -1.0, 1.0, "neck beside straight ahead, positive left")
    tilt: Any = quantity(0.0, "rad", -1.0, 1.0, "head from level, positive down")
    into_turn: Any = quantity(0.0, "rad", -1.0, 1.0, "how far the neck looks into a full turn")
    gain: Any = quantity(1.0, "1", 0.0, 2.0, "share of the torso's sway that the gaze takes out")
    bandwidth: Any = quantity(
        0.5, "rad", 0.01, 10.0, "bandwidth of the course that the gaze holds, per gait cycle"
    )
    lead: Any = quantity(
        0.0, "s", 0.0, 0.2, "how far ahead the gyro carries the torso's rotation, for slow servos"
    )


class HeadAngles(NamedTuple):
    """Commanded servo angles of the head [rad]: of the neck, positive left, and of the tilt, positive down."""

    neck: Scalars
    tilt: Scalars


HeadLike = AppendageLike[HeadAngles]


def head_held(head: Head, pace: Pace) -> HeadAngles:
    """Looks in the torso's direction, offset by `head.pan`, `head.tilt` and `head.into_turn`."""
    neck = head.pan + head.into_turn * pace.turn_rate
    return HeadAngles(neck, jnp.zeros_like(neck) + head.tilt)


def gaze(head: Head, pace: Pace, sensors: Sensors, course: CourseEstimate) -> HeadAngles:
    """Looks along the robot's course and level, with the offsets that `held` has from the torso's direction."""
    offset = head_held(head, pace)
    heading, down = course.heading + offset.neck, offset.tilt
    level = jnp.cos(down)
    direction = jnp.stack([level * jnp.sin(heading), -level * jnp.cos(heading), -jnp.sin(down)])
    target_direction = turned_back(sensors.orientation, direction)
    target_direction = target_direction + head.lead * jnp.cross(target_direction, sensors.gyro)
    level = jnp.sqrt(target_direction[0] ** 2 + target_direction[1] ** 2 + 1e-12)
    target = HeadAngles(
        jnp.arctan2(target_direction[0], -target_direction[1]),
        jnp.arctan2(-target_direction[2], level),
    )
    return HeadAngles(
        *(angle + head.gain * (to - angle) for angle, to in zip(offset, target, strict=True))
    )


_HEAD_MODES: Final[dict[str, HeadLike]] = {
    "none": Appendage("head", head_held),
    GAZE: Appendage("head", head_held, gaze, on_course=True),
}
HeadName = Literal["none", "gaze"]
HEAD_NAMES: Final = get_args(HeadName)


def named_head(name: str = "none") -> HeadLike:
    """The head control of this name in `HEAD_NAMES`."""
    return _HEAD_MODES[choice("head", name, HEAD_NAMES)]


# ---
# Tail control: held still, swinging with the gait, or moving against the sway of the body.
#
# The swing is that of the author's software, min(4.5 v^2, 0.5) cos(2 pi phase) at the commanded speed v. His positive
# angle bends the tail's tip to the right (measured on his model), here it is the left: hence `tail.swing_phase` is pi.
#
# Against the yaw of the body it takes up angular momentum: when the torso turns to the left, so does the tail, which
# moves its tip to the right. Against roll it acts as a prop, since its tip touches the ground: it moves to the side to
# which the torso leans. As a counterweight it would move to the other side, with which the simulated robot rolls more.


SWING, COUNTER_YAW, COUNTER_ROLL = "swing", "counter_yaw", "counter_roll"


@parameter_tree
class Tail:
    """How the articulated tail moves; a positive servo angle moves the tip to the left."""

    angle: Any = quantity(0.0, "rad", -1.0, 1.0, "servo angle about which it moves")
    swing_amplitude: Any = quantity(0.5, "rad", 0.0, 1.0, "largest servo amplitude of the swing")
    swing_gain: Any = quantity(
        4.5,
        "rad s^2/m^2",
        0.0,
        1e4,
        "servo amplitude of the swing over the square of commanded_speed",
    )
    swing_phase: Any = quantity(
        np.pi, "rad", -2 * np.pi, 2 * np.pi, "of the swing A cos(2 pi phase + tail.swing_phase)"
    )
    # Both were chosen by sweeps of the trot at 0.8 Hz (docs/control.md): with higher values the robot rolls or slows
    # down.
    yaw_gain: Any = quantity(
        2.0, "1", -10.0, 10.0, "servo angle against the torso's yaw off course"
    )
    roll_gain: Any = quantity(2.0, "1", -10.0, 10.0, "servo angle over the torso's roll")
    bandwidth: Any = quantity(
        0.5, "rad", 0.01, 10.0, "bandwidth of the course that yaw is counted from, per gait cycle"
    )


#: Its angle is that of the tail's servo, positive bends the tip to the left [rad].
TailLike = AppendageLike[Scalar]


def tail_held(tail: Tail, pace: Pace) -> Scalars:
    """Stays at `tail.angle`."""
    return jnp.zeros_like(pace.phase) + tail.angle


def swing(tail: Tail, pace: Pace) -> Scalars:
    """Swings once per gait cycle about `tail.angle`, as in the author's software."""
    amplitude = jnp.minimum(tail.swing_gain * pace.speed**2, tail.swing_amplitude)
    return tail_held(tail, pace) + amplitude * jnp.cos(2.0 * jnp.pi * pace.phase + tail.swing_phase)


def counter_yaw(tail: Tail, pace: Pace, sensors: Sensors, course: CourseEstimate) -> Scalars:
    """Bends to the right by `tail.yaw_gain` times the torso's yaw to the left of the robot's course."""
    return tail.angle - tail.yaw_gain * wrapped(attitude(sensors.orientation)[2] - course.heading)


def counter_roll(tail: Tail, pace: Pace, sensors: Sensors, course: Any) -> Scalars:
    """Bends to the side to which the torso leans, by `tail.roll_gain` times its roll."""
    return tail.angle + tail.roll_gain * attitude(sensors.orientation)[0]


@dataclasses.dataclass(frozen=True)
class SeveralTails(AppendageLike[Scalars]):
    """The sum of motions about `tail.angle`, of which a schedule switches some on and some off."""

    parts: tuple[TailLike, ...]

    def start(self, params: Any, pace: Pace) -> tuple[Any, Scalars]:
        return self._sum(params, pace, [part.start(params, pace) for part in self.parts])

    def init(self, params: Any, memory: Any, sensors: Sensors) -> Any:
        return tuple(
            part.init(params, tail_memory, sensors)
            for part, tail_memory in zip(self.parts, memory, strict=True)
        )

    def update(
        self, params: Any, memory: Any, sensors: Sensors, pace: Pace, dt: float
    ) -> tuple[Any, Scalars]:
        parts = zip(self.parts, memory, strict=True)
        return self._sum(
            params,
            pace,
            [part.update(params, tail_memory, sensors, pace, dt) for part, tail_memory in parts],
        )

    def _sum(
        self, params: Any, pace: Pace, parts: list[tuple[Any, Scalars]]
    ) -> tuple[Any, Scalars]:
        memories, angles = zip(*parts, strict=True)
        still = tail_held(params.tail, pace)
        return memories, sum((angle - still for angle in angles), still)


_TAIL_MODES: Final[dict[str, TailLike]] = {
    "none": Appendage("tail", tail_held),
    SWING: Appendage("tail", swing),
    COUNTER_YAW: Appendage("tail", tail_held, counter_yaw, on_course=True),
    COUNTER_ROLL: Appendage("tail", tail_held, counter_roll),
}
TailMotionName = Literal["none", "swing", "counter_yaw", "counter_roll"]
TAIL_MOTIONS: Final = get_args(TailMotionName)


def named_tail(name: str = "none") -> TailLike:
    """The tail control of this name in `TAIL_MOTIONS`, or of several joined by "+"."""
    parts = tuple(
        _TAIL_MODES[choice("tail_motion", part, TAIL_MOTIONS)] for part in name.split("+")
    )
    return parts[0] if len(parts) == 1 else SeveralTails(parts)
