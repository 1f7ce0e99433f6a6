# Tests of cli/output.py
"""Output of commands: escaped characters, full disks, and one message for what cannot be read."""

from __future__ import annotations

import errno
import io
import json
from pathlib import Path
from typing import Any

import pytest
from command import call, run_command
from fakes.sweep_fake import FakeSimulator

from nermo_mjx import all_parameters
from nermo_mjx.cli import main
from nermo_mjx.cli.kinds import KINDS
from nermo_mjx.cli.options import assigned
from nermo_mjx.cli.output import WrongUse
from nermo_mjx.sweep import run_sweep


def test_control_characters_of_a_stranger_are_escaped(tmp_path: Path) -> None:
    evil = "\x1b]0;owned\x07\x1b[2J\x9b2J\u202egnp.exe\r\nfigures  rm -rf ~"
    stamp = dict.fromkeys(("package", "sources", "model", "engine", "mujoco", "mujoco_mjx", "jax"), evil)
    session = {"started": evil, "command": f"nermo-mjx {evil}", "machine": {"host": evil}, "versions": {"jax": evil}}
    record = {"kind": "sweep", "codes": {evil: stamp}, "sessions": [session]}
    for kind in KINDS:
        (tmp_path / "run.json").write_text(json.dumps(record | {"kind": kind}))
        for words in (("status",), ("status", "--json"), ("plot",), ("view", "--no-open")):
            result = call(words[0], tmp_path, *words[1:])
            for character in "\x1b\x07\x9b\u202e\r":
                assert character not in result.stdout + result.stderr, words
            assert not any(line.startswith("figures  rm") for line in result.stdout.splitlines())
            if "--json" in words:
                json.loads(result.stdout)
    (tmp_path / "run.json").write_text(json.dumps({"kind": evil}))
    assert "\\u001b[2J" in call("status", tmp_path).stderr


@pytest.mark.parametrize("error", [MemoryError, RecursionError])
def test_what_does_not_fit_ends_in_a_sentence(error: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: Any) -> None:
        raise error

    monkeypatch.setattr("nermo_mjx.runs.directory.read_record", failing)
    result = call("status", tmp_path)
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1


@pytest.mark.release
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize(("stream", "code"), [("stdout", 1), ("stderr", 0)])
def test_a_full_disk_under_the_log_stops_nothing(tmp_path: Path, stream: str, code: int) -> None:
    """What is left to do is the summary, so that the process simulates nothing."""
    (tmp_path / "s.yaml").write_text("vary: {frequency: [0.6, 0.8]}\nrun: {duration: 0.1}\nplots: false\n")
    run_sweep(tmp_path / "s.yaml", tmp_path / "out", simulator=FakeSimulator(engine="c"))
    (tmp_path / "out" / "summary.json").unlink()
    with open("/dev/full", "w") as full:
        done = run_command(["sweep", str(tmp_path / "s.yaml"), "--out", str(tmp_path / "out")], **{stream: full})
        assert done.returncode == code
        assert (tmp_path / "out" / "summary.json").exists()
        assert stream == "stderr" or "done, but standard output cannot be written: No space left" in done.stderr
        assert run_command(["--help"], **{stream: full}).returncode == code
        assert run_command(["nonsense"], **{stream: full}).returncode == 2


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
