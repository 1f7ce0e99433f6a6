"""The published controller: pilot, gait, spine, head and tail joined into `init` and `update`.

    pilot ── drive ──► gait ──► feet ──► offset compensation, lag ──► leg kinematics ──► 8 leg servos
               │        │ phase, contact       ▲
               ├────────┴──────────► spine ────┴───────────────────────────────────────► spine servo
               └───────────────────► head, tail ───────────────────────────────────────► neck, tilt and tail servos

Two pytrees go through it: `ControlParameters` (varied by sweeps) and `ControllerState` (which changes over time). The
parts of the controller are fields, and each part can be replaced by another one with the same interface (`PilotLike`,
`GaitLike` and so on). Values are unbatched; the engines apply `vmap`. A *walk* is what the pilot knows about the present
gait (`pilot.Walk`), and a *drive* is the pilot's command: speed and turn rate (`pilot.Drive`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from nermo_mjx.control import pilot, spine_modes, trajectory
from nermo_mjx.control.head_and_tail import (
    HeadAngles,
    HeadLike,
    Pace,
    TailLike,
    named_head,
    named_tail,
)
from nermo_mjx.control.parameters import (
    ControlParameters,
    Stance,
    published_values,
    with_gait_factor,
)
from nermo_mjx.control.path import PATHS, PathPoint, course_through
from nermo_mjx.control.pilot import (
    WAYPOINTS,
    Command,
    Drive,
    External,
    Follow,
    OpenLoop,
    PilotLike,
    Walk,
)
from nermo_mjx.control.protocol import leg_servos
from nermo_mjx.control.spine_modes import SagittalLike, SagittalModes, SpineLike, SpineModes
from nermo_mjx.control.stepping import FREE_TRAJECTORY, FreeStepping, GaitLike, Stepping
from nermo_mjx.kinematics.body import attitude, rear_foot_rise
from nermo_mjx.kinematics.leg import four_legs, inverse_kinematics
from nermo_mjx.kinematics.spine import joint_angle
from nermo_mjx.robot.geometry import Geometry, geometry_of, names_geometry
from nermo_mjx.robot.masses import MassModel
from nermo_mjx.robot.parameters import LIMBS, ROUTINGS, Sensors, ServoAngles
from nermo_mjx.robot.quantity import (
    ParameterError,
    check_quantities,
    choice,
    quantities,
    replace_quantities,
    values_of,
)
from nermo_mjx.runtime import start_jax
from nermo_mjx.shapes import Array, Count, Scalar, Scalars

# ---
# The controller's state between ticks.


State = TypeVar("State")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ControllerState:
    """State of the controller.

    Attributes:
        tick: Number of control ticks since the start.
        time: Simulated time since the start [s].
        pilot: Memory of the pilot at its last tick.
        drive: Output of the pilot at its last tick, held until the next one.
        gait: State of the gait.
        foot: Commanded foot positions: the positions on the feet's paths, after offset compensation and tracking lag [m].
        spine: Commanded spine servo angle, positive left [rad].
        head, tail: Memories of these parts.
        head_angles, tail_angle: Commanded servo angles of these parts [rad].
        spine_vertical: Commanded angle of Nermo 4.1's vertical servo, which lifts the hip if positive [rad]; None for
            Nermo-Lite.
    """

    tick: Count
    time: Scalar
    pilot: Any
    drive: Drive
    gait: Any
    foot: Float[Array, "4 2"]
    spine: Scalar
    head: Any
    head_angles: HeadAngles
    tail: Any
    tail_angle: Scalar
    spine_vertical: Scalar | None = None

    @property
    def phase(self) -> Scalars:
        """Phase of the gait cycle, in [0, 1)."""
        return self.gait.phase

    @property
    def stance(self) -> Bool[Array, " 4"]:
        """Planned contact of the limbs."""
        return self.gait.stance

    @property
    def turn_rate(self) -> Scalars:
        """Commanded turn rate, in [-1, 1], positive left."""
        return self.drive.turn_rate


def canonical(state: State) -> State:
    """Convert every float of a state to JAX's default precision without weak types, so that a scan can carry it."""
    precision = jnp.zeros(()).dtype

    def convert(leaf: Array) -> Array:
        leaf = jnp.asarray(leaf)
        return leaf.astype(precision if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype)

    return jax.tree.map(convert, state)


def with_dtypes_of(reference: State, state: State) -> State:
    """Return `state` with the dtypes of `reference`, so that a scan can carry it."""
    return jax.tree.map(lambda old, new: jnp.asarray(new).astype(old.dtype), reference, state)


@dataclasses.dataclass(frozen=True)
class Controller:
    """Static choices of the controller; hashable by value, so that it can be a static argument of `jit`.

    Attributes:
        pilot: Part that commands speed and turn rate; see `PilotLike`.
        gait: Part that plans the feet; see `GaitLike`.
        spine: Part that commands the spine's servo; see `SpineLike`.
        head: Part that commands the neck and the head's tilt; see `HeadLike`.
        tail: Part that commands the tail's servo; see `TailLike`.
        sagittal: Part that commands the vertical servo of Nermo 4.1's spine; see `SagittalLike`. None for robots without
            such a servo.
        routing: Routing of the knees' tendons.
        control_rate, pilot_rate: Ticks per simulated second [Hz]; their ratio is an integer.
        parameters: Default parameters of a simulation: any tree with the groups that the parts read.

    Raises:
        ParameterError: A name is unknown, or the rates do not fit together.
    """

    pilot: PilotLike = dataclasses.field(default_factory=Follow)
    gait: GaitLike = dataclasses.field(default_factory=Stepping)
    spine: SpineLike = dataclasses.field(default_factory=SpineModes)
    routing: str = "type3"
    control_rate: float = 100.0
    pilot_rate: float = 50.0
    parameters: Any = dataclasses.field(
        default_factory=ControlParameters, compare=False, repr=False
    )
    head: HeadLike = dataclasses.field(default_factory=named_head)
    tail: TailLike = dataclasses.field(default_factory=named_tail)
    sagittal: SagittalLike | None = None

    def __post_init__(self) -> None:
        choice("routing", self.routing, ROUTINGS)
        for name in ("control_rate", "pilot_rate"):
            if not (math.isfinite(rate := getattr(self, name)) and rate > 0.0):
                raise ParameterError(f"{name} is {rate:g}: allowed is (0, inf) Hz.")
        ratio = self.control_rate / self.pilot_rate
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-9 * ratio:
            raise ParameterError(
                f"pilot_rate is {self.pilot_rate:g}: allowed is {self.control_rate:g} Hz divided by a whole number."
            )

    @property
    def dt(self) -> float:
        """Simulated duration of a control tick [s]."""
        return 1.0 / self.control_rate

    def init(
        self, params: ControlParameters, sensors: Sensors, phase: Scalar | float = 0.0
    ) -> ControllerState:
        """Return the state at the start, from the readings at rest.

        Every leg is on its nominal path at `phase` of the gait cycle, taken modulo 1, so that the robot starts in a
        posture of its gait.
        """
        state = self._start(params, phase)
        initial = dataclasses.replace(
            state,
            pilot=self.pilot.init(params, state.pilot, sensors, self._walk(params, state)),
            head=self.head.init(params, state.head, sensors),
            tail=self.tail.init(params, state.tail, sensors),
        )
        return with_dtypes_of(state, initial)

    def initial_servo(self, params: ControlParameters, phase: Scalar | float = 0.0) -> ServoAngles:
        """Return the servo angles of the state that `init` returns; the initial pose of the robot has these angles."""
        return self.servo_angles(params, self._start(params, phase))

    def update(
        self, params: ControlParameters, state: ControllerState, sensors: Sensors
    ) -> tuple[ControllerState, ServoAngles]:
        """Compute one control tick: return the state and the servo angles `dt` later."""
        walk = self._walk(params, state)
        new_command = self.pilot.update(params, state.pilot, sensors, walk)
        held_command = (state.pilot, state.drive)
        # Between two ticks of the pilot, its memory and its drive are held.
        memory, drive = jax.tree.map(
            lambda new, held: jnp.where(walk.due, new, held), new_command, held_command
        )
        gait, path = self.gait.update(params, state.gait, state.drive, drive, self.dt)
        spine = self.spine(params, gait.phase, drive.turn_rate, path, gait.stance)
        vertical = None
        if self.sagittal is not None:
            pitch = attitude(sensors.orientation)[1]
            vertical = self.sagittal(params, gait.phase, drive.turn_rate, pitch, sensors.gyro[0])
        # The commanded feet follow their target, the compensated path, with a lag: in a tick, this fraction of the
        # distance is closed.
        fraction = trajectory.share_closed(params.tracking, self.dt)
        foot = state.foot + fraction * (
            path + self._compensation(params, spine, vertical, path, state.foot) - state.foot
        )
        pace = self._pace(params, gait.phase, drive)
        head, head_angles = self.head.update(params, state.head, sensors, pace, self.dt)
        tail, tail_angle = self.tail.update(params, state.tail, sensors, pace, self.dt)

        tick = state.tick + 1
        next_state = ControllerState(
            tick,
            tick * self.dt,
            memory,
            drive,
            gait,
            foot,
            spine,
            head,
            head_angles,
            tail,
            tail_angle,
            vertical,
        )
        next_state = with_dtypes_of(state, next_state)
        return next_state, self.servo_angles(params, next_state)

    def servo_angles(self, params: ControlParameters, state: ControllerState) -> ServoAngles:
        """Return the servo angles for the commanded feet, spine, head and tail."""
        servos = leg_servos(state.foot, state.spine, self.routing, geometry_of(params))
        head = state.head_angles
        servos = dataclasses.replace(servos, neck=head.neck, head=head.tilt, tail=state.tail_angle)
        if state.spine_vertical is not None:
            servos = dataclasses.replace(servos, spine_vertical=state.spine_vertical)
        # A gait with a method `trim` adds corrections to the servo angles.
        trim = getattr(self.gait, "trim", None)
        return servos if trim is None else trim(params, servos)

    def cycle_rate(self, params: ControlParameters) -> Any:
        """Gait cycles per simulated second [1/s]."""
        return params.gait.frequency / params.tracking.clock_ratio

    def path(
        self, params: ControlParameters, state: ControllerState, position: Float[Array, " 3"]
    ) -> PathPoint | None:
        """Return the point of the pilot's path closest to a position [m]; None for a pilot without a path."""
        closest_point = getattr(self.pilot, "path", None)
        return None if closest_point is None else closest_point(params, state.pilot, position)

    def stance(self, state: ControllerState) -> Bool[Array, " 4"]:
        """Planned contact of the limbs."""
        return state.stance

    def complete(self, values: dict[str, Any]) -> dict[str, Any]:
        """Add derived values to named values: the gait factor, if only the duty factor is named."""
        return with_gait_factor(values)

    def check(self, params: ControlParameters) -> None:
        """Reject unreachable strides (see `check_workspace`), limbs that would always or never be in stance, and
        amplitudes of the spine that would be clipped.
        """
        check_workspace(params, routing=self.routing)
        if isinstance(self.spine, SpineModes):
            self.spine.check(params)
        if isinstance(self.gait, FreeStepping):
            self.gait.check(params)

    def _start(self, params: ControlParameters, phase: Scalar | float) -> ControllerState:
        """Return the state at the start as far as it does not depend on readings."""
        memory, drive = self.pilot.start(params)
        gait, path = self.gait.start(
            params, trajectory.wrap(jnp.asarray(phase, dtype=float)), drive
        )
        spine = self.spine(params, gait.phase, drive.turn_rate, path, gait.stance)
        # The vertical servo starts at its neutral angle, because the tail of an arched robot would be in the ground.
        vertical = None if self.sagittal is None else jnp.zeros_like(gait.phase)
        foot = path + self._compensation(params, spine, vertical, path, path)
        pace = self._pace(params, gait.phase, drive)
        head, head_angles = self.head.start(params, pace)
        tail, tail_angle = self.tail.start(params, pace)
        tick, time = jnp.zeros((), dtype=jnp.int32), jnp.zeros(())
        return canonical(
            ControllerState(
                tick,
                time,
                memory,
                drive,
                gait,
                foot,
                spine,
                head,
                head_angles,
                tail,
                tail_angle,
                vertical,
            )
        )

    def _pace(self, params: ControlParameters, phase: Scalar, drive: Drive) -> Pace:
        """Phase, speed, turn rate and cycle rate, for head and tail."""
        return Pace(phase, drive.speed, drive.turn_rate, self.cycle_rate(params))

    def _compensation(
        self,
        params: ControlParameters,
        spine: Scalar,
        vertical: Scalar | None,
        path: Float[Array, "4 2"],
        foot: Float[Array, "4 2"],
    ) -> Float[Array, "4 2"]:
        """Return the offsets of the feet [m] that compensate the rise of the hips, or of the feet, by the bent spine.

        Args:
            params: Parameters of the controller.
            spine, vertical: Servo angles of the spine [rad].
            path: Positions of the feet on their paths [m].
            foot: Commanded positions of the feet at the last tick [m].
        """
        geometry, rise = geometry_of(params), None
        if vertical is not None:
            lateral_bend, vertical_bend = (
                joint_angle(spine, geometry),
                joint_angle(vertical, geometry),
            )
            rise = rear_foot_rise(lateral_bend, path, vertical_bend, geometry)
        return spine_modes.compensation(params.spine, spine, geometry, rise, foot)

    def _walk(self, params: ControlParameters, state: ControllerState) -> Walk:
        """Return the inputs of the pilot."""
        speed, yaw_rate = self.gait.walked(params, state.gait, state.drive)
        due = state.tick % round(self.control_rate / self.pilot_rate) == 0
        return Walk(state.time, state.phase, speed, yaw_rate, due, self.pilot_rate)


# Many parameters because each choice of the controller is named.
def published_controller(
    spine: str | tuple[str, ...] = spine_modes.NO_MODE,
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
    """Return the published controller, whose parts are chosen by name.

    >>> published_controller(pilot="arc").gait
    Stepping(form='cubic')

    Args:
        spine, pilot, waypoints, command, trajectory, head, tail_motion, routing: Choices as in `Setup`; the modes of the
            spine can also be a tuple of names.
        masses: Two-mass model of the assembled robot, for the mode "balance".
        control_rate, pilot_rate: Rates as in `Controller` [Hz].

    Raises:
        ParameterError: A name is unknown, or choices cannot be combined.
    """
    modes = spine_modes.mode_names(spine)
    lateral = tuple(name for name in modes if name in spine_modes.LATERAL_MODES)
    vertical = tuple(name for name in modes if name in spine_modes.SAGITTAL_MODES)
    return Controller(
        named_pilot(pilot, waypoints, command),
        FreeStepping(routing=routing) if trajectory == FREE_TRAJECTORY else Stepping(trajectory),
        SpineModes(lateral, masses),
        routing,
        control_rate,
        pilot_rate,
        head=named_head(head),
        tail=named_tail(tail_motion),
        sagittal=SagittalModes(vertical) if vertical else None,
    )


def named_pilot(
    name: str, waypoints: Sequence[Sequence[float]] | None, command: Command | None
) -> PilotLike:
    """Return a pilot by its name; the arguments are those of `published_controller`."""
    choice("pilot", name, get_args(pilot.PilotName))
    # Field, its value, the only pilot that needs this field, and a pronoun for the message.
    fields = ("command", command, "external", "one"), ("waypoints", waypoints, WAYPOINTS, "them")
    for field, value, owner, description in fields:
        if (name == owner) != (value is not None):
            state = "missing" if value is None else "given"
            raise ParameterError(
                f"{field} is {state}: the pilot {owner!r}, and no other, takes {description} (pilot is {name!r})."
            )
    if waypoints is not None:
        return Follow(_course_through(tuple(tuple(map(float, point)) for point in waypoints)))
    if command is not None:
        return External(command)
    return Follow(PATHS[name]) if name in PATHS else OpenLoop()


_course_through = functools.lru_cache(maxsize=32)(course_through)


# ---
# Controller parameters from names and values. Only the functions below check names, ranges and reachable strides.


#: Number of points of the nominal foot path that are checked in each half-cycle, and of strides from 0 to the requested
#: stride that are compared to find the longest possible one.
_PATH_POINTS, _STRIDE_STEPS = 9, 41


def control_parameters(
    gait: str = "trot",
    *,
    steering: str | None = None,
    profile: str = "exact",
    routing: str = "type3",
    **values: Any,
) -> ControlParameters:
    """Return the parameters of a published gait with some values changed, after a check.

    >>> params = control_parameters("lateral_walk", frequency=0.8, **{"spine.amplitude": 0.3})
    >>> float(params.gait.duty), float(params.spine.amplitude)
    (0.68, 0.3)

    Args:
        gait: Name of a gait, such as "trot", "walking_trot" or "lateral_walk". For a custom gait, give duty and offsets
            in `values`; the gait factor follows the duty factor unless `values` contains it.
        steering: "leg", "spine" or "mix"; by default the steering of the profile.
        profile: One of `PROFILES`.
        routing: Routing of the knees' tendons, for the check of the workspace.
        values: Parameters by name, as `quantities(ControlParameters)` lists them, and lengths and positions of the robot
            (`Geometry`); pass names with a dot as `**{"spine.amplitude": 0.3}`. Values are numbers, or arrays whose axes
            are batch axes. They are checked, so they cannot be traced: use `replace_quantities` inside a transformed
            function.

    Raises:
        ParameterError: A name is unknown, a number is out of range, or a stride is outside the legs' workspace.
    """
    start = ControlParameters(geometry=Geometry() if names_geometry(values) else None)
    allowed = dict(quantities(start))
    for name, value in values.items():
        allowed[choice("parameter", name, allowed)].check(name, value)
    presets = published_values(gait, steering=steering, profile=profile) | with_gait_factor(
        {name: np.asarray(value, float) for name, value in values.items()}
    )
    params = replace_quantities(
        start, {name: np.asarray(value, float) for name, value in presets.items()}
    )
    check_workspace(params, routing=routing)
    return params


def check(params: ControlParameters, *, routing: str = "type3") -> None:
    """Reject parameters that are not finite or out of range, and strides outside the legs' workspace.

    Args:
        params: Concrete (not traced) parameters; leaves can have leading batch axes.
        routing: Routing of the knees' tendons.

    Raises:
        ParameterError: A value is not allowed; the message contains the field, its value and the allowed values.
    """
    check_quantities(params)
    check_workspace(params, routing=routing)


def check_workspace(params: ControlParameters, *, routing: str = "type3") -> None:
    """Reject strides, heights and amplitudes whose nominal foot path leaves a leg's workspace; see `check`."""
    stride = np.asarray(params.gait.stride, float) * np.asarray(params.stance.max_stride, float)
    leaves, structure = jax.tree.flatten(_Paths(params.stance, geometry_of(params), stride))
    columns = [
        leaf.ravel() for leaf in np.broadcast_arrays(*(np.asarray(leaf, float) for leaf in leaves))
    ]
    # The distinct combinations of a batch: usually one, because most sweeps vary none of these values.
    paths: _Paths = jax.tree.unflatten(structure, np.unique(np.stack(columns), axis=1))
    start_jax()
    reached = np.asarray(_reachable(paths, routing))
    if reached.all():
        return
    row, limb = np.argwhere(~reached)[0]
    path = jax.tree.map(lambda leaf: leaf[row], paths)
    raise ParameterError(_sentence(path, params, int(limb), routing))


class _Paths(NamedTuple):
    """The parameters on which the nominal foot paths and their reachability depend; all leaves have shape (batch,)."""

    stance: Stance
    geometry: Geometry
    stride: Any


@partial(jax.jit, static_argnames="routing")
def _reachable(paths: _Paths, routing: str) -> Bool[Array, "batch 4"]:
    """Whether each limb's nominal stance and swing paths lie in its workspace."""
    stance, geometry, stride = paths
    progress = jnp.linspace(0.0, 1.0, _PATH_POINTS)[:, None, None]
    strides = jnp.broadcast_to(stride[:, None], (stride.size, len(LIMBS)))
    is_stance = jnp.asarray([True, False])[:, None, None]
    is_stance = jnp.broadcast_to(is_stance, (2, *strides.shape))
    points = trajectory.nominal_points(stance, is_stance, strides)
    path = trajectory.foot_position(points[:, None], progress)
    return jnp.all(inverse_kinematics(four_legs(geometry), path, routing).reachable, axis=(0, 1))


def _sentence(paths: _Paths, params: ControlParameters, limb: int, routing: str) -> str:
    """The message about the path of a limb that leaves its workspace, with the allowed values."""
    pair, stance, stride = LIMBS[limb].split("_")[0], paths.stance, float(paths.stride)
    height = float(getattr(stance, f"{pair}_z"))
    strides = np.linspace(0.0, stride, _STRIDE_STEPS)
    batch = jax.tree.map(lambda leaf: np.full(_STRIDE_STEPS, leaf), paths)._replace(stride=strides)
    reached = np.asarray(_reachable(batch, routing))[:, limb]
    actual, published = (
        dict(values_of(getattr(source, f"{pair}_leg"))) for source in (paths.geometry, Geometry())
    )
    changed = [
        f"geometry.{pair}_leg.{link} {float(length):g} m"
        for link, length in actual.items()
        if abs(float(length) - float(published[link])) > 1e-9
    ]
    links = f", with {' and '.join(changed)}" if changed else ""
    if not reached[0]:
        position = getattr(stance, f"{pair}_y")
        rise = stance.swing_amplitude
        drop = stance.stance_amplitude
        return (
            f"stance.{pair}_z is {height:g} m: with stance.{pair}_y {position:g} m, raised by {rise:g} m and lowered by "
            f"{drop:g} m, the {pair} foot leaves its leg's workspace even without a stride{links}."
        )
    longest = strides[np.argmin(reached) - 1]
    scale = float(stance.max_stride)
    # The message names the parameter that was changed: the relative stride, or the longest stride.
    is_stride_changed = np.any(np.asarray(params.gait.stride) != 1.0) and scale > 0.0
    name, value, limit, unit = (
        ("stride", stride / scale, longest / scale, "")
        if is_stride_changed
        else ("stance.max_stride", stride, longest, " m")
    )
    return (
        f"{name} is {value:g}{unit}: with stance.{pair}_z {height:g} m the {pair} feet reach a stride of "
        f"{longest:.3f} m{links}, so allowed is [0, {limit:.3f}]{unit}."
    )
