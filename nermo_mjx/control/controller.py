"""The published controller: pilot, gait, spine, head and tail joined into `init` and `update`.

    pilot ── drive ──► gait ──► feet ──► offset compensation, lag ──► leg kinematics ──► 8 leg servos
               │        │ phase, contact       ▲
               ├────────┴──────────► spine ────┴───────────────────────────────────────► spine servo
               └───────────────────► head, tail ───────────────────────────────────────► neck, tilt and tail servos

Two pytrees go through it: `ControlParameters` (varied by sweeps) and `ControllerState` (which changes over time). Its
parts are fields, and each can be replaced by another one with the same interface. Values are unbatched; engines vmap.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from nermo_mjx.control import build, clock, fusion, pilot, trajectory
from nermo_mjx.control.course import course_through
from nermo_mjx.control.free_stepping import FREE, FreeStepping
from nermo_mjx.control.fusion import SpineLike, SpineModes
from nermo_mjx.control.head import HeadLike, named_head
from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.control.path import PATHS, PathPoint
from nermo_mjx.control.pilot import Command, Drive, External, Follow, OpenLoop, PilotLike, Walk
from nermo_mjx.control.protocol import leg_servos
from nermo_mjx.control.published import with_gait_factor
from nermo_mjx.control.sagittal import SagittalLike, SagittalModes
from nermo_mjx.control.state import ControllerState, canonical, with_dtypes_of
from nermo_mjx.control.stepping import GaitLike, Stepping
from nermo_mjx.control.sway import Pace
from nermo_mjx.control.tail import TailLike, named_tail
from nermo_mjx.kinematics.attitude import attitude
from nermo_mjx.kinematics.body import rear_foot_rise
from nermo_mjx.kinematics.spine import joint_angle
from nermo_mjx.robot.geometry import geometry_of
from nermo_mjx.robot.interface import Sensors, ServoAngles
from nermo_mjx.robot.mass_model import MassModel
from nermo_mjx.robot.nearest import choice
from nermo_mjx.robot.parameters import ROUTINGS
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.shapes import Array, Scalar


@dataclasses.dataclass(frozen=True)
class Controller:
    """Static choices of the controller; hashable by value, so it can be closed over or a static argument of `jit`.

    Attributes:
        pilot: commands speed and turn rate; see `PilotLike`.
        gait: plans the feet; see `GaitLike`.
        spine: commands the spine's servo; see `SpineLike`.
        head: commands the neck and the head's tilt; see `HeadLike`.
        tail: commands the tail's servo; see `TailLike`.
        sagittal: commands the vertical servo of Nermo 4.1's spine; see `SagittalLike`. None for robots without one.
        routing: knee tendon routing of the legs.
        control_rate, pilot_rate: ticks per simulated second [Hz]; their ratio is an integer.
        parameters: defaults of a simulation; any tree with the groups that the parts read.

    Raises:
        ParameterError: at construction, for an unknown name or incompatible rates.
    """

    pilot: PilotLike = dataclasses.field(default_factory=Follow)
    gait: GaitLike = dataclasses.field(default_factory=Stepping)
    spine: SpineLike = dataclasses.field(default_factory=SpineModes)
    routing: str = "type3"
    control_rate: float = 100.0
    pilot_rate: float = 50.0
    parameters: Any = dataclasses.field(default_factory=ControlParameters, compare=False, repr=False)
    head: HeadLike = dataclasses.field(default_factory=named_head)
    tail: TailLike = dataclasses.field(default_factory=named_tail)
    sagittal: SagittalLike | None = None

    def __post_init__(self) -> None:
        choice("routing", self.routing, ROUTINGS)
        _check_rates(self.control_rate, self.pilot_rate)

    @property
    def dt(self) -> float:
        """Simulated duration of a control tick [s]."""
        return 1.0 / self.control_rate

    @property
    def ticks_per_pilot_tick(self) -> int:
        """Control ticks for which the pilot's output is held."""
        return round(self.control_rate / self.pilot_rate)

    def init(self, params: ControlParameters, sensors: Sensors, phase: Scalar | float = 0.0) -> ControllerState:
        """State at the start: every leg is on its nominal path at `phase`, so that the robot starts in its gait's
        posture.

        Args:
            params: unbatched parameters.
            sensors: readings at the start.
            phase: of the gait cycle; taken modulo 1.
        """
        state = self._start(params, phase)
        after = dataclasses.replace(
            state,
            pilot=self.pilot.init(params, state.pilot, sensors, self._walk(params, state)),
            head=self.head.init(params, state.head, sensors),
            tail=self.tail.init(params, state.tail, sensors),
        )
        return with_dtypes_of(state, after)

    def initial_servo(self, params: ControlParameters, phase: Scalar | float = 0.0) -> ServoAngles:
        """Servo angles of the state that `init` returns, from which the start pose is built."""
        return self.servo_angles(params, self._start(params, phase))

    def update(
        self, params: ControlParameters, state: ControllerState, sensors: Sensors
    ) -> tuple[ControllerState, ServoAngles]:
        """One control tick: the state and the servo angles `dt` later."""
        memory, drive = self._decide(params, state, sensors)
        gait, path = self.gait.update(params, state.gait, state.drive, drive, self.dt)
        spine = self.spine(params, gait.phase, drive.turn_rate, path, gait.stance)
        pitch = attitude(sensors.orientation)[1]
        vertical = self._vertical(params, gait.phase, drive.turn_rate, pitch, sensors.gyro[0])
        closed = trajectory.share_closed(params.tracking, self.dt)
        foot = state.foot + closed * (path + self._compensation(params, spine, vertical, path, state.foot) - state.foot)
        pace = self._pace(params, gait.phase, drive)
        head, head_angles = self.head.update(params, state.head, sensors, pace, self.dt)
        tail, tail_angle = self.tail.update(params, state.tail, sensors, pace, self.dt)

        tick = state.tick + 1
        after = ControllerState(
            tick=tick, time=tick * self.dt, pilot=memory, drive=drive, gait=gait, foot=foot, spine=spine, head=head,
            head_angles=head_angles, tail=tail, tail_angle=tail_angle, spine_vertical=vertical,
        )  # fmt: skip
        after = with_dtypes_of(state, after)
        return after, self.servo_angles(params, after)

    def servo_angles(self, params: ControlParameters, state: ControllerState) -> ServoAngles:
        """Servo angles for the commanded feet, spine, head and tail."""
        servos = leg_servos(state.foot, state.spine, self.routing, geometry_of(params))
        head = state.head_angles
        servos = dataclasses.replace(servos, neck=head.neck, head=head.tilt, tail=state.tail_angle)
        if state.spine_vertical is not None:
            servos = dataclasses.replace(servos, spine_vertical=state.spine_vertical)
        trim = getattr(self.gait, "trim", None)
        return servos if trim is None else trim(params, servos)

    def cycle_rate(self, params: ControlParameters) -> Any:
        """Gait cycles per simulated second [1/s]."""
        return params.gait.frequency / params.tracking.clock_ratio

    def path(self, params: ControlParameters, state: ControllerState, position: Float[Array, " 3"]) -> PathPoint | None:
        """The point of the pilot's path closest to a position [m]; None for a pilot without a path."""
        follow = getattr(self.pilot, "path", None)
        return None if follow is None else follow(params, state.pilot, position)

    def stance(self, state: ControllerState) -> Bool[Array, " 4"]:
        """Planned contact of the limbs."""
        return state.stance

    def complete(self, values: dict[str, Any]) -> dict[str, Any]:
        """Named values plus derived ones: the gait factor, if only the duty factor is named."""
        return with_gait_factor(values)

    def check(self, params: ControlParameters) -> None:
        """Reject unreachable strides, see `build.check_workspace`, and limbs that would always or never be in
        stance."""
        build.check_workspace(params, routing=self.routing)
        if isinstance(self.gait, FreeStepping):
            self.gait.check(params)

    def _start(self, params: ControlParameters, phase: Scalar | float) -> ControllerState:
        memory, drive = self.pilot.start(params)
        gait, path = self.gait.start(params, clock.wrap(jnp.asarray(phase, dtype=float)), drive)
        spine = self.spine(params, gait.phase, drive.turn_rate, path, gait.stance)
        level = jnp.zeros_like(gait.phase)
        vertical = self._vertical(params, gait.phase, drive.turn_rate, level, level)
        foot = path + self._compensation(params, spine, vertical, path, path)
        pace = self._pace(params, gait.phase, drive)
        head, head_angles = self.head.start(params, pace)
        tail, tail_angle = self.tail.start(params, pace)
        state = ControllerState(
            tick=jnp.zeros((), dtype=jnp.int32), time=jnp.zeros(()), pilot=memory, drive=drive, gait=gait, foot=foot,
            spine=spine, head=head, head_angles=head_angles, tail=tail, tail_angle=tail_angle, spine_vertical=vertical,
        )  # fmt: skip
        return canonical(state)

    def _pace(self, params: ControlParameters, phase: Scalar, drive: Drive) -> Pace:
        return Pace(phase, drive.speed, drive.turn_rate, self.cycle_rate(params))

    def _vertical(
        self, params: ControlParameters, phase: Scalar, turn_rate: Scalar, pitch: Scalar, pitch_rate: Scalar
    ) -> Scalar | None:
        return None if self.sagittal is None else self.sagittal(params, phase, turn_rate, pitch, pitch_rate)

    def _compensation(
        self,
        params: ControlParameters,
        spine: Scalar,
        vertical: Scalar | None,
        path: Float[Array, "4 2"],
        foot: Float[Array, "4 2"],
    ) -> Float[Array, "4 2"]:
        geometry, lifted = geometry_of(params), None
        if vertical is not None:
            bends = joint_angle(spine, geometry), joint_angle(vertical, geometry)
            lifted = rear_foot_rise(bends[0], path, bends[1], geometry)
        return fusion.compensation(params.spine, spine, geometry, lifted, foot)

    def _walk(self, params: ControlParameters, state: ControllerState) -> Walk:
        speed, yaw_rate = self.gait.walked(params, state.gait, state.drive)
        due = state.tick % self.ticks_per_pilot_tick == 0
        return Walk(state.time, state.phase, speed, yaw_rate, due, self.pilot_rate)

    def _decide(self, params: ControlParameters, state: ControllerState, sensors: Sensors) -> tuple[Any, Drive]:
        """The pilot's memory and drive, updated at pilot ticks and held in between."""
        walk = self._walk(params, state)
        new, held = self.pilot.update(params, state.pilot, sensors, walk), (state.pilot, state.drive)
        return jax.tree.map(lambda now, before: jnp.where(walk.due, now, before), new, held)


def published_controller(
    spine: str | tuple[str, ...] = fusion.NO_MODE,
    pilot: str = "straight",
    *,
    waypoints: Sequence[Sequence[float]] | None = None,
    command: Command | None = None,
    trajectory: str = "cubic",
    head: str = "none",
    tail_motion: str = "none",
    routing: str = "type3",
    masses: MassModel | None = None,
    control_rate: float = 100.0,
    pilot_rate: float = 50.0,
) -> Controller:
    """The published controller, its parts chosen by name.

    >>> published_controller(pilot="arc").gait
    Stepping(form='cubic')

    Args:
        spine: auxiliary modes, "none", "stride_extension", "balance", "harmonics", and of Nermo 4.1
            "sagittal_extension" and "pitch_balance", or several joined by "+" (or a tuple of names).
        pilot: "open_loop" holds `pilot.turn_rate`, "straight", "arc" and "waypoints" follow a path, "external" calls
            `command`. All but the last command `gait.speed`.
        waypoints: (x, y) of the points that the pilot "waypoints" passes [m], see `course.course_through`.
        command: (speed, turn rate) at a simulated time, for the pilot "external"; see `pilot.tabulated`.
        trajectory: form of the foot path, "cubic", "linear" or "parabolic"; "free" is the cubic one with parameters for
            each limb and movable points, see `free_stepping`.
        head: "none" holds it still, "gaze" keeps its direction in the world; see `control.head`.
        tail_motion: "none" holds it still, "swing", "counter_yaw" or "counter_roll"; see `control.tail`.
        routing: knee tendon routing of the legs.
        masses: two-mass model of the assembled robot, for the mode "balance".
        control_rate, pilot_rate: see `Controller`.

    Raises:
        ParameterError: an unknown name, or choices that cannot be combined.
    """
    stepping = FreeStepping(routing=routing) if trajectory == FREE else Stepping(trajectory)
    modes = fusion.mode_names(spine)
    lateral, vertical = (tuple(name for name in modes if name in kind)
                         for kind in (fusion.LATERAL_MODES, fusion.SAGITTAL_MODES))  # fmt: skip
    return Controller(
        named_pilot(pilot, waypoints, command), stepping, SpineModes(lateral, masses), routing, control_rate,
        pilot_rate, head=named_head(head), tail=named_tail(tail_motion),
        sagittal=SagittalModes(vertical) if vertical else None,
    )  # fmt: skip


def named_pilot(name: str, waypoints: Sequence[Sequence[float]] | None, command: Command | None) -> PilotLike:
    """A pilot by its name; the arguments are those of `published_controller`."""
    choice("pilot", name, pilot.PILOTS)
    if (name == "external") != (command is not None):
        state = "missing" if command is None else "given"
        raise ParameterError(f"command is {state}: the pilot 'external', and no other, takes one (pilot is {name!r}).")
    if (name == pilot.WAYPOINTS) != (waypoints is not None):
        state = "missing" if waypoints is None else "given"
        raise ParameterError(
            f"waypoints is {state}: the pilot 'waypoints', and no other, takes them (pilot is {name!r})."
        )
    if waypoints is not None:
        return Follow(_course_through(tuple(tuple(map(float, point)) for point in waypoints)))
    if command is not None:
        return External(command)
    return Follow(PATHS[name]) if name in PATHS else OpenLoop()


_course_through = functools.lru_cache(maxsize=32)(course_through)


def _check_rates(control_rate: float, pilot_rate: float) -> None:
    for name, rate in (("control_rate", control_rate), ("pilot_rate", pilot_rate)):
        if not (math.isfinite(rate) and rate > 0.0):
            raise ParameterError(f"{name} is {rate:g}: allowed is (0, inf) Hz.")
    ratio = control_rate / pilot_rate
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-9 * ratio:
        raise ParameterError(f"pilot_rate is {pilot_rate:g}: allowed is {control_rate:g} Hz divided by a whole number.")
