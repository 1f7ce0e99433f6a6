# Tests of rollout/simulator.py
"""The assembled twin walks as the publication says, on the C engine."""

from __future__ import annotations

import numpy as np
import pytest

from nermo_mjx.rollout import Run

FREQUENCIES = np.array([0.5, 0.67, 0.8])
LONG = Run(cycles=6, warmup_cycles=2)


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize("gait", ["trot", "walking_trot", "lateral_walk"])
def test_every_gait_walks_without_falling(simulator, gait):
    """All three gaits cover ground at every published frequency, with and without the spine, and stay upright."""
    values = {
        "frequency": np.tile(FREQUENCIES, 2),
        "spine.amplitude": np.repeat([0.0, 0.2], 3),
    }
    result = simulator(gait=gait, spine="stride_extension").run(values, LONG)
    assert set(result.status) == {"ok"}
    assert np.all(result.metrics["speed"] > 0.02)
    assert np.all(np.abs(result.metrics["roll_mean"]) < np.radians(2))


@pytest.mark.release
def test_trot_speed_without_spine_is_near_the_theory_without_slip(simulator):
    """Ideal trot at 0.8 Hz and full stride: 0.080 to 0.100 m/s; (5.21) gives 0.096."""
    result = simulator(gait="trot").run({"frequency": 0.8}, LONG)
    assert 0.080 <= result.metrics["speed"][0] <= 0.100


@pytest.mark.release
def test_the_best_spine_phase_gains_and_the_worst_loses(simulator):
    """At 0.1 rad a joint the best phase walks at least 5 % faster than no spine, the worst slower than no spine."""
    phases = np.linspace(-np.pi, np.pi, 12, endpoint=False)
    values = {
        "frequency": np.full(13, 0.8),
        "spine.amplitude": np.r_[0.0, np.full(12, 0.4)],
        "spine.phase": np.r_[0.0, phases],
    }
    result = simulator(spine="stride_extension").run(values, LONG)
    speed = result.metrics["speed"]
    assert set(result.status) == {"ok"}
    assert speed[1:].max() >= 1.05 * speed[0]
    assert speed[1:].min() < speed[0]
    assert (
        -np.pi / 3 - 1e-9 <= phases[speed[1:].argmax()] <= 0.0
    )  # published prototype: 0 to -30 degrees


@pytest.mark.release
@pytest.mark.parametrize("name", ["frequency", "stride"])
def test_speed_is_linear_in_frequency_and_stride(simulator, name):
    """The speed law (5.21): R^2 of a line through the speeds is at least 0.98."""
    x = {"frequency": np.linspace(0.4, 0.9, 6), "stride": np.linspace(0.25, 1.0, 6)}[name]
    result = simulator(gait="trot").run({"frequency": np.full(6, 0.8), name: x}, LONG)
    speed = result.metrics["speed"]
    residual = speed - np.polyval(np.polyfit(x, speed, 1), x)
    assert 1 - residual.var() / speed.var() >= 0.98
    assert np.all(np.diff(speed) > 0)


@pytest.mark.release
def test_zero_stride_stays_in_place(simulator):
    """Marching on the spot covers less than a tenth of the ground that walking does."""
    result = simulator(gait="trot").run({"frequency": 0.8, "stride": np.array([0.0, 1.0])}, LONG)
    standing, walking = result.metrics["speed"]
    assert abs(standing) < 0.1 * walking


@pytest.mark.release
@pytest.mark.parametrize("steering", ["leg", "spine", "mix"])
def test_positive_turn_rate_turns_left_and_negative_right(simulator, steering):
    """Every strategy follows the one sign convention: positive is left for both yaw and path, and right mirrors
    left."""
    sim = simulator(steering=steering, pilot="open_loop")
    result = sim.run(
        {"frequency": 0.67, "pilot.turn_rate": np.array([0.9, -0.9])},
        Run(cycles=6, warmup_cycles=2),
    )
    left, right = result.metrics["yaw_mean"]
    assert left > 0.05
    assert right == pytest.approx(-left, rel=0.15)
    assert result.metrics["lateral_drift"][0] > 0.0 > result.metrics["lateral_drift"][1]
    assert result.metrics["turn_rate"][0] > 0.0 > result.metrics["turn_rate"][1]


@pytest.mark.release
def test_the_straight_pilot_keeps_the_line(simulator):
    """Started 2 cm beside the line and 10 degrees off it, the robot comes back to within 2 cm, its sway included.

    In 4 m, for its pilot is slow on purpose (a look-ahead of 0.9 m). Unsteered it would end 0.7 m away.
    """
    sim = simulator(gait="trot")
    start = {"start.x": np.array([0.02, -0.02]), "start.yaw": np.radians([10.0, -10.0])}
    result = sim.run({"frequency": 0.8, **start}, Run(cycles=40, warmup_cycles=36), record=True)
    assert np.all(np.abs(result.trace.sensors["position"][:, -200:, 0]) < 0.02)


@pytest.mark.release
def test_model_parameters_vary_within_a_batch(simulator):
    """Slippery and grippy soles in one batch; light and heavy robots, whose feet and tail carry their weight."""
    sim = simulator(gait="trot")
    friction = sim.run({"frequency": 0.8, "contact.friction": np.array([0.1, 1.0])}).metrics
    assert friction["speed"][0] < 0.9 * friction["speed"][1]
    front = np.array([0.1695, 0.25])
    stand = {
        "stride": 0.0,
        "stance.swing_amplitude": 0.0,
        "stance.stance_amplitude": 0.0,
        "mass.front": front,
    }
    sensors = sim.run(stand, Run(duration=2.0), record=True).trace.sensors
    standing = sensors["foot_force"][:, -20:].sum(axis=-1) + sensors["tail_force"][:, -20:]
    np.testing.assert_allclose(standing.mean(axis=1), 9.81 * (front + 0.1005), rtol=0.01)


@pytest.mark.release
def test_the_articulated_tail_walks_like_the_rigid_one(simulator):
    """The tail's joints change the speed by less than 10 %."""
    run = Run(cycles=6, warmup_cycles=2)
    rigid = simulator(tail="rigid").run({"frequency": 0.8}, run).metrics["speed"][0]
    jointed = simulator(tail="articulated").run({"frequency": 0.8}, run)
    assert jointed.status[0] == "ok"
    assert jointed.metrics["speed"][0] == pytest.approx(rigid, rel=0.10)


@pytest.mark.release
def test_servos_turn_no_faster_than_their_speed(simulator):
    """No servo's target changes by more than its speed allows, and a slow servo shortens the stride."""
    speed = np.array([1.0, 15.0])
    result = simulator(gait="trot").run(
        {"frequency": 0.8, "servo.speed": speed}, Run(cycles=4), record=True
    )
    fastest = np.abs(np.diff(result.trace.ctrl, axis=1)).max(axis=(1, 2)) / 0.01
    assert fastest[0] == pytest.approx(1.0, rel=1e-3)
    assert fastest[1] < 15.0
    assert result.metrics["speed"][0] < 0.9 * result.metrics["speed"][1]


@pytest.mark.release
def test_the_published_lag_shortens_the_stride(simulator):
    """Closing 11 % of the foot error a tick, at one clock, walks slower than exact tracking."""
    result = simulator(gait="trot").run(
        {"frequency": 0.8, "tracking.foot_gain": np.array([1.0, 0.11])}, LONG
    )
    assert result.metrics["speed"][1] < 0.97 * result.metrics["speed"][0]


@pytest.mark.release
def test_as_published_profile_walks(simulator):
    """The published lag and clock ratio together walk upright, and slower than theory: 0.096 m/s on a clock of 0.4."""
    result = simulator(gait="trot", profile="as_published").run({"frequency": 0.8}, LONG)
    assert result.status[0] == "ok"
    assert 0.05 < result.metrics["speed"][0] < 0.096 / 0.4
