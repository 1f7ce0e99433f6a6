# Tests of live/driving.py
"""Files of drives: a replay runs no code of a file, and rejects a malformed file with one message."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from command import call

from nermo_mjx.control import protocol
from nermo_mjx.control.schedule import Switch
from nermo_mjx.live.driving import Driving
from nermo_mjx.recording import Recording
from nermo_mjx.rollout import Setup


@pytest.fixture(scope="module")
def driven() -> Recording:
    """A drive with a command and a push."""
    driving = Driving(Setup(pilot="open_loop"))
    driving.command(Switch(0.0, values={"stride": 0.9}))
    driving.push(1, (0.5, 0.0, 0.0), 0.1)
    for _ in range(5):
        driving.tick()
    return driving.recording()


def told(recording: Recording, driven: Any = None, **setup: Any) -> Recording:
    """The same with another setup, or another course."""
    metadata = dict(recording.metadata)
    metadata["setup"] = {**metadata["setup"], **setup}
    metadata["driven"] = {**metadata["driven"], **(driven or {})}
    return dataclasses.replace(recording, metadata=metadata)


@pytest.mark.release
@pytest.mark.parametrize(
    "reference", ["own.py:stiff", "{0}/own.py:stiff", "own:stiff", "own.under:stiff"]
)
@pytest.mark.parametrize("form", ["npz", "jsonl"])
def test_replay_runs_no_code_that_a_drive_names(
    reference: str, form: str, driven: Any, tmp_path: Path, canary: Path
):
    """Not even where its setup is refused afterwards; nor do its metrics run, or another file of the same name."""
    theirs = told(
        driven, controller=reference.format(tmp_path), pilot="straight", metrics=["own.py"]
    )
    path = tmp_path / f"drive.{form}"
    if form == "npz":
        theirs.save(path)
    else:
        path.write_text(json.dumps(theirs.metadata) + "\n" + json.dumps({"ticks": 5}) + "\n")
    for words in (("replay", path), ("replay", path, "--sweep", tmp_path / "a.yaml")):
        result = call(*words)
        assert (result.exit_code, result.stderr.count("\n")) == (2, 1), result.stderr
        assert (
            "code that a file names, which is not run: give your own copy of it, --controller"
            in result.stderr
        )
    if form == "npz":
        call("servos", "--recording", path, "--out", tmp_path / "a.csv")
    assert not canary.exists()


@pytest.mark.release
def test_a_drive_by_a_controller_of_ones_own_is_made_again_with_it(
    tmp_path: Path, canary: Path
) -> None:
    driving = Driving(Setup(controller="own.py:stiff"))
    for _ in range(3):
        driving.tick()
    path = driving.recording().save(tmp_path / "drive.npz")
    canary.unlink()
    protocol._imported.cache_clear()
    assert call("replay", path).exit_code == 2
    assert not canary.exists()
    result = call("replay", path, "--controller", "own.py:stiff")
    assert "All 3 samples equal" in result.stdout, result.stderr
    (tmp_path / "own.py").write_text((tmp_path / "own.py").read_text() + "\n")
    assert (
        "another one than that of the drive"
        in call("replay", path, "--controller", "own.py:stiff").stderr
    )


MALFORMED: dict[str, dict[str, Any]] = {
    "unknown key": {"wings": 2},
    "waypoints 3": {"waypoints": 3},
    "waypoints [1, 2]": {"waypoints": [1, 2]},
    "gait": {"gait": ["trot"]},
    "scene": {"scene": 3},
    "spine": {"spine": 1},
    "tail": {"tail": ["rigid"]},
    "timestep": {"timestep": "fast"},
    "command": {"driven": {"commands": [[float("inf"), {"at": 0.0, "set": {"stride": 0.9}}]]}},
    "a tick below 0": {"driven": {"commands": [[-1, {"at": 0.0, "set": {"stride": 0.9}}]]}},
    "no pair": {"driven": {"commands": [3]}},
    "frequency": {"driven": {"commands": [[0, {"at": 0.0, "set": {"frequency": 1e-20}}]]}},
    "frequency at the start": {"driven": {"values": {"frequency": 1e-300}}},
    "unknown start": {"driven": {"values": {"froquency": 1.0}}},
    "start NaN": {"driven": {"values": {"frequency": float("nan")}}},
    "push without a body": {"driven": {"pushes": [{"tick": 0, "ticks": 3, "force": [1, 0, 0]}]}},
    "push of nobody": {
        "driven": {"pushes": [{"tick": 0, "ticks": 3, "body": 10**30, "force": [1, 0, 0]}]}
    },
    "push NaN": {
        "driven": {"pushes": [{"tick": 0, "ticks": 3, "body": 1, "force": [float("nan"), 0, 0]}]}
    },
    "push too long": {
        "driven": {"pushes": [{"tick": 0, "ticks": 10**15, "body": 1, "force": [1, 0, 0]}]}
    },
    "samples of another": {"driven": {"samples": [[[0.0], [0.0], [0.0], [None]]]}},
}


@pytest.mark.release
@pytest.mark.usefixtures("shared_simulators")
@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_drive_ends_in_a_sentence(name: str, driven: Recording, tmp_path: Path) -> None:
    path = told(driven, **MALFORMED[name]).save(tmp_path / "drive.npz")
    result = call("replay", path, "--quiet")
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1), result.stderr
    assert result.stderr.startswith(f"nermo-mjx: {path}: ")
