# Tests of cli/output.py
"""Commands whose output cannot be written."""

from __future__ import annotations

import errno
import io

import pytest

from nermo_mjx.cli import main


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
        message = (
            "done, but standard output cannot be written: No space left on device"
            in errors.getvalue()
        )
        assert message == (name == "lost")
    assert codes == {"lost": 1, "told": 0, "wrong": 2}
