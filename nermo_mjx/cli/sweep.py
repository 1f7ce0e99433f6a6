"""`nermo-mjx sweep`: the main job."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.output import print_json, print_table, sayer, stdout_reserved
from nermo_mjx.cli.progress import Progress, duration

if TYPE_CHECKING:
    from nermo_mjx.sweep import SweepResult

EPILOG = """\b
Examples:
  nermo-mjx sweep sweeps/quickstart.yaml --out runs/quickstart
  nermo-mjx sweep --list-parameters
"""


class Shard(click.ParamType):
    """I/N, with I from 0 to N - 1."""

    name = "I/N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        part, slash, parts = str(value).partition("/")
        if not (slash and part.isdecimal() and parts.isdecimal() and int(part) < int(parts)):
            self.fail(f"{value!r} is not I/N with I from 0 to N - 1, such as 0/4.", param, ctx)
        return int(part), int(parts)


@click.command("sweep", epilog=EPILOG)
@click.argument("spec", metavar="SPEC.yaml", required=False, type=options.SPEC)
@click.option("--out", metavar="DIR", type=click.Path(file_okay=False, path_type=Path), help="Where the results go.")
@options.engine
@options.number("--seed", "Instead of the seed in the file.", click.IntRange(0))
@options.number("--chunk", "Runs simulated and stored together.", click.IntRange(1))
@click.option("--shard", type=Shard(), help="Run part I of N, from 0; all parts write to the same DIR.")
@options.workers
@options.accept_new_code
@click.option("--list-parameters", is_flag=True, help="Print what vary, set and randomize can name.")
@options.report
def command(
    spec: Path | None, out: Path | None, seed: int | None, workers: str, ray_address: str | None,
    list_parameters: bool, as_json: bool, quiet: bool, **how: Any,
) -> None:  # fmt: skip
    """Run every variant of a sweep file.

    Writes a table of metrics (Parquet), a summary and plots to DIR. If DIR
    holds a part of the same sweep, only the rest is run: after Ctrl-C or a
    crash, give the same command again.

    --workers ray shares the work with a cluster's machines, which need not
    see DIR; the jobs of an array that share DIR do so by --shard.
    """
    if list_parameters:
        _list_parameters(spec, as_json)
        return
    if spec is None or out is None:
        raise click.UsageError("A sweep needs SPEC.yaml and --out DIR (or use --list-parameters).")
    with stdout_reserved():
        from nermo_mjx.sweep import Sweep, run_sweep

        sweep = Sweep.from_file(spec)
        if seed is not None:
            sweep = dataclasses.replace(sweep, seed=seed)
        say = sayer("sweep", quiet)
        progress = Progress("sweep", "runs", quiet=quiet, compiles=workers == "local")
        with options.crew(workers, ray_address, say) as crew, progress:
            result = run_sweep(
                sweep, out, **how, warn=say, workers=crew,
                progress=lambda done: progress.share(done.fraction, done.rows_done, done.rows),
            )  # fmt: skip
    if as_json:
        about = {"out": out, "complete": result.complete, "chunks_run": result.chunks_run, "plots": result.plots,
                 "recordings": result.recordings}  # fmt: skip
        print_json({**about, "rows_done": result.rows_done, "missing": result.missing, "summary": result.summary})
    elif not quiet:
        _print_summary(result)


def _print_summary(result: SweepResult) -> None:
    summary = result.summary
    if not result.complete:
        click.echo(f"{result.rows_done:,} of {result.rows:,} runs are in {result.out}; {result.missing}")
        return
    counts = ", ".join(f"{count:,} {status}" for status, count in summary["status"].items())
    effort = f"{summary['steps_per_second']:,.0f} steps/s on the engine {summary['engine']}"
    click.echo(f"{summary['rows']:,} runs ({counts}) in {duration(summary['wall_seconds'])}, {effort}")
    rows = []
    for name, best in summary["best"].items():
        if best is not None:
            at = ", ".join(f"{parameter} {value:.4g}" for parameter, value in best["parameters"].items())
            spread = f" ± {best['std']:.2g}" if best["runs"] > 1 and math.isfinite(best["std"]) else ""
            rows.append([name, best["side"], f"{best['mean']:.4g}{spread}", at])
    if rows:
        columns = [("metric", "left"), ("best is", "left"), ("value [SI]", "right"), ("at", "left")]
        print_table("Best variants", columns, rows)
    click.echo(f"table   {result.out / 'results'}\nsummary {result.out / 'summary.json'}")
    if result.plots:
        click.echo(f"plots   {result.out / 'plots'}")
    if result.recordings:
        click.echo(f"kept    {len(result.recordings)} recordings in {result.recordings[0].parent}")


def _list_parameters(spec: Path | None, as_json: bool) -> None:
    with stdout_reserved():
        from nermo_mjx.rollout import Setup, all_parameters
        from nermo_mjx.sweep import Sweep

        parameters = all_parameters(Setup() if spec is None else Sweep.from_file(spec).setup)
    if as_json:
        fields = ("default", "unit", "low", "high", "doc")
        print_json({"parameters": {name: {f: getattr(about, f) for f in fields} for name, about in parameters.items()}})
        return
    columns = [("name", "left"), ("default", "right"), ("allowed", "left"), ("meaning", "left")]
    rows = [[name, f"{about.default:.5g}", about.allowed(), about.doc] for name, about in parameters.items()]
    print_table("Parameters of a sweep (SI units, radians)", columns, rows)
