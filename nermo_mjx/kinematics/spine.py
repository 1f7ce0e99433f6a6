"""The spine: from spine base to hip as a modified DH chain, and the servo whose tendons bend it.

Positive theta_v and positive servo angle bend the robot to the left, so the lateral DH angles are -theta_v
(`robot/parameters.py`). Erratum to (5.23): the third entry of the third row is +cos(alpha).
"""

from __future__ import annotations

import functools
import math
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from nermo_mjx.kinematics.leg import bracketed_root
from nermo_mjx.robot.geometry import SEGMENT_ROWS, Geometry
from nermo_mjx.robot.parameters import SPINE_GEOMETRY
from nermo_mjx.shapes import Array, Scalars

#: Angles saturate here, so that the sine of any float is finite [rad].
_LARGEST_ANGLE_RAD: Final = 1e6
#: The published length of a segment [m], at which the links of the table are folded.
_SEGMENT_LENGTH: Final = 2 * SPINE_GEOMETRY.dh[SEGMENT_ROWS[0]][1]


def transform(
    theta_v: ArrayLike, geometry: Geometry, vertical: ArrayLike | None = None
) -> Float[Array, "*batch 4 4"]:
    """Homogeneous transform from spine base to spine end (the hip's frame), Table 5.3 and (5.23).

    Args:
        theta_v: angle of each of the four lateral joints [rad], any shape; positive bends to the left.
        geometry: `spine.segment`, of a shape that broadcasts with the angles.
        vertical: angles [rad] of the vertical joints (Nermo 4.1), shape (..., 4), added to those fused into Nermo-Lite;
            positive lifts the hip.
    """
    if isinstance(theta_v, float) and vertical is None:
        return _stretched(*_fixed_transform(theta_v), geometry, jnp.result_type(float))
    theta_v = _floating(theta_v)
    dtype = theta_v.dtype
    angles = dict.fromkeys(SPINE_GEOMETRY.lateral_joints, -theta_v)
    if vertical is not None:
        vertical = _floating(vertical)
        dtype = jnp.promote_types(dtype, vertical.dtype)
        angles |= {row: vertical[..., i] for i, row in enumerate(SPINE_GEOMETRY.vertical_joints)}

    pose: Array | None = None
    for row, link, stretch in _links(tuple(sorted(angles))):
        fixed = _stretched(link, stretch, geometry, dtype)
        rotation = fixed if row is None else _matmul(fixed, _about_z(angles[row].astype(dtype)))
        pose = rotation if pose is None else _matmul(pose, rotation)
    assert pose is not None
    return pose


def _stretched(pose: np.ndarray, stretch: np.ndarray, geometry: Geometry, dtype: Any) -> Array:
    """A pose that is linear in a segment's length: the published one, and its slope per metre."""
    longer = jnp.asarray(geometry.spine.segment, dtype) - jnp.asarray(_SEGMENT_LENGTH, dtype)
    return jnp.asarray(pose, dtype) + longer[..., None, None] * jnp.asarray(stretch, dtype)


@functools.cache
def _links(moving: tuple[int, ...]) -> list[tuple[int | None, np.ndarray, np.ndarray]]:
    """Constant links up to each moving row, and behind the last one; see `_stretched` for the two matrices.

    They are folded in numpy, in double precision.
    """
    links: list[tuple[int | None, np.ndarray, np.ndarray]] = []
    fixed, stretch = np.eye(4), np.zeros((4, 4))
    for row, link in enumerate(SPINE_GEOMETRY.dh):
        fixed, stretch = _extended(fixed, stretch, row, _link(*link))
        if row in moving:
            links.append((row, fixed, stretch))
            fixed, stretch = np.eye(4), np.zeros((4, 4))
    return [*links, (None, fixed, stretch)]


def _extended(
    fixed: np.ndarray, stretch: np.ndarray, row: int, link: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A pose and its slope by the segment's length, after one more row of the table."""
    slope = np.zeros((4, 4))
    slope[0, 3] = 0.5 * (row in SEGMENT_ROWS)
    return fixed @ link, stretch @ link + fixed @ slope


def yaw(theta_v: ArrayLike) -> Scalars:
    """Yaw of the torso relative to the hip [rad]; positive to the left.

    The lateral joints' axes are tilted by up to 25 degrees, so four joints turn it by 3.81 theta_v, not by the 4
    theta_v of the text (erratum 17). A linear approximation: at 0.1 rad per joint it is 0.2 % too large.
    """
    return _yaw_per_joint_angle() * _floating(theta_v)


@functools.cache
def _yaw_per_joint_angle() -> float:
    """Sum of the vertical components of the lateral joints' axes, for the straight spine."""
    pose, total = np.eye(4), 0.0
    for row, link in enumerate(SPINE_GEOMETRY.dh):
        pose = pose @ _link(*link)
        total += float(pose[2, 2]) * (row in SPINE_GEOMETRY.lateral_joints)
    return total


def max_joint_angle() -> float:
    """Largest theta_v that the servo can command [rad], where the inner tendon segment's length becomes zero."""
    return 2 * math.atan(SPINE_GEOMETRY.segment_length / (2 * SPINE_GEOMETRY.segment_offset))


def joint_angle(servo: ArrayLike, geometry: Geometry) -> Scalars:
    """Angle theta_v [rad] of each lateral joint at a spine servo angle [rad], (5.26)-(5.29).

    The published form, theta_v = 2 alpha_v - pi + arccos(1 - l^2 / (2 R^2)) with l = l_v + r_sp q / 4, holds for the
    side whose tendon lengthens. It is used for positive angles and made odd, so that left and right mirror each other
    (the two antagonists differ by 1 % at 0.4 rad). Saturates at `max_joint_angle`. It depends on the geometry through
    r_sp.
    """
    servo = _floating(servo)
    radius, straight = _chord()
    size, sign = _magnitude(servo)
    size = jnp.minimum(size, _servo_magnitude(jnp.asarray(max_joint_angle(), size.dtype), geometry))
    segment = (
        SPINE_GEOMETRY.segment_length
        + jnp.asarray(geometry.spine.pulley_radius, size.dtype) * size / 4
    )
    return sign * (2 * jnp.arcsin(segment / (2 * radius)) - straight)


def servo_angle(theta_v: ArrayLike, geometry: Geometry) -> Scalars:
    """Spine servo angle [rad] that bends each lateral joint by theta_v [rad]: closed form of (5.30), see `joint_angle`.

    l = 2 R sin((theta_v + pi - 2 alpha_v) / 2) and q_sp = 4 (l - l_v) / r_sp. Saturates at `max_joint_angle`.
    """
    theta_v = _floating(theta_v)
    size, sign = _magnitude(theta_v)
    return sign * _servo_magnitude(jnp.minimum(size, max_joint_angle()), geometry)


def angle_for_displacement(displacement: ArrayLike, geometry: Geometry) -> Scalars:
    """Joint angle theta_v [rad] that moves the spine end sideways by `displacement` [m], positive to the left.

    Inverts x of `transform`, which increases with theta_v over the whole range; saturates at `max_joint_angle`.
    """
    displacement = _floating(displacement)
    limit = jnp.asarray(max_joint_angle(), displacement.dtype)

    def sideways(angle: Array) -> Array:
        return transform(angle, geometry)[..., 0, 3]

    target = jnp.clip(displacement, sideways(-limit), sideways(limit))
    return bracketed_root(lambda angle: sideways(angle) - target, -limit, limit, slope_floor=1e-4)


def _floating(value: ArrayLike) -> Array:
    value = jnp.asarray(value)
    return value.astype(jnp.result_type(float, value.dtype))


def _chord() -> tuple[float, float]:
    """R [m], from a joint to where its tendon segment ends, and the angle pi - 2 alpha_v that a straight one spans."""
    radius = math.hypot(SPINE_GEOMETRY.segment_length / 2, SPINE_GEOMETRY.segment_offset)
    return radius, math.pi - 2 * math.atan(
        2 * SPINE_GEOMETRY.segment_offset / SPINE_GEOMETRY.segment_length
    )


def _servo_magnitude(theta_v: Array, geometry: Geometry) -> Array:
    radius, straight = _chord()
    segment = 2 * radius * jnp.sin((theta_v + straight) / 2)
    return (
        4
        * (segment - SPINE_GEOMETRY.segment_length)
        / jnp.asarray(geometry.spine.pulley_radius, segment.dtype)
    )


def _magnitude(value: Array) -> tuple[Array, Array]:
    """(|value|, sign), with slope +1 of their product through zero, where `abs` would have none."""
    positive = value >= 0
    return jnp.where(positive, value, -value), jnp.where(positive, 1.0, -1.0).astype(value.dtype)


def _link(alpha: float, a: float, theta: float, d: float) -> np.ndarray:
    """One modified DH link (5.23)."""
    (cos, sin), (cos_a, sin_a) = ((math.cos(angle), math.sin(angle)) for angle in (theta, alpha))
    return np.array(
        [
            [cos, -sin, 0.0, a],
            [sin * cos_a, cos * cos_a, -sin_a, -sin_a * d],
            [sin * sin_a, cos * sin_a, cos_a, cos_a * d],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


@functools.cache
def _fixed_transform(theta_v: float) -> tuple[np.ndarray, np.ndarray]:
    """`transform` of a constant, and its slope by the segment's length: adds almost nothing to tracing and
    compilation."""
    pose, stretch = np.eye(4), np.zeros((4, 4))
    for row, link in enumerate(SPINE_GEOMETRY.dh):
        pose, stretch = _extended(pose, stretch, row, _link(*link))
        if row in SPINE_GEOMETRY.lateral_joints:
            turned = _link(0.0, 0.0, -theta_v, 0.0)
            pose, stretch = pose @ turned, stretch @ turned
    return pose, stretch


def _matmul(left: Array, right: Array) -> Array:
    """Product of small matrices, written out: faster than a dot product, and in full precision on accelerators."""
    return jnp.sum(left[..., :, :, None] * right[..., None, :, :], axis=-2)


def _about_z(angle: Array) -> Float[Array, "*batch 4 4"]:
    angle = jnp.clip(angle, -_LARGEST_ANGLE_RAD, _LARGEST_ANGLE_RAD)
    cos, sin, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
    rows = (
        [cos, -sin, zero, zero],
        [sin, cos, zero, zero],
        [zero, zero, zero + 1, zero],
        [zero, zero, zero, zero + 1],
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
