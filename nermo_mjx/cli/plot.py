"""`nermo-mjx plot`: the figures of a directory or a recording, once more."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import FORMATS
from nermo_mjx.cli.completing import FileKind
from nermo_mjx.cli.group import Failure, WrongUse
from nermo_mjx.cli.kinds import kind_of_directory
from nermo_mjx.cli.output import print_json, stdout_reserved
from nermo_mjx.cli.recordings import load_recording

EPILOG = """\b
Examples:
  nermo-mjx plot runs/quickstart
  nermo-mjx plot runs/quickstart --x speed --y cost_of_transport
  nermo-mjx plot runs/quickstart --x frequency --y spine.phase --color slip
  nermo-mjx plot walk.npz --out plots --format png
"""


@click.command("plot", epilog=EPILOG)
@click.argument("path", metavar="PATH", type=FileKind(".npz"))
@click.option("--out", metavar="DIR", type=click.Path(file_okay=False, path_type=Path),
              help="Where the figures go; by default PATH/plots.")  # fmt: skip
@click.option("--format", "form", type=click.Choice(FORMATS), help="By default both.")
@click.option("--x", metavar="NAME", shell_complete=options.columns, help="One figure of these columns: across,")
@click.option("--y", metavar="NAME", shell_complete=options.columns, help="up (by default the speed),")
@click.option("--color", metavar="NAME", shell_complete=options.columns, help="and as colours.")
@options.report
def command(
    path: Path,
    out: Path | None,
    form: str | None,
    x: str | None,
    y: str | None,
    color: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make the figures of PATH from what it holds; nothing is simulated.

    PATH is the directory of a sweep, a tuning, a landscape, experiments, an
    identification or benchmarks, whose figures are made from their tables, or
    a recording FILE.npz: gait diagram, orientation, foot paths, servo angles,
    way on the ground.

    --x, --y and --color choose columns of a sweep: two parameters of a grid
    give a heat map, two metrics with a better side a Pareto front, all else a
    scatter. --color alone, a metric, gives the usual figures of it.
    """
    kind = kind_of_directory(path) if path.is_dir() or not path.exists() else None
    if (kind is None or kind.name != "sweep") and (x, y, color) != (None, None, None):
        called = "a recording" if kind is None else f"the directory of {kind.called}"
        raise WrongUse(f"--x, --y and --color choose columns of a sweep, but {path} is {called}.")
    if kind is None and out is None:
        raise WrongUse(f"{path} is a recording: say with --out DIR where its figures go.")
    formats = FORMATS if form is None else (form,)
    notes: list[str] = []
    with stdout_reserved():
        if kind is None:
            assert out is not None
            files = _plot_recording(path, out, formats, notes)
        else:
            chosen = {"x": x, "y": y, "color": color, "notify": notes.append} if kind.name == "sweep" else {}
            with _drawing_into(path / "plots" if out is None else out):
                files = kind.load(kind.redraw)(path, out, formats=formats, **chosen)
    for note in notes if not quiet else []:
        click.echo(f"plot: {note}", err=True)
    if as_json:
        print_json({"path": path, "kind": kind.name if kind else "recording", "files": files, "notes": notes})
    elif not quiet:
        for file in files:
            click.echo(f"wrote {file}")


def _plot_recording(path: Path, out: Path, formats: Any, notes: list[str]) -> list[Path]:
    from nermo_mjx.runs.files import clear_errors, replace_file
    from nermo_mjx.view.plots.draw import draw_recording

    recording = load_recording(path)
    with _drawing_into(out), clear_errors(out):
        drawn = draw_recording(recording, out, write=replace_file, formats=formats)
    notes += drawn.notes
    if not drawn.files:
        raise Failure(f"there is nothing to draw of {path}: {' '.join(drawn.notes)}")
    return drawn.files


@contextlib.contextmanager
def _drawing_into(folder: Path) -> Iterator[None]:
    """Hold a folder of figures, so that two commands do not draw into it at once; it is made if it is missing.

    Raises:
        DirectoryError: another one does, or it cannot be written.
    """
    from nermo_mjx.runs.files import clear_errors, make_writable
    from nermo_mjx.runs.lock import hold

    make_writable(folder)
    with clear_errors(folder):
        held = hold(folder)
    try:
        yield
    finally:
        os.close(held)
