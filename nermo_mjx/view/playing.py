"""Recordings in MuJoCo's own viewer: played there, or exported as MJCF with the recording as keyframes."""

from __future__ import annotations

import copy
import importlib
import os
import time
import warnings
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot import ParameterError
from nermo_mjx.view.camera import (
    body_radius,
    following_camera,
    move_sun_above,
    put_sun_overhead,
    root_body,
)
from nermo_mjx.view.recorded import recorded_spec, robot_of

#: Frame rate of the viewer [Hz].
_REFRESH_HZ: Final = 60.0
#: Keyframes of one file; MuJoCo's viewer has a slider over them.
MAX_KEYS: Final = 5000


def set_sample(data: mujoco.MjData, recording: Recording, sample: int) -> None:
    """Put a sample's time, positions, velocities and commands into MuJoCo's data, for `mj_forward`."""
    data.time = float(recording.time[sample])
    data.qpos[:], data.qvel[:], data.ctrl[:] = (
        recording.qpos[sample],
        recording.qvel[sample],
        recording.ctrl[sample],
    )


def play(recording: Recording, *, speed: float = 1.0, viewer: Any = None) -> None:
    """Play a recording in MuJoCo's viewer, over and over until its window is closed; Tab and Shift-Tab show panels.

    On macOS, run Python as `mjpython`.

    Args:
        recording: to play.
        speed: 1 is real time, 0.25 a quarter of it.
        viewer: replaces `mujoco.viewer`.

    Raises:
        ParameterError: speed is not allowed.
        RecordingError: the recording does not fit the robot, or no window can be opened.
    """
    if not speed > 0.0:
        raise ParameterError(f"speed is {speed:g}: allowed is (0, inf).")
    model = robot_of(recording).model
    recording.check_model(model)
    model = copy.copy(model)
    put_sun_overhead(model)
    data = mujoco.MjData(model)
    set_sample(data, recording, 0)
    mujoco.mj_forward(model, data)
    if viewer is None:  # without a display, opening `mujoco.viewer` would terminate the process
        import glfw

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if not glfw.init():
                raise RecordingError(
                    "MuJoCo's viewer needs a display, and there is none: write the recording with --xml FILE.xml "
                    "(write_keyframes), and open it where there is one."
                )
    viewer = viewer or importlib.import_module("mujoco.viewer")
    try:
        window = viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    except (RuntimeError, mujoco.FatalError) as error:
        raise RecordingError(f"MuJoCo's viewer cannot open a window here ({error}).") from None
    with window:
        # The camera follows the robot in a three-quarter view; the mouse rotates it as usual.
        root, camera = root_body(model), window.cam
        _, radius = body_radius(model, data, root)
        view = following_camera("three_quarter", radius, float(model.vis.global_.fovy), aspect=1.5)
        camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, root
        camera.distance = view.distance
        camera.azimuth = view.azimuth
        camera.elevation = view.elevation
        began, first = time.perf_counter(), float(recording.time[0])
        while window.is_running():
            passed = speed * (time.perf_counter() - began)
            if passed > recording.duration:
                began, passed = time.perf_counter(), 0.0
            sample = int(np.searchsorted(recording.time, first + passed + 1e-9, side="right")) - 1
            with window.lock():
                set_sample(data, recording, max(sample, 0))
                mujoco.mj_forward(model, data)
                move_sun_above(model, data, data.xpos[root])
            window.sync()
            time.sleep(1.0 / _REFRESH_HZ)


def write_keyframes(
    recording: Recording, path: str | os.PathLike[str], *, rate: float = 25.0
) -> int:
    """Write the robot as one MJCF file whose keyframes are samples of the recording, and return their number.

    Any MuJoCo of version 3 opens it, without this package: `python -m mujoco.viewer --mjcf=FILE.xml`, then the slider
    "Key" and "Load key".

    Args:
        recording: to write.
        path: the file.
        rate: keyframes per second [Hz]; the nearest samples are taken.

    Raises:
        ParameterError: the rate is not allowed, or gives too many keyframes.
        RecordingError: the recording does not fit the robot, or the file cannot be written.
    """
    if not rate > 0.0:
        raise ParameterError(f"rate is {rate:g} Hz: allowed is (0, inf).")
    robot = robot_of(recording)
    count = int(recording.duration * rate + 1e-6) + 1
    if count > MAX_KEYS:
        raise ParameterError(
            f"rate is {rate:g} Hz: that would be {count:,} keyframes, of {MAX_KEYS:,}."
        )
    times = recording.time[0] + np.arange(count) / rate
    samples = np.unique(np.abs(recording.time - times[:, None]).argmin(axis=1))
    spec = recorded_spec(recording, robot)
    for sample in samples:
        key = spec.add_key(
            name=f"t{recording.time[sample]:.3f}", time=float(recording.time[sample])
        )
        key.qpos = recording.qpos[sample]
        key.qvel = recording.qvel[sample]
        key.ctrl = recording.ctrl[sample]
    spec.compile()
    try:
        Path(path).write_text(spec.to_xml(), encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{path}: the MJCF cannot be written ({error.strerror}).") from None
    return len(samples)
