# Tests of view/playing.py
"""Recordings in MuJoCo's own viewer, and as MJCF: as far as a machine without a display can tell."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nermo_mjx import Recording, load_robot
from nermo_mjx.robot import ParameterError
from nermo_mjx.view import RecordingError, play, robot_of, write_keyframes
from nermo_mjx.view.playing import set_sample


@pytest.fixture(scope="module")
def recording(walks) -> Recording:
    """Half a second of a walk."""
    return walks("c").recording(5).between(0.0, 0.51)


@pytest.mark.release
@pytest.mark.parametrize("sample", [0, 17, 49])
def test_mujocos_forward_gives_the_recorded_readings(recording: Recording, sample: int) -> None:
    """A sensor was read a physics step before the positions, so that its way in that step lies between them."""
    robot = robot_of(recording)
    data = mujoco.MjData(robot.model)
    set_sample(data, recording, sample)
    mujoco.mj_forward(robot.model, data)
    now = robot.sensors(np.array(data.sensordata))
    step = robot.model.opt.timestep
    for name, rate in (
        ("position", "linear_velocity"),
        ("servo_angle", "servo_velocity"),
        ("foot_position", "foot_velocity"),
    ):
        integrated = np.asarray(getattr(now, name)) - step * np.asarray(getattr(now, rate))
        span = step * np.abs(recording.sensors[rate][sample]).max() + 1e-6
        np.testing.assert_allclose(integrated, recording.sensors[name][sample], atol=0.25 * span)
    assert data.time == recording.time[sample]


@pytest.mark.release
def test_a_file_of_keyframes_needs_mujoco_alone(recording: Recording, tmp_path: Path) -> None:
    """In a folder of its own and without this package, MuJoCo steps through the recording."""
    count = write_keyframes(recording, tmp_path / "walk.xml", rate=20.0)
    script = (
        "import sys, mujoco, numpy as np\n"
        "m = mujoco.MjModel.from_xml_path('walk.xml'); d = mujoco.MjData(m)\n"
        "out = []\n"
        "for k in range(m.nkey):\n"
        "    mujoco.mj_resetDataKeyframe(m, d, k); mujoco.mj_forward(m, d)\n"
        "    out.append([d.time, *d.qpos, *d.qvel, *d.ctrl])\n"
        "mujoco.mj_step(m, d)\n"
        "assert 'nermo_mjx' not in sys.modules and 'jax' not in sys.modules\n"
        "np.save('keys.npy', out)\n"
    )
    subprocess.run([sys.executable, "-I", "-c", script], cwd=tmp_path, check=True)
    keys = np.load(tmp_path / "keys.npy")
    assert len(keys) == count == 11
    samples = np.abs(recording.time - keys[:, :1]).argmin(axis=1)
    np.testing.assert_allclose(np.diff(keys[:, 0]), 0.05, atol=1e-9)
    expected = np.concatenate(
        [recording.time[:, None], recording.qpos, recording.qvel, recording.ctrl], axis=1
    )
    np.testing.assert_allclose(keys, expected[samples], atol=2e-5)


class Window:
    """A viewer that is closed after some frames, and notes what it shows."""

    def __init__(self, frames: int) -> None:
        self.frames, self.shown, self.closed = frames, list[float](), False
        self.cam, self.sun = mujoco.MjvCamera(), list[np.ndarray]()

    def launch_passive(self, model: mujoco.MjModel, data: mujoco.MjData, **_: bool) -> Window:
        self.model, self.data = model, data
        return self

    def __enter__(self) -> Window:
        return self

    def __exit__(self, *_: object) -> None:
        self.closed = True

    def is_running(self) -> bool:
        return len(self.shown) < self.frames

    def lock(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def sync(self) -> None:
        self.shown.append(self.data.time)
        self.sun.append(self.data.light_xpos[0] - self.data.body("torso").xpos)


def test_a_recording_plays_in_real_time_or_faster_and_again(recording: Recording) -> None:
    """Time follows the clock, times the speed, and restarts at the end; finally the window is closed."""
    window = Window(60)
    play(recording, speed=2.0, viewer=window)
    times_of_samples = np.array(window.shown)
    assert window.closed
    assert times_of_samples.min() == pytest.approx(recording.time[0], abs=0.1)
    assert times_of_samples.max() > 0.8 * recording.time[-1]
    assert (np.diff(times_of_samples) < 0).any(), "it begins again"
    assert (window.cam.type, window.cam.trackbodyid) == (
        mujoco.mjtCamera.mjCAMERA_TRACKING,
        window.model.body("torso").id,
    )
    assert window.model.light_castshadow[0]
    np.testing.assert_allclose(
        np.array(window.sun)[:, :2], 0.0, atol=1e-9, err_msg="the sun stands above the robot"
    )


def test_what_cannot_be_played_is_said(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ParameterError, match="speed is 0"):
        play(recording, speed=0.0)
    with pytest.raises(ParameterError, match="keyframes, of 5,000"):
        write_keyframes(recording, tmp_path / "a.xml", rate=1e5)
    with pytest.raises(ParameterError, match="rate is -1"):
        write_keyframes(recording, tmp_path / "a.xml", rate=-1.0)
    with pytest.raises(RecordingError, match="cannot be written"):
        write_keyframes(recording, tmp_path / "missing" / "a.xml")
    if (
        "DISPLAY" not in os.environ
        and "WAYLAND_DISPLAY" not in os.environ
        and sys.platform == "linux"
    ):
        with pytest.raises(RecordingError, match="needs a display"):
            play(recording)


@pytest.mark.release
def test_the_robots_mjcf_by_itself_has_the_same_physics(tmp_path: Path) -> None:
    """`model --xml`, copied to an empty folder: MuJoCo without this package steps it to the same state."""
    file = tmp_path / "robot.xml"
    command = [
        sys.executable,
        "-m",
        "nermo_mjx",
        "model",
        "--tail",
        "articulated",
        "--xml",
        str(file),
        "--quiet",
    ]
    subprocess.run(command, check=True)
    script = (
        "import sys, mujoco, numpy as np\n"
        "m = mujoco.MjModel.from_xml_path('robot.xml'); d = mujoco.MjData(m)\n"
        "d.ctrl[:] = 0.1\n"
        "for _ in range(30): mujoco.mj_step(m, d)\n"
        "assert 'nermo_mjx' not in sys.modules\n"
        "np.savez('state.npz', qpos=d.qpos, mass=m.body_mass, friction=m.pair_friction)\n"
    )
    subprocess.run([sys.executable, "-I", "-c", script], cwd=tmp_path, check=True)
    model = load_robot(tail="articulated").model
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.1
    for _ in range(30):
        mujoco.mj_step(model, data)
    with np.load(tmp_path / "state.npz") as state:
        np.testing.assert_allclose(state["mass"], model.body_mass, rtol=1e-5)
        np.testing.assert_allclose(state["friction"], model.pair_friction, rtol=1e-5)
        # XML holds six digits of each number, which a moment of contact makes a little more of.
        np.testing.assert_allclose(state["qpos"], data.qpos, atol=5e-4)
        assert np.abs(data.qpos - model.qpos0).max() > 0.05
