# Tests of cli/output.py
"""Output of commands: escaped characters, full disks, and one message for what cannot be read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from command import call, run_command
from fakes.sweep_fake import FakeSimulator

from nermo_mjx.cli.kinds import KINDS
from nermo_mjx.sweep import run_sweep


def test_control_characters_of_a_stranger_are_escaped(tmp_path: Path) -> None:
    evil = "\x1b]0;owned\x07\x1b[2J\x9b2J\u202egnp.exe\r\nfigures  rm -rf ~"
    stamp = dict.fromkeys(
        ("package", "sources", "model", "engine", "mujoco", "mujoco_mjx", "jax"), evil
    )
    session = {
        "started": evil,
        "command": f"nermo-mjx {evil}",
        "machine": {"host": evil},
        "versions": {"jax": evil},
    }
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
def test_what_does_not_fit_ends_in_a_sentence(
    error: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    (tmp_path / "s.yaml").write_text(
        "vary: {frequency: [0.6, 0.8]}\nrun: {duration: 0.1}\nplots: false\n"
    )
    run_sweep(tmp_path / "s.yaml", tmp_path / "out", simulator=FakeSimulator(engine="c"))
    (tmp_path / "out" / "summary.json").unlink()
    with open("/dev/full", "w") as full:
        done = run_command(
            ["sweep", str(tmp_path / "s.yaml"), "--out", str(tmp_path / "out")], **{stream: full}
        )
        assert done.returncode == code
        assert (tmp_path / "out" / "summary.json").exists()
        assert (
            stream == "stderr"
            or "done, but standard output cannot be written: No space left" in done.stderr
        )
        assert run_command(["--help"], **{stream: full}).returncode == code
        assert run_command(["nonsense"], **{stream: full}).returncode == 2
