"""The path through the maze, drawn once: way points in the frame of the scene `maze` (x left, y backward)."""

from __future__ import annotations

import functools
from typing import Final

from nermo_mjx.control.course import Course, course_through

#: Way points (x, y) of the maze's path [m]. The published path is not available; this one follows the published layout:
#: from the origin, heading -y, through the corridor between the boxes 32 and 39, past the island (boxes 1 to 7) on its
#: left, once around it to the right, and out between the boxes 8 and 34, until the tail has left the gap, too. The
#: points were placed by maximizing the clearance from the boxes while bounding the curvature, and rounded to 5 mm.
#: As drawn: 4.97 m long, at least 0.150 m from every box, radius of curvature at least 0.354 m (checked by a test).
MAZE_COURSE: Final[tuple[tuple[float, float], ...]] = (
    (0.0, 0.0), (0.0, -0.15), (0.0, -0.345), (0.02, -0.61), (0.12, -0.845), (0.265, -1.105), (0.265, -1.335),
    (0.145, -1.52), (-0.195, -1.615), (-0.43, -1.485), (-0.525, -1.26), (-0.465, -1.02), (-0.205, -0.84),
    (0.08, -0.885), (0.34, -1.075), (0.59, -1.175), (0.865, -1.12), (1.025, -0.95), (1.075, -0.695), (1.08, -0.48),
)  # fmt: skip


@functools.cache
def maze_course() -> Course:
    """The smooth course through `MAZE_COURSE`."""
    return course_through(MAZE_COURSE)
