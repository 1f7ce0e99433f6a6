"""The figures of a recording as files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from nermo_mjx.plotting.files import FORMATS, write_figures
from nermo_mjx.robot import ParameterError, Robot
from nermo_mjx.view.plots.body import ground_path, orientation
from nermo_mjx.view.plots.feet import leg_paths, over_ground
from nermo_mjx.view.plots.gait_diagram import gait_diagram
from nermo_mjx.view.plots.servos import servo_angles
from nermo_mjx.view.plots.walk import Walk
from nermo_mjx.view.recorded_robot import robot_of
from nermo_mjx.view.recording import Recording, RecordingError


@dataclasses.dataclass(frozen=True)
class Drawn:
    """The files, and a sentence on each figure that could not be drawn."""

    files: list[Path]
    notes: list[str]


def draw_recording(
    recording: Recording,
    folder: Path,
    *,
    robot: Robot | None = None,
    write: Callable[[Path, bytes], None] | None = None,
    formats: Sequence[str] = FORMATS,
) -> Drawn:
    """Draw the figures of a recording: `gait-diagram`, `orientation`, `foot-paths`, `foot-paths-over-ground`,
    `servo-angles` and `ground-path`.

    Args:
        recording: what it does not have is left out.
        folder: where the files go.
        robot: that was recorded; by default assembled from the recording's setup.
        write: how a file is written; `Path.write_bytes` if it is None.
        formats: of `png` and `svg`.
    """
    notes: list[str] = []

    def figures() -> Iterator[tuple[str, Figure]]:
        for name, figure in _figures(Walk(recording), robot):
            if isinstance(figure, str):
                notes.append(f"There is no {name}: {figure}")
            else:
                yield name, figure

    return Drawn(write_figures(figures(), folder, write, formats), notes)


def _figures(walk: Walk, robot: Robot | None) -> Iterator[tuple[str, Figure | str]]:
    """(name, figure) of each, or why there is none."""
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
