"""The support polygon on the ground, and the centre of mass above it, drawn into MuJoCo's scene."""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError

from nermo_mjx.recording import Recording
from nermo_mjx.view.standing import STANDING

#: Thickness of the lines, radius of the points, and their height above the ground [m].
_LINE, _POINT, _ABOVE = 0.0006, 0.0024, 0.0008
#: Where the centre of mass is inside, and where it is not (Okabe and Ito); of the polygon.
INSIDE: Final = (0.0, 0.62, 0.45, 1.0)
OUTSIDE: Final = (0.84, 0.37, 0.0, 1.0)
_EDGE: Final = (0.0, 0.45, 0.70, 1.0)


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
        scene: of the frame, updated already.
        recording: with sensors `foot_position` and `foot_force`.
        sample: of the recording.
        com: centre of mass in the world [m].
        tail: tip of the tail [m], included if the recording has its force.
    """
    points = np.asarray(recording.sensors["foot_position"][sample]).reshape(4, 3)
    force = np.asarray(recording.sensors["foot_force"][sample])
    if tail is not None and "tail_force" in recording.sensors:
        points = np.concatenate([points, tail[None]])
        force = np.append(force, recording.sensors["tail_force"][sample])
    corners = support_polygon(points[:, :2], force > STANDING)
    colour = INSIDE if is_inside(corners, com[:2]) else OUTSIDE
    below = np.array([com[0], com[1], _ABOVE])
    for i in range(len(corners) if len(corners) > 2 else len(corners) - 1):
        begin, end = (np.append(corners[j % len(corners)], _ABOVE) for j in (i, i + 1))
        _connect(scene, begin, end, _EDGE)
    for corner in corners:
        _ball(scene, np.append(corner, _ABOVE), 0.6 * _POINT, _EDGE)
    _connect(scene, below, com, colour)
    _ball(scene, below, _POINT, colour)
    _ball(scene, com, _POINT, colour)


def _ball(scene: mujoco.MjvScene, centre: np.ndarray, radius: float, colour: tuple[float, ...]) -> None:
    geom = _new(scene)
    if geom is not None:
        size = np.full(3, radius)
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, centre, np.eye(3).ravel(), np.asarray(colour, np.float32)
        )
        geom.emission = 0.5


def _connect(scene: mujoco.MjvScene, begin: np.ndarray, end: np.ndarray, colour: tuple[float, ...]) -> None:
    geom = _new(scene)
    if geom is not None:
        blank = np.zeros(3), np.zeros(3), np.zeros(9)
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, *blank, np.asarray(colour, np.float32))
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, _LINE, begin, end)
        geom.emission = 0.5


def _new(scene: mujoco.MjvScene) -> Any:
    """The next geom of the scene, or None if the scene is full."""
    if scene.ngeom >= scene.maxgeom:
        return None
    scene.ngeom += 1
    return scene.geoms[scene.ngeom - 1]
