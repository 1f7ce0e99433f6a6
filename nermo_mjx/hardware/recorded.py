"""The servo angles commanded in a recorded walk as a table over time, for controllers that answer to sensors."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from nermo_mjx.hardware.channels import Channels
from nermo_mjx.hardware.table import DEFAULT_RATE, ServoTable, channels_of, check_limits, check_rate, sent_angles
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ModelParameters, ParameterError, Robot
from nermo_mjx.robot.quantity import quantities, replace_quantities


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
        ParameterError: an invalid argument, a recording of less than two rows, or an angle beyond a servo's limit.
    """
    if recording.ctrl.shape[1] != len(robot.servos):
        raise ParameterError(f"recording has {recording.ctrl.shape[1]} servos, and the robot has {len(robot.servos)}.")
    connected = channels_of(channels, robot)
    rate = next(each for each in (rate, connected.rate, DEFAULT_RATE) if each is not None)
    check_rate(rate)
    rows = math.floor(recording.duration * rate + 1e-6) + 1
    if rows < 2:
        raise ParameterError(f"rate is {rate:g} Hz: a recording of {recording.duration:g} s has one row then.")
    time = np.arange(rows) / rate
    commanded = [np.interp(recording.time[0] + time, recording.time, column) for column in recording.ctrl.T]
    angles = sent_angles(connected, robot.servos, np.degrees(np.stack(commanded, axis=-1)))
    check_limits(connected, angles, time)
    fastest = np.abs(np.diff(angles, axis=0)).max(axis=0) * rate
    known = dict(quantities(ModelParameters))
    given = {name: float(value) for name, value in (recording.metadata.get("parameters") or {}).items()
             if name.startswith("servo.") and name in known}  # fmt: skip
    possible = math.degrees(float(replace_quantities(ModelParameters(), given).servo.top_speed))
    names = tuple(channel.servo for channel in connected)
    return ServoTable(names, time, angles, rate, None, None, connected, fastest, possible)
