"""The robot that a recording was made with, and its body as the run's own parameters made it."""

from __future__ import annotations

import copy
import dataclasses
import operator

import mujoco

from nermo_mjx.recording import Recording
from nermo_mjx.robot import ModelParameters, Robot, RobotConfig, load_robot
from nermo_mjx.robot.quantity import quantities, replace_quantities


def robot_of(recording: Recording) -> Robot:
    """The robot in its scene, built from the recording's setup; what the setup does not name has its default.

    Raises:
        ParameterError: the setup names something that this version does not have.
        RecordingError: the robot's model has changed since.
    """
    setup = recording.metadata.get("setup") or {}
    names = [field.name for field in dataclasses.fields(RobotConfig)]
    robot = load_robot(**{name: setup[name] for name in names if name in setup})
    recording.check_model(robot.model)
    return robot


def recorded_model(recording: Recording, robot: Robot) -> mujoco.MjModel:
    """The robot's whole model with the masses, springs, dampers, servos and contacts of the run.

    Returns:
        `robot.model` itself if the recording's parameters change nothing about the body.
    """
    from nermo_mjx.physics.variation import Variation  # JAX takes a second to start

    known = {name: about.default for name, about in quantities(ModelParameters)}
    given = recording.metadata.get("parameters") or {}
    changed = {name: value for name, value in given.items() if name in known and value not in (None, known[name])}
    if not changed:
        return robot.model
    fields = Variation(robot).batch(replace_quantities(ModelParameters(), changed), 1, changed)
    model = copy.copy(robot.model)
    # Pairs, joints, bodies and actuators have the same ids in the whole model and in the one that engines step.
    for name, values in fields.items():
        operator.attrgetter(name)(model)[:] = values[0]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
