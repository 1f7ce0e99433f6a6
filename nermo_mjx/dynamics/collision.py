"""Contacts of primitive geoms that are equal to those of MuJoCo C, for pairs whose contacts differ in MJX.

MJX adds 1e-6 to denominators of closest points, computes one contact of parallel capsules and other frames of capsules
on a plane, omits points of a cylinder and corners of a box that are 1 mm above the lowest one, and approximates
distances of ellipsoids and cylinders. Each function of this module returns the contacts of two geoms.
`coverage.approximated` lists the other pairs whose contacts differ from MuJoCo C.
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
from nermo_mjx.dynamics.mjx_import import GeomInfo, math, mjx
from nermo_mjx.shapes import Array, Scalar

Vector = Float[Array, " 3"]
Matrix = Float[Array, "3 3"]
#: Distances [m], positions and frames, of one contact or several.
Contacts = tuple[Float[Array, "*n"], Float[Array, "*n 3"], Float[Array, "*n 3 3"]]
#: Rounds of Newton's method for the direction in which two bodies are closest.
NEWTON_ROUNDS: Final = 20
#: Distance that marks a missing contact [m], as in MJX.
NO_CONTACT_METRES: Final = 1.0
#: Signs of a box's corners; no array, which JAX mixes up in programs of 32 and of 64 bits.
_CORNERS: Final = tuple(tuple(1 if i >> k & 1 else -1 for k in range(3)) for i in range(8))


def _collider(count: int) -> Callable[[Callable[[GeomInfo, GeomInfo], Contacts]], Any]:
    """Convert a function of two geoms to a function of all pairs of a group, which the driver of MJX calls."""

    def wrap(function: Callable[[GeomInfo, GeomInfo], Contacts]) -> Any:
        def collide(model: Any, data: Any, _: Any, geom: Any) -> Contacts:
            pair = [
                GeomInfo(data.geom_xpos[field], data.geom_xmat[field], model.geom_size[field])
                for field in geom.T
            ]
            dist, pos, frame = jax.vmap(function)(*pair)
            return dist.reshape(-1), pos.reshape(-1, 3), frame.reshape(-1, 3, 3)

        collide.ncon, collide.of = count, function  # type: ignore[attr-defined]
        return collide

    return wrap


def _unit(vector: Vector, otherwise: Vector | None = None) -> Vector:
    """Direction of a vector; for a zero vector another direction, by default x, with a derivative of zero."""
    length = spatial.length(vector)
    none = length < mjMINVAL
    otherwise = jnp.eye(3, dtype=vector.dtype)[0] if otherwise is None else otherwise
    return jnp.where(none, otherwise, vector / jnp.where(none, 1.0, length))


def _spheres(
    first: GeomInfo,
    second: GeomInfo,
    first_point: Vector,
    second_point: Vector,
    radius: Scalar,
    other_radius: Scalar,
) -> tuple[Scalar, Vector, Vector]:
    """Distance, position and normal of two spheres; if they coincide, the normal is orthogonal to both axes."""
    normal = _unit(
        second_point - first_point, _unit(spatial.cross(first.mat[:, 2], second.mat[:, 2]))
    )
    dist = spatial.length(second_point - first_point) - radius - other_radius
    return dist, first_point + normal * (radius + 0.5 * dist), normal


@_collider(1)
def sphere_sphere(first: GeomInfo, second: GeomInfo) -> Contacts:
    dist, pos, normal = _spheres(
        first, second, first.pos, second.pos, first.size[0], second.size[0]
    )
    return dist, pos, math.make_frame(normal)


@_collider(1)
def sphere_capsule(first: GeomInfo, second: GeomInfo) -> Contacts:
    axis = second.mat[:, 2]
    nearest = second.pos + axis * jnp.clip(
        axis @ (first.pos - second.pos), -second.size[1], second.size[1]
    )
    dist, pos, normal = _spheres(first, second, first.pos, nearest, first.size[0], second.size[0])
    return dist, pos, math.make_frame(normal)


@_collider(1)
def sphere_cylinder(first: GeomInfo, second: GeomInfo) -> Contacts:
    """Contact with the side, an end or the rim of the cylinder."""
    axis, (radius, half) = second.mat[:, 2], second.size[:2]
    height = axis @ (first.pos - second.pos)
    across = first.pos - second.pos - axis * height
    outside = spatial.length(across)
    side, end = jnp.abs(height) < half, outside < radius
    nearer_end = half - jnp.abs(height) < radius - outside
    side, end = side & ~(end & nearer_end), end & ~(side & ~nearer_end)
    up = jnp.where(height > 0.0, axis, -axis)
    rim = second.pos + up * half + _unit(across) * radius
    to, wide = jnp.where(side, second.pos + axis * height, rim), jnp.where(side, radius, 0.0)
    contacts = _spheres(first, second, first.pos, to, first.size[0], wide)
    above = jnp.abs(height) - half - first.size[0]
    flat = above, first.pos - up * (first.size[0] + 0.5 * above), -up
    dist, pos, normal = (
        jnp.where(end, ours, theirs) for ours, theirs in zip(flat, contacts, strict=True)
    )
    return dist, pos, math.make_frame(normal)


@_collider(1)
def sphere_box(first: GeomInfo, second: GeomInfo) -> Contacts:
    """Contact with the nearest point of the box, or with its nearest face if the centre is inside."""
    centre = second.mat.T @ (first.pos - second.pos)
    nearest = jnp.clip(centre, -second.size, second.size)
    distance = spatial.length(nearest - centre)
    is_inside = distance <= mjMINVAL
    faces = jnp.stack([second.size + centre, second.size - centre], 1).ravel()
    face = jnp.argmin(jnp.abs(faces))
    into = jnp.asarray(np.stack([np.eye(3), -np.eye(3)], 1).reshape(6, 3), centre.dtype)[face]
    dist = jnp.where(is_inside, -jnp.abs(faces[face]), distance) - first.size[0]
    normal = jnp.where(is_inside, into, _unit(nearest - centre))
    pos = centre + normal * (first.size[0] + 0.5 * dist)
    return dist, second.pos + second.mat @ pos, math.make_frame(second.mat @ normal)


@_collider(2)
def capsule_capsule(first: GeomInfo, second: GeomInfo) -> Contacts:
    """Contact at the closest points of the axes; for axes parallel to 1e-4 rad, at both ends of their common section."""
    axis, across = first.mat[:, 2], second.mat[:, 2]
    half, other_half = first.size[1], second.size[1]
    offset = second.pos - first.pos
    cosine, first_projection, second_projection = axis @ across, axis @ offset, across @ offset
    sine = 1.0 - cosine * cosine
    parallel = sine < 1e-8
    free = jnp.where(parallel, 1.0, sine)
    x, y = (
        (first_projection - cosine * second_projection) / free,
        (cosine * first_projection - second_projection) / free,
    )
    y = jnp.where(jnp.abs(x) > half, jnp.sign(x) * half * cosine - second_projection, y)
    x = jnp.where(jnp.abs(y) > other_half, jnp.sign(y) * other_half * cosine + first_projection, x)
    reach = other_half * jnp.abs(cosine)
    ends = jnp.stack(
        [jnp.maximum(first_projection - reach, -half), jnp.minimum(first_projection + reach, half)]
    )
    x = jnp.clip(jnp.where(parallel, ends, x), -half, half)
    y = jnp.clip(jnp.where(parallel, x * cosine - second_projection, y), -other_half, other_half)
    points = first.pos + x[:, None] * axis, second.pos + y[:, None] * across
    dist, pos, normal = jax.vmap(
        lambda p, q: _spheres(first, second, p, q, first.size[0], second.size[0])
    )(*points)
    dist = jnp.stack([dist[0], jnp.where(parallel, dist[1], NO_CONTACT_METRES)])
    return dist, pos, jax.vmap(math.make_frame)(normal)


@_collider(2)
def plane_capsule(first: GeomInfo, second: GeomInfo) -> Contacts:
    """Contacts at both ends, with the axes of friction along the capsule."""
    normal, axis = first.mat[:, 2], second.mat[:, 2]
    along = _unit(axis - normal * (normal @ axis))
    ends = second.pos + np.array([[1.0], [-1.0]]) * axis * second.size[1]
    dist = (ends - first.pos) @ normal - second.size[0]
    pos = ends - normal * (second.size[0] + 0.5 * dist[:, None])
    frame = jnp.stack([normal, along, spatial.cross(normal, along)])
    return dist, pos, jnp.stack([frame, frame])


@_collider(4)
def plane_cylinder(first: GeomInfo, second: GeomInfo) -> Contacts:
    """Contacts at the lowest points of both rims, and at two points that form a triangle with the first one.

    If the axis is along the normal, the triangle points along the x axis of the cylinder, and has no derivative with
    respect to the tilt; in MuJoCo C, it turns with the smallest tilt.
    """
    normal, axis = first.mat[:, 2], second.mat[:, 2]
    down = axis * jnp.where(normal @ axis > 0.0, -1.0, 1.0)
    lowest = second.size[0] * _unit(down * (normal @ down) - normal, second.mat[:, 0])
    end = second.size[1] * down
    aside = _unit(spatial.cross(lowest, end)) * second.size[0] * 0.75**0.5
    points = second.pos + jnp.stack(
        [end + lowest, lowest - end, end - 0.5 * lowest + aside, end - 0.5 * lowest - aside]
    )
    dist = (points - first.pos) @ normal
    return (
        dist,
        points - 0.5 * dist[:, None] * normal,
        jnp.broadcast_to(math.make_frame(normal), (4, 3, 3)),
    )


@_collider(4)
def plane_box(first: GeomInfo, second: GeomInfo) -> Contacts:
    """Contacts at the four lowest corners, unless they are above the centre."""
    normal = first.mat[:, 2]
    corners = (np.array(_CORNERS) * second.size) @ second.mat.T
    lowest = jnp.argsort(jax.lax.stop_gradient(corners @ normal))[:4]
    corners, below = corners[lowest], (corners @ normal)[lowest]
    dist = jnp.where(below <= 0.0, (second.pos - first.pos) @ normal + below, NO_CONTACT_METRES)
    pos = second.pos + corners - 0.5 * dist[:, None] * normal
    return dist, pos, jnp.broadcast_to(math.make_frame(normal), (4, 3, 3))


# Long because the steps of one Newton iteration share the shapes that they close over.
def _round(
    one: GeomInfo, other: GeomInfo, shapes: list[Matrix], segment: Vector, radius: Scalar
) -> Contacts:
    """Contact of a capsule, sphere or ellipsoid with an ellipsoid, at the closest or deepest points.

    The signed distance is the largest over unit vectors n of n . apart - h(n), with h the sum of the support functions:
    sqrt(n . Q n) of an ellipsoid with the matrix Q, the radius, and |n . segment|. It is convex along the segment, and
    Newton's method solves for the direction and the point together. Derivatives of any order are those of the solution.

    Args:
        one, other: Geoms.
        shapes: Matrices Q of the ellipsoids, the matrix of `other` last.
        segment, radius: Half of the segment of the first geom, and the radius around the segment.
    """
    apart = other.pos - one.pos

    def supports(n: Vector, shapes: list[Matrix]) -> list[tuple[Scalar, Vector]]:
        heights = [jnp.sqrt(jnp.maximum(n @ shape @ n, mjMINVAL**2)) for shape in shapes]
        return [(height, shape @ n / height) for height, shape in zip(heights, shapes, strict=True)]

    def distance(n: Vector, between: Vector) -> Scalar:
        return n @ between - sum(height for height, _ in supports(n, shapes)) - radius

    def newton(n: Vector, t: Scalar, damped: bool) -> tuple[Vector, Scalar]:
        offset, shapes, segment = fixed
        support_points = supports(n, shapes)
        flat = jnp.eye(3, dtype=n.dtype) - jnp.outer(n, n)
        bend = (
            flat
            @ sum(
                (q - jnp.outer(g, g)) / h for q, (h, g) in zip(shapes, support_points, strict=True)
            )
            @ flat
        )
        pull = offset - t * segment - sum(g for _, g in support_points)
        lift = n @ pull
        if damped:  # where it is not concave: the lesser of both curvatures
            size, square = jnp.trace(bend), jnp.sum(bend * bend)
            lift = jnp.maximum(
                lift, -0.45 * (size - jnp.sqrt(jnp.maximum(2.0 * square - size * size, 0.0)))
            )
        inverse = jnp.linalg.inv(bend + lift * flat + jnp.outer(n, n))
        across, normal_change = flat @ segment, inverse @ flat @ pull
        soft = jnp.maximum(across @ inverse @ across, mjMINVAL)
        segment_position = jnp.clip(t + segment @ (n + normal_change) / soft, -1.0, 1.0)
        change = normal_change - inverse @ across * (segment_position - t)
        if damped:
            change *= jnp.minimum(1.0, 0.5 / jnp.maximum(spatial.length(change), mjMINVAL))
        return _unit(n + change), segment_position

    fixed = jax.lax.stop_gradient((apart, shapes, segment))
    axes = jnp.concatenate([one.mat.T, other.mat.T])
    starts = jax.lax.stop_gradient(jnp.concatenate([_unit(apart)[None], axes, -axes]))
    middle = jnp.clip(fixed[0] @ fixed[2] / jnp.maximum(fixed[2] @ fixed[2], mjMINVAL), -1.0, 1.0)

    def converged(n: Vector) -> tuple[Vector, Scalar]:
        return jax.lax.fori_loop(
            0, NEWTON_ROUNDS, lambda _, current: newton(current[0], current[1], True), (n, middle)
        )

    found = jax.vmap(converged)(starts)
    best = jnp.argmax(jax.vmap(lambda n: distance(n, apart) - jnp.abs(n @ segment))(found[0]))
    n, t = found[0][best], found[1][best]
    n, t = newton(n, t, False)
    slides = (jnp.abs(t) < 1.0) & (fixed[2] @ fixed[2] > mjMINVAL**2)

    def off(unknowns: Array) -> Array:
        """Zero at the solution: the pull across n, the length of n less 1, and the slope along the segment."""
        direction, position = _unit(unknowns[:3]), unknowns[3]
        pull = apart - position * segment - sum(g for _, g in supports(direction, shapes))
        across = pull - (direction @ pull) * direction + unknowns[:3] - direction
        return jnp.append(across, jnp.where(slides, direction @ segment, position - t))

    def tangent(linear: Callable[[Array], Array], right: Array) -> Array:
        solution: Array = jnp.linalg.solve(jax.vmap(linear)(jnp.eye(4, dtype=right.dtype)).T, right)
        return solution

    solved = jax.lax.custom_root(off, jnp.append(n, t), lambda _, at: at, tangent)
    n, t = solved[:3], solved[3]
    *inner, (_, outer) = supports(n, shapes)
    touched = sum((g for _, g in inner), t * segment + radius * n)
    pos = 0.5 * (one.pos + other.pos + touched - outer)
    return distance(n, apart - t * segment), pos, math.make_frame(n)


def _quadric(geom: GeomInfo) -> Matrix:
    """The matrix of an ellipsoid's support function."""
    return (geom.mat * geom.size**2) @ geom.mat.T


@_collider(1)
def capsule_ellipsoid(first: GeomInfo, second: GeomInfo) -> Contacts:
    return _round(first, second, [_quadric(second)], first.mat[:, 2] * first.size[1], first.size[0])


@_collider(1)
def sphere_ellipsoid(first: GeomInfo, second: GeomInfo) -> Contacts:
    return _round(first, second, [_quadric(second)], jnp.zeros_like(first.pos), first.size[0])


@_collider(1)
def ellipsoid_ellipsoid(first: GeomInfo, second: GeomInfo) -> Contacts:
    no_segment = jnp.zeros_like(first.pos)
    return _round(first, second, [_quadric(first), _quadric(second)], no_segment, no_segment[0])


def closest_on_segment(start: Vector, end: Vector, point: Vector) -> Vector:
    """Closest point on a segment, as MJX's `closest_segment_point`, without 1e-6 added to the square of the length."""
    along = end - start
    return (
        start
        + jnp.clip((point - start) @ along / jnp.maximum(along @ along, mjMINVAL), 0.0, 1.0) * along
    )


#: Pair of types of geoms -> function of this module that computes the contacts.
CONTACT_FUNCTIONS: Final = {
    (mjx.GeomType[first], mjx.GeomType[second]): function
    for first, second, function in (
        ("PLANE", "CAPSULE", plane_capsule),
        ("PLANE", "BOX", plane_box),
        ("PLANE", "CYLINDER", plane_cylinder),
        ("SPHERE", "SPHERE", sphere_sphere),
        ("SPHERE", "CAPSULE", sphere_capsule),
        ("SPHERE", "CYLINDER", sphere_cylinder),
        ("SPHERE", "BOX", sphere_box),
        ("CAPSULE", "CAPSULE", capsule_capsule),
        ("SPHERE", "ELLIPSOID", sphere_ellipsoid),
        ("CAPSULE", "ELLIPSOID", capsule_ellipsoid),
        ("ELLIPSOID", "ELLIPSOID", ellipsoid_ellipsoid),
    )
}
