"""`nermo-mjx servos`: the servo angles of a gait as a table for the real robot."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import ROBOTS, TAILS
from nermo_mjx.cli.group import Failure, WrongUse
from nermo_mjx.cli.output import print_json, print_table, stdout_reserved
from nermo_mjx.cli.recordings import load_recording
from nermo_mjx.cli.walk_plan import plan

if TYPE_CHECKING:
    from nermo_mjx.hardware.live import Sent
    from nermo_mjx.hardware.table import ServoTable

EPILOG = """\b
Examples:
  nermo-mjx servos --frequency 0.8 --out trot.csv
  nermo-mjx servos --gait lat --turn-rate 0.5 --rate 100 --out turn.csv
  nermo-mjx servos --spine stride_extension --cycles 3 --out walk.csv
  nermo-mjx servos --channels published --send mqtt://127.0.0.1 --seconds 10
  nermo-mjx servos --recording walk.npz --out policy.csv
"""


@click.command("servos", epilog=EPILOG)
@options.gait
@options.number("--rate", "Rows per second; by default that of the channels, or 50.", options.POSITIVE)
@options.number("--cycles", "Whole gait cycles, by default 1.", click.IntRange(1))
@click.option("--channels", metavar="FILE.yaml", type=options.SPEC,
              help="Channel, direction, zero and limits of each servo; published: the author's order, whole degrees "
                   "at 30 Hz.")  # fmt: skip
@options.choice("--robot", ROBOTS)
@options.choice("--tail", TAILS)
@options.assigned("Any parameter that `sweep --list-parameters` prints; repeatable.")
@click.option("--recording", metavar="FILE.npz", type=options.RECORDING,
              help="Instead of a gait: what was commanded in a recorded walk, such as that of a policy.")  # fmt: skip
@options.file("--out", ".csv", "File for the table.")
@click.option(
    "--send",
    metavar="URL",
    help="Send the angles to the robot in real time: mqtt://HOST[:PORT], or ws://HOST[:PORT] of a rosbridge.",
)
@click.option("--topic", default="q_values", show_default=True, metavar="NAME", help="MQTT or ROS topic.")
@options.number("--seconds", "Duration of sending; by default until Ctrl-C.", options.POSITIVE)
@options.report
def command(
    rate: float | None,
    cycles: int | None,
    channels: Path | None,
    recording: Path | None,
    out: Path | None,
    send: str | None,
    topic: str,
    seconds: float | None,
    as_json: bool,
    quiet: bool,
    **chosen: Any,
) -> None:
    """Write the servo angles of a gait as CSV, ready to be played in a loop, or
    send them to the robot.

    A time column, and a column for each servo in the order of its channel, in
    degrees. They come from the controller alone, long after its start, so
    that the last row leads back to the first. Whole gait cycles are divided
    into whole rows, so the actual rate is the nearest one that fits.

    A channel file has a line for each connected servo,
    NAME: {channel: 0, direction: -1, zero: 90, low: 20, high: 160}.

    --recording makes the table of a recorded walk, by whatever controller. A
    policy answers to its sensors, so its targets are those of one walk, to be
    played once, as an open loop.

    --send plays the table repeatedly in real time. Over MQTT a message
    is a JSON list of degrees, one per channel; to ROS 2, through a
    rosbridge server, a Float32MultiArray of radians.
    """
    if out is None and send is None:
        raise WrongUse("Give --out FILE.csv, --send URL, or both.")
    if send is None and seconds is not None:
        raise WrongUse("--seconds limits the duration of --send: give --send URL, too.")
    with stdout_reserved():
        from nermo_mjx.runs.files import replace_file

        if recording is None:
            table, words = _of_gait(rate, cycles, channels, chosen)
        else:
            table, words = _of_recording(recording, rate, channels)
        if out is not None:
            try:
                out.parent.mkdir(parents=True, exist_ok=True)
                replace_file(out, table.to_csv(", ".join(words)).encode())
            except OSError as error:
                raise Failure(f"{out}: the table cannot be written ({error.strerror}).") from None
        sent = None if send is None else _sent(table, send, topic, seconds)
    lows, highs = table.angles.min(axis=0), table.angles.max(axis=0)
    if as_json:
        servos = [
            {"servo": name, "channel": channel.number, "low_deg": low, "high_deg": high, "speed_deg_per_s": speed}
            for name, channel, low, high, speed in zip(
                table.names, table.channels, lows, highs, table.speed, strict=True
            )
        ]
        about: dict[str, Any] = {"out": out, "rows": len(table.time), "rate": table.rate, "cycles": table.cycles}
        about |= {"frequency": table.frequency, "servo_speed_deg_per_s": table.servo_speed}
        about |= {} if sent is None else {"sent": dataclasses.asdict(sent)}
        print_json({**about, "servos": servos})
    elif not quiet:
        if table.too_fast:
            click.echo(f"servos: {table.too_fast}", err=True)
        columns = [("channel", "right"), ("servo", "left"), ("from [deg]", "right"), ("to [deg]", "right"),
                   ("fastest [deg/s]", "right")]  # fmt: skip
        rows = [[str(channel.number), name, f"{low:.1f}", f"{high:.1f}", f"{speed:.0f}"] for name, channel, low, high,
                speed in zip(table.names, table.channels, lows, highs, table.speed, strict=True)]  # fmt: skip
        print_table(f"{table.how_many}, {len(table.time)} rows, {table.rate:.6g} rows/s", columns, rows)
        if out is not None:
            click.echo(f"wrote {out}")
        if sent is not None:
            click.echo(f"sent {sent.messages} messages in {sent.seconds:.1f} s, {sent.skipped} skipped; the latest was "
                       f"{1e3 * sent.latest:.1f} ms late")  # fmt: skip


def _of_gait(
    rate: float | None, cycles: int | None, channels: Path | None, chosen: dict[str, Any]
) -> tuple[ServoTable, list[str]]:
    """The table of a gait, and what it is in words."""
    from nermo_mjx.hardware import servo_table

    wanted = plan(pilot="open_loop", seed=None, cycles=None, duration=None, warmup=None, scene="flat",
                  physics="reference", **chosen)  # fmt: skip
    table = servo_table(wanted.setup, wanted.values, rate=rate, cycles=cycles or 1, channels=channels)
    words = [f"gait {wanted.setup.gait}", f"spine {wanted.setup.spine}", f"steering {wanted.setup.steering}"]
    named = {"frequency": table.frequency, **wanted.values}
    return table, words + [f"{name} {value:g}" for name, value in named.items()]


def _of_recording(path: Path, rate: float | None, channels: Path | None) -> tuple[ServoTable, list[str]]:
    """The table of a recorded walk, and what it is in words."""
    from nermo_mjx.hardware import recorded_table
    from nermo_mjx.view import robot_of

    kept = ("recording", "rate", "channels", "out", "send", "topic", "seconds", "as_json", "quiet")
    context = click.get_current_context()
    for each in context.command.params:
        source = context.get_parameter_source(each.name or "")
        if each.name not in kept and source is not ParameterSource.DEFAULT:
            raise WrongUse(f"{each.opts[0]} has no effect with --recording, whose walk is over: leave one of them out.")
    recording = load_recording(path)
    return recorded_table(recording, robot_of(recording), rate=rate, channels=channels), [f"walk {path.name}"]


def _sent(table: ServoTable, url: str, topic: str, seconds: float | None) -> Sent:
    """Send the table; nobody there is a failure, and not wrong use."""
    from nermo_mjx.hardware.live import SendError, connected, play

    try:
        with connected(url, topic) as send:
            return play(table, send, seconds)
    except SendError as error:
        raise Failure(str(error)) from None
