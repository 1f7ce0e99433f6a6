"""Cameras that follow the robot: the position of each named view, and how smoothly it tracks the torso."""

from __future__ import annotations

import dataclasses
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Angle:
    """Direction of a view [degrees]; azimuth 0 looks along +x, so that the robot, heading -y, walks to the right."""

    azimuth: float
    elevation: float


CAMERAS: Final[dict[str, Angle]] = {
    "three_quarter": Angle(38.0, -22.0),
    "high": Angle(30.0, -38.0),
    "side": Angle(0.0, -6.0),
    "top": Angle(0.0, -89.9),
    "front": Angle(90.0, -12.0),
    "rear": Angle(-90.0, -18.0),
}
#: Both of the robot's eyes, side by side.
STEREO: Final = "stereo"
#: Standard deviation of the filter that removes the shaking of the steps from the camera's path [s].
SMOOTHING: Final = 0.25
#: Radius of the body over half the height of a square picture; a wide one shows the long, level body larger.
FILLING: Final = 1.0


def root_body(model: mujoco.MjModel) -> int:
    """The body that a camera follows: "torso", else the first free-floating one, else the first."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "torso")
    if body >= 0:
        return int(body)
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    return int(model.jnt_bodyid[free[0]]) if len(free) else min(1, model.nbody - 1)


def smooth_path(points: Float[np.ndarray, "F 3"], interval: float) -> Float[np.ndarray, "F 3"]:
    """The points [m], `interval` seconds apart, with x and y smoothed without lag, and z at its mean."""
    sigma = SMOOTHING / interval
    reach = int(np.ceil(3 * sigma))
    if reach == 0 or len(points) < 2:
        return points
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    # Continue each end point-symmetrically, so that a steady walk stays steady at both ends.
    index = np.arange(-reach, len(points) + reach)
    last = len(points) - 1
    inside = np.clip(np.where(index < 0, -index, np.where(index > last, 2 * last - index, index)), 0, last)
    edge = np.clip(index, 0, last)
    outside = (index < 0) | (index > last)
    padded = np.where(outside[:, None], 2 * points[edge] - points[inside], points[inside])
    smooth = np.stack([np.convolve(padded[:, axis], kernel, mode="valid") for axis in range(3)], axis=1)
    smooth[:, 2] = points[:, 2].mean()
    return smooth


def body_radius(model: mujoco.MjModel, data: mujoco.MjData, root: int) -> tuple[Float[np.ndarray, " 3"], float]:
    """Centre [m] and radius [m] of everything visible that is attached to the root body, in the pose of `data`."""
    shown = (model.body_rootid[model.geom_bodyid] == model.body_rootid[root]) & (model.geom_group < 3)
    if root == 0 or not shown.any():
        return np.array(model.stat.center), float(model.stat.extent)
    # Few geoms reach far; their bounding spheres are loose, so count half of each radius.
    centres, radii = data.geom_xpos[shown], 0.5 * model.geom_rbound[shown, None]
    low, high = (centres - radii).min(axis=0), (centres + radii).max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low) / 2)


def following_camera(name: str, radius: float, fovy: float, aspect: float) -> mujoco.MjvCamera:
    """The free camera of a named view, as far away as a body of this radius needs; fovy in degrees."""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultCamera(camera)
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.azimuth, camera.elevation = CAMERAS[name].azimuth, CAMERAS[name].elevation
    narrow = np.tan(np.deg2rad(fovy) / 2) * (np.sqrt(aspect) if aspect > 1 else aspect)
    camera.distance = radius / (FILLING * narrow)
    return camera
