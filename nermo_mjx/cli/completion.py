"""`nermo-mjx completion`: shell completion."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

EPILOG = """\b
Examples:
  nermo-mjx completion bash
  nermo-mjx completion fish

Append what it prints to ~/.bashrc or ~/.zshrc, or write it to
~/.config/fish/completions/nermo-mjx.fish.
"""
SHELLS = ("bash", "zsh", "fish")
_PROGRAM, _VARIABLE = "nermo-mjx", "_NERMO_MJX_COMPLETE"


@click.command("completion", epilog=EPILOG)
@click.argument("shell", type=click.Choice(SHELLS))
@click.pass_context
def command(context: click.Context, shell: str) -> None:
    """Print a script with which a shell completes commands, options, names and files."""
    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(context.find_root().command, {}, _PROGRAM, _VARIABLE).source())
