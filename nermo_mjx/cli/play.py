"""`nermo-mjx play`: a recording in MuJoCo's own viewer."""

from __future__ import annotations

from pathlib import Path

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.output import print_json, stdout_reserved
from nermo_mjx.cli.recordings import load_recording

EPILOG = """\b
Examples:
  nermo-mjx play walk.npz
  nermo-mjx play walk.npz --speed 0.25
  nermo-mjx play walk.npz --xml walk.xml
"""


@click.command("play", epilog=EPILOG)
@click.argument("recording", metavar="FILE.npz", type=options.RECORDING)
@options.number("--speed", "1 is real time, 0.25 a quarter of it.", options.POSITIVE, default=1.0)
@click.option("--once", is_flag=True, help="Stop at the end instead of looping.")
@options.file("--xml", ".xml", "Write MJCF with the recording as keyframes instead.")
@options.number("--rate", "Keyframes per second.", options.POSITIVE, default=25.0)
@options.report
def command(
    recording: Path, speed: float, once: bool, xml: Path | None, rate: float, as_json: bool, quiet: bool
) -> None:
    """Play a recording in MuJoCo's viewer; it needs a display.

    With --xml, no window is opened: the file contains the robot, its scene and
    the recording, and plain MuJoCo can show it anywhere with
    `python -m mujoco.viewer --mjcf=FILE.xml` and its slider over keyframes.
    """
    with stdout_reserved():
        from nermo_mjx.view import play, write_keyframes

        loaded = load_recording(recording)
        if xml is None:
            play(loaded, speed=speed, loop=not once)
            keys = None
        else:
            keys = write_keyframes(loaded, xml, rate=rate)
    if as_json:
        print_json({"recording": recording, "seconds": loaded.duration, "xml": xml, "keyframes": keys})
    elif xml is not None and not quiet:
        click.echo(f"wrote {xml}, with {keys} keyframes")
