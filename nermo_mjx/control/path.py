"""Paths that a pilot can follow: functions from a position to the nearest point of the path.

Paths are fixed in the world, start at its origin and head -y there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Final

import jax
import jax.numpy as jnp

from nermo_mjx.control.parameters import Pilot
from nermo_mjx.shapes import Array, Planar, Scalars, Spatial

#: Positions are limited to this distance [m], so that results stay finite if a world diverges.
FARTHEST: Final = 1e6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PathPoint:
    """The point of a path closest to the robot.

    Attributes:
        error: cross-track error, positive where the robot is to the **left** of the path [m].
        curvature: of the path there, positive where it bends to the left [1/m].
        tangent: unit vector (x, y) ahead.
        progress: arc length from the path's start, if the path keeps track of it, else 0 [m].
    """

    error: Scalars
    curvature: Scalars
    tangent: Planar
    progress: Scalars


def straight(pilot: Pilot, position: Spatial) -> PathPoint:
    """The line x = 0."""
    x = _near(position)[..., 0]
    ahead = jnp.broadcast_to(jnp.asarray([0.0, -1.0], x.dtype), (*x.shape, 2))
    return PathPoint(x, jnp.zeros_like(x), ahead, jnp.zeros_like(x))


def arc(pilot: Pilot, position: Spatial) -> PathPoint:
    """The circle of `pilot.radius` that bends to `pilot.direction`.

    With the centre at (s R, 0), s = +1 left: e = s (R - |p - centre|), written without the difference of two large
    numbers, so that float32 resolves millimetres at a radius of a kilometre.
    """
    near = _near(position)
    x, y = near[..., 0], near[..., 1]
    side = jnp.where(jnp.asarray(pilot.direction) >= 0.0, 1.0, -1.0)
    across = x - side * pilot.radius
    distance = jnp.sqrt(jnp.maximum(across**2 + y**2, 1e-12))
    error = side * (2.0 * side * pilot.radius * x - x**2 - y**2) / (pilot.radius + distance)
    tangent = jnp.stack([-side * y, side * across], axis=-1) / distance[..., None]
    return PathPoint(error, jnp.broadcast_to(side / pilot.radius, x.shape), tangent, jnp.zeros_like(x))


def _near(position: Spatial) -> Spatial:
    return jnp.clip(position, -FARTHEST, FARTHEST)


#: The paths without way points, by the pilot's name.
PATHS: Final[dict[str, Callable[[Pilot, Array], PathPoint]]] = {"straight": straight, "arc": arc}
