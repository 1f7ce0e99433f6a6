"""Options of `drive` for a robot behind topics."""

from __future__ import annotations

from typing import Any

import click
from click.core import ParameterSource

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import ROBOTS
from nermo_mjx.cli.output import WrongUse


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
                     shell_complete=options.names(*ROBOTS),
                     help=f"{' or '.join(ROBOTS)}, and the address of a real one: mqtt://HOST[:PORT] of a broker, or "
                     "ros://HOST[:PORT] of a rosbridge."),
        click.option("--serve", metavar="URL", help="Be a simulated robot that is driven from there."),
        click.option("--channels", default="published", show_default=True, metavar="FILE.yaml", type=options.SPEC,
                     help="Channel, direction, zero and limits of each servo, as for `servos`."),
        options.number("--rate", "Commands per second; by default that of the channels, or of the controller.",
                       options.POSITIVE),
        options.number("--watchdog", "Seconds without messages after which the robot holds still.",
                       click.FloatRange(0, 5, min_open=True), default=0.25),
        click.option("--headless", is_flag=True, help="Drive a robot without a page, from now on."),
        click.option("--switch", "switches", multiple=True, metavar="AT,NAME=X...", help="As for `walk`; repeatable."),
        options.number("--delay", "With --serve: each message takes about this long, each way [ms].",
                       click.FloatRange(0, 10_000), default=0.0),
        options.number("--loss", "With --serve: share of messages that get lost, each way.", click.FloatRange(0, 1),
                       default=0.0),
    ]  # fmt: skip
    for option in reversed(listed):
        function = option(function)
    return function


def check_use(url: str | None, serve: str | None, headless: bool) -> None:
    """Refuse options that have no effect."""
    context = click.get_current_context()
    given = {each.name: each.opts[0] for each in context.command.params
             if context.get_parameter_source(each.name or "") is not ParameterSource.DEFAULT}  # fmt: skip
    if url is not None and serve is not None:
        raise WrongUse("Give --robot URL or --serve URL, not both.")
    for names, there, why in (
        (("headless", "rate", "watchdog"), url is not None, "without --robot URL"),
        (("channels",), url is not None or serve is not None, "without --robot URL or --serve URL"),
        (("delay", "loss"), serve is not None, "without --serve URL"),
        (("port", "browser", "record"), not headless and serve is None, "without a page"),
    ):
        for name in given.keys() & set(names):
            if not there:
                raise WrongUse(f"{given[name]} has no effect {why}.")
