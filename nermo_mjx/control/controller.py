"""The controller: pilot, gait clock, foot trajectories, spine and leg kinematics joined into `init` and `update`.

    command ── pilot ──► gait clock ──► foot trajectories ──► leg kinematics ──► 8 leg servos
                 │                          ▲ rear feet's shift
                 └────► spine controller ───┴──────────────────────────────────► spine servo

Two pytrees go through it: `ControlParameters` (what a sweep varies) and `ControllerState` (what time changes). What is
chosen by name is a field of `Controller` and fixed before tracing. Values are unbatched; engines vmap.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nermo_mjx.control import clock, fusion, guidance, pilot, trajectory, turning
from nermo_mjx.control.course import Course, course_through
from nermo_mjx.control.parameters import ControlParameters, choice
from nermo_mjx.control.path import PathPoint
from nermo_mjx.control.pilot import Command
from nermo_mjx.control.state import ControllerState, canonical, with_dtypes_of
from nermo_mjx.kinematics.leg import four_legs, inverse
from nermo_mjx.robot.interface import SERVOS, Sensors, ServoAngles
from nermo_mjx.robot.mass_model import MassModel
from nermo_mjx.robot.parameters import ROUTINGS
from nermo_mjx.robot.quantity import ParameterError

NO_MODE: Final = "none"


class _Command(NamedTuple):
    """What the pilot decides at a tick; the fields are those of `ControllerState`."""

    speed: Array
    turn_rate: Array
    path_point: PathPoint
    guidance: guidance.Guidance


@dataclasses.dataclass(frozen=True)
class Controller:
    """Static choices of the controller; hashable by value, so it can be closed over or a static argument of `jit`.

    Attributes:
        spine: auxiliary modes, "none", "stride_extension", "balance", or several joined by "+" (or a tuple of names).
        pilot: "open_loop" holds `pilot.turn_rate`, "straight", "arc" and "waypoints" follow a path, "external" asks
            `command`. All but the last command `gait.speed`.
        waypoints: (x, y) of the points that the pilot "waypoints" passes [m], see `course.course_through`.
        command: (speed, turn rate) at a simulated time, for the pilot "external"; see `pilot.tabulated`.
        trajectory: form of the foot path, "cubic", "linear" or "parabolic".
        routing: knee tendon routing of the legs.
        control_rate, pilot_rate: ticks per simulated second [Hz]; their ratio is an integer.
        masses: two-mass model of the assembled robot, for the mode "balance". Kept as plain numbers.
        n_servos: number of actuators of the model.

    Raises:
        ParameterError: at construction, for an unknown name or choices that do not fit together.
    """

    spine: str | tuple[str, ...] = NO_MODE
    pilot: str = "straight"
    waypoints: tuple[tuple[float, float], ...] | None = None
    command: Command | None = None
    trajectory: str = "cubic"
    routing: str = "type3"
    control_rate: float = 100.0
    pilot_rate: float = 50.0
    masses: MassModel | None = None
    n_servos: int = len(SERVOS) - 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "spine", _mode_names(self.spine))
        choice("pilot", self.pilot, pilot.PILOTS)
        choice("trajectory", self.trajectory, trajectory.FORMS)
        choice("routing", self.routing, ROUTINGS)
        _check_rates(self.control_rate, self.pilot_rate)
        if (self.pilot == "external") != (self.command is not None):
            state = "missing" if self.command is None else "given"
            raise ParameterError(
                f"command is {state}: the pilot 'external', and no other, takes one (pilot is {self.pilot!r})."
            )
        if (self.pilot == pilot.WAYPOINTS) != (self.waypoints is not None):
            state = "missing" if self.waypoints is None else "given"
            raise ParameterError(
                f"waypoints is {state}: the pilot 'waypoints', and no other, takes them (pilot is {self.pilot!r})."
            )
        if self.waypoints is not None:
            points = tuple(tuple(map(float, point)) for point in self.waypoints)
            object.__setattr__(self, "waypoints", points)
            _course_through(points)
        if "balance" in self.modes and self.masses is None:
            raise ParameterError(f"masses is None: the spine mode {self.spine!r} needs the robot's mass model.")
        if self.masses is not None:
            object.__setattr__(self, "masses", _plain(self.masses))
        if not len(SERVOS) - 2 <= self.n_servos <= len(SERVOS):
            raise ParameterError(f"n_servos is {self.n_servos}: allowed is [{len(SERVOS) - 2}, {len(SERVOS)}].")

    @property
    def modes(self) -> tuple[str, ...]:
        """The auxiliary modes that are on."""
        return tuple(name for name in fusion.MODES if name in str(self.spine).split("+"))

    @property
    def _course(self) -> Course | None:
        return None if self.waypoints is None else _course_through(self.waypoints)

    @property
    def dt(self) -> float:
        """Simulated seconds of a control tick."""
        return 1.0 / self.control_rate

    @property
    def ticks_per_pilot_tick(self) -> int:
        """Control ticks for which the pilot's output is held."""
        return round(self.control_rate / self.pilot_rate)

    def init(
        self, params: ControlParameters, sensors: Sensors, phase: Float[Array, ""] | float = 0.0
    ) -> ControllerState:
        """State at the start: every leg on its nominal path at `phase`, so that the robot starts in its gait's posture.

        Args:
            params: unbatched parameters.
            sensors: readings at the start.
            phase: of the gait cycle; taken modulo 1.
        """
        state = self._start(params, phase)
        point = self.locate(params, sensors.position, state.path_point.progress)
        speed, _ = self._walked(params, state)
        course = guidance.start(point.error, pilot.heading(point, sensors), speed)
        located = dataclasses.replace(state, path_point=point, guidance=course)
        return with_dtypes_of(state, located)

    def locate(self, params: ControlParameters, position: Float[Array, " 3"], progress: Float[Array, ""]) -> PathPoint:
        """The point of the pilot's path beside a position; on the line straight ahead for a pilot without a path.

        Args:
            params: unbatched parameters.
            position: in the world [m].
            progress: of the last point, for a path that comes near itself [m].
        """
        return pilot.path_point(self.pilot, self._course, params.pilot, position, progress)

    def initial_servo(self, params: ControlParameters, phase: Float[Array, ""] | float = 0.0) -> ServoAngles:
        """Servo angles of the state that `init` returns, to build the robot's pose at the start from."""
        return self.servo_angles(self._start(params, phase))

    def update(
        self, params: ControlParameters, state: ControllerState, sensors: Sensors
    ) -> tuple[ControllerState, ServoAngles]:
        """One control tick: the state and the servo angles `dt` later."""
        command = self._command(params, state, sensors)
        phase = clock.advance(state.phase, params.gait.frequency, self.dt / params.tracking.clock_ratio)
        limbs = clock.limb_states(params.gait, phase)
        points = self._points(params, state, limbs, command)
        path = trajectory.position(points, limbs.progress, self.trajectory)

        spine = self._spine_servo(params, phase, command.turn_rate, path, limbs.stance)
        closed = trajectory.share_closed(params.tracking, self.dt)
        foot = state.foot + closed * (path + fusion.compensation(params.spine, spine) - state.foot)

        tick = state.tick + 1
        after = ControllerState(
            tick=tick, time=tick * self.dt, phase=phase, stance=limbs.stance, points=points, foot=foot, spine=spine,
            **command._asdict(),
        )  # fmt: skip
        after = with_dtypes_of(state, after)
        return after, self.servo_angles(after)

    def servo_angles(self, state: ControllerState) -> ServoAngles:
        """Servo angles for the commanded feet and spine; neck and tail look straight ahead and back."""
        servo = inverse(four_legs(), state.foot, self.routing).servo
        rest = jnp.zeros_like(state.spine)
        return ServoAngles(hip=servo[..., 0], knee=servo[..., 1], spine=state.spine, neck=rest, tail=rest)

    def _start(self, params: ControlParameters, phase: Float[Array, ""] | float) -> ControllerState:
        phase = clock.wrap(jnp.asarray(phase, dtype=float))
        limbs = clock.limb_states(params.gait, phase)
        point = self.locate(params, jnp.zeros(3), jnp.zeros(()))
        speed, turn_rate = self._given_command(params, jnp.zeros(()), point.curvature)
        points = trajectory.nominal_points(params.stance, limbs.stance, self._strides(params, speed, turn_rate))
        path = trajectory.position(points, limbs.progress, self.trajectory)
        spine = self._spine_servo(params, phase, turn_rate, path, limbs.stance)
        foot = path + fusion.compensation(params.spine, spine)
        zero = jnp.zeros(())
        state = ControllerState(
            tick=jnp.zeros((), dtype=jnp.int32), time=zero, phase=phase, stance=limbs.stance, points=points,
            foot=foot, speed=speed, turn_rate=turn_rate, spine=spine, path_point=point,
            guidance=guidance.start(zero, zero, zero),
        )  # fmt: skip
        return canonical(state)

    def _given_command(
        self, params: ControlParameters, time: Float[Array, ""], curvature: Float[Array, ""]
    ) -> tuple[Array, Array]:
        """Speed and turn rate as commanded, or as the guidance's curvature [1/m] needs."""
        speed, turn_rate = params.gait.speed, jnp.zeros(())
        if self.pilot == "open_loop":
            turn_rate = params.pilot.turn_rate
        elif self.pilot in pilot.FOLLOWERS:
            turn_rate = params.pilot.guidance * turning.turn_rate_for(params, curvature / params.pilot.grip)
        elif self.command is not None:
            speed, turn_rate = self.command(time)
        return jnp.maximum(jnp.asarray(speed), 0.0), jnp.clip(jnp.asarray(turn_rate), -1.0, 1.0)

    def _command(self, params: ControlParameters, state: ControllerState, sensors: Sensors) -> _Command:
        """The pilot's output, new at a pilot tick and held between two of them."""
        due = state.tick % self.ticks_per_pilot_tick == 0
        point = self.locate(params, sensors.position, state.path_point.progress)
        estimate, curvature = state.guidance, point.curvature
        if self.pilot in pilot.FOLLOWERS:
            estimate, curvature = self._guide(params, state, point, sensors)
            # No Newton step is spent on a turn rate that nobody takes up.
            curvature = jnp.where(due, curvature, 0.0)
        speed, turn_rate = self._given_command(params, state.time, curvature)
        if self.pilot in pilot.FOLLOWERS:
            published_ticks = pilot.PUBLISHED_PILOT_RATE / (self.pilot_rate * params.tracking.clock_ratio)
            change = (point.error - state.path_point.error) / published_ticks
            turn_rate = pilot.steer(params.pilot, point.error, change, turn_rate)
        new, held = (
            _Command(speed, turn_rate, point, estimate),
            _Command(state.speed, state.turn_rate, state.path_point, state.guidance),
        )
        return jax.tree.map(lambda now, before: jnp.where(due, now, before), new, held)

    def _guide(
        self, params: ControlParameters, state: ControllerState, point: PathPoint, sensors: Sensors
    ) -> tuple[guidance.Guidance, Array]:
        """The guidance's estimate, and the curvature that it wants [1/m]."""
        speed, yaw_rate = self._walked(params, state)
        seen = jnp.stack([point.error, pilot.heading(point, sensors)])
        estimate = guidance.observe(
            params.pilot, state.guidance, seen, state.phase, speed,
            params.pilot.grip * yaw_rate - speed * point.curvature,
            params.gait.frequency / params.tracking.clock_ratio, 1.0 / self.pilot_rate,
        )  # fmt: skip
        return estimate, point.curvature + guidance.correction(params.pilot, estimate, speed, point.curvature)

    @staticmethod
    def _walked(params: ControlParameters, state: ControllerState) -> tuple[Array, Array]:
        """(speed [m/s], yaw rate without slip [rad/s]) of the strides that the legs make now."""
        speed, yaw_rate = turning.walked(params, state.points, state.stance, state.turn_rate)
        return speed / params.tracking.clock_ratio, yaw_rate / params.tracking.clock_ratio

    def _points(
        self, params: ControlParameters, state: ControllerState, limbs: clock.LimbStates, command: _Command
    ) -> Float[Array, "4 3 2"]:
        """Control points of the half-cycles that the legs are in now.

        A leg switches between two ticks. Its new half-cycle starts where the old one ends, not where the foot was at
        the tick before, and has the stride that was wanted when it switched. So the commanded feet are continuous in
        frequency, duty and offsets, which say in which tick a switch falls.
        """
        duty = jnp.clip(jnp.asarray(params.gait.duty), clock.SHORTEST_HALF, 1.0 - clock.SHORTEST_HALF)
        length, other = jnp.where(limbs.stance, duty, 1.0 - duty), jnp.where(limbs.stance, 1.0 - duty, duty)
        # Since the leg's last switch, and in a tick, as shares of the gait cycle.
        since = limbs.progress * length
        in_tick = jnp.maximum(params.gait.frequency * self.dt / params.tracking.clock_ratio, 1e-9)
        before, now = (self._strides(params, given.speed, given.turn_rate) for given in (state, command))

        def stride(ago: Array) -> Array:
            return now + jnp.where(ago <= in_tick, ago / in_tick, 1.0) * (before - now)

        switched = clock.switches(limbs.stance, state.stance)
        # A half-cycle shorter than a tick may pass unseen; the foot has made its way all the same.
        skipped = ~switched & (since < in_tick - 0.5 * clock.SHORTEST_HALF)
        passed = trajectory.end_points(params.stance, ~limbs.stance, stride(since + other))
        start = jnp.where(skipped[:, None], passed, state.points[:, 2])
        planned = trajectory.plan(params.stance, start, limbs.stance, stride(since))
        return jnp.where((switched | skipped)[:, None, None], planned, state.points)

    @staticmethod
    def _strides(params: ControlParameters, speed: Array, turn_rate: Array) -> Float[Array, " 4"]:
        stride = turning.stride_length(params.gait, params.stance, speed)
        return stride * turning.stride_shares(params.turning, turn_rate)

    def _spine_servo(
        self, params: ControlParameters, phase: Array, turn_rate: Array, feet: Array, stance: Array
    ) -> Float[Array, ""]:
        """Commanded spine servo angle: steering fused with the sum of the auxiliary modes."""
        auxiliary = jnp.zeros_like(phase)
        if "stride_extension" in self.modes:
            auxiliary += fusion.stride_extension(params.spine, phase)
        if "balance" in self.modes:
            assert self.masses is not None
            masses = jax.tree.map(jnp.asarray, self.masses, is_leaf=lambda leaf: isinstance(leaf, tuple))
            auxiliary += fusion.balance(params.spine, masses, feet, stance)
        return fusion.fuse(params.spine, turning.spine_share(params.turning, turn_rate), auxiliary)


_course_through = functools.lru_cache(maxsize=32)(course_through)


def _mode_names(spine: str | tuple[str, ...]) -> str:
    names = tuple(spine.split("+")) if isinstance(spine, str) else tuple(spine)
    chosen = {choice("spine", name.strip(), (NO_MODE, *fusion.MODES)) for name in names} - {NO_MODE}
    return "+".join(name for name in fusion.MODES if name in chosen) or NO_MODE


def _check_rates(control_rate: float, pilot_rate: float) -> None:
    for name, rate in (("control_rate", control_rate), ("pilot_rate", pilot_rate)):
        if not (math.isfinite(rate) and rate > 0.0):
            raise ParameterError(f"{name} is {rate:g}: allowed is (0, inf) Hz.")
    ratio = control_rate / pilot_rate
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-9 * ratio:
        raise ParameterError(f"pilot_rate is {pilot_rate:g}: allowed is {control_rate:g} Hz divided by a whole number.")


def _plain(masses: MassModel) -> MassModel:
    """The same numbers without arrays: hashable, and equal when they are equal."""
    return MassModel(
        front_mass=float(masses.front_mass), rear_mass=float(masses.rear_mass),
        front_com=tuple(map(float, masses.front_com)), rear_com=tuple(map(float, masses.rear_com)),
    )  # fmt: skip
