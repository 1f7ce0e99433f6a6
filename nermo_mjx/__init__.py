"""Batched digital twin of Nermo, the tendon-driven robotic mouse with a compliant spine, on MuJoCo and MJX.

The public names are in `__all__`, here and in the modules that docs/reference/interface.md lists. They are imported on
first use, and importing changes nothing in the process: see `nermo_mjx.runtime`.
"""

# ruff: noqa: I001  (one statement for each module)
from __future__ import annotations

from typing import TYPE_CHECKING

from nermo_mjx.lazy import lazy_names
from nermo_mjx.trust import DATA_CONTROLLERS
from nermo_mjx.version import __version__ as __version__

if TYPE_CHECKING:
    from nermo_mjx import kinematics as kinematics
    from nermo_mjx.control import (
        Controller as Controller,
        ControllerLike as ControllerLike,
        control_parameters as control_parameters,
        leg_servos as leg_servos,
        published_controller as published_controller,
    )
    from nermo_mjx.experiments.run import (
        run_experiment as run_experiment,
        run_experiments as run_experiments,
    )
    from nermo_mjx.hardware import (
        ServoTable as ServoTable,
        read_log as read_log,
        servo_table as servo_table,
    )
    from nermo_mjx.identify.identification import identify_log as identify_log
    from nermo_mjx.identify.report import write_identification as write_identification
    from nermo_mjx.identify.run import (
        IdentificationResult as IdentificationResult,
        run_identification as run_identification,
    )
    from nermo_mjx.learn import (
        Environment as Environment,
        Task as Task,
        Training as Training,
        run_training as run_training,
    )
    from nermo_mjx.live.driving import Driving as Driving
    from nermo_mjx.optimize import (
        Search as Search,
        SearchResult as SearchResult,
        Tuning as Tuning,
        TuningResult as TuningResult,
        read_history as read_history,
        run_search as run_search,
        run_tuning as run_tuning,
    )
    from nermo_mjx.physics import (
        Trajectory as Trajectory,
        make_engine as make_engine,
        trajectory as trajectory,
    )
    from nermo_mjx.robot import (
        LIMBS as LIMBS,
        SERVOS as SERVOS,
        ParameterError as ParameterError,
        Robot as Robot,
        RobotConfig as RobotConfig,
        Sensors as Sensors,
        ServoAngles as ServoAngles,
        load_robot as load_robot,
    )
    from nermo_mjx.robot.quantity import parameter_tree as parameter_tree, quantity as quantity
    from nermo_mjx.rollout import (
        METRICS as METRICS,
        Run as Run,
        RunResult as RunResult,
        Setup as Setup,
        Simulator as Simulator,
        all_metrics as all_metrics,
        all_parameters as all_parameters,
        metric as metric,
    )
    from nermo_mjx.rollout.differentiable import Rollout as Rollout
    from nermo_mjx.rollout.loop import ClosedLoop as ClosedLoop
    from nermo_mjx.runs import (
        DirectoryError as DirectoryError,
        Interrupted as Interrupted,
        JobFailed as JobFailed,
        OtherCode as OtherCode,
        Progress as Progress,
        Watch as Watch,
    )
    from nermo_mjx.runs.ray_workers import RayWorkers as RayWorkers
    from nermo_mjx.runtime import compiler_options as compiler_options
    from nermo_mjx.specs.reading import SpecError as SpecError
    from nermo_mjx.sweep import (
        Sweep as Sweep,
        SweepResult as SweepResult,
        merge_sweeps as merge_sweeps,
        read_table as read_table,
        run_sweep as run_sweep,
    )
    from nermo_mjx.sweep.comparing import Comparison as Comparison, compare as compare
    from nermo_mjx.sweep.replay import find_row as find_row, replay_row as replay_row
    from nermo_mjx.sweep.sensitivity import Sensitivity as Sensitivity, sensitivity as sensitivity
    from nermo_mjx.view import Page as Page, Recording as Recording, render as render, show as show
else:
    __getattr__, __dir__, __all__ = lazy_names(
        __name__,
        removed={
            "run_landscape": "docs/answers/landscape.py compares the slopes of a tuning with secants"
        },
    )

DATA_CONTROLLERS[".npz"] = "nermo_mjx.learn.policy:load_policy"
