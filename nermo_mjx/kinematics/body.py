"""Effect of the spine on the body: the positions of the hips, the diagonals, and the centre of mass.

Positions are relative to the spine base in the torso's frame [m]; theta_v is the angle of each lateral joint [rad], of
any shape, positive to the left, and `vertical` that of each vertical joint of Nermo 4.1, where positive lifts the hip;
None on Nermo-Lite. Left comes before right.
"""

from __future__ import annotations

from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from nermo_mjx.kinematics import spine
from nermo_mjx.kinematics.leg import bracketed_root
from nermo_mjx.robot.geometry import Geometry, Hip, Shoulder
from nermo_mjx.robot.masses import MassModel
from nermo_mjx.robot.parameters import SPINE_GEOMETRY
from nermo_mjx.shapes import Array, Planar, Quaternion, Scalars, Spatial, TruthPerLimb

_MIRROR = np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]])


def shoulders(geometry: Geometry) -> Float[Array, "*batch 2 3"]:
    """Left and right shoulder axis; they do not move with the spine (Table A.5, with its erratum)."""
    return _both_sides(geometry.shoulder)


def hips(
    theta_v: ArrayLike, geometry: Geometry, vertical: ArrayLike | None = None
) -> Float[Array, "*batch 2 3"]:
    """Left and right hip axis."""
    return from_hip_frame(theta_v, _both_sides(geometry.hip), geometry, vertical)


def from_hip_frame(
    theta_v: ArrayLike, points: ArrayLike, geometry: Geometry, vertical: ArrayLike | None = None
) -> Float[Array, "*batch n 3"]:
    """Points (..., n, 3) of the hip's frame, from the spine end, seen from the spine base."""
    all_four = (
        None if vertical is None else jnp.repeat(jnp.asarray(vertical)[..., None], 4, axis=-1)
    )
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
    rear = from_hip_frame(
        theta_v, _both_sides(geometry.hip) + placed[..., 2:, :], geometry, vertical
    )
    front = jnp.broadcast_to(shoulders(geometry) + placed[..., :2, :], rear.shape)
    return jnp.concatenate([front, rear], axis=-2)


def hip_height_offset(
    theta_v: ArrayLike, geometry: Geometry, feet: ArrayLike | None = None
) -> Planar:
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
        bent, straight = (
            feet_positions(bend, feet, geometry) for bend in (theta_v, jnp.zeros_like(theta_v))
        )
        return bent[..., 2:, 2] - straight[..., 2:, 2]
    return hips(theta_v, geometry)[..., 2] - hips(0.0, geometry)[..., 2]


def rear_foot_rise(
    theta_v: ArrayLike, feet: ArrayLike, vertical: ArrayLike, geometry: Geometry
) -> Planar:
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
    left_points = jnp.stack(
        jnp.broadcast_arrays(*(_constant(coordinate) for coordinate in (axis.x, axis.y, axis.z))),
        axis=-1,
    )
    return _constant(_MIRROR) * left_points[..., None, :]


def _constant(value: ArrayLike) -> Array:
    """Arrays unchanged, numbers in the current precision: JAX caches numpy constants across a change of precision."""
    return value if isinstance(value, jax.Array) else jnp.asarray(value, jnp.result_type(float))


# ---
# Balance by the spine: the joint angle that brings the centre of mass over the support of the stance feet (5.35).
#
# The balance line joins a supporting front foot and a supporting rear foot. Both the line and the centre of mass move
# when the spine bends, because the rear feet turn with the hip.


#: Longer than any leg [m]; feet farther out are moved in, so that all results are finite.
_LARGEST_REACH: Final = 1.0
#: Feet closer together than this [m] define no line.
_COINCIDENCE_DISTANCE: Final = 1e-6


def diagonal_distance(point: ArrayLike, front_foot: ArrayLike, rear_foot: ArrayLike) -> Scalars:
    """Signed distance [m] of a point from the line through two feet (5.35), all of shape (..., 2) = (x, y).

    d = (a x + b y + c) / sqrt(a^2 + b^2), a = f_y - r_y, b = r_x - f_x, c = f_x r_y - f_y r_x. Positive means right of
    the line, looking from the rear foot to the front foot. Erratum: (5.35) is printed with an absolute value, but the
    method needs the sign. Feet that coincide have no line and give 0.
    """
    point, front, rear = (jnp.asarray(xy) for xy in (point, front_foot, rear_foot))
    a, b = front[..., 1] - rear[..., 1], rear[..., 0] - front[..., 0]
    # Distances are taken from the rear foot instead of using c, which avoids cancellation.
    product = a * (point[..., 0] - rear[..., 0]) + b * (point[..., 1] - rear[..., 1])
    squared = a**2 + b**2
    distinct = squared > _COINCIDENCE_DISTANCE**2
    return jnp.where(distinct, product, 0.0) / jnp.sqrt(jnp.where(distinct, squared, 1.0))


def balance_angle(
    masses: MassModel,
    feet: ArrayLike,
    stance: ArrayLike,
    geometry: Geometry,
    lift: ArrayLike = 0.0,
    limit: ArrayLike = SPINE_GEOMETRY.max_joint_angle,
) -> Scalars:
    """Spine joint angle theta_v [rad], within +-limit, that balances the robot on its stance feet.

    With one front and one rear foot on the ground, d = 0 on their line. With three, d = lift on the supporting
    diagonal, measured towards the third foot. Where the limit does not allow that, the closer end of the range. In all
    other cases, with four feet or without a line from front to rear, 0.

    Args:
        masses: the robot's two-mass model.
        feet: (y, z) of each foot from its own axis [m], shape (..., 4, 2); rear feet turn with the hip's frame.
        stance: which feet are on the ground, shape (..., 4), bool or a number above 0.5.
        geometry: the robot's.
        lift: d_lift, the desired distance of the centre of mass inside the triangle [m]: 0 on the diagonal (dynamic),
            0.009 as published (static).
        limit: largest angle [rad].
    """
    front, rear, third, supported = _support(jnp.asarray(stance) > 0.5)
    feet = jnp.clip(jnp.asarray(feet), -_LARGEST_REACH, _LARGEST_REACH)
    front, rear, third = (foot[..., None].astype(feet.dtype) for foot in (front, rear, third))

    def line(theta_v: ArrayLike) -> tuple[Array, Array, Array]:
        ground = feet_positions(theta_v, feet, geometry)[..., :2]
        return ground, jnp.sum(front * ground, axis=-2), jnp.sum(rear * ground, axis=-2)

    def distance(theta_v: ArrayLike) -> Array:
        _, front_foot, rear_foot = line(theta_v)
        return diagonal_distance(
            centre_of_mass(masses, theta_v, geometry)[..., :2], front_foot, rear_foot
        )

    ground, front_foot, rear_foot = line(0.0)
    has_third = jnp.any(third > 0, axis=(-2, -1))
    side = jnp.sign(diagonal_distance(jnp.sum(third * ground, axis=-2), front_foot, rear_foot))
    limit = jnp.broadcast_to(jnp.asarray(limit, feet.dtype), supported.shape)
    ends = distance(jnp.stack([-limit, limit]))
    target = jnp.clip(
        jnp.where(has_third, side * lift, 0.0), jnp.min(ends, axis=0), jnp.max(ends, axis=0)
    )
    angle = bracketed_root(
        lambda theta_v: distance(theta_v) - target, -limit, limit, slope_floor=1e-3
    )
    return jnp.where(supported, angle, 0.0)


def _support(stance: TruthPerLimb) -> tuple[Array, Array, Array, Array]:
    """Masks (..., 4) of the line's front and rear foot and of the third foot, and whether there is a line.

    Two feet in stance at the same end of the body leave the choice to the other end, whose single foot selects the one
    diagonally opposite: with three feet, only one diagonal supports.
    """
    fronts, rears = stance[..., :2], stance[..., 2:]
    n_front = jnp.sum(fronts, axis=-1, keepdims=True)
    n_rear = jnp.sum(rears, axis=-1, keepdims=True)
    front_foot = jnp.where(n_front == 1, fronts, rears[..., ::-1] & (n_front == 2))
    rear_foot = jnp.where(n_rear == 1, rears, fronts[..., ::-1] & (n_rear == 2))
    zeros = jnp.zeros_like(fronts)
    front = jnp.concatenate([front_foot, zeros], axis=-1)
    rear = jnp.concatenate([zeros, rear_foot], axis=-1)
    n_feet = (n_front + n_rear)[..., 0]
    supported = (n_front[..., 0] >= 1) & (n_rear[..., 0] >= 1) & (n_feet < 4)
    return front, rear, stance & ~front & ~rear, supported


# ---
# Attitude of a body as three angles, and directions in its frame.
#
# Roll, pitch and yaw are right-handed rotations about the robot's own axes: roll about y (back; positive leans left),
# pitch about x (left; positive is nose down), yaw about z (positive turns left), with R = Rz(yaw) Rx(pitch) Ry(roll).


def attitude(quaternion: Quaternion) -> Spatial:
    """(roll, pitch, yaw) of a unit quaternion (w, x, y, z) [rad]; derivatives are finite except upside down."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    r01, r11 = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z)
    r20, r21, r22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    level = jnp.sqrt(r20**2 + r22**2 + 1e-12)
    return jnp.stack(
        [jnp.arctan2(-r20, r22), jnp.arctan2(r21, level), jnp.arctan2(-r01, r11)], axis=-1
    )


def uprightness(quaternion: Quaternion) -> Scalars:
    """Cosine of the torso's tilt: 1 upright, 0 on its side."""
    return 1 - 2 * (quaternion[..., 1] ** 2 + quaternion[..., 2] ** 2)


def turned_back(quaternion: Quaternion, direction: Spatial) -> Spatial:
    """A direction of the world in the frame of a body with this attitude, R^T d."""
    w, axis = quaternion[..., :1], -quaternion[..., 1:]
    return direction + 2.0 * jnp.cross(axis, jnp.cross(axis, direction) + w * direction)
