"""Several recordings in one video, side by side and synchronised, each with its caption and its distance."""

from __future__ import annotations

import dataclasses
import os
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from nermo_mjx.recording import Recording
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.view import ink
from nermo_mjx.view.camera import smooth_path
from nermo_mjx.view.encoding import CountDone, write_video
from nermo_mjx.view.overlays import check_overlays
from nermo_mjx.view.video import check_video, draw, frame_samples, root_path

#: Height of a line of text, of the strip below the pictures, and of the gap between them [pixels].
_LINE, _FOOTER, _GAP = 18, 40, 4
_BAR, _TRACK = (35, 100, 143), (226, 226, 226)


@dataclasses.dataclass(frozen=True)
class Pane:
    """One recording and its caption.

    Attributes:
        recording: from its first sample on.
        title: in bold.
        caption: lines below the title; long ones are wrapped.
        model: of its own robot, if its geometry differs from the common model's.
    """

    recording: Recording
    title: str
    caption: Sequence[str] = ()
    model: mujoco.MjModel | None = None


def render_side_by_side(
    panes: Sequence[Pane],
    model: mujoco.MjModel,
    path: str | os.PathLike[str],
    *,
    fps: int = 25,
    width: int = 480,
    height: int = 360,
    camera: str = "three_quarter",
    speed: float = 1.0,
    overlays: Sequence[str] = (),
    progress: CountDone | None = None,
) -> Path:
    """Render recordings of one model into one video; it is as long as the shortest of them.

    Each robot has its own camera. A bar below it shows its distance since the beginning, on the same scale for all.

    Args:
        panes: from left to right.
        model, path, fps, camera, speed, overlays, progress: as for `render`.
        width, height: of one picture in pixels; the video has all of them and their captions.

    Raises:
        ParameterError: no panes, or an invalid option.
        VideoError: this machine cannot draw or encode.
        RecordingError: a recording does not fit the model.
    """
    if not panes:
        raise ParameterError("A video side by side needs at least one recording.")
    path = Path(path)
    check_video(model, path, fps=fps, width=width, height=height, camera=camera, speed=speed, overlays=overlays)
    for pane in panes:
        pane.recording.check_model(model)
        check_overlays(overlays, pane.recording)
    samples = [frame_samples(pane.recording, fps, speed) for pane in panes]
    count = min(map(len, samples))
    samples = [each[:count] for each in samples]
    header = _header(panes, width)
    ways = _ways(panes, model, samples, speed / fps)
    drawn = [
        draw(pane.recording, pane.model or model, each, width, height, camera, speed / fps, overlays)
        for pane, each in zip(panes, samples, strict=True)
    ]

    def frames() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        for i, row in enumerate(zip(*(pictures for pictures, _ in drawn), strict=True)):
            footer = _footer(i * speed / fps, speed, ways[:, i], ways.max(), width)
            yield np.concatenate([header, _beside(list(row)), footer])

    size = (header.shape[1], header.shape[0] + drawn[0][1] + _FOOTER)
    return write_video(path, frames(), count, fps=fps, width=size[0], height=size[1], progress=progress)


def _ways(
    panes: Sequence[Pane], model: mujoco.MjModel, samples: Sequence[np.ndarray], interval: float
) -> Float[np.ndarray, "panes F"]:
    """Distance of each robot from its start, without the sway of the steps [m]."""
    data, ways = mujoco.MjData(model), []
    for pane, each in zip(panes, samples, strict=True):
        positions = smooth_path(root_path(pane.recording, model, data, each), interval)[:, :2]
        ways.append(np.linalg.norm(positions - positions[0], axis=1))
    return np.array(ways)


def _header(panes: Sequence[Pane], width: int) -> UInt8[np.ndarray, "height width 3"]:
    """The captions above the pictures, all with the height of the longest."""
    most = int(width / ink.CHARACTER)
    texts = [[part for line in pane.caption for part in textwrap.wrap(line, most)] for pane in panes]
    height = _LINE * (1 + max(map(len, texts))) + 10
    strips = []
    for pane, lines in zip(panes, texts, strict=True):
        figure = ink.strip(width, height + height % 2)
        ink.write(figure, 8, 4, pane.title, fontsize=10.5, fontweight="bold")
        for i, line in enumerate(lines, start=1):
            ink.write(figure, 8, 5 + i * _LINE, line, fontsize=8.5)
        strips.append(ink.pixels(figure))
    return _beside(strips)


def _footer(
    seconds: float, speed: float, ways: Float[np.ndarray, " panes"], furthest: float, width: int
) -> UInt8[np.ndarray, "height width 3"]:
    """A bar for each robot's distance, with its value in millimetres, and the time."""
    strips = []
    room = width - 16
    for i, way in enumerate(ways):
        figure = ink.strip(width, _FOOTER)
        slowed = {1.0: "", 0.5: ", half speed"}.get(speed, f", speed {speed:g}")
        clock = f"{seconds:.2f} s{slowed}"
        ink.write(figure, 8, 19, f"{1e3 * way:.0f} mm" + (f" in {clock}" if i == 0 else ""), fontsize=8.5)
        strip = ink.pixels(figure)
        strip[7:15, 8 : 8 + room] = _TRACK
        strip[7:15, 8 : 8 + round(room * way / max(furthest, 1e-6))] = _BAR
        strips.append(strip)
    return _beside(strips)


def _beside(pictures: list[np.ndarray]) -> UInt8[np.ndarray, "height width 3"]:
    """Pictures of one height in a row, a little apart."""
    gap = np.full((len(pictures[0]), _GAP, 3), ink.PAPER, np.uint8)
    parts = [part for picture in pictures for part in (gap, picture)][1:]
    return np.concatenate(parts, axis=1)
