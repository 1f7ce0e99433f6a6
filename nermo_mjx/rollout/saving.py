"""Time series of selected signals, stored in addition to the metrics while a batch runs.

A signal is one number over time, a column. Names select signals: one signal, a sensor of the model with all its
components (`front_left_foot_velocity`), or a group of sensors (`foot_force`).
"""

from __future__ import annotations

import dataclasses
import functools
import re
from typing import Final

import jax
import mujoco
import numpy as np
from jaxtyping import Float, Int

from nermo_mjx.kinematics.body import attitude
from nermo_mjx.physics import Trace
from nermo_mjx.robot import ParameterError, Robot, Sensors
from nermo_mjx.robot.parameters import READINGS, reading_names
from nermo_mjx.robot.quantity import did_you_mean

#: Names of the root's free joint in positions and velocities, with units.
_ROOT: Final = {
    "qpos": [*((f"_{axis}", "m") for axis in "xyz"), *((f"_q{axis}", "1") for axis in "wxyz")],
    "qvel": [*((f"_{axis}", "m/s") for axis in "xyz"), *((f"_w{axis}", "rad/s") for axis in "xyz")],
}
#: The readings that a simulation can store; the others are a policy's.
SAVED: Final = tuple(
    name
    for name in READINGS
    if name not in ("foot_contact", "motor_current", "projected_gravity", "height_scan")
)
_STATE: Final = {"qpos": ("rad", "generalised position"), "qvel": ("rad/s", "generalised velocity")}


@dataclasses.dataclass(frozen=True)
class Signal:
    """One number over time.

    Attributes:
        name: of the column.
        unit, doc: as in a table.
        source: `qpos`, `qvel`, or one of `SAVED`; `place`: index in the flattened source.
    """

    name: str
    unit: str
    doc: str
    source: str
    place: int

    @property
    def names(self) -> tuple[str, ...]:
        """Names that select it: its own, its sensor's, its group's."""
        sensor = (
            self.name.rpartition("_")[0]
            if self.source in ("foot_position", "foot_velocity")
            else self.name
        )
        return self.name, sensor, self.source


@dataclasses.dataclass(frozen=True)
class Saving:
    """Selection and rate of the signals that are stored.

    Attributes:
        sensors: names of signals, sensors or groups.
        rate: samples per simulated second [Hz].
    """

    sensors: tuple[str, ...]
    rate: float = 50.0


@dataclasses.dataclass(frozen=True)
class Series:
    """Time series of a batch of n worlds.

    Attributes:
        time: of the samples, since the start [s].
        values: name of a signal -> (n, samples), float32.
        count: samples of each world (n,): until its run ends, or it diverges.
    """

    time: Float[np.ndarray, " samples"]
    values: dict[str, Float[np.ndarray, "n samples"]]
    count: Int[np.ndarray, " n"]

    def first(self, worlds: int) -> Series:
        """The series of the first worlds."""
        return self.take(slice(worlds))

    def take(self, worlds: slice) -> Series:
        """The series of some worlds."""
        values = {name: column[worlds] for name, column in self.values.items()}
        return Series(self.time, values, self.count[worlds])


def all_signals(robot: Robot) -> tuple[Signal, ...]:
    """Every signal that this robot has.

    >>> from nermo_mjx import load_robot
    >>> [each.name for each in all_signals(load_robot()) if each.source == "gyro"]
    ['gyro_x', 'gyro_y', 'gyro_z']
    """
    model, signals = robot.physical, []
    for kind, (unit, doc) in _STATE.items():
        address = 0
        for i in range(model.njnt):
            joint = model.joint(i).name
            free = model.jnt_type[i] == mujoco.mjtJoint.mjJNT_FREE
            for part, part_unit in _ROOT[kind] if free else [("", unit)]:
                signals.append(
                    Signal(f"{kind}_{joint}{part}", part_unit, f"{doc} of {joint}", kind, address)
                )
                address += 1
    for group in SAVED:
        names = reading_names(group, robot.servos)
        unit = READINGS[group].unit
        doc = READINGS[group].doc
        signals += [Signal(name, unit, doc, group, i) for i, name in enumerate(names)]
    return tuple(signals)


def chosen_signals(robot: Robot, saving: Saving) -> tuple[Signal, ...]:
    """The signals that the names select, each once, in the order of the names.

    Raises:
        ParameterError: an unknown name; the message suggests the closest one.
    """
    every, selected = all_signals(robot), dict[str, Signal]()
    for name in saving.sensors:
        # Former versions said `ctrl` and `spine_ctrl`.
        pattern = re.sub("(^|_)ctrl$", r"\1servo_command", name)
        matches = [signal for signal in every if pattern in signal.names]
        if not matches:
            groups = dict.fromkeys(signal.source for signal in every)
            hint = did_you_mean(
                name, dict.fromkeys(signal_name for signal in every for signal_name in signal.names)
            )
            raise ParameterError(
                f"sensors has {name!r}: allowed are {', '.join(groups)}, or one sensor of a group, such as gyro_z or "
                f"front_left_foot_force{hint}"
            )
        selected |= {signal.name: signal for signal in matches}
    return tuple(selected.values())


def ticks_between(saving: Saving, dt: float) -> int:
    """Control ticks from one sample to the next.

    Args:
        saving: with its rate.
        dt: length of a control tick [s].

    Raises:
        ParameterError: the control rate is not a whole multiple of the rate.
    """
    control = 1.0 / dt
    ticks = max(1, round(control / saving.rate)) if saving.rate > 0 else 1
    if not abs(control / ticks - saving.rate) <= 1e-3 * saving.rate:
        raise ParameterError(
            f"rate is {saving.rate:g}: allowed is the control rate, {control:g} Hz, or that divided by a whole number; "
            f"the nearest is {control / ticks:.6g}."
        )
    return ticks


class Keeper:
    """Collects the selected signals of a batch block by block, without storing the rest of a block."""

    def __init__(self, saving: Saving, robot: Robot, dt: float) -> None:
        """
        Args:
            saving: signals to store.
            robot: that the signals belong to.
            dt: length of a control tick [s].

        Raises:
            ParameterError: see `chosen_signals` and `ticks_between`.
        """
        self.signals, self._every = chosen_signals(robot, saving), ticks_between(saving, dt)
        self._robot, self._dt, self._ticks = robot, dt, 0
        self._parts: list[list[np.ndarray]] = []

    def add(self, trace: Trace) -> None:
        """Store the samples of the next block of ticks."""
        ticks = trace.qpos.shape[1]
        first = (-self._ticks - 1) % self._every
        self._ticks += ticks
        stored = Trace(
            *(
                getattr(trace, field.name)[:, first :: self._every]
                for field in dataclasses.fields(Trace)
            )
        )
        sensors = self._robot.sensors(np.asarray(stored.sensordata))
        read_source = functools.cache(lambda source: _read(source, stored, sensors))
        self._parts.append(
            [
                read_source(signal.source)[..., signal.place].astype(np.float32)
                for signal in self.signals
            ]
        )

    def series(self, ends: Float[np.ndarray, " n"]) -> Series:
        """The stored series, given the worlds' end times [s]."""
        columns = (np.concatenate(parts, axis=1) for parts in zip(*self._parts, strict=True))
        values = dict(zip((signal.name for signal in self.signals), columns, strict=True))
        step = self._every * self._dt
        samples = self._ticks // self._every
        count = np.clip(np.floor(np.nan_to_num(ends) / step + 1e-3), 0, samples).astype(int)
        time = np.round(np.arange(1, samples + 1) * step, 9)
        longest = int(count.max(initial=0))
        return Series(
            time[:longest], {name: signal[:, :longest] for name, signal in values.items()}, count
        )


def _read(source: str, trace: Trace, sensors: Sensors) -> np.ndarray:
    """The values of a source (n, samples, ...), with the trailing axes flattened."""
    if source in ("qpos", "qvel", "servo_command"):
        return np.asarray(trace.ctrl if source == "servo_command" else getattr(trace, source))
    if source == "speed":
        return np.hypot(sensors.linear_velocity[..., 0], sensors.linear_velocity[..., 1])[..., None]
    if source == "attitude":
        return np.asarray(_attitude(sensors.orientation))
    values = np.asarray(getattr(sensors, source))
    return values.reshape(*trace.qpos.shape[:2], -1)


_attitude = jax.jit(attitude)
