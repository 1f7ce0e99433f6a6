# Tests of control/path.py
"""Courses through way points, against lines and circles; and the maze's path, against the published boxes."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fakes.published_maze import clearance

from nermo_mjx.control.path import (
    WINDOW_AHEAD_METRES,
    WINDOW_BEHIND_METRES,
    Course,
    PathPoint,
    course_through,
    locate,
)
from nermo_mjx.experiments.walks import MAZE_COURSE, maze_course

#: From the origin along -y, as the robot starts.
LINE = ((0.0, 0.0), (0.0, -0.7), (0.0, -1.0), (0.0, -2.0))
#: Middle of the maze's island, the first box.
ISLAND = (-0.124, -1.240)


def circle(radius: float, side: float, turn: float = 3.0, count: int = 40) -> np.ndarray:
    """Way points of an arc of `turn` [rad] that leaves the origin along -y and bends to `side`."""
    angle = np.linspace(0.0, turn, count)
    return radius * np.stack([side * (1.0 - np.cos(angle)), -np.sin(angle)], axis=-1)


@functools.cache
def jitted(course: Course):
    return jax.jit(functools.partial(locate, course))


def located(course: Course, progress, x, y) -> PathPoint:
    """`locate` in NumPy's float64, over any batch."""
    x, y, progress = np.broadcast_arrays(x, y, progress)
    position = jnp.asarray(np.stack([x, y, 0.05 + 0 * x], axis=-1), jnp.float32)
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, float),
        jitted(course)(jnp.asarray(progress, jnp.float32), position),
    )


def test_beside_a_straight_line_the_error_is_the_distance_to_its_left():
    """Heading -y, left is +x; the nearest point is straight beside, also between two samples."""
    course = course_through(LINE)
    assert course.length == pytest.approx(2.0, abs=1e-6)
    result = located(course, 0.98, [0.03, -0.04, 0.0], [-1.0, -1.0372, -0.95])
    np.testing.assert_allclose(result.error, [0.03, -0.04, 0.0], atol=1e-6)
    np.testing.assert_allclose(
        result.progress, [1.0, 1.0372, 0.98], atol=1e-6
    )  # never less than before
    np.testing.assert_allclose(result.curvature, 0.0, atol=1e-6)
    np.testing.assert_allclose(result.tangent, np.broadcast_to([0.0, -1.0], (3, 2)), atol=1e-6)


def test_beyond_its_ends_a_course_goes_on_straight():
    """The error stays the distance to the line; the progress stays at the end."""
    course = course_through(LINE)
    behind, beyond = located(course, 0.0, 0.02, 0.3), located(course, 1.99, -0.02, -2.4)
    assert (behind.error, behind.progress) == pytest.approx((0.02, 0.0), abs=1e-6)
    assert (beyond.error, beyond.progress) == pytest.approx((-0.02, 2.0), abs=1e-6)


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["left", "right"])
@pytest.mark.parametrize("radius", [0.3, 1.0])
def test_beside_a_circle_the_error_is_the_difference_of_two_radii(radius, side):
    """Closed form at points 3 cm inside to 3 cm outside; left of a left bend is inside.

    Away from the ends, where the course is made straight. Tolerances: the spline through 40 points of 3 rad leaves the
    circle by less than 1e-5 of its radius, and a chord of 1 cm leaves its arc by 1 cm^2 / (8 R), 40 micrometres. Seen
    from 3 cm aside, the chord's turn of 1 cm / (2 R) at its ends moves the nearest point by 0.5 mm at R = 0.3 m.
    """
    course = course_through(circle(radius, side))
    angle, offset = np.meshgrid(np.linspace(0.6, 2.4, 15), np.linspace(-0.03, 0.03, 5))
    x, y = side * (radius - (radius - offset) * np.cos(angle)), -(radius - offset) * np.sin(angle)
    result = located(course, radius * angle - 0.04, x, y)
    np.testing.assert_allclose(result.error, side * offset, atol=5e-5)
    np.testing.assert_allclose(
        result.progress, radius * angle, atol=1e-4 * radius + 0.03 * 0.01 / (2 * radius)
    )
    np.testing.assert_allclose(result.curvature, side / radius, rtol=5e-3)
    np.testing.assert_allclose(result.tangent[..., 0], side * np.sin(angle), atol=2e-3)
    np.testing.assert_allclose(result.tangent[..., 1], -np.cos(angle), atol=2e-3)
    assert course.length == pytest.approx(3.0 * radius, rel=1e-4)


def test_the_curvature_is_continuous_and_is_the_headings_slope():
    """C2: differences of the heading give the curvature between samples, and its jumps shrink with the spacing."""
    coarse, fine = (course_through(MAZE_COURSE, spacing) for spacing in (0.01, 0.002))
    slope = np.diff(coarse.heading) / coarse.spacing
    middle = (np.array(coarse.curvature)[1:] + np.array(coarse.curvature)[:-1]) / 2
    np.testing.assert_allclose(slope, middle, atol=0.05)
    jumps = [np.abs(np.diff(course.curvature)).max() for course in (coarse, fine)]
    assert jumps[1] == pytest.approx(jumps[0] / 5, rel=0.2)


def test_where_a_course_crosses_itself_the_progress_tells_which_way():
    """The maze's path crosses itself north of the island; at the crossing, the way is that of the progress made."""
    course = maze_course()
    points = np.stack([course.x, course.y], axis=-1)
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    far = np.abs(np.subtract.outer(np.arange(len(points)), np.arange(len(points)))) > 100
    first, second = sorted(
        np.unravel_index(np.argmin(np.where(far, distances, np.inf)), distances.shape)
    )
    assert distances[first, second] < course.spacing
    for node in (first, second):
        progress = course.spacing * node - 0.03
        result = located(course, progress, *points[node])
        assert result.progress == pytest.approx(course.spacing * node, abs=1e-4)
        heading = course.heading[node]
        np.testing.assert_allclose(result.tangent, [np.cos(heading), np.sin(heading)], atol=1e-3)


def test_who_walks_beside_the_maze_path_keeps_its_error_and_reaches_the_end():
    """Walked in steps of 4 mm, 3 cm to the left and then to the right, swaying back by 2 mm in every step."""
    course = maze_course()
    points = np.stack([course.x, course.y], axis=-1)
    normal = np.stack([-np.sin(course.heading), np.cos(course.heading)], axis=-1)
    for offset in (0.03, -0.03):
        walk = points + offset * normal
        index = np.arange(0.0, len(points) - 1, 0.4)
        index[1::2] -= 0.2
        walked = np.stack(
            [np.interp(index, np.arange(len(points)), column) for column in walk.T], axis=-1
        )

        def step(progress, position):
            result = locate(course, progress, position)
            return result.progress, result

        places = jnp.asarray(np.pad(walked, ((0, 0), (0, 1))), jnp.float32)
        _, result = jax.lax.scan(step, jnp.float32(0.0), places)
        np.testing.assert_allclose(result.error, offset, atol=3e-4)
        progress = np.asarray(result.progress, float)
        assert (np.diff(progress) >= 0.0).all()
        np.testing.assert_allclose(
            progress, np.maximum.accumulate(index) * course.spacing, atol=1e-3
        )


def test_a_robot_that_was_carried_away_is_looked_for_near_its_progress():
    """On the far side of a circle or back at its start, the progress moves by the window at most and never falls."""
    course = course_through(circle(0.5, 1.0))
    across, back = located(course, 0.3, 1.0, -0.1), located(course, 1.0, 0.0, 0.0)
    assert 0.3 <= across.progress <= 0.3 + WINDOW_AHEAD_METRES + 2 * course.spacing
    assert back.progress == 1.0
    # The error and the tangent are those of the window's end, a little less than 1 m along the circle.
    turned = (1.0 - WINDOW_BEHIND_METRES) / 0.5
    np.testing.assert_allclose(
        back.tangent, [np.sin(turned), -np.cos(turned)], atol=2 * course.spacing / 0.5
    )
    assert np.isfinite([across.error, back.error]).all()


def test_gradients_are_finite_and_point_left():
    """The error's gradient by the position is the unit vector to the left, for points on the course as well.

    Tolerance: between two samples the nearest point moves along a chord, and the tangent turns by up to 1 cm / R.
    """
    course = maze_course()
    slope = jax.jit(jax.grad(lambda position, progress: locate(course, progress, position).error))
    for node, offset in ((100, 0.0), (173, 0.02), (260, -0.03), (430, 0.01)):
        heading = course.heading[node]
        normal = np.array([-np.sin(heading), np.cos(heading)])
        position = np.array([course.x[node], course.y[node]]) + offset * normal
        gradient = slope(
            jnp.asarray([*position, 0.0], jnp.float32), jnp.float32(course.spacing * node)
        )
        np.testing.assert_allclose(gradient[:2], normal, atol=0.02)
        assert gradient[2] == 0.0
    for position in ([1e30, 0.0, 0.0], [np.inf, -np.inf, 0.0], [0.0, 0.0, 0.0]):
        result = jitted(course)(jnp.float32(0.5), jnp.asarray(position, jnp.float32))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))
        assert np.isfinite(slope(jnp.asarray(position, jnp.float32), jnp.float32(0.5))).all()


def test_a_batch_is_its_members():
    """Leading axes broadcast, and vmap gives the same."""
    course = maze_course()
    progress = jnp.linspace(0.0, course.length, 24).reshape(4, 6)
    positions = jnp.asarray(np.random.default_rng(3).uniform(-1, 1, (4, 6, 3)), jnp.float32)
    one_by_one = functools.partial(locate, course)
    result_of_nested = jax.jit(one_by_one)(progress, positions)
    result_of_mapped = jax.jit(jax.vmap(jax.vmap(one_by_one)))(progress, positions)
    for nested, mapped in zip(
        jax.tree.leaves(result_of_nested), jax.tree.leaves(result_of_mapped), strict=True
    ):
        np.testing.assert_allclose(nested, mapped, atol=1e-5)
    assert result_of_nested.tangent.shape == (4, 6, 2)


def test_a_course_is_a_value():
    """Equal way points give equal, hashable courses, so that programs compiled for one are found again."""
    course, equal = course_through(LINE), course_through(np.array(LINE))
    assert course == equal
    assert hash(course) == hash(equal)
    assert course != course_through(LINE, spacing=0.02)


def test_the_maze_path_is_as_long_as_published_and_clear_of_the_boxes():
    """About 5 m; clearance by a distance to rectangles of the test's own; the figures are those of its docstring."""
    course = course_through(MAZE_COURSE, spacing=0.002)
    points = np.stack([course.x, course.y], axis=-1)
    assert 4.7 <= course.length <= 5.3
    assert course.length == pytest.approx(4.97, abs=0.005)
    assert clearance(points).min() == pytest.approx(0.150, abs=5e-4)
    assert 0.354 <= course.smallest_radius < 0.356


def test_the_maze_path_goes_from_the_start_once_round_the_island_and_out():
    """It starts at the origin along -y, turns about the island's middle by one round, and leaves between 8 and 34."""
    course = maze_course()
    points = np.stack([course.x, course.y], axis=-1)
    np.testing.assert_array_equal(points[0], 0.0)
    assert course.heading[0] == pytest.approx(-np.pi / 2, abs=np.radians(0.5))
    offsets = points - ISLAND
    round_ = np.diff(np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0]))[[0, -1]])[0]
    assert 1.0 <= abs(round_) / (2 * np.pi) < 1.5
    through = np.flatnonzero(np.diff(np.sign(points[:, 1] + 0.919)))[-1]
    assert 0.771 < points[through, 0] < 1.267
    assert points[-1, 1] > -0.869 + 0.25  # the tail, 0.23 m behind the torso, has left the gap
    assert course.heading[-1] % (2 * np.pi) == pytest.approx(np.pi / 2, abs=np.radians(2.0))
