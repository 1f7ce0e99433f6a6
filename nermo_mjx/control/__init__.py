"""The robot's controller: pilot, gait, spine, head and tail, as `init` and `update`; the protocol of controllers."""

from nermo_mjx.control.controller import (
    Controller,
    ControllerState,
    check,
    control_parameters,
    published_controller,
)
from nermo_mjx.control.head_and_tail import HeadAngles, HeadLike, Pace, TailLike
from nermo_mjx.control.parameters import ControlParameters, published_values
from nermo_mjx.control.pilot import Drive, External, Follow, OpenLoop, PilotLike, Walk, tabulated
from nermo_mjx.control.protocol import ControllerLike, leg_servos, load_controller
from nermo_mjx.control.schedule import Switch
from nermo_mjx.control.spine_modes import SagittalLike, SagittalModes, SpineLike, SpineModes
from nermo_mjx.control.stepping import GaitLike, Stepping, Steps

__all__ = [
    "ControlParameters",
    "Controller",
    "ControllerLike",
    "ControllerState",
    "Drive",
    "External",
    "Follow",
]
__all__ += [
    "GaitLike",
    "HeadAngles",
    "HeadLike",
    "OpenLoop",
    "Pace",
    "PilotLike",
    "SagittalLike",
    "SagittalModes",
]
__all__ += [
    "SpineLike",
    "SpineModes",
    "Stepping",
    "Steps",
    "Switch",
    "TailLike",
    "Walk",
    "check",
    "control_parameters",
]
__all__ += [
    "leg_servos",
    "load_controller",
    "published_controller",
    "published_values",
    "tabulated",
]
