"""`nermo-mjx view`: a recording, or two, as a page in the browser."""

from __future__ import annotations

import os
import sys
import tempfile
import webbrowser
from pathlib import Path

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.group import WrongUse
from nermo_mjx.cli.output import print_json, stdout_reserved
from nermo_mjx.cli.recordings import load_recording

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
        from nermo_mjx.view import show

        for each in (recording, *([] if other is None else [other])):
            load_recording(each)  # refuses what cannot be shown, and says which file that is
        page = show(recording, other)
        path = page.save(out or Path(tempfile.mkdtemp(prefix="nermo-mjx-")) / f"{recording.stem}.html")
        opened = not no_open and _has_browser() and webbrowser.open(path.resolve().as_uri())
    if as_json:
        print_json({"page": str(path), "bytes": path.stat().st_size, "samples": page.samples, "opened": opened})
    elif not quiet or (out is None and not opened):
        click.echo(f"wrote {path}" + ("" if opened or no_open else "; no browser was found, open it in one"))


def _has_browser() -> bool:
    """Whether a window can open; without a display Python would start a browser of the terminal, or wait for one."""
    if sys.platform.startswith("linux") and not os.environ.get("BROWSER"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True
