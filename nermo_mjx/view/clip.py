"""A recording as data for the page: shapes and motion of the robot, its plots, in compact form; and its page."""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from nermo_mjx.recording import Recording
from nermo_mjx.robot import Robot, RobotConfig
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import values_of
from nermo_mjx.view.camera import body_radius, put_pose, root_body, smooth_path
from nermo_mjx.view.page import Packer, Page, document
from nermo_mjx.view.recorded import (
    Motion,
    Plot,
    details_of,
    finite_samples,
    headline_of,
    motion_of,
    own_build,
    own_geometry,
    plots_of,
    recorded_model,
    robot_of,
    shown_model,
    stretches,
    title_of,
)


class Frames:
    """The moving bodies of a motion.

    Attributes:
        bodies: their ids in the model, parents first, (n,).
        parents: index of each one's parent in `bodies`; -1 if the parent is static, with the world's frame centred at
            the root.
        position, quaternion: of each in its parent's frame, (T, n, 3) [m] and (T, n, 4), without sign flips.
    """

    def __init__(
        self, model: mujoco.MjModel, motion: Motion, origin: Float[np.ndarray, "T 3"]
    ) -> None:
        self.bodies: Int[np.ndarray, " n"] = np.flatnonzero(model.body_weldid != 0)
        index_of_body = {int(body): i for i, body in enumerate(self.bodies)}
        self.parents = [
            index_of_body.get(int(model.body_parentid[body]), -1) for body in self.bodies
        ]
        self._position = motion.position[:, self.bodies] - origin[:, None]
        turns = motion.quaternion[:, self.bodies]
        self._turns = [
            Rotation.from_quat(turns[:, i], scalar_first=True) for i in range(len(self.bodies))
        ]
        self.position, self.quaternion = self._position.copy(), turns.copy()
        for i, parent in enumerate(self.parents):
            if parent >= 0:
                self.position[:, i] = self._inside(parent, self._position[:, i])
                self.quaternion[:, i] = (self._turns[parent].inv() * self._turns[i]).as_quat(
                    scalar_first=True
                )
        self.quaternion = without_jumps(self.quaternion)

    def fixed(
        self, path: Float[np.ndarray, "T K 3"]
    ) -> tuple[list[int], Float[np.ndarray, "T K 3"]]:
        """Points in the frames in which they move least: indices in `bodies` or -1, and the points."""
        frames, points = [], path.copy()
        for k in range(path.shape[1]):
            paths = [path[:, k], *(self._inside(i, path[:, k]) for i in range(len(self.bodies)))]
            best = int(np.argmin([path_in_frame.var(axis=0).sum() for path_in_frame in paths]))
            frames.append(best - 1)
            points[:, k] = paths[best]
        return frames, points

    def _inside(self, frame: int, points: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
        """Points in the frame of a body."""
        return self._turns[frame].apply(points - self._position[:, frame], inverse=True)


def without_jumps(quaternion: np.ndarray) -> np.ndarray:
    """The same rotations (T, n, 4), each with the sign closer to the previous one, so that they can be interpolated."""
    signs = np.where((quaternion[1:] * quaternion[:-1]).sum(axis=-1) < 0, -1.0, 1.0)
    steady = quaternion.copy()
    steady[1:] *= np.cumprod(signs, axis=0)[..., None]
    return steady


#: Shapes that the page draws, by MuJoCo's names.
SHAPES: Final = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
#: MuJoCo draws the groups below this one; the others contain collision geoms.
HIDDEN_GROUP: Final = 3


def shapes_of(model: mujoco.MjModel, packer: Packer) -> dict[str, Any]:
    """Bodies, geoms and meshes of a model, in the page's format.

    Returns:
        `bodies`: names; `eyes`: the camera of that name with body, pose and field of view, or None; `geoms`: of each
        `kind`, `body`, `size`, `pos`, `quat` in its body [m], `rgba`, `collides`, and for a mesh
        its index; `meshes`: entries of vertices and faces.
    """
    indices: dict[int, int] = {}
    geoms = []
    for i in range(model.ngeom):
        kind = mujoco.mjtGeom(model.geom_type[i]).name.removeprefix("mjGEOM_").lower()
        if kind not in SHAPES:
            continue
        geom: dict[str, Any] = {
            "kind": kind,
            "body": int(model.geom_bodyid[i]),
            "size": _rounded(model.geom_size[i]),
            "pos": _rounded(model.geom_pos[i]),
            "quat": _rounded(model.geom_quat[i]),
            "rgba": _rounded(_colour(model, i)),
            "collides": bool(model.geom_group[i] >= HIDDEN_GROUP),
        }
        if kind == "mesh":
            geom["mesh"] = indices.setdefault(int(model.geom_dataid[i]), len(indices))
        geoms.append(geom)
    meshes = []
    for mesh in indices:
        vertices, faces = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        entry = packer.steps(model.mesh_vert[vertices : vertices + model.mesh_vertnum[mesh]])
        triangles = model.mesh_face[faces : faces + model.mesh_facenum[mesh]]
        meshes.append({"vertices": entry, "faces": packer.plain(triangles, "uint32")})
    eyes, camera = None, mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "eyes")
    if camera >= 0:
        pose = {"pos": _rounded(model.cam_pos[camera]), "quat": _rounded(model.cam_quat[camera])}
        eyes = {
            "body": int(model.cam_bodyid[camera]),
            **pose,
            "fovy": float(model.cam_fovy[camera]),
        }
    names = [model.body(i).name for i in range(model.nbody)]
    return {"bodies": names, "eyes": eyes, "geoms": geoms, "meshes": meshes}


def _colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """The colour in which MuJoCo draws it: the material's unless the geom has its own; a texture's mean colour."""
    material = int(model.geom_matid[geom])
    rgba = np.array(model.geom_rgba[geom], float)
    if material < 0 or not np.allclose(rgba, 0.5 * np.array([1, 1, 1, 2])):
        return rgba
    colour = np.array(model.mat_rgba[material], float)
    for texture in [t for t in model.mat_texid[material] if t >= 0][:1]:
        channels, start = model.tex_nchannel[texture], model.tex_adr[texture]
        size = model.tex_height[texture] * model.tex_width[texture] * channels
        colour[:3] *= (
            model.tex_data[start : start + size].reshape(-1, channels)[:, :3].mean(axis=0) / 255.0
        )
    return colour


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(value), 7) for value in values]


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
        within = (
            recording.duration * self.rate + 1 if recording.duration else 1.0
        )  # the rate may be infinite
        return self.most if within >= self.most else max(int(within), 2)


#: 30 s at the recorders' 100 Hz.
FULL_DETAIL: Final = Detail(3000)
#: A quarter of the size, for pages with many recordings: the player interpolates between samples.
COMPACT_DETAIL: Final = Detail(500, rate=34.0, length=1e-4, turn=5e-4, force=5e-3, curve=1e-3)


class Models:
    """The shapes of the robots that recordings show, each once."""

    def __init__(self, packer: Packer) -> None:
        self.headers: list[dict[str, Any]] = []
        self._packer = packer
        self._known: dict[tuple[RobotConfig, tuple[float, ...]], int] = {}

    def index(self, recording: Recording, robot: Robot) -> int:
        """Index of the header of a recording's robot, which is added if it is new."""
        shape = (
            own_geometry(recording) or Geometry(),
            own_build(recording) or ModelParameters().build,
        )
        key = (
            robot.config,
            tuple(float(value) for part_shape in shape for _, value in values_of(part_shape)),
        )
        if key not in self._known:
            self._known[key] = len(self.headers)
            self.headers.append(shapes_of(shown_model(recording, robot), self._packer))
        return self._known[key]


def page_of(recordings: list[Recording], names: list[str], height: int) -> Page:
    """The page of one recording, or of several in comparison; `height` is that in a notebook [pixels].

    Raises:
        RecordingError, ParameterError: one of them cannot be shown.
    """
    packer = Packer()
    header = clips_of(recordings, names, packer)
    samples = max(clip["time"]["shape"][0] for clip in header["clips"])
    title = " and ".join(dict.fromkeys(clip["title"] for clip in header["clips"]))
    return Page(document("viewer", f"Nermo: {title}", header, [packer]), height, samples)


def clips_of(recordings: list[Recording], names: list[str], packer: Packer) -> dict[str, Any]:
    """The header's part on recordings: `models`, each once, and `clips`; errors as above."""
    models = Models(packer)
    clips = [
        clip_of(recording, name, models, packer)
        for recording, name in zip(recordings, names, strict=True)
    ]
    return {"models": models.headers, "clips": clips}


def clip_of(
    recording: Recording, name: str, models: Models, packer: Packer, detail: Detail = FULL_DETAIL
) -> dict[str, Any]:
    """The header of one recording; errors as above."""
    robot = robot_of(recording)
    model = recorded_model(recording, robot)
    motion = motion_of(recording, model, detail.samples(recording))
    root = root_body(model)
    origin = motion.position[:, root]
    # Static bodies get far from a robot that walks away: their positions are sent once, and the robot's keep their
    # digits.
    frames = Frames(model, motion, origin)
    data = mujoco.MjData(model)
    put_pose(model, data, recording.qpos[0])
    centre, radius = body_radius(model, data, root)
    interval = float(np.median(np.diff(motion.time))) if len(motion.time) > 1 else 0.01
    header = {
        "name": name,
        "title": title_of(recording),
        "headline": headline_of(recording),
        "details": details_of(recording),
        "cut": len(finite_samples(recording)) < len(recording.time),
        "time": packer.plain(motion.time),
        "root": root,
        "radius": radius,
        "origin": packer.plain(origin),
        "follow": packer.plain(smooth_path(origin.copy(), interval) + (centre - data.xpos[root])),
        "moving": frames.bodies.tolist(),
        "parents": frames.parents,
        "still": {
            "position": motion.position[0].tolist(),
            "quaternion": motion.quaternion[0].tolist(),
        },
        "position": packer.steps(frames.position, detail.length),
        "quaternion": packer.steps(frames.quaternion, detail.turn),
    }
    header |= {
        "tendons": [],
        "contacts": [],
        "footprints": _footprints(recording, motion),
    }
    for tendon in motion.tendons:
        frame_indices, path = frames.fixed(tendon.path - origin[:, None])
        tendon_data = {"name": tendon.name, "radius": tendon.radius, "frames": frame_indices}
        values = {
            "path": packer.steps(path, detail.length),
            "tension": packer.steps(tendon.tension, detail.force),
        }
        header["tendons"].append(tendon_data | values)
    for contact in motion.contacts:
        point = packer.steps(contact.point - origin, detail.length)
        force = packer.steps(contact.force, detail.force)
        header["contacts"].append({"limb": contact.limb, "point": point, "force": force})
    header["plots"] = [_packed_plot(plot, packer, detail) for plot in plots_of(recording, motion)]
    return header | {"model": models.index(recording, robot)}


def _packed_plot(plot: Plot, packer: Packer, detail: Detail) -> dict[str, Any]:
    """The header of one plot."""
    lines = []
    for line in plot.lines:
        finite_values = line.values[np.isfinite(line.values)]
        step = detail.curve * float(np.ptp(finite_values)) if len(finite_values) else 0.0
        values = packer.steps(line.values, step)
        lines.append(
            {"name": line.name, "colour": line.colour, "faint": line.faint, "values": values}
        )
    packed = {"key": plot.key, "title": plot.title, "unit": plot.unit, "bars": plot.bars}
    return packed | {"lines": lines}


def _footprints(recording: Recording, motion: Motion) -> list[list[float]]:
    """(time [s], limb, x, y [m]) of each touchdown that lasts."""
    if not {"foot_force", "foot_position"} <= recording.sensors.keys():
        return []
    samples = np.searchsorted(recording.time, motion.time)
    force = recording.sensors["foot_force"][samples]
    position = recording.sensors["foot_position"][samples]
    prints = []
    for limb in range(force.shape[1]):
        for begin, end in stretches(force[:, limb] > 0.1):
            if motion.time[end - 1] - motion.time[begin] >= 0.05:
                x, y = position[(begin + end - 1) // 2, limb, :2]
                prints.append(
                    [
                        round(float(motion.time[begin]), 4),
                        limb,
                        round(float(x), 5),
                        round(float(y), 5),
                    ]
                )
    return sorted(prints)
