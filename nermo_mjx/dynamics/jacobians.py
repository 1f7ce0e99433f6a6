"""Jacobians of points on bodies, with the tree known at trace time.

`mjx.jac` determines on the device, level by level, which velocities move a body, for each end of a tendon and each
contact: for this robot 130 of a step's launches on a GPU, though none of it depends on the state. `mjx_copy` uses the
functions of this module in place of MJX's functions, deep inside of MJX's stages.

Among these are the wraps of tendons around geoms. MJX computes the wrap of every tendon and selects afterwards. Where
a tendon runs past its cylinder, or begins within it, that is the arcsine of a number above one, and its NaN propagates
through the selection as zero times NaN. Here such a tendon first gets ends for which everything is finite; the selected
values do not change. The angle on the circle is an arctangent: the arccosine has no derivative where the points meet,
and loses half of float32's digits nearby.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from mujoco import mjMINVAL

from nermo_mjx.dynamics import spatial
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.dynamics.tree import tree_of
from nermo_mjx.shapes import Array, Count, Scalar, Truth


def point_jacobian(
    model: mjx.Model, data: mjx.Data, point: Float[Array, " 3"], body: Count | int
) -> tuple[Float[Array, "nv 3"], Float[Array, "nv 3"]]:
    """As `mjx.jac`: how a point on a body moves, and how the body turns, with each velocity."""
    moves = jnp.asarray(tree_of(model).moves, point.dtype)[body][:, None]
    arm = point - data.subtree_com[jnp.asarray(np.asarray(model.body_rootid))[body]]
    turns = data.cdof[:, :3] * moves
    return data.cdof[:, 3:] * moves + spatial.cross(
        turns, jnp.broadcast_to(arm, turns.shape)
    ), turns


def muscle_time_constant(excess: Scalar, rising: Scalar, falling: Scalar, width: Scalar) -> Scalar:
    """As MJX's `muscle_dynamics_timescale`: from one time constant to the other over a width of excess excitation.

    MJX takes the fifth power of excess over width first, which is 0 by default: it overflows in float32.
    """
    share = jnp.clip(excess / jnp.maximum(width, mjMINVAL) + 0.5, 0.0, 1.0)
    smooth = falling + (rising - falling) * share**3 * (3.0 * share * (2.0 * share - 5.0) + 10.0)
    return jnp.where(width < mjMINVAL, jnp.where(excess > 0.0, rising, falling), smooth)


def axis_and_angle(q: Float[Array, " 4"]) -> tuple[Float[Array, " 3"], Scalar]:
    """As MJX's `quat_to_axis_angle`, of which only the product is used: here the rotation vector, and 1."""
    return spatial.rotation_vector(q), jnp.ones((), q.dtype)


def segment_length(vector: Float[Array, " 3"]) -> Scalar:
    """Length of a tendon's segment, at least 1e-15 m: times its direction, that has the derivative of the vector."""
    none = ~jnp.any(vector)
    return jnp.where(
        none, mjMINVAL, jnp.linalg.norm(jnp.where(none, jnp.ones_like(vector), vector))
    )


def segment_direction(vector: Array, length: Scalar) -> Array:
    """Its direction: that of MuJoCo, x, where it has no length."""
    first = jnp.zeros_like(vector).at[0].set(1.0)
    return vector / length + jnp.where(length <= mjMINVAL, first, 0.0)


#: Ends for which a wrap of radius 1 has a solution, from inside and from outside.
_INSIDE_WRAP_ENDS: Final = (2.0, -0.5, -2.0, -0.5)
_OUTSIDE_WRAP_ENDS: Final = (2.0, 1.5, -2.0, 1.5)

#: Both ends (x0, y0, x1, y1) in the plane of a circle about the origin.
Ends = Float[Array, " 4"]
Point = Float[Array, " 2"]


def circle(
    wrap: Callable[..., Any], ends: Ends, side: Point, has_side: Any, radius: Scalar
) -> tuple[Array, Array]:
    """As MJX's `wrap_circle`, which is `wrap`: length of the arc (-1 without a wrap) and its ends."""
    near = jnp.minimum(ends[:2] @ ends[:2], ends[2:] @ ends[2:]) < radius * radius
    straight = ends[2:] - ends[:2]
    free = near | (radius < mjMINVAL) | (straight @ straight < mjMINVAL)
    # Where the straight line grazes the circle the arc has no length, and MJX's derivative of it is rounding's.
    foot = ends[:2] - (straight @ ends[:2]) / jnp.maximum(straight @ straight, mjMINVAL) * straight
    grazes = jnp.abs(foot @ foot - radius * radius) < 1e-12 * radius * radius
    free |= ~jnp.squeeze(jnp.asarray(has_side, bool)) & grazes
    safe_ends, ring = _or_else(free, _INSIDE_WRAP_ENDS, ends, radius)
    length, points = wrap(safe_ends, side, has_side, ring)
    return jnp.where(free, -1.0, length), jnp.where(free, 0.0, points)


def wrap_inside(
    ends: Ends, radius: Scalar, rounds: int, tolerance: float, first: float
) -> tuple[Array, Array]:
    """As MJX's `wrap_inside`: length (-1 without a wrap, else about 0), (1,), and the one point, twice.

    The tangent point solves asin(A z) + asin(B z) - 2 asin(z) + G = 0, with A and B the radius over both distances, and
    G the angle between the ends. Its derivative is that of the solution, not of the Newton iterations.
    """
    between, straight = 0.5 * (ends[:2] + ends[2:]), ends[2:] - ends[:2]
    cosine = ends[:2] @ ends[2:] / jnp.maximum(_length(ends[:2]) * _length(ends[2:]), mjMINVAL)
    share = -(straight @ ends[:2]) / jnp.maximum(straight @ straight, mjMINVAL)
    foot = ends[:2] + share * straight
    near = jnp.minimum(_length(ends[:2]), _length(ends[2:])) <= radius
    crosses = (
        (straight @ straight > mjMINVAL)
        & (share > 0.0)
        & (share < 1.0)
        & (foot @ foot <= radius * radius)
    )
    free = near | crosses | (radius < mjMINVAL) | (cosine < -1.0 + mjMINVAL)
    parallel = cosine > 1.0 - mjMINVAL
    safe_ends, ring = _or_else(free | parallel, _OUTSIDE_WRAP_ENDS, ends, radius)
    first_distance, second_distance = _length(safe_ends[:2]), _length(safe_ends[2:])
    angle = jnp.arctan2(
        jnp.abs(safe_ends[0] * safe_ends[3] - safe_ends[1] * safe_ends[2]),
        safe_ends[:2] @ safe_ends[2:],
    )

    z, is_lost = _root(
        ring / first_distance, ring / second_distance, angle, rounds, tolerance, first
    )
    # MJX's fallback is the middle of the ends, on the circle.
    middle = radius * between / jnp.maximum(_length(between), mjMINVAL)
    begins = safe_ends[0] * safe_ends[3] - safe_ends[1] * safe_ends[2] > 0.0
    from_, distance = (
        jnp.where(begins, safe_ends[:2], safe_ends[2:]),
        jnp.where(begins, first_distance, second_distance),
    )
    turn = jnp.arcsin(z) - jnp.arcsin(ring / distance * z)
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    touched = (
        ring
        / distance
        * jnp.stack([cos * from_[0] - sin * from_[1], sin * from_[0] + cos * from_[1]])
    )
    point = jnp.where(free, 0.0, jnp.where(parallel | is_lost, middle, touched))
    # The length of a single point is not exactly zero: MJX takes the root of its square.
    return jnp.where(free, -1.0, mjMINVAL)[None], jnp.tile(point, 2)


def _apart(z: Array, a: Array, b: Array, angle: Array) -> Array:
    return jnp.arcsin(a * z) + jnp.arcsin(b * z) - 2.0 * jnp.arcsin(z) + angle


def _root(
    a: Scalar, b: Scalar, angle: Scalar, rounds: int, tolerance: float, first: float
) -> tuple[Scalar, Truth]:
    """z at which `_apart` vanishes, and whether MJX's iteration would fail."""
    fixed = jax.lax.stop_gradient((a, b, angle))

    def slope(z: Array) -> Array:
        return sum(
            f / jnp.sqrt(jnp.maximum(1.0 - (f * z) ** 2, mjMINVAL)) for f in fixed[:2]
        ) - 2.0 / jnp.sqrt(jnp.maximum(1.0 - z * z, mjMINVAL))

    def next_round(_: Count, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        z, is_lost = carry
        value, rise = _apart(z, *fixed), slope(z)
        next_z = jnp.where(
            jnp.abs(value) <= tolerance, z, z - value / jnp.where(rise == 0.0, mjMINVAL, rise)
        )
        is_lost |= (rise > -mjMINVAL) | (next_z > z)
        next_z = jnp.clip(next_z, 0.0, first)
        return next_z, is_lost | (_apart(next_z, *fixed) > tolerance)

    start = jnp.asarray(first, angle.dtype)
    z, lost = jax.lax.fori_loop(0, rounds, next_round, (start, _apart(start, *fixed) > 0.0))
    z = jnp.where(lost, 0.5, z)
    # At the solution, for derivatives of any order.
    z -= _apart(z, *fixed) / slope(z)
    return jax.lax.custom_root(
        lambda z: _apart(z, a, b, angle), z, lambda _, z: z, lambda f, y: y / f(1.0)
    ), lost


def _length(vector: Point) -> Scalar:
    """Length of a vector, at least 1e-15, so that it has a derivative everywhere."""
    return jnp.sqrt(jnp.maximum(vector @ vector, mjMINVAL**2))


def _or_else(
    replace: Truth, ends: tuple[float, ...], values: Ends, radius: Scalar
) -> tuple[Ends, Scalar]:
    """The given ends, or valid ends around a circle of radius 1."""
    return jnp.where(replace, jnp.asarray(ends, values.dtype), values), jnp.where(
        replace, 1.0, radius
    )


def arc_length(start: Point, end: Point, index: Count, radius: Scalar) -> Scalar:
    """As MJX's `_length_circle`: length of the arc from one point to the other, in the direction given by `index`."""
    cross = start[1] * end[0] - start[0] * end[1]
    angle = jnp.arctan2(jnp.abs(cross), start @ end)
    far = ((cross > 0.0) & (index != 0)) | ((cross < 0.0) & (index == 0))
    return radius * jnp.where(far, 2.0 * jnp.pi - angle, angle)
