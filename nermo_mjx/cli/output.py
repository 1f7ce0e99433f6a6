"""What commands print: one JSON object, or tables for people."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from nermo_mjx.plotting.files import Figures

Found = TypeVar("Found")


def print_json(value: Any) -> None:
    """Write one JSON object to standard output."""
    from nermo_mjx.runs.text import plain

    sys.stdout.write(json.dumps(plain(value), indent=2, allow_nan=False, ensure_ascii=False) + "\n")
    sys.stdout.flush()


@contextlib.contextmanager
def stdout_reserved() -> Iterator[None]:
    """While a command runs, redirect anything that libraries print to standard error."""
    with contextlib.redirect_stdout(sys.stderr):
        yield


def sayer(command: str, quiet: bool) -> Callable[[str], None] | None:
    """A function that prints a sentence about a command's work on standard error; None with --quiet."""
    return None if quiet else lambda sentence: click.echo(f"{command}: {sentence}", err=True)


def tell_report(
    command: str, kind: str, found: Found, figures: Callable[[Any], Figures], out: Path | None,
    tell: Callable[[Found], None], *, as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    """Write the table of what was found, and its figures, where `out` is given, and print it: as JSON or by `tell`."""
    report: Any = found
    files, moved = list[Path](), ""
    if out is not None:
        from nermo_mjx.sweep.reports import write_report

        with stdout_reserved():
            files, moved = write_report(out, kind, report.table, report.about(), figures(report.table))
    say = sayer(command, quiet)
    if say is not None and moved:
        say(moved)
    if as_json:
        print_json({**report.about(), "files": files})
    elif not quiet:
        tell(found)
        for file in files:
            click.echo(f"wrote {file}")


def print_table(title: str, columns: list[tuple[str, str]], rows: list[list[str]]) -> None:
    """A table for people; columns are (heading, "left" or "right"). Without a terminal, lines are never wrapped."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, show_header=any(heading for heading, _ in columns))
    for heading, side in columns:
        table.add_column(Text(heading), justify="right" if side == "right" else "left")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    console = Console(file=sys.stdout, width=None if sys.stdout.isatty() else 200, highlight=False)
    with console.capture() as capture:
        console.print(Text(title, style="bold"))
        console.print(table)
    lines = (line.rstrip() for line in capture.get().splitlines())
    sys.stdout.write("\n".join(lines) + "\n\n")
