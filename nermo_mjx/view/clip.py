"""A recording as the page reads it: a model's shapes, motion, forces and curves, packed."""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.recording import Recording
from nermo_mjx.view.camera import body_radius, root_body, smooth_path
from nermo_mjx.view.caption import details_of, headline_of, title_of
from nermo_mjx.view.motion import Motion, finite_samples, motion_of
from nermo_mjx.view.packing import Packer
from nermo_mjx.view.recorded_robot import recorded_model, robot_of
from nermo_mjx.view.shapes import shapes_of
from nermo_mjx.view.signals import Plot, plots_of

#: Samples of a page at most: 30 s at the recorders' 100 Hz; of a longer run every second, third, ... one.
MOST_SAMPLES: Final = 3000


def clips_of(recordings: list[Recording], names: list[str], packer: Packer) -> dict[str, Any]:
    """The header's part on recordings: `models`, each once, and `clips`.

    Raises:
        RecordingError, ParameterError: one of them cannot be shown.
    """
    models: list[dict[str, Any]] = []
    known: dict[int, int] = {}
    clips = []
    for recording, name in zip(recordings, names, strict=True):
        robot = robot_of(recording)
        if id(robot) not in known:
            known[id(robot)] = len(models)
            models.append(shapes_of(robot.model, packer))
        model = recorded_model(recording, robot)
        clips.append({"name": name, "model": known[id(robot)]} | _clip(recording, model, packer))
    return {"models": models, "clips": clips}


def _clip(recording: Recording, model: mujoco.MjModel, packer: Packer) -> dict[str, Any]:
    motion = motion_of(recording, model, MOST_SAMPLES)
    root = root_body(model)
    origin = motion.position[:, root]
    # What stands still is far from a robot that walks away: its place is sent once, and the robot's keep their digits.
    moving = np.flatnonzero(model.body_weldid != 0)
    centre, radius = _extent(recording, model)
    interval = float(np.median(np.diff(motion.time))) if len(motion.time) > 1 else 0.01
    return {
        "title": title_of(recording),
        "headline": headline_of(recording),
        "details": details_of(recording),
        "cut": len(finite_samples(recording)) < len(recording.time),
        "time": packer.plain(motion.time),
        "root": root,
        "radius": radius,
        "origin": packer.plain(origin),
        "follow": packer.plain(smooth_path(origin.copy(), interval) + centre),
        "moving": moving.tolist(),
        "still": {"position": motion.position[0].tolist(), "quaternion": motion.quaternion[0].tolist()},
        "position": packer.steps(motion.position[:, moving] - origin[:, None]),
        "quaternion": packer.steps(_without_jumps(motion.quaternion[:, moving])),
        "tendons": [
            {"name": tendon.name, "radius": tendon.radius, "path": packer.steps(tendon.path - origin[:, None]),
             "tension": packer.steps(tendon.tension)}
            for tendon in motion.tendons
        ],
        "contacts": [
            {"limb": contact.limb, "point": packer.steps(contact.point - origin), "force": packer.steps(contact.force)}
            for contact in motion.contacts
        ],
        "footprints": _footprints(recording, motion),
        "plots": [_plot(plot, packer) for plot in plots_of(recording, motion)],
    }  # fmt: skip


def _extent(recording: Recording, model: mujoco.MjModel) -> tuple[np.ndarray, float]:
    """Where the middle of the body is beside its root, and how large it is [m]."""
    data = mujoco.MjData(model)
    data.qpos[:] = recording.qpos[0]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    root = root_body(model)
    centre, radius = body_radius(model, data, root)
    return centre - data.xpos[root], radius


def _without_jumps(quaternion: np.ndarray) -> np.ndarray:
    """The same turns (T, n, 4), each with the sign that is nearer to the one before, so that they can be mixed."""
    signs = np.where((quaternion[1:] * quaternion[:-1]).sum(axis=-1) < 0, -1.0, 1.0)
    steady = quaternion.copy()
    steady[1:] *= np.cumprod(signs, axis=0)[..., None]
    return steady


def _footprints(recording: Recording, motion: Motion) -> list[list[float]]:
    """(time [s], limb, x, y [m]) of each touchdown that holds for a while."""
    if not {"foot_force", "foot_position"} <= recording.sensors.keys():
        return []
    samples = np.searchsorted(recording.time, motion.time)
    force, place = recording.sensors["foot_force"][samples], recording.sensors["foot_position"][samples]
    prints = []
    for limb in range(force.shape[1]):
        stands = force[:, limb] > 0.1
        edges = np.flatnonzero(np.diff(np.concatenate([[False], stands, [False]]).astype(int)))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            if motion.time[end - 1] - motion.time[begin] >= 0.05:
                x, y = place[(begin + end - 1) // 2, limb, :2]
                prints.append([round(float(motion.time[begin]), 4), limb, round(float(x), 5), round(float(y), 5)])
    return sorted(prints)


def _plot(plot: Plot, packer: Packer) -> dict[str, Any]:
    return {
        "key": plot.key, "title": plot.title, "unit": plot.unit, "bars": plot.bars,
        "lines": [
            {"name": line.name, "colour": line.colour, "faint": line.faint, "values": packer.steps(line.values)}
            for line in plot.lines
        ],
    }  # fmt: skip
