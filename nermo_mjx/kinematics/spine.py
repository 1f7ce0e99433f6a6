"""The spine: from spine base to hip as a modified DH chain, and the servo whose tendons bend it.

Positive theta_v and positive servo angle bend the robot to the left, so the lateral DH angles are -theta_v
(`robot/parameters.py`). Erratum to (5.23): the third entry of the third row is +cos(alpha).
"""

from __future__ import annotations

import functools
import math
from typing import Final

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from nermo_mjx.kinematics.root import bracketed_root
from nermo_mjx.robot.parameters import SPINE, SpineGeometry
from nermo_mjx.shapes import Array, Scalars

#: Angles saturate here, so that the sine of any float is finite [rad].
_LARGEST_ANGLE: Final = 1e6


def transform(
    theta_v: ArrayLike, vertical: ArrayLike | None = None, spine: SpineGeometry = SPINE
) -> Float[Array, "*batch 4 4"]:
    """Homogeneous transform from spine base to spine end (the hip's frame), Table 5.3 and (5.23).

    Args:
        theta_v: angle of each of the four lateral joints [rad], any shape; positive bends to the left.
        vertical: angles [rad] of the vertical joints (Nermo 4.1), shape (..., 4), added to those fused into Nermo-Lite;
            positive lifts the hip.
        spine: the spine's numbers (static).
    """
    if isinstance(theta_v, float) and vertical is None:
        return jnp.asarray(_fixed_transform(theta_v, spine), jnp.result_type(float))
    theta_v = _floating(theta_v)
    dtype = theta_v.dtype
    angles = dict.fromkeys(spine.lateral_joints, -theta_v)
    if vertical is not None:
        vertical = _floating(vertical)
        dtype = jnp.promote_types(dtype, vertical.dtype)
        angles |= {row: vertical[..., i] for i, row in enumerate(spine.vertical_joints)}

    # Constant links between moving joints are folded in numpy, in double precision.
    pose: Array | None = None
    fixed = np.eye(4)
    for row, link in enumerate(spine.dh):
        fixed = fixed @ _link(*link)
        if row in angles:
            moved = _matmul(jnp.asarray(fixed, dtype), _about_z(angles[row].astype(dtype)))
            pose = moved if pose is None else _matmul(pose, moved)
            fixed = np.eye(4)
    assert pose is not None
    return _matmul(pose, jnp.asarray(fixed, dtype))


def yaw(theta_v: ArrayLike, spine: SpineGeometry = SPINE) -> Scalars:
    """How far the torso is turned against the hip, seen from above [rad]; positive to the left.

    The lateral joints' axes are tilted by up to 25 degrees, so that four joints turn it by 3.81 theta_v, and not by the
    4 theta_v of the text (erratum 17). Linear: at 0.1 rad a joint 0.2 % too large.
    """
    return _yaw_per_joint_angle(spine) * _floating(theta_v)


@functools.cache
def _yaw_per_joint_angle(spine: SpineGeometry) -> float:
    """Sum of the vertical parts of the lateral joints' axes, in the straight spine."""
    pose, total = np.eye(4), 0.0
    for row, link in enumerate(spine.dh):
        pose = pose @ _link(*link)
        total += float(pose[2, 2]) * (row in spine.lateral_joints)
    return total


def max_joint_angle(spine: SpineGeometry = SPINE) -> float:
    """Largest theta_v that the servo can ask for [rad]: there the inner tendon segment has no length left."""
    return 2 * math.atan(spine.segment_length / (2 * spine.segment_offset))


def joint_angle(servo: ArrayLike, spine: SpineGeometry = SPINE) -> Scalars:
    """Angle theta_v [rad] of each lateral joint at a spine servo angle [rad], (5.26)-(5.29).

    The published form, theta_v = 2 alpha_v - pi + arccos(1 - l^2 / (2 R^2)) with l = l_v + r_sp q / 4, holds for the
    side whose tendon lengthens. It is used for positive angles and made odd, so that left and right mirror each other
    (the two antagonists differ by 1 % at 0.4 rad). Saturates at `max_joint_angle`.
    """
    servo = _floating(servo)
    radius, straight = _chord(spine)
    size, sign = _magnitude(servo)
    size = jnp.minimum(size, _servo_magnitude(max_joint_angle(spine), spine))
    segment = spine.segment_length + spine.pulley_radius * size / 4
    return sign * (2 * jnp.arcsin(segment / (2 * radius)) - straight)


def servo_angle(theta_v: ArrayLike, spine: SpineGeometry = SPINE) -> Scalars:
    """Spine servo angle [rad] that bends each lateral joint by theta_v [rad]: closed form of (5.30), see `joint_angle`.

    l = 2 R sin((theta_v + pi - 2 alpha_v) / 2) and q_sp = 4 (l - l_v) / r_sp. Saturates at `max_joint_angle`.
    """
    theta_v = _floating(theta_v)
    size, sign = _magnitude(theta_v)
    return sign * _servo_magnitude(jnp.minimum(size, max_joint_angle(spine)), spine)


def angle_for_displacement(displacement: ArrayLike, spine: SpineGeometry = SPINE) -> Scalars:
    """Joint angle theta_v [rad] that moves the spine end sideways by `displacement` [m], positive to the left.

    Inverts x of `transform`, which rises with theta_v over the whole range; saturates at `max_joint_angle`.
    """
    displacement = _floating(displacement)
    limit = jnp.asarray(max_joint_angle(spine), displacement.dtype)

    def sideways(angle: Array) -> Array:
        return transform(angle, spine=spine)[..., 0, 3]

    wanted = jnp.clip(displacement, sideways(-limit), sideways(limit))
    return bracketed_root(lambda angle: sideways(angle) - wanted, -limit, limit, slope_floor=1e-4)


def _floating(value: ArrayLike) -> Array:
    value = jnp.asarray(value)
    return value.astype(jnp.result_type(float, value.dtype))


def _chord(spine: SpineGeometry) -> tuple[float, float]:
    """R [m], from a joint to where its tendon segment ends, and the angle pi - 2 alpha_v that a straight one spans."""
    radius = math.hypot(spine.segment_length / 2, spine.segment_offset)
    return radius, math.pi - 2 * math.atan(2 * spine.segment_offset / spine.segment_length)


def _servo_magnitude(theta_v: ArrayLike, spine: SpineGeometry) -> Array:
    radius, straight = _chord(spine)
    segment = 2 * radius * jnp.sin((theta_v + straight) / 2)
    return 4 * (segment - spine.segment_length) / spine.pulley_radius


def _magnitude(value: Array) -> tuple[Array, Array]:
    """(|value|, sign), with slope +1 of their product through zero, where `abs` would have none."""
    positive = value >= 0
    return jnp.where(positive, value, -value), jnp.where(positive, 1.0, -1.0).astype(value.dtype)


def _link(alpha: float, a: float, theta: float, d: float) -> np.ndarray:
    """One modified DH link (5.23)."""
    (cos, sin), (cos_a, sin_a) = ((math.cos(angle), math.sin(angle)) for angle in (theta, alpha))
    return np.array([
        [cos, -sin, 0.0, a],
        [sin * cos_a, cos * cos_a, -sin_a, -sin_a * d],
        [sin * sin_a, cos * sin_a, cos_a, cos_a * d],
        [0.0, 0.0, 0.0, 1.0],
    ])  # fmt: skip


@functools.cache
def _fixed_transform(theta_v: float, spine: SpineGeometry) -> np.ndarray:
    """`transform` of a constant: nothing to trace, or to compile for a few numbers."""
    pose = np.eye(4)
    for row, link in enumerate(spine.dh):
        pose = pose @ _link(*link)
        if row in spine.lateral_joints:
            pose = pose @ _link(0.0, 0.0, -theta_v, 0.0)
    return pose


def _matmul(left: Array, right: Array) -> Array:
    """Product of small matrices, written out: faster than a dot, and in full precision on accelerators too."""
    return jnp.sum(left[..., :, :, None] * right[..., None, :, :], axis=-2)


def _about_z(angle: Array) -> Float[Array, "*batch 4 4"]:
    angle = jnp.clip(angle, -_LARGEST_ANGLE, _LARGEST_ANGLE)
    cos, sin, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
    rows = ([cos, -sin, zero, zero], [sin, cos, zero, zero], [zero, zero, zero + 1, zero], [zero, zero, zero, zero + 1])
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
