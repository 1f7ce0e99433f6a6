"""The robot's controller: pilot, gait, spine, head and tail, as `init` and `update`; the protocol of controllers."""

from nermo_mjx.control.build import check, control_parameters
from nermo_mjx.control.controller import Controller, published_controller
from nermo_mjx.control.fusion import SpineLike, SpineModes
from nermo_mjx.control.head import HeadAngles, HeadLike
from nermo_mjx.control.loading import load_controller
from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.control.pilot import Drive, External, Follow, OpenLoop, PilotLike, Walk, tabulated
from nermo_mjx.control.protocol import ControllerLike, leg_servos
from nermo_mjx.control.published import published_values
from nermo_mjx.control.sagittal import SagittalLike, SagittalModes
from nermo_mjx.control.state import ControllerState
from nermo_mjx.control.stepping import GaitLike, Stepping, Steps
from nermo_mjx.control.sway import Pace
from nermo_mjx.control.tail import TailLike

__all__ = [
    "ControlParameters", "Controller", "ControllerLike", "ControllerState", "Drive", "External", "Follow",
    "GaitLike", "HeadAngles", "HeadLike", "OpenLoop", "Pace", "PilotLike", "SagittalLike", "SagittalModes",
    "SpineLike", "SpineModes", "Stepping", "Steps", "TailLike", "Walk", "check", "control_parameters", "leg_servos",
    "load_controller", "published_controller", "published_values", "tabulated",
]  # fmt: skip
