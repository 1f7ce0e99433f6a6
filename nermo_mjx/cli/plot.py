"""`nermo-mjx plot`: the figures of a directory or a recording, once more."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import EXPERIMENTS, FORMATS
from nermo_mjx.cli.completing import FileKind
from nermo_mjx.cli.group import Failure, WrongUse
from nermo_mjx.cli.output import print_json, stdout_reserved
from nermo_mjx.cli.recordings import load_recording

EPILOG = """\b
Examples:
  nermo-mjx plot runs/quickstart
  nermo-mjx plot runs/quickstart --x speed --y cost_of_transport
  nermo-mjx plot runs/quickstart --x frequency --y spine.phase --color slip
  nermo-mjx plot walk.npz --out plots --format png
"""
#: What tells the kinds of directories apart, and their names.
_MARKS = {
    "sweep": ("sweep.yaml",),
    "tuning": ("tuning.yaml",),
    "experiments": ("report.json", *(f"results/{name}.parquet" for name in EXPERIMENTS)),
    "identification": ("identification.json",),
    "landscape": ("landscape.yaml",),
    "benchmarks": ("results.jsonl",),
}


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
    kind = _kind_of(path)
    if kind != "sweep" and (x, y, color) != (None, None, None):
        raise WrongUse(f"--x, --y and --color choose columns of a sweep, but {path} is {_ARTICLES[kind]}.")
    if kind == "recording" and out is None:
        raise WrongUse(f"{path} is a recording: say with --out DIR where its figures go.")
    formats = FORMATS if form is None else (form,)
    notes: list[str] = []
    with stdout_reserved():
        if kind == "sweep":
            from nermo_mjx.sweep.redraw import redraw as redraw_sweep

            files = redraw_sweep(path, out, x=x, y=y, color=color, formats=formats, notify=notes.append)
        elif kind == "recording":
            assert out is not None
            files = _plot_recording(path, out, formats, notes)
        else:
            files = _redraw(kind)(path, out, formats=formats)
    for note in notes if not quiet else []:
        click.echo(f"plot: {note}", err=True)
    if as_json:
        print_json({"path": path, "kind": kind, "files": files, "notes": notes})
    elif not quiet:
        for file in files:
            click.echo(f"wrote {file}")


_ARTICLES = {
    "recording": "a recording", "tuning": "a tuning's directory", "experiments": "a directory of experiments",
    "identification": "an identification's directory", "landscape": "a landscape's directory",
    "benchmarks": "a directory of benchmarks",
}  # fmt: skip


def _kind_of(path: Path) -> str:
    """What a path holds, by its content."""
    if not path.exists():
        raise WrongUse(f"{path}: there is no such file or directory.")
    if not path.is_dir():
        return "recording"
    for kind, marks in _MARKS.items():
        if any((path / mark).exists() for mark in marks):
            return kind
    if (path / "landscape.parquet").exists():
        raise WrongUse(f"{path} holds a landscape of an earlier version: nermo-mjx landscape draws it again.")
    names = [mark for each in _MARKS.values() for mark in each[:1]]
    raise WrongUse(
        f"{path} is no directory that figures can be made of: it has none of {', '.join(names[:-1])} and {names[-1]}."
    )


def _redraw(kind: str) -> Callable[..., list[Path]]:
    module, name = {
        "tuning": ("nermo_mjx.tune.redraw", "redraw"),
        "landscape": ("nermo_mjx.tune.landscape.run", "redraw"),
        "experiments": ("nermo_mjx.experiments.redraw", "redraw"),
        "identification": ("nermo_mjx.experiments.redraw", "redraw_identification"),
        "benchmarks": ("nermo_mjx.bench.page", "redraw"),
    }[kind]
    draw: Callable[..., list[Path]] = getattr(importlib.import_module(module), name)
    return draw


def _plot_recording(path: Path, out: Path, formats: Any, notes: list[str]) -> list[Path]:
    from nermo_mjx.runs.files import clear_errors, make_writable, replace_file
    from nermo_mjx.view.plots.draw import draw_recording

    recording = load_recording(path)
    make_writable(out)
    with clear_errors(out):
        drawn = draw_recording(recording, out, write=replace_file, formats=formats)
    notes += drawn.notes
    if not drawn.files:
        raise Failure(f"there is nothing to draw of {path}: {' '.join(drawn.notes)}")
    return drawn.files
