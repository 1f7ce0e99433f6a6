"""`nermo-mjx render`: a recording as a video."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import VIEWS
from nermo_mjx.cli.output import print_json, stdout_reserved
from nermo_mjx.cli.progress import Progress

if TYPE_CHECKING:
    from nermo_mjx.view import Recording

EPILOG = """\b
Examples:
  nermo-mjx render walk.npz --out walk.mp4
  nermo-mjx render walk.npz --out slow.gif --camera side --speed 0.25 --fps 25
"""


@click.command("render", epilog=EPILOG)
@click.argument("recording", metavar="FILE.npz", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@options.file("--out", ".mp4", "MP4 (H.264) or GIF.", required=True)
@click.option("--camera", default=VIEWS[0], metavar="NAME", show_default=True, help=f"{', '.join(VIEWS)}.")
@options.number("--fps", "Frames per second.", click.IntRange(1, 240), default=30)
@options.number("--width", "Pixels.", click.IntRange(16, 7680), default=640)
@options.number("--height", "Pixels.", click.IntRange(16, 4320), default=480)
@options.number("--speed", "1 is real time, 0.25 a quarter of it.", options.POSITIVE, default=1.0)
@options.report
def command(
    recording: Path, out: Path, camera: str, fps: int, width: int, height: int, speed: float, as_json: bool, quiet: bool
) -> None:
    """Render a recording of `walk --record` into a video."""
    with stdout_reserved():
        from nermo_mjx.view import Recording

        loaded = Recording.load(recording)
        render_video(loaded, out, quiet, camera=camera, fps=fps, width=width, height=height, speed=speed)
    if as_json:
        print_json(
            {"video": str(out), "seconds": loaded.duration / speed, "width": width, "height": height, "fps": fps}
        )
    elif not quiet:
        click.echo(f"wrote {out}")


def render_video(recording: Recording, path: Path, quiet: bool, **options: Any) -> None:
    """Render with a progress bar; the robot is built from the recording's own setup."""
    from nermo_mjx.view import render, robot_of

    robot = robot_of(recording)
    with Progress("video", "frames", quiet=quiet) as progress:
        render(recording, robot.model, path, progress=progress.count, **options)
