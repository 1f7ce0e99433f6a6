"""The command that drives a robot: over the topics of a real one, or of a simulated one that it is itself."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import PILOTS, ROBOTS, TAILS
from nermo_mjx.cli.output import Failure, WrongUse, print_json, stdout_reserved
from nermo_mjx.cli.walk import plan

DRIVE_EPILOG = """\b
Examples:
  nermo-mjx drive --robot mqtt://192.168.0.10 --frequency 0.8 --seconds 10
  nermo-mjx drive --robot ros://localhost --switch 4,gait=lat
  nermo-mjx drive --serve mqtt://localhost --delay 20 --loss 0.01
"""


def _robot(context: click.Context, parameter: click.Parameter, given: tuple[str, ...]) -> tuple[str, str | None]:
    """The model's name, and the address of a robot."""
    urls = [each for each in given if "://" in each]
    names = [each for each in given if "://" not in each]
    for name in names:
        click.Choice(ROBOTS).convert(name, parameter, context)
    if len(urls) > 1 or len(names) > 1:
        raise click.BadParameter("give one name and one address at most.", context, parameter)
    return names[0] if names else ROBOTS[0], urls[0] if urls else None


def wire_options(function: Any) -> Any:
    """The options of robots that are driven over topics, and of those that are simulated there."""
    listed = [
        click.option("--robot", multiple=True, metavar="NAME|URL", callback=_robot,
                     help=f"{' or '.join(ROBOTS)}, and the address of a real one: mqtt://HOST[:PORT] of a broker, or "
                     "ros://HOST[:PORT] of a rosbridge."),
        click.option("--serve", metavar="URL", help="Be a simulated robot that is driven from there."),
        click.option("--channels", default="published", show_default=True, metavar="FILE.yaml", type=options.SPEC,
                     help="Channel, direction, zero and limits of each servo, as for `servos`."),
        options.number("--rate", "Commands per second; by default that of the channels, or of the controller.",
                       options.POSITIVE),
        options.number("--watchdog", "Seconds without messages after which the robot holds still.", options.POSITIVE,
                       default=0.25),
        options.number("--seconds", "Duration, by default until Ctrl-C.", options.POSITIVE),
        options.number("--delay", "With --serve: each message takes about this long, each way [ms].",
                       click.FloatRange(0, 10_000), default=0.0),
        options.number("--loss", "With --serve: share of messages that get lost, each way.", click.FloatRange(0, 1),
                       default=0.0),
    ]  # fmt: skip
    for option in reversed(listed):
        function = option(function)
    return function


@click.command("drive", epilog=DRIVE_EPILOG)
@options.gait
@click.option("--controller", metavar="FILE", help="Custom controller: FILE.py:NAME, or a policy FILE.npz.")
@options.choice("--pilot", PILOTS, "Default: straight, or open_loop with --turn-rate.", default=None)
@options.scene
@options.choice("--tail", TAILS)
@options.physics
@options.set_option("Any parameter that `sweep --list-parameters` prints; repeatable.")
@click.option("--switch", "switches", multiple=True, metavar="AT,NAME=X...", help="As for `walk`; repeatable.")
@options.number("--seed", "Shift the start slightly, like the repeats of a sweep.", click.IntRange(0))
@wire_options
@options.report
def drive_command(
    robot: tuple[str, str | None], serve: str | None, channels: Path, rate: float | None, watchdog: float,
    seconds: float | None, delay: float, loss: float, as_json: bool, quiet: bool, **chosen: Any,
) -> None:  # fmt: skip
    """Drive a robot over its topics, or be one.

    --robot closes the loop of the controller over the topics q_values (servo
    angles, out) and sensors_mouse (what the robot measures, in). Servos go to
    the start of the gait slowly. Without messages the robot holds still, and
    after 5 s the drive ends. A robot without sensors, such as Nermo-Lite, is
    driven with --pilot open_loop.

    --serve is the other side: a simulated robot, in real time.
    """
    model, url = robot
    if (url is None) == (serve is None):
        raise WrongUse("Give --robot URL or --serve URL.")
    with stdout_reserved():
        wanted = plan(cycles=None, duration=None, warmup=None, robot=model, **chosen)
        if serve is not None:
            about = serve_wired(wanted.setup, wanted.values, serve, channels, seconds, delay / 1e3, loss, quiet)
        else:
            assert url is not None
            about = drive_wired(wanted.setup, wanted.values, url, channels, rate, watchdog, seconds, quiet)
    if as_json:
        print_json(about)
    elif not quiet:
        for name, value in about.items():
            told = ", ".join(f"{each} {what}" for what, each in value.items()) if isinstance(value, dict) else value
            click.echo(f"{name}: {told if not isinstance(told, float) else f'{told:.4g}'}")
    if about.get("ended"):
        raise Failure(f"{about['ended']}.".replace("..", "."))


def drive_wired(
    setup: Any, values: Any, url: str, channels: Path, rate: float | None, watchdog: float, seconds: float | None,
    quiet: bool,
) -> dict[str, Any]:  # fmt: skip
    """Drive a robot; how it went."""
    from nermo_mjx.hardware.live import ROS_TYPE, TOPIC, SendError, linked
    from nermo_mjx.hardware.table import channels_of
    from nermo_mjx.live import wire
    from nermo_mjx.live.running import Running
    from nermo_mjx.robot import ParameterError

    robot = setup.load()
    connected, needed = channels_of(channels, robot), wire.needed_sensors(setup)
    running = Running(setup, values)
    rate = rate or connected.rate
    if rate is not None and rate > 1.0 / running.dt + 1e-6:
        raise ParameterError(f"rate is {rate:g} Hz: allowed is (0, {1.0 / running.dt:g}], the controller's.")
    measured = wire.Measured(robot, connected, watchdog)
    running.reset(measured.sensordata)  # compiled before the robot is reached
    try:
        with linked(url, TOPIC, ROS_TYPE, wire.SENSORS_TOPIC, measured.receive, "robot") as publish:
            wire.meet(measured, needed)
            if not quiet:
                click.echo("drive: the robot is there" if measured.told else "drive: the robot says nothing, so its "
                           "servos go to the start of the gait at their own speed", err=True)  # fmt: skip
            return dataclasses.asdict(wire.drive_robot(wire.Wired(running, measured, publish, url, rate), seconds))
    except SendError as error:
        raise Failure(str(error)) from None


def serve_wired(
    setup: Any, values: Any, url: str, channels: Path, seconds: float | None, delay: float, loss: float, quiet: bool
) -> dict[str, Any]:
    """Be a simulated robot; what it did."""
    from nermo_mjx.hardware.live import TOPIC, SendError, linked
    from nermo_mjx.hardware.table import channels_of
    from nermo_mjx.live import wire
    from nermo_mjx.runs.interruption import interruptible

    body = wire.SimulatedRobot(setup, values, channels_of(channels, setup.load()), delay, loss)
    try:
        with (
            interruptible(),
            linked(url, wire.SENSORS_TOPIC, wire.SENSORS_TYPE, TOPIC, body.receive, "serve") as publish,
        ):
            if not quiet:
                click.echo("drive: the simulated robot is there", err=True)
            return body.run(publish, seconds)
    except SendError as error:
        raise Failure(str(error)) from None
