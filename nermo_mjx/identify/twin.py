"""Simulations of a model under the commands of a log, in batches of parameter sets, and the predicted samples.

The model is any MJCF, or Nermo. The control of a step is the mean of the command during this step, shifted by `delay`,
so that predictions depend smoothly on the delay. The base stays fixed if no channel measures it. The initial state
depends on the model:

- A model with position servos starts at the first angles of the log.
- A model with a free base first stands at the first commands for `SETTLING_SECONDS`.
- A model with motors restarts from the measured angles every `RESTART_SECONDS`, because its errors grow.

`hardware.twin.replay_log` simulates Nermo under the same commands, and holds each command until the next one. Its numbers
differ for this reason, and because its track is the track of the IMU: a position here is the origin of a body, and a
yaw the direction of the body's x axis. It records one run of `Simulator`, which this module cannot: `predict` simulates
batches of bodies, of which each has its own delay, and the predictions must be smooth in the delay.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from nermo_mjx.hardware.log import Channel, Log
from nermo_mjx.hardware.twin import SETTLING_SECONDS
from nermo_mjx.identify.body import BATCH_WORLDS, Body, load_body
from nermo_mjx.identify.estimation import LoggedSamples, projection_without
from nermo_mjx.physics.servo_play import Play, ServosWithPlay
from nermo_mjx.physics.variation import moves_constants
from nermo_mjx.robot import ParameterError
from nermo_mjx.runtime import thread_count

#: Interval after which a model without servos restarts from the measured angles [s].
RESTART_SECONDS: Final = 0.5
#: Time after which the initial state no longer affects a model with servos [s].
INITIAL_STATE_SECONDS: Final = 2.0
#: Perturbations of the unknown initial positions and velocities.
INITIAL_STATE_WIDTHS: Final = (1e-4, 1e-3)
#: Quantities of the channels that a model predicts.
PREDICTED_QUANTITIES: Final = (
    "angle",
    "velocity",
    "gyro",
    "accelerometer",
    "position",
    "yaw",
    "torque",
)
_SENSORS: Final = {"gyro": "GYRO", "accelerometer": "ACCELEROMETER"}


class LoggedTwin:
    """The predictions of a model for logs; an `EstimationProblem`.

    Attributes:
        has_free_base: Whether the base of the model is free.
        labels, components: Names of the channels, and number of values in a sample of each.
        is_selected: Mask of the simulated values that `measured` contains.
        measured: Measured samples.
    """

    def __init__(
        self,
        body: Body,
        logs: Sequence[Log],
        names: Sequence[str],
        selection: Callable[[np.ndarray, float], np.ndarray] | None = None,
    ) -> None:
        """
        Args:
            body: Model, and its parameters.
            logs: Logs with the commands and the measured samples.
            names: Names of the parameters, in the order of the values of `predict`.
            selection: Function of times (n,) and the duration of their log, returns a mask (n,) of the samples that
                count; by default all samples count.

        Raises:
            ParameterError: The model lacks a part that a channel names, a log contains no command, or no channel is
                predicted.
        """
        for log in logs if body.model.nu else ():
            log.commands()
        self.body, self.names, self.logs = body, tuple(names), tuple(logs)
        pushed = not body.servos.all() and body.model.nu > 0
        self._simulations = [
            _LogSimulation(body, log, RESTART_SECONDS if pushed else None) for log in logs
        ]
        if not all(simulation.channels for simulation in self._simulations):
            raise ParameterError(
                "no channel of the log is one that a model predicts: give angles, an IMU, or a track."
            )
        self.has_free_base = any(simulation.has_free_base for simulation in self._simulations)
        sizes = {
            channel.name: channel.values[:1].size
            for simulation in self._simulations
            for channel in simulation.channels
        }
        self.labels, self.components = tuple(sizes), tuple(sizes.values())
        parts, offset = [], 0.0
        for simulation in self._simulations:
            for channel in simulation.channels:
                is_selected = simulation.is_simulated(channel) & (
                    True if selection is None else selection(channel.times, simulation.log.duration)
                )
                size, values = channel.values[:1].size, channel.values
                parts.append(
                    (
                        (np.unwrap(values) if channel.quantity == "yaw" else values).ravel(),
                        np.full(values.size, self.labels.index(channel.name)),
                        np.repeat(offset + channel.times, size),
                        np.repeat(is_selected, size),
                    )
                )
            offset += simulation.log.duration + 1.0
        *columns, self.is_selected = map(np.concatenate, zip(*parts, strict=True))
        values, channel_index, times = (column[self.is_selected] for column in columns)
        quantum = np.array([_quantum(values[channel_index == i]) for i in range(len(sizes))])
        self.measured = LoggedSamples(values, channel_index, times, quantum)
        self._nuisance_columns: list[tuple[np.ndarray, np.ndarray]] = []

    def predict(self, values: np.ndarray) -> np.ndarray:
        """Predictions (k, n) of the measured samples, for parameter values (k, p)."""
        rows = []
        for block in np.array_split(values, -(-len(values) // BATCH_WORLDS)):
            parts = [simulation.predict(self.names, block) for simulation in self._simulations]
            rows.append(np.concatenate(parts, axis=1)[:, self.is_selected])
        return np.concatenate(rows)

    @functools.cached_property
    def parts(self) -> tuple[np.ndarray, np.ndarray]:
        """Index of the kinematic tree of each parameter (p,) and each channel (channels,).

        The index is -1 for several trees, and if equalities or tendons may connect trees.
        """
        body, model = self.body, self.body.model
        part_of_channel = {
            channel.name: model.jnt_dofadr[body.joint(channel.of)]
            if channel.quantity in ("angle", "velocity")
            else -1
            for simulation in self._simulations
            for channel in simulation.channels
        }
        dofs = np.array(
            [
                *(body.dofs.get(name, -1) for name in self.names),
                *(part_of_channel[label] for label in self.labels),
            ]
        )
        trees = np.where((dofs < 0) | (model.neq + model.ntendon > 0), -1, model.dof_treeid[dofs])
        return trees[: len(self.names)], trees[len(self.names) :]

    def linearize(self, values: np.ndarray) -> None:
        """See `EstimationProblem.linearize`."""
        self._nuisance_columns, first = [], 0
        for simulation in self._simulations:
            columns, window = simulation.linearize_initial_state(self.names, values)
            is_kept = self.is_selected[first : first + len(window)]
            row = np.cumsum(self.is_selected)[first : first + len(window)] - 1
            first += len(window)
            for w in np.unique(window[is_kept]):
                rows = np.flatnonzero(is_kept & (window == w))
                if len(rows) > columns.shape[1] > 0:
                    self._nuisance_columns.append((row[rows], columns[rows]))
        self._projections: dict[
            bytes, list[tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]]
        ] = {}

    def project(self, residual: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """See `EstimationProblem.project`."""
        if not self._nuisance_columns:
            return residual
        if (key := sigma.tobytes()) not in self._projections:
            channel_index = self.measured.channel
            self._projections[key] = [
                (rows, projection_without(c / sigma[channel_index[rows]][:, None]))
                for rows, c in self._nuisance_columns
            ]
        residual = residual.copy()
        for rows, remove in self._projections[key]:
            residual[rows] = remove(residual[rows])
        return residual


def replay_on_model(log: Log, model: str | os.PathLike[str]) -> tuple[Log, tuple[str, ...]]:
    """Simulate any MJCF under the commands of a log.

    The initial state has the first angles of the log; a model with a free base stands first.

    Returns:
        The predicted channels, with the time stamps of the log, and the assumptions as sentences.

    Raises:
        ParameterError: The log and the model do not fit together, or the simulation diverges.
    """
    body = load_body(model, [log], ())
    twin = LoggedTwin(body, [log], ())
    predicted, channels = twin.predict(np.zeros((1, 0)))[0], list[Channel]()
    if not np.isfinite(predicted).all():
        raise ParameterError(f"{model} diverges under the commands of {log.file}.")
    for channel in log.channels:
        if channel.name in twin.labels:
            rows = twin.measured.channel == twin.labels.index(channel.name)
            values = predicted[rows].reshape(-1, *channel.values.shape[1:])
            times = twin.measured.time[rows].reshape(len(values), -1)[:, 0]
            channels.append(dataclasses.replace(channel, times=times, values=values))
    return Log(tuple(channels), str(model)), tuple(body.notes)


def _quantum(values: np.ndarray) -> float:
    """Step of quantized values; 0 if the resolution is fine."""
    steps = np.unique(np.round(np.abs(np.diff(np.unique(values))), 12))
    steps = steps[steps > 0]
    return float(steps[0]) if len(steps) and len(np.unique(values)) < len(values) / 4 else 0.0


def truncate_log(log: Log, end: float) -> Log:
    """The samples of a log before a time [s]; every channel keeps at least one sample."""
    parts = []
    for channel in log.channels:
        is_before = channel.times < max(end, float(channel.times[0]) + 1e-9)
        parts.append(
            dataclasses.replace(
                channel, times=channel.times[is_before], values=channel.values[is_before]
            )
        )
    return dataclasses.replace(log, channels=tuple(parts))


class _LogSimulation:
    """Simulations of a model under the commands of one log, in one or several windows of time."""

    def __init__(self, body: Body, log: Log, window: float | None) -> None:
        self.body, self.log, model = body, log, body.model
        self.channels = tuple(
            channel for channel in log.channels if channel.quantity in PREDICTED_QUANTITIES
        )
        self.step = float(model.opt.timestep)
        self.has_free_base = any(kind == mujoco.mjtJoint.mjJNT_FREE for kind in model.jnt_type)
        total = max(1, math.ceil(log.duration / self.step))
        self.steps = (
            total if window is None or self.has_free_base else max(1, round(window / self.step))
        )
        self.windows = math.ceil(total / self.steps)
        self.settle = round(SETTLING_SECONDS / self.step) if self.has_free_base else 0
        self.readings = [self._reading(channel) for channel in self.channels]
        grid = np.arange(self.windows * self.steps + 1) * self.step
        self.grid = np.concatenate([(np.arange(self.settle) - self.settle) * self.step, grid])
        self.commands: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for channel in log.channels:
            if channel.quantity == "command":
                values_held = np.concatenate([[channel.values[0]], channel.values])
                knots = np.concatenate(
                    [
                        [min(channel.times[0], 0.0) - 10.0],
                        channel.times,
                        [max(grid[-1], channel.times[-1]) + 10.0],
                    ]
                )
                area = np.concatenate([[0.0], np.cumsum(values_held * np.diff(knots))])
                self.commands[body.commanded_actuator(channel)] = (knots, area)
        self.start = self._initial_state()

    def is_simulated(self, channel: Channel) -> np.ndarray:
        """Mask (n,) of the samples of a channel within the simulated time."""
        return (channel.times >= 0) & (channel.times < self.windows * self.steps * self.step)

    def _reading(self, channel: Channel) -> tuple[str, Any]:
        """Name of the field of MuJoCo's data that a channel measures, and the indices in it."""
        model, body = self.body.model, self.body
        if channel.quantity in ("angle", "velocity"):
            joint = body.joint(channel.of)
            address = model.jnt_qposadr if channel.quantity == "angle" else model.jnt_dofadr
            return ("qpos" if channel.quantity == "angle" else "qvel"), [int(address[joint])]
        if channel.quantity == "torque":
            return "actuator_force", [body.actuator(channel.of)]
        if channel.quantity in _SENSORS:
            kind = getattr(mujoco.mjtSensor, f"mjSENS_{_SENSORS[channel.quantity]}")
            sensor_ids = [i for i in range(model.nsensor) if model.sensor_type[i] == kind]
            named_sensors = [
                i
                for i in sensor_ids
                if channel.of in (model.sensor(i).name, model.site(int(model.sensor_objid[i])).name)
            ]
            candidates = named_sensors or (sensor_ids if len(sensor_ids) == 1 else [])
            if not candidates:
                raise ParameterError(
                    f"channel {channel.name!r}: the model has no {channel.quantity} sensor {channel.of!r}."
                )
            first = int(model.sensor_adr[candidates[0]])
            return "sensordata", list(
                range(first, first + channel.values.reshape(len(channel.times), -1).shape[1])
            )
        body_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, channel.of)
        if body_id < 0:
            raise ParameterError(f"channel {channel.name!r}: the model has no body {channel.of!r}.")
        return ("xpos" if channel.quantity == "position" else "xmat"), int(body_id)

    def _initial_state(self) -> tuple[np.ndarray, np.ndarray]:
        """Initial positions (windows, nq) and velocities (windows, nv) of the windows."""
        model = self.body.model
        rest = self.body.rest_positions()
        qpos = np.repeat(rest[None], self.windows, axis=0)
        qvel = np.zeros((self.windows, model.nv))
        begin = np.arange(self.windows) * self.steps * self.step
        for channel in self.channels:
            if channel.quantity == "angle" and not self.has_free_base:
                joint = self.body.joint(channel.of)
                i, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
                for w, t in enumerate(begin):
                    # A parabola through nearby samples reduces noise, and its slope is the velocity.
                    near = np.argsort(np.abs(channel.times - t))[:9]
                    order = min(2, len(near) - 1)
                    curve = np.polyfit(channel.times[near] - t, channel.values[near], order)
                    qpos[w, i], qvel[w, v] = (
                        curve[-1],
                        (curve[-2] if order else 0.0) if self.windows > 1 else 0.0,
                    )
        return qpos, qvel

    def controls(self, names: Sequence[str], values: np.ndarray) -> np.ndarray:
        """Controls (k, settle + windows * steps, nu) for parameter values (k, p)."""
        model, column = self.body.model, dict(zip(names, values.T, strict=True))
        delay = column.get("delay", np.zeros(len(values)))
        start_values = self.body.rest_positions()
        controls = np.zeros((len(values), len(self.grid) - 1, model.nu))
        held_commands = [
            start_values[model.jnt_qposadr[j]] if servo else 0.0
            for j, servo in zip(model.actuator_trnid[:, 0], self.body.servos, strict=True)
        ]
        controls[:] = held_commands
        for a, (knots, area) in self.commands.items():
            for delay_value in np.unique(delay):
                mean = np.diff(np.interp(self.grid - delay_value, knots, area)) / self.step
                controls[delay == delay_value, :, a] = mean
            for name in {
                f"bias.{model.actuator(a).name}",
                f"bias.{model.actuator(a).name.removesuffix('_servo')}",
            }:
                if name in column:
                    controls[:, :, a] += column[name][:, None]
        return controls

    def predict(self, names: Sequence[str], values: np.ndarray, starts: Any = None) -> np.ndarray:
        """Predictions (k, n) of all samples, for parameter values (k, p); NaN if a simulation fails.

        Args:
            names, values: Names of the parameters, and their values (k, p).
            starts: Initial positions and velocities (k, windows, ...), by default from the log.
        """
        model, body, k, w = self.body.model, self.body, len(values), self.windows
        names = (*names, *body.fixed)
        values = np.concatenate([values, np.tile(list(body.fixed.values()), (k, 1))], axis=1)
        batch = self._batch(names, values, starts)
        ctrl = self.controls(names, values)
        recorded, servos = sorted({name for name, _ in self.readings}), None
        if (play := body.play(names, values)) is not None:
            leaves = (np.broadcast_to(leaf, (k, np.shape(leaf)[-1])) for leaf in play)
            play = Play(*(np.repeat(leaf, w, axis=0) for leaf in leaves))
            servos = ServosWithPlay(model, play, k * w)
        if self.settle:
            _rollout(batch, ctrl[:, : self.settle], recorded, servos)
        driven = ctrl[:, self.settle :].reshape(k * w, self.steps, model.nu)
        first = {"qpos": np.array(batch.bind("qpos")), "qvel": np.array(batch.bind("qvel"))}
        recorded_states = _rollout(batch, driven, recorded, servos)
        is_diverged = batch.warning.reshape(k, -1).any(axis=1)
        rows = [
            self._sample(channel, reading, recorded_states, first, k)
            for channel, reading in zip(self.channels, self.readings, strict=True)
        ]
        result = np.concatenate(rows, axis=1)
        result[is_diverged] = np.nan
        return result

    def _batch(self, names: Sequence[str], values: np.ndarray, starts: Any) -> Batch:
        """Worlds of all parameter values (k, p) and all windows, in their initial states."""
        k, w = len(values), self.windows
        batch = Batch(self.body.model, k * w, nthread=thread_count(None))
        fields = self.body.fields(names, values)
        for name, field in fields.items():
            batch.expand(name)[...] = np.repeat(field, w, axis=0)
        if moves_constants(fields) or "dof_armature" in fields:
            batch.set_const()
        for name, start in zip(("qpos", "qvel"), starts or self.start, strict=True):
            batch.bind(name)[...] = np.broadcast_to(start, (k, *start.shape[-2:])).reshape(
                k * w, -1
            )
        return batch

    def _sample(
        self,
        channel: Channel,
        reading: tuple[str, Any],
        readings: Mapping[str, np.ndarray],
        first: Mapping[str, np.ndarray],
        k: int,
    ) -> np.ndarray:
        """Samples (k, n) of a channel, interpolated linearly between steps."""
        name, element = reading
        series = readings[name].reshape(k, self.windows, self.steps, *readings[name].shape[2:])
        if name == "xpos":
            series = series[..., element, : channel.values.shape[1]]
        elif name == "xmat":
            turned = series[..., element, :]
            series = np.unwrap(np.arctan2(turned[..., 3], turned[..., 0]), axis=2)[..., None]
        else:
            series = series[..., element]
        times = np.clip(channel.times, 0.0, self.windows * self.steps * self.step - 1e-9)
        window = np.minimum((times / (self.steps * self.step)).astype(int), self.windows - 1)
        local = times / self.step - window * self.steps
        if (
            name in first
        ):  # states are recorded after a step, all other quantities belong to the state before it
            start = first[name].reshape(k, self.windows, 1, -1)[..., element]
            series = np.concatenate([start, series], axis=2)
        low = (
            np.minimum(local.astype(int), series.shape[2] - 2)
            if series.shape[2] > 1
            else np.zeros(len(local), int)
        )
        share = np.clip(local - low, 0.0, 1.0)[:, None]
        high = np.minimum(low + 1, series.shape[2] - 1)
        return ((1 - share) * series[:, window, low] + share * series[:, window, high]).reshape(
            k, -1
        )

    def linearize_initial_state(
        self, names: Sequence[str], values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (n, m) of the samples with respect to the unknown initial state, and the window (n,) of each sample."""
        windows = np.concatenate([self._window_indices(channel) for channel in self.channels])
        columns = self._frame_columns()
        if not self.has_free_base:
            # With servos, the whole log is one window, and the initial state affects its first seconds only.
            is_early = (
                self
                if self.windows > 1
                else _LogSimulation(self.body, truncate_log(self.log, INITIAL_STATE_SECONDS), None)
            )
            near = np.concatenate(
                [
                    np.repeat(e.times < INITIAL_STATE_SECONDS, e.values[:1].size)
                    for e in self.channels
                ]
            )
            columns += is_early.differentiate_initial_state(
                names, values, near | (self.windows > 1)
            )
        return (np.stack(columns, axis=1) if columns else np.zeros((len(windows), 0))), windows

    def _window_indices(self, channel: Channel) -> np.ndarray:
        """Index of the window of each value of a channel."""
        window_index = np.clip(
            (channel.times / (self.steps * self.step)).astype(int), 0, self.windows - 1
        )
        return np.repeat(window_index, channel.values[:1].size)

    def differentiate_initial_state(
        self, names: Sequence[str], values: np.ndarray, rows: np.ndarray
    ) -> list[np.ndarray]:
        """Normalized derivatives (n,) of the samples `rows` (n,) with respect to each initial position and velocity."""
        model, starts, columns = self.body.model, list[Any](), list[np.ndarray]()
        for direction in np.eye(2 * model.nv):
            for sign in (1.0, -1.0):
                qpos, qvel = (
                    self.start[0].copy(),
                    self.start[1] + sign * INITIAL_STATE_WIDTHS[1] * direction[model.nv :],
                )
                for row in qpos:
                    mujoco.mj_integratePos(
                        model, row, direction[: model.nv], sign * INITIAL_STATE_WIDTHS[0]
                    )
                starts.append((qpos, qvel))
        for i in range(0, len(starts), BATCH_WORLDS):
            start_pairs = tuple(
                np.stack(part) for part in zip(*starts[i : i + BATCH_WORLDS], strict=True)
            )
            predictions = self.predict(
                names, np.repeat(values[None], len(start_pairs[0]), axis=0), start_pairs
            )
            for change in np.nan_to_num(predictions[0::2] - predictions[1::2]):
                columns.append(np.zeros(len(rows)))
                columns[-1][rows] = change / max(float(np.abs(change).max()), 1e-30)
        return columns

    def _frame_columns(self) -> list[np.ndarray]:
        """Derivatives (n,) of the samples with respect to the unknown frame of a track: its offsets, and its rotation."""
        columns = []
        sizes = [channel.values.size for channel in self.channels]
        ends = np.cumsum([0, *sizes])
        tracks = [
            i for i, channel in enumerate(self.channels) if channel.quantity in ("position", "yaw")
        ]
        turn = np.zeros(ends[-1])
        for i in tracks:
            channel = self.channels[i]
            if channel.quantity == "yaw":
                turn[ends[i] : ends[i + 1]] = 1.0
                continue
            values = channel.values
            for axis in range(values.shape[1]):
                shift = np.zeros_like(values)
                shift[:, axis] = 1.0
                columns.append(np.pad(shift.ravel(), (ends[i], ends[-1] - ends[i + 1])))
            around = values[:, :2] - values[:, :2].mean(axis=0)
            turned = np.zeros_like(values)
            turned[:, 0], turned[:, 1] = -around[:, 1], around[:, 0]
            turn[ends[i] : ends[i + 1]] = turned.ravel()
        return [*columns, turn] if tracks else []


def _rollout(
    batch: Batch, controls: np.ndarray, recorded: Sequence[str], servos: ServosWithPlay | None
) -> dict[str, np.ndarray]:
    """Simulate under controls (n, steps, nu), and return the recorded quantities (n, steps, ...); NaN after a failure."""
    try:
        if servos is None:
            return batch.rollout(controls.shape[1], controls, record=recorded)
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        rows = [
            batch.rollout(1, servos.controls(target, qpos, qvel)[:, None], record=recorded)
            for target in controls.swapaxes(0, 1)
        ]
        return {name: np.concatenate([row[name] for row in rows], axis=1) for name in recorded}
    except SimulationError:
        blank = mujoco.MjData(batch.model)
        shape = controls.shape[:2]
        return {name: np.full((*shape, *getattr(blank, name).shape), np.nan) for name in recorded}
