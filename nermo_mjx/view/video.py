"""Videos of one recording, or of several side by side, with strips below the picture that scroll with time.

A strip, of footfall or of servo angles, is drawn once for the whole run; each frame shows the part around its own time.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import itertools
import math
import os
import shutil
import textwrap
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nermo_mjx.files import TEMPORARY_SUFFIX
from nermo_mjx.plotting.style import FOOT, INK, OKABE_ITO, TAIL_COLOUR
from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot.assembly import EYE_CAMERAS
from nermo_mjx.robot.parameters import LIMBS
from nermo_mjx.robot.quantity import ParameterError, choice
from nermo_mjx.view import offscreen
from nermo_mjx.view.camera import (
    CAMERAS,
    STEREO,
    body_radius,
    draw_support,
    following_camera,
    move_sun_above,
    put_pose,
    put_sun_overhead,
    root_body,
    smooth_path,
)
from nermo_mjx.view.recorded import STANCE_NEWTONS, finite_count, spans

#: Called with (frames done, frames in all).
CountDone = Callable[[int, int], None]
VIDEO_SUFFIXES: Final = (".mp4", ".gif", ".webp")
#: What ffmpeg is told; its quality of WebP is that of JPEG, which blurs text below 70.
_CODECS: Final[dict[str, dict[str, Any]]] = {
    ".mp4": {"codec": "libx264", "quality": 8, "output_params": ["-movflags", "+faststart"]},
    ".webp": {
        "codec": "libwebp_anim",
        "quality": None,
        "output_params": ["-quality", "70", "-loop", "0"],
    },
}


class VideoError(RuntimeError):
    """A video that cannot be made; the message is one sentence, with the remedy where there is one."""


#: Matplotlib's pixels per inch, and mean width of a character of a caption [pixels].
VIDEO_DPI: Final = 100
CHARACTER_PIXELS: Final = 6.6
#: Grey of the paper.
PAPER_GREY: Final = 255


def blank_strip(width: int, height: int) -> Figure:
    """A blank figure of the given size in pixels."""
    figure = Figure(
        figsize=(width / VIDEO_DPI, height / VIDEO_DPI), dpi=VIDEO_DPI, facecolor="white"
    )
    FigureCanvasAgg(figure)
    return figure


def write_text(figure: Figure, x: float, y: float, text: str, **style: Any) -> None:
    """Write a text whose upper left corner is at the given pixels from that of the figure."""
    width, height = figure.get_size_inches() * VIDEO_DPI
    figure.text(x / width, 1 - y / height, text, **({"va": "top", "color": INK} | style))


def pixels(figure: Figure) -> UInt8[np.ndarray, "height width 3"]:
    """The figure as pixels."""
    canvas: Any = figure.canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


#: Time range shown in a frame [s]: the past, and, paler, the future.
PAST_SECONDS: Final = 2.0
FUTURE_SECONDS: Final = 0.75
#: Width of the column with names and scales, and height of the time's scale [pixels].
MARGIN_PIXELS, SCALE_PIXELS = 44, 15
ROW_COLOURS: Final = FOOT | {"spine": OKABE_ITO["green"]}
#: Names of the limbs in a narrow column.
LIMB_LABELS: Final = {limb: "".join(word[0] for word in limb.split("_")).upper() for limb in LIMBS}
#: Gap above each row [pixels].
ROW_GAP_PIXELS: Final = 5
#: Half a label of the time's scale [pixels].
_HALF_LABEL_PIXELS: Final = 12
#: Widest picture that is drawn at once [pixels].
_WIDEST_PIXELS: Final = 4000


@dataclasses.dataclass(frozen=True)
class StripPanel:
    """One row of a strip.

    Attributes:
        height: in pixels, without the gap above it.
        low, high: ends of the vertical axis.
        draw: draws onto matplotlib's axes over time [s].
        notes: (value, text, colour) in the column next to it.
    """

    height: int
    low: float
    high: float
    draw: Callable[[Any], None]
    notes: tuple[tuple[float, str, str], ...]


class Strip:
    """A strip of one recording, `width` pixels wide, for times of the recording [s]."""

    def __init__(self, recording: Recording, panels: list[StripPanel], width: int) -> None:
        self.begin, self.end = float(recording.time[0]), float(recording.time[-1])
        self._width = width
        self._rate = (width - MARGIN_PIXELS) / min(
            PAST_SECONDS + FUTURE_SECONDS, max(self.end - self.begin, 1e-3)
        )  # pixels per second
        self._rows, top = list[tuple[int, StripPanel]](), ROW_GAP_PIXELS
        for panel in panels:
            self._rows.append((top, panel))
            top += panel.height + ROW_GAP_PIXELS
        self.height = top - ROW_GAP_PIXELS + SCALE_PIXELS
        self.height += self.height % 2
        column = blank_strip(MARGIN_PIXELS, self.height)
        for top, panel in self._rows:
            for value, text, colour in panel.notes:
                share = (panel.high - value) / (panel.high - panel.low)
                style = {"fontsize": 7.5, "ha": "right", "va": "center", "color": colour}
                write_text(column, MARGIN_PIXELS - 4, top + share * panel.height, text, **style)
        self._column = pixels(column)
        self._run = np.concatenate(list(self._draw_run()), axis=1)

    def at(self, seconds: float) -> UInt8[np.ndarray, "height width 3"]:
        """The strip around a time since the recording began [s]."""
        room = self._width - MARGIN_PIXELS
        column = round(self._rate * seconds)
        first = int(
            np.clip(column - round(self._rate * PAST_SECONDS), 0, self._run.shape[1] - room)
        )
        window, now = self._run[:, first : first + room].copy(), min(column - first, room - 1)
        window[:, now:] = PAPER_GREY - (PAPER_GREY - window[:, now:].astype(int)) * 2 // 5
        window[: -SCALE_PIXELS + 3, now : now + 1] = 0x22
        return np.concatenate([self._column, window], axis=1)

    def _draw_run(self) -> Iterator[UInt8[np.ndarray, "height part 3"]]:
        """The whole run, in parts."""
        total = max(round(self._rate * (self.end - self.begin)), self._width - MARGIN_PIXELS)
        for first in range(0, total, _WIDEST_PIXELS):
            width = min(_WIDEST_PIXELS, total - first)
            since = self.begin + first / self._rate
            until = since + width / self._rate
            figure = blank_strip(width, self.height)
            for top, panel in self._rows:
                run_columns = (
                    0.0,
                    1 - (top + panel.height) / self.height,
                    1.0,
                    panel.height / self.height,
                )
                axes = figure.add_axes(run_columns)
                axes.axis("off")
                axes.set(xlim=(since, until), ylim=(panel.low, panel.high))
                axes.axvspan(since, until, color="#f3f3f3", zorder=0, linewidth=0)
                panel.draw(axes)
            for half in range(int(np.floor(2 * since)), int(np.ceil(2 * until)) + 1):
                offset = (half / 2 - since) * self._rate
                if (
                    _HALF_LABEL_PIXELS < first + offset < total - _HALF_LABEL_PIXELS
                ):  # else it would be clipped
                    write_text(
                        figure,
                        offset,
                        self.height - SCALE_PIXELS + 1,
                        f"{half / 2:g} s",
                        fontsize=7.5,
                        ha="center",
                    )
            yield pixels(figure)


def gait_panels(recording: Recording) -> list[StripPanel]:
    """A bar for each foot in stance (a Hildebrand diagram), and for the tail while it is loaded."""
    force = np.asarray(recording.sensors["foot_force"])
    rows = {LIMB_LABELS[limb]: ROW_COLOURS[limb] for limb in LIMBS}
    if "tail_force" in recording.sensors:
        force = np.column_stack([force, recording.sensors["tail_force"]])
        rows["tail"] = TAIL_COLOUR
    standing, top = force > STANCE_NEWTONS, len(rows) - 1

    def draw(axes: Any) -> None:
        for row, colour in enumerate(rows.values()):
            axes.broken_barh(
                spans(standing[:, row], recording.time), (top - row + 0.12, 0.76), color=colour
            )

    notes = tuple(
        (top + 0.5 - row, name, colour) for row, (name, colour) in enumerate(rows.items())
    )
    return [StripPanel(13 * len(rows), 0.0, float(len(rows)), draw, notes)]


def servo_panels(recording: Recording) -> list[StripPanel]:
    """Angles of hips, knees and spine [degrees]: measured, and, paler, commanded."""
    measured = np.degrees(np.asarray(recording.sensors["servo_angle"]))
    commanded = np.degrees(np.asarray(recording.ctrl))
    panels = []
    for name, columns in {"hip": range(4), "knee": range(4, 8), "spine": range(8, 9)}.items():
        angles = np.concatenate([measured[:, columns], commanded[:, columns]])
        low, high = float(np.nanmin(angles)), float(np.nanmax(angles))
        middle, half = (low + high) / 2, max((high - low) / 2, 1.0)

        def draw(axes: Any, name: str = name, columns: range = columns) -> None:
            for column in columns:
                colour = ROW_COLOURS["spine" if name == "spine" else LIMBS[column % 4]]
                axes.plot(
                    recording.time, commanded[:, column], color=colour, linewidth=2.2, alpha=0.3
                )
                axes.plot(recording.time, measured[:, column], color=colour, linewidth=1.1)

        ends = [
            (limit_angle, f"{limit_angle:.0f}°", INK)
            for limit_angle in (middle + half, middle - half)
        ]
        notes = (ends[0], (middle, name, ROW_COLOURS.get(name, INK)), ends[1])
        panels.append(StripPanel(46, middle - 1.15 * half, middle + 1.15 * half, draw, notes))
    return panels


#: Sensors that an overlay needs, and what makes its rows of the strip below the image; None: drawn into the scene.
#: `gait`: a bar for each standing foot; `servos`: their angles; `support`: polygon and centre of mass on the ground.
OVERLAYS: Final[
    dict[str, tuple[tuple[str, ...], Callable[[Recording], list[StripPanel]] | None]]
] = {
    "gait": (("foot_force",), gait_panels),
    "servos": (("servo_angle",), servo_panels),
    "support": (("foot_force", "foot_position"), None),
}


def check_overlays(names: Sequence[str], recording: Recording | None = None) -> None:
    """Reject unknown overlays, and those for which a recording lacks the sensors.

    Raises:
        ParameterError: an unknown name, or one that is given twice.
        RecordingError: a sensor is missing.
    """
    for name in names:
        choice("overlay", name, OVERLAYS)
        missing = [
            sensor for sensor in OVERLAYS[name][0] if recording and sensor not in recording.sensors
        ]
        if missing:
            raise RecordingError(
                f"The overlay {name!r} needs the sensor {missing[0]!r}, which the recording lacks."
            )
    if len(set(names)) < len(names):
        raise ParameterError(f"overlay is {', '.join(names)}: allowed is each name once.")


def write_video(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "height width 3"]],
    count: int,
    *,
    fps: int,
    width: int,
    height: int,
    progress: CountDone | None = None,
) -> Path:
    """Encode frames as they arrive; the file appears only when it is complete.

    Args:
        count: of the frames.
        progress: called with (frames done, frames in all).

    Raises:
        VideoError: it cannot be written.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}{TEMPORARY_SUFFIX}{path.suffix.lower()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.touch()  # fail on an unwritable path before ffmpeg starts, and before the first frame is drawn
        remaining_frames = iter(frames)
        first = next(
            remaining_frames
        )  # and on a frame that cannot be drawn before ffmpeg waits for it
        with _writer(partial, fps, width, height, count) as write:
            for frame_count, frame in enumerate(
                itertools.chain([first], remaining_frames), start=1
            ):
                write(frame)
                if progress is not None:
                    progress(frame_count, count)
        partial.replace(path)
    except OSError as error:
        reason = (
            error.strerror or str(error).partition("\n")[0]
        )  # imageio quotes all that ffmpeg printed
        raise VideoError(f"{path}: the video cannot be written ({reason}).") from None
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()
    return path


@contextlib.contextmanager
def _writer(
    path: Path, fps: int, width: int, height: int, count: int
) -> Iterator[Callable[[np.ndarray], object]]:
    if path.suffix == ".gif":
        import imageio.v2 as imageio

        # A frame lasts whole hundredths of a second: some last one more, so that the average rate is the requested one.
        lasts = np.diff(np.round(np.arange(count + 1) * 100.0 / fps) * 10.0).tolist()
        duration = lasts if count > 1 else lasts[0]  # as Pillow has it
        writer: Any = imageio.get_writer(path, format="GIF", mode="I", duration=duration, loop=0)
        with writer:
            yield writer.append_data
        return
    encoder = require_encoder().write_frames(
        str(path),
        (width, height),
        fps=fps,
        pix_fmt_out="yuv420p",
        macro_block_size=2,
        ffmpeg_log_level="error",
        **_CODECS[path.suffix],
    )
    with warnings.catch_warnings():
        # JAX warns of every fork; the child becomes ffmpeg at once.
        warnings.simplefilter("ignore", RuntimeWarning)
        encoder.send(None)
    try:
        yield lambda frame: encoder.send(np.ascontiguousarray(frame))
    finally:
        encoder.close()


def require_encoder() -> Any:
    """The module that bundles and runs ffmpeg; raises `VideoError` if it is not installed."""
    try:
        import imageio_ffmpeg

        program = imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise VideoError(
            "No ffmpeg encodes MP4 or WebP: `pip install imageio-ffmpeg`, or write a .gif."
        ) from None
    if shutil.which(program) is None:  # the user's choice, which imageio-ffmpeg does not check
        raise VideoError(
            f"IMAGEIO_FFMPEG_EXE is {program!r}, which cannot be run: unset it, or write a .gif."
        )
    return imageio_ffmpeg


#: Without a graphics card, the time of a frame depends on its samples, shadow map, reflections and facets.
SHADOW_MAP: Final = 2048
SAMPLES: Final = 4
SLICES: Final = 14
STACKS: Final = 8

#: Frames per second of a GIF: players show a frame of less than two hundredths of a second for ten.
MAX_GIF_RATE_HZ: Final = 50


#: Height of a line of text, of the strip below the pictures, and of the gap between them [pixels].
_TEXT_LINE_PIXELS, _FOOTER_PIXELS, _IMAGE_GAP_PIXELS = 18, 40, 4
#: Robots in one row of a video.
MAX_ROW_ROBOTS = 3
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


# Many parameters because the options of a video are named.
def render(
    recording: Recording | Sequence[Pane],
    model: mujoco.MjModel,
    path: str | os.PathLike[str],
    *,
    fps: int = 30,
    width: int = 640,
    height: int = 480,
    camera: str = "three_quarter",
    speed: float = 1.0,
    overlays: Sequence[str] = (),
    progress: CountDone | None = None,
) -> Path:
    """Render a recording, or several side by side, into a video; the suffix chooses `.mp4`, `.gif` or `.webp`.

    Side by side, each robot has its own camera, its captions above, and a bar for its distance since the beginning
    below, on the same scale for all; the video is as long as the shortest recording. More than `MAX_ROW_ROBOTS` stand in
    pairs below one another.

    Args:
        recording: what to show, truncated where its state is no longer finite; or panes from left to right, row by row.
        model: the simulated model, one for all.
        path: the file; it appears only when it is complete.
        fps: frames per second of the video.
        width, height: size of one robot's picture in pixels, even except for GIF; strips of overlays stand below it.
        camera: a following view of `CAMERAS`, the name of a camera of the model, or `stereo` for the images of both
            eyes, each half as wide.
        speed: 1 is real time, 0.25 a quarter of it.
        overlays: names of `OVERLAYS`.
        progress: called with (frames done, frames in all).

    Raises:
        ParameterError: no panes, or an invalid option.
        VideoError: this machine cannot draw or encode.
        RecordingError: a recording does not fit the model.
    """
    panes = [Pane(recording, "")] if isinstance(recording, Recording) else recording
    if not panes:
        raise ParameterError("A video side by side needs at least one recording.")
    path = Path(path)
    check_video(
        model,
        path,
        fps=fps,
        width=width,
        height=height,
        camera=camera,
        speed=speed,
        overlays=overlays,
    )
    for pane in panes:
        check_overlays(overlays, pane.recording)
        pane.recording.check_model(model)
    samples = [frame_samples(pane.recording, fps, speed) for pane in panes]
    count = min(map(len, samples))
    samples = [each[:count] for each in samples]
    drawn = [
        draw_frames(
            pane.recording, pane.model or model, each, width, height, camera, speed / fps, overlays
        )
        for pane, each in zip(panes, samples, strict=True)
    ]
    pictures, height = drawn[0]
    if isinstance(recording, Recording):
        return write_video(
            path, pictures, count, fps=fps, width=width, height=height, progress=progress
        )
    beside = len(panes) if len(panes) <= MAX_ROW_ROBOTS else 2
    headers = _header(panes, width)
    ways = _distances(panes, model, samples, speed / fps)

    def frames() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        for i, row in enumerate(zip(*(pictures for pictures, _ in drawn), strict=True)):
            footers = _footer(i * speed / fps, speed, ways[:, i], ways.max(), width)
            panels = [np.concatenate(parts) for parts in zip(headers, row, footers, strict=True)]
            panels += [np.full_like(panels[0], PAPER_GREY)] * (-len(panels) % beside)
            yield np.concatenate(
                [_beside(panels[start : start + beside]) for start in range(0, len(panels), beside)]
            )

    height = (height + len(headers[0]) + _FOOTER_PIXELS) * math.ceil(len(panes) / beside)
    wide = beside * (width + _IMAGE_GAP_PIXELS) - _IMAGE_GAP_PIXELS
    return write_video(path, frames(), count, fps=fps, width=wide, height=height, progress=progress)


def _distances(
    panes: Sequence[Pane], model: mujoco.MjModel, samples: Sequence[np.ndarray], interval: float
) -> np.ndarray:
    """Distance of each robot from its start, without the sway of the steps (panes, frames) [m].

    Args:
        panes: Recordings.
        model: Simulated model.
        samples: Samples of each recording that are shown (frames,).
        interval: Time between two frames [s].
    """
    data, distances = mujoco.MjData(model), []
    for pane, shown in zip(panes, samples, strict=True):
        path = smooth_path(root_path(pane.recording, model, data, shown), interval)[:, :2]
        distances.append(np.linalg.norm(path - path[0], axis=1))
    return np.stack(distances)


def check_video(
    model: mujoco.MjModel,
    path: str | os.PathLike[str],
    *,
    fps: int = 30,
    width: int = 640,
    height: int = 480,
    camera: str = "three_quarter",
    speed: float = 1.0,
    overlays: Sequence[str] = (),
) -> None:
    """Reject an impossible video before a long run is made for it; arguments as for `render`.

    Raises:
        ParameterError: an invalid option.
        VideoError: this machine cannot draw or encode.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in VIDEO_SUFFIXES:
        allowed = f"{', '.join(VIDEO_SUFFIXES[:-1])} or {VIDEO_SUFFIXES[-1]}"
        raise ParameterError(
            f"{path}: a video ends in {allowed}, not in {path.suffix or 'nothing'!r}."
        )
    if suffix == ".gif" and fps > MAX_GIF_RATE_HZ:
        raise ParameterError(
            f"fps is {fps}: allowed is [1, {MAX_GIF_RATE_HZ}] in a GIF, which players show slowly past it."
        )
    if not (1 <= fps <= 240 and speed > 0 and 16 <= width <= 7680 and 16 <= height <= 4320):
        raise ParameterError(
            f"A video of {width} x {height} pixels, {fps} frames/s and speed {speed:g} cannot be made: allowed are "
            "16 x 16 to 7680 x 4320 pixels, 1 to 240 frames/s, and a speed above 0."
        )
    if suffix != ".gif" and (width % 2 or height % 2):
        raise ParameterError(
            f"A video {suffix} needs an even width and height, not {width} x {height}."
        )
    model_cameras = [model.camera(i).name for i in range(model.ncam)]
    camera_names = [
        *CAMERAS,
        *filter(None, model_cameras),
        *([STEREO] if set(EYE_CAMERAS) <= set(model_cameras) else []),
    ]
    if camera not in camera_names:
        raise ParameterError(f"camera is {camera!r}: allowed is one of {', '.join(camera_names)}.")
    if camera == STEREO and width % 2:
        raise ParameterError(
            f"width is {width}: allowed is an even number with camera {STEREO}, half for each eye."
        )
    check_overlays(overlays)
    if suffix != ".gif":
        require_encoder()
    try:
        offscreen.require_gl()
    except offscreen.RenderingUnavailable as error:
        raise VideoError(str(error)) from None


def frame_samples(recording: Recording, fps: float, speed: float) -> Int[np.ndarray, " F"]:
    """The sample of the recording in each frame: the nearest in time."""
    count = finite_count(np.isfinite(recording.qpos))
    time = recording.time[:count] - recording.time[0]
    frame_times = np.arange(0.0, time[-1] + 1e-9, speed / fps)
    next_samples = np.clip(np.searchsorted(time, frame_times), 0, count - 1)
    previous_samples = np.maximum(next_samples - 1, 0)
    return np.where(
        frame_times - time[previous_samples] < time[next_samples] - frame_times,
        previous_samples,
        next_samples,
    )


def draw_frames(
    recording: Recording,
    model: mujoco.MjModel,
    samples: Int[np.ndarray, " F"],
    width: int,
    height: int,
    camera: str,
    interval: float,
    overlays: Sequence[str] = (),
) -> tuple[Iterator[UInt8[np.ndarray, "rows width 3"]], int]:
    """The picture of each sample, and their height; `interval` is the simulated time between two of them [s]."""
    makers = [OVERLAYS[name][1] for name in overlays]
    strips = [Strip(recording, panels(recording), width) for panels in makers if panels is not None]
    model = _dressed(model, width, height)
    data, root = mujoco.MjData(model), root_body(model)
    tip = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "tail_tip")

    def frames() -> Iterator[UInt8[np.ndarray, "rows width 3"]]:
        put_pose(model, data, recording.qpos[samples[0]])
        # A following camera looks at the middle of the body.
        centre, radius = body_radius(model, data, root)
        middle = centre - data.xpos[root]
        path = smooth_path(root_path(recording, model, data, samples), interval) + middle
        fovy = float(model.vis.global_.fovy)
        following = (
            following_camera(camera, radius, fovy, width / height) if camera in CAMERAS else None
        )
        views: list[Any] = (
            [following] if following else [*EYE_CAMERAS] if camera == STEREO else [camera]
        )
        with _renderer(model, width // len(views), height) as renderer:
            for i, (sample, point) in enumerate(zip(samples, path, strict=True)):
                put_pose(model, data, recording.qpos[sample])
                mujoco.mj_camlight(model, data)
                mujoco.mj_tendon(model, data)
                if following is not None:
                    following.lookat[:] = point
                move_sun_above(model, data, point)
                pictures = []
                for view in views:
                    renderer.update_scene(data, view)
                    if "support" in overlays:
                        tail = data.geom_xpos[tip] if tip >= 0 else None
                        draw_support(
                            renderer.scene, recording, int(sample), data.subtree_com[root], tail
                        )
                    pictures.append(renderer.render())
                yield np.concatenate(
                    [
                        np.concatenate(pictures, axis=1),
                        *(strip.at(i * interval) for strip in strips),
                    ]
                )

    return frames(), height + sum(strip.height for strip in strips)


def _dressed(model: mujoco.MjModel, width: int, height: int) -> mujoco.MjModel:
    """A copy of the model for fast software rendering, with a large enough buffer."""
    model = copy.copy(model)
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    quality = model.vis.quality
    quality.shadowsize = min(quality.shadowsize, SHADOW_MAP)
    quality.offsamples = min(quality.offsamples, SAMPLES)
    quality.numslices = min(quality.numslices, SLICES)
    quality.numstacks = min(quality.numstacks, STACKS)
    model.mat_reflectance[:] = 0.0
    put_sun_overhead(model)
    return model


def root_path(
    recording: Recording, model: mujoco.MjModel, data: mujoco.MjData, samples: Int[np.ndarray, " F"]
) -> Float[np.ndarray, "F 3"]:
    """Position of the followed body in each of the samples [m]; `data` is scratch space."""
    root = root_body(model)
    positions = np.empty((len(samples), 3))
    for i, sample in enumerate(samples):
        put_pose(model, data, recording.qpos[sample])
        positions[i] = data.xpos[root]
    return positions


def _renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW's warnings are repeated in its error
            return mujoco.Renderer(model, height, width)
    except Exception as error:  # every GL library fails in its own way
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise VideoError(
            f"MuJoCo cannot draw on this machine ({reason}): install libosmesa6 (`apt-get install libosmesa6`) and set "
            "MUJOCO_GL=osmesa."
        ) from error


def _header(panes: Sequence[Pane], width: int) -> list[UInt8[np.ndarray, "height width 3"]]:
    """The captions above each picture, all with the height of the longest."""
    character_limit = int(width / CHARACTER_PIXELS)
    texts = [
        [part for line in pane.caption for part in textwrap.wrap(line, character_limit)]
        for pane in panes
    ]
    height = _TEXT_LINE_PIXELS * (1 + max(map(len, texts))) + 10
    strips = []
    for pane, lines in zip(panes, texts, strict=True):
        figure = blank_strip(width, height + height % 2)
        write_text(figure, 8, 4, pane.title, fontsize=10.5, fontweight="bold")
        for i, line in enumerate(lines, start=1):
            write_text(figure, 8, 5 + i * _TEXT_LINE_PIXELS, line, fontsize=8.5)
        strips.append(pixels(figure))
    return strips


def _footer(
    seconds: float, speed: float, ways: Float[np.ndarray, " panes"], furthest: float, width: int
) -> list[UInt8[np.ndarray, "height width 3"]]:
    """A bar for each robot's distance, with its value in millimetres, and the time."""
    strips = []
    room = width - 16
    for i, way in enumerate(ways):
        figure = blank_strip(width, _FOOTER_PIXELS)
        slowed = {1.0: "", 0.5: ", half speed"}.get(speed, f", speed {speed:g}")
        clock = f"{seconds:.2f} s{slowed}"
        write_text(
            figure, 8, 19, f"{1e3 * way:.0f} mm" + (f" in {clock}" if i == 0 else ""), fontsize=8.5
        )
        strip = pixels(figure)
        strip[7:15, 8 : 8 + room] = _TRACK
        strip[7:15, 8 : 8 + round(room * way / max(furthest, 1e-6))] = _BAR
        strips.append(strip)
    return strips


def _beside(pictures: list[np.ndarray]) -> UInt8[np.ndarray, "height width 3"]:
    """Pictures of one height in a row, a little apart."""
    gap = np.full((len(pictures[0]), _IMAGE_GAP_PIXELS, 3), PAPER_GREY, np.uint8)
    parts = [part for picture in pictures for part in (gap, picture)][1:]
    return np.concatenate(parts, axis=1)
