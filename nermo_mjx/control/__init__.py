"""The robot's controller: pilot, gait clock, foot trajectories, turning and spine, as `init` and `update`."""

from nermo_mjx.control.build import check, control_parameters
from nermo_mjx.control.controller import Controller
from nermo_mjx.control.parameters import ControlParameters, published_values
from nermo_mjx.control.pilot import tabulated
from nermo_mjx.control.state import ControllerState

__all__ = [
    "ControlParameters",
    "Controller",
    "ControllerState",
    "check",
    "control_parameters",
    "published_values",
    "tabulated",
]
