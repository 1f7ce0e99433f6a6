"""Rotations and spatial vectors, in arrays of any leading shape.

A spatial vector (..., 6) has its angular part first. A spatial inertia (..., 10) is xx, yy, zz, xy, xz, yz of the
moments about a point, the mass times the offset of its centre from there, and the mass.
`solve_definite` solves a linear system with a derivative that costs no more than the solution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Float

from nermo_mjx.shapes import Array

Vector = Float[Array, "*#n 3"]
Quaternion = Float[Array, "*#n 4"]
Matrix = Float[Array, "*#n 3 3"]
Motion = Float[Array, "*#n 6"]
Inertia = Float[Array, "*#n 10"]

# 32-bit indices: JAX caches its conversion of an array, and would keep the precision of the first use in any mode.
_NEXT_AXIS: Final = np.array([1, 2, 0], np.int32)
_LAST_AXIS: Final = np.array([2, 0, 1], np.int32)
#: Rows and columns of the moments in an inertia, and the index of the moment of each entry of the matrix.
_ROW: Final = np.array([0, 1, 2, 0, 0, 1], np.int32)
_COLUMN: Final = np.array([0, 1, 2, 1, 2, 2], np.int32)
_MOMENT: Final = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]], np.int32)
#: (q p)_c is the sum over i of q_i p_j, j = _FACTOR_INDEX[i, c], with the sign _SIGN[i, c].
_FACTOR_INDEX: Final = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]], np.int32)
_SIGN: Final = np.array([[1, 1, 1, 1], [-1, 1, -1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1]])
#: Components and signs of a vector in the matrix of its cross product.
_SKEW: Final = (
    np.array([[0, 2, 1], [2, 0, 0], [1, 0, 0]], np.int32),
    np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]),
)


def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return a[..., _NEXT_AXIS] * b[..., _LAST_AXIS] - a[..., _LAST_AXIS] * b[..., _NEXT_AXIS]


def product(q: Quaternion, p: Quaternion) -> Quaternion:
    """The quaternion q p, which turns by p and then by q."""
    return sum(
        q[..., i, None] * p[..., _FACTOR_INDEX[i]] * _SIGN[i].astype(p.dtype) for i in range(4)
    )


def rotate(vector: Vector, q: Quaternion) -> Vector:
    """A vector turned by a unit quaternion."""
    w, u = q[..., :1], q[..., 1:]
    along, square = jnp.sum(u * vector, -1, keepdims=True), jnp.sum(u * u, -1, keepdims=True)
    return 2.0 * along * u + (w * w - square) * vector + 2.0 * w * cross(u, vector)


def matrix(q: Quaternion) -> Matrix:
    """The rotation matrix of a unit quaternion."""
    w, u = q[..., :1, None], q[..., 1:]
    component, sign = _SKEW
    outer, square = u[..., :, None] * u[..., None, :], jnp.sum(u * u, -1)[..., None, None]
    diagonal = (w * w - square) * np.eye(3, dtype=u.dtype)
    return 2.0 * outer + diagonal + 2.0 * w * u[..., component] * sign.astype(u.dtype)


def normalized(q: Quaternion) -> Quaternion:
    """The normalised quaternion; zero, which has no direction, becomes the identity."""
    square = jnp.sum(q * q, -1, keepdims=True)
    is_zero = square <= 0.0
    none = np.array([1.0, 0.0, 0.0, 0.0], q.dtype)
    return jnp.where(is_zero, none, q / jnp.sqrt(jnp.where(is_zero, 1.0, square)))


def rotation_vector(q: Quaternion) -> Vector:
    """The rotation vector of a unit quaternion, of at most half a turn [rad]; it has a derivative at the identity."""
    w, u = q[..., :1], q[..., 1:]
    square = jnp.sum(u * u, -1, keepdims=True)
    small = square < 1e-8
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    angle = 2.0 * jnp.arctan2(sine, jnp.where(small, 1.0, w))
    angle = jnp.where(angle > jnp.pi, angle - 2.0 * jnp.pi, angle)
    near = jnp.where(small, w, 1.0)
    return u * jnp.where(small, 2.0 / near * (1.0 - square / (3.0 * near * near)), angle / sine)


def turn_between(q: Quaternion, p: Quaternion) -> Vector:
    """The rotation vector from one orientation to another, in the frame of the first [rad]."""
    conjugate = np.array([1.0, -1.0, -1.0, -1.0])
    return rotation_vector(product(q * conjugate.astype(q.dtype), normalized(p)))


def inertia_about(
    moments: Vector, axes: Matrix, offset: Vector, mass: Float[Array, "*#n"]
) -> Inertia:
    """The spatial inertia of a body about a point.

    Args:
        moments: Principal moments.
        axes: Principal axes, as columns.
        offset: Offset of the centre of mass from the point.
        mass: Mass of the body.
    """
    turned = jnp.sum(axes[..., _ROW, :] * moments[..., None, :] * axes[..., _COLUMN, :], -1)
    square = jnp.sum(offset * offset, -1, keepdims=True) * (_ROW == _COLUMN)
    weight = mass[..., None]
    apart = weight * (square - offset[..., _ROW] * offset[..., _COLUMN])
    return jnp.concatenate([turned + apart, weight * offset, weight], -1)


def momentum(inertia: Inertia, motion: Motion) -> Motion:
    """The spatial force (or momentum) of an inertia under an acceleration (or a velocity)."""
    angular, linear = motion[..., :3], motion[..., 3:]
    offset, mass = inertia[..., 6:9], inertia[..., 9:]
    turning = jnp.sum(inertia[..., _MOMENT] * angular[..., None, :], -1) + cross(offset, linear)
    return jnp.concatenate([turning, mass * linear - cross(offset, angular)], -1)


def moved(velocity: Motion, motion: Motion) -> Motion:
    """Rate of change of a motion that moves along with a velocity."""
    (a, b), (c, d) = ((vector[..., :3], vector[..., 3:]) for vector in (velocity, motion))
    return jnp.concatenate([cross(a, c), cross(b, c) + cross(a, d)], -1)


def moved_force(velocity: Motion, force: Motion) -> Motion:
    """Rate of change of a force that moves along with a velocity."""
    (a, b), (c, d) = ((vector[..., :3], vector[..., 3:]) for vector in (velocity, force))
    return jnp.concatenate([cross(a, c) + cross(b, d), cross(a, d)], -1)


def cylinder_distance(point: Vector, size: Vector) -> Float[Array, "*#n"]:
    """Distance of a point from a cylinder along z, negative inside, as MJX's `_cylinder`; twice differentiable everywhere.

    The function of MJX has a custom derivative, whose derivative is NaN inside, and no derivative with respect to the
    size.

    Args:
        point: Point in the frame of the cylinder.
        size: Radius, half-length, and an unused number.
    """
    across, along = length(point[..., :2]) - size[..., 0], jnp.abs(point[..., 2]) - size[..., 1]
    out = jnp.stack([jnp.maximum(across, 0.0), jnp.maximum(along, 0.0)], -1)
    return jnp.minimum(jnp.maximum(across, along), 0.0) + length(out)


def length(vector: Float[Array, "*#n d"]) -> Float[Array, "*#n"]:
    """Length of a vector; at zero its derivative is zero."""
    square = jnp.sum(vector * vector, -1)
    is_zero = square <= 0.0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, square)))


def solve_definite(matrix: Float[Array, "n n"], vector: Float[Array, " n"]) -> Float[Array, " n"]:
    """x with A x = b for a symmetric positive definite A.

    Its derivative is A dx = db - dA x. The derivative of a Cholesky decomposition, as in MJX, costs ten times as much.
    """

    def solve(_: Callable[[Array], Array], right: Array) -> Array:
        solution: Array = cho_solve(cho_factor(jax.lax.stop_gradient(matrix)), right)
        return solution

    result: Array = jax.lax.custom_linear_solve(lambda x: matrix @ x, vector, solve, symmetric=True)
    return result
