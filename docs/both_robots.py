"""Both robots at the beginning of a walk, from the side and from the front: `python docs/both_robots.py`.

Writes DIR/nermo_41.png.
"""

from __future__ import annotations

import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from nermo_mjx import Run, Setup, Simulator
from nermo_mjx.view import offscreen, robot_of
from nermo_mjx.view.video import blank_strip, draw_frames, pixels, write_text

ROBOTS = {"nermo_lite": "Nermo-Lite", "nermo_41": "Nermo 4.1"}
WIDTH, HEIGHT, STRIP = 640, 330, 40


def pictures(robot: str) -> np.ndarray:
    """Both views of a robot, side by side below its name, (height, 2 width, 3)."""
    recording = (
        Simulator(Setup(robot=robot), engine="c")
        .run({}, Run(duration=0.5), record=True)
        .recording(0)
    )
    views = []
    for camera in ("side", "three_quarter"):
        frames, _ = draw_frames(
            recording, robot_of(recording).model, np.array([0]), WIDTH, HEIGHT, camera, 1.0, ()
        )
        views.append(next(iter(frames)))
    strip = blank_strip(2 * WIDTH, STRIP)
    write_text(strip, 12, 10, ROBOTS[robot], fontsize=16, fontweight="bold")
    return np.concatenate([pixels(strip), np.concatenate(views, axis=1)])


if __name__ == "__main__":
    offscreen.require_gl()
    iio.imwrite(
        Path(sys.argv[1]) / "nermo_41.png", np.concatenate([pictures(robot) for robot in ROBOTS])
    )
