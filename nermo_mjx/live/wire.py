"""One controller for the twin and the robot: the control loop over the topics of a real or simulated robot.

    controller ── q_values: servo angles ──► robot ── sensors_mouse: measurements ──► controller

Topics and messages are those of the author's ROS package (github.com/a-rohr/mouse_controller, commit 4dc4214):
`q_values` as in `nermo_mjx.hardware.live`, and `sensors_mouse` (msg/mouse_sensors.msg), filled as in
scripts/mouse_simulation.py. The author sends no sensors over MQTT; there it is the same message as JSON. His message
has no time: of one with ROS's `header` before its fields the order of stamps is checked, another one is taken as it is.
"""

from __future__ import annotations

import contextlib
import dataclasses
import heapq
import math
import queue
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import Float

from nermo_mjx.control.controller import canonical
from nermo_mjx.control.protocol import seeing
from nermo_mjx.files import replace_file
from nermo_mjx.hardware.channels import Channels
from nermo_mjx.hardware.live import (
    ANSWER_SECONDS,
    LARGEST_LATE_SHARE,
    PRINT_ADDRESS,
    ROS_TYPE,
    TOPIC,
    NotSentError,
    SendError,
    address,
    lateness,
    linked,
    servo_message,
)
from nermo_mjx.hardware.log import AXIS_COUNTS
from nermo_mjx.hardware.table import channels_of, sent_angles
from nermo_mjx.live.driving import AppendedFile, Driving
from nermo_mjx.physics.c_engine import CBodies, CEngine
from nermo_mjx.recording import Recording
from nermo_mjx.robot import LIMBS, ParameterError, Robot, Sensors
from nermo_mjx.robot.parameters import READINGS, reading_names
from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.rollout.metrics import DIVERGED_SPEED
from nermo_mjx.runs.job import interruptible
from nermo_mjx.specs.reading import dump
from nermo_mjx.trust import MESSAGE_HANDLER
from nermo_mjx.view.recorded import attitude_of

#: The author's topic and message of the sensors.
SENSORS_TOPIC: Final = "sensors_mouse"
SENSORS_TYPE: Final = "mouse_controller/mouse_sensors"
#: Servos among `servo_pos_leg`; the others are in `servo_pos_aux`.
_LEG_SERVOS: Final = 8
#: Parts of `imu_sensor` in the order of the message, and their lengths.
_IMU: Final = {"position": 3, "orientation": 4, "linear_velocity": 3, "accelerometer": 3, "gyro": 3}
#: Time without any message after which a robot is driven in an open loop [s].
SILENCE_SECONDS: Final = 2.0
#: Speed of the servos on their way to the initial pose of the gait [rad/s].
APPROACH_RAD_PER_SECOND: Final = 1.0
#: Largest difference between a command and this pose at the begin of the gait [rad].
_POSE_TOLERANCE_RAD: Final = 1e-6
#: Time without messages after which the robot holds its pose [s].
WATCHDOG_SECONDS: Final = 0.25
#: Time between two ticks after which the robot may have been moved [s]; in slow motion, ticks are 0.2 s apart.
_PAUSE_SECONDS: Final = 0.5
#: Largest number of a message that can be a measurement.
_LARGEST_MEASUREMENT: Final = 1e4


def needed_sensors(setup: Setup) -> set[str]:
    """The fields of `Sensors` that the compiled program of a setup's controller reads."""
    robot = setup.load()
    controller = seeing(setup.make_controller(), robot.terrain.height)
    rest = robot.sensors(robot.sensordata_at_rest(jnp.asarray(robot.model.qpos0)))

    def run(sensors: Sensors) -> Any:
        state = canonical(controller.init(controller.parameters, sensors, jnp.zeros(())))
        return controller.update(controller.parameters, state, sensors)

    program = jax.make_jaxpr(run)(rest).jaxpr
    _, used = dce_jaxpr(program, [True] * len(program.outvars))
    return {
        field.name for field, is_used in zip(dataclasses.fields(rest), used, strict=True) if is_used
    }


def _numbers(value: Any, *lengths: int) -> np.ndarray:
    """The list of numbers in a message; raises `ValueError` with the reason if it is invalid."""
    try:
        numbers = np.asarray([] if value is None else value, float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("garbage") from None
    if isinstance(value, list) and any(isinstance(element, bool | str) for element in value):
        raise ValueError("garbage")
    if numbers.ndim != 1 or len(numbers) not in lengths:
        raise ValueError("of a wrong size")
    if not (np.abs(numbers) < _LARGEST_MEASUREMENT).all():  # true for NaN, too
        raise ValueError("not finite")
    return numbers


class Measurements:
    """The measurements of a robot, message by message.

    Attributes:
        sensordata: Sensor data of the last message (n_sensordata,); missing values are those of the robot at rest.
        reported_fields: Fields of `Sensors` in the last message; empty before the first message.
        arrival_time: Time of the last message [s].
        steady_since: Time since when messages have arrived without a break [s].
        counts: Numbers of messages that were `taken`, or ignored, by reason.
        needed: Fields that a message must contain.
    """

    def __init__(
        self,
        robot: Robot,
        channels: Channels,
        watchdog: float = WATCHDOG_SECONDS,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.robot, self.channels, self.watchdog, self.clock = robot, channels, watchdog, clock
        at_rest = robot.sensordata_at_rest(jnp.asarray(robot.model.qpos0))
        self.sensordata, self.reported_fields = np.array(at_rest, float), frozenset[str]()
        self.counts = {"taken": 0}
        self.arrival_time = -math.inf
        self.steady_since = -math.inf
        self._stamp = -math.inf
        self._places, self.needed = robot.sensors(np.arange(len(self.sensordata))), set[str]()
        self.log: LinkLog | None = None

    def receive(self, message: Any) -> None:
        """Use or ignore a message; the connection's thread calls this method."""
        now = self.clock()
        try:
            readings, stamp = self._read(message)
            # The clock of a robot may differ after a break.
            if (
                stamp is not None
                and stamp <= self._stamp
                and now - self.arrival_time <= self.watchdog
            ):
                raise ValueError("out of order")
        except ValueError as error:
            self.counts[str(error)] = self.counts.get(str(error), 0) + 1
            return
        data = self.sensordata.copy()
        for name, values in readings.items():
            data[getattr(self._places, name)] = values
        self.steady_since = now if now - self.arrival_time > self.watchdog else self.steady_since
        self.counts["taken"] += 1
        self._stamp = -math.inf if stamp is None else stamp
        self.sensordata, self.reported_fields, self.arrival_time = data, frozenset(readings), now
        if self.log is not None:
            self.log.measured(now, stamp, readings)

    def _read(self, message: Any) -> tuple[dict[str, np.ndarray], float | None]:
        """Readings by field of `Sensors`, and the message's time [s]."""
        if not isinstance(message, dict):
            raise ValueError("garbage")
        remaining = max(0, len(self.channels.servos) - _LEG_SERVOS)
        legs, aux = (
            _numbers(message.get(f"servo_pos_{part}"), 0, size)
            for part, size in (("leg", len(self.channels.servos) - remaining), ("aux", remaining))
        )
        contact = _numbers(message.get("contact_sensors"), 0, 4)
        imu = _numbers(message.get("imu_sensor"), 0, 16)
        if (contact < 0.0).any():
            raise ValueError("out of range")
        readings: dict[str, np.ndarray] = {"foot_force": contact} if len(contact) else {}
        if len(imu):
            readings |= dict(
                zip(_IMU, np.split(imu, np.cumsum([*_IMU.values()])[:-1]), strict=True)
            )
            length = np.linalg.norm(readings["orientation"])
            if not 0.5 < length < 2.0 or np.abs(readings["linear_velocity"]).max() > DIVERGED_SPEED:
                raise ValueError("not finite")
            readings["orientation"] = readings["orientation"] / length
        if len(legs) + len(aux) == len(self.channels.servos):
            degrees = np.degrees([*legs, *aux])
            readings["servo_angle"] = robot_angles(self.channels, self.robot, degrees, self.pose)
        if not readings or self.needed - readings.keys():
            raise ValueError("of a wrong size" if readings else "garbage")
        return readings, _stamp(message.get("header"))

    @property
    def pose(self) -> Float[np.ndarray, " n_servos"]:
        """The servos' angles [rad]."""
        return self.sensordata[self._places.servo_angle]

    @property
    def silence(self) -> float:
        """Time since the last message that was used [s]."""
        return self.clock() - self.arrival_time


def _stamp(header: Any) -> float | None:
    """Time of a `std_msgs/Header` of ROS 2 or ROS 1 [s]; None if there is no header."""
    if header is None:
        return None
    try:
        stamp = {name.removesuffix("s"): value for name, value in header["stamp"].items()}
        return int(stamp["sec"]) + 1e-9 * int(stamp["nanosec" if "nanosec" in stamp else "nsec"])
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
        raise ValueError("garbage") from None


@dataclasses.dataclass
class DriveReport:
    """The report of a robot's drive.

    Attributes:
        messages: Numbers of the robot's messages, see `Measurements.counts`.
        walking_seconds, holding_seconds: Duration of the walk, and of the holds because messages were missing [s].
        holds: Number of holds.
        sent, unsent: Numbers of commands that the broker accepted, and did not accept.
        limited: Number of commands with an angle that was clipped to its servo's limits.
        skipped: Number of ticks that this machine skipped because it was late.
        ended: Reason of an early end; empty if there was none.
    """

    messages: dict[str, int]
    walking_seconds: float = 0.0
    holding_seconds: float = 0.0
    holds: int = 0
    sent: int = 0
    unsent: int = 0
    limited: int = 0
    skipped: int = 0
    ended: str = ""

    def sentences(self) -> list[str]:
        """Sentences that describe the drive."""
        commands = f"It walked for {self.walking_seconds:.1f} s, and {self.sent} commands were sent"
        limited = f", {self.limited} of them within the limits of a channel" if self.limited else ""
        hold_note = f"; {self.holds} times it stood still, as no message came" if self.holds else ""
        heard = f"{self.messages['taken']} messages of the robot were taken{_ignored_messages(self.messages)}."
        return [
            f"{commands}{limited}{hold_note}.",
            *([heard] if any(self.messages.values()) else []),
        ]

    def failures(self, factor: float = 1.0, answers: bool = True) -> list[str]:
        """What was wrong with it: of a robot that `answers`, driven at `factor` seconds per second."""
        everything = self.sent + self.unsent + self.skipped
        unsent = (
            f"{self.unsent} commands were not taken."
            if self.unsent > LARGEST_LATE_SHARE * everything
            else ""
        )
        lateness_note = lateness(self.skipped + max(0.0, 1.0 - factor) * everything, everything)
        ended = f"{self.ended[:1].upper()}{self.ended[1:].rstrip('.')}." if self.ended else ""
        never = f"The robot never answered on {SENSORS_TOPIC}: it was driven in an open loop."
        return [
            reason
            for reason in (
                ended,
                "" if self.messages["taken"] or not answers else never,
                lateness_note,
                unsent,
            )
            if reason
        ]


class LinkLog(AppendedFile):
    """The log of a driven robot: FILE.csv has a row for each command and each message, when it was sent or came.

    FILE.yaml says what its columns are, see `hardware.log`. Messages with stamps have their own clock, which is set by
    the one that came soonest.
    """

    def __init__(
        self, path: Path, channels: Channels, robot: Robot, clock: Callable[[], float]
    ) -> None:
        """See `AppendedFile`."""
        super().__init__(path)
        self.about, self._begun, self._offset = path.with_suffix(".yaml"), clock(), math.inf
        self._robot = robot
        self._servos = {c.servo: i for i, c in enumerate(channels) if c.servo in robot.servos}
        axes = {name: list(reading_names(name)) for name in AXIS_COUNTS}
        channel_specs: dict[str, dict[str, Any]] = {}
        for mapped_channel in (channel for channel in channels if channel.servo in robot.servos):
            spec = {"unit": "deg", "sign": mapped_channel.direction, "zero": mapped_channel.zero}
            channel_specs[f"{mapped_channel.servo}_servo_command"] = {
                "quantity": "command",
                "of": mapped_channel.servo,
                **spec,
            }
            channel_specs[f"{mapped_channel.servo}_servo_angle"] = {
                "quantity": "angle",
                "of": mapped_channel.servo,
                "unit": READINGS["servo_angle"].unit,
            }
        feet = zip(reading_names("foot_force"), LIMBS, strict=True)
        channel_specs |= {
            name: {"quantity": "force", "of": limb, "unit": READINGS["foot_force"].unit}
            for name, limb in feet
        }
        channel_specs |= {
            name: {"quantity": name, "columns": axes[name], "unit": READINGS[name].unit}
            for name in AXIS_COUNTS
        }
        yaw = {"quantity": "yaw", "unit": READINGS["attitude"].unit}
        self._signals = channel_specs | {"yaw": yaw}
        self._names = [name for key in self._signals for name in axes.get(key, [key])] + ["stamp"]
        self._counts, self._new, self._written = Counter[str](), deque[str](), b""
        self._left = (",".join(["t", *self._names]) + "\n").encode()
        self._thread.start()

    def command(self, now: float, degrees: Float[np.ndarray, " channels"]) -> None:
        """What was sent at a time [s], of all channels [deg]."""
        self._add(now, {f"{servo}_servo_command": degrees[i] for servo, i in self._servos.items()})

    def measured(self, now: float, stamp: float | None, readings: Mapping[str, np.ndarray]) -> None:
        """A message that came at a time [s], by field of `Sensors`, and its own time."""
        row = {} if stamp is None else {"stamp": stamp}
        self._offset = min(self._offset, now - self._begun - row.get("stamp", -math.inf))
        for name in ("servo_angle", "foot_force", *AXIS_COUNTS):
            row |= dict(
                zip(reading_names(name, self._robot.servos), readings.get(name, ()), strict=False)
            )
        if "orientation" in readings:
            row["yaw"] = math.radians(attitude_of(readings["orientation"][None])[0, 2])
        self._add(now, row)

    def _add(self, now: float, row: Mapping[str, float]) -> None:
        cells = (f"{row[name]:.12g}" if name in row else "" for name in self._names)
        self._counts.update(row.keys())
        self._new.append(",".join([f"{now - self._begun:.6f}", *cells]) + "\n")

    def _new_content(self) -> bytes:
        # A channel has two samples at least.
        channel_fields = {
            name: e
            for name, e in self._signals.items()
            if self._counts[e.get("columns", [name])[0]] > 1
        }
        if math.isfinite(self._offset):
            time_column = {"column": "stamp", "offset": round(self._offset, 6)}
            channel_fields = {
                name: e if e["quantity"] == "command" else e | {"time": time_column}
                for name, e in channel_fields.items()
            }
        content = dump({"time": {"column": "t", "unit": "s"}, "channels": channel_fields}).encode()
        if content != self._written:
            with contextlib.suppress(OSError):  # the log's own error tells of a full disk
                replace_file(self.about, content)
                self._written = content
        return "".join(self._new.popleft() for _ in range(len(self._new))).encode()


def wait_for_message(
    measured: Measurements, needed: set[str], wait: Callable[[float], None] = time.sleep
) -> None:
    """Wait for the robot's first message.

    Args:
        measured: of the robot.
        needed: fields that the controller reads. If it reads none, a robot that says nothing is driven, too.

    Raises:
        SendError: there is none.
        ParameterError: it does not tell all that is needed.
    """
    end = measured.clock() + (ANSWER_SECONDS if needed else SILENCE_SECONDS)
    while not measured.reported_fields and measured.clock() < end:
        wait(0.01)
    what = f"the controller reads {', '.join(sorted(needed - measured.reported_fields))}"
    if needed and not measured.reported_fields:
        why = "".join(
            f"; {number} messages were {what}" for what, number in measured.counts.items() if number
        )
        raise SendError(
            f"no message of the robot for {ANSWER_SECONDS:g} s, and {what}: a robot without sensors walks with "
            f"the pilot open_loop{why}."
        )
    if needed - measured.reported_fields:
        raise ParameterError(
            f"robot does not tell all that is needed: {what}; its messages tell {', '.join(sorted(measured.reported_fields))}."
        )
    measured.needed = needed


class RobotDriving(Driving):
    """The drive of a robot over its topics; under a page a simulated body gets the same commands, and is shown.

    The servos go from the robot's pose to that in which the gait starts, and then the controller runs. Without messages
    for `measured.watchdog` it stands still, and nothing is sent: servos hold their last angle. When messages have come
    for as long, so that none is old, the servos go from where they are to these angles, and the walk goes on, as after
    a pause. After `ANSWER_SECONDS` the drive ends. A robot that has never said a thing is driven without this watch, and from
    the pose of the gait's start.

    Attributes:
        needed: fields of `Sensors` that the controller reads.
        measured: of the robot, from when it is there.
        driven: how it goes.
        pose: the last command, before limits of channels [rad].
        operator: how long the page has been away [s].
    """

    repeatable, failed = False, ""

    def __init__(
        self,
        setup: Setup,
        values: Mapping[str, float] | None = None,
        url: str = "ros://localhost",
        channels: Any = "published",
        rate: float | None = None,
        watchdog: float = WATCHDOG_SECONDS,
        *,
        record: bool = True,
        log: Path | None = None,
    ) -> None:
        """
        Args:
            setup, values, record: see `Driving`.
            log: file of commands and measurements, see `LinkLog`.
            url: of the robot, see `linked`.
            channels: of its servos, see `servo_table`.
            rate: of commands [Hz], at most one per tick; by default that of the channels, or one each.
            watchdog: see above [s].

        Raises:
            ParameterError: the URL, a channel or the rate is invalid; before anything is compiled.
        """
        address(url, "connect")
        connected, control_rate = (
            channels_of(channels, setup.load()),
            1.0 / setup.make_controller().dt,
        )
        rate = rate or connected.rate
        if rate is not None and rate > control_rate + 1e-6:
            raise ParameterError(
                f"rate is {rate:g} Hz: allowed is (0, {control_rate:g}], the controller's."
            )
        self.needed, self.operator = needed_sensors(setup), lambda: 0.0
        self._url, self._channels, self._watchdog, self._log = url, connected, watchdog, log
        self._period = 0.0 if rate is None else 1.0 / rate
        self.measured: Measurements | None = None
        super().__init__(setup, values, record=record)

    @contextlib.contextmanager
    def reach(self) -> Iterator[None]:
        """The robot, which is there; for errors see `linked` and `wait_for_message`. A sentence tells what is waited for."""
        measured, tell = (
            Measurements(self.simulator.robot, self._channels, self._watchdog),
            MESSAGE_HANDLER.get(),
        )
        with linked(
            self._url, TOPIC, ROS_TYPE, SENSORS_TOPIC, measured.receive, "connect"
        ) as publish:
            if self._url != PRINT_ADDRESS:
                tell(f"connected: waiting for the robot's messages on {SENSORS_TOPIC}.")
                wait_for_message(measured, self.needed)
                heard = f"the robot tells {', '.join(sorted(measured.reported_fields))}."
                tell(
                    heard
                    if measured.reported_fields
                    else f"no message on {SENSORS_TOPIC} in {SILENCE_SECONDS:g} s: open loop."
                )
            self.connect(measured, publish)
            if self._log is not None:
                measured.log = LinkLog(
                    self._log, self._channels, self.simulator.robot, measured.clock
                )
            try:
                yield
            finally:
                if (log := measured.log) is not None:
                    log.end()
                    self.failed = (
                        f"{log.path}: the log cannot be written ({log.error.strerror})."
                        if log.error
                        else ""
                    )

    def failures(self, factor: float = 1.0) -> list[str]:
        """What was wrong with the drive, see `Driven`; without a robot none answers."""
        messages = self.driven.failures(factor, answers=self._url != PRINT_ADDRESS)
        return [*messages, self.failed] if self.failed else messages

    def connect(self, measured: Measurements, publish: Callable[[Any], None]) -> None:
        """Drive the robot that has been measured from now on; `publish` sends it a message."""
        self.measured = measured
        self.driven = DriveReport(messages=measured.counts)
        self._publish = publish
        self._low, self._high = (
            np.array([getattr(channel, end) for channel in measured.channels])
            for end in ("low", "high")
        )
        self._slots, self._send_due, self._reached = 0, 0.0, measured.clock()
        self._approach(measured)
        self.pose = self._start

    def reset(self) -> None:
        """See `Driving`; the robot goes slowly to the start of the gait, from wherever it is."""
        super().reset()
        if self.measured is not None:
            self._approach(self.measured)

    def _approach(self, measured: Measurements) -> None:
        self._start = self.restart(measured.sensordata)
        self._away, self._there, self._quiet = True, False, measured.clock()
        self._stepped = self._quiet

    def watch(self) -> None:
        """See `Driving`; the robot may be elsewhere when time goes on.

        Raises:
            SendError: nothing was heard for `ANSWER_SECONDS`.
        """
        if self.measured is not None:
            self._check_presence(self.operator())
            self._away = True
            self._check()

    def _check(self) -> None:
        if self.driven.ended:
            raise SendError(self.driven.ended)

    def _check_presence(self, operator: float) -> None:
        """Whether robot and operator are there."""
        measured, driven = self.measured, self.driven
        assert measured is not None
        silence = max(measured.silence if measured.reported_fields else 0.0, operator)
        if silence > ANSWER_SECONDS:
            driven.ended = f"no message {'of the robot ' if operator < silence else ''}for {ANSWER_SECONDS:g} s"
        elif silence > measured.watchdog:
            driven.holds += driven.walking_seconds > 0.0 and not self._away
            self._away, self._quiet = True, measured.clock()

    def step(self, operator: float = 0.0) -> None:
        """One tick of the controller, or of the approach, or of standing still; `driven.ended` says if it was the last.

        Args:
            operator: how long the operator has been away [s].
        """
        measured, driven, dt = self.measured, self.driven, self.dt
        assert measured is not None
        self._check_presence(operator)
        if driven.ended:
            return
        now, before = measured.clock(), self._stepped
        self._stepped, self._away = now, self._away or now - before > _PAUSE_SECONDS
        if (
            self._away
            and measured.reported_fields
            and now - max(self._quiet, measured.steady_since) < measured.watchdog
        ):
            driven.holding_seconds += dt
            return
        if self._away:
            self.pose = measured.pose if "servo_angle" in measured.reported_fields else self.pose
            self._away = self._there = False
        elif self._there:
            self.pose = self._start = self.targets(
                np.tile(measured.sensordata, (self.steps_per_tick, 1))
            )
            driven.walking_seconds += dt
        else:
            self.pose = self.pose + np.clip(
                self._start - self.pose, -APPROACH_RAD_PER_SECOND * dt, APPROACH_RAD_PER_SECOND * dt
            )
            self._there = bool(np.abs(self._start - self.pose).max() < _POSE_TOLERANCE_RAD)
            if self._there and not self.ticks and not self.commands:
                self.restart(measured.sensordata)  # the walk begins where the robot stands now
        self._slots += 1
        if self._slots * dt >= self._send_due - 1e-9:
            self._send_due = max(self._send_due + self._period, self._slots * dt)
            self._send(measured)

    def _send(self, measured: Measurements) -> None:
        channels, driven = measured.channels, self.driven
        if not np.isfinite(self.pose).all():
            driven.ended = "the controller asks for an angle that is not a number"
            return
        servo_angles = sent_angles(channels, measured.robot.servos, np.degrees(self.pose)[None])[0]
        degrees = np.clip(servo_angles, self._low, self._high)
        driven.limited += bool(np.abs(degrees - servo_angles).max() > 1e-6)
        try:
            self._publish(servo_message(self._url, degrees, channels.given(degrees)))
            driven.sent, self._reached = driven.sent + 1, measured.clock()
            if measured.log is not None:
                measured.log.command(self._reached, channels.given(degrees))
        except SendError as error:
            driven.unsent += 1
            if (
                not isinstance(error, NotSentError)
                or measured.clock() - self._reached > ANSWER_SECONDS
            ):
                driven.ended = str(error)

    def run(
        self, seconds: float | None = None, wait: Callable[[float], None] = time.sleep
    ) -> DriveReport:
        """Drive in real time, without a page.

        Args:
            seconds: duration of the walk, without approach and holds; None until a `KeyboardInterrupt`.
            wait: function for waiting [s].
        """
        measured, driven, dt = self.measured, self.driven, self.dt
        assert measured is not None
        due = measured.clock()
        with contextlib.suppress(KeyboardInterrupt):
            while not driven.ended and (seconds is None or driven.walking_seconds < seconds - 1e-9):
                early = due - measured.clock()
                if early > 1e-6:
                    wait(early)
                    continue
                if (
                    -early > measured.watchdog
                ):  # this machine was away: the gait goes on late, instead of hurrying
                    driven.skipped, due = driven.skipped + int(-early / dt), due - early
                self.step()
                due += dt
        return driven

    def _next_targets(self) -> Float[np.ndarray, " n_servos"]:
        self.step(self.operator())
        self._check()
        return self.pose

    def recording(self) -> Recording:
        """The commands, what the robot measured, and how the simulated body moved; no `replay` makes it again."""
        recording = super().recording()
        return dataclasses.replace(recording, metadata={**recording.metadata, "driven": None})

    def _sample(self) -> tuple[np.ndarray, ...]:
        simulated = super()._sample()
        return simulated if self.measured is None else (*simulated[:3], self.measured.sensordata)


class LossyLink:
    """Messages on their way: some get lost, and each takes between half and one and a half times `delay` [s], so that
    some overtake others."""

    def __init__(self, delay: float, loss: float, random: np.random.Generator) -> None:
        self._delay, self._loss, self._random = delay, loss, random
        self._under_way: list[tuple[float, int, Any]] = []
        self.messages = self.lost = 0

    def put(self, now: float, message: Any) -> None:
        """A message sets out."""
        due = now + self._delay * self._random.uniform(0.5, 1.5)
        lost = self._random.random() < self._loss
        self.messages, self.lost = self.messages + 1, self.lost + lost
        if not lost:
            heapq.heappush(self._under_way, (due, self.messages, message))

    def arrivals(self, now: float) -> Iterator[Any]:
        """Those that have arrived, in the order of arrival."""
        while self.next <= now:
            yield heapq.heappop(self._under_way)[2]

    @property
    def next(self) -> float:
        """When the next one arrives [s]."""
        return self._under_way[0][0] if self._under_way else math.inf


class SimulatedRobot:
    """A simulated robot on the topics of a real one, in real time on the engine c.

    It stands as the setup starts until it is given commands, and goes where the last one said, as servos do: at their
    speed, and still there when no more come. It says what it measures at the end of each tick.
    """

    def __init__(
        self,
        setup: Setup,
        values: Mapping[str, float],
        channels: Any,
        delay: float = 0.0,
        loss: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            setup, values: of the body; the gait decides the pose at the start.
            channels: of the servos, see `servo_table`.
            delay, loss: mean time that a message takes [s], and share that gets lost, each way; see `Way`.
            clock: function for the time [s].
        """
        simulator = Simulator(setup, "c")
        batch, self.robot = simulator.prepare(values, Run(duration=1.0)), simulator.robot
        self._channels = channels_of(channels, self.robot)
        assert isinstance(simulator.engine, CEngine)
        self._body = CBodies(simulator.engine, batch.qpos, batch.fields, 1)
        self.dt = float(simulator.controller.dt)
        self._reach = float(batch.params.servo.top_speed[0]) * self.dt
        self._readings = np.repeat(
            self._body.sensordata[:, None], simulator.loop.steps_per_tick, axis=1
        )
        start = self.robot.sensors(self._readings[0, -1].copy())
        self._ctrl = self._target = np.asarray(start.servo_angle)
        self._start, self._clock, self._heard, self._ticks = start.position, clock, math.nan, 0
        self._counts, self._received = Counter[str](), queue.SimpleQueue[tuple[float, Any]]()
        self._inward, self.outward = (
            LossyLink(delay, loss, np.random.default_rng(seed)) for seed in (0, 1)
        )

    def receive(self, message: Any) -> None:
        """Take a command; called in the connection's thread."""
        self._received.put((self._clock(), message))

    def tick(self, now: float) -> None:
        """A tick that begins at a time [s], with the commands that have arrived by then."""
        while not self._received.empty():
            self._inward.put(*self._received.get())
        for message in self._inward.arrivals(now):
            try:
                self._target = _commanded_angles(message, self._channels, self.robot, self._target)
                self._heard = now
                self._counts["taken"] += 1
            except ValueError as error:
                self._counts[str(error)] += 1
        self._ctrl = self._ctrl + np.clip(self._target - self._ctrl, -self._reach, self._reach)
        self._body.ctrl[0] = self._ctrl
        self._body.move(self._readings)
        self._ticks += 1
        sensor_text = sensor_message(
            self.robot, self._channels, self._readings[0, -1], self._ticks * self.dt
        )
        self.outward.put(now + self.dt, sensor_text)

    def run(self, url: str, seconds: float | None = None) -> dict[str, Any]:
        """Be there for a time [s], or until Ctrl-C or SIGTERM; returns `about`. For the URL see `linked`."""
        with (
            interruptible(),
            linked(url, SENSORS_TOPIC, SENSORS_TYPE, TOPIC, self.receive, "serve") as publish,
            contextlib.suppress(KeyboardInterrupt),
        ):
            begun = self._clock()
            while seconds is None or self._ticks * self.dt < seconds - 1e-9:
                now, due = self._clock(), begun + self._ticks * self.dt
                for message in self.outward.arrivals(now):
                    with contextlib.suppress(NotSentError):
                        publish(message)
                if now < due:
                    time.sleep(max(0.0, min(due, self.outward.next) - self._clock()))
                else:
                    self.tick(due)
        return self.about

    @property
    def about(self) -> dict[str, Any]:
        """`seconds`, `distance`: for how long it was there, and how far its IMU got [s, m]; `commands` by what became
        of them; `silence` since the last one [s], None if there was none; `tilt` of the torso now [rad]."""
        now = self.robot.sensors(self._readings[0, -1])
        _, x, y, _ = now.orientation
        return {
            "seconds": self._ticks * self.dt,
            "distance": float(np.linalg.norm((now.position - self._start)[:2])),
            "commands": {**self._counts, "lost": self._inward.lost},
            "silence": None if math.isnan(self._heard) else self._clock() - self._heard,
            "tilt": float(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))),
        }

    def sentences(self) -> list[str]:
        """What happened."""
        description = self.about
        last = (
            ""
            if description["silence"] is None
            else f", the last one {description['silence']:.1f} s before the end"
        )
        far = f"got {1e3 * description['distance']:.0f} mm far; its tilt is {math.degrees(description['tilt']):.0f} degrees"
        return [
            f"The simulated robot was there for {description['seconds']:.1f} s, and {far}.",
            f"{description['commands'].get('taken', 0)} commands were taken{last}{_ignored_messages(description['commands'])}.",
        ]


def _ignored_messages(counts: Mapping[str, int]) -> str:
    """What became of messages that were not taken, as the end of a sentence."""
    listing = ", ".join(
        f"{count} {reason}" for reason, count in counts.items() if count and reason != "taken"
    )
    return listing and f"; left out: {listing}"


def _commanded_angles(
    message: Any, channels: Channels, robot: Robot, previous: np.ndarray
) -> np.ndarray:
    """The servos' angles of a message [rad]; servos that it does not name stay where they are."""
    value, in_radians = (
        (message.get("data"), True) if isinstance(message, dict) else (message, False)
    )
    if not isinstance(value, list):
        raise ValueError("garbage")
    angles = _numbers(value, len(channels.servos))
    degrees = np.degrees(angles) if in_radians else angles
    return np.clip(
        robot_angles(channels, robot, degrees, previous), *robot.model.actuator_ctrlrange.T
    )


def robot_angles(
    channels: Channels, robot: Robot, degrees: np.ndarray, before: np.ndarray
) -> np.ndarray:
    """The robot's servo angles [rad] of what its channels say [deg], the inverse of `sent_angles`."""
    angles = before.copy()
    for channel, angle in zip(channels, degrees, strict=True):
        if channel.servo in robot.servos:
            angles[robot.servos.index(channel.servo)] = np.radians(
                channel.direction * (angle - channel.zero)
            )
    return angles


def sensor_message(
    robot: Robot, channels: Channels, sensordata: np.ndarray, stamp: float
) -> dict[str, Any]:
    """What a robot says that it measures at a time [s]: its servos' angles, contacts and IMU."""
    sensors = robot.sensors(sensordata)
    angles = np.radians(
        sent_angles(channels, robot.servos, np.degrees(sensors.servo_angle)[None])[0]
    )
    imu = np.concatenate([getattr(sensors, name) for name in _IMU])
    parts = {
        "servo_pos_leg": angles[:_LEG_SERVOS],
        "servo_pos_aux": angles[_LEG_SERVOS:],
        "contact_sensors": sensors.foot_force,
        "imu_sensor": imu,
    }
    stamp_fields = {"sec": int(stamp), "nanosec": int(1e9 * (stamp % 1.0))}
    fields = {name: values.round(7).tolist() for name, values in parts.items()}
    return {"header": {"stamp": stamp_fields, "frame_id": "imu"}, **fields}
