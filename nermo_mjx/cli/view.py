"""`nermo-mjx view`: a recording, or two, as a page in the browser."""

from __future__ import annotations

import os
import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.group import WrongUse
from nermo_mjx.cli.output import print_json, stdout_reserved

if TYPE_CHECKING:
    from nermo_mjx.view import Page

EPILOG = """\b
Examples:
  nermo-mjx view walk.npz
  nermo-mjx view walk.npz other.npz
  nermo-mjx view walk.npz --out walk.html --no-open
"""


@click.command("view", epilog=EPILOG)
@click.argument("recording", metavar="FILE.npz", type=options.RECORDING)
@click.argument("other", metavar="[OTHER.npz]", required=False, type=options.RECORDING)
@options.file("--out", ".html", "Write the page there, to keep or to share.")
@click.option("--no-open", is_flag=True, help="Open no browser.")
@options.report
def command(recording: Path, other: Path | None, out: Path | None, no_open: bool, as_json: bool, quiet: bool) -> None:
    """Look at a recording of `walk --record` in the browser.

    One page holds everything and needs no network: the robot to turn around
    and to scrub through, tendons coloured by tension, contact forces, plots.
    With a second recording both are compared, in step with the time.
    """
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise WrongUse(f"{out}: a page ends in .html, not in {out.suffix or 'nothing'!r}.")
    with stdout_reserved():
        page = _page(recording, other)
        path = page.save(out or Path(tempfile.mkdtemp(prefix="nermo-mjx-")) / f"{recording.stem}.html")
        opened = not no_open and _has_browser() and webbrowser.open(path.resolve().as_uri())
    if as_json:
        print_json({"page": str(path), "bytes": path.stat().st_size, "samples": page.samples, "opened": opened})
    elif not quiet or (out is None and not opened):
        click.echo(f"wrote {path}" + ("" if opened or no_open else "; no browser was found, open it in one"))


def _page(recording: Path, other: Path | None) -> Page:
    from nermo_mjx.view import show

    for path in (recording, other):
        if path is not None:
            _check(path)
    return show(recording, other)


def _check(path: Path) -> None:
    """Refuse what is no recording, or not one of this version's robot."""
    from nermo_mjx.view import Recording, RecordingError
    from nermo_mjx.view.motion import finite_samples
    from nermo_mjx.view.recorded_robot import robot_of

    try:
        recording = Recording.load(path)
        robot_of(recording)
        finite_samples(recording)
    except RecordingError as error:
        text = str(error)
        raise WrongUse(text if text.startswith(f"{path}:") else f"{path}: {text}") from None


def _has_browser() -> bool:
    """Whether a window can open; without a display Python would start a browser of the terminal, or wait for one."""
    if sys.platform.startswith("linux") and not os.environ.get("BROWSER"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True
