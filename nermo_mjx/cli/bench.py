"""`nermo-mjx bench`: how fast this machine is, against plain physics."""

from __future__ import annotations

from typing import Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import ENGINES, GRADIENT_MODES
from nermo_mjx.cli.output import print_json, print_table, stdout_reserved
from nermo_mjx.cli.progress import Progress

EPILOG = """\b
Examples:
  nermo-mjx bench
  nermo-mjx bench --engine mjx --worlds 64 --worlds 1024 --json
  nermo-mjx bench --gradient forward --gradient reverse --cycles 1 --cycles 4
  nermo-mjx bench --tuning 0.5 --tuning 0.8
"""


#: Heading, side, key, format and scale of each column.
_ENGINE_COLUMNS = (
    ("engine", "left", "engine", "{}", 1.0),
    ("worlds", "right", "worlds", "{:,}", 1),
    ("steps/s", "right", "steps_per_second", "{:,.0f}", 1.0),
    ("plain steps/s", "right", "plain_steps_per_second", "{:,.0f}", 1.0),
    ("ratio", "right", "ratio", "{:.2f}", 1.0),
    ("trace [s]", "right", "trace_s", "{:.1f}", 1.0),
    ("compile [s]", "right", "compile_s", "{:.1f}", 1.0),
    ("plain [s]", "right", "plain_compile_s", "{:.1f}", 1.0),
    ("peak [MB]", "right", "peak_bytes", "{:,.0f}", 1e-6),
)
_GRADIENT_COLUMNS = (
    ("mode", "left", "mode", "{}", 1.0),
    ("worlds", "right", "worlds", "{:,}", 1),
    ("cycles", "right", "horizon_cycles", "{:g}", 1.0),
    ("gradient [s]", "right", "gradient_s", "{:.2f}", 1.0),
    ("walk [s]", "right", "forward_s", "{:.2f}", 1.0),
    ("ratio", "right", "ratio", "{:.2f}", 1.0),
    ("trace [s]", "right", "trace_s", "{:.1f}", 1.0),
    ("compile [s]", "right", "compile_s", "{:.1f}", 1.0),
    ("kB a world", "right", "temporary_bytes_per_world", "{:,.0f}", 1e-3),
    ("peak [MB]", "right", "peak_bytes", "{:,.0f}", 1e-6),
)
_TUNING_COLUMNS = (
    ("search", "left", "search", "{}", 1.0),
    ("from phase [rad]", "right", "start_phase", "{:.2f}", 1.0),
    ("amplitude [rad]", "right", "amplitude", "{:.3f}", 1.0),
    ("phase [rad]", "right", "phase", "{:.2f}", 1.0),
    ("speed [m/s]", "right", "speed", "{:.4f}", 1.0),
    ("of the best", "right", "share", "{:.1%}", 1),
    ("runs", "right", "runs", "{:g}", 1),
    ("wall [s]", "right", "wall_s", "{:.0f}", 1.0),
)


@click.command("bench", epilog=EPILOG)
@options.choice("--engine", ENGINES[1:], "Repeatable; all by default.", default=None, multiple=True)
@options.number("--worlds", "Size of the batch; repeatable.", click.IntRange(1), multiple=True)
@options.choice(
    "--gradient", GRADIENT_MODES, "Measure gradients in this mode; repeatable.", default=None, multiple=True
)
@options.number("--cycles", "Gait cycles that are differentiated; repeatable.", click.FloatRange(0, min_open=True),
                multiple=True)  # fmt: skip
@options.number("--tuning", "Tune a trot of this frequency [Hz], against a dense sweep and CMA-ES; repeatable.",
                click.FloatRange(0, min_open=True), multiple=True)  # fmt: skip
@options.report
def command(
    engine: tuple[str, ...],
    worlds: tuple[int, ...],
    gradient: tuple[str, ...],
    cycles: tuple[float, ...],
    tuning: tuple[float, ...],
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure throughput, compile time and memory of each engine.

    Each case runs the robot with its controller, and the same physics
    without; the ratio of both is the price of the controller. With
    --gradient, value and gradient of a walk against the walk alone.
    With --tuning, the speed that tuning by gradient, and CMA-ES, reach
    on a tenth of a dense sweep's simulated time.
    """
    if cycles and not gradient:
        raise click.UsageError("--cycles is the length of the walks that --gradient measures.")
    with stdout_reserved():
        from nermo_mjx.bench import run_bench

        with Progress("bench", "cases", quiet=quiet, compiles=True) as progress:
            result = run_bench(
                engines=engine or None, worlds=worlds or None, gradients=gradient, cycles=cycles or None,
                tunings=tuning, progress=progress.count,
            )  # fmt: skip
    if as_json:
        print_json(result)
    elif not quiet:
        _print(result)


def _print(result: dict[str, Any]) -> None:
    hardware = result["hardware"]
    text = ", ".join(f"{key} {value}" for key, value in hardware.items()) if isinstance(hardware, dict) else hardware
    click.echo(f"hardware: {text}")
    engines = [case for case in result["cases"] if "engine" in case and "mode" not in case]
    gradients = [case for case in result["cases"] if "mode" in case]
    if engines:
        _table("Physics steps of all worlds together", _ENGINE_COLUMNS, engines)
    if gradients:
        _table("Value and gradient against the value alone", _GRADIENT_COLUMNS, gradients)
    for case in result["cases"]:
        if "searches" in case:
            dense = f"{case['dense_runs']} runs of a dense sweep reach {case['dense_speed']:.4f} m/s"
            title = f"Trot at {case['frequency']:g} Hz: {dense}; {case['budget_runs']} runs for each search"
            _table(title, _TUNING_COLUMNS, case["searches"])


def _table(title: str, columns: tuple[Any, ...], cases: list[dict[str, Any]]) -> None:
    rows = [[_cell(case.get(key), shape, scale) for _, _, key, shape, scale in columns] for case in cases]
    print_table(title, [(heading, side) for heading, side, *_ in columns], rows)


def _cell(value: Any, shape: str, scale: float) -> str:
    if value is None:
        return "-"
    return shape.format(value if isinstance(value, str) or scale == 1 else value * scale)
