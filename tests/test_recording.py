# Tests of recording.py
"""Recordings: what is saved is loaded, and what is no recording is refused in one sentence."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nermo_mjx.view import Recording, RecordingError, model_hash, recording_of

BALL = """
<mujoco><worldbody><body name="torso"><freejoint/><geom size="0.1" mass="{mass}"/>{more}</body></worldbody></mujoco>
"""


def ball(mass: float = 1.0, elements: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(BALL.format(mass=mass, more=elements))


def some_recording(**changes: object) -> Recording:
    rng = np.random.default_rng(0)
    values: dict = {
        "time": np.arange(5) * 0.02,
        "qpos": rng.normal(size=(5, 7)),
        "qvel": rng.normal(size=(5, 6)),
        "ctrl": rng.normal(size=(5, 3)),
        "sensors": {"foot_position": rng.normal(size=(5, 4, 3))},
        "model_hash": model_hash(ball()),
        "metadata": {"setup": {"gait": "trot"}, "parameters": {"frequency": 0.8}},
    }
    return Recording(**(values | changes))


def test_a_saved_recording_is_loaded_as_it_was_and_read_by_numpy_alone(tmp_path: Path) -> None:
    recording = some_recording()
    loaded = Recording.load(path := recording.save(tmp_path / "new" / "walk.npz"))
    for name in ("time", "qpos", "qvel", "ctrl"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(recording, name))
    np.testing.assert_array_equal(
        loaded.sensors["foot_position"], recording.sensors["foot_position"]
    )
    assert loaded.metadata == recording.metadata
    assert loaded.model_hash == recording.model_hash
    assert loaded.duration == pytest.approx(0.08)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["walk.npz"], (
        "no temporary file stays behind"
    )
    with np.load(path, allow_pickle=False) as file:
        assert file["qpos"].shape == (5, 7)
        assert json.loads(str(file["header"]))["metadata"]["setup"] == {"gait": "trot"}


def test_a_part_of_a_recording_is_one_too() -> None:
    recording = some_recording()
    part = recording.between(0.02, 0.06)
    np.testing.assert_allclose(part.time, [0.02, 0.04, 0.06])
    np.testing.assert_array_equal(part.qpos, recording.qpos[1:4])
    np.testing.assert_array_equal(
        part.sensors["foot_position"], recording.sensors["foot_position"][1:4]
    )
    assert part.metadata == recording.metadata
    assert recording.between(0.03, 0.03).time.tolist() == [0.04], "at least one sample"
    assert recording.between(1.0, 2.0).time.tolist() == [0.08]


def test_another_layout_is_refused_with_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nermo_mjx.recording.LAYOUT_VERSION", 7)
    path = some_recording().save(tmp_path / "walk.npz")
    monkeypatch.undo()
    with pytest.raises(RecordingError, match="layout 7, but this version reads layout 1"):
        Recording.load(path)


def test_another_file_a_cut_one_and_a_missing_one_are_refused(tmp_path: Path) -> None:
    path = some_recording().save(tmp_path / "walk.npz")
    complete_bytes = path.read_bytes()
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for content in (b"", b"hello", complete_bytes[:-300], (tmp_path / "other.npz").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match="not a recording of nermo_mjx"):
            Recording.load(path)
    with pytest.raises(RecordingError, match="no such file"):
        Recording.load(tmp_path / "missing.npz")


def test_a_failed_save_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = some_recording().save(tmp_path / "walk.npz")
    former_bytes = path.read_bytes()

    def no_space(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", no_space)
    with pytest.raises(RecordingError, match="No space left"):
        some_recording(metadata={"other": 1}).save(path)
    assert path.read_bytes() == former_bytes
    assert [file.name for file in tmp_path.iterdir()] == ["walk.npz"]


def test_arrays_of_different_lengths_are_refused() -> None:
    with pytest.raises(RecordingError, match=r"ctrl has shape \(4, 3\), but there are 5 samples"):
        some_recording(ctrl=np.zeros((4, 3)))


def test_the_hash_knows_structure_and_ignores_what_a_sweep_varies() -> None:
    assert model_hash(ball()) == model_hash(ball(mass=2.0))
    assert model_hash(ball()) == model_hash(
        ball(elements="<camera name='eye'/><light name='sun'/>")
    ), "looks"
    assert model_hash(ball()) != model_hash(
        ball(elements="<body pos='0 0 1'><joint/><geom size='.1'/></body>")
    )
    assert model_hash(ball(elements="<body pos='0 0 1'/>")) != model_hash(
        ball(elements="<body pos='0 0 1.001'/>")
    )


def test_a_recording_of_another_model_is_refused() -> None:
    some_recording().check_model(ball(mass=3.0))
    some_recording(model_hash="").check_model(ball(elements="<body pos='0 0 1'/>"))
    with pytest.raises(RecordingError, match="another version of the robot's model"):
        some_recording().check_model(ball(elements="<body pos='0 0 1'/>"))
    with pytest.raises(RecordingError, match="7 positions, but the model has 8"):
        some_recording().check_model(ball(elements="<body><joint/><geom size='.1'/></body>"))


def test_one_world_of_a_trace_becomes_a_recording() -> None:
    trace = SimpleNamespace(
        time=np.arange(4.0),
        qpos=np.ones((2, 4, 7)),
        qvel=np.ones((2, 4, 6)),
        ctrl=np.ones((2, 4, 0)),
        sensors={"gyro": np.stack([np.zeros((4, 3)), np.ones((4, 3))])},
    )
    recording = recording_of(trace, ball(), world=1, metadata={"engine": "c"})
    assert recording.qpos.shape == (4, 7)
    assert recording.sensors["gyro"].min() == 1.0
    recording.check_model(ball())


def test_a_part_of_a_recording_has_both_ends_and_at_least_one_sample() -> None:
    """Times are sums of steps, whose rounding neither adds nor removes a sample."""
    time = np.cumsum(np.full(30, 0.1))
    recording = Recording(
        time, *(np.arange(30.0)[:, None] for _ in range(3)), sensors={"a": np.arange(30)}
    )
    for begin, end, first, last in (
        (0.3, 0.7, 2, 6),
        (0.0, 0.1, 0, 0),
        (2.9, 9.0, 28, 29),
        (0.31, 0.32, 3, 3),
    ):
        part = recording.between(begin, end)
        assert part.qpos[:, 0].tolist() == list(range(first, last + 1))
        assert part.sensors["a"].tolist() == list(range(first, last + 1))
        np.testing.assert_array_equal(part.time, time[first : last + 1])
