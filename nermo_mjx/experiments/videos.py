"""The video of an experiment: one run of it, short enough to be drawn without a graphics card."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Final

from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.view import Recording, render, robot_of

#: A frame takes 0.1 to 0.15 s of one core without a graphics card, so that a video takes 25 s at most.
FPS: Final = 20
WIDTH, HEIGHT = 480, 360
LONGEST: Final = 8.0
#: Simulated time that is shown after a run has reached its end [s].
_AFTER: Final = 1.0


@dataclasses.dataclass(frozen=True)
class Shot:
    """The content of a video.

    Attributes:
        recording: part of the recording's name; if none matches, the last recording is shown.
        camera: a following view.
        speed: 1 is real time; a run that has an end is shown faster if it would take too long.
        until: column with the simulated time at which the run reached its end, if it has one.
    """

    recording: str = ""
    camera: str = "three_quarter"
    speed: float = 1.0
    until: str = ""

    def choose(self, outcome: Outcome) -> str | None:
        """Name of the recording that is shown; None if there is none."""
        names = list(outcome.recordings)
        return next((name for name in names if self.recording in name), names[-1] if names else None)


def shoot(outcome: Outcome, shot: Shot, path: Path, progress: Callable[[float], None] | None = None) -> float:
    """Render the video of an experiment that has a recording, and return its speed.

    Raises:
        VideoError: this machine cannot draw or encode.
        RecordingError: the recording was made with another version of the model.
    """
    name = shot.choose(outcome)
    assert name is not None
    recording = outcome.recordings[name]
    robot = robot_of(recording)
    end = _end(outcome, recording, shot)
    speed = max(shot.speed, float(math.ceil(end / LONGEST)) if math.isfinite(end) else 0.0)
    began = float(recording.time[0])
    shown = recording.between(began, began + min(speed * LONGEST, end))
    render(
        shown, robot.model, path, fps=FPS, width=WIDTH, height=HEIGHT, camera=shot.camera, speed=speed,
        progress=None if progress is None else lambda done, frames: progress(done / frames),
    )  # fmt: skip
    return speed


def _end(outcome: Outcome, recording: Recording, shot: Shot) -> float:
    """Simulated time after which nothing more happens."""
    labels = recording.metadata.get("labels", {})
    if shot.until not in outcome.columns or not set(labels) <= set(outcome.columns):
        return math.inf
    end = outcome.mean(shot.until, **labels)
    return end + _AFTER if math.isfinite(end) else math.inf
