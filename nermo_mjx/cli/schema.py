"""`nermo-mjx schema`: JSON Schemas with which an editor completes and checks spec files."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Final

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.output import stdout_reserved

EPILOG = """\b
Examples:
  nermo-mjx schema sweep
  nermo-mjx schema tune --out tune.schema.json

With "# yaml-language-server: $schema=tune.schema.json" as its first line, a
file next to it is completed and checked as you type.
"""
#: Where the fields of each command's file are declared.
FILES: Final = {
    "sweep": "sweep.file:SweepFile",
    "search": "search.spec:SearchFile",
    "tune": "tune.spec:TuningFile",
    "landscape": "tune.spec:TuningFile",
    "train": "learn.spec:TrainingFile",
    "servos": "hardware.channels:ChannelsFile",
}


@click.command("schema", epilog=EPILOG)
@click.argument("kind", type=click.Choice(list(FILES)))
@options.file("--out", ".json", "File for the schema, instead of standard output.")
def command(kind: str, out: Path | None) -> None:
    """Print the JSON Schema of the file that a command reads.

    An editor that supports it completes fields, names and parameters, with
    units, defaults and ranges, and marks errors. KIND is the command; servos
    reads a file of channels.
    """
    with stdout_reserved():
        from nermo_mjx.specs.fields import schema_of

        module, _, name = FILES[kind].partition(":")
        model = getattr(importlib.import_module(f"nermo_mjx.{module}"), name)
        text = json.dumps(schema_of(model), indent=2) + "\n"
    if out is None:
        click.echo(text, nl=False)
        return
    from nermo_mjx.runs.files import replace_file

    out.parent.mkdir(parents=True, exist_ok=True)
    replace_file(out, text.encode())
