"""A drive: the controller and a body on engine c, tick by tick, with everything that makes it again bit for bit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from nermo_mjx.control.schedule import Switch
from nermo_mjx.live.running import Running
from nermo_mjx.physics.c_engine import CBodies
from nermo_mjx.recording import Recording, RecordingError, model_hash
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout import Run, Setup
from nermo_mjx.rollout.simulator import MOST_RECORDED, TICK_BYTES
from nermo_mjx.runs.provenance import versions
from nermo_mjx.runs.text import plain
from nermo_mjx.specs.walk import WalkSpec

#: Largest force of a push on each axis [N]; the robot weighs 2.65 N. Longest push [s].
MOST_FORCE: Final = 10.0
LONGEST_PUSH: Final = 5.0


@dataclasses.dataclass(frozen=True)
class Push:
    """A force on a body.

    Attributes:
        tick: before which it begins.
        ticks: that it lasts.
        body: index in the model.
        force: in the world, at the body's centre of mass [N].
    """

    tick: int
    ticks: int
    body: int
    force: tuple[float, float, float]


class Driving:
    """A drive from its start to now.

    Attributes:
        running: the controller.
        values: of parameters at the start, by name.
        pushes: since the start.
    """

    def __init__(self, setup: Setup, values: Mapping[str, float] | None = None, *, record: bool = True) -> None:
        """
        Args:
            setup, values: as for `Running`.
            record: whether every tick is kept, for `recording`.

        Raises:
            ParameterError: see `Running`.
        """
        self.running, self.values, self._record = Running(setup, values), dict(values or {}), record
        parameters = setup.defaults() | self.values
        self._about = {"parameters": parameters, "setup": setup.fields(), "engine": "c", "versions": versions()}
        self._hash = model_hash(self.running.simulator.robot.model)
        self.reset()

    def reset(self) -> None:
        """Start anew: the robot at its start, and all commands as in the setup."""
        running = self.running
        self._body = CBodies(running.simulator.engine, running.batch.qpos, running.batch.fields, 1)  # type: ignore[arg-type]
        self._forces = self._body.batch.bind("xfrc_applied")
        self._readings = np.repeat(self._body.sensordata[:, None], running.steps_per_tick, axis=1)
        self.pushes: list[Push] = []
        self._rows: list[tuple[np.ndarray, ...]] = []
        running.reset(self._body.sensordata[0])

    @property
    def time(self) -> float:
        """Since the start [s]."""
        return self.running.ticks * self.running.dt

    @property
    def is_finite(self) -> bool:
        """Whether the simulation still has numbers."""
        return bool(np.isfinite(self._readings).all())

    @property
    def sample(self) -> Recording:
        """The moment after the last tick, or the start: a recording of one sample."""
        return self._recorded([self._row()], np.array([self.time]), {})

    def push(self, body: int, force: tuple[float, float, float], seconds: float) -> None:
        """Begin to push a body; it replaces another push.

        Raises:
            ParameterError: no such body, or a force or time that is not allowed.
        """
        bodies, weld = self.running.simulator.robot.model.nbody, self.running.simulator.robot.model.body_weldid
        if not 0 < body < bodies or weld[body] == 0:
            raise ParameterError(f"push.body is {body}: allowed is one of the robot's, below {bodies}.")
        if not np.all(np.abs(force) <= MOST_FORCE):
            raise ParameterError(f"push.force is {list(force)}: allowed is [-{MOST_FORCE:g}, {MOST_FORCE:g}] N.")
        if not 0 < seconds <= LONGEST_PUSH:
            raise ParameterError(f"push.seconds is {seconds:g}: allowed is (0, {LONGEST_PUSH:g}] s.")
        ticks = max(1, round(seconds / self.running.dt))
        self.pushes.append(Push(self.running.ticks, ticks, body, (float(force[0]), float(force[1]), float(force[2]))))

    def commanded(self) -> Float[np.ndarray, " n_servos"]:
        """The controller's tick: servo angles [rad]."""
        return self.running.tick(self._readings[0])

    def tick(self) -> None:
        """The controller's tick, and the physics until the next one."""
        now, self._forces[...] = self.running.ticks, 0.0
        if self.pushes and now < self.pushes[-1].tick + self.pushes[-1].ticks:
            self._forces[0, self.pushes[-1].body, :3] = self.pushes[-1].force
        self._body.ctrl[...] = self.commanded()
        self._body.move(self._readings)
        if self._record:
            if TICK_BYTES * len(self._rows) > MOST_RECORDED:
                raise ParameterError(
                    f"the drive has lasted {self.time:g} s: its recording would exceed {MOST_RECORDED / 1e9:g} GB."
                )
            self._rows.append(self._row())

    def recording(self) -> Recording:
        """What was driven since the start; `replayed` makes it again.

        Raises:
            RecordingError: nothing was, or nothing was kept.
        """
        if not self._rows:
            raise RecordingError("nothing was driven: there is nothing to record.")
        time = (1 + np.arange(len(self._rows))) * self.running.dt
        commands = [[tick, switch.written()] for tick, switch in self.running.commands]
        pushes = [dataclasses.asdict(push) for push in self.pushes]
        return self._recorded(self._rows, time, {"values": self.values, "commands": commands, "pushes": pushes})

    def _row(self) -> tuple[np.ndarray, ...]:
        body = self._body
        return body.qpos[0].copy(), body.qvel[0].copy(), body.ctrl[0].copy(), self._readings[0, -1].copy()

    def _recorded(self, rows: list[tuple[np.ndarray, ...]], time: np.ndarray, driven: dict[str, Any]) -> Recording:
        robot = self.running.simulator.robot
        qpos, qvel, ctrl, sensordata = map(np.stack, zip(*rows, strict=True))
        sensors = robot.sensors(sensordata)
        named = {field.name: np.asarray(getattr(sensors, field.name)) for field in dataclasses.fields(sensors)}
        about = plain(self._about | {"driven": driven}) if driven else self._about
        return Recording(time, qpos, qvel, ctrl, named, self._hash, about)


def _read(recording: Recording) -> tuple[Setup, dict[str, float], list[tuple[int, Switch]], list[Push]]:
    """Setup, values, commands with their ticks, and pushes of a recorded drive."""
    driven: Any = recording.metadata.get("driven")
    fields: Any = dict(recording.metadata.get("setup") or {})
    try:
        commands = [(int(tick), _switch(dict(written))) for tick, written in driven["commands"]]
        pushes = [Push(**{**push, "force": tuple(push["force"])}) for push in driven["pushes"]]
        values = {str(name): float(value) for name, value in driven["values"].items()}
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise RecordingError(
            f"the recording is not of a drive ({error}); nermo-mjx drive --record writes one."
        ) from None
    fields |= {"schedule": (), "metrics": ()}  # whose switches are among the commands
    fields["waypoints"] = None if fields.get("waypoints") is None else tuple(map(tuple, fields["waypoints"]))
    return Setup(**fields), values, commands, pushes


def as_sweep(recording: Recording) -> dict[str, Any]:
    """The fields of a sweep file that walks as was driven, from five slightly different starts.

    Its `schedule` has the commands. Pushes are left out.

    Raises:
        RecordingError: it is not of a drive.
        ParameterError: as `replayed`; or there are more commands than a schedule can have, or they overlap.
    """
    setup, values, commands, _ = _read(recording)
    dt = float(recording.time[0])
    switches = tuple(dataclasses.replace(switch, at=round(tick * dt, 9)) for tick, switch in commands)
    driven = dataclasses.replace(setup, schedule=switches)
    driven.check(driven.world({name: np.asarray(value) for name, value in values.items()}))
    options = {name.removeprefix("pilot."): value for name, value in values.items() if name.startswith("pilot.")}
    fixed = {name: value for name, value in values.items() if not name.startswith("pilot.")}
    run = Run(duration=round(float(recording.time[-1]), 9), warmup=0.0)
    return WalkSpec(driven, run, fixed, options).walk_fields(Path.cwd()) | {"randomize": {"repeats": 5}}


def replayed(recording: Recording) -> Recording:
    """The drive of a recording, driven again.

    Raises:
        RecordingError: it is not of a drive.
        ParameterError: its setup or a command names something that this version does not have.
    """
    setup, values, commands, pushes = _read(recording)
    driving = Driving(setup, values)
    for tick in range(len(recording.time)):
        for at, switch in commands:
            if at == tick:
                driving.running.command(switch)
        for push in pushes:
            if push.tick == tick:
                driving.push(push.body, push.force, push.ticks * driving.running.dt)
        driving.tick()
    return driving.recording()


def difference(one: Recording, other: Recording) -> float | None:
    """Time of the first sample that differs in any bit of positions, velocities or targets [s]; None if none does."""
    pairs = [(getattr(one, name), getattr(other, name)) for name in ("qpos", "qvel", "ctrl")]
    differs = np.any([(a != b).any(axis=1) for a, b in pairs], axis=0)
    return float(one.time[np.argmax(differs)]) if differs.any() else None


def _switch(written: dict[str, Any]) -> Switch:
    return Switch(**{("values" if name == "set" else name): value for name, value in written.items()})
