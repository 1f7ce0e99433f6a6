"""`nermo-mjx landscape`: whether a tuning's gradients can be trusted."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.output import print_json, print_table, sayer, stdout_reserved
from nermo_mjx.cli.progress import Progress, duration

if TYPE_CHECKING:
    from nermo_mjx.tune.landscape import LandscapeResult

EPILOG = """\b
Examples:
  nermo-mjx landscape sweeps/tune_speed.yaml --out runs/landscape
  nermo-mjx landscape sweeps/tune_roll.yaml --span 0.2 --out runs/near
"""


@click.command("landscape", epilog=EPILOG)
@click.argument("spec", metavar="SPEC.yaml", type=options.SPEC)
@options.out
@options.number("--points", "Points per line.", click.IntRange(5, 100_000), default=41)
@options.number("--span", "Length of the lines, as a fraction of the bounds.", click.FloatRange(0, 1, min_open=True),
                default=1.0)  # fmt: skip
@options.accept_new_code
@options.report
def command(spec: Path, out: Path, points: int, span: float, accept_new_code: bool, as_json: bool, quiet: bool) -> None:
    """Measure whether the gradients of a tuning file can be trusted.

    Follows a line along each tuned parameter through the given start, and
    compares exact slopes of the objective with secants of five widths.
    Writes all points, a report, and a figure for each parameter to DIR.
    """
    with stdout_reserved():
        from nermo_mjx.tune.landscape import run_landscape

        with Progress("landscape", "walks", quiet=quiet, compiles=True) as progress:
            result = run_landscape(
                spec, out, points=points, span=span, progress=progress.count, warn=sayer("landscape", quiet),
                accept_new_code=accept_new_code,
            )  # fmt: skip
    if as_json:
        print_json({"out": result.out, "evaluated": result.evaluated, **result.content})
    elif not quiet:
        _print(result)


def _print(result: LandscapeResult) -> None:
    from nermo_mjx.tune.landscape.report import HEADINGS, rows_of, sentences

    content = result.content
    print_table("Exact slopes beside secants", list(HEADINGS), rows_of(content))
    for sentence in sentences(content):
        click.echo(sentence)
    kept = "" if result.evaluated else ", kept from before"
    click.echo(f"\n{content['evaluations']} walks with gradients in {duration(content['wall_seconds'])}{kept}")
    click.echo(f"report  {result.out / 'report.md'}\nplots   {result.out / 'plots'}")
    click.echo(f"table   {result.out / 'landscape.parquet'}")
