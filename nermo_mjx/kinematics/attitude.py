"""Attitude of a body as three angles, and directions in its frame.

Roll, pitch and yaw are right-handed rotations about the robot's own axes: roll about y (back; positive leans left),
pitch about x (left; positive is nose down), yaw about z (positive turns left), with R = Rz(yaw) Rx(pitch) Ry(roll).
"""

from __future__ import annotations

import jax.numpy as jnp

from nermo_mjx.shapes import Quaternion, Scalars, Spatial


def attitude(quaternion: Quaternion) -> Spatial:
    """(roll, pitch, yaw) of a unit quaternion (w, x, y, z) [rad]; derivatives are finite except upside down."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    r01, r11 = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z)
    r20, r21, r22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    level = jnp.sqrt(r20**2 + r22**2 + 1e-12)
    return jnp.stack([jnp.arctan2(-r20, r22), jnp.arctan2(r21, level), jnp.arctan2(-r01, r11)], axis=-1)


def uprightness(quaternion: Quaternion) -> Scalars:
    """Cosine of the torso's tilt: 1 upright, 0 on its side."""
    return 1 - 2 * (quaternion[..., 1] ** 2 + quaternion[..., 2] ** 2)


def turned_back(quaternion: Quaternion, direction: Spatial) -> Spatial:
    """A direction of the world in the frame of a body with this attitude, R^T d."""
    w, axis = quaternion[..., :1], -quaternion[..., 1:]
    return direction + 2.0 * jnp.cross(axis, jnp.cross(axis, direction) + w * direction)
