"""Turning and mirroring. The right half of the robot is mirrored from the left: there is one file per pair of limbs."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np


def mirror(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Mirror a model at its y-z plane (x -> -x), with its meshes, in place; returns it.

    Joints keep their axes, which must lie along x: both sides then share one sign convention (positive swings
    backward), and a hinge along x is its own mirror image.

    Raises:
        ValueError: a joint whose axis is not along x.
    """
    for joint in spec.joints:
        if np.any(np.abs(joint.axis[1:]) > 1e-12):
            raise ValueError(f"joint {joint.name} has axis {joint.axis}: a mirrored limb needs hinges along x.")
        joint.pos = _point(joint.pos)
    for element in (*spec.bodies[1:], *spec.geoms, *spec.sites, *spec.frames):
        element.pos = _point(element.pos)
        element.quat = _rotation(element.quat)
        euler = element.alt.euler
        if not np.isnan(euler[0]):
            element.alt.euler = np.array([euler[0], -euler[1], -euler[2]])
    for mesh in spec.meshes:
        mesh.scale = _point(mesh.scale)
    for geom in spec.geoms:
        if not np.isnan(geom.fromto[0]):
            geom.fromto = np.concatenate([_point(geom.fromto[:3]), _point(geom.fromto[3:])])
    return spec


def turn(element: Any, x: float, y: float, z: float) -> None:
    """Give an element of a specification its orientation: Euler angles about the axes x, y, z that turn along,
    in the unit of its file."""
    element.alt.type = mujoco.mjtOrientation.mjORIENTATION_EULER
    element.alt.euler = np.array([x, y, z])


def _point(pos: np.ndarray) -> np.ndarray:
    return np.array([-pos[0], pos[1], pos[2]])


def _rotation(quat: np.ndarray) -> np.ndarray:
    return np.array([quat[0], quat[1], -quat[2], -quat[3]])
