"""The pilot, the high-level controller: speed and turn rate from the sensors, or from a command given beforehand.

A path is a function from a position to its cross-track error, positive where the robot is to the **left** of the path,
and one to its curvature there, positive where it bends to the left. Paths are fixed in the world and start at its
origin, heading -y.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.control.parameters import Pilot
from nermo_mjx.robot.quantity import ParameterError

#: Rate on the controller's clock for which the published gain on the change of the error holds [Hz].
PUBLISHED_PILOT_RATE: Final = 50.0

#: A function from simulated time [s] to (speed [m/s of the controller's clock], turn rate in [-1, 1]).
Command = Callable[[Any], tuple[Any, Any]]


def straight(pilot: Pilot, position: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Cross-track error of the line x = 0, heading -y [m]."""
    return position[..., 0]


def arc(pilot: Pilot, position: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Cross-track error of the circle that leaves the origin along -y and bends to `direction` [m].

    With the centre at (s R, 0), s = +1 left: e = s (R - |p - centre|), written without the difference of two large
    numbers, so that a radius of a kilometre keeps its millimetres in float32.
    """
    x, y = position[..., 0], position[..., 1]
    side = _side(pilot)
    squared = (x - side * pilot.radius) ** 2 + y**2
    distance = jnp.sqrt(jnp.maximum(squared, 1e-12))
    return side * (2.0 * side * pilot.radius * x - x**2 - y**2) / (pilot.radius + distance)


def arc_curvature(pilot: Pilot, position: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """1/radius with the sign of `direction` [1/m], wherever the robot is."""
    return jnp.broadcast_to(_side(pilot) / pilot.radius, position.shape[:-1])


def _side(pilot: Pilot) -> Array:
    return jnp.where(jnp.asarray(pilot.direction) >= 0.0, 1.0, -1.0)


#: The paths that a pilot can follow, by the pilot's name, and the curvature of those that are not straight.
PATHS: Final[dict[str, Callable[[Pilot, Array], Array]]] = {"straight": straight, "arc": arc}
CURVATURES: Final[dict[str, Callable[[Pilot, Array], Array]]] = {"arc": arc_curvature}
PILOTS: Final = ("open_loop", *PATHS, "external")


def cross_track_error(path: str, pilot: Pilot, position: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Signed distance to the left of the named path [m]; zero for a pilot that follows none."""
    if path not in PATHS:
        return jnp.zeros_like(position[..., 0])
    return PATHS[path](pilot, jnp.clip(position, -1e6, 1e6))


def tangent(path: str, pilot: Pilot, position: Float[Array, " 3"]) -> Float[Array, " 2"]:
    """Direction (x, y) of the named path beside a position: the error's gradient points left, its right is ahead."""
    left = jax.grad(lambda point: cross_track_error(path, pilot, point))(position)
    ahead = jnp.stack([left[1], -left[0]])
    return ahead / jnp.sqrt(jnp.sum(ahead**2) + 1e-12)


def steer(
    pilot: Pilot,
    error: Float[Array, "*batch"],
    change: Float[Array, "*batch"],
    ahead: Float[Array, "*batch"] | float = 0.0,
) -> Float[Array, "*batch"]:
    """PD on the cross-track error: a robot to the left of its path is steered to the right.

    Args:
        pilot: gains and output limit.
        error: cross-track error, positive to the left of the path [m].
        change: its change in 1/50 s of the controller's clock [m].
        ahead: turn rate of the feed-forward, to which the PD adds.
    """
    wanted = ahead - (pilot.error_gain * error + pilot.change_gain * change)
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
