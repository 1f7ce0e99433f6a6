"""From frames to a video file: MP4 (H.264), GIF or animated WebP."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import UInt8

#: Called with (frames done, frames in all).
CountDone = Callable[[int, int], None]
SUFFIXES: Final = (".mp4", ".gif", ".webp")
#: What ffmpeg is told; its quality of WebP is that of JPEG, which blurs text below 70.
_CODECS: Final[dict[str, dict[str, Any]]] = {
    ".mp4": {"codec": "libx264", "quality": 8, "output_params": ["-movflags", "+faststart"]},
    ".webp": {"codec": "libwebp_anim", "quality": None, "output_params": ["-quality", "70", "-loop", "0"]},
}


class VideoError(RuntimeError):
    """A video that cannot be made; the message is one sentence, with the remedy where there is one."""


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
    partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix.lower()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.touch()  # fail on an unwritable path before ffmpeg starts, and before the first frame is drawn
        drawn = iter(frames)
        first = next(drawn)  # and on a frame that cannot be drawn before ffmpeg waits for it
        with _writer(partial, fps, width, height, count) as write:
            for done, frame in enumerate(itertools.chain([first], drawn), start=1):
                write(frame)
                if progress is not None:
                    progress(done, count)
        partial.replace(path)
    except OSError as error:
        reason = error.strerror or str(error).partition("\n")[0]  # imageio quotes all that ffmpeg printed
        raise VideoError(f"{path}: the video cannot be written ({reason}).") from None
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()
    return path


@contextlib.contextmanager
def _writer(path: Path, fps: int, width: int, height: int, count: int) -> Iterator[Callable[[np.ndarray], object]]:
    if path.suffix == ".gif":
        import imageio.v2 as imageio

        # A frame lasts whole hundredths of a second: some last one more, so that the average rate is the requested one.
        ends = np.round(np.arange(count + 1) * 100.0 / fps) * 10.0
        writer: Any = imageio.get_writer(path, format="GIF", mode="I", duration=np.diff(ends).tolist(), loop=0)
        with writer:
            yield writer.append_data
        return
    encoder = require_encoder().write_frames(
        str(path), (width, height), fps=fps, pix_fmt_out="yuv420p", macro_block_size=2, ffmpeg_log_level="error",
        **_CODECS[path.suffix],
    )  # fmt: skip
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
        raise VideoError("No ffmpeg encodes MP4 or WebP: `pip install imageio-ffmpeg`, or write a .gif.") from None
    if shutil.which(program) is None:  # the user's choice, which imageio-ffmpeg does not check
        raise VideoError(f"IMAGEIO_FFMPEG_EXE is {program!r}, which cannot be run: unset it, or write a .gif.")
    return imageio_ffmpeg
