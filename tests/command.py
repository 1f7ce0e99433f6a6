"""Calls as users make them: commands, in this process or another one, and calls that are refused with one message."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from nermo_mjx.cli import main
from nermo_mjx.robot.quantity import ParameterError


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


def run_command(words: list[str], **options: Any) -> Any:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.run(
        [sys.executable, "-m", "nermo_mjx", *words], text=True, check=False, **pipes | options
    )


def refused(act: Any, message: str, *arguments: Any) -> None:
    with pytest.raises(ParameterError) as error:
        act(*arguments)
    message_of_error = str(error.value)
    assert re.search(message, message_of_error), message_of_error
    assert "\n" not in message_of_error
