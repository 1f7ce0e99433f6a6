"""The robot's controller: pilot, gait, spine, head and tail, as `init` and `update`; the protocol of controllers."""

from nermo_mjx.control.build import check, control_parameters
from nermo_mjx.control.controller import Controller, published_controller
from nermo_mjx.control.fusion import SpineLike, SpineModes
from nermo_mjx.control.head import Gaze, HeadAngles, HeadLike, HeldHead
from nermo_mjx.control.loading import load_controller
from nermo_mjx.control.parameters import ControlParameters, published_values
from nermo_mjx.control.pilot import Drive, External, Follow, OpenLoop, PilotLike, Walk, tabulated
from nermo_mjx.control.protocol import ControllerLike, leg_servos
from nermo_mjx.control.sagittal import SagittalLike, SagittalModes
from nermo_mjx.control.state import ControllerState
from nermo_mjx.control.stepping import GaitLike, Stepping, Steps
from nermo_mjx.control.sway import Pace
from nermo_mjx.control.tail import CounterRoll, CounterYaw, HeldTail, TailLike, TailSwing

__all__ = [
    "ControlParameters", "Controller", "ControllerLike", "ControllerState", "CounterRoll", "CounterYaw", "Drive",
    "External", "Follow", "GaitLike", "Gaze", "HeadAngles", "HeadLike", "HeldHead", "HeldTail", "OpenLoop", "Pace",
    "PilotLike", "SagittalLike", "SagittalModes", "SpineLike", "SpineModes", "Stepping", "Steps", "TailLike",
    "TailSwing", "Walk", "check", "control_parameters", "leg_servos", "load_controller", "published_controller",
    "published_values", "tabulated",
]  # fmt: skip
