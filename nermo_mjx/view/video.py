"""Videos of recordings, drawn off-screen by MuJoCo and encoded as MP4 (H.264), GIF or animated WebP."""

from __future__ import annotations

import contextlib
import copy
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float, Int, UInt8

from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot.assembly import EYES
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.view import offscreen, sun
from nermo_mjx.view.camera import CAMERAS, STEREO, body_radius, following_camera, root_body, smooth_path
from nermo_mjx.view.encoding import SUFFIXES, CountDone, VideoError, require_encoder, write_video
from nermo_mjx.view.overlays import beside, check_overlays, scenery_of, strips_of

#: Without a graphics card, the time of a frame depends on its samples, shadow map, reflections and facets.
SHADOW_MAP: Final = 2048
SAMPLES: Final = 4
SLICES: Final = 14
STACKS: Final = 8

#: Frames per second of a GIF: players show a frame of less than two hundredths of a second for ten.
FASTEST_GIF: Final = 50


def render(
    recording: Recording,
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
    """Render a recording into a video file; the suffix chooses the format: `.mp4`, `.gif` or `.webp`.

    Args:
        recording: what to show; it is truncated where its state is no longer finite.
        model: the simulated model.
        path: the file; it appears only when it is complete.
        fps: frames per second of the video.
        width, height: size of the robot's picture in pixels, even except for GIF; strips of overlays stand below it.
        camera: a following view of `CAMERAS`, the name of a camera of the model, or `stereo` for the images of both
            eyes, each half as wide.
        speed: 1 is real time, 0.25 a quarter of it.
        overlays: names of `OVERLAYS`.
        progress: called with (frames done, frames in all).

    Raises:
        VideoError: the request cannot be drawn or encoded here.
        RecordingError: the recording does not fit the model.
    """
    path = Path(path)
    check_video(model, path, fps=fps, width=width, height=height, camera=camera, speed=speed, overlays=overlays)
    check_overlays(overlays, recording)
    recording.check_model(model)
    samples = frame_samples(recording, fps, speed)
    frames, height = draw(recording, model, samples, width, height, camera, speed / fps, overlays)
    return write_video(path, frames, len(samples), fps=fps, width=width, height=height, progress=progress)


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
    if suffix not in SUFFIXES:
        allowed = f"{', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}"
        raise ParameterError(f"{path}: a video ends in {allowed}, not in {path.suffix or 'nothing'!r}.")
    if suffix == ".gif" and fps > FASTEST_GIF:
        raise ParameterError(
            f"fps is {fps}: allowed is [1, {FASTEST_GIF}] in a GIF, which players show slowly past it."
        )
    if not (1 <= fps <= 240 and speed > 0 and 16 <= width <= 7680 and 16 <= height <= 4320):
        raise ParameterError(
            f"A video of {width} x {height} pixels, {fps} frames/s and speed {speed:g} cannot be made: allowed are "
            "16 x 16 to 7680 x 4320 pixels, 1 to 240 frames/s, and a speed above 0."
        )
    if suffix != ".gif" and (width % 2 or height % 2):
        raise ParameterError(f"A video {suffix} needs an even width and height, not {width} x {height}.")
    own = [model.camera(i).name for i in range(model.ncam)]
    known = [*CAMERAS, *filter(None, own), *([STEREO] if set(EYES) <= set(own) else [])]
    if camera not in known:
        raise ParameterError(f"camera is {camera!r}: allowed is one of {', '.join(known)}.")
    if camera == STEREO and width % 2:
        raise ParameterError(f"width is {width}: allowed is an even number with camera {STEREO}, half for each eye.")
    check_overlays(overlays)
    if suffix != ".gif":
        require_encoder()
    try:
        offscreen.require_gl()
    except offscreen.RenderingUnavailable as error:
        raise VideoError(str(error)) from None


def frame_samples(recording: Recording, fps: float, speed: float) -> Int[np.ndarray, " F"]:
    """The sample of the recording in each frame: the nearest in time."""
    finite = np.isfinite(recording.qpos).all(axis=1)
    count = len(finite) if finite.all() else int(np.argmin(finite))
    if count == 0:
        raise RecordingError("The recording has no finite state to show.")
    time = recording.time[:count] - recording.time[0]
    wanted = np.arange(0.0, time[-1] + 1e-9, speed / fps)
    after = np.clip(np.searchsorted(time, wanted), 0, count - 1)
    before = np.maximum(after - 1, 0)
    return np.where(wanted - time[before] < time[after] - wanted, before, after)


def draw(
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
    strips = strips_of(recording, overlays, width)
    scenery = scenery_of(recording, overlays, root_body(model))
    pictures = _robot(recording, model, samples, width, height, camera, interval, scenery)
    frames = (beside(strips, picture, i * interval) for i, picture in enumerate(pictures))
    return frames, height + sum(strip.height for strip in strips)


def _robot(
    recording: Recording,
    model: mujoco.MjModel,
    samples: Int[np.ndarray, " F"],
    width: int,
    height: int,
    camera: str,
    interval: float,
    scenery: Callable[[mujoco.MjvScene, mujoco.MjData, int], None] | None,
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield the robot's picture of each sample."""
    model = _dressed(model, width, height)
    data = mujoco.MjData(model)
    following, path = _track(recording, model, data, samples, width / height, camera, interval)
    views: list[Any] = [following] if following else [*EYES] if camera == STEREO else [camera]
    with _renderer(model, width // len(views), height) as renderer:
        for sample, point in zip(samples, path, strict=True):
            _pose(model, data, recording.qpos[sample])
            mujoco.mj_camlight(model, data)
            mujoco.mj_tendon(model, data)
            if following is not None:
                following.lookat[:] = point
            sun.move_above(model, data, point)
            yield np.concatenate([_seen(renderer, data, view, scenery, int(sample)) for view in views], axis=1)


def _seen(
    renderer: mujoco.Renderer,
    data: mujoco.MjData,
    view: Any,
    scenery: Callable[[mujoco.MjvScene, mujoco.MjData, int], None] | None,
    sample: int,
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture of one camera."""
    renderer.update_scene(data, view)
    if scenery is not None:
        scenery(renderer.scene, data, sample)
    return renderer.render()


def _dressed(model: mujoco.MjModel, width: int, height: int) -> mujoco.MjModel:
    """A copy of the model for fast software rendering, with a large enough buffer."""
    model = copy.copy(model)
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    quality = model.vis.quality
    quality.shadowsize, quality.offsamples = min(quality.shadowsize, SHADOW_MAP), min(quality.offsamples, SAMPLES)
    quality.numslices, quality.numstacks = min(quality.numslices, SLICES), min(quality.numstacks, STACKS)
    model.mat_reflectance[:] = 0.0
    sun.put_overhead(model)
    return model


def _track(
    recording: Recording,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    samples: Int[np.ndarray, " F"],
    aspect: float,
    camera: str,
    interval: float,
) -> tuple[mujoco.MjvCamera | None, Float[np.ndarray, "F 3"]]:
    """The camera, or None for one of the model, and the middle of the body in each frame, as the torso carries it."""
    root = root_body(model)
    _pose(model, data, recording.qpos[samples[0]])
    centre, radius = body_radius(model, data, root)
    offset = centre - data.xpos[root]
    positions = root_path(recording, model, data, samples)
    fovy = float(model.vis.global_.fovy)
    view = following_camera(camera, radius, fovy, aspect) if camera in CAMERAS else None
    return view, smooth_path(positions, interval) + offset


def root_path(
    recording: Recording, model: mujoco.MjModel, data: mujoco.MjData, samples: Int[np.ndarray, " F"]
) -> Float[np.ndarray, "F 3"]:
    """Position of the followed body in each of the samples [m]; `data` is scratch space."""
    root = root_body(model)
    positions = np.empty((len(samples), 3))
    for i, sample in enumerate(samples):
        _pose(model, data, recording.qpos[sample])
        positions[i] = data.xpos[root]
    return positions


def _pose(model: mujoco.MjModel, data: mujoco.MjData, qpos: Float[np.ndarray, " nq"]) -> None:
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)


@contextlib.contextmanager
def _renderer(model: mujoco.MjModel, width: int, height: int) -> Iterator[mujoco.Renderer]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW's warnings are repeated in its error
            renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # every GL library fails in its own way
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise VideoError(
            f"MuJoCo cannot draw on this machine ({reason}): install libosmesa6 (`apt-get install libosmesa6`) and set "
            "MUJOCO_GL=osmesa."
        ) from error
    try:
        yield renderer
    finally:
        renderer.close()
