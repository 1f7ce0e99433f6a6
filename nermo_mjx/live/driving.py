"""A drive: controller and body on the engine `c`, tick by tick, under commands that arrive while the robot walks.

A command is a `Switch` that begins when it arrives. Commands whose blends overlap are added, each with its own length, so
that feet and servos move continuously, as in a schedule. The loop is the compiled loop of the engine `c`, and the
commands are sufficient to repeat a drive bit for bit. A journal stores the commands in a file at once, so that no drive
is lost.
"""

from __future__ import annotations

import dataclasses
import json
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, cast

import jax
import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, Field, NonNegativeInt

from nermo_mjx.control.head_and_tail import GAZE, TAIL_MOTIONS
from nermo_mjx.control.protocol import ChecksParameters, data_of
from nermo_mjx.control.schedule import MODE_CHOICES, MODE_GAINS, Schedule, Switch, turned
from nermo_mjx.control.spine_modes import LATERAL_MODES, NO_MODE, SAGITTAL_MODES
from nermo_mjx.files import MAX_FILE_BYTES, read_as, read_bytes
from nermo_mjx.physics.c_engine import BLOCK_WORLDS, CBodies, CEngine
from nermo_mjx.recording import Metadata, Recording, RecordingError, model_hash
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.quantity import choice, quantities, replace_quantities, values_of
from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.rollout.loop import LoopState
from nermo_mjx.rollout.setup import Window
from nermo_mjx.rollout.simulator import MOST_RECORDED, TICK_BYTES, default_precision
from nermo_mjx.runs.code import versions
from nermo_mjx.runs.files import plain_json
from nermo_mjx.specs.controllers import code_identity
from nermo_mjx.specs.walk import RecordedSetup, WalkSpec
from nermo_mjx.trust import FileError

#: Largest force of a push on each axis [N]; the robot weighs 2.65 N. Longest push [s].
LARGEST_FORCE_NEWTONS: Final = 10.0
LONGEST_PUSH_SECONDS: Final = 5.0
#: Maximum number of simultaneous changes, because each of them needs time in every tick.
MAX_BLENDS: Final = 100


@dataclasses.dataclass(frozen=True)
class Push:
    """A force on a body.

    Attributes:
        tick: Tick before which the force begins.
        ticks: Number of ticks of the force.
        body: Index of the body in the model.
        force: Force in the world frame, at the body's centre of mass [N].
    """

    tick: int
    ticks: int
    body: int
    force: tuple[float, float, float]


class Driving:
    """A drive from its start to the present.

    >>> from nermo_mjx import Setup
    >>> driving = Driving(Setup(pilot="open_loop"), {"frequency": 0.8})
    >>> driving.dt, driving.steps_per_tick
    (0.01, 5)

    Attributes:
        setup, values: Arguments of the drive.
        simulator: Simulator of the drive, with every mode that a command can turn on. Therefore the last digits can
            differ from a walk, whose program contains only its own modes.
        dt: Time between ticks [s].
        steps_per_tick: Number of sensor readings between two ticks.
        parameters: Parameters that a command can change, with their ranges.
        about: Metadata of a recording of the drive.
        ticks: Number of ticks since the start.
        commands, pushes: Commands and pushes since the start; each command has the tick before which it arrived.
        rows: Positions, velocities, targets and readings after each recorded tick.
        control: Present parameters of the controller, leaves (1, ...).
        modes: Active modes, by the choice that they belong to.
    """

    #: Whether the commands are sufficient to repeat the drive.
    repeatable = True

    def __init__(
        self, setup: Setup, values: Mapping[str, float] | None = None, *, record: bool = True
    ) -> None:
        """
        Args:
            setup: Setup of the walk. The switches of its schedule are commands that arrive at their times.
            values: Parameters at the start, by name.
            record: Whether to store every tick, for `recording`.

        Raises:
            ParameterError: See `Setup`, `Simulator`.
        """
        self.setup, self.values, self._record = setup, dict(values or {}), record
        once = dataclasses.replace(setup, schedule=())
        self.simulator = Simulator(_with_all_modes(once) if setup.controller is None else once, "c")
        self.batch = self.simulator.prepare(self.values, Run(duration=1.0))
        engine, self._controller = self.simulator.engine, self.simulator.controller
        assert isinstance(engine, CEngine)
        self._engine = engine
        self.dt = float(self._controller.dt)
        self.steps_per_tick = self.simulator.loop.steps_per_tick
        self.parameters = dict(quantities(self._controller.parameters))
        endless = jax.tree.map(
            np.full_like, self.batch.params.window, Window(begin=0.0, end=1e6, distance=1e6)
        )
        self._params = dataclasses.replace(self.batch.params, window=endless, schedule=None)
        self.about = {
            "parameters": setup.defaults() | self.values,
            "setup": setup.fields(),
            "code": _code(setup),
            "engine": "c",
            "versions": versions(),
        }
        self._hash = model_hash(self.simulator.robot.model)
        self._compiled: Any = None
        self.reset()

    def reset(self) -> None:
        """Start again: the robot is in its initial state, and the parameters are the parameters of the setup."""
        self._body = CBodies(self._engine, self.batch.qpos, self.batch.fields, 1)
        self._forces = self._body.batch.bind("xfrc_applied")
        self._readings = np.repeat(self._body.sensordata[:, None], self.steps_per_tick, axis=1)
        self.pushes: list[Push] = []
        self.rows: list[tuple[np.ndarray, ...]] = []
        self.restart(self._body.sensordata[0])

    def restart(self, sensordata: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n_servos"]:
        """Start the controller again, with the parameters of the setup.

        Args:
            sensordata: Sensor data of the body at rest (n,).

        Returns:
            Servo angles of the start pose [rad].
        """
        rest = np.asarray(sensordata, float)
        if (
            self._compiled is None
        ):  # a command without changes and the following tick compile all programs
            self._begin(rest)
            for name, value in [*self._commanded.items()][:1]:
                self.command(Switch(0.0, values={name: value}))
            self.targets(np.tile(rest, (self.steps_per_tick, 1)))
        self._begin(rest)
        self._due = sorted(self.setup.schedule, key=lambda switch: switch.at)
        return np.asarray(self.state.ctrl)

    def _begin(self, rest: np.ndarray) -> None:
        start = Switch(
            0.0, spine=self.setup.spine, head=self.setup.head, tail_motion=self.setup.tail_motion
        )
        # Commanded parameters, including parameters of inactive modes, and the active modes.
        self._commanded = _numbers(self._params.control)
        self.modes = {f: set(m) for f, m in start.modes.items()}
        self.control = self._aim = self._effective_parameters(self._commanded, self.modes)
        self._base = np.array([*_numbers(self._aim).values()])
        # Commands in progress: tick of the begin, duration [s], and change of the values.
        self._blends: list[tuple[int, float, np.ndarray]] = []
        self.ticks, self.commands, self._due = 0, list[tuple[int, Switch]](), list[Switch]()
        lanes, readings = self._lanes(), np.tile(rest, (BLOCK_WORLDS, 1))
        self._compiled = self._engine.packed(lanes, readings)
        self._row = self._compiled.pack(lanes)
        self._state = self._compiled.init(self._row, readings)

    def command(self, switch: Switch) -> None:
        """Begin the changes of a switch, whose time `at` is ignored.

        The changes take `blend` gait cycles at the present frequency, and are added to the changes of earlier commands.

        Raises:
            ParameterError: A parameter or mode is unknown, a value is out of range, a stride is outside of the legs'
                workspace, or a limb would move backward; then the drive does not change.
        """
        values, rate = switch.absolute(), self.cycle_rate
        if len(self._blends) >= MAX_BLENDS:
            raise ParameterError(
                f"command: {MAX_BLENDS} changes are under way, and no more are allowed at once."
            )
        for name, value in values.items():
            self.parameters[choice("parameter", name, self.parameters)].check(name, value)
        dict(quantities(Schedule))["blend.1"].check("blend", switch.blend)
        for field, names in switch.modes.items():
            for mode in names:
                choice(field, mode, self.simulator.setup.modes[field] or (NO_MODE,))
        commanded = self._commanded | values
        modes = self.modes | {field: set(names) for field, names in switch.modes.items()}
        aim = self._effective_parameters(commanded, modes)
        if isinstance(self._controller, ChecksParameters):
            self._controller.check(aim)
        old, new = _numbers(self._aim), _numbers(aim)
        moves = {name: new[name] - old[name] for name in new}
        moves |= {
            name: move - round(move) for name, move in moves.items() if name.startswith("offset.")
        }
        now = _numbers(self.control).get("frequency", 1.0)
        slower = now / min(now, now + moves.get("frequency", 0.0))
        if (shortest_blend := float(turned(moves)) * slower) >= switch.blend:
            raise ParameterError(
                f"blend is {switch.blend:g}: allowed is more than {shortest_blend:g} cycles; a limb would go backward."
            )
        added, move = np.array([*moves.values()]), np.array([*moves.values()])
        for _, seconds, other_choice in self._blends:
            added = added + other_choice * switch.blend / rate / seconds
        if float(turned(dict(zip(moves, added, strict=True)))) * slower >= switch.blend:
            raise ParameterError(
                "beside the change before, a limb would go backward: wait until that has ended."
            )
        seconds = switch.blend / rate
        self._commanded, self.modes, self._aim = commanded, modes, aim
        self._blends.append((self.ticks, seconds, move))
        self.commands.append((self.ticks, switch))

    def targets(self, readings: Float[np.ndarray, "steps n"]) -> Float[np.ndarray, " n_servos"]:
        """Run one tick of the controller: servo angles [rad] from the readings since the last tick, or at rest."""
        while self._due and self._due[0].at <= self.ticks * self.dt + 1e-9:
            self.command(self._due.pop(0))
        if self._blends:
            self._blend()
            self._row = self._compiled.pack(self._lanes())
        lanes = np.tile(np.asarray(readings, float), (BLOCK_WORLDS, 1, 1))
        self._state, ctrl = self._compiled.step(self._compiled.once, self._row, self._state, lanes)
        self.ticks += 1
        return np.asarray(ctrl)[0]

    def _blend(self) -> None:
        """Update the parameters to the present tick, in the precision of a schedule."""
        under_way = list[tuple[int, float, np.ndarray]]()
        for began, seconds, move in self._blends:
            if (self.ticks - began) * self.dt < seconds:
                under_way.append((began, seconds, move))
            else:
                self._base = self._base + move
        self._blends, self.control = under_way, self._aim
        if not self._blends:
            self._base = np.array([*_numbers(self._aim).values()])
            return
        begun, lengths, moves = map(np.array, zip(*self._blends, strict=True))
        course = self._base + np.cumsum([np.zeros_like(self._base), *moves], axis=0)
        passed, lengths, course = default_precision(
            ((self.ticks - begun) * self.dt, lengths, course)
        )
        now = course[0] + ((passed / lengths)[:, None] * np.diff(course, axis=0)).sum(0)
        values = {
            name: np.array([value]) for name, value in zip(_numbers(self._aim), now, strict=True)
        }
        self.control = replace_quantities(self._aim, values)

    def push(self, body: int, force: tuple[float, float, float], seconds: float) -> None:
        """Begin to push a body with a force [N] for a time [s]; an earlier push ends.

        Raises:
            ParameterError: The body does not exist, or the force or time is out of range.
        """
        bodies, weld = self.simulator.robot.model.nbody, self.simulator.robot.model.body_weldid
        if not 0 < body < bodies or weld[body] == 0:
            raise ParameterError(
                f"push.body is {body}: allowed is one of the robot's, below {bodies}."
            )
        if not np.all(np.abs(force) <= LARGEST_FORCE_NEWTONS):
            raise ParameterError(
                f"push.force is {list(force)}: allowed is [-{LARGEST_FORCE_NEWTONS:g}, {LARGEST_FORCE_NEWTONS:g}] N."
            )
        if not 0 < seconds <= LONGEST_PUSH_SECONDS:
            raise ParameterError(
                f"push.seconds is {seconds:g}: allowed is (0, {LONGEST_PUSH_SECONDS:g}] s."
            )
        ticks = max(1, round(seconds / self.dt))
        self.pushes.append(
            Push(self.ticks, ticks, body, (float(force[0]), float(force[1]), float(force[2])))
        )

    def tick(self) -> None:
        """Run one tick of the controller, and the physics until the next one."""
        now, self._forces[...] = self.ticks, 0.0
        if self.pushes and now < self.pushes[-1].tick + self.pushes[-1].ticks:
            self._forces[0, self.pushes[-1].body, :3] = self.pushes[-1].force
        self._body.ctrl[...] = self._next_targets()
        self._body.move(self._readings)
        if self._record:
            if TICK_BYTES * len(self.rows) > MOST_RECORDED:
                raise RecordingError(
                    f"the drive has lasted {self.time:g} s: its recording would exceed {MOST_RECORDED / 1e9:g} GB."
                )
            self.rows.append(self._sample())

    def _next_targets(self) -> Float[np.ndarray, " n_servos"]:
        return self.targets(self._readings[0])

    def watch(self) -> None:
        """Watch the robot during a pause; a page calls this method instead of `tick`."""

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self.ticks * self.dt

    @property
    def is_finite(self) -> bool:
        """Whether the state of the simulation is finite."""
        return bool(np.isfinite(self._readings).all())

    @property
    def state(self) -> LoopState:
        """State of the controller and the metrics; its leaves have no world axis."""
        return jax.tree.map(lambda leaf: np.asarray(leaf)[0], self._compiled.unpack(self._state))

    @property
    def cycle_rate(self) -> float:
        """Present gait frequency [Hz]."""
        return float(np.ravel(self._controller.cycle_rate(self.control))[0])

    def value(self, name: str) -> float | None:
        """The commanded value of a parameter; None if the controller does not have it."""
        return self._commanded.get(name)

    @property
    def sample(self) -> Recording:
        """A recording of one sample, after the last tick or at the start."""
        return self._make_recording([self._sample()], np.array([self.time]), {})

    def recording(self) -> Recording:
        """The recording of the drive since the start, which `replay_drive` can repeat.

        Raises:
            RecordingError: There was no tick, or the drive does not record.
        """
        if not self.rows:
            raise RecordingError("nothing was driven: there is nothing to record.")
        driven = {"values": self.values, **self.piece()}
        return self._make_recording(self.rows, (1 + np.arange(len(self.rows))) * self.dt, driven)

    def piece(self, commands: int = 0, pushes: int = 0) -> dict[str, Any]:
        """Commands and pushes in the form of files, without the first `commands` and `pushes`."""
        switches = [[tick, switch.written()] for tick, switch in self.commands[commands:]]
        return {"commands": switches, "pushes": [*map(dataclasses.asdict, self.pushes[pushes:])]}

    def _sample(self) -> tuple[np.ndarray, ...]:
        body = self._body
        return (
            body.qpos[0].copy(),
            body.qvel[0].copy(),
            body.ctrl[0].copy(),
            self._readings[0, -1].copy(),
        )

    def _make_recording(
        self, rows: list[tuple[np.ndarray, ...]], time: np.ndarray, driven: dict[str, Any]
    ) -> Recording:
        qpos, qvel, ctrl, sensordata = map(np.stack, zip(*rows, strict=True))
        sensors = self.simulator.robot.sensors(sensordata)
        named_values = {
            field.name: np.asarray(getattr(sensors, field.name))
            for field in dataclasses.fields(sensors)
        }
        metadata = plain_json(self.about | {"driven": driven}) if driven else self.about
        return Recording(time, qpos, qvel, ctrl, named_values, self._hash, metadata)

    def _effective_parameters(
        self, commanded: Mapping[str, float], modes: Mapping[str, set[str]]
    ) -> Any:
        """The commanded parameters, with gains of 0 for the inactive modes."""
        available = self.simulator.setup.modes
        off = {
            gain
            for field in MODE_CHOICES
            for name in set(available[field]) - modes[field]
            for gain in MODE_GAINS[name]
        }
        values = {
            name: np.array([value])
            for name, value in {**commanded, **dict.fromkeys(off, 0.0)}.items()
        }
        return default_precision(replace_quantities(self._params.control, values))

    def _lanes(self) -> Any:
        params = dataclasses.replace(self._params, control=self.control)
        return jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf), BLOCK_WORLDS, 0), params)


def _numbers(control: Any) -> dict[str, float]:
    """The parameters of one world by name, from leaves (1, ...)."""
    return {name: float(np.asarray(value)[0]) for name, value in values_of(control)}


def _with_all_modes(setup: Setup) -> Setup:
    """The setup with every mode of the robot; a switch after the end turns on the inactive modes."""
    spine = LATERAL_MODES + (SAGITTAL_MODES if setup.robot == "nermo_41" else ())
    on: list[dict[str, Any]] = [{"spine": "+".join(spine), "head": GAZE}]
    on += [
        {"tail_motion": name} for name in TAIL_MOTIONS if setup.tail != "rigid" and name != NO_MODE
    ]
    later = tuple(Switch(1e5 * (k + 1), **mode_choice) for k, mode_choice in enumerate(on))
    return dataclasses.replace(setup, schedule=later)


def _code(setup: Setup) -> dict[str, str]:
    """Name and content of the file of a setup's controller, if the controller is given by a text."""
    return (
        code_identity(dataclasses.replace(setup, metrics=()))
        if isinstance(setup.controller, str)
        else {}
    )


# ---
# Drives in files: the metadata of a recording, and the journal of a drive, which grows piece by piece.


Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]


class CommandFields(BaseModel, extra="forbid"):
    """A command in messages and files: the fields of a switch of a schedule."""

    gait: str | None = None
    steering: str | None = None
    spine: str | None = None
    head: str | None = None
    tail_motion: str | None = None
    blend: Finite = 1.0
    set: dict[str, Finite] = {}

    def switch(self, begin: float) -> Switch:
        """The switch at a time [s]; raises `ParameterError` like `Switch`."""
        fields = {
            name: getattr(self, name)
            for name in ("gait", "steering", "spine", "head", "tail_motion")
        }
        return Switch(begin, self.blend, **fields, values=self.set)


class _TimedCommand(CommandFields):
    at: Finite = 0.0


class _DriveContent(BaseModel, extra="forbid"):
    values: dict[str, Finite] = {}
    commands: list[tuple[NonNegativeInt, _TimedCommand]] = []
    pushes: list[Push] = []
    samples: list[
        tuple[list[float | None], list[float | None], list[float | None], list[float | None]]
    ] = []
    ticks: NonNegativeInt = 0


#: Time between two writes of a journal [s].
_JOURNAL_SECONDS: Final = 0.25


class AppendedFile:
    """A file to which a thread appends the drive, so that the drive never waits for the disk.

    Attributes:
        path: Path of the file.
        error: Error of the last write, whose content is written later; None if the file can be written.
    """

    def __init__(self, path: Path) -> None:
        """
        Raises:
            OSError: The file cannot be created, or exists.
        """
        self.path, self.error = path, cast("OSError | None", None)
        self._file, self._stop, self._left = path.open("xb", buffering=0), threading.Event(), b""
        self._thread = threading.Thread(target=self._work, daemon=True)

    def _new_content(self) -> bytes:
        """The new content since the last call."""
        raise NotImplementedError

    def _work(self) -> None:
        ended = False
        while not ended:
            ended = self._stop.wait(_JOURNAL_SECONDS)
            self._left += self._new_content()
            try:
                while self._left:
                    self._left = self._left[self._file.write(self._left) :]
                os.fsync(self._file.fileno())
                self.error = None
            except OSError as error:
                self.error = error

    def end(self, keep: bool = True) -> None:
        """Write the rest and close the file; without `keep`, it is deleted."""
        self._stop.set()
        self._thread.join()
        self._file.close()
        if not keep:
            self.path.unlink(missing_ok=True)


class Journal(AppendedFile):
    """The journal of a drive.

    The first line contains the metadata of the drive, as JSON. Each other line contains the progress of the drive, with
    the commands and pushes since the line before, and with the samples if commands cannot repeat them, as for a robot.
    """

    def __init__(self, path: Path, driving: Driving) -> None:
        """See `AppendedFile`."""
        super().__init__(path)
        self._driving, self._written, self._before = driving, (0, 0, 0), cast(Any, None)
        self._left = (
            json.dumps(plain_json(driving.about | {"driven": {"values": driving.values}})).encode()
            + b"\n"
        )
        self._thread.start()

    def _new_content(self) -> bytes:
        driving = self._driving
        ticks, (commands, pushes, samples) = (
            driving.ticks,
            self._written,
        )  # the journal contains all commands before this tick
        piece = driving.piece(commands, pushes) | {"ticks": ticks}
        piece["samples"] = [] if driving.repeatable else driving.rows[samples:]
        commands, pushes = commands + len(piece["commands"]), pushes + len(piece["pushes"])
        self._written = commands, pushes, samples + len(piece["samples"])
        if self._before == (now := (ticks, self._written)):
            return b""
        self._before = now
        return json.dumps(plain_json(piece)).encode() + b"\n"


def _read_drive(source: Recording | Path) -> tuple[Mapping[str, Any], _DriveContent]:
    """Read the metadata and the commands of a drive from a recording, or from a journal up to its last whole line."""
    try:
        if isinstance(source, Recording):
            metadata, pieces = source.metadata, [b'{"ticks": %d}' % len(source.time)]
        else:  # after a power failure, zeros may follow
            first, *pieces = read_bytes(source, MAX_FILE_BYTES).partition(b"\0")[0].split(b"\n")[
                :-1
            ] or [b""]
            metadata = read_as(first, Metadata, "line 1").model_dump()
        driven: _DriveContent = read_as(json.dumps(metadata.get("driven")), _DriveContent, "driven")
        for number, text in enumerate(pieces, 2):
            piece: _DriveContent = read_as(text, _DriveContent, f"line {number}")
            for name in ("commands", "pushes", "samples"):
                getattr(driven, name).extend(getattr(piece, name))
            driven.ticks = max(driven.ticks, piece.ticks)
    except (FileError, OSError) as error:
        raise RecordingError(
            f"the recording is not of a drive ({str(error).rstrip('.')}); nermo-mjx drive --record writes one."
        ) from None
    if not (driven.ticks or driven.samples):
        raise RecordingError("nothing was driven: there is nothing to make again.")
    return metadata, driven


def _make_setup(metadata: Mapping[str, Any], controller: Any) -> Setup:
    """The setup of a drive, with `controller` instead of the controller in the metadata, if it is given."""
    choices = RecordedSetup.choices(metadata.get("setup") or {}) | (
        {} if controller is None else {"controller": controller}
    )
    controller_name = None if controller is not None else choices.get("controller")
    if controller_name is not None and (data_of(controller_name) or ("", controller_name))[1]:
        advice = (
            "give your own copy of it, --controller FILE.py:NAME, or FILE.npz:FILE.py of a policy"
        )
        raise ParameterError(
            f"controller is {controller_name!r}, code that a file names, which is not run: {advice}."
        )
    setup = Setup(**choices)
    if (code := metadata.get("code")) and code != _code(setup):
        raise ParameterError(
            f"controller is {setup.controller!r}: another one than that of the drive."
        )
    return setup


def as_sweep(recording: Recording, controller: Any = None) -> dict[str, Any]:
    """The fields of a sweep file that repeats the commands of a drive from five slightly different initial states.

    Its `schedule` contains the commands, without the pushes.

    Raises:
        RecordingError: The recording does not contain a drive.
        ParameterError: See `replay_drive`; or there are too many commands for a schedule, or they overlap.
    """
    metadata, driven = _read_drive(recording)
    dt, values = float(recording.time[0]), driven.values
    switches = tuple(command.switch(round(tick * dt, 9)) for tick, command in driven.commands)
    setup = dataclasses.replace(_make_setup(metadata, controller), schedule=switches)
    setup.check(setup.world({name: np.asarray(value) for name, value in values.items()}))
    options = {
        name.removeprefix("pilot."): value
        for name, value in values.items()
        if name.startswith("pilot.")
    }
    fixed = {name: value for name, value in values.items() if not name.startswith("pilot.")}
    run = Run(duration=round(float(recording.time[-1]), 9), warmup=0.0)
    return WalkSpec(setup, run, fixed, options).walk_fields(Path.cwd()) | {
        "randomize": {"repeats": 5}
    }


def replay_drive(source: Recording | Path, controller: Any = None) -> Recording:
    """Repeat a drive, and return its recording.

    Args:
        source: Recording or journal of the drive.
        controller: Controller as in `Setup`, which replaces a controller in the file, whose Python code is not run.

    Raises:
        RecordingError: The file does not contain a drive.
        ParameterError: The setup or a command contains Python code, or something that this version does not have.
    """
    metadata, driven = _read_drive(source)
    driving = Driving(_make_setup(metadata, controller), driven.values)
    if driven.samples:
        driving.rows = [
            tuple(np.array(part, float) for part in sample) for sample in driven.samples
        ]
        if {tuple(map(len, row)) for row in driving.rows} != {tuple(map(len, driving._sample()))}:
            raise RecordingError("its samples are not of this robot.")
        replay = driving.recording()
        return dataclasses.replace(replay, metadata={**replay.metadata, "driven": None})
    for tick in range(driven.ticks):
        for command_tick, command in driven.commands:
            if command_tick == tick:
                driving.command(command.switch(driving.time))
        for push in driven.pushes:
            if push.tick == tick:
                driving.push(push.body, push.force, push.ticks * driving.dt)
        driving.tick()
    return driving.recording()


def difference(first: Recording, second: Recording) -> float | None:
    """Time of the first sample [s] whose positions, velocities or targets differ in any bit; None if all are equal."""
    pairs = [(getattr(first, name), getattr(second, name)) for name in ("qpos", "qvel", "ctrl")]
    differs = np.any([(a != b).any(axis=1) for a, b in pairs], axis=0)
    return float(first.time[np.argmax(differs)]) if differs.any() else None
