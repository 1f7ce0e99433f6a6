"""`nermo-mjx plot`: redraw the figures of a directory or a recording."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import FORMATS
from nermo_mjx.cli.completing import FileKind
from nermo_mjx.cli.group import Failure, WrongUse
from nermo_mjx.cli.kinds import RECORDING, Kind, kind_of_directory
from nermo_mjx.cli.output import print_json, stdout_reserved

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
    path: Path, out: Path | None, form: str | None, as_json: bool, quiet: bool, **chosen: str | None
) -> None:  # fmt: skip
    """Redraw the figures of PATH from its tables; nothing is simulated.

    PATH is the directory of a sweep, a search, a tuning, a training, a
    landscape, experiments, an identification or benchmarks, or a recording
    FILE.npz: gait diagram, orientation, foot paths, servo angles, path over
    the ground.

    --x, --y and --color choose columns of a table: two parameters of a grid
    give a heat map, two metrics with a better direction a Pareto front, other
    columns a scatter plot. --color alone, with a metric, gives the usual
    figures for it.
    """
    kind = RECORDING if path.is_file() else kind_of_directory(path)
    if not set(chosen) <= set(kind.options) and any(chosen.values()):
        place = "" if kind is RECORDING else "the directory of "
        raise WrongUse(f"--x, --y and --color choose columns of a sweep or a search, but {path} is {place}"
                       f"{kind.called}.")  # fmt: skip
    if out is None and kind is RECORDING:
        raise WrongUse(f"{path} is a recording: give the directory for its figures with --out DIR.")
    notes: list[str] = []
    given = {name: each for name, each in {**chosen, "notify": notes.append}.items() if name in kind.options}
    with stdout_reserved():
        from nermo_mjx.plotting.files import write_figures

        figures, folder = kind.load(kind.figures)(path, **given), path / "plots" if out is None else out
        with _drawing_into(folder), _writing(kind, path, folder, notes) as write:
            files = write_figures(figures, folder, write, FORMATS if form is None else (form,))
    if not files:
        raise Failure(f"there is nothing to draw of {path}: {' '.join(notes)}")
    for note in notes if not quiet else []:
        click.echo(f"plot: {note}", err=True)
    if as_json:
        print_json({"path": path, "kind": kind.name, "files": files, "notes": notes})
    elif not quiet:
        for file in files:
            click.echo(f"wrote {file}")


@contextlib.contextmanager
def _writing(kind: Kind, path: Path, folder: Path, notes: list[str]) -> Iterator[Callable[[Path, bytes], None]]:
    """How files are written into a folder: of a directory that knows its own files, others are moved aside."""
    from nermo_mjx.runs import RunDirectory, Written
    from nermo_mjx.runs.files import replace_file

    if not kind.tracked or folder != path / "plots":
        yield replace_file
        return
    with RunDirectory(path, kind.name) as held, Written(held) as written:
        yield written.write
    notes += filter(None, [written.sentence()])


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
