"""The pilot, the high-level controller: turn rate from the cross-track error, or a command given beforehand."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.control.course import Course, locate
from nermo_mjx.control.parameters import Pilot
from nermo_mjx.control.path import PATHS, PathPoint
from nermo_mjx.kinematics.spine import joint_angle, yaw
from nermo_mjx.robot.interface import SERVOS, Sensors
from nermo_mjx.robot.quantity import ParameterError

#: Rate on the controller's clock for which the published gain on the change of the error holds [Hz].
PUBLISHED_PILOT_RATE: Final = 50.0

#: A function from simulated time [s] to (speed [m/s of the controller's clock], turn rate in [-1, 1]).
Command = Callable[[Any], tuple[Any, Any]]


WAYPOINTS: Final = "waypoints"
#: Pilots that follow a path, and all of them.
FOLLOWERS: Final = (*PATHS, WAYPOINTS)
PILOTS: Final = ("open_loop", *FOLLOWERS, "external")


def path_point(
    name: str, course: Course | None, pilot: Pilot, position: Float[Array, " 3"], progress: Float[Array, ""]
) -> PathPoint:
    """The point of the named pilot's path beside a position; of the line straight ahead for a pilot without a path.

    Args:
        name: of `PILOTS`.
        course: of the pilot `waypoints`.
        pilot: parameters of the paths.
        position: in the world [m].
        progress: of the last point on the course [m].
    """
    if name == WAYPOINTS:
        assert course is not None
        return locate(course, progress, position)
    return PATHS.get(name, PATHS["straight"])(pilot, position)


def heading(point: PathPoint, sensors: Sensors) -> Float[Array, ""]:
    """Heading of the robot from the tangent of its path [rad], positive left, in (-pi, pi].

    A bent spine turns torso and hip to opposite sides of it, so it is the torso's less half of the bend.

    Args:
        point: of the path, beside the robot.
        sensors: orientation and the spine's servo angle count.
    """
    w, x, y, z = sensors.orientation
    ahead = jnp.stack([2.0 * (w * z - x * y), 2.0 * (x * x + z * z) - 1.0])
    across = point.tangent[0] * ahead[1] - point.tangent[1] * ahead[0]
    along = jnp.sum(point.tangent * ahead)
    bend = yaw(joint_angle(sensors.servo_angle[SERVOS.index("spine")]))
    return jnp.arctan2(across, along) - 0.5 * bend


def steer(
    pilot: Pilot,
    error: Float[Array, "*batch"],
    change: Float[Array, "*batch"],
    guided: Float[Array, "*batch"] | float = 0.0,
) -> Float[Array, "*batch"]:
    """Turn rate of the published PD on the cross-track error, added to the guidance's; left of the path it is negative.

    Args:
        pilot: gains and output limit.
        error: cross-track error, positive to the left of the path [m].
        change: its change in 1/50 s of the controller's clock [m].
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

    def __call__(self, time: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """(speed, turn rate) at `time`; before the first and after the last row, that row's."""
        times, speed, turn = (jnp.asarray(column) for column in (self.time, self.speed, self.turn_rate))
        if self.hold:
            row = jnp.clip(jnp.searchsorted(times, time, side="right") - 1, 0, len(self.time) - 1)
            return speed[row], turn[row]
        return jnp.interp(time, times, speed), jnp.interp(time, times, turn)


def tabulated(
    time: Sequence[float], speed: Sequence[float] | float, turn_rate: Sequence[float] | float, *, hold: bool = False
) -> Tabulated:
    """A command for the pilot `external` from arrays over time.

    Args:
        time: strictly increasing, simulated time [s].
        speed: commanded, one for each time or one for all [m/s of the controller's clock]. The stride saturates.
        turn_rate: in [-1, 1], positive left, one for each time or one for all.
        hold: keep each row until the next one begins, instead of interpolating linearly.

    Raises:
        ParameterError: the columns do not fit together, are not finite, or are out of range.
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
