"""The pilot, the high-level controller: speed and turn rate that follow a path, or that are prescribed."""

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
        """The memory of `start` updated with the first readings; by default it stays as it is."""
        return memory

    def update(self, params: Any, memory: Any, sensors: Sensors, walk: Walk) -> tuple[Any, Drive]:
        """New memory and drive; both are held until the next pilot tick."""


def limited(speed: Any, turn_rate: Any) -> Drive:
    """A drive within its limits: speeds from 0, turn rates in [-1, 1]."""
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
        along: a function of `path.PATHS`' form, from parameters and a position to a `PathPoint`, or a `Course`.
    """

    along: Callable[[Pilot, Array], PathPoint] | Course = straight

    def locate(
        self, params: ControlParameters, position: Float[Array, " 3"], progress: Scalar
    ) -> PathPoint:
        """The point of the path closest to a position [m]; `progress` of the last one tells a path that approaches
        itself where to look [m]."""
        if isinstance(self.along, Course):
            return locate(self.along, progress, position)
        return self.along(params.pilot, position)

    def path(
        self, params: ControlParameters, memory: Beside, position: Float[Array, " 3"]
    ) -> PathPoint:
        """The point of the path closest to a position, for metrics."""
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
        # Avoids Newton steps for a turn rate that is not used.
        speed, turn_rate = self._guided(params, jnp.where(walk.due, curvature, 0.0))
        published_ticks = PUBLISHED_RATE_HZ / (walk.rate * params.tracking.clock_ratio)
        change = (point.error - memory.point.error) / published_ticks
        return Beside(point, estimate), Drive(
            speed, steer(params.pilot, point.error, change, turn_rate)
        )

    def _guided(self, params: ControlParameters, curvature: Scalar) -> Drive:
        """The gait's speed, and the turn rate for a curvature [1/m]."""
        turn_rate = params.pilot.guidance * turning.turn_rate_for(
            params, curvature / params.pilot.grip
        )
        return limited(params.gait.commanded_speed, turn_rate)


def heading(point: PathPoint, sensors: Sensors, geometry: Geometry) -> Scalar:
    """Heading of the robot relative to the tangent of its path [rad], positive left, in (-pi, pi].

    A bent spine turns torso and hip to opposite sides of it, so it is the torso's minus half of the bend.
    """
    w, x, y, z = sensors.orientation
    ahead = jnp.stack([2.0 * (w * z - x * y), 2.0 * (x * x + z * z) - 1.0])
    across = point.tangent[0] * ahead[1] - point.tangent[1] * ahead[0]
    along = jnp.sum(point.tangent * ahead)
    bend = yaw(joint_angle(sensors.servo_angle[SERVOS.index("spine")], geometry))
    return jnp.arctan2(across, along) - 0.5 * bend


def steer(pilot: Pilot, error: Scalars, change: Scalars, guided: Scalars | float = 0.0) -> Scalars:
    """Turn rate of the published PD, added to that of the guidance and limited.

    Its input is the cross-track error, positive to the left of the path [m], and the error's change in 1/100 s of the
    controller's clock [m]; left of the path it is negative.
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
        """(speed, turn rate) at `time`; before the first and after the last row, that row's."""
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
    """A command for the pilot `external` from arrays over time.

    Args:
        time: strictly increasing, simulated time [s].
        speed: commanded, a number, or one per time [m/s of the controller's clock]. The stride saturates.
        turn_rate: in [-1, 1], positive left, a number, or one per time.
        hold: keep each row until the next one begins, instead of interpolating linearly.

    Raises:
        ParameterError: the columns have different lengths, are not finite, or are out of range.
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
# Two observers of the same form track the cross-track error and the heading. Between two steps, the observed system is
# linear: a double integrator for the course (the value, and what drives it beyond the known input) and an oscillator
# for each harmonic of the sway. The gains place the poles for any gait frequency and pilot rate: with a(z) the plant's
# characteristic polynomial and p(z) the desired one, they are the partial fractions of p(z) / a(z) at the plant's
# poles, in closed form.
#
# The heading is measured, not just predicted from the turn rate, because the prediction is inaccurate: with the spine's
# stride extension the trot responds to a turn by the legs with up to three times the yaw rate that it has without.


#: Harmonics of the gait cycle that make up the sway. On a straight line right mirrors left after half a cycle, which
#: leaves only the odd ones; in a turn the second is added. Measured in trots with and without the spine: 5 to 8 mm
#: in the first, 1 to 2 mm in the third, 0.3 mm at most in the second and fourth.
SWAY_HARMONICS: Final = (1, 2, 3)
#: Decay rate of the unexplained inputs relative to all other poles: for cross-track error and heading. The unexplained
#: turning is in the loop with a plant that may turn twice as much as expected, or half as much; estimated as fast as
#: the course, it made the trot with the spine oscillate with a period of four cycles.
DECAY_RATE_RATIOS: Final = (1.0, 0.4)
#: Look-ahead on a bend, as a share of its radius, see `correction`.
BEND_RADIUS_SHARE: Final = 0.7
#: Longest step of the observer [gait cycles]: beyond it, a harmonic would alias to a slower one, or to its own mirror
#: image.
LONGEST_STEP_CYCLES: Final = 0.4 / max(SWAY_HARMONICS)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Guidance:
    """Estimate of the robot's position and heading relative to its path.

    Attributes:
        course: cross-track error [m] and heading from the path's tangent [rad], without sway, positive left.
        unexplained: not accounted for by the observers' inputs: lateral speed relative to the heading [m/s], and yaw
            rate beyond the one expected from the strides [rad/s].
        sway: of both, cosine and sine of each of `SWAY_HARMONICS` at the gait's phase [m, rad].
        cycles: time observed since the start [gait cycles].
    """

    course: Float[Array, " 2"]
    unexplained: Float[Array, " 2"]
    sway: Float[Array, "2 harmonics 2"]
    cycles: Scalar


def start(error: Scalar, heading: Scalar, speed: Scalar) -> Guidance:
    """Estimate at rest, from the cross-track error [m], the heading from the path's tangent [rad] and the speed [m/s].

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
    """One step of the observers (Luenberger, in the current-estimate form: each step uses its own reading).

    Args:
        pilot: `bandwidth`, of the observers [rad per gait cycle].
        state: the estimate before.
        observation: cross-track error [m] and heading from the path's tangent [rad] as measured.
        phase: of the gait cycle.
        speed: of the walk [m/s].
        yaw_rate: expected, relative to that of the path [rad/s].
        cycle_rate: gait cycles per second [1/s].
        dt: time since the last step [s].
    """
    course, sway = observer_gains(pilot.bandwidth, cycle_rate * dt)
    angle = 2.0 * jnp.pi * phase * jnp.asarray(SWAY_HARMONICS, observation.dtype)
    wave = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    # The gain on an oscillator's complex amplitude is fixed in the frame that turns with it.
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
    """Gains that put each pole of an observer at exp(-bandwidth * cycles) of the plant's: stable for every bandwidth.

    The pole of the unexplained input is at exp(-DECAY_RATE_RATIOS * bandwidth * cycles).

    Args:
        bandwidth: [rad per gait cycle]; 0 leaves the estimate unchanged.
        cycles: length of a step [gait cycles]; limited to `LONGEST_STEP_CYCLES`.

    Returns:
        of (value, unexplained rate dt), the observers in the last axis, and real and imaginary part of each harmonic's,
        the observers in the first.
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
    # The coefficients are those of the gains before the step; the step itself, (1, 1; 0, 1), is taken out of them.
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
    """Curvature to add to the path's [1/m]: poles at 1 / look-ahead along the path, unexplained turning compensated.

    The look-ahead is `look_ahead` on a line, and at most `BEND_RADIUS_SHARE` times the radius on a bend: if the robot turns less
    than expected, it leaves the path faster the tighter the bend is.

    It is ramped up over the 2 / `bandwidth` gait cycles in which the observers learn the sway: until then, apparent
    errors are mostly sway. `speed` is that of the walk [m/s], `curvature` that of the path [1/m].
    """
    per_way = jnp.sqrt(1.0 / pilot.look_ahead**2 + (curvature / BEND_RADIUS_SHARE) ** 2)
    per_speed = 1.0 / jnp.maximum(speed, 0.01)
    error, heading = state.course
    drift, turn = state.unexplained * per_speed
    spring = error * per_way**2
    damper = 2.0 * pilot.damping * (jnp.sin(heading) + drift) * per_way
    learned = jnp.clip(pilot.bandwidth * state.cycles / 2.0, 0.0, 1.0)
    return -learned * (spring + damper + turn)
