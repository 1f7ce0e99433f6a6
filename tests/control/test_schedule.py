# Tests of control/schedule.py, rollout/transitions.py
"""Switches while the robot walks: continuous feet and servos, derivatives, walks without a fall, files and refusals."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.control.schedule import Switch, schedule_of, scheduled
from nermo_mjx.kinematics.body import attitude
from nermo_mjx.robot.parameters import FRONT_LEG, REAR_LEG
from nermo_mjx.robot.quantity import quantities, replace_quantities, values_of
from nermo_mjx.rollout import Run, Setup, Simulator, all_metrics, transitions
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.rollout.metric_table import TRANSITION
from nermo_mjx.runtime import compiler_options
from nermo_mjx.sweep import Sweep

FREQUENCY, AT = 0.8, 2.0
PAIRS = list(itertools.permutations(("trot", "walking_trot", "lateral_walk"), 2))
SPINES = list(itertools.permutations(("none", "stride_extension", "balance"), 2))
#: By how many gait cycles a switch is later.
PHASES = np.arange(20) / 20


def stacked(trees):
    return jax.tree.map(
        lambda *leaves: jnp.stack([jnp.asarray(leaf, float) for leaf in leaves]), *trees
    )


def commanded(setups: list[Setup], rate: float, seconds: float):
    """Feet (setups, phases, ticks, 4, 2), planned contact and servo angles at a control rate [Hz], of a robot at rest.

    The setups have the same modes; a function of the schedule's times, and the arguments of `jax.vmap` for it.
    """
    controller_of_setup, robot = setups[0].make_controller(), setups[0].load()
    controller = dataclasses.replace(controller_of_setup, control_rate=rate, pilot_rate=rate)
    sensors = robot.sensors(robot.sensordata_at_rest(jnp.asarray(robot.model.qpos0)))

    def walk(control, schedule):
        def tick(state, _):
            state, servos = controller.update(
                scheduled(control, schedule, state.time, FREQUENCY), state, sensors
            )
            return state, (state.foot, state.stance, servos.vector(robot.servos))

        first = controller.init(scheduled(control, schedule, 0.0, FREQUENCY), sensors)
        return jax.lax.scan(tick, first, None, length=round(rate * seconds))[1]

    worlds = [setup.world({"frequency": FREQUENCY}) for setup in setups]
    control, schedule = (
        stacked([world.control for world in worlds]),
        stacked([world.schedule for world in worlds]),
    )

    def at_phases(control, schedule):
        def later(phase):
            return walk(
                control, dataclasses.replace(schedule, at=schedule.at.at[0].add(phase / FREQUENCY))
            )

        return jax.vmap(later)(jnp.asarray(PHASES))

    return walk, at_phases, (control, schedule)


@pytest.mark.release
@pytest.mark.parametrize("switches", ["gaits", pytest.param("spine", marks=pytest.mark.release)])
def test_feet_and_servos_are_continuous(switches):
    """In a tick of 1 ms a foot moves by 0.1 mm more than in a steady walk at most, and no servo faster than it can."""
    gaits = [Setup(gait=a, pilot="open_loop", schedule=(Switch(AT, gait=b),)) for a, b in PAIRS]
    last = Switch(9.0, spine="stride_extension+balance")
    modes = [
        Setup(spine=a, pilot="open_loop", schedule=(Switch(AT, spine=b), last)) for a, b in SPINES
    ]
    with jax.enable_x64(True):
        _, at_phases, worlds = commanded(gaits if switches == "gaits" else modes, 1000.0, 5.0)
        every = jax.jit(jax.vmap(at_phases), compiler_options=compiler_options())
        feet, stance, servos = map(np.asarray, every(*worlds))
    switch_row = round(1000 * AT) - 1
    steps = np.linalg.norm(np.diff(feet, axis=2), axis=-1)
    steady = max(steps[:, :, :switch_row].max(), steps[:, :, -1250:].max())
    assert steps.max() < steady + 1e-4
    top = np.asarray(Setup().world({}).model.servo.top_speed)
    assert np.abs(np.diff(servos, axis=2)).max() < top * 1e-3
    # In swing a foot is above its height in stance.
    neutral = np.repeat([FRONT_LEG.neutral_foot[1], REAR_LEG.neutral_foot[1]], 2)
    assert np.where(stance, np.inf, feet[..., 1] - neutral).min() > -1e-9
    changed = np.abs(servos[:, :, -1250:] - servos[:, :, :1250]).max((1, 2, 3))
    assert (changed > 0.05).all()  # each switch did switch


@pytest.mark.release
def test_derivatives_through_a_switch_are_those_of_differences():
    setup = Setup(
        pilot="open_loop", schedule=(Switch(AT, gait="lateral_walk", values={"stride": 0.8}),)
    )
    with jax.enable_x64(True):
        walk, _, (control, schedule) = commanded([setup], 100.0, 4.0)
        control, schedule = jax.tree.map(lambda leaf: leaf[0], (control, schedule))

        def value(point):
            times, blend = schedule.at.at[0].add(point[0]), schedule.blend.at[0].add(point[1])
            servos = walk(control, dataclasses.replace(schedule, at=times, blend=blend))[2]
            return jnp.sum(servos[200:330] * jnp.cos(jnp.arange(servos.shape[1])))

        slope = np.asarray(jax.jit(jax.grad(value))(jnp.zeros(2)))
        value, step = jax.jit(value), 1e-6
        differences = [
            (value(step * direction) - value(-step * direction)) / (2 * step)
            for direction in np.eye(2)
        ]
    assert np.abs(slope).min() > 1e-2
    np.testing.assert_allclose(slope, differences, rtol=1e-5)


@pytest.mark.release
def test_a_walk_is_that_without_a_schedule_until_its_first_switch():
    switched = Setup(
        pilot="open_loop", schedule=(Switch(1.5, gait="lateral_walk", spine="stride_extension"),)
    )
    lateral = Setup(pilot="open_loop", gait="lateral_walk", spine="stride_extension")

    def walked(setup):
        return Simulator(setup, "c").run({"frequency": 0.8}, Run(duration=4.0), record=True).trace

    ours, theirs, walk_after_switch = map(walked, (switched, Setup(pilot="open_loop"), lateral))
    for name in ("qpos", "qvel", "ctrl"):
        np.testing.assert_array_equal(getattr(ours, name)[:, :150], getattr(theirs, name)[:, :150])
    assert np.abs(ours.ctrl[:, 200:] - theirs.ctrl[:, 200:]).max() > 0.1
    # A cycle after the switch has ended the commanded servos are those of the other gait.
    np.testing.assert_allclose(ours.ctrl[:, 390:], walk_after_switch.ctrl[:, 390:], atol=1e-5)


def test_the_time_to_the_new_speed_is_half_a_ramp_and_the_constant_of_an_approach():
    """Also the slip: of the transition alone, whatever happens before and after."""
    schedule = (
        Setup(schedule=(Switch(2.0, blend=2.0, gait="lateral_walk"), Switch(5.0, gait="trot")))
        .world({})
        .schedule
    )
    time_span = transitions.span(schedule, jnp.asarray(1.0))
    assert [float(bound) for bound in time_span] == [2.0, 7.0]
    time = (1 + np.arange(1200)) * 0.01
    courses = {
        "ramp": np.interp(time, [2.0, 5.0], [0.1, 0.3]),
        "approach": 0.3 - 0.2 * np.exp(-(time - 2.0) / 0.5),
        "steady": np.full(1200, 0.1),
    }
    courses["approach"][time <= 2.0] = 0.1
    speed = jnp.asarray(np.stack(list(courses.values())), float)

    def tick(time, speed):
        return transitions.integrals(
            time_span, time, 0.01, jnp.where(time > 7.0, 9.0, 0.06), 3.0, speed
        )

    ticks = jax.vmap(jax.vmap(tick), (None, 0))(jnp.asarray(time), speed)
    result = jax.vmap(transitions.transition_result, (0, None))(
        {name: column.sum(axis=1) for name, column in ticks.items()}, 0.2
    )
    np.testing.assert_allclose(result["transition_time"], [1.5, 0.5, np.nan], atol=0.02)
    np.testing.assert_allclose(result["transition_slip"], 0.02, rtol=1e-3)


@pytest.mark.release
def test_a_run_with_a_schedule_has_the_metrics_of_its_transition():
    setup = Setup(schedule=(Switch(AT, values={"stride": 0.5}),))
    assert set(all_metrics(setup)) - set(all_metrics()) == set(TRANSITION)
    result = Simulator(setup, "c").run(
        {"frequency": FREQUENCY}, Run(duration=7.0, warmup=0.75), record=True
    )
    assert set(result.metrics) == set(all_metrics(setup))
    # From the recorded way, which is straight: 1.25 s before, 2.5 s of transition, 2.5 s after.
    distance = -result.trace.sensors["position"][0, :, 1]
    first_distance, during, last_distance = (
        distance[end - 1] - distance[begin - 1]
        for begin, end in ((75, 200), (200, 450), (450, 700))
    )
    delay = (last_distance - during) / (last_distance / 2.5 - first_distance / 1.25)
    assert 0.3 < delay < 2.5
    assert result.metrics["transition_time"][0] == pytest.approx(delay, rel=0.03)
    ticks = slice(round(100 * AT) - 1, round(100 * (AT + 2 / FREQUENCY)))
    roll = np.abs(
        np.asarray(jax.vmap(attitude)(result.trace.sensors["orientation"][0, ticks]))[:, 0]
    ).max()
    assert result.metrics["transition_roll"][0] == pytest.approx(roll, rel=0.05)
    assert 0.001 < result.metrics["transition_slip"][0] < 0.2


def falls(setup: Setup, phases: np.ndarray) -> list[str]:
    values = {"frequency": FREQUENCY, "schedule.at.1": AT + phases / FREQUENCY}
    status = Simulator(setup, "c").run(values, Run(duration=8.0, warmup=2.0)).status
    return [str(text) for text in status if text != "ok"]


@pytest.mark.release
def test_no_walk_falls_where_trot_becomes_a_lateral_walk_with_the_spine():
    assert (
        falls(
            Setup(schedule=(Switch(AT, gait="lateral_walk", spine="stride_extension"),)),
            PHASES[::4],
        )
        == []
    )


@pytest.mark.long
def test_no_walk_falls_at_any_switch():
    setups = [Setup(gait=a, schedule=(Switch(AT, gait=b),)) for a, b in PAIRS]
    setups += [Setup(spine=a, schedule=(Switch(AT, spine=b),)) for a, b in SPINES]
    assert [setup.schedule for setup in setups if falls(setup, PHASES)] == []


@pytest.mark.long
def test_engines_agree_and_the_gradient_through_a_switch_is_that_of_differences():
    setup, run = (
        Setup(schedule=(Switch(0.5, gait="lateral_walk", blend=0.5),)),
        Run(duration=1.5, warmup=0.2),
    )
    values = {"frequency": np.array([0.8, 1.0])}
    c, mjx = (Simulator(setup, engine).run(values, run).metrics for engine in ("c", "mjx"))
    np.testing.assert_allclose(mjx["speed"], c["speed"], rtol=0.02)
    with jax.enable_x64(True):
        rollout = Rollout(setup, run, "mjx")

        def speed(time):
            return rollout({"frequency": 0.8, "schedule.at.1": time})["speed"]

        value_and_slope = jax.jit(jax.value_and_grad(speed), compiler_options=compiler_options())
        (_, slope), h = value_and_slope(0.5), 1e-6
        difference = (value_and_slope(0.5 + h)[0] - value_and_slope(0.5 - h)[0]) / (2 * h)
    assert np.isfinite(slope)
    np.testing.assert_allclose(slope, difference, rtol=1e-3)


FILE = """run: {duration: 8.0}
schedule:
  - {at: 1.5, gait: lateral_walk, spine: stride_extension}
  - {at: 4.0, blend: 2.0, set: {stride: 0.8}}
vary:
  schedule.at.1: [1.2, 1.6]
  spine.amplitude: [0.2, 0.4]
"""


def test_a_sweep_varies_when_a_switch_begins(tmp_path):
    path = tmp_path / "switch.yaml"
    path.write_text(FILE)
    sweep = Sweep.from_file(path)
    assert set(sweep.varied) == {"schedule.at.1", "spine.amplitude"}
    resolved = sweep.resolved()["schedule"]
    assert resolved == [
        {"at": 1.5, "blend": 1.0, "gait": "lateral_walk", "spine": "stride_extension"},
        {"at": 4.0, "blend": 2.0, "set": {"stride": 0.8}},
    ]


def test_the_phase_of_a_limb_goes_the_shorter_way_around_the_cycle():
    """From 0.1 of the cycle to 0.9 by way of 0, and on to 0.3 by way of 1; other parameters go straight."""
    declarations = dict(quantities(ControlParameters))
    switches = [
        Switch(at=1.0, blend=0.5, values={"offset.front_left": 0.9, "stride": 0.4}),
        Switch(at=2.0, blend=1.0, values={"offset.front_left": 0.3}),
    ]
    schedule = schedule_of(
        Switch(at=0.0, spine="none", head="none", tail_motion="none"), switches, declarations
    )
    control = replace_quantities(ControlParameters(), {"offset.front_left": 0.1, "stride": 1.0})
    now = jax.jit(lambda time: dict(values_of(scheduled(control, schedule, time, 0.5))))
    for time, offset, stride in (
        (0.5, 0.1, 1.0),
        (1.5, 0.0, 0.7),
        (2.0, -0.1, 0.4),
        (3.0, 0.1, 0.4),
        (9.0, 0.3, 0.4),
    ):
        values = now(time)
        phase_error = (values["offset.front_left"] - offset + 0.5) % 1.0 - 0.5
        assert phase_error == pytest.approx(0.0, abs=1e-6), time
        assert values["stride"] == pytest.approx(stride, abs=1e-6), time
