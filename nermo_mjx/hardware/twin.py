"""The twin beside a robot's log: driven by the commands of the log at their times, and its signals as a log's."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.hardware.log import CHANNEL_PARTS, QUANTITIES, Channel, Log
from nermo_mjx.hardware.signals import (
    Difference,
    axes_of,
    channel_differences,
    in_frame_of,
    values_at,
)
from nermo_mjx.kinematics.body import attitude
from nermo_mjx.recording import LOG_PREFIX, Recording
from nermo_mjx.robot import LIMBS, Robot, RobotConfig, ServoAngles
from nermo_mjx.robot.quantity import choice
from nermo_mjx.rollout import Run, Setup, Simulator

#: How long the twin stands at the first commands before the log begins [s].
SETTLING_SECONDS: Final = 1.0
#: Load of a foot from which a switch under it is closed [N].
_SWITCH_NEWTONS: Final = 0.02


@dataclasses.dataclass(frozen=True, eq=False)
class LoggedCommands:
    """A controller that plays a table of servo angles, one row a tick, and stays at its last row.

    Attributes:
        table: (ticks, n_servos), in the order of the robot's servos [rad].
        servos: of the robot.
        dt: between rows [s].
    """

    table: Float[np.ndarray, "ticks servos"]
    servos: tuple[str, ...]
    dt: float

    @property
    def parameters(self) -> dict[str, Any]:
        """None."""
        return {}

    def _angles(self, tick: Any) -> ServoAngles:
        row, legs = jnp.asarray(self.table)[jnp.minimum(tick, len(self.table) - 1)], len(LIMBS)
        single = dict.fromkeys(("spine", "neck", "tail"), jnp.zeros(()))
        single |= dict(zip(self.servos[2 * legs :], row[2 * legs :], strict=True))
        return ServoAngles(hip=row[:legs], knee=row[legs : 2 * legs], **single)

    def init(self, params: Any, sensors: Any, phase: Any) -> Any:
        """The first row."""
        return jnp.zeros((), int)

    def initial_servo(self, params: Any, phase: Any) -> ServoAngles:
        """See `ControllerLike`."""
        return self._angles(0)

    def update(self, params: Any, state: Any, sensors: Any) -> tuple[Any, ServoAngles]:
        """See `ControllerLike`."""
        return state + 1, self._angles(state)

    def cycle_rate(self, params: Any) -> Any:
        """A second is a cycle."""
        return 1.0


def command_table(
    log: Log, servos: tuple[str, ...], dt: float
) -> Float[np.ndarray, "ticks servos"]:
    """A log's commands for each tick: of each servo the last one that was given by then, and before it the first one.

    Servos without a channel are at 0.

    Raises:
        ParameterError: there is no command, or one of no such servo.
    """
    commands = log.commands()
    table = np.zeros((math.ceil(log.duration / dt) + 1, len(servos)))
    ticks = dt * np.arange(len(table)) + 1e-9
    for servo, channel in commands.items():
        column = servos.index(
            choice(f"{log.file}: the servo of channel {channel.name!r}", servo, servos)
        )
        table[:, column] = channel.values[
            np.maximum(np.searchsorted(channel.times, ticks, "right") - 1, 0)
        ]
    return table


def replay_log(
    log: Log,
    setup: Setup | None = None,
    values: Mapping[str, Any] | None = None,
    engine: str = "c",
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """Drive the twin by a log's commands at their times, to the next step of its physics.

    It has stood at the first ones for `SETTLING_SECONDS` when the log begins.

    `identify.twin` simulates the same commands for any MJCF. Its numbers differ, therefore it is another implementation:
    a command is held here until the next one, as a servo does it, and `identify.twin` takes the mean of the commands in
    each step, so that its predictions are smooth in the delay. The simulation here has all choices of `Setup`, either
    engine, metrics and a recording of the IMU; `identify.twin` simulates batches of bodies in MuJoCo alone, and reads
    the places of the channels of a log. The commands, the time of standing and the comparison are shared.

    Args:
        log: see `read_log`.
        setup: Robot, scene and profile; the profile sets the values of the body. Choices of a controller have no effect.
        values: Values of the body's parameters, by name, which take precedence over those of the profile.
        engine, progress: see `Simulator`.

    Raises:
        ParameterError: see `command_table` and `Simulator.run`.
    """
    setup = setup or Setup()
    servos, dt = setup.load().servos, setup.timestep
    table, settling_ticks = command_table(log, servos, dt), round(SETTLING_SECONDS / dt)
    commands = LoggedCommands(
        np.concatenate([np.repeat(table[:1], settling_ticks, axis=0), table]), servos, dt
    )
    run = Run(duration=len(commands.table) * dt, warmup=settling_ticks * dt)
    # The robot as it is resolved, because another controller has no profile.
    robot_fields: dict[str, Any] = {
        field.name: getattr(setup, field.name) for field in dataclasses.fields(RobotConfig)
    }
    robot_fields |= {name: str(robot_fields[name]) for name in ("robot", "tail", "feet")}
    simulator = Simulator(Setup(**robot_fields, controller=commands, metrics=setup.metrics), engine)
    recording = simulator.run(
        setup.body | dict(values or {}), run, record=True, progress=progress
    ).recording()
    recording = recording.between((settling_ticks + 1) * dt, recording.time[-1])
    return dataclasses.replace(recording, time=recording.time - settling_ticks * dt)


def twin_signals(recording: Recording, robot: Robot) -> Log:
    """The signals of a recorded twin, named as in a log; yaw and position are those of the torso's IMU.

    A sample stands for the tick before it: its commands act since the tick's begin, and its sensors were read before
    the last step.
    """
    sensors = {name: np.asarray(values) for name, values in recording.sensors.items()}
    channels = list[Channel]()
    times = recording.time - robot.model.opt.timestep
    begin = recording.time - (np.median(np.diff(recording.time)) if len(times) > 1 else 0.0)

    def add(
        quantity: str, columns: Mapping[str, np.ndarray], sample_times: np.ndarray = times
    ) -> None:
        unit = next(iter(QUANTITIES[quantity]))
        channels.extend(
            Channel(f"{quantity} {element}", quantity, element, sample_times, values, unit)
            for element, values in columns.items()
        )

    def each(names: tuple[str, ...], values: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(names, values.T, strict=True))

    add("command", each(robot.servos, recording.ctrl), begin)
    for last in ("angle", "velocity", "torque"):
        add(last, each(robot.servos, sensors[f"servo_{last}"]))
    sensors["yaw"] = np.unwrap(np.asarray(attitude(jnp.asarray(sensors["orientation"])))[:, 2])
    for name, element in CHANNEL_PARTS.items():
        add(name, {element: sensors[name]})
    add("force", each(LIMBS, sensors["foot_force"]))
    add("contact", each(LIMBS, (sensors["foot_force"] > _SWITCH_NEWTONS).astype(float)))
    return Log(tuple(channels), "the twin")


def beside(log: Log, twin: Log) -> Log:
    """What a twin measures of a log's channels, as the log has it: in the frame of its track."""
    pairs = []
    for channel in log.channels:
        if channel.quantity == "command":
            continue
        twin_channel = twin.of_quantity(channel.quantity).get(channel.of)
        if twin_channel is not None:
            pairs.append(dataclasses.replace(in_frame_of(twin_channel, channel), name=channel.name))
    return Log(tuple(pairs), twin.file)


def with_log(recording: Recording, log: Log, robot: Robot) -> tuple[Recording, list[Difference]]:
    """A recording of the twin that shows a log's channels beside its own, and how far these are apart.

    Each axis of a channel is the sensor `log.NAME`, (T, 2): measured at the recording's times (NaN in gaps), simulated.
    """
    twin = beside(log, twin_signals(recording, robot))
    differences, sensors = channel_differences(log, twin), dict(recording.sensors)
    for channel in log.channels:
        if (twin_channel := twin.of_quantity(channel.quantity).get(channel.of)) is not None:
            for (name, axis_values), (_, two) in zip(
                axes_of(channel), axes_of(twin_channel), strict=False
            ):
                sensors[LOG_PREFIX + name] = np.stack(
                    [
                        values_at(axis_channel, recording.time)
                        for axis_channel in (axis_values, two)
                    ],
                    axis=-1,
                )
    descriptions = {difference.name: dataclasses.asdict(difference) for difference in differences}
    channel_names = [channel.name for channel in twin.channels]
    metadata = {
        **recording.metadata,
        "log": {"file": log.file, "shown": channel_names, "channels": descriptions},
    }
    return dataclasses.replace(recording, sensors=sensors, metadata=metadata), differences
