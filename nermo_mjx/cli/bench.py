"""`nermo-mjx bench`: how fast this machine is, against plain physics."""

from __future__ import annotations

import contextlib
import functools
from pathlib import Path
from typing import Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import (
    BENCH_CASES,
    ENGINES,
    GAITS,
    GPU_PROGRAMS,
    GPU_TARGETS,
    GRADIENT_MODES,
    PAYING_METHODS,
    PAYING_TASKS,
)  # fmt: skip
from nermo_mjx.cli.output import print_json, print_table, stdout_reserved
from nermo_mjx.cli.progress import Progress

EPILOG = """\b
Cases:
  throughput  a walk with controller and metrics against plain physics
  gradient    value and gradient of a walk against the walk alone
  tuning      what tuning finds on a tenth of a dense sweep's time, and CMA-ES
  search      what CMA-ES finds with ten seeds, against a dense sweep
  gradients-pay  what gradients and CMA-ES find in the same processor time;
              with --into, one line per search; existing ones are skipped
  startup     a new process to its first control tick, cold and warm cache
  profile     a physics step, stage by stage
  speedtest   MuJoCo's own speed test of MJX on the same model
  gpu-plan    an estimate of the programs on a GPU, without one

\b
Examples:
  nermo-mjx bench
  nermo-mjx bench --engine mjx --worlds 64 --worlds 1024 --json
  nermo-mjx bench gradient --mode reverse --cycles 1 --cycles 4
  nermo-mjx bench throughput startup --into docs/benchmarks
  nermo-mjx bench gpu-plan --target t4 --program walk --worlds 1024
"""


@click.command("bench", epilog=EPILOG)
@click.argument("cases", nargs=-1, type=click.Choice(BENCH_CASES), metavar="[CASE]...")
@options.choice("--engine", ENGINES[1:], "Repeatable; c and mjx by default.", default=None, multiple=True)
@options.number("--worlds", "Size of the batch; repeatable.", click.IntRange(1), multiple=True)
@options.choice("--mode", GRADIENT_MODES, "How gradients are computed; repeatable.", default=None, multiple=True)
@options.number("--cycles", "Gait cycles to differentiate; repeatable.", options.POSITIVE, multiple=True)
@options.number(
    "--frequency", "Frequency of the trots to tune or search [Hz]; repeatable.", options.POSITIVE, multiple=True
)
@options.number("--parameters", "Number of parameters: 2, 8, 16, 32, 64; repeatable.", click.IntRange(1), multiple=True)
@options.choice("--task", PAYING_TASKS, "Objective of the search; repeatable.", default=None, multiple=True)
@options.choice("--gait", GAITS, "Gait to start from; repeatable.", default=None, multiple=True)
@options.choice("--method", PAYING_METHODS, "Search method; repeatable.", default=None, multiple=True)
@options.number("--seed", "Seed of a search; repeatable.", click.IntRange(1), multiple=True)
@click.option("--cpu", "cpu_s", metavar="X", type=options.POSITIVE, multiple=True,
              help="Budget of a search [CPU s]; repeatable.")  # fmt: skip
@options.choice("--target", GPU_TARGETS, "GPU to compile for; repeatable.", default=None, multiple=True)
@options.choice(
    "--program", GPU_PROGRAMS, "A walk, or its gradient in one mode; repeatable.", default=None, multiple=True
)
@click.option("--into", metavar="DIR", type=click.Path(file_okay=False, path_type=Path),
              help="Append to DIR/results.jsonl, and draw its page and plots.")  # fmt: skip
@options.report
def command(cases: tuple[str, ...], into: Path | None, as_json: bool, quiet: bool, **given: tuple[Any, ...]) -> None:
    """Measure throughput, compile time and memory on this machine.

    The default CASE is throughput: the robot with its controller, and the
    same physics without; their ratio is the cost of the controller.
    """
    with stdout_reserved():
        from nermo_mjx.bench.page import draw_page
        from nermo_mjx.runs import RunDirectory, Written, session
        from nermo_mjx.runs.files import clear_errors

        # Held while it measures, so that an hour's results can be written.
        with contextlib.nullcontext() if into is None else RunDirectory(into, "benchmarks") as held:
            with Progress("bench", "measurements", quiet=quiet, compiles=True) as progress:
                result = _measured(cases or ("throughput",), given, progress.count, None if held is None else held.out)
            if held is not None:
                held.note_session(session())
                with Written(held) as written, clear_errors(held.out):
                    draw_page(held.out, written.write)
                if written.aside and not quiet:
                    click.echo(f"bench: {written.sentence()}", err=True)
    if as_json:
        print_json(result)
    elif not quiet:
        _print(result)


def _measured(cases: tuple[str, ...], given: dict[str, Any], count: Any, out: Path | None) -> dict[str, Any]:
    """Run the cases; each measurement is appended to a file of the folder `out` as soon as it is made."""
    from nermo_mjx.bench import run_bench
    from nermo_mjx.bench.history import RESULTS, append, is_known
    from nermo_mjx.runs.text import plain

    if out is None:
        return run_bench(cases, given, count)
    kept = []

    def keep(run: dict[str, Any]) -> None:
        append(out, plain(run))
        kept.append(run)

    try:
        return run_bench(cases, given, count, keep=keep, known=functools.partial(is_known, out))
    except KeyboardInterrupt:
        if not kept:
            raise
        number = "1 measurement is" if len(kept) == 1 else f"{len(kept)} measurements are"
        raise KeyboardInterrupt(f"stopped; {number} kept in {out / RESULTS}.") from None


def _print(result: dict[str, Any]) -> None:
    from nermo_mjx.bench.columns import COLUMNS, rows, titled

    if result["hardware"]:
        click.echo("hardware: " + ", ".join(f"{key} {value}" for key, value in result["hardware"].items()))
    for line in result["cases"]:
        if title := titled(line):
            click.echo(title)
    for case in dict.fromkeys(line["case"] for line in result["cases"]):
        found = [row for line in result["cases"] if line["case"] == case for row in rows(line)]
        shown = [column for column in COLUMNS[case] if any(row.get(column.key) is not None for row in found)]
        if found:
            sides = [
                (column.heading, "left" if isinstance(found[0].get(column.key), str) else "right") for column in shown
            ]
            print_table(case.capitalize(), sides, [[column.cell(row) for column in shown] for row in found])
