# Tests of __init__.py, rollout/saving.py, learn/observing.py, robot/parameters.py
"""One thing, one name: what a number of the robot's sensors is called wherever it comes out.

Each number of the sensors has a value of its own here, by which it is found again: in the model, in what the simulator
saves, in observations, in the log that a drive writes, and among the signals that a log is laid beside.
"""

from __future__ import annotations

import collections
import dataclasses
import io
import json

import jax.numpy as jnp
import numpy as np
import pytest
from test_docs import ROOT

from nermo_mjx import Run, Setup, load_robot
from nermo_mjx.hardware import read_log
from nermo_mjx.hardware.channels import read_channels
from nermo_mjx.hardware.log import QUANTITIES
from nermo_mjx.hardware.twin import twin_signals
from nermo_mjx.learn import Task, Training, load_policy
from nermo_mjx.learn.acting import ACTION_SERVOS
from nermo_mjx.learn.observing import (
    DEFAULT_OBSERVATION,
    FORMER_NAMES,
    POLICY_INPUTS,
    SENSED_READINGS,
    Observer,
    privileged_names,
)
from nermo_mjx.live.wire import LinkLog
from nermo_mjx.physics import Trace
from nermo_mjx.recording import Recording
from nermo_mjx.robot import Sensors
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.parameters import READINGS, reading_names
from nermo_mjx.rollout import electrical
from nermo_mjx.rollout.saving import SAVED, Saving, all_signals, chosen_signals
from nermo_mjx.rollout.saving import _read as saved
from nermo_mjx.sweep.spec import Sweep

ROBOT = load_robot()
#: A value for each number of the sensors, and for what the servos are commanded.
DATA = 0.001 * (1.0 + np.arange(ROBOT.model.nsensordata))
CTRL = 0.9 + 0.001 * np.arange(ROBOT.model.nu)
SENSORS = ROBOT.sensors(DATA)
#: What a robot's message tells.
MESSAGE = ("servo_angle", "foot_force", "gyro", "accelerometer", "position")


def in_the_model():
    for i in range(ROBOT.model.nsensor):
        sensor = ROBOT.model.sensor(i)
        size, first = int(sensor.dim[0]), int(sensor.adr[0])
        axes = {1: ("",), 3: ("_x", "_y", "_z"), 4: ("_w", "_x", "_y", "_z")}[size]
        if not sensor.name.startswith("tail_"):  # the tail's force is the sum over its geoms
            yield from ((sensor.name + axis, DATA[first + k]) for k, axis in enumerate(axes))


def of_the_controller():
    for field in dataclasses.fields(Sensors):
        if field.name in READINGS:
            values = np.ravel(getattr(SENSORS, field.name))
            yield from zip(reading_names(field.name, ROBOT.servos), values, strict=True)


def as_saved():
    state = [np.zeros((1, 1, size)) for size in (ROBOT.model.nq, ROBOT.model.nv)]
    trace = Trace(*state, CTRL[None, None], DATA[None, None])
    for signal in all_signals(ROBOT):
        if signal.source not in ("qpos", "qvel", "attitude", "speed"):
            yield (
                signal.name,
                saved(signal.source, trace, ROBOT.sensors(trace.sensordata))[0, 0, signal.place],
            )


def as_observed():
    raw = [
        name
        for name in SENSED_READINGS
        if name not in ("foot_contact", "motor_current", "projected_gravity", "height_scan")
    ]
    observer = Observer(tuple(raw), (), (), False, False, 0, False, 0.01)
    scales = [
        SENSED_READINGS[name].scale for name in raw for _ in reading_names(name, ACTION_SERVOS)
    ]
    yield from zip(observer.names, np.asarray(observer.readings(SENSORS)) * scales, strict=True)


def in_the_log_of_a_drive(folder):
    channels = read_channels("published")
    log = LinkLog(folder / "log.csv", channels, ROBOT, lambda: 0.0)
    log.measured(0.0, None, {name: np.asarray(getattr(SENSORS, name)) for name in MESSAGE})
    command_values = dict(zip(ROBOT.servos, CTRL, strict=True))
    log.command(0.0, np.array([command_values.get(channel.servo, 0.0) for channel in channels]))
    log.end()
    names, *rows = (line.split(",") for line in log.path.read_text().splitlines())
    for row in rows:
        yield from (
            (name, float(cell))
            for name, cell in zip(names, row, strict=True)
            if cell and name != "t"
        )


def beside_a_log():
    sensors = {
        field.name: np.asarray(getattr(SENSORS, field.name))[None]
        for field in dataclasses.fields(Sensors)
    }
    state = (np.zeros((1, ROBOT.model.nq)), np.zeros((1, ROBOT.model.nv)))
    log = twin_signals(Recording(np.zeros(1), *state, CTRL[None], sensors), ROBOT)
    group = {"force": "foot_force"} | {
        last: f"servo_{last}" for last in ("command", "angle", "velocity", "torque")
    }
    for channel in log.channels:
        name = group.get(channel.quantity, channel.quantity)
        if channel.quantity in ("yaw", "contact"):
            continue
        numbers = [f"{channel.of}_{name}"] if name in group.values() else reading_names(name)
        assert channel.quantity == name.rpartition("_")[2]
        assert channel.unit == READINGS[name].unit
        yield from zip(numbers, channel.values.ravel(), strict=True)


def test_each_number_of_the_sensors_has_one_name(tmp_path):
    doors = {
        "model": in_the_model(),
        "controller": of_the_controller(),
        "saved": as_saved(),
        "observed": as_observed(),
        "drive": in_the_log_of_a_drive(tmp_path),
        "log": beside_a_log(),
    }
    called, values_of_names = collections.defaultdict(set), collections.defaultdict(set)
    for numbers in doors.values():
        for name, value in numbers:
            called[round(float(value), 5)].add(name)
            values_of_names[name].add(round(float(value), 5))
    assert {value: names for value, names in called.items() if len(names) != 1} == {}
    assert {name: values for name, values in values_of_names.items() if len(values) != 1} == {}, (
        "and no two things one name"
    )
    of_joints = {
        name
        for name in values_of_names
        if name.endswith("_velocity") and "_foot_" not in name and "servo" not in name
    }
    names_of_readings = {
        number for name in READINGS for number in reading_names(name, ROBOT.servos)
    }
    assert set(values_of_names) - of_joints <= names_of_readings
    assert {number for name in SAVED for number in reading_names(name, ROBOT.servos)} <= set(
        values_of_names
    ) | {
        *READINGS["attitude"].names,
        "speed",
    }


def test_names_of_a_log_are_the_last_words_of_the_vocabulary():
    numbers = {number for name in READINGS for number in (name, *reading_names(name))}
    last = {number.rpartition("_")[2] for number in numbers}
    assert set(QUANTITIES) <= last
    assert len({name for reading in READINGS for name in reading_names(reading)}) == sum(
        len(reading_names(reading)) for reading in READINGS
    )


def test_what_a_policy_is_told_has_the_names_of_the_vocabulary():
    names_of_readings = {number for name in READINGS for number in reading_names(name)}
    observer = Observer(tuple(SENSED_READINGS), (), (), False, False, 0, False, 0.01)
    assert set(observer.names) <= names_of_readings
    critic = {name for name in privileged_names((), (), False) if "." not in name}
    assert critic - names_of_readings <= {
        "height",
        "time_left",
        *(name for name in critic if name.endswith("_foot_height")),
    }


def test_motor_current_is_one_thing_as_metric_and_as_observation():
    """The metric is the mean over the time of the sum over all servos."""
    servo = ModelParameters().servo
    torque = (
        0.01 * np.arange(len(ROBOT.servos)) * (np.arange(len(ROBOT.servos)) < len(ACTION_SERVOS))
    )
    sums = electrical.power_sums(jnp.asarray(torque)[None], jnp.zeros((1, len(torque))), servo)
    metric = electrical.electrical_result(
        sums, jnp.ones(()), electrical.Supply.of(ModelParameters())
    )
    sensed = SENSED_READINGS["motor_current"].read(
        dataclasses.replace(SENSORS, servo_torque=jnp.asarray(torque))
    )
    unloaded = float(servo.idle_current) * (len(torque) - len(ACTION_SERVOS))
    assert float(metric["motor_current"]) == pytest.approx(
        float(np.sum(sensed)) + unloaded, rel=1e-6
    )


# ---
# Files of former versions.


def test_a_policy_of_a_former_version_observes_the_same_numbers():
    path = ROOT / "tests" / "data" / "former_policy.npz"
    metadata = json.loads(bytes(np.load(path)["about"]))
    policy = load_policy(path)
    assert {"servo_load.spine", "tilt.x", "gyro.x"} <= set(metadata["observation"]), (
        "it is of a former version"
    )
    for old, new in (
        ("servo_load.spine", "spine_servo_torque"),
        ("tilt.x", "projected_gravity_x"),
        ("foot_contact.rear_left", "rear_left_foot_contact"),
        ("phase.cos", "phase.cos"),
    ):
        assert policy.observer.names.index(new) == metadata["observation"].index(old)
    saved_metadata = json.loads(bytes(np.load(io.BytesIO(policy.content()))["about"]))
    assert saved_metadata["observation"] == list(policy.observer.names)
    assert not set(FORMER_NAMES) & set(saved_metadata["observer"]["groups"])


def test_specifications_of_a_former_version_are_read():
    training = Training.from_dict(
        {
            "task": {
                "observe": ["servo_load", "servo_current", "tilt", "phase"],
                "set": {"sensing.tilt_noise": 0.01},
            },
            "randomize": {"sensing.servo_load_noise": [0.0, 0.1]},
        }
    )
    assert training.task.observe == ("servo_torque", "motor_current", "projected_gravity", "phase")
    assert training.task.set["sensing.projected_gravity_noise"] == 0.01
    assert training.task.randomize == {"sensing.servo_torque_noise": (0.0, 0.1)}
    assert Task(observe=("tilt",)).observe == ("projected_gravity",)
    assert not set(FORMER_NAMES) & {*SENSED_READINGS, *POLICY_INPUTS, *DEFAULT_OBSERVATION}
    for old, new in (("ctrl", "servo_command"), ("spine_ctrl", "spine_servo_command")):
        assert chosen_signals(ROBOT, Saving((old,))) == chosen_signals(ROBOT, Saving((new,)))
    Sweep.from_dict({"vary": {"frequency": [0.7, 0.8]}, "save": {"sensors": ["ctrl"]}})


def test_channels_of_a_former_version_are_read(tmp_path):
    rows = "".join(f"{t},{t},{t % 2},{t},{t + 1},{9.8 + t}\n" for t in range(4))
    (tmp_path / "log.csv").write_text("t,load,switch,x,y,z\n" + rows)
    channels = {
        "load": {"quantity": "contact", "of": "front_left", "unit": "N"},
        "switch": {"quantity": "contact", "of": "front_left", "unit": "switch"},
        "imu": {"quantity": "acceleration", "columns": ["x", "y", "z"], "unit": "m/s^2"},
    }
    log = read_log(
        tmp_path / "log.csv", {"time": {"column": "t", "unit": "s"}, "channels": channels}
    )
    assert [channel.quantity for channel in log.channels] == ["force", "contact", "accelerometer"]


@pytest.mark.release
def test_a_walk_saves_commands_under_their_name(simulator):
    result = simulator("c").run(
        {}, Run(duration=0.1), save=Saving(("servo_command", "spine_servo_angle"), 100.0)
    )
    assert [*result.series.values] == [
        *reading_names("servo_command", ROBOT.servos),
        "spine_servo_angle",
    ]
    assert Setup().load().servos == ROBOT.servos
