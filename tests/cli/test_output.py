"""Tests of nermo_mjx.cli.output and nermo_mjx.cli.options: lost output, and assignments of parameters."""

from __future__ import annotations

import errno
import io

import pytest

from nermo_mjx import all_parameters
from nermo_mjx.cli import main
from nermo_mjx.cli.options import assigned
from nermo_mjx.cli.output import WrongUse


class FullDisk(io.StringIO):
    """A stream that takes nothing."""

    def write(self, text: str) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_command_whose_output_is_lost_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sentence names the reason; a command whose output arrives, or that is used wrongly, keeps its exit code."""
    codes = {}
    for name, stream, words in (
        ("lost", FullDisk(), ["--version"]),
        ("told", io.StringIO(), ["--version"]),
        ("wrong", FullDisk(), ["nonsense"]),
    ):
        errors = io.StringIO()
        monkeypatch.setattr("sys.stdout", stream)
        monkeypatch.setattr("sys.stderr", errors)
        with pytest.raises(SystemExit) as ended:
            main(words)
        codes[name] = ended.value.code
        said = "done, but standard output cannot be written: No space left on device" in errors.getvalue()
        assert said == (name == "lost")
    assert codes == {"lost": 1, "told": 0, "wrong": 2}


def test_the_last_assignment_of_a_parameter_wins() -> None:
    parameters = all_parameters()
    assert assigned(["frequency=0.5", "frequency = 0.8"], parameters) == {"frequency": 0.8}
    found = assigned(["stiffness.*=0.5", "stiffness.spine=1.5", "spine.phase=90 deg"], parameters)
    assert (found["stiffness.spine"], found["stiffness.ankle"]) == (1.5, 0.5)
    assert found["spine.phase"] == pytest.approx(1.5707963)
    with pytest.raises(WrongUse, match="--set frequency: expected NAME=VALUE"):
        assigned(["frequency"], parameters)
