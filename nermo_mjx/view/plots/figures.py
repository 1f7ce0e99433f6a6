"""The figures of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from matplotlib.figure import Figure

from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot import ParameterError, Robot
from nermo_mjx.view.plots.body import ground_path, orientation
from nermo_mjx.view.plots.feet import leg_paths, over_ground
from nermo_mjx.view.plots.gait_diagram import gait_diagram
from nermo_mjx.view.plots.servos import servo_angles
from nermo_mjx.view.plots.walk import Walk
from nermo_mjx.view.recorded_robot import robot_of


def figures_of(
    recording: Recording, notify: Callable[[str], None], robot: Robot | None = None
) -> Iterator[tuple[str, Figure]]:
    """The figures of a recording: `gait-diagram`, `orientation`, `foot-paths`, `foot-paths-over-ground`,
    `servo-angles` and `ground-path`.

    Args:
        recording: figures of missing data are left out.
        notify: called with a message about each figure that cannot be drawn.
        robot: that was recorded; by default assembled from the recording's setup.
    """
    for name, figure in _figures(Walk(recording), robot):
        if isinstance(figure, str):
            notify(f"There is no {name}: {figure}")
        else:
            yield name, figure


def _figures(walk: Walk, robot: Robot | None) -> Iterator[tuple[str, Figure | str]]:
    """(name, figure) of each, or the reason for its absence."""
    lacks = "the recording lacks its sensors."
    yield "gait-diagram", gait_diagram(walk) or lacks
    yield "orientation", orientation(walk) or lacks
    try:
        yield "foot-paths", leg_paths(walk, robot or robot_of(walk.recording)) or lacks
    except (RecordingError, ParameterError) as error:
        yield "foot-paths", str(error)
    yield "foot-paths-over-ground", over_ground(walk) or lacks
    yield "servo-angles", servo_angles(walk) or lacks
    yield "ground-path", ground_path(walk) or lacks
