# Tests of live/wire.py
"""A controller and a robot on the same topics: their messages, the watchdog, and two processes that walk together."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import io
import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import shared_simulator
from fakes import wires
from fakes.wires import CHANNELS, Together, until

from nermo_mjx import Run, Setup
from nermo_mjx.hardware import read_channels, read_log
from nermo_mjx.hardware.live import ANSWER_SECONDS, ROS_TYPE, TOPIC, NotSentError, SendError, linked
from nermo_mjx.hardware.signals import findings_of
from nermo_mjx.live.driving import Journal, replay_drive
from nermo_mjx.live.server import LiveDrive
from nermo_mjx.live.wire import (
    APPROACH_RAD_PER_SECOND,
    SENSORS_TOPIC,
    DriveReport,
    LinkLog,
    Measurements,
    RobotDriving,
    needed_sensors,
    sensor_message,
    wait_for_message,
)
from nermo_mjx.recording import RecordingError
from nermo_mjx.robot import ParameterError, load_robot
from nermo_mjx.trust import MESSAGE_HANDLER

pytestmark = pytest.mark.usefixtures("shared_simulators")

#: A message of the author's simulation: eight leg servos, tail, neck, head and spine, four feet, and the IMU's place,
#: quaternion, velocity, acceleration and turning.
AUTHORS = {
    "servo_pos_leg": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8],
    "servo_pos_aux": [0.25, -0.1, 0.0, 0.35],
    "contact_sensors": [1.0, 0.0, 0.5, 2.0],
    "imu_sensor": [
        1.0,
        -2.0,
        0.05,
        1.0,
        0.0,
        0.0,
        0.0,
        0.01,
        -0.02,
        0.03,
        0.0,
        0.1,
        9.8,
        0.4,
        0.5,
        0.6,
    ],
}


@pytest.fixture(scope="module")
def driving() -> RobotDriving:
    return RobotDriving(Setup(), channels=CHANNELS, rate=100.0)


def stamped(seconds: float, **fields: Any) -> dict[str, Any]:
    return {
        "header": {"stamp": {"sec": int(seconds), "nanosec": round(1e9 * (seconds % 1.0))}},
        **AUTHORS,
        **fields,
    }


def test_the_authors_message_is_read_by_meaning() -> None:
    robot, clock = load_robot(), wires.Clock()
    measured = Measurements(robot, CHANNELS, clock=clock)
    assert not measured.reported_fields
    measured.receive(AUTHORS)
    sensors = robot.sensors(measured.sensordata)
    legs = dict(
        zip((channel.servo for channel in CHANNELS), AUTHORS["servo_pos_leg"], strict=False)
    )
    for name, angle in {**legs, "spine": 0.35, "neck": -0.1}.items():
        assert sensors.servo_angle[robot.servos.index(name)] == pytest.approx(angle, abs=1e-12)
    np.testing.assert_array_equal(sensors.foot_force, [1.0, 0.0, 0.5, 2.0])
    np.testing.assert_array_equal(sensors.position, [1.0, -2.0, 0.05])
    np.testing.assert_array_equal(sensors.orientation, [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(sensors.linear_velocity, [0.01, -0.02, 0.03])
    np.testing.assert_array_equal(sensors.accelerometer, [0.0, 0.1, 9.8])
    np.testing.assert_array_equal(sensors.gyro, [0.4, 0.5, 0.6])
    imu = {"position", "orientation", "linear_velocity", "accelerometer", "gyro"}
    assert measured.reported_fields == imu | {"servo_angle", "foot_force"}
    measured.receive({"imu_sensor": AUTHORS["imu_sensor"]})
    assert "servo_angle" not in measured.reported_fields


def test_a_wired_servo_is_read_as_it_is_commanded() -> None:
    """Direction and zero of a channel, and an articulated tail against the author's."""
    robot = load_robot(tail="articulated")
    channels = read_channels(
        {"spine": {"channel": 0, "direction": -1, "zero": 90}, "tail": {"channel": 1, "zero": 10}}
    )
    measured = Measurements(robot, channels)
    measured.receive({"servo_pos_leg": np.radians([80.0, 15.0]).tolist()})
    assert np.degrees(measured.pose[robot.servos.index("spine")]) == pytest.approx(10.0)
    assert np.degrees(measured.pose[robot.servos.index("tail")]) == pytest.approx(5.0)
    data = measured.sensordata.copy()
    message = sensor_message(robot, CHANNELS, data, 2.25)
    assert np.degrees(message["servo_pos_aux"]) == pytest.approx([-5.0, 0.0, 0.0, 10.0], abs=1e-4)
    assert message["header"]["stamp"] == {"sec": 2, "nanosec": 250_000_000}


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (None, "garbage"),
        ("Hello World! mqtt publisher here", "garbage"),
        ([1, 2], "garbage"),
        ({}, "garbage"),
        ({"servo_pos_leg": "abc"}, "garbage"),
        ({"imu_sensor": [{}] * 16}, "garbage"),
        (AUTHORS | {"servo_pos_leg": [0.1] * 7}, "of a wrong size"),
        (AUTHORS | {"imu_sensor": [0.0] * 17}, "of a wrong size"),
        (AUTHORS | {"servo_pos_aux": [[0.1]] * 4}, "of a wrong size"),
        (AUTHORS | {"servo_pos_aux": [0.0, float("nan"), 0.0, 0.0]}, "not finite"),
        (AUTHORS | {"contact_sensors": [None] * 4}, "not finite"),
        (AUTHORS | {"contact_sensors": [1e300] * 4}, "not finite"),
        (AUTHORS | {"imu_sensor": [0.0] * 16}, "not finite"),
        (AUTHORS | {"contact_sensors": [True, False, True, True]}, "garbage"),
        (AUTHORS | {"contact_sensors": [0.1, True, 0.1, 0.1]}, "garbage"),
        (AUTHORS | {"servo_pos_leg": ["0.1"] * 8}, "garbage"),
        (AUTHORS | {"contact_sensors": [0.1, -5.0, 0.1, 0.1]}, "out of range"),
        (AUTHORS | {"header": {"stamp": 3}}, "garbage"),
        (AUTHORS | {"header": {"stamp": {"sec": 10**400, "nanosec": 0}}}, "garbage"),
    ],
)
def test_what_is_no_measurement_is_left_out_and_counted(message: Any, why: str) -> None:
    measured = Measurements(load_robot(), CHANNELS)
    sensordata = measured.sensordata
    measured.receive(message)
    assert measured.counts == {"taken": 0, why: 1}
    assert measured.sensordata is sensordata
    assert not measured.reported_fields


def test_a_message_that_was_overtaken_is_left_out() -> None:
    clock = wires.Clock()
    measured = Measurements(load_robot(), CHANNELS, clock=clock)
    for seconds, feet in ((5.00, 1.0), (5.02, 2.0), (5.01, 3.0), (5.02, 4.0), (5.03, 5.0)):
        measured.receive(stamped(seconds, contact_sensors=[feet] * 4))
        clock.wait(0.01)
    assert measured.counts == {"taken": 3, "out of order": 2}
    assert measured.robot.sensors(measured.sensordata).foot_force[0] == 5.0
    measured.receive(AUTHORS | {"header": {"stamp": {"secs": 5, "nsecs": 0}}})
    assert measured.counts["out of order"] == 3, "ROS 1 writes its stamps so"
    clock.wait(1.0)
    measured.receive(stamped(0.5))
    assert measured.counts["taken"] == 4, "a robot that was away may have started anew"


def test_what_a_controller_reads_is_found_and_must_be_told() -> None:
    assert needed_sensors(Setup(pilot="open_loop", spine="stride_extension")) == set()
    assert needed_sensors(Setup()) >= {"position", "orientation"}
    assert "gyro" in needed_sensors(Setup(pilot="open_loop", head="gaze"))
    clock = wires.Clock()
    measured = Measurements(load_robot(), CHANNELS, clock=clock)
    wait_for_message(measured, set(), clock.wait)
    measured.receive("nonsense")
    with pytest.raises(
        SendError, match=r"no message .* for 5 s.*position.*open_loop; 1 messages were garbage"
    ):
        wait_for_message(measured, {"position"}, clock.wait)
    measured.receive({"contact_sensors": [0.0] * 4})
    with pytest.raises(
        ParameterError, match="the controller reads position; its messages tell foot_force"
    ):
        wait_for_message(measured, {"position", "foot_force"}, clock.wait)
    wait_for_message(measured, {"foot_force"}, clock.wait)
    measured.receive({"servo_pos_leg": [0.0] * 8, "servo_pos_aux": [0.0] * 4})
    assert measured.counts["of a wrong size"] == 1, (
        "what the controller reads may not be left out later"
    )


@pytest.mark.long
@pytest.mark.release
def test_over_topics_it_walks_as_far_as_without_and_almost_so_with_delay_and_loss(driving) -> None:
    """6 s, against the plain walk; then with 20 ms (10 to 30) and 1 % lost, both ways, within the 5 % allowed."""
    history = (
        shared_simulator(Setup(), "c")
        .run({}, Run(duration=6.0), record=True)
        .recording()
        .sensors["position"]
    )
    plain = np.linalg.norm((history[-1] - history[0])[:2])
    near = Together(driving)
    near.walk(6.0)
    assert near.body.about["distance"] == pytest.approx(plain, rel=0.005)
    far = Together(driving, delay=0.02, loss=0.01)
    far.walk(6.0)
    assert far.body.about["distance"] == pytest.approx(plain, rel=0.05)
    assert far.measured.counts["out of order"] > 20, "messages did overtake each other"
    assert far.body.about["commands"]["lost"] > 0
    assert driving.driven.holds == 0


@pytest.mark.release
def test_servos_go_slowly_from_where_the_robot_is_to_the_start_of_the_gait(driving) -> None:
    link_pair = Together(driving, values={"start.phase": 0.5})
    start_pose = link_pair.measured.pose.copy()
    link_pair.walk(2.0)
    steps = np.abs(np.diff([np.zeros(12), *link_pair.commands], axis=0))[1:]
    begins = int(np.argmax(steps.max(axis=1) > APPROACH_RAD_PER_SECOND * driving.dt + 1e-5))
    assert begins > 20, "the poses at phases 0 and 1/2 are that far apart"
    assert steps[:begins].max() <= APPROACH_RAD_PER_SECOND * driving.dt + 1e-5
    assert np.abs(link_pair.commands[0][[0, 2, 4, 6]] - start_pose[:4]).max() < 1e-4
    assert driving.driven.walking_seconds == pytest.approx(
        (len(link_pair.commands) - begins) * driving.dt, abs=0.05
    )
    top = np.radians(np.degrees(driving.batch.params.servo.top_speed[0])) * driving.dt
    assert steps.max() <= top + 1e-5


@pytest.mark.release
def test_without_messages_it_holds_then_goes_on_and_at_last_ends(driving) -> None:
    link_pair = Together(driving)
    link_pair.walk(1.0)
    link_pair.silent, command_count, distance = (
        True,
        len(link_pair.commands),
        link_pair.body.about["distance"],
    )
    link_pair.walk(2.0)
    assert len(link_pair.commands) - command_count <= link_pair.measured.watchdog / driving.dt + 2
    assert driving.driven.holds == 1
    assert driving.driven.holding_seconds == pytest.approx(2.0, abs=0.05), (
        "with the wait at the start"
    )
    assert link_pair.body.about["distance"] - distance < 0.05
    assert link_pair.body.about["tilt"] < 0.2
    link_pair.silent = False
    link_pair.walk(1.0)
    assert link_pair.body.about["distance"] > distance + 0.03
    assert np.abs(np.diff(link_pair.commands, axis=0)).max() < 0.2, (
        "no jump: where it was, slowly to where it held"
    )
    link_pair.silent = True
    link_pair.walk(ANSWER_SECONDS + 0.5)
    assert driving.driven.ended == "no message of the robot for 5 s"


@pytest.mark.release
@pytest.mark.parametrize("watched", [True, False])
@pytest.mark.parametrize("silent", [True, False])
def test_after_a_pause_the_robot_is_approached_from_where_it_is(
    driving, watched: bool, silent: bool
) -> None:
    """Its power was off meanwhile, or somebody has moved it; whether or not the loop has looked after it."""
    link_pair = Together(driving)
    link_pair.walk(2.0)
    assert driving.driven.walking_seconds > 1.0
    rest_sensors = np.array(Measurements(link_pair.body.robot, CHANNELS).sensordata)
    for k in range(300):
        link_pair.clock.now += driving.dt
        if not silent or k > 200:
            link_pair.measured.receive(
                sensor_message(link_pair.body.robot, CHANNELS, rest_sensors, link_pair.clock())
            )
        if watched:
            driving.watch()
    command_count = len(link_pair.commands)
    driving.step()
    assert len(link_pair.commands) == command_count + 1
    assert (
        np.abs(driving.pose - link_pair.measured.pose).max()
        <= APPROACH_RAD_PER_SECOND * driving.dt + 1e-6
    )


@pytest.mark.release
def test_a_robot_that_is_silent_during_a_pause_ends_the_drive(driving) -> None:
    link_pair = Together(driving)
    link_pair.walk(0.5)
    link_pair.clock.now += ANSWER_SECONDS + 0.1
    with pytest.raises(SendError, match="no message of the robot for 5 s"):
        driving.watch()


@pytest.mark.release
def test_a_page_that_is_closed_ends_the_drive_of_a_robot(driving, monkeypatch) -> None:
    """As `drive --help` says; one that only pauses does not, and one that comes back in time goes on."""
    driving.reset()
    link_pair = Together(driving)
    link_pair.walk(0.5)
    drive = LiveDrive(driving)
    monkeypatch.setattr(driving, "operator", lambda: drive.away)
    drive._began = drive.paused = True
    assert drive.away == 0.0
    driving.watch()
    drive._gone = [time.perf_counter() - ANSWER_SECONDS - 0.1]
    monkeypatch.setattr(time, "sleep", lambda _: None)
    with pytest.raises(SendError, match="no message for 5 s"):
        drive.run(1.0)


@pytest.mark.release
def test_the_journal_of_a_robots_drive_has_its_samples(driving, tmp_path) -> None:
    """What it measured, no command makes again."""
    driving.reset()
    link_pair = Together(driving)
    journal = Journal(tmp_path / "d.jsonl", driving)
    for _ in range(60):
        link_pair.tell()
        driving.tick()
        link_pair.body.tick(link_pair.clock())
        link_pair.clock.now += driving.dt
    journal.end(keep=True)
    recording, replayed_recording = driving.recording(), replay_drive(tmp_path / "d.jsonl")
    for name in ("time", "qpos", "qvel", "ctrl"):
        np.testing.assert_array_equal(getattr(replayed_recording, name), getattr(recording, name))
    np.testing.assert_array_equal(
        replayed_recording.sensors["position"], recording.sensors["position"]
    )


@pytest.mark.release
def test_an_operator_who_is_away_is_as_silent_as_a_robot(driving) -> None:
    link_pair = Together(driving)
    link_pair.walk(0.5)
    driving.step(operator=0.1)
    walked = driving.driven.walking_seconds
    driving.step(operator=0.3)
    assert (driving.driven.walking_seconds, driving.driven.holds) == (walked, 1)
    driving.step(operator=6.0)
    assert driving.driven.ended == "no message for 5 s"


class Posed(RobotDriving):
    """A drive without a controller, whose pose is set."""

    def __init__(self, url: str) -> None:
        self._url = url

    def _approach(self, measured: Measurements) -> None:
        self._start = measured.pose


def test_a_command_beyond_the_limits_of_a_servo_is_sent_at_its_limit() -> None:
    """Also where the channel counts against the controller's angle; the drive counts such commands."""
    wired = {
        "spine": {"channel": 0, "direction": -1, "zero": 90, "low": 80, "high": 100},
        "neck": {"channel": 1},
    }
    robot, angles_of_commands, drive = load_robot(), list[list[float]](), Posed("mqtt://localhost")
    measured = Measurements(robot, read_channels(wired))
    drive.connect(measured, angles_of_commands.append)
    for spine, neck in ((5.0, 40.0), (25.0, 40.0), (-25.0, 40.0)):
        drive.pose = np.zeros(len(robot.servos))
        drive.pose[[robot.servos.index(name) for name in ("spine", "neck")]] = np.radians(
            [spine, neck]
        )
        drive._send(measured)
    np.testing.assert_allclose(
        angles_of_commands, [[85.0, 40.0], [80.0, 40.0], [100.0, 40.0]], atol=1e-3
    )
    assert (drive.driven.sent, drive.driven.limited) == (3, 2)


@pytest.mark.release
def test_limits_of_channels_are_kept_and_commands_come_at_their_rate(driving) -> None:
    narrow = dataclasses.replace(
        CHANNELS, servos=tuple(dataclasses.replace(servo, low=-5.0, high=5.0) for servo in CHANNELS)
    )
    link_pair = Together(driving, narrow, rate=30.0)
    link_pair.walk(2.0)
    assert np.abs(np.degrees(link_pair.commands)).max() <= 5.0 + 1e-4
    assert driving.driven.limited > 20
    assert len(link_pair.commands) == pytest.approx(60, abs=2)


@pytest.mark.release
def test_a_broker_that_is_away_for_long_ends_the_drive(driving) -> None:
    link_pair = Together(driving)

    def fail(message: Any) -> None:
        raise NotSentError("a:1: the MQTT broker is gone")

    driving._publish = fail

    def wait(seconds: float) -> None:
        link_pair.clock.wait(seconds)
        link_pair.measured.receive(AUTHORS)

    driven = driving.run(None, wait)
    assert driven.ended == "a:1: the MQTT broker is gone"
    assert driven.unsent == pytest.approx(
        (ANSWER_SECONDS - link_pair.measured.watchdog) / driving.dt, rel=0.02
    )


@pytest.mark.release
def test_an_angle_that_is_not_a_number_is_not_sent(driving, monkeypatch) -> None:
    link_pair = Together(driving)
    link_pair.walk(0.5)
    command_count = len(link_pair.commands)
    monkeypatch.setattr(driving, "targets", lambda readings: np.full(10, np.nan))
    driving.step()
    assert driving.driven.ended == "the controller asks for an angle that is not a number"
    assert len(link_pair.commands) == command_count


@pytest.mark.release
def test_a_robot_leaves_out_commands_that_are_none(driving) -> None:
    link_pair = Together(driving)
    for message in (
        None,
        "abc",
        [1.0] * 11,
        {"data": [0.0] * 11 + [float("inf")]},
        {"data": None},
        [0.0] * 12,
    ):
        link_pair.body.receive(message)
    link_pair.body.tick(link_pair.clock())
    assert link_pair.body.about["commands"] == {
        "garbage": 3,
        "of a wrong size": 1,
        "not finite": 1,
        "taken": 1,
        "lost": 0,
    }


@pytest.mark.release
def test_under_a_page_the_twin_gets_the_robots_commands(driving, monkeypatch) -> None:
    """And the recording has what the robot measured. A reset leads the robot back slowly; no page is no message."""
    driving.reset()
    link_pair = Together(driving)
    commands = link_pair.commands

    def drive(seconds: float) -> None:
        for _ in range(round(seconds / driving.dt)):
            link_pair.tell()
            driving.tick()
            link_pair.body.tick(link_pair.clock())
            link_pair.clock.now += driving.dt

    drive(2.0)
    recording = driving.recording()
    assert link_pair.body.about["distance"] > 0.1
    walked = np.linalg.norm((recording.qpos[-1] - recording.qpos[0])[:2])
    assert walked == pytest.approx(link_pair.body.about["distance"], rel=0.1)
    np.testing.assert_allclose(
        recording.ctrl[-1][[0, 8]], [commands[-1][0], commands[-1][11]], atol=1e-5
    )
    np.testing.assert_array_equal(
        recording.sensors["position"][-1], link_pair.measured.sensordata[:3]
    )
    assert driving.driven.walking_seconds > 1.9
    with pytest.raises(RecordingError, match="the recording is not of a drive"):
        replay_drive(recording)
    driving.reset()
    drive(0.5)
    assert np.abs(np.diff(commands, axis=0)).max() < 0.2, (
        "no jump, but for what servos differ from what they were told"
    )
    monkeypatch.setattr(driving, "operator", lambda: 0.3)
    walked = driving.driven.walking_seconds
    drive(0.2)
    assert driving.driven.walking_seconds == walked
    monkeypatch.setattr(driving, "operator", lambda: 6.0)
    with pytest.raises(SendError, match="no message for 5 s"):
        driving.tick()


@pytest.mark.release
@pytest.mark.parametrize("signed", [False, True])
def test_what_it_was_sent_and_what_it_measured_is_a_log(signed, driving, tmp_path) -> None:
    """Read back, commands and angles are those of the wire, by signs and zeros of the channels; nothing is amiss."""
    turned = {"direction": -1.0, "zero": 90.0} if signed else {}
    channels = dataclasses.replace(
        CHANNELS, servos=tuple(dataclasses.replace(c, **turned) for c in CHANNELS)
    )
    link_pair = Together(driving, channels)
    log = link_pair.measured.log = LinkLog(
        tmp_path / "robot.csv", channels, link_pair.body.robot, link_pair.clock
    )
    link_pair.commands.clear()
    link_pair.walk(4.0)
    log.end()
    assert log.error is None
    measured_log = read_log(log.path, log.about)
    assert {servo_channel.quantity for servo_channel in measured_log.channels} >= {
        "command",
        "angle",
        "gyro",
        "accelerometer",
        "position",
        "yaw",
    }
    commands = np.degrees(link_pair.commands)
    for servo, channel in measured_log.of_quantity("command").items():
        column = [servo_channel.servo for servo_channel in channels].index(servo)
        expected_angles = -(commands[:, column] - 90.0) if signed else commands[:, column]
        np.testing.assert_allclose(np.degrees(channel.values), expected_angles, atol=1e-3)
    angles = measured_log.of_quantity("angle")["spine"]
    assert len(angles.times) > 390
    np.testing.assert_allclose(
        angles.values[-1],
        link_pair.measured.pose[link_pair.body.robot.servos.index("spine")],
        atol=1e-6,
    )
    assert findings_of(measured_log) == ()
    with pytest.raises(FileExistsError):
        LinkLog(tmp_path / "robot.csv", channels, link_pair.body.robot, link_pair.clock)


@pytest.mark.release
def test_a_log_on_a_full_disk_is_told_and_the_drive_goes_on(driving, monkeypatch, tmp_path) -> None:
    class Full(io.BytesIO):
        fileno = staticmethod(lambda: 0)

        def write(self, content: Any) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(driving, "needed", set())
    monkeypatch.setattr(driving, "_url", "print:")
    monkeypatch.setattr(driving, "_log", tmp_path / "robot.csv")
    with driving.reach():
        driving.measured.log._file = Full()
        driving.run(0.3)
    assert driving.driven.walking_seconds == pytest.approx(0.3)
    assert driving.failures() == [
        f"{tmp_path / 'robot.csv'}: the log cannot be written (No space left on device)."
    ]


@pytest.mark.release
def test_stamps_of_a_robot_are_the_times_of_what_it_measured(driving, tmp_path) -> None:
    """However late its messages come: what is lost or overtaken is missing, and the others are 10 ms apart."""
    link_pair = Together(driving, delay=0.05, loss=0.02)
    log = link_pair.measured.log = LinkLog(
        tmp_path / "robot.csv", CHANNELS, link_pair.body.robot, link_pair.clock
    )
    link_pair.walk(3.0)
    log.end()
    times = read_log(log.path, log.about).channel("angle", "spine").times
    intervals = np.diff(times) / link_pair.body.dt
    np.testing.assert_allclose(intervals, np.round(intervals), atol=1e-6)
    assert (np.round(intervals) > 1).sum() > 10


@pytest.mark.release
@pytest.mark.parametrize(
    ("driven", "factor", "sentences"),
    [
        (DriveReport({"taken": 99}, walking_seconds=5.0, sent=100), 1.0, []),
        (
            DriveReport({"taken": 0}, walking_seconds=5.0, sent=100),
            1.0,
            ["The robot never answered on sensors_mouse: it was"],
        ),
        (
            DriveReport({"taken": 9}, sent=151, skipped=284),
            1.0,
            ["65% of the commands were late and left out: this machine"],
        ),
        (DriveReport({"taken": 9}, sent=100), 0.25, ["75% of the commands were late and left out"]),
        (DriveReport({"taken": 9}, sent=100, skipped=9), 0.99, []),
        (DriveReport({"taken": 9}, sent=50, unsent=30), 1.0, ["30 commands were not taken."]),
        (
            DriveReport({"taken": 9}, sent=9, ended="no message of the robot for 5 s"),
            1.0,
            ["No message of the robot for 5 s."],
        ),
    ],
)
def test_a_drive_is_judged_in_sentences(driven, factor, sentences) -> None:
    failures = driven.failures(factor)
    assert len(failures) == len(sentences)
    assert all(
        text.startswith(sentence) for text, sentence in zip(failures, sentences, strict=True)
    )
    assert not any("{" in text or "None" in text for text in driven.sentences())


@pytest.mark.release
def test_sentences_of_both_sides(driving) -> None:
    link_pair = Together(driving)
    link_pair.measured.receive("garbage")
    link_pair.walk(1.0)
    walked, heard = driving.driven.sentences()
    assert (
        walked
        == f"It walked for {driving.driven.walking_seconds:.1f} s, and {len(link_pair.commands)} commands were sent."
    )
    assert (
        heard
        == f"{link_pair.measured.counts['taken']} messages of the robot were taken; left out: 1 garbage."
    )
    body_sentences, command_sentence = link_pair.body.sentences()
    assert body_sentences.startswith("The simulated robot was there for ")
    assert re.fullmatch(
        r"\d+ commands were taken, the last one \d\.\d s before the end\.", command_sentence
    )


@pytest.mark.release
@pytest.mark.parametrize("heard", [False, True])
def test_a_robot_that_says_nothing_is_told_at_the_start(
    heard, driving, monkeypatch, tmp_path
) -> None:
    """And in the end, by the exit code; the log is there all the same."""
    messages = []

    @contextlib.contextmanager
    def linked(url, topic, kind, link_address, receive, field):
        if heard:
            receive(AUTHORS)
        yield lambda message: None

    monkeypatch.setattr("nermo_mjx.live.wire.linked", linked)
    monkeypatch.setattr("nermo_mjx.live.wire.SILENCE_SECONDS", 0.05)
    monkeypatch.setattr(driving, "needed", set())
    monkeypatch.setattr(driving, "_log", tmp_path / "robot.csv")
    token = MESSAGE_HANDLER.set(messages.append)
    try:
        with driving.reach():
            driving.run(0.3)
    finally:
        MESSAGE_HANDLER.reset(token)
    assert messages[0] == "connected: waiting for the robot's messages on sensors_mouse."
    assert messages[1].startswith(
        "the robot tells accelerometer, "
        if heard
        else "no message on sensors_mouse in 0.05 s: open"
    )
    never = [text for text in driving.failures() if "never answered" in text]
    assert bool(never) is not heard
    assert (len((tmp_path / "robot.csv").read_text().splitlines()) > 10) is not heard, (
        "nothing is sent into silence"
    )


#: Other jobs on the machine delay its messages; simulated time is tested always.
in_real_time = pytest.mark.long


@contextlib.contextmanager
def process(*words: str | Path) -> Iterator[subprocess.Popen[str]]:
    """`nermo-mjx drive` with these words; killed in the end."""
    command = [sys.executable, "-m", "nermo_mjx", "drive", *map(str, words), "--json"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as started:
        try:
            yield started
        finally:
            started.kill()


def walking(url: str, channels: Path) -> tuple[str | Path, ...]:
    """Options of a controller that reads the sensors, at 100 Hz."""
    return (
        "--connect",
        url,
        "--headless",
        "--pilot",
        "straight",
        "--rate",
        "100",
        "--channels",
        channels,
    )


@pytest.fixture(params=["mqtt", "ros"])
def wire(request) -> Iterator[str]:
    """The address of a broker, or of a bridge."""
    with wires.broker() if request.param == "mqtt" else wires.bridge() as port:
        yield f"{request.param}://127.0.0.1:{port}"


@pytest.fixture
def channels(tmp_path) -> Path:
    """`CHANNELS`, as a file."""
    file = tmp_path / "channels.yaml"
    line = "{0.servo}: {{channel: {0.number}, direction: {0.direction:g}, missing: 0}}\n"
    file.write_text("".join(map(line.format, CHANNELS)))
    return file


@in_real_time
def test_two_processes_walk_together(wire, channels) -> None:
    """At 100 Hz, with 20 ms of delay and 1 % of loss both ways, for 8 s, as far as without within 5 %."""
    history = (
        shared_simulator(Setup(), "c")
        .run({}, Run(duration=8.0), record=True)
        .recording()
        .sensors["position"]
    )
    measured, times = Measurements(load_robot(), CHANNELS), list[float]()
    with (
        linked(wire, "listener", ROS_TYPE, SENSORS_TOPIC, measured.receive) as _,
        linked(
            wire, "listener", ROS_TYPE, TOPIC, lambda message: times.append(time.monotonic())
        ) as _,
        process(
            "--serve", wire, "--delay", "20", "--loss", "0.01", "--channels", channels
        ) as robot,
    ):
        until(lambda: measured.reported_fields)
        with process(*walking(wire, channels), "--seconds", "8") as drive:
            out, err = drive.communicate(timeout=180)
        assert drive.returncode == 0, err
        time.sleep(0.2)
        robot.send_signal(signal.SIGTERM)
        served, err = robot.communicate(timeout=30)
        assert robot.returncode == 0, err
    driven, served = json.loads(out), json.loads(served)
    assert driven["walked"] == pytest.approx(8.0)
    assert driven["sent"] + driven["skipped"] > 780
    assert driven["messages"]["out of order"] > 0
    assert served["commands"]["taken"] > 750
    assert served["commands"]["lost"] > 0
    assert served["tilt"] < 0.2
    if (gap := np.quantile(np.diff(times), 0.99)) > 0.04:
        pytest.skip(f"this machine is too busy for real time: commands were {gap:.3f} s apart")
    assert served["distance"] == pytest.approx(
        np.linalg.norm((history[-1] - history[0])[:2]), rel=0.05
    )


@in_real_time
def test_when_either_side_is_killed_the_other_stops(wire, channels, driving, monkeypatch) -> None:
    """The controller, and the robot stands still upright; then the robot, and the next controller holds and ends."""
    measured, commands = Measurements(load_robot(), CHANNELS), []
    position_of_robot = lambda: measured.robot.sensors(measured.sensordata)  # noqa: E731

    def taken(message: Any) -> None:
        angles = message["data"] if isinstance(message, dict) else np.radians(message)
        commands.append((time.monotonic(), np.array(angles)))

    with (
        linked(wire, "listener", ROS_TYPE, SENSORS_TOPIC, measured.receive) as _,
        linked(wire, "listener", ROS_TYPE, TOPIC, taken) as _,
        process("--serve", wire, "--channels", channels) as robot,
    ):
        until(lambda: measured.reported_fields)
        start = position_of_robot().position
        with process(*walking(wire, channels)) as drive:
            until(lambda: np.linalg.norm(position_of_robot().position - start) > 0.1)
            drive.kill()
            drive.wait()
        time.sleep(1.0)
        stood, number = position_of_robot().position, len(commands)
        time.sleep(1.0)
        assert len(commands) == number, "nobody commands"
        assert np.linalg.norm(position_of_robot().position - stood) < 0.002, "it stands"
        assert position_of_robot().position[2] > 0.04, "upright"

        mine, driven = Measurements(load_robot(), CHANNELS), []
        with linked(wire, TOPIC, ROS_TYPE, SENSORS_TOPIC, mine.receive) as publish:
            wait_for_message(mine, {"position"})
            monkeypatch.setattr(driving, "_url", wire)
            driving.connect(mine, publish)
            thread = threading.Thread(target=lambda: driven.append(driving.run()))
            thread.start()
            until(lambda: np.linalg.norm(position_of_robot().position - stood) > 0.05)
            robot.kill()
            robot.wait()
            killed = time.monotonic()
            thread.join(60)
        assert driven[0].ended == "no message of the robot for 5 s"
    jump = np.abs(np.diff([angles for _, angles in commands[number:]], axis=0)).max()
    assert jump < 0.25, "taken over from where it stood"
    assert commands[-1][0] < killed + 1.0, "commands stop"


@in_real_time
def test_a_page_drives_a_robot_that_holds_when_it_hangs() -> None:
    """A page that says what it has shown; then it hangs, and goes on; then it goes, and no command is sent."""
    from websockets.sync.client import connect

    commands: list[float] = []
    with (
        wires.broker() as port,
        linked(
            f"mqtt://127.0.0.1:{port}",
            "listener",
            ROS_TYPE,
            TOPIC,
            lambda angles: commands.append(angles[0]),
        ) as _,
        process("--serve", f"mqtt://127.0.0.1:{port}") as robot,
        process(
            "--connect",
            f"mqtt://127.0.0.1:{port}",
            "--rate",
            "100",
            "--no-browser",
            "--seconds",
            "60",
        ) as drive,
    ):
        assert drive.stderr is not None
        url = next(line.split()[1] for line in drive.stderr if line.startswith("drive: http"))
        begin = url.removesuffix("/").rpartition("/")[0]

        def show(page: Any, seconds: float) -> None:
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                with contextlib.suppress(TimeoutError):
                    if isinstance(message := page.recv(timeout=0.1), bytes):
                        page.send(json.dumps({"shown": int.from_bytes(message[:4], "little")}))

        with connect(f"ws{url[4:]}socket", origin=begin, max_size=None) as page:
            until(lambda: show(page, 0.2) or np.ptp(commands[-50:] or [0]) > 5.0)
            time.sleep(1.0)  # hangs
            number = len(commands)
            time.sleep(1.0)
            assert len(commands) == number, "it holds"
            show(page, 2.0)
            assert np.ptp(commands[-50:]) > 5.0, "it walks again"
        time.sleep(1.0)
        number = len(commands)
        time.sleep(0.5)
        assert len(commands) == number, "no page, no commands"
        drive.send_signal(signal.SIGINT)
        out, err = drive.communicate(timeout=30)
        assert drive.returncode == 0, err
        robot.kill()
    driven = json.loads(out)
    assert driven["holds"] >= 1
    assert driven["ended"] == ""
