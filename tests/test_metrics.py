"""Attitude and gait metrics on made-up sensor readings whose answers are known."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nermo_mjx.control.parameters import Pilot
from nermo_mjx.control.path import straight
from nermo_mjx.robot import LIMBS, Sensors
from nermo_mjx.rollout import METRICS, metrics
from nermo_mjx.rollout.attitude import attitude, uprightness
from nermo_mjx.rollout.parameters import Window

STEPS, DT, RATE, MASS, SERVOS = 5, 0.01, 1.0, 0.27, 10
#: Of the IMU over the mat [m].
HEIGHT = 0.063


def quaternion(yaw: Any = 0.0, pitch: Any = 0.0, roll: Any = 0.0) -> np.ndarray:
    """(w, x, y, z) of R = Rz(yaw) Rx(pitch) Ry(roll), by scipy."""
    angles = np.stack(np.broadcast_arrays(yaw, pitch, roll), axis=-1)
    return Rotation.from_euler("ZXY", angles).as_quat(scalar_first=True)


def stream(ticks: int, **readings: Any) -> Sensors:
    """Readings of `ticks` ticks of an upright robot that stands still at the origin, but for what is named.

    A named reading is anything that broadcasts to (ticks, STEPS, ...), the axis of the tick's steps included.
    """
    still = {
        "position": np.array([0.0, 0.0, HEIGHT]), "orientation": np.array([1.0, 0.0, 0.0, 0.0]),
        "linear_velocity": np.zeros(3), "gyro": np.zeros(3), "accelerometer": np.array([0.0, 0.0, 9.81]),
        "servo_angle": np.zeros(SERVOS), "servo_velocity": np.zeros(SERVOS), "servo_torque": np.zeros(SERVOS),
        "knee_angle": np.ones(4), "foot_force": np.full(4, 0.66), "foot_position": np.zeros((4, 3)),
        "foot_velocity": np.zeros((4, 3)),
    }  # fmt: skip
    return Sensors(
        **{
            name: np.array(np.broadcast_to(readings.get(name, value), (ticks, STEPS, *value.shape)))
            for name, value in still.items()
        }
    )


def every_step(values: np.ndarray) -> np.ndarray:
    """Readings of one a tick, (ticks, ...), repeated for the tick's steps."""
    return values[:, None]


@functools.cache
def _program(on_line: bool) -> Any:
    def run(window, readings, rate):
        def tick(carry, sensors):
            state, time = carry
            beside = straight(Pilot(), sensors.position[-1]) if on_line else None
            state = metrics.update(window, state, sensors, time, DT, rate, beside)
            return (state, time + DT), state

        # As in the loop: the first reading is that at rest, at time 0, and belongs to no tick.
        start = metrics.init(jax.tree.map(lambda leaf: leaf[0, -1], readings))
        (state, _), history = jax.lax.scan(tick, (start, jnp.zeros(())), readings)
        return metrics.result(state, jnp.asarray(MASS)), history

    return jax.jit(run)


def measure(
    readings: Sensors, rate: float = RATE, on_line: bool = False, **window: float
) -> tuple[dict[str, float], Any]:
    """Metrics of a stream, and the accumulators after every tick; the first tick of a stream is the state at rest.

    `on_line`: beside the straight pilot's line, instead of without a path.
    """
    with jax.enable_x64(True):
        limits = {field.name: np.float64(window.get(field.name, 1e6)) for field in dataclasses.fields(Window)}
        limits["begin"] = np.float64(window.get("begin", 0.0))
        result, history = _program(on_line)(Window(**limits), readings, np.float64(rate))
        return {name: float(value) for name, value in result.items()}, jax.tree.map(np.asarray, history)


def path(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return every_step(np.stack([x, y, np.full_like(x, HEIGHT)], axis=-1))


TIME = DT * np.arange(401)


# --- attitude


def test_angles_are_those_of_scipy():
    """Roll, pitch and yaw are the intrinsic z-x-y Euler angles of scipy, for any attitude but a vertical one."""
    rng = np.random.default_rng(0)
    yaw, pitch, roll = rng.uniform((-3.1, -1.5, -3.1), (3.1, 1.5, 3.1), (200, 3)).T
    with jax.enable_x64(True):
        angles = np.asarray(attitude(jnp.asarray(quaternion(yaw, pitch, roll))))
    np.testing.assert_allclose(angles, np.stack([roll, pitch, yaw], axis=-1), atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_quaternions_and_their_negatives_are_one_attitude(sign):
    """q and -q give the same angles."""
    angles = attitude(jnp.asarray(sign * quaternion(0.3, -0.2, 0.1)))
    np.testing.assert_allclose(angles, (0.1, -0.2, 0.3), atol=1e-6)


def test_signs_of_the_angles():
    """Positive roll leans left (+x), positive pitch puts the nose (-y) down, positive yaw turns the nose left (+x)."""
    half = np.sin(0.1), np.cos(0.1)
    about_x, about_y, about_z = (np.array([half[1], *(half[0] * axis)]) for axis in np.eye(3))
    np.testing.assert_allclose(attitude(jnp.asarray(about_y)), (0.2, 0, 0), atol=1e-6)
    np.testing.assert_allclose(attitude(jnp.asarray(about_x)), (0, 0.2, 0), atol=1e-6)
    np.testing.assert_allclose(attitude(jnp.asarray(about_z)), (0, 0, 0.2), atol=1e-6)
    up, nose = np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])
    roll, pitch, yaw = (Rotation.from_quat(q, scalar_first=True) for q in (about_y, about_x, about_z))
    assert roll.apply(up)[0] > 0.1
    assert pitch.apply(nose)[2] < -0.1
    assert yaw.apply(nose)[0] > 0.1


def test_uprightness():
    """The uprightness is the cosine between the torso's z and the world's."""
    rng = np.random.default_rng(1)
    turns = Rotation.random(50, random_state=rng)
    with jax.enable_x64(True):
        quaternions = jnp.asarray(turns.as_quat(scalar_first=True))
        np.testing.assert_allclose(uprightness(quaternions), turns.apply([0, 0, 1])[:, 2], atol=1e-12)


# --- way, speed, drift


def test_a_straight_walk():
    """0.08 m/s along the heading for 4 s: speed, distance and duration are exact, and nothing else is measured."""
    result, _ = measure(stream(401, position=path(0 * TIME, -0.08 * TIME)))
    assert set(result) == set(METRICS)
    assert result["duration"] == pytest.approx(4.0)
    assert result["distance"] == pytest.approx(0.32)
    assert result["speed"] == pytest.approx(0.08)
    zero = ["lateral_drift", "slip", "servo_work", "cost_of_transport", "fell", "diverged"]
    zero += [f"{angle}_{what}" for angle in ("roll", "pitch", "yaw") for what in ("mean", "std", "min", "max")]
    assert {name: result[name] for name in zero} == pytest.approx(dict.fromkeys(zero, 0.0), abs=1e-6)
    assert [result[f"duty_{limb}"] for limb in LIMBS] == pytest.approx([1.0] * 4)


@pytest.mark.parametrize("yaw", [-2.0, -0.5, 0.5, np.pi, 3.0])
def test_distance_is_along_the_heading(yaw):
    """Whichever way the robot heads, forward counts, backward counts against it, and sideways does not count."""
    forward = np.array([np.sin(yaw), -np.cos(yaw)])
    aside = np.array([forward[1], -forward[0]])
    for along, across in ((0.05, 0.0), (-0.05, 0.0), (0.05, 0.03)):
        x, y = np.outer(forward * along + aside * across, TIME)
        result, _ = measure(stream(401, position=path(x, y), orientation=quaternion(yaw)))
        assert result["speed"] == pytest.approx(along, rel=1e-6)


def test_sway_within_a_cycle_is_no_way():
    """A body that swings left and right at the gait's frequency while it walks gains no distance from it.

    A third of the heading's swing passes the smoothing, and with it that share of the sideways speed: up to 0.5 %.
    """
    rate = 0.8
    swing = np.sin(2 * np.pi * rate * TIME)
    position = path(0.004 * swing, -0.07 * TIME)
    orientation = every_step(quaternion(0.1 * swing))
    result, _ = measure(stream(401, position=position, orientation=orientation), rate=rate, begin=1.5, end=4.0)
    assert result["speed"] == pytest.approx(0.07, rel=5e-3)


@pytest.mark.parametrize("side", [1, -1])
def test_a_full_circle(side):
    """Once and a half around the tightest published circle: the way is its arc, and yaw goes on beyond half a turn.

    Tracking of the heading settles in a few cycles and then does not lag: from there on the way is exact.
    """
    radius, turn_rate, rate = 0.135, 0.44, 0.5
    time = DT * np.arange(1 + round(3 * np.pi / turn_rate / DT))
    yaw = side * turn_rate * time
    position = path(side * radius * (1 - np.cos(yaw)), -radius * np.sin(np.abs(yaw)))
    readings = stream(len(time), position=position, orientation=every_step(quaternion(yaw)))
    settled, _ = measure(readings, rate=rate, begin=18.0)
    assert settled["speed"] == pytest.approx(radius * turn_rate, rel=2e-3)
    result, _ = measure(readings, rate=rate)
    assert result["distance"] == pytest.approx(radius * abs(yaw[-1]), rel=0.03)
    low, high = sorted((side * 3 * np.pi, 0.0))
    assert result["yaw_max"] == pytest.approx(high, abs=0.01)
    assert result["yaw_min"] == pytest.approx(low, abs=0.01)
    assert result["yaw_mean"] == pytest.approx(side * 1.5 * np.pi, abs=0.01)


def test_drift_is_to_the_left():
    """A robot that heads along -y and slides to +x drifts to its left by that much, while it is measured."""
    position = path(0.01 * TIME, -0.08 * TIME)
    assert measure(stream(401, position=position))[0]["lateral_drift"] == pytest.approx(0.04)
    measured, _ = measure(stream(401, position=position), begin=1.0, end=3.0)
    assert measured["lateral_drift"] == pytest.approx(0.02)
    assert measured["distance"] == pytest.approx(0.16)


# --- attitude's statistics


def test_statistics_of_a_rocking_body():
    """A sine of amplitude A about a mean M has mean M, standard deviation A / sqrt 2, and extremes M +- A."""
    wave = np.sin(2 * np.pi * TIME)
    angles = {"roll": (0.02, 0.1), "pitch": (-0.05, 0.03), "yaw": (0.3, 0.05)}
    orientation = every_step(quaternion(**{name: mean + size * wave for name, (mean, size) in angles.items()}))
    result, _ = measure(stream(401, orientation=orientation), end=4.0)
    for name, (mean, size) in angles.items():
        assert result[f"{name}_mean"] == pytest.approx(mean, abs=1e-6)
        assert result[f"{name}_std"] == pytest.approx(size / np.sqrt(2), rel=1e-5)
        assert result[f"{name}_min"] == pytest.approx(mean - size, abs=1e-6)
        assert result[f"{name}_max"] == pytest.approx(mean + size, abs=1e-6)


# --- work, slip, duty


def test_work_of_a_constant_torque_at_a_constant_speed():
    """Positive power counts, negative does not: work is the sum over driving servos of torque x speed x time."""
    torque, speed = np.zeros(SERVOS), np.zeros(SERVOS)
    torque[:4], speed[:4] = (0.1, -0.05, 0.1, -0.1), (2.0, -3.0, -2.0, 0.0)  # drives, drives, brakes, holds
    readings = stream(401, servo_torque=torque, servo_velocity=speed, position=path(0 * TIME, -0.05 * TIME))
    result, _ = measure(readings)
    assert result["servo_work"] == pytest.approx((0.1 * 2.0 + 0.05 * 3.0) * 4.0)
    assert result["cost_of_transport"] == pytest.approx(result["servo_work"] / (MASS * 9.81 * 0.2))


def test_work_is_averaged_over_the_steps_of_a_tick():
    """All steps of a tick count, not the last one alone."""
    power = np.arange(STEPS, dtype=float)  # of one servo, step by step
    torque, speed = np.zeros((STEPS, SERVOS)), np.zeros((STEPS, SERVOS))
    torque[:, 3], speed[:, 3] = power, 1.0
    result, _ = measure(stream(101, servo_torque=torque, servo_velocity=speed))
    assert result["servo_work"] == pytest.approx(power.mean() * 1.0)


def test_cost_of_transport_needs_a_distance():
    """A robot that works on the spot has none."""
    result, _ = measure(stream(101, servo_torque=np.full(SERVOS, 0.1), servo_velocity=np.ones(SERVOS)))
    assert result["servo_work"] == pytest.approx(1.0)
    assert np.isnan(result["cost_of_transport"])


def test_slip_is_the_speed_of_loaded_feet():
    """Each foot's horizontal speed counts while the foot is loaded; in the air, and up or down, it does not."""
    loaded = np.zeros((STEPS, 4))
    loaded[:, 0], loaded[:2, 1] = 0.5, 0.5  # front left always; front right in two of five steps
    velocity = np.zeros((STEPS, 4, 3))
    velocity[:, 0] = 0.03, 0.04, 0.5
    velocity[:2, 1], velocity[2:, 1] = (0.0, 0.1, 0.0), (9.0, 0.0, 0.0)
    velocity[:, 3] = 7.0
    result, _ = measure(stream(101, foot_force=loaded, foot_velocity=velocity))
    assert result["slip"] == pytest.approx((1.0 * 0.05 + 0.4 * 0.1) / 1.4, rel=1e-6)
    assert [result[f"duty_{limb}"] for limb in LIMBS] == pytest.approx([1.0, 0.4, 0.0, 0.0])


def test_a_touch_is_no_load():
    """Less than `LOADED` does not count; a robot that never touches the ground has no slip, rather than none."""
    result, _ = measure(stream(101, foot_force=np.full(4, 0.9 * metrics.LOADED)))
    assert [result[f"duty_{limb}"] for limb in LIMBS] == [0.0] * 4
    assert np.isnan(result["slip"])


# --- when it is measured


def wild_then_calm(until: int, ticks: int = 401) -> Sensors:
    """Until tick `until` it leans, slips and works hard; then it walks on quietly at 0.05 m/s."""
    early = np.arange(ticks) < until
    return stream(
        ticks,
        position=path(0.2 * np.minimum(TIME[:ticks], (until - 1) * DT), -0.05 * TIME[:ticks]),
        orientation=every_step(quaternion(roll=0.5 * early)),
        servo_torque=np.where(early, 1.0, 0.0)[:, None, None],
        servo_velocity=np.ones(SERVOS),
        foot_velocity=np.where(early, 2.0, 0.0)[:, None, None, None],
    )


def test_the_warm_up_is_not_measured():
    """Whatever happens before the warm-up's end leaves no trace; the run's end stops the measuring."""
    result, _ = measure(wild_then_calm(151), begin=1.5, end=3.5)
    assert result["duration"] == pytest.approx(2.0)
    assert result["speed"] == pytest.approx(0.05, rel=1e-6)
    for name in ("roll_max", "roll_std", "lateral_drift", "servo_work", "slip"):
        assert result[name] == pytest.approx(0.0, abs=2e-6), name
    assert measure(wild_then_calm(153), begin=1.5, end=3.5)[0]["roll_max"] == pytest.approx(0.5)


def test_measuring_stops_at_the_end_of_the_cycle_that_covers_the_distance():
    """Angles are measured over whole gait cycles; the warm-up's way counts towards the distance."""
    readings = stream(401, position=path(0 * TIME, -0.08 * TIME))
    whole, _ = measure(readings, rate=2.0, distance=0.15)
    assert whole["duration"] == pytest.approx(2.0, abs=DT + 1e-9)
    assert whole["distance"] == pytest.approx(0.16, abs=0.08 * DT + 1e-9)
    assert whole["speed"] == pytest.approx(0.08)
    late, _ = measure(readings, rate=2.0, distance=0.15, begin=0.8)
    assert late["duration"] == pytest.approx(1.5, abs=DT + 1e-9)
    assert late["speed"] == pytest.approx(0.08)


# --- paths


@pytest.mark.parametrize(("radius", "angle"), [(0.08, 3.0), (0.3, 2.0), (1.0, 0.6)])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_turning_radius_is_that_of_the_circle_walked(radius, angle, side):
    turn = angle * TIME / TIME[-1]
    x, y = side * radius * (1 - np.cos(turn)), -radius * np.sin(turn)
    result, _ = measure(stream(401, position=path(3.0 + x, y - 5.0)), rate=20.0)
    # The mean position of a cycle that turns by b lies on a circle smaller by sinc(b / 2).
    assert result["turning_radius"] == pytest.approx(radius * np.sinc(angle / 80 / 2 / np.pi), rel=1e-4)


def test_sway_does_not_shrink_the_circle():
    """A circle of 0.1 m, 2.5 rad of it, with a sway of 10 mm in each of 8 cycles."""
    turn = 2.5 * TIME / TIME[-1]
    swaying = 0.1 + 0.01 * np.cos(2 * np.pi * 2.0 * TIME)
    x, y = 0.1 - swaying * np.cos(turn), -swaying * np.sin(turn)
    result, _ = measure(stream(401, position=path(x, y)), rate=2.0)
    assert result["turning_radius"] == pytest.approx(0.1, rel=0.01)


def test_a_straight_way_has_no_turning_radius():
    result, _ = measure(stream(401, position=path(0.3 * TIME, -0.08 * TIME)))
    assert np.isnan(result["turning_radius"])
    standing, _ = measure(stream(401))
    assert np.isnan(standing["turning_radius"])


def test_sway_counts_in_the_peak_of_the_error_and_not_in_the_way_walked():
    """A drift of 2 mm a second and a sway of 10 mm at 2 cycles a second; the oracle is NumPy on the same numbers."""
    error = 0.002 * TIME + 0.010 * np.cos(2 * np.pi * 2.0 * TIME)
    result, _ = measure(stream(401, position=path(error, -0.08 * TIME)), rate=2.0, on_line=True)
    assert result["cross_track_peak"] == pytest.approx(np.abs(error[1:]).max(), rel=1e-6)
    means = error[1:].reshape(-1, 50).mean(axis=1)
    assert result["cross_track_walked"] == pytest.approx(np.abs(means).max(), rel=1e-6)
    free, _ = measure(stream(401, position=path(error, -0.08 * TIME)), rate=2.0)
    assert np.isnan(free["cross_track_peak"])
    assert np.isnan(free["cross_track_walked"])


def test_a_run_that_was_never_measured_has_no_numbers():
    """Fallen during the warm-up: flagged, with zero duration and NaN instead of made-up zeros."""
    down = every_step(quaternion(roll=np.where(np.arange(401) < 50, 0.0, 1.5)))
    result, _ = measure(stream(401, orientation=down), begin=1.0)
    assert (result["fell"], result["diverged"], result["duration"]) == (1.0, 0.0, 0.0)
    for name in ("speed", "distance", "roll_mean", "yaw_max", "pitch_std", "slip", "duty_rear_left", "lateral_drift"):
        assert np.isnan(result[name]), name


# --- falls and divergence


@pytest.mark.parametrize("how", ["roll", "pitch", "height"])
def test_a_fall_is_kept_and_freezes_what_was_measured(how):
    """Beyond 60 degrees of tilt, or with the IMU on the ground, measuring ends for good, also if the robot gets up."""
    fall = (np.arange(401) >= 200) & (np.arange(401) < 250)
    position = path(0 * TIME, -0.08 * TIME)
    if how == "height":
        position[fall, :, 2] = 0.02
        readings = stream(401, position=position)
    else:
        readings = stream(401, position=position, orientation=every_step(quaternion(**{how: np.where(fall, 1.1, 0.0)})))
    result, history = measure(readings)
    assert (result["fell"], result["diverged"]) == (1.0, 0.0)
    assert result["duration"] == pytest.approx(1.99)
    assert result["distance"] == pytest.approx(0.08 * 1.99)
    assert result["speed"] == pytest.approx(0.08)
    assert abs(result["roll_max"]) < 1e-6
    np.testing.assert_array_equal(history.fell, np.arange(401) >= 200)
    for name in ("time", "work", "way", "mean", "square", "low", "high", "loaded", "slid"):
        frozen = getattr(history, name)[199:]
        np.testing.assert_array_equal(frozen, np.broadcast_to(frozen[0], frozen.shape), err_msg=name)


def test_a_deep_tilt_is_not_yet_a_fall():
    """50 degrees are still measured."""
    result, _ = measure(stream(101, orientation=quaternion(roll=np.radians(50))))
    assert result["fell"] == 0.0
    assert result["roll_max"] == pytest.approx(np.radians(50), abs=1e-6)


FIELDS = [field.name for field in dataclasses.fields(Sensors)]


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_divergence_is_kept_and_no_nan_reaches_the_accumulators(name, value):
    """One bad number, in any sensor and any step, ends the measuring for good; what was measured stays, and finite."""
    position = path(0 * TIME, -0.08 * TIME)
    readings = stream(401, position=position, orientation=quaternion(yaw=0.0, roll=0.1))
    getattr(readings, name)[200, 2] = value
    result, history = measure(readings)
    assert (result["fell"], result["diverged"]) == (0.0, 1.0)
    np.testing.assert_array_equal(history.diverged, np.arange(401) >= 200)
    assert result["duration"] == pytest.approx(1.99)
    assert result["distance"] == pytest.approx(0.08 * 1.99)
    assert result["roll_mean"] == pytest.approx(0.1, abs=1e-6)
    assert result["roll_std"] == pytest.approx(0.0, abs=1e-6)
    for leaf in jax.tree.leaves(history):
        assert np.isfinite(leaf[1:]).all()


def test_an_absurd_speed_is_a_divergence():
    """Finite numbers that are no robot's count as diverged too."""
    velocity = np.zeros((101, STEPS, 3))
    velocity[50, 1] = 0.0, 2 * metrics.DIVERGED_SPEED, 0.0
    result, _ = measure(stream(101, linear_velocity=velocity))
    assert result["diverged"] == 1.0
    assert result["duration"] == pytest.approx(0.49)


def test_every_metric_has_a_unit_and_a_meaning():
    """What `result` returns is what `METRICS` describes."""
    result, _ = measure(stream(11))
    assert set(result) == set(METRICS)
    assert all(metric.unit and metric.doc for metric in METRICS.values())
