"""Effect of the spine on the body: the positions of the hips, the diagonals, and the centre of mass.

Positions are relative to the spine base in the torso's frame [m]; theta_v is the angle of each lateral joint [rad], of
any shape, positive to the left, and `vertical` that of each vertical joint of Nermo 4.1, where positive lifts the hip;
None on Nermo-Lite. Left comes before right.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from nermo_mjx.kinematics import spine
from nermo_mjx.robot.geometry import Geometry, Hip, Shoulder
from nermo_mjx.robot.mass_model import MassModel
from nermo_mjx.shapes import Array, Planar, Scalars, Spatial

_MIRROR = np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]])


def shoulders(geometry: Geometry) -> Float[Array, "*batch 2 3"]:
    """Left and right shoulder axis; they do not move with the spine (Table A.5, with its erratum)."""
    return _both_sides(geometry.shoulder)


def hips(theta_v: ArrayLike, geometry: Geometry, vertical: ArrayLike | None = None) -> Float[Array, "*batch 2 3"]:
    """Left and right hip axis."""
    return from_hip_frame(theta_v, _both_sides(geometry.hip), geometry, vertical)


def from_hip_frame(
    theta_v: ArrayLike, points: ArrayLike, geometry: Geometry, vertical: ArrayLike | None = None
) -> Float[Array, "*batch n 3"]:
    """Points (..., n, 3) of the hip's frame, from the spine end, seen from the spine base."""
    all_four = None if vertical is None else jnp.repeat(jnp.asarray(vertical)[..., None], 4, axis=-1)
    pose = spine.transform(theta_v, geometry, all_four)
    points = jnp.asarray(points, pose.dtype)
    turned = jnp.sum(pose[..., None, :3, :3] * points[..., None, :], axis=-1)
    return turned + pose[..., None, :3, 3]


def feet_positions(
    theta_v: ArrayLike, feet: ArrayLike, geometry: Geometry, vertical: ArrayLike | None = None
) -> Float[Array, "*batch 4 3"]:
    """The feet, given as (y, z) from their own axis, shape (..., 4, 2); rear feet turn with the hip's frame."""
    feet = jnp.asarray(feet)
    placed = jnp.stack([jnp.zeros_like(feet[..., 0]), feet[..., 0], feet[..., 1]], axis=-1)
    rear = from_hip_frame(theta_v, _both_sides(geometry.hip) + placed[..., 2:, :], geometry, vertical)
    front = jnp.broadcast_to(shoulders(geometry) + placed[..., :2, :], rear.shape)
    return jnp.concatenate([front, rear], axis=-2)


def hip_height_offset(theta_v: ArrayLike, geometry: Geometry, feet: ArrayLike | None = None) -> Planar:
    """How much higher each hip is than with a straight spine (5.31), or each rear foot, which turns with the hip.

    The published code's function returns the rise, which is subtracted from the height of the rear foot: a foot that is
    lowered by it keeps the hip level. "Added", as its docstring says, doubles the roll (erratum 16). It takes the feet,
    which are about 0.4 mm lower than the hips on both sides, where (5.31) takes the hips.

    Args:
        theta_v: of each lateral joint [rad].
        geometry: of the robot.
        feet: (y, z) of the four feet from their own axis, shape (..., 4, 2) [m]; None for the hips.
    """
    if feet is not None:
        bent, straight = (feet_positions(bend, feet, geometry) for bend in (theta_v, jnp.zeros_like(theta_v)))
        return bent[..., 2:, 2] - straight[..., 2:, 2]
    return hips(theta_v, geometry)[..., 2] - hips(0.0, geometry)[..., 2]


def rear_foot_rise(theta_v: ArrayLike, feet: ArrayLike, vertical: ArrayLike, geometry: Geometry) -> Planar:
    """Rise of each rear foot due to the vertical joints, which lift the hip and turn the legs with it.

    Args:
        theta_v: of each lateral joint [rad].
        feet: (y, z) of the four feet from their own axis, shape (..., 4, 2) [m].
        vertical: of each vertical joint [rad].
        geometry: of the robot.
    """
    bent, straight = (feet_positions(theta_v, feet, geometry, bend) for bend in (vertical, None))
    return bent[..., 2:, 2] - straight[..., 2:, 2]


def diagonals(theta_v: ArrayLike, geometry: Geometry) -> Planar:
    """Distance from shoulder to opposite hip, front left to rear right and front right to rear left (5.32).

    Monotonic over the usable range: bending left extends the first and compresses the second.
    """
    return jnp.linalg.norm(hips(theta_v, geometry)[..., ::-1, :] - shoulders(geometry), axis=-1)


def stride_gain(theta_v: ArrayLike, geometry: Geometry) -> Scalars:
    """Stride gained by swinging the spine between -theta_v and theta_v [m] (5.33): 0.015 m at 0.1 rad per joint.

    Seen from the heading, which bisects the bend, torso and hip yaw by half the bend, in opposite senses. While a
    diagonal pair is on the ground, the bend goes from one extreme to the other, and shoulder and hip of that pair are
    carried backward by 2 x sin(bend / 2) each, x being half the distance from left to right; the body gains the mean of
    the two. Negative where theta_v compresses the standing pair. The gain is monotonic, so that the maximum of (5.33)
    lies at the limit of theta_v (erratum 7).
    """
    hip = hips(theta_v, geometry)
    across, along = jnp.moveaxis((hip[..., 0, :] - hip[..., 1, :])[..., :2] / 2, -1, 0)
    bend = jnp.arctan2(-along, across)
    return (_constant(geometry.shoulder.x) + jnp.hypot(across, along)) * jnp.sin(bend / 2)


def centre_of_mass(
    masses: MassModel, theta_v: ArrayLike, geometry: Geometry, vertical: ArrayLike | None = None
) -> Spatial:
    """Centre of mass of front and rear, joined by a massless spine (5.34). Leaves of `masses` may be batched."""
    masses = jax.tree.map(_constant, masses)
    front_mass, rear_mass = masses.front_mass[..., None], masses.rear_mass[..., None]
    rear = from_hip_frame(theta_v, masses.rear_com[..., None, :], geometry, vertical)[..., 0, :]
    return (front_mass * masses.front_com + rear_mass * rear) / (front_mass + rear_mass)


def _both_sides(axis: Shoulder | Hip) -> Float[Array, "*batch 2 3"]:
    """A left axis and its mirror image."""
    left = jnp.stack(jnp.broadcast_arrays(*(_constant(each) for each in (axis.x, axis.y, axis.z))), axis=-1)
    return _constant(_MIRROR) * left[..., None, :]


def _constant(value: ArrayLike) -> Array:
    """Arrays unchanged, numbers in the current precision: JAX caches numpy constants across a change of precision."""
    return value if isinstance(value, jax.Array) else jnp.asarray(value, jnp.result_type(float))
