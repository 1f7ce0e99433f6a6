"""The pilot, the high-level controller: speed and turn rate that follow a path, or that are prescribed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from nermo_mjx.control import guidance, turning
from nermo_mjx.control.course import Course, locate
from nermo_mjx.control.parameters import ControlParameters, Pilot
from nermo_mjx.control.path import PATHS, PathPoint, straight
from nermo_mjx.control.published import PUBLISHED_RATE
from nermo_mjx.kinematics.spine import joint_angle, yaw
from nermo_mjx.robot.geometry import Geometry, geometry_of
from nermo_mjx.robot.interface import SERVOS, Sensors
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.shapes import Array, Scalar, Scalars, Truth

#: A function from simulated time [s] to (speed [m/s of the controller's clock], turn rate in [-1, 1]).
Command = Callable[[Any], tuple[Any, Any]]

WAYPOINTS: Final = "waypoints"
PILOTS: Final = ("open_loop", *PATHS, WAYPOINTS, "external")


class Drive(NamedTuple):
    """A pilot's output.

    Attributes:
        speed: commanded [m/s of the controller's clock].
        turn_rate: in [-1, 1], positive left.
    """

    speed: Scalar
    turn_rate: Scalar


class Walk(NamedTuple):
    """A pilot's inputs, in addition to the sensors.

    Attributes:
        time: simulated, since the start [s].
        phase: of the gait cycle.
        speed, yaw_rate: expected without slip from the legs' current strides [m/s, rad/s of simulated time].
        due: whether the pilot's output at this tick is used.
        rate: pilot ticks per simulated second [Hz].
    """

    time: Scalar
    phase: Scalar
    speed: Scalar
    yaw_rate: Scalar
    due: Truth
    rate: float


@runtime_checkable
class PilotLike(Protocol):
    """A pilot: pure functions of its parameters and its own memory, any pytree. Values are unbatched.

    If it has a method `path(params, memory, position) -> PathPoint`, the path error is measured (`cross_track_rms`).
    """

    def start(self, params: Any) -> tuple[Any, Drive]:
        """Memory and drive of a robot at the beginning of the path; the start pose is built from them."""

    def init(self, params: Any, memory: Any, sensors: Sensors, walk: Walk) -> Any:
        """The memory of `start` updated with the first readings."""

    def update(self, params: Any, memory: Any, sensors: Sensors, walk: Walk) -> tuple[Any, Drive]:
        """New memory and drive; both are held until the next pilot tick."""


def limited(speed: Any, turn_rate: Any) -> Drive:
    """A drive within its limits: speeds from 0, turn rates in [-1, 1]."""
    return Drive(jnp.maximum(jnp.asarray(speed), 0.0), jnp.clip(jnp.asarray(turn_rate), -1.0, 1.0))


@dataclasses.dataclass(frozen=True)
class OpenLoop(PilotLike):
    """Holds the gait's speed and `pilot.turn_rate`."""

    def start(self, params: ControlParameters) -> tuple[Any, Drive]:
        return (), limited(params.gait.speed, params.pilot.turn_rate)

    def init(self, params: ControlParameters, memory: Any, sensors: Sensors, walk: Walk) -> Any:
        return memory

    def update(self, params: ControlParameters, memory: Any, sensors: Sensors, walk: Walk) -> tuple[Any, Drive]:
        return self.start(params)


@dataclasses.dataclass(frozen=True)
class External(PilotLike):
    """Follows a command over time; see `tabulated`."""

    command: Command

    def start(self, params: ControlParameters) -> tuple[Any, Drive]:
        return (), limited(*self.command(jnp.zeros(())))

    def init(self, params: ControlParameters, memory: Any, sensors: Sensors, walk: Walk) -> Any:
        return memory

    def update(self, params: ControlParameters, memory: Any, sensors: Sensors, walk: Walk) -> tuple[Any, Drive]:
        return memory, limited(*self.command(walk.time))


class Beside(NamedTuple):
    """Memory of `Follow`: the point of the path closest to the robot, and the estimate of its course there."""

    point: PathPoint
    guidance: guidance.Guidance


@dataclasses.dataclass(frozen=True)
class Follow(PilotLike):
    """Follows a path at the gait's speed.

    Attributes:
        along: a function of `path.PATHS`' form, from parameters and a position to a `PathPoint`, or a `Course`.
    """

    along: Callable[[Pilot, Array], PathPoint] | Course = straight

    def locate(self, params: ControlParameters, position: Float[Array, " 3"], progress: Scalar) -> PathPoint:
        """The point of the path closest to a position.

        Args:
            params: unbatched.
            position: in the world [m].
            progress: of the last point, for a path that approaches itself [m].
        """
        if isinstance(self.along, Course):
            return locate(self.along, progress, position)
        return self.along(params.pilot, position)

    def path(self, params: ControlParameters, memory: Beside, position: Float[Array, " 3"]) -> PathPoint:
        """The point of the path closest to a position, for metrics."""
        return self.locate(params, position, memory.point.progress)

    def start(self, params: ControlParameters) -> tuple[Beside, Drive]:
        zero = jnp.zeros(())
        point = self.locate(params, jnp.zeros(3), zero)
        return Beside(point, guidance.start(zero, zero, zero)), self._guided(params, point.curvature)

    def init(self, params: ControlParameters, memory: Beside, sensors: Sensors, walk: Walk) -> Beside:
        point = self.locate(params, sensors.position, memory.point.progress)
        return Beside(point, guidance.start(point.error, heading(point, sensors, geometry_of(params)), walk.speed))

    def update(self, params: ControlParameters, memory: Beside, sensors: Sensors, walk: Walk) -> tuple[Beside, Drive]:
        point = self.locate(params, sensors.position, memory.point.progress)
        seen = jnp.stack([point.error, heading(point, sensors, geometry_of(params))])
        estimate = guidance.observe(
            params.pilot, memory.guidance, seen, walk.phase, walk.speed,
            params.pilot.grip * walk.yaw_rate - walk.speed * point.curvature,
            params.gait.frequency / params.tracking.clock_ratio, 1.0 / walk.rate,
        )  # fmt: skip
        curvature = point.curvature + guidance.correction(params.pilot, estimate, walk.speed, point.curvature)
        # Avoids Newton steps for a turn rate that is not used.
        speed, turn_rate = self._guided(params, jnp.where(walk.due, curvature, 0.0))
        published_ticks = PUBLISHED_RATE / (walk.rate * params.tracking.clock_ratio)
        change = (point.error - memory.point.error) / published_ticks
        return Beside(point, estimate), Drive(speed, steer(params.pilot, point.error, change, turn_rate))

    def _guided(self, params: ControlParameters, curvature: Scalar) -> Drive:
        """The gait's speed, and the turn rate for a curvature [1/m]."""
        turn_rate = params.pilot.guidance * turning.turn_rate_for(params, curvature / params.pilot.grip)
        return limited(params.gait.speed, turn_rate)


def heading(point: PathPoint, sensors: Sensors, geometry: Geometry) -> Scalar:
    """Heading of the robot relative to the tangent of its path [rad], positive left, in (-pi, pi].

    A bent spine turns torso and hip to opposite sides of it, so it is the torso's minus half of the bend.

    Args:
        point: of the path, closest to the robot.
        sensors: orientation and the spine's servo angle are used.
        geometry: of the robot.
    """
    w, x, y, z = sensors.orientation
    ahead = jnp.stack([2.0 * (w * z - x * y), 2.0 * (x * x + z * z) - 1.0])
    across = point.tangent[0] * ahead[1] - point.tangent[1] * ahead[0]
    along = jnp.sum(point.tangent * ahead)
    bend = yaw(joint_angle(sensors.servo_angle[SERVOS.index("spine")], geometry))
    return jnp.arctan2(across, along) - 0.5 * bend


def steer(
    pilot: Pilot,
    error: Scalars,
    change: Scalars,
    guided: Scalars | float = 0.0,
) -> Scalars:
    """Turn rate of the published PD on the cross-track error, added to the guidance's; left of the path it is negative.

    Args:
        pilot: gains and output limit.
        error: cross-track error, positive to the left of the path [m].
        change: its change in 1/100 s of the controller's clock [m].
        guided: turn rate of the guidance.
    """
    wanted = guided - (pilot.error_gain * error + pilot.change_gain * change)
    return jnp.clip(wanted, -pilot.output_limit, pilot.output_limit)


@dataclasses.dataclass(frozen=True)
class Tabulated:
    """A command given as a table over time, see `tabulated`. Hashable by value, as `Controller` needs."""

    time: tuple[float, ...]
    speed: tuple[float, ...]
    turn_rate: tuple[float, ...]
    hold: bool = False

    def __call__(self, time: Scalar) -> tuple[Scalar, Scalar]:
        """(speed, turn rate) at `time`; before the first and after the last row, that row's."""
        times, speed, turn = (jnp.asarray(column) for column in (self.time, self.speed, self.turn_rate))
        if self.hold:
            row = jnp.clip(jnp.searchsorted(times, time, side="right") - 1, 0, len(self.time) - 1)
            return speed[row], turn[row]
        return jnp.interp(time, times, speed), jnp.interp(time, times, turn)


def tabulated(time: ArrayLike, speed: ArrayLike, turn_rate: ArrayLike, *, hold: bool = False) -> Tabulated:
    """A command for the pilot `external` from arrays over time.

    Args:
        time: strictly increasing, simulated time [s].
        speed: commanded, a number, or one per time [m/s of the controller's clock]. The stride saturates.
        turn_rate: in [-1, 1], positive left, a number, or one per time.
        hold: keep each row until the next one begins, instead of interpolating linearly.

    Raises:
        ParameterError: the columns have different lengths, are not finite, or are out of range.
    """
    times = _column("command.time", time)
    if times.ndim != 1 or times.size == 0:
        raise ParameterError(f"command.time has shape {times.shape}: expected one dimension and at least one entry.")
    if (np.diff(times) <= 0).any():
        raise ParameterError(f"command.time is not increasing at {times[1:][np.diff(times) <= 0][0]:g} s.")
    columns = []
    for name, given, low, high in (("speed", speed, 0.0, np.inf), ("turn_rate", turn_rate, -1.0, 1.0)):
        column = _column(f"command.{name}", given)
        if column.shape not in ((), times.shape):
            raise ParameterError(f"command.{name} has shape {column.shape}: expected {times.shape}, as command.time.")
        bad = (column < low) | (column > high)
        if bad.any():
            raise ParameterError(f"command.{name} is {column[bad].flat[0]:g}: allowed is [{low:g}, {high:g}].")
        columns.append(tuple(np.broadcast_to(column, times.shape).tolist()))
    return Tabulated(tuple(times.tolist()), columns[0], columns[1], hold)


def _column(name: str, values: Any) -> np.ndarray:
    try:
        column = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(f"{name} is {values!r}: expected numbers.") from None
    if not np.isfinite(column).all():
        raise ParameterError(f"{name} is {column[~np.isfinite(column)].flat[0]:g}: expected finite numbers.")
    return column
