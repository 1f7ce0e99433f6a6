"""`nermo-mjx compare`: which of two sweeps, or of two structures in one, is better, and by how much."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import METRICS
from nermo_mjx.cli.completing import names
from nermo_mjx.cli.output import print_table, stdout_reserved, tell_report

if TYPE_CHECKING:
    from nermo_mjx.sweep.comparing import Comparison

EPILOG = """\b
Examples:
  nermo-mjx compare runs/stiff runs/bending --for frequency --out runs/gain
  nermo-mjx compare runs/spine_gain --by spine --for gait --for frequency
  nermo-mjx compare runs/spine_gain --by spine --where gait=trt --out gain.csv
"""
FOLDER = click.Path(path_type=Path)


@click.command("compare", epilog=EPILOG)
@click.argument("a", metavar="A", type=FOLDER)
@click.argument("b", metavar="[B]", required=False, type=FOLDER)
@click.option("--by", metavar="NAME", shell_complete=options.columns, help="Compare the values of a column in A.")
@click.option("--base", metavar="VALUE", help="The baseline value; by default none, or the first.")
@click.option("--for", "groups", metavar="NAME", multiple=True, shell_complete=options.columns,
              help="An interval for each value of a column; repeatable: for each combination.")  # fmt: skip
@click.option("--where", metavar="NAME=VALUE", multiple=True, help="Only runs with this value of a column.")
@click.option("--metric", "drawn", metavar="NAME", multiple=True, shell_complete=names(*METRICS),
              help="Metric to show for the groups; by default the speed.")  # fmt: skip
@options.report_out
@options.report
def command(
    a: Path, b: Path | None, by: str | None, base: str | None, groups: tuple[str, ...], where: tuple[str, ...],
    drawn: tuple[str, ...], out: Path | None, as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    """Compare two sweeps, A and B, or with --by the values of a column of A.

    Runs are paired over the variants that both have. Each metric's
    difference, B minus A or value minus base, has a 95 % interval, by a
    bootstrap of variants and repeats. Differences beyond noise are
    marked with a star: at most 5 % of them are expected to be false.
    """
    if (b is None) == (by is None):
        raise click.UsageError("Give two directories A and B, or one and --by NAME.")
    if base is not None and by is None:
        raise click.UsageError("--base is a value of --by; for two directories, the first one is the base.")
    chosen = dict(_split(text) for text in where)
    with stdout_reserved():
        from nermo_mjx.sweep.comparing import compare
        from nermo_mjx.sweep.comparing.figures import figures_of

        found = compare(a, b, by=by, base=base, groups=groups, where=chosen, drawn=drawn)
    tell_report("compare", "comparison", found, figures_of, out, _print, as_json=as_json, quiet=quiet)


def _split(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise click.UsageError(f"--where {text}: expected NAME=VALUE, such as gait=trt.")
    return name.strip(), value.strip()


def _print(found: Comparison) -> None:
    """Tables for people: every metric over all variants, and the chosen ones by groups."""
    columns = [(found.base, "right"), ("", "right"), ("difference [SI]", "right"), ("95 % interval", "left"),
               ("relative", "right"), ("variants", "right"), ("", "left")]  # fmt: skip
    for other in found.others:
        columns[1] = (other, "right")
        rows = [[row["metric"], *_cells(row)] for row in found.rows(other)]
        print_table(f"{other} minus {found.base}", [("metric", "left"), *columns], rows)
        for metric in found.drawn if found.groups else ():
            lines = [row for row in found.rows(other, grouped=True) if row["metric"] == metric]
            cells = [[*(_text(row[name]) for name in found.groups), *_cells(row), _failed(row)] for row in lines]
            heads = [(name, "right") for name in found.groups]
            print_table(f"{metric}: {other} minus {found.base}", [*heads, *columns, ("", "left")], cells)
    for side, counts in found.status.items():
        click.echo(f"{side}: {', '.join(f'{count:,} {status}' for status, count in counts.items())}")
    for note in found.notes:
        click.echo(note)
    click.echo("* beyond noise; at most 5 % of all marked differences are expected to be false")


def _cells(row: Mapping[str, Any]) -> list[str]:
    if not row["variants"]:
        return ["", "", "no run has it", "", "", "0", ""]
    low, high = row["low"], row["high"]
    interval = f"[{low:.3g}, {high:.3g}]" if math.isfinite(low) else ""
    relative = f"{row['relative']:+.1%}".replace("%", " %") if math.isfinite(row["relative"]) else ""
    return [f"{row['base_mean']:.4g}", f"{row['other_mean']:.4g}", f"{row['difference']:+.3g}", interval, relative,
            str(row["variants"]), "*" if row["beyond_noise"] else ""]  # fmt: skip


def _failed(row: Mapping[str, Any]) -> str:
    base, other = row["failed_base"], row["failed_other"]
    return f"{base} and {other} fell or were lost" if base or other else ""


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
