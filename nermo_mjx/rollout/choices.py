"""Checks of a setup's choices and of the names of its controller and metrics; each raises a `ParameterError`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import jax
import numpy as np

from nermo_mjx.control.fusion import SAGITTAL_MODES, mode_names
from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.control.protocol import ControllerLike
from nermo_mjx.robot import ParameterError, RobotConfig
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.robot.scene import is_mjcf
from nermo_mjx.robot.terrains import scenes_reading, terrain_values
from nermo_mjx.rollout.catalogue import METRICS
from nermo_mjx.rollout.own_metrics import OwnMetric
from nermo_mjx.rollout.parameters import WorldParameters

#: Columns of tables, which are reserved names for metrics.
TAKEN: Final = frozenset((
    "row", "variant", "repeat", "seed", "body", "status", "code", "batch", "cell", "time", "objective", "iteration",
    "start", "ok", "discarded", "simulated_seconds", "wall_seconds", "trajectory_error", "line", "centre", "width",
    "side", *RobotConfig.__dataclass_fields__, "gait", "spine", "steering", "pilot", "profile",
    "trajectory", "head", "tail_motion",
))  # fmt: skip


def check_spine(spine: str, robot: str) -> None:
    """Reject unknown modes, and those of joints that the robot does not have."""
    for mode in mode_names(spine):
        if mode in SAGITTAL_MODES and robot != "nermo_41":
            raise ParameterError(
                f"spine is {spine!r}: {mode} bends vertical spine joints, which robot {robot!r} does not have; it goes "
                "with robot 'nermo_41'."
            )


def check_kinds(metrics: Sequence[Any]) -> None:
    """Reject objects that are no custom metrics."""
    for each in metrics:
        if not isinstance(each, (str, OwnMetric)):
            raise ParameterError(f"metrics has {each!r}: expected a function under @metric, or its FILE.py:NAME.")


def check_timestep(timestep: float, period: float) -> None:
    """Reject time steps [s] that do not divide the controller's period [s]."""
    ratio = period / timestep
    if abs(ratio - round(ratio)) > 1e-9 * ratio or round(ratio) < 1:
        raise ParameterError(
            f"timestep is {timestep}: allowed is the control period {period:g} s divided by a whole number."
        )


def check_names(controller: ControllerLike, metrics: Sequence[OwnMetric]) -> None:
    """Reject parameters of a controller, and custom metrics, whose names are taken."""
    seen: dict[str, str] = {}
    for own in metrics:
        if own.name in METRICS or own.name in TAKEN:
            whose = "a metric that every run has" if own.name in METRICS else "a column that every table has"
            raise ParameterError(f"metrics has {own.place}, but {own.name} is {whose}: give it another name.")
        if own.name in seen:
            raise ParameterError(f"metrics has {own.place} and {seen[own.name]}: give one of them another name.")
        seen[own.name] = own.place
    shared = ControlParameters(geometry=Geometry())
    taken = {name for name, _ in quantities(WorldParameters)} - {name for name, _ in quantities(shared)}
    names = [name for name, _ in quantities(controller.parameters)]
    for name in names:
        if name in taken:
            raise ParameterError(f"controller has a parameter {name!r}, which is one of the robot or its start.")
    for own in metrics:
        if own.name in taken or own.name in names:
            raise ParameterError(f"metrics has {own.place}, but {own.name} is a parameter: give it another name.")


def check_terrain(scene: str, values: Mapping[str, Any]) -> None:
    """Reject a terrain shape that the scene does not read; its default is harmless."""
    for name in values.keys() - terrain_values(scene).keys():
        scenes, value = scenes_reading(name), values[name]
        if not scenes:
            continue
        default = dict(quantities(ModelParameters))[name].default
        if isinstance(value, jax.core.Tracer) or not np.allclose(value, default, rtol=1e-6):
            here = "a custom one" if is_mjcf(scene) else repr(scene)
            raise ParameterError(
                f"{name} has no effect: it is read only with scene {' or '.join(scenes)}, and the scene is {here}."
            )
