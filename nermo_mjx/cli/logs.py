"""The command about a robot's own log, and what other commands show of logs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.options import FileKind
from nermo_mjx.cli.output import Output, WrongUse, command, in_unit, print_table

if TYPE_CHECKING:
    from nermo_mjx.hardware.log import Log
    from nermo_mjx.hardware.signals import Difference

#: Suffixes of logs.
LOGS = (".csv", ".parquet")
#: How many first rows of a log are shown back, and how many columns.
_ROWS, _WIDE = 3, 6

log_channels = options.text(
    "--channels",
    "FILE.yaml",
    "The log's columns; by default the YAML file beside it.",
    type=options.SPEC,
)


def log_of(file: Path, channels: Path | None) -> Log:
    """A log with its channels, by default those of the YAML file of its name beside it.

    Raises:
        WrongUse: there is none.
        SpecError: see `read_log`.
    """
    from nermo_mjx.hardware.log import read_log

    beside = file.with_suffix(".yaml")
    if channels is None and not beside.exists():
        raise WrongUse(
            f"{file}: give the file of its channels, --channels FILE.yaml; by default it is {beside}."
        )
    return read_log(file, channels or beside)


@command("log", reads=True)
@click.argument("file", metavar="FILE", type=FileKind(*LOGS, dir_okay=False))
@log_channels
def log_command(file: Path, channels: Path | None) -> Output:
    """Check a robot's own log, and say what looks wrong in it.

    FILE is CSV or Parquet, with a row for each time. The file of its channels
    says which column is what, in which unit, sign and zero:

    \b
    time: {column: t, unit: ms}
    channels:
      cmd1: {quantity: command, of: spine, unit: deg, sign: -1, zero: 90}
      pos1: {quantity: angle, of: spine, unit: deg}
      gyro: {quantity: gyro, columns: [gx, gy, gz], unit: deg/s}
      mark: {quantity: position, columns: [x, y], unit: mm}

    It shows the header and the first rows back, then rates, ranges, and how
    far each angle is behind its command. Gaps, late and doubled stamps,
    saturation, mirrored servos, wrong units and lags are told in a sentence.

    Examples:
      nermo-mjx log robot.csv --channels robot.yaml
      nermo-mjx log robot.parquet --json
    """
    import numpy as np

    from nermo_mjx.hardware.log import MOTION_THRESHOLD, table_of_log
    from nermo_mjx.hardware.signals import findings_of, lag_of

    log, table = log_of(file, channels), table_of_log(file)
    commands, findings = log.of_quantity("command"), findings_of(log)
    rows = []
    for channel in log.channels:
        command_channel = commands.get(channel.of) if channel.quantity == "angle" else None
        lag = (
            None
            if command_channel is None or np.ptp(command_channel.values) <= MOTION_THRESHOLD
            else lag_of(channel, command_channel)[0]
        )
        low, high = float(channel.values.min()), float(channel.values.max())
        report = {
            "channel": channel.name,
            "quantity": channel.quantity,
            "of": channel.of,
            "rate": 1.0 / channel.interval,
        }
        rows.append(
            report
            | {
                "samples": len(channel.times),
                "low": low,
                "high": high,
                "unit": channel.unit,
                "lag": lag,
            }
        )
    content = {"file": file, "seconds": log.duration, "channels": rows, "findings": findings}

    def show() -> None:
        names = [str(name) for name in table.columns]
        remaining_text = f" and {len(names) - _WIDE} more" if len(names) > _WIDE else ""
        cells = table.iloc[:_ROWS, :_WIDE].astype(str).values.tolist()
        print_table(
            f"{file}: {len(table):,} rows of {len(names)} columns{remaining_text and ', the first ones'}",
            names[:_WIDE],
            cells,
        )
        print_table(f"{log.duration:.4g} s", _CHANNEL_HEADINGS, [_shown_row(row) for row in rows])
        for sentence in findings or ["Nothing looks wrong."]:
            click.echo(sentence)

    return Output(content, show)


_CHANNEL_HEADINGS = (
    "channel, quantity, of, rate [Hz]>, samples>, from>, to>, unit, behind its command [ms]>"
)


def _shown_row(row: dict[str, Any]) -> list[str]:
    (low, high), unit = in_unit("", row["unit"], row["low"], row["high"])
    lag = "" if row["lag"] is None else str(round(1e3 * row["lag"]))
    numbers = [f"{row['rate']:.4g}", f"{row['samples']:,}", f"{low:.3g}", f"{high:.3g}"]
    return [row["channel"], row["quantity"], row["of"], *numbers, unit, lag]


def compare_files(a: Path, b: Path, channels: Path | None) -> Output:
    """Two logs, or a log and a recording of the twin, or two recordings, channel by channel: B minus A."""
    from nermo_mjx.cli.view import load_recording
    from nermo_mjx.hardware.signals import channel_differences
    from nermo_mjx.hardware.twin import beside, twin_signals
    from nermo_mjx.view import robot_of

    loaded = {path: load_recording(path) for path in (a, b) if path.suffix == ".npz"}
    twins = {
        path: twin_signals(recording, robot_of(recording)) for path, recording in loaded.items()
    }
    first_log, second_log = (twins.get(path) or log_of(path, channels) for path in (a, b))
    first_log, second_log = (
        beside(second_log, first_log) if a in twins else first_log,
        beside(first_log, second_log) if b in twins else second_log,
    )
    if not (differences := channel_differences(second_log, first_log)):
        raise WrongUse(
            f"{a} and {b} have no channel of the same quantity and thing at the same time."
        )
    content = {"a": a, "b": b, "channels": [*map(dataclasses.asdict, differences)]}
    return Output(content, lambda: print_differences(f"{b} minus {a}", differences))


def print_differences(
    title: str, differences: Sequence[Difference], missing_names: Sequence[str] = ()
) -> None:
    """Channels beside other ones, in units that people read; `missing` are channels that the twin lacks."""
    rows = []
    for difference in differences:
        numbers, unit = in_unit(
            "", difference.unit, difference.rms, difference.bias, difference.amplitude
        )
        row = [difference.name, *(f"{round(number, 6) + 0.0:.3g}" for number in numbers), unit]
        rows.append([*row, str(round(1e3 * difference.lag)), f"{difference.correlation:.3f}"])
    print_table(title, "channel, RMS>, mean>, signal>, unit, lag [ms]>, correlation>", rows)
    if missing_names:
        click.echo(f"The twin has no signal of {', '.join(missing_names)}.")
