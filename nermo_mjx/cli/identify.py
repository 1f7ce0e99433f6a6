"""`nermo-mjx identify`: servo gain and damping that the publication does not give, and how well they are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.output import print_json, print_table, sayer, stdout_reserved
from nermo_mjx.cli.progress import Progress, duration

EPILOG = """\b
Examples:
  nermo-mjx identify --out runs/identified
  nermo-mjx identify --samples 8 --generations 2 --bodies 0 --out runs/look
"""


@click.command("identify", epilog=EPILOG)
@options.out
@options.number("--samples", "Candidates of the first, even search.", click.IntRange(1), default=64)
@options.number("--generations", "Of the second search, from its best.", click.IntRange(1), default=25)
@options.number("--population", "Candidates of a generation.", click.IntRange(4), default=12)
@options.number("--bodies", "Of the ensemble; 0 leaves it out.", click.IntRange(0), default=256)
@options.number("--sweeps", "Of the ensemble, at most.", click.IntRange(1), default=5)
@options.number("--tolerance", "Objective of a body of the ensemble.", options.POSITIVE, default=0.5)
@options.number("--seed", "Of all of them.", click.IntRange(0), default=0)
@options.workers
@options.accept_new_code
@options.engine
@options.report
def command(
    out: Path, workers: str, ray_address: str | None, engine: str, as_json: bool, quiet: bool, **settings: Any
) -> None:
    """Identify the body's parameters that the publication does not give.

    Searches servo gain and damping, and damping of the joints, within
    physical bounds for the published speeds on the straight line, and
    nothing else. The result is printed as options of `experiment` and
    `walk`, and as the `set` line of a sweep. Then finds an ensemble of
    bodies that come about as near, with the friction of sole and tail
    free as well: ensemble.csv. The same command goes on with what was
    stopped.

    --workers ray shares the batches of the even search and of the ensemble
    among a cluster's machines, which need not see DIR.
    """
    with stdout_reserved():
        from nermo_mjx.experiments.identification.run import run_identification

        say = sayer("identify", quiet)
        progress = Progress("identify", quiet=quiet, compiles=workers == "local")
        with options.crew(workers, ray_address, say) as crew, progress:
            content = run_identification(
                out, engine=engine, **settings, progress=progress.share, notify=say, workers=crew
            )
    if as_json:
        print_json({"out": out, **content})
    elif not quiet:
        _print(content, out)


def _print(content: dict[str, Any], out: Path) -> None:
    from nermo_mjx.experiments.identification.run import (
        PARAMETER_HEADINGS,
        TARGET_HEADINGS,
        parameter_rows,
        target_rows,
    )

    print_table("Published speeds", list(TARGET_HEADINGS), target_rows(content))
    print_table("Parameters", list(PARAMETER_HEADINGS), parameter_rows(content))
    objective = content["objective"]
    took = f"{content['candidates']} candidates in {duration(content['wall_seconds'])}, engine {content['engine']}"
    click.echo(f"objective  {objective['start']:.3f} before, {objective['end']:.3f} after ({took})")
    if ensemble := content["ensemble"]:
        share = f"{ensemble['share_of_prior']:.1%} of the prior"
        click.echo(f"ensemble   {ensemble['size']} bodies within {ensemble['tolerance']:g}, {share}")
    click.echo(f"report     {out / 'identification.md'}\n")
    click.echo(f"Options of experiment and walk:\n  {content['options']}\n")
    click.echo(f"In a sweep file:\n{content['yaml']}", nl=False)
