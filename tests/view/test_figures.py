# Tests of view/figures.py
"""Figures of a recording: each shows the recording's own numbers, in shown units, over the part that it says."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.image import imread

from nermo_mjx.kinematics.leg import forward_kinematics, four_legs
from nermo_mjx.plotting.files import FORMATS, write_figures
from nermo_mjx.plotting.style import STYLE
from nermo_mjx.robot import LIMBS, load_robot
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.view import Recording, model_hash
from nermo_mjx.view.figures import (
    RecordedGait,
    commanded_feet,
    figures_of_recording,
    gait_diagram,
    ground_path,
    in_leg_frame,
    leg_paths,
    orientation,
    over_ground,
    servo_angles_figure,
)
from nermo_mjx.view.recorded import spans

#: The published robot.
ROBOT = Geometry()


def drawn_of(
    recording: Recording, folder: Path, formats: Sequence[str] = FORMATS
) -> tuple[list[Path], list[str]]:
    """The files of a recording's figures, and the notes on those that there are not."""
    notes: list[str] = []
    return write_figures(
        figures_of_recording(recording, notes.append), folder, formats=formats
    ), notes


NAMES = (
    "gait-diagram",
    "orientation",
    "foot-paths",
    "foot-paths-over-ground",
    "servo-angles",
    "ground-path",
)
#: A lateral walk of a cycle a second.
OFFSETS = dict(zip(LIMBS, (0.63, 0.14, 0.0, 0.54), strict=True))
VALUES = {"frequency": 1.0, "duty": 0.68, "tracking.clock_ratio": 1.0, "start.phase": 0.25}
VALUES |= {f"offset.{limb}": offset for limb, offset in OFFSETS.items()}


@pytest.fixture(autouse=True)
def _style():
    with matplotlib.rc_context(STYLE):
        yield


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Six seconds that rolls by 5 degrees once a second and walks ahead with 0.1 m/s; feet touch late by 0.05 s."""
    model = load_robot().model
    time = 0.01 * np.arange(1, 601)
    half = 0.5 * np.radians(5.0) * np.sin(2 * np.pi * time)
    zero = np.zeros_like(time)
    phase = (VALUES["start.phase"] + time - 0.05)[:, None]
    force = np.where((phase - np.array(list(OFFSETS.values()))) % 1.0 < 0.68, 0.7, 0.0)
    position = np.stack([zero, -0.1 * time, zero + 0.08], axis=-1)
    feet = position[:, None] + np.array(
        [[0.04, -0.06, -0.08], [-0.04, -0.06, -0.08], [0.04, 0.06, -0.08], [-0.04, 0.06, -0.08]]
    )
    ctrl = np.zeros((600, model.nu))
    ctrl[:, :8] = 0.3 + 0.2 * np.sin(2 * np.pi * time)[:, None]
    sensors = {
        "orientation": np.stack([np.cos(half), zero, np.sin(half), zero], axis=-1),
        "position": position,
        "foot_force": force,
        "foot_position": feet,
        "servo_angle": 0.9 * ctrl,
    }
    qpos = np.tile(model.qpos0, (600, 1))
    metadata = {"setup": {"gait": "lateral_walk"}, "parameters": VALUES}
    return Recording(
        time, qpos, np.zeros((600, model.nv)), ctrl, sensors, model_hash(model), metadata
    )


def texts(figure: matplotlib.figure.Figure) -> str:
    return " ".join(text.get_text() for text in figure.findobj(matplotlib.text.Text))


@pytest.mark.release
def test_all_figures_are_written_with_units_and_are_no_blanks(
    recording: Recording, tmp_path: Path
) -> None:
    files, notes = drawn_of(recording, tmp_path)
    assert notes == []
    assert [file.name for file in files] == [
        f"{name}.{form}" for name in NAMES for form in ("png", "svg")
    ]
    for file in files[::2]:
        picture = imread(file)
        assert min(picture.shape[:2]) > 200  # tests draw at half the size
        assert len(np.unique(picture.reshape(-1, picture.shape[2]), axis=0)) > 30
    repeated_files, _ = drawn_of(recording, tmp_path / "again")
    assert [file.read_bytes() for file in repeated_files] == [file.read_bytes() for file in files]
    png_files, _ = drawn_of(recording, tmp_path / "png", ("png",))
    assert [file.suffix for file in png_files] == [".png"] * len(NAMES)


def bars(figure: matplotlib.figure.Figure) -> list[list[tuple[float, float]]]:
    """(begin, end) of the bars of each row of the diagram: measured, planned, measured, ..."""
    rows = [c for c in figure.axes[0].collections if isinstance(c, PolyCollection)]
    return [
        [(p.vertices[:, 0].min(), p.vertices[:, 0].max()) for p in row.get_paths()] for row in rows
    ]


def test_the_gait_diagram_shows_planned_and_measured_contact(recording: Recording) -> None:
    """Each planned stance begins where phase equals the limb's offset; each measured one 0.05 s later."""
    figure = gait_diagram(RecordedGait(recording))
    assert figure is not None
    rows = bars(figure)
    for i, (limb, offset) in enumerate(OFFSETS.items()):
        begin = (offset - VALUES["start.phase"]) % 1.0
        for row, shift in ((rows[2 * i + 1], 0.0), (rows[2 * i], 0.05)):
            complete_intervals = [(a, b) for a, b in row if a > 2.05 and b < 5.95]
            assert len(complete_intervals) >= 3, limb
            for a, b in complete_intervals:
                assert (a - shift - begin + 0.5) % 1.0 - 0.5 == pytest.approx(0.0, abs=0.011)
                assert b - a == pytest.approx(0.68, abs=0.011)
    text = texts(figure)
    words = ["lateral walk at 1 Hz", "time [s]", "gait cycles [1]", "0.68 (0.68)"]
    for word in [*words, "the last 4 whole gait cycles"]:
        assert word in text


def test_a_recording_that_does_not_say_its_gait_shows_what_was_measured(
    recording: Recording,
) -> None:
    figure = gait_diagram(RecordedGait(dataclasses.replace(recording, metadata={})))
    assert figure is not None
    assert len(bars(figure)) == 4
    assert "the whole recording" in texts(figure)


def test_stretches_of_contact() -> None:
    time = 0.1 * np.arange(1, 7)
    intervals = spans(np.array([True, True, False, False, True, True]), time)
    np.testing.assert_allclose(intervals, [(0.0, 0.2), (0.4, 0.2)])
    assert spans(np.zeros(6, bool), time) == []


def test_orientation_is_in_degrees(recording: Recording) -> None:
    figure = orientation(RecordedGait(recording))
    assert figure is not None
    roll, pitch, yaw = (ax.lines[0].get_ydata() for ax in figure.axes)
    np.testing.assert_allclose(roll, 5.0 * np.sin(2 * np.pi * recording.time), atol=1e-3)
    assert np.abs(pitch).max() < 1e-3
    assert np.abs(yaw).max() < 1e-3
    assert [ax.get_ylabel() for ax in figure.axes] == ["roll [deg]", "pitch [deg]", "yaw [deg]"]


def test_the_way_on_the_ground_and_its_mean(recording: Recording) -> None:
    figure = ground_path(RecordedGait(recording))
    assert figure is not None
    torso, mean = figure.axes[0].lines[:2]
    np.testing.assert_allclose(
        torso.get_xdata(), 100.0 * (recording.time - recording.time[0]), atol=1e-6
    )
    np.testing.assert_allclose(torso.get_ydata(), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(mean.get_xdata()), 1.0, atol=1e-6)
    assert figure.axes[0].get_xlabel() == "ahead of the start [mm]"


def test_feet_over_the_ground_are_thick_where_they_bear_a_load(recording: Recording) -> None:
    figure = over_ground(RecordedGait(recording))
    assert figure is not None
    for i, ax in enumerate(figure.axes):
        path, loaded = ax.lines[:2]
        heights = np.asarray(loaded.get_ydata())
        bearing = recording.sensors["foot_force"][-len(heights) :, i] > 0
        np.testing.assert_array_equal(np.isfinite(heights), bearing)
        np.testing.assert_allclose(np.diff(path.get_xdata()), 1.0, atol=1e-6)


@pytest.mark.release
def test_the_leg_frame_is_that_of_the_leg_kinematics(recording: Recording) -> None:
    """A model's leg at taut servo angles has its foot where the closed form has it, however the torso stands."""
    robot = load_robot()
    joints, servo = robot.joints, np.array([[0.5, 0.3], [0.2, 0.1], [-0.4, 0.2], [-0.8, 0.4]])
    pose = forward_kinematics(four_legs(ROBOT), servo, "type3")
    qpos = np.tile(robot.model.qpos0, (2, 1))
    qpos[:, joints.hip], qpos[:, joints.pulley] = servo[:, 0], servo[:, 1]
    qpos[:, np.ravel(joints.knee)] = np.asarray(pose.knee_angle)
    qpos[1, joints.root : joints.root + 7] = [0.1, -0.2, 0.3, *np.array([0.8, 0.2, -0.4, 0.4])]
    for feet in in_leg_frame(robot.model, qpos):
        np.testing.assert_allclose(feet, np.asarray(pose.foot), atol=4e-4)
    ctrl = np.concatenate([servo[:, 0], servo[:, 1], [0.0, 0.0]])[None]
    np.testing.assert_allclose(
        commanded_feet(ctrl, "type3", ROBOT)[0], np.asarray(pose.foot), atol=1e-6
    )
    figure = leg_paths(RecordedGait(recording), robot)
    assert figure is not None
    assert "ahead of the axis [mm]" in texts(figure)


def test_servo_angles_are_commanded_and_measured(recording: Recording) -> None:
    """A servo that stands still is left out, unless it is a leg's."""
    figure = servo_angles_figure(RecordedGait(recording))
    assert figure is not None
    assert len(figure.axes) == 4
    measured, commanded = figure.axes[0].lines[:2]
    np.testing.assert_allclose(
        commanded.get_ydata(), np.degrees(recording.ctrl[-len(commanded.get_ydata()) :, 0])
    )
    np.testing.assert_allclose(measured.get_ydata(), 0.9 * np.asarray(commanded.get_ydata()))


def test_what_a_recording_lacks_is_left_out_and_said(recording: Recording, tmp_path: Path) -> None:
    poor = dataclasses.replace(
        recording, sensors={"orientation": recording.sensors["orientation"]}, model_hash="other"
    )
    files, notes = drawn_of(poor, tmp_path, ("svg",))
    assert [file.name for file in files] == ["orientation.svg"]
    assert "There is no gait-diagram: the recording lacks its sensors." in notes
    assert any("another version of the robot's model" in note for note in notes)
