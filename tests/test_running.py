"""A controller under commands that come while it runs."""

from __future__ import annotations

import numpy as np
import pytest

from nermo_mjx.control.schedule import Switch
from nermo_mjx.live.running import Running
from nermo_mjx.physics.c_engine import CBodies
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.quantity import values_of
from nermo_mjx.rollout import Run, Setup, Simulator

pytestmark = pytest.mark.compiles


@pytest.fixture(scope="module")
def running() -> Running:
    return Running(Setup(pilot="open_loop"), {"frequency": 0.8})


def walked(running: Running, ticks: int, commands=()) -> tuple[np.ndarray, np.ndarray]:
    """Positions (ticks, nq) and servo targets (ticks, n_servos) of engine c under commands."""
    body = CBodies(running.simulator.engine, running.batch.qpos, running.batch.fields, 1)
    readings = np.repeat(body.sensordata[:, None], running.steps_per_tick, axis=1)
    running.reset(body.sensordata[0])
    qpos, ctrl = [], []
    for tick in range(ticks):
        for at, switch in commands:
            if at == tick:
                running.command(switch)
        body.ctrl[...] = running.tick(readings[0])
        body.move(readings)
        qpos.append(body.qpos[0].copy())
        ctrl.append(body.ctrl[0].copy())
    return np.array(qpos), np.array(ctrl)


def test_without_a_command_it_is_a_walk_bit_for_bit():
    setup = Setup(pilot="open_loop", spine="stride_extension")
    qpos, ctrl = walked(Running(setup, {"frequency": 0.8}, all_modes=False), 120)
    trace = Simulator(setup, "c").run({"frequency": 0.8}, Run(duration=1.2), record=True).trace
    np.testing.assert_array_equal(qpos, trace.qpos[0, :120])
    np.testing.assert_array_equal(ctrl, trace.ctrl[0, :120])


def test_it_switches_as_a_schedule_does():
    """A gait and a mode that it did not start with; the frequency, on which a blend's length hangs, stays."""
    switch = Switch(0.8, gait="lat", spine="stride_extension", values={"stride": 0.7})
    setup = Setup(pilot="open_loop", schedule=(switch,))
    trace = Simulator(setup, "c").run({"frequency": 0.8}, Run(duration=2.5), record=True).trace
    qpos, ctrl = walked(Running(setup, {"frequency": 0.8}), 250)
    np.testing.assert_allclose(ctrl, trace.ctrl[0, :250], atol=2e-3)
    np.testing.assert_allclose(qpos[:, :3], trace.qpos[0, :250, :3], atol=2e-3)


def test_commands_within_a_blend_are_continuous_and_make_the_run_again_bit_for_bit(running):
    commands = [
        (50, Switch(0, gait="lat")),
        (80, Switch(0, spine="stride_extension", values={"frequency": 1.1})),
        (120, Switch(0, gait="trt", values={"pilot.turn_rate": 0.5})),
        (150, Switch(0, spine="none", blend=0.3)),
    ]
    first = walked(running, 250, commands)
    again = list(running.commands)
    assert [tick for tick, _ in again] == [50, 80, 120, 150]
    steady = np.abs(np.diff(walked(running, 250)[1], axis=0)).max()
    for one, other in zip(first, walked(running, 250, again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert np.abs(np.diff(first[1], axis=0)).max() < 2 * steady
    spine = first[1][:, running.simulator.robot.servos.index("spine")]
    assert np.ptp(spine[:50]) == 0 < np.ptp(spine[100:150])


def test_a_command_beside_a_longer_one_leaves_it_its_length(running):
    """A slider that is moved while the gait changes: the gait is that of the gait's command alone, tick by tick."""
    gait, stride = Switch(0, gait="lat", blend=1.0), Switch(0, values={"stride": 0.8}, blend=0.1)
    seen = {}
    for name, commands in {"gait": [(20, gait)], "both": [(20, gait), (50, stride), (60, stride)]}.items():
        seen[name] = []
        body = CBodies(running.simulator.engine, running.batch.qpos, running.batch.fields, 1)
        running.reset(body.sensordata[0])
        readings = np.repeat(body.sensordata, running.steps_per_tick, axis=0)
        for tick in range(200):
            for at, switch in commands:
                if at == tick:
                    running.command(switch)
            running.tick(readings)
            now = dict(values_of(running.control))
            seen[name].append([float(np.asarray(now[each])[0]) for each in ("duty", "stride")])
    duty, stride = np.array(seen["both"]).T
    np.testing.assert_allclose(duty, np.array(seen["gait"])[:, 0], atol=1e-6)
    assert duty[20] == 0.5 < duty[82] < 0.6 < duty[-1] == pytest.approx(0.68)
    assert stride[49] == 1.0 > stride[56] > stride[-1] == pytest.approx(0.8)
    running.command(gait)
    running.command(Switch(0, gait="trt"))
    with pytest.raises(ParameterError, match="beside the change before"):
        running.command(Switch(0, values={"frequency": 0.1}))


@pytest.mark.parametrize(("switch", "sentence"), [
    (Switch(0, values={"frequency": 9}), r"frequency is 9: allowed is \(0, 5\] Hz"),
    (Switch(0, values={"froquency": 1}), r"'froquency': did you mean 'frequency'"),
    (Switch(0, values={"contact.friction": 1}), r"'contact.friction'"),
    (Switch(0, values={"stride": 1.2, "stance.max_stride": 0.08}), r"stride is 1.2: .* allowed is \[0, 1.050\]"),
    (Switch(0, spine="pitch_balance"), r"spine is 'pitch_balance'.*allowed"),
    (Switch(0, gait="lat", blend=0.1), r"blend is 0.1: allowed is more than 0.32 cycles"),
    (Switch(0, gait="lat", blend=0.0), r"blend is 0: allowed is \[0.05, 100\]"),
])  # fmt: skip
def test_a_command_that_is_refused_changes_nothing(running, switch, sentence):
    before = walked(running, 30)[1]
    with pytest.raises(ParameterError, match=sentence):
        running.command(switch)
    assert running.commands == []
    body = CBodies(running.simulator.engine, running.batch.qpos, running.batch.fields, 1)
    readings = np.repeat(body.sensordata[:, None], running.steps_per_tick, axis=1)
    running.reset(body.sensordata[0])
    with pytest.raises(ParameterError):
        running.command(switch)
    np.testing.assert_array_equal(running.tick(readings[0]), before[0])
