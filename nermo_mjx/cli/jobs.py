"""The commands that run a job into a directory: sweep, merge, search, tune, train, experiment and identify.

If a job was interrupted, the same command resumes it. Each command reads its file, runs the job, and returns an
`Output` with the content for `--json` and a function that prints the result.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import EXPERIMENTS, PROFILE
from nermo_mjx.cli.options import FileKind, assigned, flag, number
from nermo_mjx.cli.output import (
    Output,
    WrongUse,
    command,
    in_unit,
    print_pairs,
    print_places,
    print_table,
    say,
)
from nermo_mjx.progress import ProgressBar, Stages, duration, is_given

if TYPE_CHECKING:
    from nermo_mjx.experiments.run import ExperimentsResult
    from nermo_mjx.learn.run import TrainingResult
    from nermo_mjx.optimize import Search, SearchResult, Tuning, TuningResult
    from nermo_mjx.runs.job import Forecast, Progress
    from nermo_mjx.sweep import SweepResult


#: Arguments and options of several jobs.
_spec = click.argument("spec", metavar="SPEC.yaml", type=options.SPEC)
_seed = number("--seed", "Seed, overriding the file.", click.IntRange(0, 2**32 - 1))
_dry_run = flag("--dry-run", "Estimate the cost on this machine; write nothing.")
_on_workers = options.grouped(options.workers, options.accept_new_code)
_on_engine = options.grouped(options.engine, _on_workers)
_TENSORBOARD_HELP = "Log each {} to TensorBoard, in DIR."


@contextlib.contextmanager
def _working(
    unit: str,
    job_options: dict[str, Any],
    *,
    compiles: Callable[[str], bool] | None = None,
    details: Callable[[Progress], str] = lambda _: "",
) -> Iterator[dict[str, Any]]:
    """Show the progress of the job of the current command, and start its workers.

    Args:
        unit: Unit of the count of the progress, such as "runs".
        job_options: Options of the command: the keyword arguments of the function of the job, and also `workers` and
            `ray_address`.
        compiles: Whether a stage of the job, by its name, compiles; see `Stages`.
        details: Additional text about the progress; see `Stages`.

    Yields:
        Keyword arguments of the function of the job: the options, `watch`, and `workers` if it uses Ray.
    """
    from nermo_mjx.robot.quantity import require
    from nermo_mjx.runs.job import Watch

    kind, address = job_options.pop("workers", None), job_options.pop("ray_address", None)
    name = click.get_current_context().info_name or ""
    with contextlib.ExitStack() as stack:
        stages = Stages(name, unit, compiles or (lambda _: kind != "ray"), details)
        if kind == "ray":
            require("--workers ray", "ray", "ray")
            from nermo_mjx.runs.ray_workers import RayWorkers

            job_options["workers"] = stack.enter_context(RayWorkers(address, stages.say))
        elif address is not None:
            raise click.UsageError("--ray-address is given without --workers ray.")
        stack.enter_context(stages)
        yield job_options | {"watch": Watch(stages.show, stages.say)}


def _overriding_fields(job_options: dict[str, Any], *names: str) -> dict[str, Any]:
    """Remove options that override fields of the file from the others; returns the ones that the user gave."""
    return {name: value for name in names if (value := job_options.pop(name)) is not None}


def _content(result: Any, *names: str) -> dict[str, Any]:
    """Attributes of a result by name, for `--json`."""
    return {name: getattr(result, name) for name in names}


def _shard(text: str) -> tuple[int, int]:
    """The value of `--shard` as two numbers, I and N of I/N."""
    part, slash, parts = text.partition("/")
    if not (slash and part.isdecimal() and parts.isdecimal() and int(part) < int(parts)):
        raise click.BadParameter(f"{text!r} is not I/N with I from 0 to N - 1, such as 0/4.")
    return int(part), int(parts)


@command("sweep")
@click.argument("spec", metavar="SPEC.yaml", required=False, type=options.SPEC)
@options.text("--out", "DIR", "Results directory.", type=options.FOLDER)
@number("--seed", "Seed, overriding the file.", click.IntRange(0))
@number("--chunk", "Runs simulated and stored together.", click.IntRange(1))
@options.text(
    "--shard", "I/N", "Run part I of N, from 0; all parts write to the same DIR.", type=_shard
)
@options.text(
    "--rows",
    "FILE",
    "Exactly these variants, instead of vary; SPEC.yaml is then optional.",
    type=FileKind(".csv", ".parquet", exists=True, dir_okay=False),
)
@flag("--extend", "Add rows to DIR: more values, repeats, structures or Sobol points.")
@options.best_body
@options.text(
    "--optimum",
    "YAML",
    "What is best, as the field optimum of a file has it; also of a finished DIR.",
)
@options.text(
    "--use",
    "DIR2",
    "Reuse rows from DIR2 instead of running them.",
    multiple=True,
    type=options.PATH,
)
@flag("--tensorboard", _TENSORBOARD_HELP.format("chunk"))
@flag("--dry-run", "Estimate the cost in time, disk and memory; write nothing.")
@flag("--list-parameters", "List what vary, set and randomize can name.")
@_on_engine
def sweep_command(
    spec: Path | None,
    out: Path | None,
    rows: Path | None,
    dry_run: bool,
    list_parameters: bool,
    optimum: str | None,
    body: str | None,
    **job_options: Any,
) -> Output:
    """Run every variant of a sweep file.

    Writes a table of metrics (Parquet), a summary and plots to DIR. If DIR
    contains part of the same sweep, only the rest is run: after Ctrl-C or a
    crash, run the same command again to resume.

    Existing rows are reused: with --extend those of a smaller sweep in DIR,
    with --use those of other directories.

    --workers ray distributes the work over a cluster's machines, which need
    no access to DIR; jobs of an array that share DIR use --shard.

    Examples:
      nermo-mjx sweep sweeps/quickstart.yaml --out runs/quickstart
      nermo-mjx sweep finer.yaml --out runs/quickstart --extend
      nermo-mjx sweep runs/quickstart/sweep.yaml --rows front.csv --out runs/front
      nermo-mjx sweep sweeps/quickstart.yaml --dry-run
      nermo-mjx sweep --list-parameters
    """
    if list_parameters:
        return _list_parameters(spec)
    if (spec is None and rows is None) or (out is None and not dry_run):
        raise click.UsageError(
            "A sweep needs SPEC.yaml or --rows FILE, and --out DIR (or use --list-parameters)."
        )
    if dry_run and job_options["workers"] != "local":
        raise click.UsageError("--dry-run estimates for this machine: leave out --workers.")
    from nermo_mjx.sweep import Sweep, run_sweep
    from nermo_mjx.sweep.forecast import sweep_forecast

    sweep = (
        Sweep.from_rows(rows, spec, body) if rows is not None else Sweep.from_file(str(spec), body)
    )
    sweep = dataclasses.replace(sweep, **_overriding_fields(job_options, "seed"))
    sweep = sweep if optimum is None else sweep.seeking(optimum)
    if dry_run or out is None:
        forecast = sweep_forecast(
            sweep,
            out,
            **{name: job_options[name] for name in ("engine", "chunk", "shard", "extend", "use")},
        )
        return Output(forecast.content, lambda: _print_forecast(forecast))
    for name, reading_structures in {} if is_given("quiet") else sweep.partly_read().items():
        fraction = f"{len(reading_structures)} of {len(sweep.structures)} structures"
        say(f"{name} is varied in {fraction}: the others do not read it.")
    with _working("runs", job_options) as arguments:
        result = run_sweep(sweep, out, **arguments)
    return Output(_sweep_content(out, result), lambda: _print_sweep(result))


def _print_forecast(forecast: Forecast) -> None:
    click.echo("\n".join([_forecast_summary(forecast), forecast.rate_from, *forecast.notes]))


def _forecast_summary(forecast: Forecast) -> str:
    """A line about the parts of a job, and the time and disk space that it would take."""
    counts = ", ".join(
        f"{count:,} {name.replace('_', ' ')}" for name, count in forecast.counts.items()
    )
    method = f"method {forecast.method}: " if forecast.method else ""
    has_wall_time = math.isfinite(forecast.wall_seconds)
    time = (
        f"about {duration(forecast.wall_seconds)} here"
        if has_wall_time
        else "for a time that is not known"
    )
    disk = "" if forecast.disk_bytes is None else f", {forecast.disk_bytes / 1e6:.3g} MB on disk"
    compiles = (
        ", and minutes to compile, once per machine"
        if forecast.method and forecast.engine == "mjx"
        else ""
    )
    return (
        f"{method}{counts}; {duration(forecast.simulated_seconds)} simulated, {time} on the engine {forecast.engine}"
        f"{compiles}{disk}"
    )


def _sweep_content(out: Path, result: SweepResult) -> dict[str, Any]:
    """The result of a sweep for `--json`."""
    names = ("complete", "chunks_run", "plots", "recordings", "rows_done", "missing", "summary")
    return {"out": out} | _content(result, *names)


def _with_unit(name: str, unit: str, value: float) -> str:
    """A value of a parameter or metric in its display unit, which `in_unit` chooses, for example `12.3 mm/s`."""
    (number,), unit = in_unit(name, unit, value)
    return "–" if math.isnan(number) else f"{number + 0.0:.4g} {unit}".rstrip()


# Long because it prints the parts of one report in their order.
def _print_sweep(result: SweepResult) -> None:
    """Print the contents of a sweep's directory: counts, the optimum, the best variants, and the files."""
    summary = result.summary
    if not result.complete:
        click.echo(
            f"{result.rows_done:,} of {result.rows:,} runs are in {result.out}; {result.missing}"
        )
        return
    counts = ", ".join(f"{count:,} {status}" for status, count in summary["status"].items())
    effort = f"{summary['steps_per_second']:,.0f} steps/s on the engine {summary['engine']}"
    from nermo_mjx.runs.rows import part_files
    from nermo_mjx.sweep.counting import losses_text
    from nermo_mjx.sweep.optimum import optimum_in
    from nermo_mjx.sweep.optimum_tables import optimum_cells
    from nermo_mjx.sweep.replay import recording_file
    from nermo_mjx.sweep.table import LEADING, Results, meta, profile_text

    profile = profile_text(summary["profiles"])
    click.echo(
        f"{summary['rows']:,} runs, {profile} ({counts}) in {duration(summary['wall_seconds'])}, {effort}"
    )
    if optimum := optimum_in(result.out):
        print_table(f"{optimum.title}; {profile}", *optimum_cells(optimum))
        for sentence in optimum.how():
            click.echo(sentence)
        recordings = [recording_file(result.out, row) for row in optimum.shown_rows()]
        if recordings and {*recordings} <= {*result.recordings}:
            files = " ".join(map(str, recordings))
            film = f"{files} --camera top --out {result.out / 'optimum.webp'}"
            click.echo(f"The best points beside their bases, from above: nermo-mjx render {film}")
    schema, rows = Results(part_files(result.out)).schema, []

    def unit(name: str) -> str:
        return meta(schema.field(name))["unit"]

    for name, best in [
        *summary["best"].items(),
        *((LEADING, objective) for objective in summary["best_of_each"]),
    ]:
        if best is not None:
            parameter_texts = [
                f"{key} {value if isinstance(value, str) else _with_unit(key, unit(key), value)}"
                for key, value in best["parameters"].items()
            ]
            (mean, high), unit_shown = in_unit(
                name, unit(name), best["mean"], best["high"] or math.nan
            )
            half = f" ± {high - mean:.2g}" if math.isfinite(high) else ""
            lost_text = f"{best['lost']:.0%}".replace("%", " %") + losses_text(best["why"])
            rows.append(
                [
                    name,
                    best["side"],
                    f"{mean:.4g}{half}",
                    unit_shown,
                    lost_text,
                    ", ".join(parameter_texts),
                ]
            )
    if rows:
        print_table(
            "Best variants", "metric, best is, mean ± 95 % interval>, , runs lost, at", rows
        )
    findings = {
        name: f"{name}.parquet"
        for name in ("comparison", "sensitivity", "optimum")
        if name in summary
    }
    print_places(
        result.out,
        table="results",
        summary="summary.json",
        **findings,
        plots=result.plots and "plots",
    )
    if result.recordings:
        print_pairs(
            [("kept", f"{len(result.recordings)} recordings in {result.recordings[0].parent}")]
        )


def _list_parameters(spec: Path | None) -> Output:
    """The parameters and structures that a sweep file can name; those of its own controller if there is a file."""
    from nermo_mjx.robot.quantity import gathered
    from nermo_mjx.rollout import Setup, all_parameters
    from nermo_mjx.sweep import Sweep
    from nermo_mjx.sweep.structures import STRUCTURES, about_structure, choices_of

    parameters = all_parameters(Setup() if spec is None else Sweep.from_file(spec).setup)
    structures = {
        name: {
            "default": getattr(Setup, name),
            "allowed": choices_of(name),
            "doc": about_structure(name),
        }
        for name in STRUCTURES
    }

    def show() -> None:
        headings = "name, default>, allowed, meaning"
        rows = [
            [name, f"{declaration.default:.5g}", declaration.allowed(), declaration.doc]
            for name, declaration in gathered(parameters)
        ]
        print_table("Parameters of a sweep (SI units, radians)", headings, rows)
        rows = [
            [name, structure["default"], ", ".join(structure["allowed"]), structure["doc"]]
            for name, structure in structures.items()
        ]
        print_table("Structures, which vary and rows can name, too", headings, rows)

    listed = {
        name: _content(declaration, "default", "unit", "low", "high", "doc")
        for name, declaration in parameters.items()
    }
    return Output({"parameters": listed, "structures": structures}, show)


@command("merge", reads=True)
@options.out
@click.argument("sources", metavar="DIR DIR...", nargs=-1, required=True, type=options.PATH)
@options.accept_new_code
def merge_command(sources: tuple[Path, ...], out: Path, **job_options: Any) -> Output:
    """Merge the rows of several sweeps into one directory.

    The sweeps may differ in what they vary, and in their repeats; what is
    fixed, the seed and the code have to be the same. Nothing is simulated,
    and the given directories are only read. A row that is in several is taken
    from the first of them.

    Examples:
      nermo-mjx merge runs/slow runs/fast --out runs/both
    """
    with _working("runs", job_options, compiles=lambda _: False) as arguments:
        from nermo_mjx.sweep import merge_sweeps

        result = merge_sweeps(sources, out, **arguments)

    def show() -> None:
        _print_sweep(result)
        if not result.complete:
            use = " ".join(f"--use {source}" for source in sources)
            click.echo(f"To run the rest: nermo-mjx sweep {out / 'sweep.yaml'} --out {out} {use}")

    return Output(_sweep_content(out, result), show)


@command("search")
@options.out
@_spec
@number("--budget", "Number of evaluations, overriding the file.", click.IntRange(1, 10_000_000))
@options.best_body
@_seed
@_dry_run
@_on_engine
def search_command(
    spec: Path,
    out: Path,
    budget: int | None,
    seed: int | None,
    body: str | None,
    dry_run: bool,
    **job_options: Any,
) -> Output:
    """Search for the best parameters that a search file allows.

    A single objective is optimized by CMA-ES, several by NSGA-II for their
    Pareto front, an atlas by CMA-ME for the best gait in each of its cells.
    Writes a table of all runs (Parquet), the best point, and plots to DIR.
    After Ctrl-C or a crash, run the same command again: it resumes, and ends
    with the same numbers. A larger --budget extends a completed search.

    Examples:
      nermo-mjx search sweeps/search_speed.yaml --out runs/fast
      nermo-mjx search sweeps/pareto.yaml --out runs/front --dry-run
      nermo-mjx search sweeps/atlas.yaml --out runs/atlas --budget 10000
    """
    from nermo_mjx.optimize import Search, run_search
    from nermo_mjx.optimize.search_run import search_forecast

    search = Search.from_file(spec, body)
    if budget is not None:
        search = dataclasses.replace(search, evaluations=budget, simulated_seconds=None)
    if seed is not None:
        search = dataclasses.replace(search, sweep=dataclasses.replace(search.sweep, seed=seed))
    if dry_run:
        forecast = search_forecast(search, job_options["engine"])
        return Output({"cost": forecast.content}, lambda: _print_forecast(forecast))
    with _working(
        "evaluations", job_options, details=functools.partial(_search_details, search)
    ) as arguments:
        result = run_search(search, out, **arguments)
    content = _content(result, "out", "best", "evaluations_run", "recordings", "plots")
    return Output(content, lambda: _print_search(result))


def _search_details(search: Search, progress: Progress) -> str:
    """The result of a search so far, beside its progress: filled cells of an atlas, or the best objective.

    If the objective is a single metric that is maximized or minimized, the text contains this metric with its unit.
    """
    if "cells" in progress.numbers:
        return f"{progress.numbers['cells']:,.0f} cells"
    if (objective := progress.best) is None:
        return ""
    term = search.aim.objective.terms[0]
    if len(search.aim.objective.terms) > 1 or term.aim == "hold":
        return f"best {objective:.4g}"
    value = objective * term.scale / term.weight * (-1.0 if term.aim == "maximize" else 1.0)
    return f"best {term.metric} {_with_unit(term.metric, search.sweep.metrics[term.metric].unit, value)}"


def _print_search(result: SearchResult) -> None:
    best, search, rows = result.best, result.search, []
    units = {("parameters", name): search.sweep.parameters[name].unit for name in search.names}
    units |= {("metrics", name): search.sweep.metrics[name].unit for name in search.aim.metrics}
    for (kind, name), unit in units.items():
        (number,), unit_shown = in_unit(name, unit, best[kind][name])
        rows.append([name, f"{number + 0.0:.4g}", unit_shown])
    title = "In the middle of the front" if search.aim.pareto else "Best"
    print_table(f"{title}: row {best['row']}, profile {search.setup.profile}", ", best>, ", rows)
    effort = f"{best['evaluations']:,} evaluations, {duration(best['simulated_seconds'])} simulated"
    click.echo(f"{effort}; {best['failed']:,} fell" if best["failed"] else effort)
    if "front" in best:
        click.echo(
            f"{len(best['front']):,} points on the front, hypervolume {best['hypervolume']:.1%}"
        )
    if "cells" in best:
        click.echo(
            f"{best['filled']:,} of {best['cells']:,} cells filled, QD score {best['qd_score']:.4g}"
        )
    optional_files = {
        "atlas": search.aim.measures and "atlas.parquet",
        "records": result.recordings and "recordings",
    }
    files = {"table": "results", "best": "best.json", "sweep": "best.yaml"} | optional_files
    print_places(result.out, **files, plots=result.plots and "plots")


@command("tune")
@options.out
@_spec
@number("--iterations", "Number of steps, overriding the file.", click.IntRange(1, 1_000_000))
@number(
    "--starts",
    "Number of points tuned in parallel, overriding the file.",
    click.IntRange(1, 100_000),
)
@options.best_body
@_seed
@flag("--dry-run", "Estimate the cost of each method on this machine; write nothing.")
@_on_workers
def tune_command(
    spec: Path, out: Path, body: str | None, dry_run: bool, **job_options: Any
) -> Output:
    """Tune the parameters that a tuning file names.

    The file's method says how: by local gradients, or by wide differences.
    The cost of each on this machine is printed before it starts.

    Writes the best point, the history of all iterations, a sweep file with
    the tuned values, checkpoints and plots to DIR. After Ctrl-C or a crash,
    run the same command again: it resumes, and ends with the same numbers.
    More iterations extend a completed tuning.

    --workers ray distributes the starts over a cluster's machines, which need
    no access to DIR.

    Examples:
      nermo-mjx tune sweeps/tune_speed.yaml --out runs/tuned
      nermo-mjx tune sweeps/tune_speed.yaml --out runs/tuned --iterations 80
      nermo-mjx tune sweeps/tune_roll.yaml --starts 8 --out runs/roll
      nermo-mjx tune sweeps/tune_roll.yaml --out runs/roll --dry-run
    """
    from nermo_mjx.optimize import Tuning, run_tuning
    from nermo_mjx.optimize.tuning_run import tuning_forecasts

    tuning = Tuning.from_file(spec, body)
    tuning = dataclasses.replace(
        tuning, **_overriding_fields(job_options, "iterations", "starts", "seed")
    )
    # A resumed tuning keeps its method, so that only a new one prints the cost of each method.
    shows_costs = not (
        is_given("as_json") or is_given("quiet") or (out / "history.parquet").exists()
    )
    # The first forecast is that of the method of the file.
    forecasts = tuning_forecasts(tuning) if dry_run or shows_costs else []
    sentences = [
        f"{'instead of it, ' if i else ''}{_forecast_summary(forecast)}"
        for i, forecast in enumerate(forecasts)
    ]
    if dry_run:
        content = {"costs": [forecast.content for forecast in forecasts]}
        return Output(content, lambda: click.echo("\n".join(sentences)))
    for sentence in sentences:
        say(sentence)
    details = functools.partial(_tuning_details, tuning)
    with _working(
        "evaluations",
        job_options,
        compiles=lambda stage: stage in ("tune", "landscape"),
        details=details,
    ) as arguments:
        result = run_tuning(tuning, out, **arguments)
        for note in result.notes:
            arguments["watch"].warn(note)
    content = _content(result, "out", "iterations_run", "start", "best", "plots", "notes")
    return Output(content, lambda: _print_tuning(result))


def _tuning_details(tuning: Tuning, progress: Progress) -> str:
    """The best objective so far, and the first three metrics of the best point of the last iteration.

    More metrics would not fit on a line.
    """
    if progress.best is None:
        return ""
    parts = [f"best {progress.best:.4g}"]
    for name in tuning.objective.metrics[:3]:
        if name in progress.numbers:
            unit = tuning.objective_metrics[name].unit
            (number,), unit = in_unit(name, unit, progress.numbers[name])
            parts.append(f"{name} {number:.4g} {unit}".rstrip())
    return ", ".join(parts)


def _print_tuning(result: TuningResult) -> None:
    best, tuning = result.best, result.tuning
    verified = best.get("verified")
    # Starting point and best point are walked again on a second engine.
    verified_headings = (
        [f"{point}, {verified['engine']}" for point in ("start", "best")] if verified else []
    )
    headings: list[Any] = [
        "",
        "start>",
        "best>",
        "change>",
        *((heading, "right") for heading in verified_headings),
        "",
    ]
    start_text = f" of start {best['start']}" if tuning.starts > 1 else ""
    print_table(
        f"Iteration {best['iteration']}{start_text} is the best", headings, _tuning_rows(result)
    )
    wall = result.history.column("wall_seconds")[-1].as_py()
    effort = f"{duration(best['simulated_seconds'])} simulated, gradients at their cost, in {duration(wall)}"
    if verified:  # a line that explains the columns of the second engine
        completed_counts = [
            (verified[point] or {"walks_ok": 0})["walks_ok"] for point in ("start", "best")
        ]
        failed_count = sum(verified["walks"] - count for count in completed_counts)
        failures = f", of which {failed_count} were not completed" if failed_count else ""
        walks = (
            "1 walk"
            if verified["walks"] == 1
            else f"means of {verified['walks']} walks from unseen starts"
        )
        extremes = verified["best"] if verified["walks"] > 1 else None
        range_text = (
            f"; the best gave {extremes['lowest']:.4g} to {extremes['highest']:.4g}"
            if extremes
            else ""
        )
        click.echo(f"Engine {verified['engine']}: {walks}{failures}{range_text}.")
    click.echo(f"{best['iterations']} iterations in the profile {tuning.setup.profile} ({effort})")
    if best["stopped"]:
        click.echo(best["stopped"])
    if not result.start["ok"]:
        click.echo("From the given start, the robot did not complete the walk.")
    files = {"best": "best.json", "history": "history.parquet", "sweep": "tuned.yaml"}
    print_places(result.out, **files, plots=result.plots and "plots")


def _tuning_rows(result: TuningResult) -> Iterator[list[str]]:
    """Rows of the table of a tuning: each parameter, each metric of the objective, and the objective itself.

    The columns are the starting point, the best point, the change, and both points on the second engine, if there is
    one.
    """
    best, tuning = result.best, result.tuning
    points = [
        result.start,
        best,
        *(best["verified"][point] or {} for point in ("start", "best") if "verified" in best),
    ]
    kinds = dict.fromkeys(tuning.names, "parameters") | dict.fromkeys(
        tuning.objective.metrics, "metrics"
    )
    for name, kind in (kinds | {"objective": ""}).items():
        values = [(point.get(kind, {}) if kind else point).get(name) for point in points]
        numbers = [math.nan if value is None else value for value in values]
        numbers.insert(2, _shortest_change(tuning, name, numbers[1] - numbers[0]))
        unit = "lower is better"
        if kind:
            declaration = tuning.parameters.get(name) or tuning.objective_metrics[name]
            numbers, unit = in_unit(name, declaration.unit, *numbers)
        texts = [
            f"{number + 0.0:{'+.3g' if i == 2 else '.4g'}}" for i, number in enumerate(numbers)
        ]
        texts = [
            text if math.isfinite(number) else "-"
            for number, text in zip(numbers, texts, strict=True)
        ]
        texts[3:] = [
            "" if value is None else text for value, text in zip(values[2:], texts[3:], strict=True)
        ]
        yield [name, *texts, unit]


def _shortest_change(tuning: Tuning, name: str, change: float) -> float:
    """A change of a parameter; for a periodic parameter such as a phase, the equivalent change within half a period."""
    if name not in tuning.names or not tuning.bounds.periodic[index := tuning.names.index(name)]:
        return change
    period = float(tuning.bounds.high[index] - tuning.bounds.low[index])
    return change - period * round(change / period)


@command("train")
@options.out
@_spec
@number("--steps", "Number of control steps, overriding the file.", click.IntRange(1))
@number("--worlds", "Number of parallel worlds, overriding the file.", click.IntRange(1, 1_000_000))
@options.best_body
@_seed
@flag("--onnx", "Also write policy.onnx; needs the extra onnx.")
@flag("--tensorboard", _TENSORBOARD_HELP.format("iteration"))
@flag("--video", "Render a walk of the policy at each checkpoint, in DIR/videos.")
@_dry_run
@options.engine
@options.accept_new_code
def train_command(
    spec: Path, out: Path, body: str | None, onnx: bool, dry_run: bool, **job_options: Any
) -> Output:
    """Train a policy as described in a training file.

    Writes the policy, which walk and sweep files accept as a controller,
    learning curves, checkpoints, and an evaluation on unseen bodies to DIR.
    After Ctrl-C or a crash, run the same command again: it resumes, and
    ends with the same numbers. More steps extend a completed training.

    Examples:
      nermo-mjx train sweeps/train_residual.yaml --out runs/walker
      nermo-mjx train sweeps/train_residual.yaml --out runs/walker --dry-run
      nermo-mjx train sweeps/train_residual.yaml --seed 1 --out runs/walker-1
    """
    from nermo_mjx.learn.spec import Training, changed

    training = changed(
        Training.from_file(spec, body), **_overriding_fields(job_options, "steps", "worlds", "seed")
    )
    if onnx:
        from nermo_mjx.robot.quantity import require

        require("--onnx", "onnx", "onnx")
    if dry_run:
        from nermo_mjx.learn.run import training_forecast

        forecast = training_forecast(training, job_options["engine"])
        return Output({"cost": forecast.content}, lambda: _print_forecast(forecast))

    def details(progress: Progress) -> str:
        """Return and reward of the last episodes."""
        numbers = {name: progress.numbers.get(name, math.nan) for name in ("return", "reward")}
        return ", ".join(
            f"{name} {value:.3g}" for name, value in numbers.items() if math.isfinite(value)
        )

    with _working("steps", job_options, details=details) as arguments:
        from nermo_mjx.learn.run import run_training

        onnx_file, result = None, run_training(training, out, **arguments)
        if onnx and result.policy is not None:
            from nermo_mjx.learn.policy import export, load_policy
            from nermo_mjx.runs.files import replace_file

            onnx_file = result.policy.with_suffix(".onnx")
            replace_file(onnx_file, export(load_policy(result.policy)))
    content = {"out": result.out} | result.summary | _content(result, "iterations_run", "policy")
    content |= {"onnx": onnx_file, "plots": result.plots}
    return Output(content, lambda: _print_training(result, onnx_file))


def _print_training(result: TrainingResult, onnx_file: Path | None) -> None:
    summary, rows = result.summary, []
    for scene, statistics in summary["scenes"].items():
        for walker, name in (("policy", "policy"), ("alone", "controller alone")):
            walker_statistics = statistics[walker]
            costs = [
                f"{walker_statistics[cost]:.3g}"
                for cost in ("cost_of_transport", "electrical_cost_of_transport")
            ]
            rows.append(
                [
                    scene,
                    name,
                    f"{100 * walker_statistics['success']:.0f}",
                    f"{1e3 * walker_statistics['speed']:.1f}",
                    *costs,
                ]
            )
    if rows:
        headings = [
            "scene",
            "walks",
            "success [%]>",
            "speed [mm/s]>",
            "cost of transport, mechanical>",
            "electrical>",
        ]
        conditions = (
            f"physics {summary['judged']['physics']}, profile {result.training.setup.profile}"
        )
        title = (
            f"On {result.training.evaluation.bodies:,} unseen bodies and starts, in {conditions}"
        )
        print_table(title, headings, rows)
    cpu = summary["environment_cpu"] + summary["learner_cpu"]
    click.echo(
        f"{summary['steps']:,} control steps, {duration(summary['simulated_seconds'])} simulated, in "
        f"{duration(summary['wall_seconds'])} ({duration(cpu)} of CPU time)"
    )
    if result.training.validation:
        click.echo(
            f"policy after {summary['policy_steps']:,} steps, the best of all checkpoints in its walks"
        )
    files = {"policy": result.policy, "onnx": onnx_file, "history": "history.parquet"}
    print_places(result.out, **files, plots=result.plots and "plots")


@command("experiment")
@options.out
@click.argument("name", type=click.Choice((*EXPERIMENTS, "all")))
@options.choice_option(
    "--profile", ("all", *PROFILE), "Set-up: as published, as described, as built."
)
@number("--repeats", "Starts of each case; by default 3, or 1 with --quick.", click.IntRange(1))
@number("--seed", "Seed of the shifts between repeats.", click.IntRange(0), default=0)
@number(
    "--bodies",
    "Also run this many identified bodies: for what share of them does a line hold?",
    click.IntRange(1),
)
@flag("--quick", "Quick run: fewer cases, no videos; a minute.")
@flag("--no-video", "Render no videos.")
@flag("--again", "Rerun, and replace the results in DIR.")
@options.text(
    "--controller",
    "FILE.npz",
    "A policy, in place of the published controller; for straight-line, turning and maze.",
)
@options.set_option("A parameter of the body, such as contact.friction; repeatable.")
@_on_engine
def experiment_command(
    name: str,
    out: Path,
    profile: str,
    no_video: bool,
    assignments: tuple[str, ...],
    **job_options: Any,
) -> Output:
    """Run a published experiment, or all of them, and compare.

    Writes a table of every run, a report with the published figures beside
    the simulated ones, plots, recordings and a video. Finished experiments
    are kept in DIR; the same command resumes.

    --workers ray distributes experiments, and batches of bodies, over the
    machines of a cluster, which need no access to DIR.

    Examples:
      nermo-mjx experiment all --out runs/published
      nermo-mjx experiment all --quick --out runs/look
      nermo-mjx experiment turning --profile exact --repeats 5 --out runs/turns
      nermo-mjx experiment maze --set contact.friction=0.8 --out runs/slippery
      nermo-mjx experiment all --bodies 64 --out runs/published
      nermo-mjx experiment maze --controller policy.npz --out runs/learned
    """
    # The stage of identified bodies, such as "maze, 64 bodies", does not report compilation.
    with _working("", job_options, compiles=lambda stage: "," not in stage) as arguments:
        from nermo_mjx.experiments.run import run_experiments
        from nermo_mjx.robot.quantity import quantities
        from nermo_mjx.rollout.setup import WorldParameters

        # `run_experiments` checks the ranges of these values.
        values = assigned(assignments, dict(quantities(WorldParameters)))
        profiles = PROFILE if profile == "all" else (profile,)
        names = EXPERIMENTS if name == "all" else [name]
        result = run_experiments(
            names, out, profiles=profiles, values=values, video=not no_video, **arguments
        )
    run = {
        experiment_result.name: {"kept": experiment_result.kept}
        for experiment_result in result.results
    }
    return Output(
        {"out": result.out, "run": run, **result.report}, lambda: _print_experiments(result)
    )


def _print_experiments(result: ExperimentsResult) -> None:
    from nermo_mjx.experiments.report import LINE_HEADINGS, cells
    from nermo_mjx.experiments.run import EXPERIMENTS as CATALOGUE

    content = result.report
    # Longer cells are cut off; the names of published figures are shorter.
    max_cell_width = 72
    for experiment_result in result.results:
        lines = [
            cells(line) for line in content["lines"] if line["experiment"] == experiment_result.name
        ]
        rows = [
            [
                text if len(text) <= max_cell_width else f"{text[: max_cell_width - 1]}…"
                for text in line
            ]
            for line in lines
        ]
        print_table(CATALOGUE[experiment_result.name].title, LINE_HEADINGS, rows)
    for experiment_result in result.results:
        metadata, summary = (
            content["experiments"][experiment_result.name],
            content["summary"]["by_experiment"][experiment_result.name],
        )
        effort = f"{metadata['worlds']} runs in {duration(metadata['wall_seconds'])}, engine {metadata['engine']}"
        click.echo(
            f"{experiment_result.name}: {_counted(summary)} ({effort}{', kept' if experiment_result.kept else ''})"
        )
    kinds = content["summary"]["by_kind"]
    click.echo(
        f"all of {result.out}: {'; '.join(f'{kind}: {_counted(kinds[kind])}' for kind in kinds)}"
    )
    click.echo("Only predicted lines count as evidence.")
    for sentence in content["differences"]:
        click.echo(sentence)
    folders = {"plots": "plots", "recordings": "*/recordings", "videos": "videos"}
    files = {
        name: folder
        for name, folder in folders.items()
        if any(getattr(experiment_result, name) for experiment_result in result.results)
    }
    print_places(result.out, report="report.md", tables="*/results", **files)


def _counted(summary: dict[str, Any]) -> str:
    """How many of the published figures hold in the simulation, for example `12 of 15 figures hold`."""
    compared = summary["hold"] + summary["do_not_hold"]
    missing = (
        f", {summary['not_measured']} not judged or measured" if summary["not_measured"] else ""
    )
    return f"{summary['hold']} of {compared} figures hold{missing}"


@command("identify")
@options.out
@options.text(
    "--log",
    "FILE",
    "A log of the robot, CSV or Parquet; repeatable.",
    multiple=True,
    type=FileKind(".csv", ".parquet"),
)
@options.text(
    "--channels",
    "FILE.yaml",
    "What the columns of the logs are; see nermo-mjx log.",
    type=options.SPEC,
)
@options.text(
    "--check",
    "FILE",
    "A log that judges; by default the last quarter of each.",
    multiple=True,
    type=FileKind(".csv", ".parquet"),
)
@options.text("--model", "FILE.xml", "The MJCF of another robot.", type=FileKind(".xml"))
@options.text(
    "--free", "KINDS", "Kinds of parameters, separated by commas; by default all but play."
)
@options.text(
    "--range", "NAME=LOW:HIGH", "Range of a parameter or kind; repeatable.", multiple=True
)
@number("--seed", "Seed of all searches.", click.IntRange(0), default=0)
@options.robot
# Many parameters because each is an option of the command.
def identify_command(
    out: Path,
    *,
    log: tuple[Path, ...],
    channels: Path | None,
    check: tuple[Path, ...],
    model: Path | None,
    free: str | None,
    range: tuple[str, ...],
    robot: str,
    seed: int,
) -> Output:
    """Identify a robot's body from its logs.

    Fits a model that is driven by the logged commands to what the robot
    measured, and says which parameters the log determines, which only
    together, whether this kind of model explains it, and what to measure next.
    The model is Nermo, or with --model any MJCF.

    The same command resumes an identification. The file ensemble.csv contains
    robot instances: `--body DIR` of other jobs uses the best one,
    `randomize: {from: DIR}` samples one for each run.

    Examples:
      nermo-mjx identify --log robot.csv --channels robot.yaml --out runs/mine
      nermo-mjx identify --log a.csv --channels a.yaml --model arm.xml --out arm
    """
    if not log:
        raise WrongUse(
            "identify needs --log FILE, a log of the robot. The result of the identification from published speeds "
            "is part of the package: randomize: {from: identified}."
        )
    if model and "robot" in options.given():
        raise WrongUse("--model is another robot: give it, or --robot.")
    from nermo_mjx.hardware.log import read_log
    from nermo_mjx.identify.identification import FREE_KINDS
    from nermo_mjx.identify.report import ESTIMATE_HEADINGS, estimate_rows
    from nermo_mjx.identify.run import run_identification
    from nermo_mjx.robot.quantity import require
    from nermo_mjx.runs.job import Watch

    require("identify", "cma", "cma")
    if channels is None:
        raise WrongUse("--log needs --channels FILE.yaml, which says what the columns are.")
    ranges = dict[str, tuple[float, float]]()
    for bound in range:
        name, _, ends = bound.partition("=")
        try:
            low, high = map(float, ends.split(":"))
        except ValueError:
            raise WrongUse(f"--range {bound}: expected NAME=LOW:HIGH, such as kp=1:3.") from None
        ranges[name] = (low, high)
    logs, check_logs = ([read_log(file, channels) for file in files] for files in (log, check))
    with ProgressBar("identify") as bar:
        result = run_identification(
            logs,
            out,
            model=robot if model is None else model,
            free=free.split(",") if free else FREE_KINDS,
            ranges=ranges,
            judges=check_logs,
            seed=seed,
            watch=Watch(lambda progress: bar.share(progress.fraction), say),
        )
    content = result.content

    def show() -> None:
        print_table("Parameters", ESTIMATE_HEADINGS, estimate_rows(content["parameters"]))
        for sentence in content["sentences"]:
            click.echo(sentence)
        print_places(
            out,
            report="report.html",
            body=content["files"][0],
            next=content["next"]["file"] or None,
        )

    return Output({"out": out, **content}, show)
