"""A command as users type it, run in this process; errors that are not for users are raised."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from nermo_mjx.cli import main


def call(*arguments: str | Path) -> Result:
    """What the command printed, and its exit code."""
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def json_of(*arguments: str | Path) -> dict[str, Any]:
    """The object that the command prints with `--json`: exactly one, without NaN, which is not JSON."""
    result = call(*arguments, "--json")
    assert result.exit_code == 0, result.stderr

    def no_constant(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    value = json.loads(result.stdout, parse_constant=no_constant)
    assert isinstance(value, dict)
    return value
