"""`nermo-mjx servos`: the servo angles of a gait as a table for the real robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import ROBOTS, TAILS
from nermo_mjx.cli.group import Failure
from nermo_mjx.cli.output import print_json, print_table, stdout_reserved
from nermo_mjx.cli.walk_plan import plan

EPILOG = """\b
Examples:
  nermo-mjx servos --frequency 0.8 --out trot.csv
  nermo-mjx servos --gait lat --turn-rate 0.5 --rate 100 --out turn.csv
  nermo-mjx servos --spine stride_extension --cycles 3 --out walk.csv
"""


@click.command("servos", epilog=EPILOG)
@options.gait
@options.number("--rate", "Rows a second.", options.POSITIVE, default=50.0)
@options.number("--cycles", "Whole gait cycles.", click.IntRange(1), default=1)
@click.option("--channels", metavar="FILE.yaml", type=options.SPEC,
              help="Channel, direction, zero and limits of each servo.")  # fmt: skip
@options.choice("--robot", ROBOTS)
@options.choice("--tail", TAILS)
@options.assigned("Any parameter that `sweep --list-parameters` prints; repeatable.")
@options.file("--out", ".csv", "Where the table goes.", required=True)
@options.report
def command(
    rate: float, cycles: int, channels: Path | None, out: Path, as_json: bool, quiet: bool, **chosen: Any
) -> None:
    """Write the servo angles of a gait as CSV, ready to be played in a loop.

    A time column, and a column for each servo in the order of its channel, in
    degrees. They come from the controller alone, long after its start, so
    that the last row leads back to the first. Whole gait cycles are cut into
    whole rows: the rate is set by that, very near to the one asked for.

    A file of channels has a line for each connected servo,
    NAME: {channel: 0, direction: -1, zero: 90, low: 20, high: 160}.
    """
    with stdout_reserved():
        from nermo_mjx.hardware import servo_table
        from nermo_mjx.runs.files import replace_file

        wanted = plan(pilot="open_loop", seed=None, cycles=None, duration=None, warmup=None, scene="flat",
                      physics="reference", **chosen)  # fmt: skip
        table = servo_table(wanted.setup, wanted.values, rate=rate, cycles=cycles, channels=channels)
        words = [f"gait {wanted.setup.gait}", f"spine {wanted.setup.spine}", f"steering {wanted.setup.steering}"]
        words += [f"{name} {value:g}" for name, value in {"frequency": table.frequency, **wanted.values}.items()]
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            replace_file(out, table.to_csv(", ".join(words)).encode())
        except OSError as error:
            raise Failure(f"{out}: the table cannot be written ({error.strerror}).") from None
    lows, highs = table.angles.min(axis=0), table.angles.max(axis=0)
    if as_json:
        servos = [
            {"servo": name, "channel": channel.number, "low_deg": low, "high_deg": high, "speed_deg_per_s": speed}
            for name, channel, low, high, speed in zip(
                table.names, table.channels, lows, highs, table.speed, strict=True
            )
        ]
        about = {"out": out, "rows": len(table.time), "rate": table.rate, "cycles": cycles}
        about |= {"frequency": table.frequency, "servo_speed_deg_per_s": table.servo_speed}
        print_json({**about, "servos": servos})
    elif not quiet:
        if table.too_fast:
            click.echo(f"servos: {table.too_fast}", err=True)
        columns = [("channel", "right"), ("servo", "left"), ("from [deg]", "right"), ("to [deg]", "right"),
                   ("fastest [deg/s]", "right")]  # fmt: skip
        rows = [[str(channel.number), name, f"{low:.1f}", f"{high:.1f}", f"{speed:.0f}"] for name, channel, low, high,
                speed in zip(table.names, table.channels, lows, highs, table.speed, strict=True)]  # fmt: skip
        print_table(f"{table.how_many}, {len(table.time)} rows, {table.rate:.6g} rows/s", columns, rows)
        click.echo(f"wrote {out}")
