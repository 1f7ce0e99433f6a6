"""Overlays of a video, by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.view.strips import Panel, Strip, gait_panels, servo_panels
from nermo_mjx.view.support import draw_support


@dataclasses.dataclass(frozen=True)
class Overlay:
    """One kind of overlay.

    Attributes:
        needs: sensors of the recording that it shows.
        panels: rows of the strip below the image; None if it is drawn into the scene.
    """

    needs: tuple[str, ...]
    panels: Callable[[Recording], list[Panel]] | None


#: `gait`: a bar for each standing foot; `servos`: their angles; `support`: polygon and centre of mass on the ground.
OVERLAYS: Final[dict[str, Overlay]] = {
    "gait": Overlay(("foot_force",), gait_panels),
    "servos": Overlay(("servo_angle",), servo_panels),
    "support": Overlay(("foot_force", "foot_position"), None),
}


def check_overlays(names: Sequence[str], recording: Recording | None = None) -> None:
    """Reject unknown overlays, and those for which a recording lacks the sensors.

    Raises:
        ParameterError: an unknown name, or one that is given twice.
        RecordingError: a sensor is missing.
    """
    for name in names:
        if name not in OVERLAYS:
            raise ParameterError(f"overlay is {name!r}: allowed is one of {', '.join(OVERLAYS)}.")
        missing = [sensor for sensor in OVERLAYS[name].needs if recording and sensor not in recording.sensors]
        if missing:
            raise RecordingError(f"The overlay {name!r} needs the sensor {missing[0]!r}, which the recording lacks.")
    if len(set(names)) < len(names):
        raise ParameterError(f"overlay is {', '.join(names)}: allowed is each name once.")


def strips_of(recording: Recording, names: Sequence[str], width: int) -> list[Strip]:
    """The strips below the image, from top to bottom."""
    kinds = [OVERLAYS[name].panels for name in names]
    return [Strip(recording, panels(recording), width) for panels in kinds if panels is not None]


def scenery_of(
    recording: Recording, names: Sequence[str], root: int
) -> Callable[[mujoco.MjvScene, mujoco.MjData, int], None] | None:
    """The function that adds to the scene of a sample, or None.

    Args:
        recording: to show.
        names: of overlays.
        root: body whose subtree is the robot.
    """
    if "support" not in names:
        return None

    def draw(scene: mujoco.MjvScene, data: mujoco.MjData, sample: int) -> None:
        tip = mujoco.mj_name2id(data.model, mujoco.mjtObj.mjOBJ_GEOM, "tail_tip")
        tail = np.array(data.geom_xpos[tip]) if tip >= 0 else None
        draw_support(scene, recording, sample, np.array(data.subtree_com[root]), tail)

    return draw


def beside(strips: Sequence[Strip], picture: Any, seconds: float) -> Any:
    """The picture with its strips below, at a time since the recording began [s]."""
    return np.concatenate([picture, *(strip.at(seconds) for strip in strips)]) if strips else picture
