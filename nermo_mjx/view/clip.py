"""A recording in the page's format: a model's shapes, motion, forces and curves, packed."""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.recording import Recording
from nermo_mjx.robot import Robot, RobotConfig
from nermo_mjx.robot.quantity import values_of
from nermo_mjx.view.camera import body_radius, root_body, smooth_path
from nermo_mjx.view.caption import details_of, headline_of, title_of
from nermo_mjx.view.frames import Frames
from nermo_mjx.view.motion import Motion, Tendon, finite_samples, motion_of
from nermo_mjx.view.packing import Packer
from nermo_mjx.view.recorded_robot import recorded_geometry, recorded_model, robot_of, shown_model
from nermo_mjx.view.shapes import shapes_of
from nermo_mjx.view.signals import Plot, plots_of


@dataclasses.dataclass(frozen=True)
class Detail:
    """Resolution of a recording in a page; lower ones give smaller pages.

    Attributes:
        most: maximum number of samples; of a longer run every second, third, ... one is kept.
        rate: samples per second at most [Hz].
        length, turn, force: rounding of positions [m], quaternions and forces [N]; 0 is the finest that 16 bits allow.
        curve: the same for curves, as a fraction of their range.
    """

    most: int
    rate: float = np.inf
    length: float = 0.0
    turn: float = 0.0
    force: float = 0.0
    curve: float = 0.0

    def samples(self, recording: Recording) -> int:
        """Maximum number of samples of a recording."""
        within = recording.duration * self.rate + 1
        return self.most if within >= self.most else max(int(within), 2)


#: 30 s at the recorders' 100 Hz.
FULL: Final = Detail(3000)
#: A quarter of the size, for pages with many recordings: the player interpolates between samples.
COMPACT: Final = Detail(500, rate=34.0, length=1e-4, turn=5e-4, force=5e-3, curve=1e-3)


class Models:
    """The shapes of the robots that recordings show, each once."""

    def __init__(self, packer: Packer) -> None:
        self.headers: list[dict[str, Any]] = []
        self._packer = packer
        self._known: dict[tuple[RobotConfig, tuple[float, ...]], int] = {}

    def index(self, recording: Recording, robot: Robot) -> int:
        """Index of the header of a recording's robot, which is added if it is new."""
        key = robot.config, tuple(float(value) for _, value in values_of(recorded_geometry(recording)))
        if key not in self._known:
            self._known[key] = len(self.headers)
            self.headers.append(shapes_of(shown_model(recording, robot), self._packer))
        return self._known[key]


def clips_of(recordings: list[Recording], names: list[str], packer: Packer) -> dict[str, Any]:
    """The header's part on recordings: `models`, each once, and `clips`.

    Raises:
        RecordingError, ParameterError: one of them cannot be shown.
    """
    models = Models(packer)
    clips = [clip_of(each, name, models, packer) for each, name in zip(recordings, names, strict=True)]
    return {"models": models.headers, "clips": clips}


def clip_of(recording: Recording, name: str, models: Models, packer: Packer, detail: Detail = FULL) -> dict[str, Any]:
    """The header of one recording.

    Raises:
        RecordingError, ParameterError: it cannot be shown.
    """
    robot = robot_of(recording)
    clip = _clip(recording, recorded_model(recording, robot), packer, detail)
    return {"name": name, "model": models.index(recording, robot)} | clip


def _clip(recording: Recording, model: mujoco.MjModel, packer: Packer, detail: Detail) -> dict[str, Any]:
    motion = motion_of(recording, model, detail.samples(recording))
    root = root_body(model)
    origin = motion.position[:, root]
    # Static bodies get far from a robot that walks away: their positions are sent once, and the robot's keep their
    # digits.
    frames = Frames(model, motion, origin)
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
        "moving": frames.bodies.tolist(),
        "parents": frames.parents,
        "still": {"position": motion.position[0].tolist(), "quaternion": motion.quaternion[0].tolist()},
        "position": packer.steps(frames.position, detail.length),
        "quaternion": packer.steps(frames.quaternion, detail.turn),
        "tendons": [_tendon(tendon, frames, origin, packer, detail) for tendon in motion.tendons],
        "contacts": [
            {"limb": contact.limb, "point": packer.steps(contact.point - origin, detail.length),
             "force": packer.steps(contact.force, detail.force)}
            for contact in motion.contacts
        ],
        "footprints": _footprints(recording, motion),
        "plots": [_plot(plot, packer, detail) for plot in plots_of(recording, motion)],
    }  # fmt: skip


def _tendon(tendon: Tendon, frames: Frames, origin: np.ndarray, packer: Packer, detail: Detail) -> dict[str, Any]:
    within, path = frames.fixed(tendon.path - origin[:, None])
    return {
        "name": tendon.name, "radius": tendon.radius, "frames": within, "path": packer.steps(path, detail.length),
        "tension": packer.steps(tendon.tension, detail.force),
    }  # fmt: skip


def _extent(recording: Recording, model: mujoco.MjModel) -> tuple[np.ndarray, float]:
    """Centre of the body relative to its root, and its size [m]."""
    data = mujoco.MjData(model)
    data.qpos[:] = recording.qpos[0]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    root = root_body(model)
    centre, radius = body_radius(model, data, root)
    return centre - data.xpos[root], radius


def _footprints(recording: Recording, motion: Motion) -> list[list[float]]:
    """(time [s], limb, x, y [m]) of each touchdown that lasts."""
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


def _plot(plot: Plot, packer: Packer, detail: Detail) -> dict[str, Any]:
    return {
        "key": plot.key, "title": plot.title, "unit": plot.unit, "bars": plot.bars,
        "lines": [
            {"name": line.name, "colour": line.colour, "faint": line.faint,
             "values": packer.steps(line.values, detail.curve * _span(line.values))}
            for line in plot.lines
        ],
    }  # fmt: skip


def _span(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else 0.0
