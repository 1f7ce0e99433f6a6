"""`nermo-mjx status`: what a directory contains, its progress, what made it, and how to resume."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.kinds import kind_of_directory
from nermo_mjx.cli.output import print_json, stdout_reserved

if TYPE_CHECKING:
    from nermo_mjx.runs import CodeStamp
    from nermo_mjx.runs.status import Status

EPILOG = """\b
Examples:
  nermo-mjx status runs/quickstart
  nermo-mjx status runs/published --json
"""
#: Number of sessions to show, the latest.
_SHOWN = 3


@click.command("status", epilog=EPILOG)
@click.argument("path", metavar="DIR", type=click.Path(path_type=Path))
@options.report
def command(path: Path, as_json: bool, quiet: bool) -> None:
    """Show what DIR contains, its progress, what made it, and how to resume.

    DIR is the directory of a sweep, a search, a tuning, a training, a
    landscape, experiments, an identification or benchmarks, of this release or
    an earlier one, finished or in progress. It is only read.
    """
    kind = kind_of_directory(path)
    with stdout_reserved():
        from nermo_mjx.runs import codes_of
        from nermo_mjx.runs.directory import read_record

        status: Status = kind.load(kind.status)(path)
        codes, sessions = codes_of(path), read_record(path).get("sessions") or status.sessions
    if as_json:
        print_json({"kind": kind.name, "rows": status.rows, "rows_done": status.rows_done,
                    "code": [*codes] or status.code, "engine": status.engine, "complete": status.complete})  # fmt: skip
    elif not quiet:
        click.echo(f"{path}: {kind.called}, {_amount(status)}")
        for name, text in (*_made(status, codes), *_worked(sessions), *(("note", note) for note in status.notes)):
            click.echo(f"{name:<8} {text}")
        click.echo(f"{'figures' if status.complete and ' plot ' in status.command else 'resume':<8} {status.command}"
                   if status.command else "resume   with the command that started it, not recorded here")  # fmt: skip


def _amount(status: Status) -> str:
    known = status.rows is not None and not status.complete
    of_all = f" of {status.rows:,}" if known else ""
    return f"{status.rows_done:,}{of_all} {status.unit}, {'complete' if status.complete else 'not complete'}"


def _made(status: Status, codes: Mapping[str, CodeStamp]) -> Iterator[tuple[str, str]]:
    yield "engine", status.engine or "not known"
    yield from (("code", f"{name}: {stamp}") for name, stamp in codes.items())
    if not codes:
        yield "code", ", ".join(status.code) or "not known"


def _worked(sessions: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """The newest sessions: when, with what, where, by which command."""
    if len(sessions) > _SHOWN:
        yield "session", f"and {len(sessions) - _SHOWN} earlier"
    for each in sessions[-_SHOWN:]:
        versions, machine = each.get("versions", {}), each.get("machine", {})
        named = ", ".join(f"{name} {versions[name]}" for name in ("nermo-mjx", "mujoco", "jax") if name in versions)
        where = ", ".join(str(machine[name]) for name in ("host", "processor") if name in machine)
        cores = f", {machine['cores']} cores" if "cores" in machine else ""
        yield "session", f"{str(each.get('started', 'some time'))[:16]}, {named}, on {where}{cores}"
        if each.get("command"):
            yield "", str(each["command"])
