"""`nermo-mjx replay`: rerun one row of a sweep or of a search, to inspect it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import ENGINES
from nermo_mjx.cli.group import Failure
from nermo_mjx.cli.output import print_json, stdout_reserved
from nermo_mjx.cli.progress import Progress
from nermo_mjx.cli.render import check_video, save_run
from nermo_mjx.cli.walk_plan import Plan
from nermo_mjx.cli.walk_report import print_walk

if TYPE_CHECKING:
    from nermo_mjx.sweep.replay import Replay, SweepRow

EPILOG = """\b
Examples:
  nermo-mjx replay runs/quickstart --row 57 --video row57.mp4
  nermo-mjx replay runs/quickstart --row 57 --engine mjx --json
  nermo-mjx replay runs/atlas --row 8123 --video gait.mp4
"""


@click.command("replay", epilog=EPILOG)
@click.argument("out", metavar="DIR", type=click.Path(path_type=Path))
@options.number("--row", "Row of the table, from 0.", int, required=True, metavar="N")
@options.choice("--engine", ENGINES, "By default the directory's own.", default=None)
@options.file("--record", ".npz", "Save the whole run.")
@options.file("--video", ".mp4", "Render it; MP4, GIF or WebP.")
@options.camera
@options.report
def command(
    out: Path, row: int, engine: str | None, record: Path | None, video: Path | None, camera: str, as_json: bool,
    quiet: bool,
) -> None:  # fmt: skip
    """Rerun one row of a sweep's or a search's directory on its own.

    It has the parameters, start and duration that the sweep gives it, whether
    or not the sweep has reached it; for a search, those of a row of its table.
    Its metrics are compared with those in the table: with the engine c on the
    same machine, they are bit-identical. DIR is only read.
    """
    files = [path for path in (record, video) if path is not None]
    with stdout_reserved():
        from nermo_mjx.runs.files import make_writable
        from nermo_mjx.sweep.replay import find_row, replay_row, report_of

        if (out / "search.yaml").exists():
            from nermo_mjx.search.keeping import find_evaluation

            found = find_evaluation(out, row)
        else:
            found = find_row(out, row)
        wanted = Plan(found.walk.setup, found.walk.run, found.values, found.parameters)
        for path in files:
            make_writable(path.parent)
        check_video(wanted.setup, video, camera)
        with Progress("replay", quiet=quiet, compiles=True) as progress:
            replay = replay_row(found, engine, progress.share)
        report = report_of(found, replay)
        if files:
            if not len(replay.history.time):
                raise Failure(f"row {row} diverged in its first tick: there is nothing to record or to show.")
            from nermo_mjx.runs.text import plain

            recording = dataclasses.replace(replay.recording(), metadata=plain(report))
            save_run(recording, record, video, camera, quiet)
    if as_json:
        print_json(report)
    elif not quiet:
        _print(found, wanted, replay, report, files)


def _print(found: SweepRow, wanted: Plan, replay: Replay, report: dict[str, Any], files: list[Path]) -> None:
    values = "".join(f", {name} {label}" for name, label in found.walk.labels.items())
    values += "".join(f", {name} {value:.4g}" for name, value in found.values.items())
    click.echo(f"Row {found.row} of {found.out}: variant {report['variant']}, repeat {report['repeat']}{values}\n")
    print_walk(report, wanted, [])
    for flag, what in (("fell", "fell"), ("diverged", "lost its numbers")):
        if report["metrics"][flag]:
            click.echo(f"It {what} at {replay.metrics['failure_time']:.2f} s, of {found.end:.2f} s.")
    click.echo(report["compared"])
    for file in files:
        click.echo(f"wrote {file}")
