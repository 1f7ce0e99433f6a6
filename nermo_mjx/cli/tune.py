"""`nermo-mjx tune`: tune parameters by gradient, or by another method."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.group import WrongUse
from nermo_mjx.cli.output import print_json, print_table, stdout_reserved
from nermo_mjx.cli.progress import Stages, duration

if TYPE_CHECKING:
    from nermo_mjx.tune import Tuning, TuningProgress, TuningResult
    from nermo_mjx.tune.cost import MethodCost

EPILOG = """\b
Examples:
  nermo-mjx tune sweeps/tune_speed.yaml --out runs/tuned --video
  nermo-mjx tune sweeps/tune_speed.yaml --out runs/tuned --iterations 80
  nermo-mjx tune sweeps/tune_roll.yaml --starts 8 --out runs/roll
  nermo-mjx tune sweeps/tune_roll.yaml --out runs/roll --dry-run
"""
#: Metrics of the point that are shown while the tuning runs; more would not fit on a line.
_NAMED = 3
#: Points that are verified on another engine.
_AGAIN = ("start", "best")


@click.command("tune", epilog=EPILOG)
@click.argument("spec", metavar="SPEC.yaml", type=options.SPEC)
@options.out
@options.number("--iterations", "Number of steps, overriding the file.", click.IntRange(1, 1_000_000))
@options.number("--starts", "Number of points tuned in parallel, overriding the file.", click.IntRange(1, 100_000))
@options.number("--seed", "Seed, overriding the file.", click.IntRange(0, 2**32 - 1))
@click.option("--plots/--no-plots", default=None, help="Draw figures regardless of the file.")
@click.option("--video/--no-video", default=None, help="Render start and best regardless of the file.")
@click.option("--dry-run", is_flag=True, help="Estimate the cost of each method on this machine; write nothing.")
@options.workers
@options.accept_new_code
@options.report
def command(
    spec: Path, out: Path, dry_run: bool, workers: str, ray_address: str | None, accept_new_code: bool, as_json: bool,
    quiet: bool, **chosen: Any,
) -> None:  # fmt: skip
    """Tune the parameters that a tuning file names.

    The file's method says how: by exact gradients, by finite differences, or
    by CMA-ES. The cost of each on this machine is printed before it starts.

    Writes the best point, the history of all iterations, a sweep file with
    the tuned values, checkpoints, plots and, on demand, a video to DIR. After
    Ctrl-C or a crash, run the same command again: it resumes, and ends with
    the same numbers. More iterations extend a completed tuning.

    --workers ray distributes the starts over a cluster's machines, which need
    no access to DIR.
    """
    with stdout_reserved():
        from nermo_mjx.tune import Tuning

        tuning = Tuning.from_file(spec)
        changed = {name: value for name, value in chosen.items() if value is not None}
        if "starts" in changed and tuning.method.name == "cma":
            raise WrongUse("--starts is not used by the method cma: give method: {cma: {population: N}} in the file.")
        tuning = dataclasses.replace(tuning, **changed)
        # A resumed tuning keeps the method with which it started.
        begins = not (as_json or quiet or (out / "history.parquet").exists())
        costs = _costs(tuning) if dry_run or begins else []
        for line in _told(costs) if not dry_run else ():
            click.echo(f"tune: {line}", err=True)
    if dry_run:
        _print_costs(costs, as_json)
        return
    with stdout_reserved():
        from nermo_mjx.tune import run_tuning

        with (
            Stages(quiet, compiles=lambda what: what in ("tune", "landscape")) as stages,
            options.crew(workers, ray_address, stages.say) as crew,
        ):
            display = _Display(stages, tuning)
            result = run_tuning(
                tuning, out, progress=display.report, drawing=stages.share, warn=stages.say,
                accept_new_code=accept_new_code, workers=crew,
            )  # fmt: skip
            for note in result.pictures.notes:
                stages.say(note)
    if as_json:
        print_json(_content(result))
    elif not quiet:
        _print(result)


def _costs(tuning: Tuning) -> list[MethodCost]:
    """The cost of each method on this machine."""
    from nermo_mjx.tune import cost

    return cost.costs_of(tuning)


def _told(costs: list[MethodCost]) -> list[str]:
    """A sentence on each method, that of the file first."""
    lines = []
    for i, each in enumerate(costs):
        compiles = ", and minutes to compile, once per machine" if each.method == "gradient" else ""
        wall = "" if each.wall_seconds is None else f", about {duration(each.wall_seconds)} here"
        instead = "" if i == 0 else "instead of it, "
        lines.append(f"{instead}method {each.method}: {each.evaluations:,} evaluations, "
                     f"{duration(each.simulated_seconds)} simulated{wall}{compiles}")  # fmt: skip
    return lines


def _print_costs(costs: list[MethodCost], as_json: bool) -> None:
    if as_json:
        print_json({"costs": [dataclasses.asdict(each) for each in costs]})
    else:
        for line in _told(costs):
            click.echo(line)


class _Display:
    """Passes a tuning's progress to the display."""

    def __init__(self, stages: Stages, tuning: Tuning) -> None:
        self._stages, self._tuning = stages, tuning
        self._begun = False

    def report(self, progress: TuningProgress) -> None:
        """Show the tuning's progress; there is one more evaluation than steps."""
        total = progress.iterations + 1
        done = min(progress.iteration + 1 if self._begun else progress.resumed, total)
        self._begun = True
        self._stages.part("tune", "evaluations").share(done / total, done, total, self._known(progress))

    def _known(self, progress: TuningProgress) -> str:
        """The best objective so far, and the metrics of this iteration's best point."""
        if progress.best is None:
            return ""
        parts = [f"best {progress.best:.4g}"]
        for name in self._tuning.objective.metrics[:_NAMED]:
            if name in progress.metrics:
                parts.append(_number_and_unit(self._tuning, name, progress.metrics[name]))
        return ", ".join(parts)


def _content(result: TuningResult) -> dict[str, Any]:
    """The result of a tuning, in SI units and radians."""
    pictures = result.pictures
    return {
        "out": result.out,
        "iterations_run": result.iterations_run,
        "start": result.start,
        "best": result.best,
        "plots": list(pictures.plots),
        "video": pictures.video,
        "notes": list(pictures.notes),
    }


def _print(result: TuningResult) -> None:
    best = result.best
    columns = [("", "left"), ("start", "right"), ("best", "right"), ("change", "right"), ("", "left")]
    again = best.get("verified")
    if again:
        columns[-1:-1] = [(f"{name}, {again['engine']}", "right") for name in _AGAIN]
    where = f" of start {best['start']}" if result.tuning.starts > 1 else ""
    print_table(f"Iteration {best['iteration']}{where} is the best", columns, _rows(result))
    wall = result.history.column("wall_seconds")[-1].as_py()
    effort = f"{duration(best['simulated_seconds'])} simulated, gradients at their cost, in {duration(wall)}"
    if again:
        click.echo(_walked_again(again))
    click.echo(f"{best['iterations']} iterations ({effort})")
    if best["stopped"]:
        click.echo(best["stopped"])
    if not result.start["ok"]:
        click.echo("From the given start, the robot did not complete the walk.")
    places = {"best": "best.json", "history": "history.parquet", "sweep": "tuned.yaml"}
    places |= {"plots": "plots"} if result.pictures.plots else {}
    for name, place in places.items():
        click.echo(f"{name:<8}{result.out / place}")
    if result.pictures.video is not None:
        click.echo(f"video   {result.pictures.video}")


def _rows(result: TuningResult) -> list[list[str]]:
    """Every parameter, every metric of the objective, and the objective itself, in readable form."""
    start, best = result.start, result.best
    names = dict.fromkeys(result.tuning.names, "parameters")
    names |= dict.fromkeys(result.tuning.objective.metrics, "metrics")
    rows = []
    for name, kind in names.items():
        ends = start[kind][name], best[kind][name]
        change = _shortest(result.tuning, name, ends[1] - ends[0])
        (before, after, change), unit = _shown(result.tuning, name, (*ends, change))
        rows.append([name, *_cells(before, after, change), *_again(result, name, kind), unit])
    ends = start["objective"], best["objective"]
    return [*rows, ["objective", *_cells(*ends, ends[1] - ends[0]), *_again(result, "objective"), "lower is better"]]


def _again(result: TuningResult, name: str, kind: str = "") -> list[str]:
    """A row's cells of the verification of start and best; none if there was none."""
    if "verified" not in result.best:
        return []
    cells = []
    for each in (result.best["verified"][point] for point in _AGAIN):
        found = None if each is None else each.get(name) if not kind else each.get(kind, {}).get(name)
        number = None if found is None else _shown(result.tuning, name, (found,))[0][0] if kind else found
        cells.append("" if number is None else _digits(number))
    return cells


def _walked_again(again: Mapping[str, Any]) -> str:
    """The meaning of the columns of the engine `c`."""
    fell = sum(again["walks"] - (each or {"walks_ok": 0})["walks_ok"] for each in (again[point] for point in _AGAIN))
    fallen = f", of which {fell} were not completed" if fell else ""
    many = "1 walk" if again["walks"] == 1 else f"means of {again['walks']} walks from unseen starts"
    best = again["best"]
    apart = f"; the best gave {best['lowest']:.4g} to {best['highest']:.4g}" if best and again["walks"] > 1 else ""
    return f"Engine {again['engine']}: {many}{fallen}{apart}."


def _shortest(tuning: Tuning, name: str, change: float) -> float:
    """A change of a parameter; for a periodic one, the shorter way around."""
    if name not in tuning.names:
        return change
    place = tuning.names.index(name)
    if not tuning.bounds.periodic[place]:
        return change
    period = float(tuning.bounds.high[place] - tuning.bounds.low[place])
    return change - period * round(change / period)


def _cells(before: float, after: float, change: float) -> list[str]:
    return [_digits(before), _digits(after), f"{change + 0.0:+.3g}" if math.isfinite(change) else "-"]


def _digits(value: float) -> str:
    return f"{value + 0.0:.4g}" if math.isfinite(value) else "-"


def _number_and_unit(tuning: Tuning, metric: str, value: float) -> str:
    (number,), unit = _shown(tuning, metric, (value,))
    return f"{metric} {number:.4g} {unit}".rstrip()


def _shown(tuning: Tuning, name: str, values: tuple[float, ...]) -> tuple[list[float], str]:
    """Values of a parameter or metric as figures show them, and the unit."""
    from nermo_mjx.plotting.shown import shown

    about = tuning.parameters.get(name) or tuning.objective_metrics[name]
    quantity = shown(name, about.unit, values)
    return quantity.values.tolist(), quantity.unit
