"""Which parameters a setup reads: some have an effect only with one of its choices, or in one scene."""

from __future__ import annotations

from typing import Final

from nermo_mjx.control.free_stepping import FREE
from nermo_mjx.control.head import GAZE
from nermo_mjx.control.tail import COUNTER_ROLL, COUNTER_YAW, SWING
from nermo_mjx.robot.terrains import scenes_reading, terrain_values
from nermo_mjx.rollout import Setup

#: Parameters, and groups of them, that are only used with a certain choice of the setup.
_NEEDS: Final = {
    "spine.amplitude": ("spine", "stride_extension"),
    "spine.phase": ("spine", "stride_extension"),
    "spine.balance_lift": ("spine", "balance"),
    "pilot.turn_rate": ("pilot", "open_loop"),
    "pilot.radius": ("pilot", "arc"),
    "pilot.direction": ("pilot", "arc"),
    "spine.harmonics": ("spine", "harmonics"),
    "head.tilt": ("robot", "nermo_41"),
    **{f"head.{name}": ("head", GAZE) for name in ("gain", "bandwidth", "lead")},
    "tail.angle": ("tail", "articulated"),
    **{f"tail.{name}": ("tail_motion", SWING) for name in ("swing_amplitude", "swing_gain", "swing_phase")},
    **{f"tail.{name}": ("tail_motion", COUNTER_YAW) for name in ("yaw_gain", "bandwidth")},
    "tail.roll_gain": ("tail_motion", COUNTER_ROLL),
    "spine.sagittal_amplitude": ("spine", "sagittal_extension"),
    "spine.sagittal_phase": ("spine", "sagittal_extension"),
    "spine.pitch_gain": ("spine", "pitch_balance"),
    "spine.pitch_damping": ("spine", "pitch_balance"),
    "limb": ("trajectory", FREE),
    "foot": ("trajectory", FREE),
    "trim": ("trajectory", FREE),
}


def unread(setup: Setup, name: str) -> tuple[str, str] | None:
    """The choice that a parameter requires, and its required values; None if the parameter is used."""
    if is_terrain(name) and name not in terrain_values(str(setup.scene)):
        return "scene", scenes_reading(name)[0]
    groups = [name.rsplit(".", up)[0] for up in range(name.count(".") + 1)] if setup.controller is None else []
    choice, wanted = next((_NEEDS[each] for each in groups if each in _NEEDS), ("", ""))
    return (choice, wanted) if choice and wanted not in getattr(setup, choice).split("+") else None


def is_terrain(name: str) -> bool:
    """Whether a parameter is one of the terrain's shape."""
    return name.startswith("terrain.")
