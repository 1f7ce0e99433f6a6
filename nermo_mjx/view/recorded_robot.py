"""The robot that a recording was made with, from the recording's own setup."""

from __future__ import annotations

import dataclasses

from nermo_mjx.robot import Robot, RobotConfig, load_robot
from nermo_mjx.view.recording import Recording


def robot_of(recording: Recording) -> Robot:
    """Assemble the robot and scene of a recording; what its setup does not say has its default.

    Raises:
        RecordingError: this version's robot is another one.
        ParameterError: this version has no such robot or scene.
    """
    setup = recording.metadata.get("setup", {})
    robot = load_robot(**{field.name: setup[field.name] for field in dataclasses.fields(RobotConfig)
                          if field.name in setup})  # fmt: skip
    recording.check_model(robot.model)
    return robot
