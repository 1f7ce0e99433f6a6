"""`nermo-mjx bench`: how fast this machine is, against plain physics."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import BENCH_CASES, ENGINES, GRADIENT_MODES
from nermo_mjx.cli.output import print_json, print_table, stdout_reserved
from nermo_mjx.cli.progress import Progress

EPILOG = """\b
Cases:
  throughput  a walk with controller and metrics against plain physics
  gradient    value and gradient of a walk against the walk alone
  startup     a new process to its first control tick, cold and warm cache

\b
Examples:
  nermo-mjx bench
  nermo-mjx bench --engine mjx --worlds 64 --worlds 1024 --json
  nermo-mjx bench gradient --mode reverse --cycles 1 --cycles 4
  nermo-mjx bench throughput startup --into docs/benchmarks
"""


@click.command("bench", epilog=EPILOG)
@click.argument("cases", nargs=-1, type=click.Choice(BENCH_CASES), metavar="[CASE]...")
@options.choice("--engine", ENGINES[1:], "Repeatable; c and mjx by default.", default=None, multiple=True)
@options.number("--worlds", "Size of the batch; repeatable.", click.IntRange(1), multiple=True)
@options.choice("--mode", GRADIENT_MODES, "How gradients are computed; repeatable.", default=None, multiple=True)
@options.number("--cycles", "Gait cycles to differentiate; repeatable.", options.POSITIVE, multiple=True)
@click.option("--into", metavar="DIR", type=click.Path(file_okay=False, path_type=Path),
              help="Append to DIR/results.jsonl, and draw its page and plots.")  # fmt: skip
@options.report
def command(cases: tuple[str, ...], into: Path | None, as_json: bool, quiet: bool, **given: tuple[Any, ...]) -> None:
    """Measure throughput, compile time and memory on this machine.

    The default CASE is throughput: the robot with its controller, and the
    same physics without; their ratio is the cost of the controller.
    """
    with stdout_reserved():
        from nermo_mjx.bench.results import draw_page
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
    from nermo_mjx.bench.results import RESULTS, append
    from nermo_mjx.runs.text import plain

    if out is None:
        return run_bench(cases, given, count)
    kept = []

    def keep(run: dict[str, Any]) -> None:
        append(out / RESULTS, plain(run))
        kept.append(run)

    try:
        return run_bench(cases, given, count, keep=keep)
    except KeyboardInterrupt:
        if not kept:
            raise
        number = "1 measurement is" if len(kept) == 1 else f"{len(kept)} measurements are"
        raise KeyboardInterrupt(f"stopped; {number} kept in {out / RESULTS}.") from None


def _print(result: dict[str, Any]) -> None:
    from nermo_mjx.bench.results import failure_of, table_of

    if result["hardware"]:
        click.echo("hardware: " + ", ".join(f"{key} {value}" for key, value in result["hardware"].items()))
    for line in result["cases"]:
        if failure := failure_of(line):
            click.echo(failure)
    for case in dict.fromkeys(line["case"] for line in result["cases"]):
        columns, rows = table_of(case, [line for line in result["cases"] if line["case"] == case])
        if rows:
            words = ("engine", "mode", "cache")
            headings = [(column.heading, "left" if column.key in words else "right") for column in columns]
            print_table(case.capitalize(), headings, rows)
