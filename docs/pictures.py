"""Writes the pictures and films of the pages as small WebP files.

    python docs/pictures.py SOURCE OUT.webp [--width PIXELS] [--still]

A picture keeps its size and gets at most 256 colours; the difference is not visible in a figure. `--still` takes the
middle frame of a film as the picture.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from pathlib import Path

import click
from PIL import Image, ImageSequence

#: Largest film [bytes].
LARGEST = 500_000
#: Below this quality the encoder leaves traces on a floor that moves.
QUALITY = 75


class PictureError(ValueError):
    """A film that is too large; the message contains the remedy."""


def reduce_colours(image: Image.Image) -> Image.Image:
    """Return a copy of a picture with a palette of at most 256 colours."""
    return image.convert("RGB").quantize(
        256, Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE
    )


def encode_png(image: Image.Image) -> bytes:
    """Return a picture as PNG with a palette, which is about a third as large as Matplotlib's PNG."""
    file = io.BytesIO()
    reduce_colours(image).save(file, "png", optimize=True)
    return file.getvalue()


def write_picture(image: Image.Image, path: Path) -> None:
    """Write a picture as lossless WebP with at most 256 colours."""
    reduce_colours(image).convert("RGB").save(path, lossless=True, quality=100, method=6)


def write_film(
    frames: Sequence[Image.Image],
    durations: Sequence[float],
    path: Path,
    *,
    width: int | None = None,
    quality: int = QUALITY,
) -> None:
    """Write frames as a film that repeats without end.

    Args:
        frames: Pictures of one size.
        durations: Time from each frame to the next one [ms].
        path: File that ends in `.webp`.
        width: Width of the film [pixels]; by default the width of the frames.
        quality: From 0 to 100.

    Raises:
        PictureError: The film is larger than `LARGEST`; nothing is written.
    """
    if width is not None:
        size = width, round(frames[0].height * width / frames[0].width)
        frames = [frame.resize(size, Image.Resampling.LANCZOS) for frame in frames]
    times = [round(time) for time in itertools.accumulate(durations, initial=0)]
    whole = [after - before for before, after in itertools.pairwise(times)]
    file = io.BytesIO()
    options = {"quality": quality, "method": 4, "minimize_size": True}
    frames[0].save(
        file, "webp", save_all=True, append_images=frames[1:], duration=whole, loop=0, **options
    )
    if file.tell() > LARGEST:
        remedy = "use fewer frames per second or a smaller width"
        raise PictureError(
            f"{path}: {file.tell():,} bytes, but at most {LARGEST:,} are allowed: {remedy}."
        )
    path.write_bytes(file.getvalue())


def read_film(path: Path) -> tuple[list[Image.Image], list[float]]:
    """Return the frames of a film, and the time from each to the next one [ms]; a picture has one frame."""
    with Image.open(path) as film:
        read = [
            (frame.convert("RGB"), frame.info.get("duration", 0))
            for frame in ImageSequence.Iterator(film)
        ]
    frames, durations = zip(*read, strict=True)
    return list(frames), list(durations)


@click.command(help=__doc__)
@click.argument("source", type=click.Path(exists=True, path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--width", type=int, help="Width of the film [pixels].")
@click.option("--still", is_flag=True, help="Write the middle frame of the film.")
def main(source: Path, out: Path, width: int | None, still: bool) -> None:
    frames, durations = read_film(source)
    if still or len(frames) == 1:
        write_picture(frames[len(frames) // 2], out)
    else:
        write_film(frames, durations, out, width=width)


if __name__ == "__main__":
    main()
