"""The servo angles of a gait, or of a recorded walk, as a table for the real robot."""

from __future__ import annotations

import copy
import dataclasses
import math
import os
from collections.abc import Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.control.controller import Controller
from nermo_mjx.control.head_and_tail import COUNTER_ROLL, COUNTER_YAW, GAZE
from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.control.spine_modes import mode_names
from nermo_mjx.hardware.channels import Channels, ServoChannel, read_channels
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ModelParameters, ParameterError, Robot, Sensors
from nermo_mjx.robot.equipment import VISUAL_GROUP
from nermo_mjx.robot.parameters import servo_range
from nermo_mjx.robot.quantity import of_type, quantities, replace_quantities
from nermo_mjx.rollout import Setup
from nermo_mjx.rollout.setup import with_own

#: Lowest rate of the controller, in simulated time [Hz]; a table of a lower rate contains every nth of its ticks.
CONTROL_RATE: Final = 100.0
#: Default rate of a table [Hz].
DEFAULT_RATE: Final = 50.0
#: Highest rate of a table, and longest table [Hz, rows].
HIGHEST_RATE: Final = 1000.0
MAX_ROWS: Final = 1_000_000
#: A table is periodic when no angle differs more than this between one of its cycles and the next [rad].
_PERIODIC_TOLERANCE_RAD: Final = 1e-6
#: Head and tail controls that use sensors.
_FEEDBACK_CONTROLS: Final = (GAZE, COUNTER_YAW, COUNTER_ROLL, "pitch_balance")
#: Physics steps between two looks at whether parts touch.
_CONTACT_CHECK_STEPS: Final = 5
#: Maximum number of gait cycles for the controller to settle.
_MAX_SETTLING_CYCLES: Final = 200


@dataclasses.dataclass(frozen=True)
class ServoTable:
    """Servo angles of whole gait cycles, or of a recorded walk.

    Attributes:
        channels: of the servos, in the order of the columns.
        angles: (rows, servos), before rounding [deg].
        rate: rows per second [Hz]; adjusted slightly from the requested one, so that the cycles are whole numbers of
            rows.
        servo_speed: `servo.speed` of the model at its supply voltage [deg/s]; commands are not limited to it.
        cycles: gait cycles in the table; None for a recorded walk.
        frequency: of the gait [Hz]; None for a recorded walk.
    """

    channels: Channels
    angles: Float[np.ndarray, "rows servos"]
    rate: float
    servo_speed: float
    cycles: int | None = None
    frequency: float | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The servos, in the order of their channels."""
        return tuple(channel.servo for channel in self.channels)

    @property
    def time(self) -> Float[np.ndarray, " rows"]:
        """Of each row, from 0, on the controller's clock [s]."""
        return np.arange(len(self.angles)) / self.rate

    @property
    def speed(self) -> Float[np.ndarray, " servos"]:
        """Highest speed of each servo [deg/s]."""
        rows = np.concatenate([self.angles, self.angles[:1]]) if self.periodic else self.angles
        return np.abs(np.diff(rows, axis=0)).max(axis=0) * self.rate

    @property
    def given(self) -> Float[np.ndarray, "rows servos"]:
        """The angles as sent to the servos, rounded to whole degrees if the channels require it [deg]."""
        return self.channels.given(self.angles)

    @property
    def how_many(self) -> str:
        """The number of gait cycles in words, or the length of the recorded walk."""
        if self.cycles is None:
            return f"{self.time[-1]:.6g} s of a recorded walk"
        return f"{self.cycles} gait cycle{'s' if self.cycles > 1 else ''}"

    @property
    def periodic(self) -> bool:
        """Whether the table can be played in a loop."""
        return self.cycles is not None

    @property
    def too_fast(self) -> str:
        """A sentence on the servos that exceed the speed of the model's; empty if there are none."""
        names = [
            f"{name} ({speed:.0f})"
            for name, speed in zip(self.names, self.speed, strict=True)
            if speed > self.servo_speed
        ]
        what = (
            f"asked for more than the {self.servo_speed:.0f} deg/s that the model's servos can do: "
        )
        return f"{what}{', '.join(names)}." if names else ""

    def to_csv(self, description: str = "") -> str:
        """The table as text: comments that begin with #, a line of headings with units, then the rows.

        Args:
            description: description of the gait, for the first comment.
        """
        instruction = "after the last row, continue with the first"
        long = f" of {1 / self.frequency:.6g} s" if self.frequency else ""
        lines = [
            *([description] if description else []),
            f"{self.how_many}{long}, {len(self.time)} rows, {self.rate:.6g} rows/s; "
            f"{instruction if self.periodic else 'not periodic, to be played once'}.",
            "columns are in the order of the channels: "
            + ", ".join(f"{channel.number} {channel.servo}" for channel in self.channels),
            *([self.too_fast] if self.too_fast else []),
        ]
        headings = ["time [s]", *(f"{name} [deg]" for name in self.names)]
        digits = 3 if self.channels.whole_degrees is None else 0
        rows = (
            ",".join([f"{t:.6f}", *(f"{angle + 0.0:.{digits}f}" for angle in row)])
            for t, row in zip(self.time.tolist(), np.round(self.given, 3).tolist(), strict=True)
        )
        return "\n".join([*(f"# {line}" for line in lines), ",".join(headings), *rows]) + "\n"


def servo_table(
    setup: Setup | None = None,
    values: Mapping[str, float] | None = None,
    *,
    rate: float | None = None,
    cycles: int = 1,
    channels: Channels | Mapping[str, Any] | str | os.PathLike[str] | None = None,
) -> ServoTable:
    """The servo angles that the controller commands in a steady gait.

    >>> servo_table(Setup(gait="lateral_walk"), {"frequency": 0.5}, rate=20.0).angles.shape
    (40, 10)

    The pilot is always `open_loop`, with the turn rate `pilot.turn_rate`. The table begins at the phase `start.phase`,
    long after the start, so that filters have settled.

    Args:
        setup: gait, spine mode, steering, profile, tail.
        values: parameters by name, as for `Simulator.run`, one number or text each.
        rate: rows per second of the controller's clock [Hz]; by default that of the channels, or else 50.
        cycles: gait cycles in the table.
        channels: of the servos, see `nermo_mjx.hardware.channels`, or "published", the order of the author's
            software; by default all servos in the order of `SERVOS`, in the controller's convention: hip 0 straight
            down, positive backward; spine positive to the left.

    Raises:
        ParameterError: an invalid argument or parameter, an angle beyond a servo's limit, or parts of the robot that
        would touch; the message is one sentence.
    """
    setup = with_own(setup)
    of_type("rate", rate, (float, int, type(None)), "rows per second [Hz]")
    of_type("cycles", cycles, (float, int), "a whole number")
    if setup.controller is not None:
        raise ParameterError(
            f"controller is {setup.controller!r}: a servo table is of the published controller."
        )
    if setup.schedule:
        raise ParameterError(
            "schedule is given: a servo table is of a steady gait; record the walk and take `recorded_table`."
        )
    modes = mode_names(setup.spine)
    for name, choice in (
        ("head", setup.head),
        ("tail_motion", setup.tail_motion),
        *(("spine", mode) for mode in modes),
    ):
        if choice in _FEEDBACK_CONTROLS:
            raise ParameterError(
                f"{name} is {choice!r}, which answers to sensors: a servo table reads none."
            )
    setup = dataclasses.replace(setup, pilot="open_loop", waypoints=None, command=None)
    values = setup.numbers({} if values is None else values)
    world = setup.world({name: np.asarray(value, float) for name, value in values.items()})
    for name, value in values.items():
        if np.ndim(value):
            raise ParameterError(
                f"{name} has shape {np.shape(value)}: a servo table is of one gait, so of one number."
            )
    setup.check(world)
    params, phase = world.control, float(np.asarray(world.start.phase))
    robot = setup.load()
    connected = channels_of(channels, robot)
    rate = _rate_of(connected, rate)
    if isinstance(cycles, bool) or int(cycles) != cycles or cycles < 1:
        raise ParameterError(
            f"cycles is {cycles!r}: allowed is a whole number from 1 on, so that the table is periodic."
        )
    frequency = float(np.asarray(params.gait.frequency))
    rows = max(1, round(rate * cycles / frequency))
    if rows > MAX_ROWS:
        raise ParameterError(
            f"cycles is {cycles}: with {rate:g} rows/s this would be {rows:,} rows, of {MAX_ROWS:,}."
        )
    rate = rows * frequency / cycles
    if rows < 4 * cycles:
        raise ParameterError(
            f"rate is {rate:g} Hz: a gait cycle of {1 / frequency:g} s needs at least four rows."
        )
    angles = _steady(setup, params, phase, rows, cycles, rate)
    return _table(connected, robot, angles, rate, world.model, cycles, frequency)


def _rate_of(channels: Channels, rate: float | None) -> float:
    """Rows per second [Hz]; raises `ParameterError` if no table can have as many."""
    rate = next(
        candidate for candidate in (rate, channels.rate, DEFAULT_RATE) if candidate is not None
    )
    if not 0.0 < rate <= HIGHEST_RATE:
        raise ParameterError(f"rate is {rate:g} Hz: allowed is (0, {HIGHEST_RATE:g}].")
    return rate


def _table(
    channels: Channels, robot: Robot, angles: np.ndarray, rate: float, model: Any, *gait: Any
) -> ServoTable:
    """The table of the controller's angles (rows, n_servos) [rad] of a robot with these parameters of the model.

    Raises:
        ParameterError: an angle is beyond its servo's limit, or parts of the robot would touch.
    """
    columns = sent_angles(channels, robot.servos, np.degrees(angles))
    for channel, column in zip(channels, columns.T, strict=True):
        for beyond, word, limit in (
            (column < channel.low - 1e-6, "below", channel.low),
            (column > channel.high + 1e-6, "above", channel.high),
        ):
            if beyond.any():
                row = int(np.argmax(np.where(beyond, np.abs(column - limit), 0.0)))
                raise ParameterError(
                    f"{channel.servo} would go to {column[row]:.1f} deg at {row / rate:.3f} s, {word} its limit of "
                    f"{limit:.1f} deg: take a shorter stride, or another zero or direction of the servo."
                )
    check_clearance(robot.with_geometry(model.geometry, model.build), angles, rate)
    return ServoTable(channels, columns, rate, math.degrees(float(model.servo.top_speed)), *gait)


def check_clearance(
    model: mujoco.MjModel, angles: Float[np.ndarray, "rows servos"], rate: float
) -> None:
    """Refuse angles [rad] at which parts of the robot would touch, played on a robot in the air without gravity.

    Its tendons and springs place knees and spine. Parts are convex hulls of the drawn ones; neighbours are left out.

    Raises:
        ParameterError: two parts touch; the message names them and the time.
    """
    model = copy.copy(model)
    model.opt.gravity[:] = 0.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, body = mujoco.MjData(model), model.geom_bodyid
    of_robot = model.body_rootid[body] == model.body("torso").rootid
    visual_geoms = np.flatnonzero(of_robot & (model.geom_group == VISUAL_GROUP))
    first, second = visual_geoms[np.array(np.triu_indices(len(visual_geoms), 1))]
    parents = model.body_parentid[body]
    clearance = (
        (body[first] != body[second])
        & (parents[first] != body[second])
        & (body[first] != parents[second])
    )
    pairs = np.stack([first, second], axis=-1)[clearance]
    reach = model.geom_rbound[pairs].sum(axis=-1)
    data.ctrl[:] = angles[0]
    mujoco.mj_step(model, data, nstep=50 * _CONTACT_CHECK_STEPS)
    for time in np.arange(0.0, len(angles) / rate, _CONTACT_CHECK_STEPS * model.opt.timestep):
        data.ctrl[:] = angles[int(time * rate + 1e-9)]
        mujoco.mj_step(model, data, nstep=_CONTACT_CHECK_STEPS)
        mujoco.mj_kinematics(model, data)
        between = np.linalg.norm(data.geom_xpos[pairs[:, 0]] - data.geom_xpos[pairs[:, 1]], axis=-1)
        for pair in pairs[between < reach]:
            if mujoco.mj_geomDistance(model, data, *pair, 1e-3, None) < 0.0:
                first_body, second_body = (model.body(body[geom]).name for geom in pair)
                raise ParameterError(
                    f"{first_body} and {second_body} would touch at {time:.3f} s: take a shorter stride, or less of the spine."
                )


def _steady(
    setup: Setup, params: ControlParameters, phase: float, rows: int, cycles: int, rate: float
) -> Float[np.ndarray, "rows servos"]:
    """Angles [rad] of `rows` rows at `rate`, once they repeat from one pass to the next."""
    # Ticks are counted in simulated time, which the controller's own clock may outrun.
    ratio = float(np.asarray(params.tracking.clock_ratio))
    tick_limit = max(1, math.ceil(CONTROL_RATE * ratio / rate - 1e-9))
    ticks_rate = tick_limit * rate / ratio
    servo_controller, robot = setup.make_controller(), setup.load()
    assert isinstance(servo_controller, Controller)
    controller = dataclasses.replace(
        servo_controller, control_rate=ticks_rate, pilot_rate=ticks_rate
    )
    # In double precision, so that the phase is exact after many cycles.
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), params)
        still = robot.sensors(jnp.zeros(robot.model.nsensordata))  # which an open loop ignores
        state = _begin(servo_controller, exact, still, phase)  # the rate does not affect it
        previous = None
        for _ in range(max(2, math.ceil(_MAX_SETTLING_CYCLES / cycles))):
            state, angles = _run(controller, robot.servos, exact, state, still, rows, tick_limit)
            angle_table = np.asarray(angles)
            if (
                previous is not None
                and np.abs(angle_table - previous).max() < _PERIODIC_TOLERANCE_RAD
            ):
                return angle_table
            previous = angle_table
    raise ParameterError(
        "the controller does not settle into a periodic gait with these parameters."
    )


@jax.jit(static_argnums=0)
def _begin(
    controller: Controller, params: ControlParameters, sensors: Sensors, phase: float
) -> Any:
    """The state at the start, compiled: op by op it would take seconds."""
    return controller.init(params, sensors, phase)


@jax.jit(static_argnums=(0, 1, 5, 6))
def _run(
    controller: Controller,
    servos: tuple[str, ...],
    params: ControlParameters,
    state: Any,
    sensors: Sensors,
    rows: int,
    within: int,
) -> tuple[Any, Any]:
    """The next rows: each is the current angles, followed by `within` ticks."""

    def tick(state: Any, _: None) -> tuple[Any, None]:
        return controller.update(params, state, sensors)[0], None

    def row(state: Any, _: None) -> tuple[Any, Any]:
        angles = controller.servo_angles(params, state).vector(servos)
        return jax.lax.scan(tick, state, None, length=within)[0], angles

    return jax.lax.scan(row, state, None, length=rows)


def sent_angles(
    channels: Channels, servos: tuple[str, ...], angles: Float[np.ndarray, "rows servos"]
) -> Float[np.ndarray, "rows channels"]:
    """The angles sent to the servos, from the controller's angles of the robot's servos [deg]."""
    columns = []
    for channel in channels:
        if channel.servo in servos:
            columns.append(
                channel.zero + channel.direction * angles[:, servos.index(channel.servo)]
            )
        else:
            columns.append(np.full(len(angles), channel.missing))  # see `channels_of`
    return np.stack(columns, axis=-1)


def channels_of(
    channels: Channels | Mapping[str, Any] | str | os.PathLike[str] | None, robot: Robot
) -> Channels:
    """The channels of a robot's servos as they are given; by default in its own order and angles, with its limits.

    Raises:
        ParameterError: a servo that it has not.
    """
    if channels is None:
        limits = [
            np.degrees(servo_range(servo, robot.config.routing)).tolist() for servo in robot.servos
        ]
        return Channels(
            tuple(
                ServoChannel(robot.servos[i], i, low=low, high=high)
                for i, (low, high) in enumerate(limits)
            )
        )
    connected = channels if isinstance(channels, Channels) else read_channels(channels)
    for channel in connected:
        if channel.servo not in robot.servos and channel.missing is None:
            whose, remedy = f"the robot {robot.config.robot!r}", "take 'nermo_41'"
            if channel.servo == "tail":
                whose = f"the robot with tail {robot.config.tail!r}"
                remedy = "take the articulated tail"
            raise ParameterError(
                f"{channel.servo} is no servo of {whose}: {remedy}, leave the servo out, or give it what is 'missing'."
            )
    return connected


def recorded_table(
    recording: Recording,
    robot: Robot,
    *,
    rate: float | None = None,
    channels: Channels | Mapping[str, Any] | str | os.PathLike[str] | None = None,
) -> ServoTable:
    """The servo angles that were commanded in a recorded walk, from its first to its last sample.

    Played on the robot, they are an open loop: what a policy commanded there answered to the sensors of the simulated
    robot. Between two samples the angles are interpolated linearly.

    Args:
        recording: of a walk, by whatever controller.
        robot: that walked.
        rate: rows per second of simulated time [Hz]; by default that of the channels, or else 50.
        channels: as for `servo_table`.

    Raises:
        ParameterError: an invalid argument, a recording of less than two rows, an angle beyond a servo's limit, or
        parts of the robot that would touch.
    """
    if recording.ctrl.shape[1] != len(robot.servos):
        raise ParameterError(
            f"recording has {recording.ctrl.shape[1]} servos, and the robot has {len(robot.servos)}."
        )
    connected = channels_of(channels, robot)
    rate = _rate_of(connected, rate)
    rows = math.floor(recording.duration * rate + 1e-6) + 1
    if rows < 2:
        raise ParameterError(
            f"rate is {rate:g} Hz: a recording of {recording.duration:g} s has one row then."
        )
    time = np.arange(rows) / rate
    commanded = [
        np.interp(recording.time[0] + time, recording.time, column) for column in recording.ctrl.T
    ]
    declarations = dict(quantities(ModelParameters))
    values = {
        name: float(value)
        for name, value in (recording.metadata.get("parameters") or {}).items()
        if name.startswith(("servo.", "geometry.", "build.")) and name in declarations
    }
    model = replace_quantities(ModelParameters(), values)
    return _table(connected, robot, np.stack(commanded, axis=-1), rate, model)
