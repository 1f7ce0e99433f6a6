"""Batched digital twin of Nermo, the tendon-driven robotic mouse with a compliant spine, on MuJoCo and MJX.

The public names are in `__all__`. They are imported on first use, and importing changes nothing in the process: see
`nermo_mjx.runtime`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from nermo_mjx.trust import DATA_CONTROLLERS
from nermo_mjx.version import __version__

if TYPE_CHECKING:
    from nermo_mjx import kinematics
    from nermo_mjx.control import Controller, ControllerLike, control_parameters, leg_servos, published_controller
    from nermo_mjx.experiments.run import run_experiment, run_experiments
    from nermo_mjx.hardware import ServoTable, servo_table
    from nermo_mjx.optimize import (
        Search,
        SearchResult,
        Tuning,
        TuningResult,
        read_history,
        run_search,
        run_tuning,
    )
    from nermo_mjx.physics import make_engine
    from nermo_mjx.robot import LIMBS, SERVOS, ParameterError, Robot, RobotConfig, Sensors, ServoAngles, load_robot
    from nermo_mjx.robot.quantity import parameter_tree, quantity
    from nermo_mjx.rollout import METRICS, Run, RunResult, Setup, Simulator, all_metrics, all_parameters, metric
    from nermo_mjx.rollout.differentiable import Rollout
    from nermo_mjx.runtime import compiler_options
    from nermo_mjx.sweep import Sweep, SweepResult, merge_sweeps, read_table, run_sweep
    from nermo_mjx.sweep.comparing import Comparison, compare
    from nermo_mjx.sweep.sensitivity import Sensitivity, sensitivity
    from nermo_mjx.view import Page, Recording, render, show

_HOMES = {
    "nermo_mjx.control": "Controller ControllerLike control_parameters leg_servos published_controller",
    "nermo_mjx.experiments.run": "run_experiment run_experiments",
    "nermo_mjx.hardware": "ServoTable servo_table",
    "nermo_mjx.optimize": "Search SearchResult Tuning TuningResult read_history run_search run_tuning",
    "nermo_mjx.physics": "make_engine",
    "nermo_mjx.robot": "LIMBS SERVOS ParameterError Robot RobotConfig Sensors ServoAngles load_robot",
    "nermo_mjx.robot.quantity": "parameter_tree quantity",
    "nermo_mjx.rollout": "METRICS Run RunResult Setup Simulator all_metrics all_parameters metric",
    "nermo_mjx.rollout.differentiable": "Rollout",
    "nermo_mjx.runtime": "compiler_options",
    "nermo_mjx.sweep": "Sweep SweepResult merge_sweeps read_table run_sweep",
    "nermo_mjx.sweep.comparing": "Comparison compare",
    "nermo_mjx.sweep.sensitivity": "Sensitivity sensitivity",
    "nermo_mjx.view": "Page Recording render show",
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}

DATA_CONTROLLERS[".npz"] = "nermo_mjx.learn.policy:load_policy"

__all__ = ["LIMBS", "METRICS", "SERVOS", "Comparison", "Controller", "ControllerLike", "Page", "ParameterError"]
__all__ += ["Recording", "Robot", "RobotConfig", "Rollout", "Run", "RunResult", "Search", "SearchResult", "Sensitivity"]
__all__ += ["Sensors", "ServoAngles", "ServoTable", "Setup", "Simulator", "Sweep", "SweepResult", "Tuning"]
__all__ += ["TuningResult", "__version__", "all_metrics", "all_parameters", "compare", "compiler_options"]
__all__ += ["control_parameters", "kinematics", "leg_servos", "load_robot", "make_engine", "merge_sweeps", "metric"]
__all__ += ["parameter_tree", "published_controller", "quantity", "read_history", "read_table", "render"]
__all__ += ["run_experiment", "run_experiments", "run_search", "run_sweep", "run_tuning"]
__all__ += ["sensitivity", "servo_table", "show"]


#: Names of earlier releases, and what replaces them.
_REMOVED = {"run_landscape": "docs/answers/landscape.py compares the slopes of a tuning with secants"}


def __getattr__(name: str) -> Any:
    if name in _REMOVED:  # of an AttributeError, `from nermo_mjx import ...` would hide the message
        raise ImportError(f"nermo_mjx.{name} was removed: {_REMOVED[name]}.")
    if name == "kinematics":
        return importlib.import_module("nermo_mjx.kinematics")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'nermo_mjx' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
