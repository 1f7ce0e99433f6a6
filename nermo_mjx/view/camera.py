"""The view of the robot in videos and in the viewer: following cameras, light, and the support polygon."""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import ConvexHull, QhullError

from nermo_mjx.recording import Recording
from nermo_mjx.view.recorded import STANCE_NEWTONS

#: Azimuth and elevation of views [degrees]; azimuth 0 looks along +x: the robot, heading -y, walks to the right.
CAMERAS: Final = {
    "three_quarter": (38.0, -22.0),
    "high": (30.0, -38.0),
    "side": (0.0, -6.0),
    "top": (0.0, -89.9),
    "front": (90.0, -12.0),
    "rear": (-90.0, -18.0),
}
#: Both of the robot's eyes, side by side.
STEREO: Final = "stereo"
#: Standard deviation of the filter that removes the shaking of the steps from the camera's path [s].
SMOOTHING_SECONDS: Final = 0.25


def root_body(model: mujoco.MjModel) -> int:
    """The body that a camera follows: "torso", else the first free-floating one, else the first."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "torso")
    if body >= 0:
        return int(body)
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    return int(model.jnt_bodyid[free[0]]) if len(free) else min(1, model.nbody - 1)


def put_pose(model: mujoco.MjModel, data: mujoco.MjData, qpos: Float[np.ndarray, " nq"]) -> None:
    """Put bodies and centres of mass where they are in a pose."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)


def smooth_path(points: Float[np.ndarray, "F 3"], interval: float) -> Float[np.ndarray, "F 3"]:
    """The points [m], `interval` seconds apart, with x and y smoothed without lag, and z at its mean."""
    sigma = SMOOTHING_SECONDS / interval
    reach = int(np.ceil(3 * sigma))
    if reach == 0 or len(points) < 2:
        return points
    # Each end is continued point-symmetrically, so that a steady walk stays steady there.
    padded = np.pad(points, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    smooth = gaussian_filter1d(padded, sigma, axis=0, radius=reach)[reach:-reach]
    smooth[:, 2] = points[:, 2].mean()
    return smooth


def body_radius(
    model: mujoco.MjModel, data: mujoco.MjData, root: int
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Centre [m] and radius [m] of everything visible that is attached to the root body, in the pose of `data`."""
    is_visible = (model.body_rootid[model.geom_bodyid] == model.body_rootid[root]) & (
        model.geom_group < 3
    )
    if root == 0 or not is_visible.any():
        return np.array(model.stat.center), float(model.stat.extent)
    # Few geoms reach far; their bounding spheres are loose, so count half of each radius.
    centres, radii = data.geom_xpos[is_visible], 0.5 * model.geom_rbound[is_visible, None]
    low, high = (centres - radii).min(axis=0), (centres + radii).max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low) / 2)


def following_camera(name: str, radius: float, fovy: float, aspect: float) -> mujoco.MjvCamera:
    """The free camera of a named view, at the distance that a body of this radius requires; fovy in degrees.

    In a square image, the bounding sphere of the body fills the height. In a wide image, the long, level body is larger.
    """
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultCamera(camera)
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.azimuth, camera.elevation = CAMERAS[name]
    narrow = np.tan(np.deg2rad(fovy) / 2) * (np.sqrt(aspect) if aspect > 1 else aspect)
    camera.distance = radius / narrow
    return camera


_DIRECTIONAL_LIGHT = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL


def put_sun_overhead(model: mujoco.MjModel) -> None:
    """Point the shadow-casting light straight down, in place.

    Slanting light speckles the floor at the edge of the shadow map; light from above also shows the positions of the feet.
    """
    overhead = (model.light_type == _DIRECTIONAL_LIGHT) & (model.light_castshadow != 0)
    model.light_dir[overhead] = (0.0, 0.0, -1.0)
    model.light_pos[overhead, :2] = 0.0


def move_sun_above(
    model: mujoco.MjModel, data: mujoco.MjData, point: Float[np.ndarray, " 3"]
) -> None:
    """Move the sun to a point in the world [m], after `mj_camlight`; otherwise the robot walks out of its shadow
    map."""
    data.light_xpos[model.light_type == _DIRECTIONAL_LIGHT, :2] += point[:2]


#: Thickness of the lines, radius of the points, and their height above the ground [m].
_LINE_METRES, _POINT_METRES, _HEIGHT_METRES = 0.0006, 0.0024, 0.0008
#: Colours of a centre of mass inside and outside of the polygon, and of the polygon (Okabe and Ito).
INSIDE_COLOUR: Final = (0.0, 0.62, 0.45, 1.0)
OUTSIDE_COLOUR: Final = (0.84, 0.37, 0.0, 1.0)
_EDGE_COLOUR: Final = (0.0, 0.45, 0.70, 1.0)


def support_polygon(
    points: Float[np.ndarray, "n 2"], standing: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "corners 2"]:
    """Corners of the convex hull of the standing points, in order [m]; fewer than three if fewer are standing."""
    points = points[standing]
    if len(points) < 3:
        return points
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:  # all in one line
        along = points @ (points[-1] - points[0])
        return points[[int(along.argmin()), int(along.argmax())]]


def is_inside(corners: Float[np.ndarray, "corners 2"], point: Float[np.ndarray, " 2"]) -> bool:
    """Whether a point lies in a convex polygon; always false with fewer than three corners."""
    if len(corners) < 3:
        return False
    edges = np.roll(corners, -1, axis=0) - corners
    to_point = point - corners
    sides = edges[:, 0] * to_point[:, 1] - edges[:, 1] * to_point[:, 0]
    return bool((sides >= 0).all() or (sides <= 0).all())


def draw_support(
    scene: mujoco.MjvScene,
    recording: Recording,
    sample: int,
    com: Float[np.ndarray, " 3"],
    tail: Float[np.ndarray, " 3"] | None = None,
) -> None:
    """Add the support polygon of feet and tail in a sample, and the centre of mass with its plumb line, to a scene.

    Args:
        scene: Updated scene of the frame; geoms beyond its capacity are omitted.
        recording: Recording with the sensors `foot_position` and `foot_force`.
        sample: Index of the sample.
        com: Centre of mass in the world [m].
        tail: Tip of the tail [m], which is used if the recording contains its force.
    """

    def add(
        colour: tuple[float, ...], radius: float, begin: np.ndarray, end: np.ndarray | None = None
    ) -> None:
        """A ball, or a bar from one point to another."""
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        scene.ngeom += 1
        kind = mujoco.mjtGeom.mjGEOM_SPHERE if end is None else mujoco.mjtGeom.mjGEOM_CAPSULE
        rgba = np.asarray(colour, np.float32)
        mujoco.mjv_initGeom(geom, kind, np.full(3, radius), begin, np.eye(3).ravel(), rgba)
        geom.emission = 0.5
        if end is not None:
            mujoco.mjv_connector(geom, kind, radius, begin, end)

    points = np.asarray(recording.sensors["foot_position"][sample]).reshape(4, 3)
    force = np.asarray(recording.sensors["foot_force"][sample])
    if tail is not None and "tail_force" in recording.sensors:
        points = np.concatenate([points, tail[None]])
        force = np.append(force, recording.sensors["tail_force"][sample])
    corners = support_polygon(points[:, :2], force > STANCE_NEWTONS)
    colour = INSIDE_COLOUR if is_inside(corners, com[:2]) else OUTSIDE_COLOUR
    corners = np.column_stack([corners, np.full(len(corners), _HEIGHT_METRES)])
    following = np.roll(corners, -1, axis=0) if len(corners) > 2 else corners[1:]
    for begin, end in zip(corners, following, strict=False):
        add(_EDGE_COLOUR, _LINE_METRES, begin, end)
    for corner in corners:
        add(_EDGE_COLOUR, 0.6 * _POINT_METRES, corner)
    below = np.array([com[0], com[1], _HEIGHT_METRES])
    add(colour, _LINE_METRES, below, com)
    add(colour, _POINT_METRES, below)
    add(colour, _POINT_METRES, com)
