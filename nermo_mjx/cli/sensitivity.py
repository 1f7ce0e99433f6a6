"""`nermo-mjx sensitivity`: which parameters of a sampled sweep a metric depends on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import METRICS
from nermo_mjx.cli.completing import names
from nermo_mjx.cli.output import print_table, stdout_reserved, tell_report

if TYPE_CHECKING:
    from nermo_mjx.sweep.sensitivity import Sensitivity

EPILOG = """\b
Examples:
  nermo-mjx sensitivity runs/robustness
  nermo-mjx sensitivity runs/robustness --metric roll_std --out runs/roll
"""


@click.command("sensitivity", epilog=EPILOG)
@click.argument("path", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--metric", metavar="NAME", default="speed", show_default=True, shell_complete=names(*METRICS),
              help="Whose variance.")  # fmt: skip
@options.report_out
@options.report
def command(path: Path, metric: str, out: Path | None, as_json: bool, quiet: bool) -> None:
    """Estimate each parameter's share of a metric's variance in a sweep.

    Sobol indices with 95 % intervals: first order, alone; total, including
    interactions; second order, of pairs. A sweep with sample: {saltelli: N}
    gives all of them, any other random sample the first-order ones.
    """
    with stdout_reserved():
        from nermo_mjx.sweep.sensitivity import sensitivity
        from nermo_mjx.sweep.sensitivity_figure import figures_of

        found = sensitivity(path, metric)
    tell_report("sensitivity", "sensitivity", found, figures_of, out, _print, as_json=as_json, quiet=quiet)


def _print(found: Sensitivity) -> None:
    from nermo_mjx.sweep.table import labelled

    structures = labelled(found.table)
    rows = [[*(line[name] for name in structures), f"{line['parameter']} {line['second']}".strip(), line["order"],
             f"{line['index']:.3f}", f"[{line['low']:.3f}, {line['high']:.3f}]"]
            for line in sorted(found.table.to_pylist(), key=lambda line: (line["order"], -line["index"]))]  # fmt: skip
    heads = [*((name, "left") for name in structures), ("parameter", "left"), ("order", "left"), ("index", "right"),
             ("95 % interval", "left")]  # fmt: skip
    print_table(f"{found.metric}: share of the variance", heads, rows)
    for note in found.notes:
        click.echo(note)
