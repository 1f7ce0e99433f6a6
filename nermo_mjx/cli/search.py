"""`nermo-mjx search`: the best point, a front, or an atlas."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.output import print_json, print_table, sayer, stdout_reserved
from nermo_mjx.cli.progress import Progress, duration

if TYPE_CHECKING:
    from nermo_mjx.search import Search, SearchProgress, SearchResult
    from nermo_mjx.search.cost import Cost

EPILOG = """\b
Examples:
  nermo-mjx search sweeps/search_speed.yaml --out runs/fast
  nermo-mjx search sweeps/pareto.yaml --out runs/front --dry-run
  nermo-mjx search sweeps/atlas.yaml --out runs/atlas --budget 10000
"""


@click.command("search", epilog=EPILOG)
@click.argument("spec", metavar="SPEC.yaml", type=options.SPEC)
@options.out
@options.engine
@options.number("--budget", "Number of evaluations, overriding the file.", click.IntRange(1, 10_000_000))
@options.number("--batch", "Points evaluated together, overriding the file.", click.IntRange(4, 100_000))
@options.number("--seed", "Seed, overriding the file.", click.IntRange(0, 2**32 - 1))
@click.option("--plots/--no-plots", default=None, help="Draw figures regardless of the file.")
@click.option("--dry-run", is_flag=True, help="Estimate the cost on this machine; write nothing.")
@options.workers
@options.accept_new_code
@options.report
def command(
    spec: Path, out: Path, engine: str, budget: int | None, seed: int | None, dry_run: bool, workers: str,
    ray_address: str | None, accept_new_code: bool, as_json: bool, quiet: bool, **chosen: Any,
) -> None:  # fmt: skip
    """Search for the best parameters that a search file allows.

    A single objective is optimized by CMA-ES, several by NSGA-II for their
    Pareto front, an atlas by CMA-ME for the best gait in each of its cells.
    Writes a table of all runs (Parquet), the best point, and plots to DIR.
    After Ctrl-C or a crash, run the same command again: it resumes, and ends
    with the same numbers. A larger --budget extends a completed search.
    """
    with stdout_reserved():
        from nermo_mjx.search import Search, run_search

        search = Search.from_file(spec)
        search = dataclasses.replace(search, **{name: value for name, value in chosen.items() if value is not None})
        if budget is not None:
            search = dataclasses.replace(search, evaluations=budget, simulated_seconds=None)
        if seed is not None:
            search = dataclasses.replace(search, sweep=dataclasses.replace(search.sweep, seed=seed))
        if dry_run:
            from nermo_mjx.search.cost import cost_of

            cost = cost_of(search, engine)
        else:
            say = sayer("search", quiet)
            progress = Progress("search", "evaluations", quiet=quiet, compiles=workers == "local")
            with options.crew(workers, ray_address, say) as crew, progress:
                result = run_search(
                    search, out, engine=engine, warn=say, workers=crew, accept_new_code=accept_new_code,
                    progress=lambda done: _show(progress, search, done),
                )  # fmt: skip
    if dry_run:
        print_json({"cost": dataclasses.asdict(cost)}) if as_json else _print_cost(cost)
    elif as_json:
        print_json({"out": result.out, "best": result.best, "evaluations_run": result.evaluations_run,
                    "recordings": result.recordings, "plots": result.plots})  # fmt: skip
    elif not quiet:
        _print(result)


def _show(progress: Progress, search: Search, done: SearchProgress) -> None:
    """How far the search is, and what it has found by now."""
    total = search.evaluations or None
    known = f"{done.filled:,} cells" if done.filled is not None else ""
    if not known and done.best is not None:
        known = f"best {_objective(search, done.best)}"
    count = None if total is None else min(done.evaluations, total)
    progress.share(done.fraction, count, total, known)


def _objective(search: Search, cost: float) -> str:
    """An objective as people read it: a metric with its unit, where it is one metric."""
    from nermo_mjx.plotting.shown import shown
    from nermo_mjx.rollout import METRICS

    term = search.aim.objective.terms[0]
    if len(search.aim.objective.terms) > 1 or term.aim == "hold":
        return f"{cost:.4g}"
    value = cost * term.scale / term.weight * (-1.0 if term.aim == "maximize" else 1.0)
    quantity = shown(term.metric, METRICS[term.metric].unit, value)
    return f"{term.metric} {quantity.shown(float(quantity.values))}"


def _print(result: SearchResult) -> None:
    best, search = result.best, result.search
    columns = [("", "left"), ("best", "right"), ("", "left")]
    middle = "In the middle of the front" if search.aim.pareto else "Best"
    print_table(f"{middle}: row {best['row']}", columns, list(_rows(result)))
    effort = f"{best['evaluations']:,} evaluations, {duration(best['simulated_seconds'])} simulated"
    click.echo(f"{effort}; {best['failed']:,} fell" if best["failed"] else effort)
    if "front" in best:
        click.echo(f"{len(best['front']):,} points on the front, hypervolume {best['hypervolume']:.1%}")
    if "cells" in best:
        click.echo(f"{best['filled']:,} of {best['cells']:,} cells filled, QD score {best['qd_score']:.4g}")
    places = {"table": "results", "best": "best.json", "sweep": "best.yaml"}
    places |= {"atlas": "atlas.parquet"} if search.aim.measures else {}
    places |= {"records": "recordings"} if result.recordings else {}
    places |= {"plots": "plots"} if result.plots else {}
    for name, place in places.items():
        click.echo(f"{name:<8}{result.out / place}")


def _rows(result: SearchResult) -> Any:
    """Every parameter, and every metric that the search aims at."""
    from nermo_mjx.plotting.shown import shown
    from nermo_mjx.rollout import METRICS

    parameters = result.search.sweep.parameters
    for kind, names in (("parameters", result.search.names), ("metrics", result.search.aim.metrics)):
        for name in names:
            about: Any = parameters[name] if kind == "parameters" else METRICS[name]
            quantity = shown(name, about.unit, result.best[kind][name])
            yield [name, f"{float(quantity.values) + 0.0:.4g}", quantity.unit]


def _print_cost(cost: Cost) -> None:
    click.echo(f"{cost.evaluations:,} evaluations in {cost.batches:,} batches of {cost.batch}, {cost.runs:,} runs")
    click.echo(f"{duration(cost.simulated_seconds)} simulated; about {duration(cost.wall_seconds)} here on the engine "
               f"{cost.engine}, and {cost.disk_bytes / 1e6:.3g} MB on disk")  # fmt: skip
    if cost.gradient_runs:
        click.echo(f"plus gradients: as {cost.gradient_runs:,} runs on the engine mjx, and minutes to compile, once")
