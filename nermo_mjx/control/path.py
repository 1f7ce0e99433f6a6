"""Paths that a pilot can follow: functions from a position to the nearest point of the path.

Paths are fixed in the world, start at its origin and head -y there.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.control.parameters import Pilot
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.shapes import Array, Planar, Scalars, Spatial

#: Positions are limited to this distance [m], so that results stay finite if a world diverges.
LARGEST_POSITION_METRES: Final = 1e6


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
    return PathPoint(
        error, jnp.broadcast_to(side / pilot.radius, x.shape), tangent, jnp.zeros_like(x)
    )


def _near(position: Spatial) -> Spatial:
    return jnp.clip(position, -LARGEST_POSITION_METRES, LARGEST_POSITION_METRES)


#: The paths without way points, by the pilot's name.
PATHS: Final[dict[str, Callable[[Pilot, Array], PathPoint]]] = {"straight": straight, "arc": arc}


# ---
# Courses: smooth planar curves through way points, and a robot's position relative to one.
#
# A curve is sampled once, when it is built, at equal steps of arc length. The search for the nearest point covers only
# the vicinity of the robot's progress, so a course may approach or cross itself, and a search is one short table
# lookup.


#: Search window along the course, by arc length from the progress made [m]. The robot sways back by a centimetre within
#: a stride; ahead, the window leaves room to cut a bend.
WINDOW_BEHIND_METRES: Final = 0.05
WINDOW_AHEAD_METRES: Final = 0.15
#: Largest coordinate of a way point [m], where float32 still tells millimetres; and samples of the longest course.
LARGEST_WAY_POINT_METRES: Final = 1e4
MAX_COURSE_SAMPLES: Final = 1_000_000
#: Smallest radius of curvature that is not a kink [m].
SMALLEST_RADIUS_METRES: Final = 0.05


@dataclasses.dataclass(frozen=True)
class Course:
    """A planar curve, sampled at n + 1 points of equal distance in arc length; hashable by value.

    Attributes:
        x, y: of the points [m], n + 1 each.
        heading: direction of the tangent from the x axis [rad], continuous (not wrapped).
        curvature: at the points [1/m], positive where the course bends to the left in walking direction.
        spacing: arc length between two points [m].
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    heading: tuple[float, ...]
    curvature: tuple[float, ...]
    spacing: float

    @property
    def length(self) -> float:
        """Arc length from the first to the last point [m]."""
        return self.spacing * (len(self.x) - 1)

    @property
    def smallest_radius(self) -> float:
        """Smallest radius of curvature at the points [m]; infinite for a straight line."""
        sharpest = max(map(abs, self.curvature))
        return 1.0 / sharpest if sharpest > 0.0 else float("inf")

    @functools.cached_property
    def _table(self) -> Float[np.ndarray, "points 4"]:
        return np.stack([self.x, self.y, self.heading, self.curvature], axis=-1).astype(np.float32)


def course_through(points: Sequence[Sequence[float]] | np.ndarray, spacing: float = 0.01) -> Course:
    """The smooth course through way points: a cubic spline over the chord lengths, with continuous curvature.

    Both ends have no curvature, because the course continues straight beyond them.

    Args:
        points: (x, y) of at least three way points [m], in walking order.
        spacing: desired arc length between samples [m]; rounded to a whole fraction of the course.

    Raises:
        ParameterError: the points do not give a smooth course.
    """
    from scipy.interpolate import (
        CubicSpline,
    )  # the import takes a second, which only walks with a course need

    waypoints = _checked(points, spacing)
    chords = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))])
    if chords[-1] > MAX_COURSE_SAMPLES * spacing:
        raise ParameterError(
            f"The course is {chords[-1]:g} m long: allowed are {MAX_COURSE_SAMPLES * spacing:g} m."
        )
    curve = CubicSpline(chords, waypoints, bc_type="natural")

    # Arc length on a grid whose polygon is shorter than the curve by less than a micrometre per metre.
    fine = np.linspace(
        0.0, chords[-1], 1 + 20 * max(int(np.ceil(chords[-1] / spacing)), len(waypoints))
    )
    pieces = np.diff(curve(fine), axis=0)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(pieces, axis=1))])
    # Turns between pieces instead of the curvature's formula, which is 0 / 0 where a course reverses.
    turn = np.diff(np.unwrap(np.arctan2(pieces[:, 1], pieces[:, 0])))
    sharpest = float(np.abs(turn / (0.5 * (arc[2:] - arc[:-2]))).max())
    if not sharpest * SMALLEST_RADIUS_METRES <= 1.0:
        raise ParameterError(
            f"The course bends with a radius of {1.0 / sharpest:.3g} m: allowed is at least {SMALLEST_RADIUS_METRES:g} m."
        )

    steps = max(round(arc[-1] / spacing), 1)
    nodes = np.interp(np.linspace(0.0, arc[-1], steps + 1), arc, fine)
    (x, y), (dx, dy), (ddx, ddy) = curve(nodes).T, curve(nodes, 1).T, curve(nodes, 2).T
    curvature = (dx * ddy - dy * ddx) / np.hypot(dx, dy) ** 3
    columns = (x, y, np.unwrap(np.arctan2(dy, dx)), curvature)
    x, y, heading, curvature = (tuple(column.tolist()) for column in columns)
    return Course(x, y, heading, curvature, float(arc[-1]) / steps)


def locate(course: Course, progress: Scalars, position: Spatial) -> PathPoint:
    """The nearest point of the course near the progress made.

    Beyond either end the error refers to a straight continuation, and the progress stays at the end. The error of a
    robot that has left the window, because it was moved, is measured from the window's nearer end.

    Args:
        course: the curve.
        progress: arc length covered so far [m], 0 at the start.
        position: of the robot [m]; only x and y are used.
    """
    table, step = jnp.asarray(course._table), course.spacing
    segments = len(course.x) - 1
    window = min(int(np.ceil((WINDOW_BEHIND_METRES + WINDOW_AHEAD_METRES) / step)) + 1, segments)
    first = jnp.clip(
        jnp.floor((progress - WINDOW_BEHIND_METRES) / step).astype(jnp.int32), 0, segments - window
    )
    nodes = table[first[..., None] + jnp.arange(window + 1)]

    # The nearest point of each segment in the window, as its share `along` of the segment, then the nearest of these.
    position_xy = jnp.clip(position[..., :2], -1e6, 1e6)
    start, chord = nodes[..., :-1, :2], nodes[..., 1:, :2] - nodes[..., :-1, :2]
    offset = position_xy[..., None, :] - start
    along = jnp.clip(jnp.sum(offset * chord, axis=-1) / jnp.sum(chord**2, axis=-1), 0.0, 1.0)
    distance = jnp.sum((offset - along[..., None] * chord) ** 2, axis=-1)
    nearest = jnp.argmin(distance, axis=-1)[..., None]

    share = jnp.take_along_axis(along, nearest, axis=-1)
    segment_start = jnp.take_along_axis(nodes, nearest[..., None], axis=-2)[..., 0, :]
    segment_end = jnp.take_along_axis(nodes, nearest[..., None] + 1, axis=-2)[..., 0, :]
    point = segment_start + share * (segment_end - segment_start)

    tangent = jnp.stack([jnp.cos(point[..., 2]), jnp.sin(point[..., 2])], axis=-1)
    aside = position_xy - point[..., :2]
    # Left of the tangent (tx, ty) is (-ty, tx), with x to the left and y backward as with any axes seen from above.
    error = tangent[..., 0] * aside[..., 1] - tangent[..., 1] * aside[..., 0]
    reached = (first + nearest[..., 0] + share[..., 0]) * step
    return PathPoint(error, point[..., 3], tangent, jnp.maximum(progress, reached))


def _checked(
    points: Sequence[Sequence[float]] | np.ndarray, spacing: float
) -> Float[np.ndarray, "points 2"]:
    try:
        waypoints = np.asarray(points, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ParameterError("The way points are not numbers in rows of (x, y).") from None
    if waypoints.ndim != 2 or waypoints.shape[1:] != (2,) or len(waypoints) < 3:
        raise ParameterError(
            f"The way points have shape {waypoints.shape}: expected at least three rows of (x, y)."
        )
    if len(far := np.flatnonzero(~(np.abs(waypoints) <= LARGEST_WAY_POINT_METRES).all(axis=1))):
        x, y = waypoints[far[0]]
        allowed = f"expected finite numbers, allowed up to {LARGEST_WAY_POINT_METRES:g} m"
        raise ParameterError(f"Way point {far[0]} is ({x:g}, {y:g}): {allowed}.")
    repeated = np.flatnonzero(np.linalg.norm(np.diff(waypoints, axis=0), axis=1) < 1e-6)
    if len(repeated):
        raise ParameterError(f"Way point {repeated[0] + 1} repeats the one before it.")
    if not (np.isfinite(spacing) and 1e-4 <= spacing <= 0.1):
        raise ParameterError(f"spacing is {spacing:g}: allowed is [0.0001, 0.1] m.")
    return waypoints
