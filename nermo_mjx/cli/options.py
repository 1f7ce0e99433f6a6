"""Options that commands share, and short ways to declare them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from nermo_mjx.cli.choices import ENGINES, PHYSICS

F = TypeVar("F", bound=Callable[..., Any])
POSITIVE = click.FloatRange(0, min_open=True)


def choice(name: str, names: tuple[str, ...], about: str | None = None, **more: Any) -> Callable[[F], F]:
    """An option that allows some names; the first is the default unless `default` is given."""
    settings: dict[str, Any] = {"default": names[0], "show_default": True} | more
    return click.option(name, type=click.Choice(names), help=about, **settings)


def number(name: str, about: str, kind: Any = float, **more: Any) -> Callable[[F], F]:
    """An option that takes a number."""
    whole = isinstance(kind, click.IntRange)
    settings: dict[str, Any] = {"metavar": "N" if whole else "X", "show_default": "default" in more} | more
    return click.option(name, type=kind, help=about, **settings)


def file(name: str, suffix: str, about: str, **more: Any) -> Callable[[F], F]:
    """An option that names a file to write."""
    kind: Any = click.Path(dir_okay=False, path_type=Path)
    return click.option(name, metavar=f"FILE{suffix}", type=kind, help=about, **more)


def engine(function: F) -> F:
    """`--engine`."""
    about = "c: MuJoCo C on all cores. mjx: JAX. warp: NVIDIA. auto: warp or mjx on a GPU, else c."
    return choice("--engine", ENGINES, about)(function)


def physics(function: F) -> F:
    """`--physics`."""
    return choice("--physics", PHYSICS, "fast: 1.6 to 2 times the speed, gaits within 2 %.")(function)


def scene(function: F) -> F:
    """`--scene`."""
    return click.option("--scene", default="flat", metavar="NAME", show_default=True, help="A file of mjcf/scenes.")(
        function
    )


def report(function: F) -> F:
    """`--json` and `--quiet`."""
    quiet = click.option("--quiet", "-q", is_flag=True, help="No progress, no summary; errors only.")
    as_json = click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output, nothing else.")
    return as_json(quiet(function))
