"""`nermo-mjx sweep`: the main job."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.completing import FileKind
from nermo_mjx.cli.output import print_json, print_table, sayer, stdout_reserved
from nermo_mjx.cli.progress import Progress, duration

if TYPE_CHECKING:
    from nermo_mjx.sweep import Sweep, SweepResult
    from nermo_mjx.sweep.forecast import Forecast

EPILOG = """\b
Examples:
  nermo-mjx sweep sweeps/quickstart.yaml --out runs/quickstart
  nermo-mjx sweep finer.yaml --out runs/quickstart --extend
  nermo-mjx sweep runs/quickstart/sweep.yaml --rows front.csv --out runs/front
  nermo-mjx sweep sweeps/quickstart.yaml --dry-run
  nermo-mjx sweep --list-parameters
"""
#: Options that decide what a sweep costs.
_FORECAST = ("engine", "chunk", "shard", "extend", "use")


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
@click.option("--out", metavar="DIR", type=click.Path(file_okay=False, path_type=Path), help="Results directory.")
@options.engine
@options.number("--seed", "Seed, overriding the file.", click.IntRange(0))
@options.number("--chunk", "Runs simulated and stored together.", click.IntRange(1))
@click.option("--shard", type=Shard(), help="Run part I of N, from 0; all parts write to the same DIR.")
@click.option(
    "--rows",
    type=FileKind(".csv", ".parquet", exists=True, dir_okay=False),
    metavar="FILE",
    help="Exactly these variants, instead of vary; SPEC.yaml is then optional.",
)
@click.option("--extend", is_flag=True, help="Add rows to DIR: more values, repeats, structures or Sobol points.")
@click.option(
    "--use",
    multiple=True,
    metavar="DIR2",
    type=click.Path(path_type=Path),
    help="Reuse rows from DIR2 instead of running them.",
)
@options.workers
@options.accept_new_code
@click.option("--tensorboard", is_flag=True, help="Log each chunk to TensorBoard, in DIR.")
@click.option("--dry-run", is_flag=True, help="Estimate the cost in time, disk and memory; write nothing.")
@click.option("--list-parameters", is_flag=True, help="List what vary, set and randomize can name.")
@options.report
def command(
    spec: Path | None, out: Path | None, seed: int | None, workers: str, ray_address: str | None,
    rows: Path | None, dry_run: bool, list_parameters: bool, as_json: bool, quiet: bool, **how: Any,
) -> None:  # fmt: skip
    """Run every variant of a sweep file.

    Writes a table of metrics (Parquet), a summary and plots to DIR. If DIR
    contains part of the same sweep, only the rest is run: after Ctrl-C or a
    crash, run the same command again to resume.

    Existing rows are reused: with --extend those of a smaller sweep in DIR,
    with --use those of other directories.

    --workers ray distributes the work over a cluster's machines, which need
    no access to DIR; jobs of an array that share DIR use --shard.
    """
    if list_parameters:
        _list_parameters(spec, as_json)
        return
    if (spec is None and rows is None) or (out is None and not dry_run):
        raise click.UsageError("A sweep needs SPEC.yaml or --rows FILE, and --out DIR (or use --list-parameters).")
    if dry_run and workers != "local":
        raise click.UsageError("--dry-run estimates for this machine: leave out --workers.")
    if dry_run or out is None:
        with stdout_reserved():
            from nermo_mjx.sweep.forecast import forecast

            found = forecast(_read(spec, rows, seed), out, **{name: how[name] for name in _FORECAST})
        if as_json:
            print_json(dataclasses.asdict(found))
        elif not quiet:
            _print_forecast(found)
        return
    with stdout_reserved():
        from nermo_mjx.sweep import run_sweep

        sweep = _read(spec, rows, seed)
        say = sayer("sweep", quiet)
        if say is not None:
            for name, places in sweep.partly_read().items():
                read = f"{len(places)} of {len(sweep.structures)} structures"
                say(f"{name} is varied in {read}: the others do not read it.")
        progress = Progress("sweep", "runs", quiet=quiet, compiles=workers == "local")
        with options.crew(workers, ray_address, say) as crew, progress:
            result = run_sweep(
                sweep, out, **how, warn=say, workers=crew,
                progress=lambda done: progress.share(done.fraction, done.rows_done, done.rows),
            )  # fmt: skip
    if as_json:
        print_json(result_fields(out, result))
    elif not quiet:
        print_result(result)


def _read(spec: Path | None, rows: Path | None, seed: int | None) -> Sweep:
    from nermo_mjx.sweep import Sweep

    sweep = Sweep.from_rows(rows, spec) if rows is not None else Sweep.from_file(str(spec))
    return sweep if seed is None else dataclasses.replace(sweep, seed=seed)


def _time(found: Forecast) -> str:
    if not found.rows_left:
        return "none: all rows are there"
    return "not known" if math.isnan(found.seconds) else f"{duration(found.seconds)}, and what compiling takes"


def _print_forecast(found: Forecast) -> None:
    rate = f"{found.steps_per_second:,.0f} steps/s; " if math.isfinite(found.steps_per_second) else ""
    left = f", of which {found.rows_left:,} are left to be run" if found.rows_left < found.rows else ""
    batches = f"{found.batches:,} batches to be run, of {found.structures:,} structures"
    for name, text in (
        ("rows", f"{found.rows:,}{left}"),
        ("chunks", f"{found.chunks:,}; {batches}"),
        ("engine", found.engine),
        ("rate", f"{rate}{found.rate_from}"),
        ("time", _time(found)),
        ("disk", f"{found.disk_bytes / 1e6:,.1f} MB for the table; {found.disk_free / 1e9:,.1f} GB are free"),
        ("memory", f"about {found.memory_bytes / 1e9:.1f} GB"),
        *(("note", note) for note in found.notes),
    ):
        click.echo(f"{name:<8} {text}")


def result_fields(out: Path, result: SweepResult) -> dict[str, Any]:
    """For `--json`."""
    about = {"out": out, "complete": result.complete, "chunks_run": result.chunks_run, "plots": result.plots,
             "recordings": result.recordings}  # fmt: skip
    return {**about, "rows_done": result.rows_done, "missing": result.missing, "summary": result.summary}


def print_result(result: SweepResult) -> None:
    """A directory's contents in readable form."""
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
            parameters = best["parameters"].items()
            at = ", ".join(f"{name} {each if isinstance(each, str) else f'{each:.4g}'}" for name, each in parameters)
            spread = f" ± {best['std']:.2g}" if best["runs"] > 1 and math.isfinite(best["std"]) else ""
            rows.append([name, best["side"], f"{best['mean']:.4g}{spread}", at])
    if rows:
        columns = [("metric", "left"), ("best is", "left"), ("value [SI]", "right"), ("at", "left")]
        print_table("Best variants", columns, rows)
    click.echo(f"table   {result.out / 'results'}\nsummary {result.out / 'summary.json'}")
    for name in ("comparison", "sensitivity"):
        if name in summary:
            click.echo(f"{name} {result.out / f'{name}.parquet'}")
    if result.plots:
        click.echo(f"plots   {result.out / 'plots'}")
    if result.recordings:
        click.echo(f"kept    {len(result.recordings)} recordings in {result.recordings[0].parent}")


def _list_parameters(spec: Path | None, as_json: bool) -> None:
    with stdout_reserved():
        from nermo_mjx.robot.quantity import gathered
        from nermo_mjx.rollout import Setup, all_parameters
        from nermo_mjx.sweep import Sweep
        from nermo_mjx.sweep.structures import STRUCTURES, about_structure, choices_of

        parameters = all_parameters(Setup() if spec is None else Sweep.from_file(spec).setup)
        structures = {name: {"default": getattr(Setup, name), "allowed": choices_of(name), "doc": about_structure(name)}
                      for name in STRUCTURES}  # fmt: skip
    if as_json:
        fields = ("default", "unit", "low", "high", "doc")
        shown = {name: {f: getattr(about, f) for f in fields} for name, about in parameters.items()}
        print_json({"parameters": shown, "structures": structures})
        return
    columns = [("name", "left"), ("default", "right"), ("allowed", "left"), ("meaning", "left")]
    rows = [[name, f"{about.default:.5g}", about.allowed(), about.doc] for name, about in gathered(parameters)]
    print_table("Parameters of a sweep (SI units, radians)", columns, rows)
    rows = [[name, about["default"], ", ".join(about["allowed"]), about["doc"]] for name, about in structures.items()]
    print_table("Structures, which vary and rows can name, too", columns, rows)
