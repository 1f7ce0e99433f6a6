"""`nermo-mjx render`: a recording as a video, or several side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import OVERLAYS
from nermo_mjx.cli.output import print_json, stdout_reserved
from nermo_mjx.cli.progress import Progress
from nermo_mjx.cli.recordings import load_recording

if TYPE_CHECKING:
    from nermo_mjx.rollout import Setup
    from nermo_mjx.view import Recording

EPILOG = """\b
Examples:
  nermo-mjx render walk.npz --out walk.mp4
  nermo-mjx render walk.npz --out slow.gif --camera side --speed 0.25 --fps 25
  nermo-mjx render walk.npz other.npz --out both.mp4 --overlay gait
"""


@click.command("render", epilog=EPILOG)
@click.argument("recordings", metavar="FILE.npz...", nargs=-1, required=True, type=options.RECORDING)
@options.file("--out", ".mp4", "MP4 (H.264), GIF or WebP.", required=True)
@options.camera
@click.option(
    "--overlay", "overlays", multiple=True, type=click.Choice(OVERLAYS), metavar="NAME",
    help="gait: footfall; servos: their angles; support: support polygon and centre of mass. Repeatable.",
)  # fmt: skip
@options.number("--fps", "Frames per second.", click.IntRange(1, 240), default=30)
@options.number("--width", "Pixels of one robot's picture.", click.IntRange(16, 7680), default=640)
@options.number("--height", "Pixels of one robot's picture.", click.IntRange(16, 4320), default=480)
@options.number("--speed", "1 is real time, 0.25 a quarter of it.", options.POSITIVE, default=1.0)
@options.report
def command(recordings: tuple[Path, ...], out: Path, as_json: bool, quiet: bool, **drawn: Any) -> None:
    """Render a recording of `walk --record` as a video; several are shown side by side, synchronized."""
    with stdout_reserved():
        loaded = [load_recording(path) for path in recordings]
        if len(loaded) == 1:
            render_video(loaded[0], out, quiet, **drawn)
        else:
            _render_side_by_side([path.stem for path in recordings], loaded, out, quiet, **drawn)
    if as_json:
        seconds = min(each.duration for each in loaded) / drawn["speed"]
        print_json({"video": out, "seconds": seconds, **{name: drawn[name] for name in ("width", "height", "fps")}})
    elif not quiet:
        click.echo(f"wrote {out}")


def check_video(setup: Setup, video: Path | None, camera: str) -> None:
    """Refuse a video that cannot be made, before anything is simulated."""
    if video is not None:
        from nermo_mjx.view import check_video

        check_video(setup.load().model, video, camera=camera)


def save_run(recording: Recording, record: Path | None, video: Path | None, camera: str, quiet: bool) -> None:
    """Save a recording as it is, as a video, or both."""
    if record is not None:
        recording.save(record)
    if video is not None:
        render_video(recording, video, quiet, camera=camera)


def render_video(recording: Recording, path: Path, quiet: bool, **drawn: Any) -> None:
    """Render with a progress bar; the robot is built from the recording's own setup."""
    from nermo_mjx.view import render, robot_of, shown_model

    model = shown_model(recording, robot_of(recording))
    with Progress("video", "frames", quiet=quiet) as progress:
        render(recording, model, path, progress=progress.count, **drawn)


def _render_side_by_side(names: list[str], recordings: list[Recording], path: Path, quiet: bool, **drawn: Any) -> None:
    """Render several recordings of one robot, each below the name of its file, its title and its figures."""
    from nermo_mjx.view import robot_of, shown_model
    from nermo_mjx.view.recorded import headline_of, title_of
    from nermo_mjx.view.video import Pane, render_side_by_side

    panes = []
    for name, each in zip(names, recordings, strict=True):
        figures = ", ".join(" ".join(row) for row in headline_of(each))
        lines = [line for line in (title_of(each), figures) if line]
        panes.append(Pane(each, name, lines, shown_model(each, robot_of(each))))
    robot = robot_of(recordings[0])
    with Progress("video", "frames", quiet=quiet) as progress:
        render_side_by_side(panes, robot.model, path, progress=progress.count, **drawn)
