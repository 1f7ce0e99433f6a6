"""`nermo-mjx identify`: servo gain and damping, which the publication does not give, and their uncertainty."""

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
@options.number("--samples", "Candidates of the first, space-filling search.", click.IntRange(1), default=64)
@options.number("--generations", "Generations of the second search, from its best.", click.IntRange(1), default=25)
@options.number("--population", "Candidates per generation.", click.IntRange(4), default=12)
@options.number("--bodies", "Bodies of the ensemble; 0 for none.", click.IntRange(0), default=256)
@options.number("--sweeps", "Sampling rounds of the ensemble, at most.", click.IntRange(1), default=5)
@options.number("--tolerance", "Largest objective of a body of the ensemble.", options.POSITIVE, default=0.5)
@options.number("--seed", "Seed of all searches.", click.IntRange(0), default=0)
@options.choice("--profile", ("exact", "as_published"), "Set-up of the walks.")
@options.workers
@options.accept_new_code
@options.engine
@options.report
def command(
    out: Path, workers: str, ray_address: str | None, engine: str, as_json: bool, quiet: bool, **settings: Any
) -> None:
    """Identify the body's parameters that the publication does not give.

    Fits servo gain and damping, and damping of the joints, within physical
    bounds to the published speeds on the straight line, and nothing else. The
    result is printed as options of `experiment` and `walk`, and as the `set`
    line of a sweep. Then samples an ensemble of bodies that also fit, with the
    friction of soles and tail free as well: ensemble.csv. The same command
    resumes an interrupted identification.

    --workers ray distributes the batches of the space-filling search and of
    the ensemble over a cluster's machines, which need no access to DIR.
    """
    with stdout_reserved():
        from nermo_mjx.experiments.identification import run_identification

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
    from nermo_mjx.experiments.identification import (
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
