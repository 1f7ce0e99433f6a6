"""The pilot, the high-level controller: it commands speed and turn rate, so that the robot follows a path, or as prescribed.

A pilot returns a `Drive` from the sensors and a `Walk`. `OpenLoop` and `External` prescribe the drive; `Follow` follows a
path, with the published PD controller (`steer`) and the guidance of the profile `exact` (second half of this file).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Final, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from nermo_mjx.control import turning
from nermo_mjx.control.parameters import PUBLISHED_RATE_HZ, ControlParameters, Pilot
from nermo_mjx.control.path import Course, PathPoint, locate, straight
from nermo_mjx.kinematics.spine import joint_angle, yaw
from nermo_mjx.robot.geometry import Geometry, geometry_of
from nermo_mjx.robot.parameters import SERVOS, Sensors
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.shapes import Array, Scalar, Scalars, Truth

#: A function from simulated time [s] to (speed [m/s of the controller's clock], turn rate in [-1, 1]).
Command = Callable[[Any], tuple[Any, Any]]

WAYPOINTS: Final = "waypoints"
PilotName = Literal["open_loop", "straight", "arc", "waypoints", "external"]


class Drive(NamedTuple):
    """A pilot's output.

    Attributes:
        speed: Commanded speed [m/s of the controller's clock].
        turn_rate: Commanded turn rate, in [-1, 1], positive left.
    """

    speed: Scalar
    turn_rate: Scalar


class Walk(NamedTuple):
    """A pilot's inputs, in addition to the sensors.

    Attributes:
        time: Simulated time since the start [s].
        phase: Phase of the gait cycle, in [0, 1).
        speed, yaw_rate: Speed and yaw rate of the present strides without slip [m/s, rad/s of simulated time].
        due: Whether the pilot's output at this control tick is used; otherwise the last output is held.
        rate: Pilot ticks per simulated second [Hz].
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
        """Return memory and drive of a robot at the beginning of the path; its initial pose follows from them."""

    def init(self, params: Any, memory: Any, sensors: Sensors, walk: Walk) -> Any:
        """Return the memory of `start`, updated with the first readings; by default it is unchanged."""
        return memory

    def update(self, params: Any, memory: Any, sensors: Sensors, walk: Walk) -> tuple[Any, Drive]:
        """Return new memory and drive; both are held until the next pilot tick."""


def limited(speed: Any, turn_rate: Any) -> Drive:
    """Return the drive within its limits: a speed of at least 0, and a turn rate in [-1, 1]."""
    return Drive(jnp.maximum(jnp.asarray(speed), 0.0), jnp.clip(jnp.asarray(turn_rate), -1.0, 1.0))


@dataclasses.dataclass(frozen=True)
class OpenLoop(PilotLike):
    """Holds the gait's speed and `pilot.turn_rate`."""

    def start(self, params: ControlParameters) -> tuple[Any, Drive]:
        return (), limited(params.gait.commanded_speed, params.pilot.turn_rate)

    def update(
        self, params: ControlParameters, memory: Any, sensors: Sensors, walk: Walk
    ) -> tuple[Any, Drive]:
        return self.start(params)


@dataclasses.dataclass(frozen=True)
class External(PilotLike):
    """Follows a command over time; see `tabulated`."""

    command: Command

    def start(self, params: ControlParameters) -> tuple[Any, Drive]:
        return (), limited(*self.command(jnp.zeros(())))

    def update(
        self, params: ControlParameters, memory: Any, sensors: Sensors, walk: Walk
    ) -> tuple[Any, Drive]:
        return memory, limited(*self.command(walk.time))


class Beside(NamedTuple):
    """Memory of `Follow`: the point of the path closest to the robot, and the estimate of its course there."""

    point: PathPoint
    guidance: Guidance


@dataclasses.dataclass(frozen=True)
class Follow(PilotLike):
    """Follows a path at the gait's speed.

    Attributes:
        along: The path: a `Course`, or a function as in `path.PATHS`, from parameters and a position to a `PathPoint`.
    """

    along: Callable[[Pilot, Array], PathPoint] | Course = straight

    def locate(
        self, params: ControlParameters, position: Float[Array, " 3"], progress: Scalar
    ) -> PathPoint:
        """Return the point of the path closest to a position [m].

        Args:
            params: Parameters of the controller.
            position: Position of the robot [m].
            progress: Distance along the path at the last tick [m]. A path that approaches itself is searched near it.
        """
        if isinstance(self.along, Course):
            return locate(self.along, progress, position)
        return self.along(params.pilot, position)

    def path(
        self, params: ControlParameters, memory: Beside, position: Float[Array, " 3"]
    ) -> PathPoint:
        """Return the point of the path closest to a position [m], for metrics."""
        return self.locate(params, position, memory.point.progress)

    def start(self, params: ControlParameters) -> tuple[Beside, Drive]:
        zero = jnp.zeros(())
        point = self.locate(params, jnp.zeros(3), zero)
        return Beside(point, start(zero, zero, zero)), self._guided(params, point.curvature)

    def init(
        self, params: ControlParameters, memory: Beside, sensors: Sensors, walk: Walk
    ) -> Beside:
        point = self.locate(params, sensors.position, memory.point.progress)
        return Beside(
            point, start(point.error, heading(point, sensors, geometry_of(params)), walk.speed)
        )

    def update(
        self, params: ControlParameters, memory: Beside, sensors: Sensors, walk: Walk
    ) -> tuple[Beside, Drive]:
        point = self.locate(params, sensors.position, memory.point.progress)
        observation = jnp.stack([point.error, heading(point, sensors, geometry_of(params))])
        estimate = observe(
            params.pilot,
            memory.guidance,
            observation,
            walk.phase,
            walk.speed,
            params.pilot.grip * walk.yaw_rate - walk.speed * point.curvature,
            params.gait.frequency / params.tracking.clock_ratio,
            1.0 / walk.rate,
        )
        curvature = point.curvature + correction(
            params.pilot, estimate, walk.speed, point.curvature
        )
        # A curvature of 0 avoids Newton steps for a turn rate that is not used.
        speed, turn_rate = self._guided(params, jnp.where(walk.due, curvature, 0.0))
        # The published PD controller takes the change of the error in one tick of its own rate.
        published_ticks = PUBLISHED_RATE_HZ / (walk.rate * params.tracking.clock_ratio)
        change = (point.error - memory.point.error) / published_ticks
        return Beside(point, estimate), Drive(
            speed, steer(params.pilot, point.error, change, turn_rate)
        )

    def _guided(self, params: ControlParameters, curvature: Scalar) -> Drive:
        """Return the gait's speed, and the turn rate for a curvature [1/m]."""
        turn_rate = params.pilot.guidance * turning.turn_rate_for(
            params, curvature / params.pilot.grip
        )
        return limited(params.gait.commanded_speed, turn_rate)


def heading(point: PathPoint, sensors: Sensors, geometry: Geometry) -> Scalar:
    """Return the heading of the robot relative to the tangent of its path [rad], positive left, in (-pi, pi].

    A bent spine turns torso and hip to opposite sides of the heading, so the heading is the yaw of the torso minus half of
    the bend.
    """
    w, x, y, z = sensors.orientation
    ahead = jnp.stack([2.0 * (w * z - x * y), 2.0 * (x * x + z * z) - 1.0])
    across = point.tangent[0] * ahead[1] - point.tangent[1] * ahead[0]
    along = jnp.sum(point.tangent * ahead)
    bend = yaw(joint_angle(sensors.servo_angle[SERVOS.index("spine")], geometry))
    return jnp.arctan2(across, along) - 0.5 * bend


def steer(pilot: Pilot, error: Scalars, change: Scalars, guided: Scalars | float = 0.0) -> Scalars:
    """Add the turn rate of the published PD controller to the turn rate of the guidance, and limit the sum.

    The PD controller turns right, with a negative turn rate, if the robot is left of the path.

    Args:
        pilot: Gains and limit.
        error: Cross-track error, positive to the left of the path [m].
        change: Change of the error in 1/100 s of the controller's clock [m].
        guided: Turn rate of the guidance.
    """
    command = guided - (pilot.error_gain * error + pilot.change_gain * change)
    return jnp.clip(command, -pilot.output_limit, pilot.output_limit)


@dataclasses.dataclass(frozen=True)
class Tabulated:
    """A command given as a table over time, see `tabulated`. Hashable by value, as `Controller` needs."""

    time: tuple[float, ...]
    speed: tuple[float, ...]
    turn_rate: tuple[float, ...]
    hold: bool = False

    def __call__(self, time: Scalar) -> tuple[Scalar, Scalar]:
        """Return (speed, turn rate) at `time`; before the first row and after the last one, the values of this row."""
        times, speed, turn = (
            jnp.asarray(column) for column in (self.time, self.speed, self.turn_rate)
        )
        if self.hold:
            row = jnp.clip(jnp.searchsorted(times, time, side="right") - 1, 0, len(self.time) - 1)
            return speed[row], turn[row]
        return jnp.interp(time, times, speed), jnp.interp(time, times, turn)


def tabulated(
    time: ArrayLike, speed: ArrayLike, turn_rate: ArrayLike, *, hold: bool = False
) -> Tabulated:
    """Return a command for the pilot `external` from arrays over time.

    Args:
        time: Simulated times in strictly increasing order [s].
        speed: Commanded speed, a number or one per time [m/s of the controller's clock]. The stride saturates.
        turn_rate: Commanded turn rate in [-1, 1], positive left, a number or one per time.
        hold: Whether each row is held until the next one begins, instead of a linear interpolation.

    Raises:
        ParameterError: The columns have different lengths, are not finite, or are out of range.
    """
    times = _column("time", time)
    if times.ndim != 1 or times.size == 0:
        raise ParameterError(
            f"command.time has shape {times.shape}: expected one dimension and at least one entry."
        )
    if (np.diff(times) <= 0).any():
        raise ParameterError(
            f"command.time is not increasing at {times[1:][np.diff(times) <= 0][0]:g} s."
        )
    columns = []
    for name, value, low, high in (
        ("speed", speed, 0.0, np.inf),
        ("turn_rate", turn_rate, -1.0, 1.0),
    ):
        column = _column(name, value)
        if column.shape not in ((), times.shape):
            raise ParameterError(
                f"command.{name} has shape {column.shape}: expected {times.shape}, as command.time."
            )
        bad = (column < low) | (column > high)
        if bad.any():
            raise ParameterError(
                f"command.{name} is {column[bad].flat[0]:g}: allowed is [{low:g}, {high:g}]."
            )
        columns.append(tuple(np.broadcast_to(column, times.shape).tolist()))
    return Tabulated(tuple(times.tolist()), columns[0], columns[1], hold)


def _column(name: str, values: Any) -> np.ndarray:
    try:
        column = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(f"command.{name} is {values!r}: expected numbers.") from None
    if not np.isfinite(column).all():
        raise ParameterError(
            f"command.{name} is {column[~np.isfinite(column)].flat[0]:g}: expected finite numbers."
        )
    return column


# ---
# Guidance of the profile `exact`: the commanded curvature, from a sway-free estimate of the course beside the path.
#
# The torso sways by a centimetre and yaws back and forth in every gait cycle, because the spine bends and the legs push
# alternately. A robot that steers against its sway limit-cycles, or steps longer on one side, since a leg adopts its
# new stride only when it switches; and each turn by the legs costs speed, since it shortens strides. The gait's phase
# is known, so the sway can be estimated together with the course, and ignored.
#
# Two observers of the same form track the cross-track error and the heading. Between two steps, the observed system (the
# plant) is linear: a double integrator for the course (the value, and the unexplained input that adds to the known one)
# and an oscillator for each harmonic of the sway. The gains place the poles for any gait frequency and pilot rate: with
# the plant's characteristic polynomial a(z) and the desired one p(z), the gains are the partial fractions of p(z) / a(z)
# at the plant's poles, in closed form.
#
# The heading is measured, not just predicted from the turn rate, because the prediction is inaccurate: with the spine's
# stride extension the trot responds to a turn by the legs with up to three times the yaw rate that it has without.


#: Harmonics of the gait cycle in the sway. On a straight line, right mirrors left after half a cycle, so that only odd
#: harmonics occur; a turn adds the second one. In trots with and without the spine, the amplitude is 5 to 8 mm in the
#: first harmonic, 1 to 2 mm in the third, and at most 0.3 mm in the second and fourth.
SWAY_HARMONICS: Final = (1, 2, 3)
#: Decay rate of the unexplained inputs relative to the other poles, for cross-track error and for heading. The robot may
#: turn twice or half as much as expected. When the unexplained yaw rate was estimated as fast as the course, the trot with
#: the spine oscillated with a period of four cycles.
DECAY_RATE_RATIOS: Final = (1.0, 0.4)
#: Look-ahead on a bend as a fraction of the radius, see `correction`.
BEND_RADIUS_SHARE: Final = 0.7
#: Longest step of the observer [gait cycles]: beyond it, a harmonic would alias to a slower one, or to its own mirror
#: image.
LONGEST_STEP_CYCLES: Final = 0.4 / max(SWAY_HARMONICS)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Guidance:
    """Estimate of the robot's position and heading relative to its path.

    Attributes:
        course: Cross-track error [m] and heading from the path's tangent [rad], without sway, positive left.
        unexplained: Inputs that the observers do not know: lateral speed relative to the heading [m/s], and yaw rate
            minus the yaw rate expected from the strides [rad/s].
        sway: Amplitudes of the sway of both, cosine and sine of each of `SWAY_HARMONICS` at the gait's phase [m, rad].
        cycles: Time observed since the start [gait cycles].
    """

    course: Float[Array, " 2"]
    unexplained: Float[Array, " 2"]
    sway: Float[Array, "2 harmonics 2"]
    cycles: Scalar


def start(error: Scalar, heading: Scalar, speed: Scalar) -> Guidance:
    """Return the estimate at rest from cross-track error [m], heading from the path's tangent [rad] and speed [m/s].

    The robot is assumed to walk along its path, whatever the torso's direction.
    """
    zero = jnp.zeros_like(error)
    return Guidance(
        course=jnp.stack([error, heading]),
        unexplained=jnp.stack([-speed * heading, zero]),
        sway=jnp.zeros((2, len(SWAY_HARMONICS), 2), error.dtype),
        cycles=zero,
    )


def observe(
    pilot: Pilot,
    state: Guidance,
    observation: Float[Array, " 2"],
    phase: Array,
    speed: Array,
    yaw_rate: Array,
    cycle_rate: Any,
    dt: float,
) -> Guidance:
    """Compute one step of the observers (Luenberger observers in the current form: each step uses the present reading).

    Args:
        pilot: Parameters, of which `bandwidth` [rad per gait cycle] is used.
        state: Estimate before the step.
        observation: Measured cross-track error [m] and heading from the path's tangent [rad].
        phase: Phase of the gait cycle.
        speed: Speed of the walk [m/s].
        yaw_rate: Expected yaw rate minus the yaw rate along the path [rad/s].
        cycle_rate: Gait cycles per second [1/s].
        dt: Time since the last step [s].
    """
    course, sway = observer_gains(pilot.bandwidth, cycle_rate * dt)
    angle = 2.0 * jnp.pi * phase * jnp.asarray(SWAY_HARMONICS, observation.dtype)
    wave = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    # The gain of an oscillator's complex amplitude is constant in the frame that turns with the phase; `turned` is this
    # gain for the cosine and sine at phase 0.
    real, imaginary = sway[..., :1], sway[..., 1:]
    turned = wave * real + wave[:, ::-1] * jnp.asarray([1.0, -1.0], observation.dtype) * imaginary

    inputs = jnp.stack([speed * jnp.sin(state.course[1]), yaw_rate])
    ahead = state.course + dt * (inputs + state.unexplained)
    surprise = observation - ahead - jnp.sum(wave * state.sway, axis=(1, 2))
    return Guidance(
        course=ahead + course[0] * surprise,
        unexplained=state.unexplained + course[1] / dt * surprise,
        sway=state.sway + turned * surprise[:, None, None],
        cycles=state.cycles + cycle_rate * dt,
    )


def observer_gains(
    bandwidth: Scalar | float, cycles: Scalar | float
) -> tuple[Float[Array, "2 2"], Float[Array, "2 harmonics 2"]]:
    """Return the gains with which each pole of an observer is exp(-bandwidth * cycles) times the pole of the plant.

    The observer is stable for every bandwidth. The pole of the unexplained input is at
    exp(-DECAY_RATE_RATIOS * bandwidth * cycles).

    Args:
        bandwidth: Bandwidth [rad per gait cycle]; with 0, the estimate is unchanged.
        cycles: Length of a step [gait cycles]; limited to `LONGEST_STEP_CYCLES`.

    Returns:
        Gains of (value, unexplained rate * dt), shape (2, observers), and real and imaginary parts of the gain of each
        harmonic, shape (observers, harmonics, 2).
    """
    step = jnp.minimum(cycles, LONGEST_STEP_CYCLES)
    decay = jnp.exp(-bandwidth * step)
    closed = -jnp.expm1(-bandwidth * step)
    slow = -jnp.expm1(-jnp.asarray(DECAY_RATE_RATIOS) * bandwidth * step)
    angle = 2.0 * jnp.pi * step * jnp.asarray(SWAY_HARMONICS, float)
    curve = 4.0 * jnp.sin(0.5 * angle) ** 2

    # p / a near z = 1 + w is (w + closed) (w + slow) / w^2 times, for each oscillator, (w^2 + n1 w + n0) / (w^2 + d w
    # + d) with n0 = closed^2 + decay d, n1 = 2 closed + decay d, d = 2 - 2 cos(angle). Up to w:
    series = (closed * slow, closed + slow)
    for index in range(len(SWAY_HARMONICS)):
        d = curve[index]
        ratio0 = (closed**2 + decay * d) / d
        ratio1 = (2.0 * closed + decay * d - ratio0 * d) / d
        series = (series[0] * ratio0, series[1] * ratio0 + series[0] * ratio1)
    # The coefficients are the gains before the step; subtracting the step itself, the matrix (1, 1; 0, 1), gives the gains.
    course = jnp.stack([series[1] - series[0], series[0]])

    turn = jnp.exp(1j * angle)
    sway = []
    for index in range(len(SWAY_HARMONICS)):
        root = turn[index]
        factor = 2.0 * (root - decay) * (root - 1.0 + slow) / (root - 1.0) ** 2 / root
        for other_index in range(len(SWAY_HARMONICS)):
            factor *= (root - decay * turn[other_index]) * (root - decay * turn[other_index].conj())
            factor /= (1.0 if other_index == index else root - turn[other_index]) * (
                root - turn[other_index].conj()
            )
        sway.append(jnp.stack([factor.real, factor.imag], axis=-1))
    return course, jnp.stack(sway, axis=1)


def correction(pilot: Pilot, state: Guidance, speed: Array, curvature: Array) -> Scalar:
    """Return the curvature [1/m] that is added to the curvature of the path, so that the robot returns to the path.

    The return is a damped oscillator along the path with poles at 1 / look-ahead; the unexplained yaw rate is compensated.
    The look-ahead is `look_ahead` on a line, and at most `BEND_RADIUS_SHARE` times the radius on a bend: a robot that turns
    less than expected leaves the path faster if the bend is tighter.

    The curvature is ramped up over the 2 / `bandwidth` gait cycles in which the observers learn the sway, because until then
    most of the apparent error is sway.

    Args:
        pilot: Parameters of the pilot.
        state: Estimate of position and heading.
        speed: Speed of the walk [m/s].
        curvature: Curvature of the path [1/m].
    """
    inverse_look_ahead = jnp.sqrt(1.0 / pilot.look_ahead**2 + (curvature / BEND_RADIUS_SHARE) ** 2)
    inverse_speed = 1.0 / jnp.maximum(speed, 0.01)
    error, heading = state.course
    # Unexplained lateral speed and yaw rate per distance: a slope, and a curvature [1/m].
    drift, turn = state.unexplained * inverse_speed
    spring = error * inverse_look_ahead**2
    damper = 2.0 * pilot.damping * (jnp.sin(heading) + drift) * inverse_look_ahead
    ramp = jnp.clip(pilot.bandwidth * state.cycles / 2.0, 0.0, 1.0)
    return -ramp * (spring + damper + turn)
