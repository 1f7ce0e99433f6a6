# Tests of hardware/table.py, hardware/channels.py
"""Servo tables for the real robot: what the controller commands, periodic, in degrees, on the robot's channels."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
from command import call, json_of

from nermo_mjx import SERVOS, Run, ServoTable, Setup, Simulator, load_robot, servo_table
from nermo_mjx.hardware import recorded_table, send_table
from nermo_mjx.hardware.table import check_clearance
from nermo_mjx.kinematics.leg import four_legs, inverse_kinematics
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.equipment import VISUAL_GROUP
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import servo_range

#: The published robot.
ROBOT = Geometry()

#: The balancing spine jumps where a leg switches, so that no tick may fall on a switch but for its rounding.
GAITS = [
    (Setup(gait="trot", spine="stride_extension"), {"frequency": 0.8, "spine.phase": -0.5}),
    pytest.param(
        Setup(gait="lateral_walk", steering="mix"),
        {"frequency": 0.5, "pilot.turn_rate": -0.4},
        marks=pytest.mark.release,
    ),
    pytest.param(
        Setup(gait="walking_trot", spine="stride_extension+balance"),
        {"frequency": 1.0, "spine.offset_compensation": 1.0, "start.phase": 0.004},
        marks=pytest.mark.release,
    ),
    # In the stance of the tests the rear knees would go beyond the servos' range.
    (
        Setup(gait="trot", spine="stride_extension", profile="as_published"),
        {"frequency": 0.8, "stance.front_z": -0.045, "stance.rear_z": -0.05, "stance.rear_y": 0.0},
    ),
]


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize(("setup", "values"), GAITS, ids=["trot", "turn", "modes", "published"])
def test_a_table_is_what_the_simulation_commands(setup: Setup, values: dict[str, float]) -> None:
    """The simulated servos are given the same angles, cycle for cycle: tick k of a steady cycle is row k."""
    recorded = dataclasses.replace(setup, pilot="open_loop")
    ratio = recorded.defaults()["tracking.clock_ratio"]
    period = ratio / values["frequency"]
    rate = 100.0 * ratio  # rows a second of the controller's clock: a row a tick
    table = servo_table(setup, values, rate=rate)
    result = Simulator(recorded, "c").run(values, Run(cycles=6, warmup_cycles=1), record=True)
    assert result.trace is not None
    ctrl = np.degrees(np.asarray(result.trace.ctrl)[0])
    # The simulated servos follow no faster than they can, 15 rad/s, where the balancing spine jumps.
    angles, reach = table.angles.copy(), np.degrees(recorded.defaults()["servo.speed"]) / 100.0
    for row in [*range(1, len(angles)), *range(len(angles))]:
        angles[row] = angles[row - 1] + np.clip(table.angles[row] - angles[row - 1], -reach, reach)
    phase = np.asarray(result.trace.time)[-len(table.time) :] / period % 1.0
    rows = np.round(phase * len(table.time)).astype(int) % len(table.time)
    error = np.abs(ctrl[-len(table.time) :] - angles[rows])
    # Single precision there, double here.
    assert error.max() < 0.02


@pytest.mark.release
def test_a_servo_is_where_the_leg_needs_it_at_the_end_of_stance() -> None:
    """By the closed form alone: at phase 0 of the trot, a front left stance begins half a cycle later at the front."""
    table = servo_table(Setup(gait="trot"), {"frequency": 1.0}, rate=100.0)
    half = table.angles[50]
    # The stance of front left begins at phase 0.5: its foot is half a stride ahead of its neutral place.
    target = np.array([-0.005 - 0.03, -0.045])
    leg = four_legs(ROBOT)
    servo = np.degrees(
        np.asarray(inverse_kinematics(leg, np.broadcast_to(target, (4, 2)), "type3").servo)
    )[0]
    assert table.angles[50, 0] == pytest.approx(servo[0], abs=0.05)
    assert half[SERVOS.index("front_left_knee")] == pytest.approx(servo[1], abs=0.05)


@pytest.mark.release(cases=("30.0-0.5", "120.0-0.83", "50.0-0.83", "120.0-0.67", "120.0-0.5"))
@pytest.mark.parametrize("frequency", [0.5, 0.67, 0.83])
@pytest.mark.parametrize("rate", [30.0, 50.0, 120.0])
def test_whole_cycles_are_whole_rows(frequency: float, rate: float) -> None:
    """The rows divide the cycles evenly, at nearly the rate asked for, and the end leads to the beginning."""
    table = servo_table(Setup(gait="trot"), {"frequency": frequency}, rate=rate, cycles=3)
    assert table.rate == pytest.approx(rate, rel=0.51 / len(table.time))
    assert len(table.time) / table.rate == pytest.approx(3 / frequency, rel=1e-12)
    steps = np.abs(np.diff(np.concatenate([table.angles, table.angles[:1]]), axis=0)).max(axis=1)
    assert steps[-1] <= steps[:-1].max() * 1.01
    assert steps.max() == pytest.approx(table.speed.max() / table.rate)
    if len(table.time) % 3 == 0:
        cycle = len(table.time) // 3
        np.testing.assert_allclose(table.angles[:cycle], table.angles[cycle : 2 * cycle], atol=1e-4)


def test_left_and_right_turns_mirror_each_other() -> None:
    """A trot's turn to the left is that to the right, half a cycle later on the other side."""
    tables = [
        servo_table(
            Setup(gait="trot", steering="mix"),
            {"frequency": 1.0, "pilot.turn_rate": turn},
            rate=100.0,
        )
        for turn in (0.6, -0.6)
    ]
    left, right = (table.angles for table in tables)
    opposite = [
        SERVOS.index(name.replace("left", "?").replace("right", "left").replace("?", "right"))
        for name in tables[0].names
    ]
    signs = np.array([-1.0 if name in ("spine", "neck") else 1.0 for name in tables[0].names])
    np.testing.assert_allclose(left, signs * np.roll(right, 50, axis=0)[:, opposite], atol=0.02)
    assert left[:, SERVOS.index("spine")].mean() > 5.0


@pytest.mark.release
def test_columns_are_the_robots_servos_in_the_order_of_ctrl() -> None:
    model = load_robot().model
    table = servo_table(rate=30.0)
    assert [f"{name}_servo" for name in table.names] == [
        model.actuator(i).name for i in range(model.nu)
    ]
    limits = np.radians([[channel.low, channel.high] for channel in table.channels])
    np.testing.assert_allclose(limits, model.actuator_ctrlrange)
    assert [channel.number for channel in table.channels] == list(range(model.nu))
    assert servo_table(Setup(tail="articulated"), rate=30.0).names[-1] == "tail"


CHANNELS = {
    "spine": {"channel": 0, "direction": -1, "zero": 90.0},
    "front_right_hip": {"channel": 5, "direction": -1, "zero": 92.5, "low": 0, "high": 180},
    "front_left_hip": {"channel": 2},
}


@pytest.mark.release
def test_channels_order_turn_and_shift_the_columns(tmp_path: Path) -> None:
    setup = Setup(spine="stride_extension")
    plain = servo_table(setup, rate=30.0)
    file = tmp_path / "channels.yaml"
    file.write_text(
        "".join(f"{name}: {fields}\n".replace("'", "") for name, fields in CHANNELS.items())
    )
    for source in (CHANNELS, file):
        table = servo_table(setup, rate=30.0, channels=source)
        assert table.names == ("spine", "front_left_hip", "front_right_hip")
        np.testing.assert_allclose(table.angles[:, 0], 90.0 - plain.angles[:, 8])
        np.testing.assert_allclose(table.angles[:, 1], plain.angles[:, 0])
        np.testing.assert_allclose(table.angles[:, 2], 92.5 - plain.angles[:, 1])


def test_a_bending_spine_stays_within_its_servos_range() -> None:
    low, high = np.degrees(servo_range("spine"))
    table = servo_table(Setup(spine="stride_extension"), rate=30.0)
    assert low < table.angles[:, 8].min() < table.angles[:, 8].max() < high


def test_the_csv_is_read_by_pandas_and_by_hand() -> None:
    """Comments, one line of headings with units, numbers to a thousandth of a degree."""
    table = servo_table(rate=30.0, cycles=2)
    text = table.to_csv("a trot")
    frame = pd.read_csv(io.StringIO(text), comment="#")
    assert list(frame.columns) == ["time [s]", *(f"{name} [deg]" for name in table.names)]
    np.testing.assert_allclose(frame.to_numpy()[:, 1:], table.angles, atol=5.1e-4)
    np.testing.assert_allclose(frame["time [s]"], table.time, atol=5.1e-7)
    rows = [row for row in csv.reader(text.splitlines()) if not row[0].startswith("#")]
    assert len(rows) == 1 + len(table.time)
    assert text.startswith("# a trot\n# 2 gait cycles of ")
    assert "-0.000" not in text
    assert isinstance(table, ServoTable)


@pytest.mark.release
def test_the_command_writes_the_table(tmp_path: Path) -> None:
    """The same numbers as from Python, and nothing but JSON on standard output."""
    out = tmp_path / "new" / "gait.csv"
    words = f"servos --gait lateral_walk --frequency 0.5 --turn-rate 0.3 --rate 40 --cycles 2 --out {out} --json"
    command = [sys.executable, "-m", "nermo_mjx", *words.split()]
    process = subprocess.run(command, capture_output=True, text=True, check=True)
    report = json.loads(process.stdout)
    table = servo_table(
        Setup(gait="lateral_walk"), {"frequency": 0.5, "pilot.turn_rate": 0.3}, rate=40.0, cycles=2
    )
    assert report["rows"] == len(table.time) == 160
    assert [servo["servo"] for servo in report["servos"]] == list(table.names)
    np.testing.assert_allclose(
        pd.read_csv(out, comment="#").to_numpy()[:, 1:], table.angles, atol=5.1e-4
    )


@pytest.mark.release
def test_a_recorded_walk_gives_what_was_commanded(tmp_path: Path) -> None:
    """By a controller that answers to its sensors: at each tick the angle of the recording, in between on a line."""
    setup = Setup(spine="stride_extension", pilot="straight")
    recording = (
        Simulator(setup, "c")
        .run({"frequency": 0.8}, Run(duration=0.5, warmup=0.0), record=True)
        .recording()
    )
    ticks = recorded_table(recording, setup.load(), rate=100.0)
    np.testing.assert_allclose(ticks.angles, np.degrees(recording.ctrl), atol=1e-4)
    assert ticks.names == SERVOS[:10]
    assert ticks.servo_speed == pytest.approx(np.degrees(setup.defaults()["servo.speed"]), rel=1e-6)
    between = recorded_table(recording, setup.load(), rate=200.0)
    middle = 0.5 * (ticks.angles[:-1] + ticks.angles[1:])
    np.testing.assert_allclose(between.angles[1::2], middle, atol=1e-4)
    commands, clock = [], iter(np.arange(10_000) * 0.001)
    send_table(
        ticks,
        lambda angles, channels: commands.append(angles),
        clock=lambda: next(clock),
        wait=lambda seconds: None,
    )
    assert len(commands) == len(ticks.time)  # once, and not in a loop

    path, out = tmp_path / "walk.npz", tmp_path / "walk.csv"
    recording.save(path)
    assert json_of("servos", "--recording", path, "--out", out)["cycles"] is None
    table = pd.read_csv(out, comment="#")
    np.testing.assert_allclose(
        table["spine [deg]"], recorded_table(recording, setup.load()).angles[:, 8], atol=6e-4
    )
    assert "not periodic, to be played once" in out.read_text()
    refused = call("servos", "--recording", path, "--gait", "lateral_walk", "--out", out)
    assert (refused.exit_code, "--gait has no effect with --recording" in refused.stderr) == (
        2,
        True,
    )
    with pytest.raises(ParameterError, match="has one row then"):
        recorded_table(recording, setup.load(), rate=1.0)


@pytest.mark.release
@pytest.mark.parametrize("side", [0, 1], ids=["left", "right"])
def test_parts_that_would_touch_are_named_with_the_time(side: int, tmp_path: Path) -> None:
    """A front foot far back meets the rear foot far forward where the spine bends to their side, and only there."""
    setup = Setup(pilot="open_loop")
    walk = (
        Simulator(setup, "c")
        .run({"frequency": 0.8}, Run(duration=2.0, warmup=0.0), record=True)
        .recording()
    )
    ctrl, share = np.zeros_like(walk.ctrl), np.clip(walk.time - 0.2, 0.0, 1.0)
    towards, name = (0.6, "left") if side == 0 else (-0.6, "right")
    for servo, angle in (
        (side, 1.6),
        (2 + side, -1.6),
        (4 + side, 1.25),
        (6 + side, -0.8),
        (8, towards),
    ):
        ctrl[:, servo] = share * angle
    bent = dataclasses.replace(walk, ctrl=ctrl)
    bent.save(tmp_path / "bent.npz")
    with pytest.raises(
        ParameterError, match=f"^rear_{name}_foot and front_{name}_foot would touch at "
    ) as refused:
        recorded_table(bent, setup.load())
    time = float(str(refused.value).partition(" at ")[2].partition(" s")[0])
    assert 0.8 < time <= 1.3  # on the way there, the last part of it
    ctrl[:, 8] = 0.0
    assert len(recorded_table(dataclasses.replace(walk, ctrl=ctrl), setup.load()).time) == 101
    result = call("servos", "--recording", tmp_path / "bent.npz", "--out", tmp_path / "bent.csv")
    assert (result.exit_code, f"front_{name}_foot would touch" in result.stderr) == (2, True)
    assert not (tmp_path / "bent.csv").exists()


#: Two arms of 150 mm that hang 200 mm apart, each turned inward by its servo.
ARMS = """<mujoco><option timestep=".001"/><worldbody><body name="torso"><geom size=".01" group="{group}"/>
<body name="left" pos=".1 0 0"><joint name="l" axis="0 1 0" armature=".001"/>
<geom type="capsule" fromto="0 0 0 0 0 -.15" size=".01" group="{group}"/></body>
<body name="right" pos="-.1 0 0"><joint name="r" axis="0 -1 0" armature=".001"/>
<geom type="capsule" fromto="0 0 0 0 0 -.15" size=".01" group="{group}"/></body>
</body></worldbody><actuator><position joint="l" kp="10" kv=".2"/><position joint="r" kp="10" kv=".2"/></actuator>
</mujoco>"""


def test_two_arms_touch_when_their_closed_form_says() -> None:
    """Tips of 10 mm radius meet at arcsin(0.09 / 0.15) = 0.64 rad each; servos follow 1 rad/s with a lag of 20 ms."""
    model = mujoco.MjModel.from_xml_string(ARMS.format(group=VISUAL_GROUP))
    inward = np.repeat(np.linspace(0.0, 1.0, 101)[:, None], 2, axis=1)
    with pytest.raises(
        ParameterError, match=r"^(left and right|right and left) would touch at "
    ) as refused:
        check_clearance(model, inward, 100.0)
    time = float(str(refused.value).partition(" at ")[2].partition(" s")[0])
    assert time == pytest.approx(np.arcsin(0.6) + 0.02, abs=0.01)
    check_clearance(model, 0.6 * inward, 100.0)
    check_clearance(model, inward * [1.0, -1.0], 100.0)


@pytest.mark.release
def test_a_cycle_and_three_cycles_are_the_same_gait() -> None:
    single = servo_table(Setup(gait="lateral_walk"), {"frequency": 0.5}, rate=50.0)
    three = servo_table(Setup(gait="lateral_walk"), {"frequency": 0.5}, rate=50.0, cycles=3)
    np.testing.assert_allclose(np.tile(single.angles, (3, 1)), three.angles, atol=1e-4)
