"""The robot that a recording was made with, and its body with the run's own parameters."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from nermo_mjx.recording import Recording
from nermo_mjx.robot import ModelParameters, Robot, RobotConfig, load_robot
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.quantity import quantities, replace_quantities, values_of
from nermo_mjx.robot.terrains import terrain_values


def robot_of(recording: Recording) -> Robot:
    """The robot in its scene, built from the recording's setup; unnamed choices have their defaults.

    Raises:
        ParameterError: the setup names something that this version does not have.
        RecordingError: the robot's model has changed since.
    """
    setup = recording.metadata.get("setup") or {}
    names = [field.name for field in dataclasses.fields(RobotConfig)]
    robot = load_robot(**{name: setup[name] for name in names if name in setup})
    recording.check_model(robot.model)
    return robot


def recorded_geometry(recording: Recording) -> Geometry:
    """The recorded robot's geometry; the published one if the recording has none."""
    given, known = recording.metadata.get("parameters") or {}, {name for name, _ in quantities(Geometry)}
    own = {name.removeprefix("geometry."): value for name, value in given.items() if value is not None}
    return replace_quantities(Geometry(), {name: np.asarray(own[name], float) for name in known & own.keys()})


def has_own_geometry(recording: Recording) -> bool:
    """Whether the recorded robot's geometry differs from the published one."""
    one, other = (dict(values_of(geometry)) for geometry in (recorded_geometry(recording), Geometry()))
    return any(float(one[name]) != float(other[name]) for name in one)


def shown_model(recording: Recording, robot: Robot) -> mujoco.MjModel:
    """The robot's whole model for rendering, with the geometry of the recorded robot."""
    return robot.with_geometry(recorded_geometry(recording)) if has_own_geometry(recording) else robot.model


def recorded_model(recording: Recording, robot: Robot) -> mujoco.MjModel:
    """The robot's whole model with the masses, springs, dampers, servos, contacts and geometry of the run.

    Returns:
        `robot.model` itself if the recording's parameters do not change the body.
    """
    from nermo_mjx.physics.variation import compile_model  # importing JAX takes a second

    known = {name: about.default for name, about in quantities(ModelParameters)}
    known |= terrain_values(str(robot.config.scene))
    given = recording.metadata.get("parameters") or {}
    changed = {name: value for name, value in given.items() if name in known and value not in (None, known[name])}
    return compile_model(robot, changed) if changed else robot.model
