"""`nermo-mjx view`: a recording, or two, or all runs of a directory as a page in the browser."""

from __future__ import annotations

import os
import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.completing import FileKind
from nermo_mjx.cli.group import WrongUse
from nermo_mjx.cli.kinds import kind_of_directory
from nermo_mjx.cli.output import print_json, stdout_reserved
from nermo_mjx.cli.recordings import load_recording

if TYPE_CHECKING:
    from nermo_mjx.view import Page

EPILOG = """\b
Examples:
  nermo-mjx view walk.npz
  nermo-mjx view walk.npz other.npz
  nermo-mjx view walk.npz --out walk.html --no-open
  nermo-mjx view runs/quickstart
"""


@click.command("view", epilog=EPILOG)
@click.argument("path", metavar="PATH", type=FileKind(".npz"))
@click.argument("other", metavar="[OTHER.npz]", required=False, type=options.RECORDING)
@options.file("--out", ".html", "Write the page to this file.")
@options.number("--recordings", "For a directory: maximum number of recordings in the page; by default 50.",
                click.IntRange(0), metavar="N")  # fmt: skip
@click.option("--no-open", is_flag=True, help="Do not open a browser.")
@options.report
def command(
    path: Path, other: Path | None, out: Path | None, recordings: int | None, no_open: bool, as_json: bool, quiet: bool
) -> None:
    """View a recording, or all runs of a directory, in the browser.

    The page is self-contained and needs no network. For a recording FILE.npz:
    an interactive 3D view with a time line, tendons coloured by tension,
    contact forces, plots; a second recording is compared with it, synchronized
    in time. For the directory of a sweep or a search: every run as a point or
    a cell, to filter and brush; clicking a run shows its numbers and the
    command that repeats it, and plays its recording if DIR/recordings has it.
    """
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise WrongUse(f"{out}: a page ends in .html, not in {out.suffix or 'nothing'!r}.")
    if not path.exists():
        raise WrongUse(
            f"{path} does not exist: allowed is a recording FILE.npz, or the directory of a sweep or search."
        )
    notes: list[str] = []
    with stdout_reserved():
        if path.is_dir():
            page, held = _directory(path, other, recordings, notes)
        else:
            page, held = _recording(path, other, recordings)
        file = page.save(out or Path(tempfile.mkdtemp(prefix="nermo-mjx-")) / f"{path.resolve().stem}.html")
        opened = not no_open and _has_browser() and webbrowser.open(file.resolve().as_uri())
    for note in notes if not quiet else []:
        click.echo(f"view: {note}", err=True)
    if as_json:
        print_json({"page": str(file), "bytes": file.stat().st_size, **held, "opened": opened})
    elif not quiet or (out is None and not opened):
        click.echo(f"wrote {file}" + ("" if opened or no_open else "; no browser was found, open it in one"))


def _recording(path: Path, other: Path | None, recordings: int | None) -> tuple[Page, dict[str, Any]]:
    from nermo_mjx.view import show

    if recordings is not None:
        raise WrongUse(f"--recordings is for the page of a directory, but {path} is a recording.")
    for each in (path, *([] if other is None else [other])):
        load_recording(each)  # refuses what cannot be shown, and says which file that is
    page = show(path, other)
    return page, {"samples": page.samples}


def _directory(path: Path, other: Path | None, recordings: int | None, notes: list[str]) -> tuple[Page, dict[str, Any]]:
    from nermo_mjx.runs import kind_of
    from nermo_mjx.view.explore import KINDS, MOST_RECORDINGS, explore

    if other is not None:
        raise WrongUse(f"{path} is a directory: it has its own page; show {other} with a separate command.")
    if kind_of(path) not in KINDS:
        raise WrongUse(
            f"{path} is the directory of {kind_of_directory(path).called}: the page of a directory shows the runs of a "
            "sweep or a search, and nermo-mjx plot draws the others."
        )
    page = explore(path, recordings=MOST_RECORDINGS if recordings is None else recordings, notify=notes.append)
    return page, {"rows": page.rows, "recordings": page.recordings}


def _has_browser() -> bool:
    """Whether a window can open; without a display Python would start a text browser, or wait for one."""
    if sys.platform.startswith("linux") and not os.environ.get("BROWSER"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True
