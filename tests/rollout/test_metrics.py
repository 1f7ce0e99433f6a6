# Tests of rollout/metrics.py, rollout/stride_metrics.py, rollout/path_metrics.py, rollout/electrical.py
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
from nermo_mjx.kinematics.body import attitude, uprightness
from nermo_mjx.robot import LIMBS, ModelParameters, Sensors
from nermo_mjx.rollout import METRICS, electrical, metrics
from nermo_mjx.rollout.setup import Window

STEPS, DT, RATE, MASS, SERVOS = 5, 0.01, 1.0, 0.27, 10
#: Index of the neck's servo.
NECK = 9
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
        "position": np.array([0.0, 0.0, HEIGHT]),
        "orientation": np.array([1.0, 0.0, 0.0, 0.0]),
        "linear_velocity": np.zeros(3),
        "gyro": np.zeros(3),
        "accelerometer": np.array([0.0, 0.0, 9.81]),
        "servo_angle": np.zeros(SERVOS),
        "servo_velocity": np.zeros(SERVOS),
        "servo_torque": np.zeros(SERVOS),
        "knee_angle": np.ones(4),
        "foot_force": np.full(4, 0.66),
        "foot_position": np.zeros((4, 3)),
        "foot_velocity": np.zeros((4, 3)),
        "joint_velocity": np.zeros(12),
        "tail_force": np.zeros(()),
        "contact_distance": np.full((), -1e-4),
    }
    return Sensors(
        **{
            name: np.array(np.broadcast_to(readings.get(name, value), (ticks, STEPS, *value.shape)))
            for name, value in still.items()
        }
    )


def every_step(values: np.ndarray) -> np.ndarray:
    """Readings of one a tick, (ticks, ...), repeated for the tick's steps."""
    return values[:, None]


def _run(on_line: bool) -> Any:
    """Metrics and the accumulators' history, of a window, readings, the gait's frequency and the servos' back-EMF."""

    def run(window, readings, rate, back_emf=0.0):
        servo = dataclasses.replace(ModelParameters().servo, back_emf=back_emf)

        def tick(state, now):
            time, sensors = now
            beside = straight(Pilot(), sensors.position[-1]) if on_line else None
            # A trot on the spot: each diagonal pair is commanded to stand for half a cycle.
            stance = jnp.sin(2 * jnp.pi * RATE * time) * jnp.array([1.0, -1.0, -1.0, 1.0]) >= 0.0
            tick_record = metrics.Tick(
                sensors, time, DT, rate, beside, stance, brake=servo.brake, servo=servo
            )
            state = metrics.update(window, state, tick_record)
            return state, state

        # As in the loop: the first reading is that at rest, at time 0, and belongs to no tick.
        start = metrics.init(jax.tree.map(lambda leaf: leaf[0, -1], readings))
        state, history = jax.lax.scan(
            tick, start, (DT * np.arange(len(readings.position)), readings)
        )
        supply = electrical.Supply(servo, ModelParameters().battery, ModelParameters().damping)
        return metrics.result(state, jnp.asarray(MASS), supply=supply), history

    return run


@functools.cache
def _program(on_line: bool) -> Any:
    return jax.jit(_run(on_line))


def measure(
    readings: Sensors,
    rate: float = RATE,
    on_line: bool = False,
    back_emf: float = 0.0,
    **window: float,
) -> tuple[dict[str, float], Any]:
    """Metrics of a stream, and the accumulators after every tick; the first tick of a stream is the state at rest.

    `on_line`: beside the straight pilot's line, instead of without a path.
    """
    with jax.enable_x64(True):
        result, history = _program(on_line)(
            limits(**window), readings, np.float64(rate), np.float64(back_emf)
        )
        return {name: float(value) for name, value in result.items()}, jax.tree.map(
            np.asarray, history
        )


def limits(begin: float = 0.0, end: float = 1e6, distance: float = 1e6) -> Window:
    return Window(begin=np.float64(begin), end=np.float64(end), distance=np.float64(distance))


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
    roll, pitch, yaw = (
        Rotation.from_quat(q, scalar_first=True) for q in (about_y, about_x, about_z)
    )
    assert roll.apply(up)[0] > 0.1
    assert pitch.apply(nose)[2] < -0.1
    assert yaw.apply(nose)[0] > 0.1


def test_uprightness():
    """The uprightness is the cosine between the torso's z and the world's."""
    rng = np.random.default_rng(1)
    turns = Rotation.random(50, random_state=rng)
    with jax.enable_x64(True):
        quaternions = jnp.asarray(turns.as_quat(scalar_first=True))
        np.testing.assert_allclose(
            uprightness(quaternions), turns.apply([0, 0, 1])[:, 2], atol=1e-12
        )


# --- way, speed, drift


def test_a_straight_walk():
    """0.08 m/s along the heading for 4 s: speed, distance and duration are exact, and nothing else is measured."""
    result, _ = measure(stream(401, position=path(0 * TIME, -0.08 * TIME)))
    assert set(result) == set(METRICS)
    assert result["duration"] == pytest.approx(4.0)
    assert result["distance"] == pytest.approx(0.32)
    assert result["speed"] == pytest.approx(0.08)
    zero = ["lateral_drift", "slip", "servo_work", "cost_of_transport", "fell", "diverged"]
    zero += [
        f"{angle}_{what}"
        for angle in ("roll", "pitch", "yaw")
        for what in ("mean", "std", "min", "max")
    ]
    assert {name: result[name] for name in zero} == pytest.approx(
        dict.fromkeys(zero, 0.0), abs=2e-6
    )
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
    result, _ = measure(
        stream(401, position=position, orientation=orientation), rate=rate, begin=1.5, end=4.0
    )
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
    assert result["turn_rate"] == pytest.approx(side * turn_rate, rel=1e-4)
    low, high = sorted((side * 3 * np.pi, 0.0))
    assert result["turn_rate"] == pytest.approx(side * turn_rate, rel=1e-4)
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
    orientation = every_step(
        quaternion(**{name: mean + size * wave for name, (mean, size) in angles.items()})
    )
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
    torque[:4], speed[:4] = (
        (0.1, -0.05, 0.1, -0.1),
        (2.0, -3.0, -2.0, 0.0),
    )  # drives, drives, brakes, holds
    readings = stream(
        401, servo_torque=torque, servo_velocity=speed, position=path(0 * TIME, -0.05 * TIME)
    )
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


def test_power_is_what_heats_the_windings_and_what_drives():
    """Of ten servos one is stalled, one holds half of that, one drives with a quarter of it, one is driven back."""
    torque, speed = np.zeros(SERVOS), np.zeros(SERVOS)
    torque[:4], speed[:4] = 0.157 * np.array([1.0, -0.5, 0.25, 0.01]), (0.0, 0.0, 10.0, -10.0)
    result, _ = measure(
        stream(
            401, servo_torque=torque, servo_velocity=speed, position=path(0 * TIME, -0.05 * TIME)
        )
    )
    idle, rise = SERVOS * 0.008, 0.8 - 0.008
    power = 6.0 * idle + 6.0 * rise * (1.0 + 0.25 + 0.0625) + 0.157 * 0.25 * 10.0
    assert result["motor_current"] == pytest.approx(idle + 1.76 * rise)
    assert result["electrical_power"] == pytest.approx(power)
    assert result["servo_current"] == pytest.approx(power / 6.0)
    assert result["charge"] == pytest.approx(4.0 * power / 6.0)
    assert result["battery_time"] == pytest.approx(3600.0 / (power / 6.0 + 0.3))
    assert result["electrical_cost_of_transport"] == pytest.approx(
        4.0 * power / (MASS * 9.81 * 0.2)
    )


@pytest.mark.parametrize(
    ("share", "left", "drawn"),
    [(0.5, 0.5, 0.5), (1.5, -0.5, 0.0)],
    ids=["half the no-load speed", "above the no-load speed"],
)
def test_the_back_emf_takes_torque_and_current(share, left, drawn):
    """At half the no-load speed and full voltage, half the stall torque is left, and half the stall current flows."""
    torque, speed = np.zeros(SERVOS), np.zeros(SERVOS)
    torque[3], speed[3] = 0.157, share * 6.0 / 0.4
    result, _ = measure(stream(401, servo_torque=torque, servo_velocity=speed), back_emf=0.4)
    idle, rise = SERVOS * 0.008, 0.8 - 0.008
    assert result["servo_work"] == pytest.approx(max(left, 0.0) * 0.157 * speed[3] * 4.0)
    assert result["motor_current"] == pytest.approx(idle + abs(left) * rise)
    assert result["servo_current"] == pytest.approx(idle + drawn * rise)


@pytest.mark.parametrize("limit", [0.01, 0.157, 2.0])
@pytest.mark.parametrize("stall", [0.0, 0.008, 0.8, 10.0])
@pytest.mark.parametrize("back_emf", [0.0, 0.4, 2.0])
def test_power_is_at_least_work_whatever_the_motor(limit, stall, back_emf):
    """An optimizer would find a motor that gives more than it takes."""
    random = np.random.default_rng(0)
    servo = dataclasses.replace(
        ModelParameters().servo, torque_limit=limit, stall_current=stall, back_emf=back_emf
    )
    torque, speed = (
        limit * random.uniform(-1.0, 1.0, (STEPS, 40)),
        random.uniform(-20.0, 20.0, (STEPS, 40)),
    )
    sums = electrical.power_sums(torque, speed, servo)
    power = electrical.electrical_result(
        sums, 1.0, electrical.Supply(servo, ModelParameters().battery, ModelParameters().damping)
    )["electrical_power"]
    assert power >= np.maximum(torque * speed, 0.0).sum(axis=1).mean()


def test_time_without_contact_and_the_deepest_contact():
    """In the air in one tick of four; the deepest contact counts from the start, the time in the air as measured."""
    distance = np.full((401, STEPS), -0.001)
    distance[::4], distance[5, 2] = 0.0, -0.003
    result, _ = measure(stream(401, contact_distance=distance))
    assert result["airborne_time"] == pytest.approx(0.25)
    assert result["penetration"] == pytest.approx(0.003)
    assert result["sunk_time"] == 0.0


def test_endings_say_what_is_no_walk():
    table = {
        name: np.zeros(7)
        for name in ("fell", "diverged", "penetration", "sunk_time", "airborne_time")
    }
    table["fell"][:1], table["diverged"][1], table["penetration"][:3], table["sunk_time"][3] = (
        1,
        1,
        0.0061,
        0.06,
    )
    table["airborne_time"][3:5] = 0.51
    named = metrics.endings(table, np.array([True] * 6 + [False]))
    assert named.tolist() == ["fell", "diverged", "sank", "sank", "floated", "unsolved", "ok"]


def test_cost_of_transport_needs_a_distance():
    """A robot that works on the spot has none."""
    result, _ = measure(
        stream(101, servo_torque=np.full(SERVOS, 0.1), servo_velocity=np.ones(SERVOS))
    )
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
    assert [result[f"slip_{limb}"] for limb in LIMBS[:2]] == pytest.approx([0.05, 0.1])
    assert np.isnan([result[f"slip_{limb}"] for limb in LIMBS[2:]]).all()
    assert (result["loaded_front"], result["loaded_rear"]) == pytest.approx((0.7, 0.0))


@pytest.mark.parametrize(("neck", "rates"), [(0.0, (0.3, 5.0, 0.4)), (np.pi / 2, (5.0, 0.3, 0.4))])
def test_a_roll_of_the_head_moves_no_picture(neck, rates):
    """Pitch and yaw rates of 0.3 and 0.4 rad/s move the image by 0.5 rad/s, whatever the rate about the line of sight.

    A head that is turned to the left looks along the torso's x, so that the torso's roll is the head's pitch.
    """
    angle = np.zeros(SERVOS)
    angle[NECK] = neck
    result, _ = measure(stream(51, gyro=np.array(rates), servo_angle=angle))
    assert result["picture_motion"] == pytest.approx(0.5, rel=1e-6)


def test_loads_are_shared_by_feet_and_tail():
    """Mean forces by limb, the front's share of the feet's load, and the tail's of all; the tail's share of time."""
    force, tail = np.zeros((101, STEPS, 4)), np.zeros((101, STEPS))
    force[..., :] = 0.5, 0.7, 0.3, 0.5
    tail[1:26, :] = 0.4  # a quarter of the time
    result, _ = measure(stream(101, foot_force=force, tail_force=tail))
    assert [result[f"load_{limb}"] for limb in LIMBS] == pytest.approx([0.5, 0.7, 0.3, 0.5])
    assert result["front_load_share"] == pytest.approx(1.2 / 2.0)
    assert result["tail_time"] == pytest.approx(0.25)
    assert result["tail_load_share"] == pytest.approx(0.1 / 2.1)


def test_feet_loaded_in_their_swing_are_seen():
    """The made-up trot has FL and RR stand in the first half of a cycle: FL, always loaded, is so in all its swing.

    RR bears only while it is commanded to stand, FR in a quarter of its swing.
    """
    phase = (RATE * TIME[:201]) % 1.0
    force = np.zeros((201, STEPS, 4))
    force[..., 0] = 0.6
    force[..., 3] = np.where(phase < 0.5, 0.6, 0.0)[:, None]
    force[..., 1] = np.where(phase < 0.125, 0.6, 0.0)[:, None]
    result, _ = measure(stream(201, foot_force=force))
    assert result["swing_loaded_front"] == pytest.approx((1.0 + 0.25) / 2, abs=0.02)
    assert result["swing_loaded_rear"] == pytest.approx(0.0, abs=0.02)


def test_a_touch_is_no_load():
    """Below the lighter of `LOADED` nothing counts; a robot that never bears on a foot has no slip, rather than 0."""
    result, _ = measure(stream(101, foot_force=np.full(4, 0.99 * metrics.LOADED[0])))
    assert [result[f"duty_{limb}"] for limb in LIMBS] == [0.0] * 4
    assert np.isnan(result["slip"])


@pytest.mark.release
def test_a_light_load_counts_in_part():
    """Nothing at the lighter of `LOADED`, all from the heavier on, half midway, without a jump or a kink between."""
    light, heavy = metrics.LOADED
    force = np.linspace(0.0, 2 * heavy, 601)
    share = np.array(
        [
            [measure(stream(11, foot_force=four))[0][f"duty_{limb}"] for limb in LIMBS]
            for four in np.append(force, [heavy] * 3).reshape(-1, 4)
        ]
    ).ravel()[:601]
    assert np.interp([light, 0.5 * (light + heavy), heavy], force, share) == pytest.approx(
        [0.0, 0.5, 1.0], abs=1e-9
    )
    assert (share[force >= heavy] == 1.0).all()
    slope = np.gradient(share, force)
    assert (slope >= -1e-9).all()
    assert slope.max() == pytest.approx(1.5 / (heavy - light), rel=1e-2)  # of a smoothstep
    assert np.abs(np.diff(slope)).max() < 0.05 * slope.max()


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
    assert whole["duration"] == pytest.approx(2.0)
    assert whole["distance"] == pytest.approx(0.16)
    assert whole["speed"] == pytest.approx(0.08)
    late, _ = measure(readings, rate=2.0, distance=0.15, begin=0.8)
    assert late["duration"] == pytest.approx(1.5)
    assert late["speed"] == pytest.approx(0.08)


def test_measuring_stops_between_two_ticks_where_the_cycle_does():
    """0.7 Hz: a cycle is 142.86 ticks."""
    readings = stream(401, position=path(0.01 * TIME, -0.08 * TIME))
    result, history = measure(readings, rate=0.7, distance=0.15)
    assert result["duration"] == pytest.approx(2 / 0.7)
    assert result["distance"] == pytest.approx(0.08 * 2 / 0.7)
    assert result["lateral_drift"] == pytest.approx(0.01 * 2 / 0.7)
    np.testing.assert_array_equal(history.finished, TIME >= 2 / 0.7)
    assert (history.path.cycles[-1], history.path.time[-1]) == (2.0, 0.0)


# --- paths


@pytest.mark.parametrize(("radius", "angle"), [(0.08, 3.0), (0.3, 2.0), (1.0, 0.6)])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_turning_radius_is_that_of_the_circle_walked(radius, angle, side):
    turn = angle * TIME / TIME[-1]
    x, y = side * radius * (1 - np.cos(turn)), -radius * np.sin(turn)
    result, _ = measure(stream(401, position=path(3.0 + x, y - 5.0)), rate=20.0)
    # The mean position of a cycle that turns by b lies on a circle smaller by sinc(b / 2).
    assert result["turning_radius"] == pytest.approx(
        radius * np.sinc(angle / 80 / 2 / np.pi), rel=1e-4
    )


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


def test_the_turn_rate_is_that_between_the_ends_of_what_is_measured():
    """A turn of 0.3 rad/s after a warm-up without one, its sway of whole cycles left out; the end lies in a tick."""
    yaw = 0.3 * np.maximum(TIME - 0.5, 0.0) + 0.2 * np.sin(2 * np.pi * 2.0 * TIME)
    result, _ = measure(
        stream(401, orientation=every_step(quaternion(yaw))), rate=2.0, begin=0.5, end=1.5
    )
    assert result["turn_rate"] == pytest.approx(0.3, rel=1e-3)


def test_sway_counts_in_the_peak_of_the_error_and_not_in_the_way_walked():
    """A drift of 2 mm a second and a sway of 10 mm at 2 cycles a second; the oracle is NumPy on the same numbers."""
    error = 0.002 * TIME + 0.010 * np.cos(2 * np.pi * 2.0 * TIME)
    result, _ = measure(stream(401, position=path(error, -0.08 * TIME)), rate=2.0, on_line=True)
    assert result["cross_track_peak"] == pytest.approx(np.abs(error[1:]).max(), rel=1e-6)
    assert result["cross_track_rms"] == pytest.approx(np.sqrt(np.mean(error[1:] ** 2)), rel=1e-6)
    means = error[1:].reshape(-1, 50).mean(axis=1)
    assert result["cross_track_walked"] == pytest.approx(np.abs(means).max(), rel=1e-6)
    sway = error[1:] - np.repeat(means, 50)
    assert result["cross_track_noise"] == pytest.approx(np.sqrt(np.mean(sway**2)), rel=1e-5)
    free, _ = measure(stream(401, position=path(error, -0.08 * TIME)), rate=2.0)
    assert all(np.isnan(free[f"cross_track_{what}"]) for what in ("peak", "rms", "walked", "noise"))


# --- within a tick, and derivatives


def lively(seed: int, ticks: int = 201) -> Sensors:
    """A walk in which everything changes smoothly from tick to tick, along a bend to the left."""
    random, time = np.random.default_rng(seed), TIME[:ticks]

    def wave(size: float, *shape: int) -> np.ndarray:
        parts = random.normal(size=(3, *shape)) * size / 3
        pulse = np.multiply.outer(2 * np.pi * random.uniform(0.3, 2.0, 3), time) + random.uniform(
            0, 6, (3, 1)
        )
        return np.einsum("kt,k...->t...", np.sin(pulse), parts)

    turn = 0.6 * time + wave(0.1)
    x, y = 0.2 * (1 - np.cos(turn)) + wave(0.01), -0.2 * np.sin(turn) + wave(0.01)
    return stream(
        ticks,
        position=path(x, y),
        orientation=every_step(quaternion(turn, wave(0.1), wave(0.1))),
        servo_torque=every_step(wave(0.2, SERVOS)),
        servo_velocity=every_step(wave(2.0, SERVOS)),
        foot_force=every_step(0.02 + wave(0.04, 4)),
        foot_velocity=every_step(wave(0.1, 4, 3)),
        contact_distance=np.linspace(-0.002, -0.001, STEPS) + every_step(wave(0.0005)),
    )


def integral(values: np.ndarray, until: float) -> Any:
    """From 0 to `until` of readings (ticks, ...) that stand for the tick before them."""
    sums = np.concatenate([[0.0 * values[0]], np.cumsum(DT * values[1:], axis=0)])
    return np.stack(
        [
            np.interp(until, TIME[: len(values)], column)
            for column in sums.reshape(len(values), -1).T
        ]
    )


@pytest.mark.parametrize("seed", range(12))
def test_a_window_may_begin_and_end_within_a_tick(seed):
    """NumPy is the oracle, on readings that stand for their tick, positions and extremes that go straight in it."""
    random, readings = np.random.default_rng(seed), lively(seed)
    begin = random.uniform(0.0, 0.8) if seed else 0.0
    end, rate = random.uniform(begin + 0.5, 2.0), random.uniform(1.0, 8.0)
    result, history = measure(readings, rate=rate, on_line=True, begin=begin, end=end)
    free, _ = measure(readings, rate=rate, begin=begin, end=end)
    time, near = TIME[:201], {"rel": 1e-9, "abs": 1e-9}

    def mean(values: np.ndarray) -> Any:
        return (integral(values, end) - integral(values, begin)) / (end - begin)

    def seen(values: np.ndarray) -> np.ndarray:
        inner = time[(time > begin + DT) & (time < end)]
        return np.interp(np.concatenate([[begin + DT], inner, [end]]), time, values)

    angles = Rotation.from_quat(readings.orientation[:, -1], scalar_first=True).as_euler("ZXY")[
        :, ::-1
    ]
    for name, angle in zip(("roll", "pitch", "yaw"), angles.T, strict=True):
        assert result[f"{name}_mean"] == pytest.approx(mean(angle)[0], **near)
        assert result[f"{name}_std"] == pytest.approx(
            np.sqrt(mean(angle**2)[0] - mean(angle)[0] ** 2), rel=1e-6
        )
        assert result[f"{name}_min"] == pytest.approx(seen(angle).min(), **near)
        assert result[f"{name}_max"] == pytest.approx(seen(angle).max(), **near)

    x, y = readings.position[:, -1, :2].T
    assert result["duration"] == pytest.approx(end - begin, **near)
    assert result["lateral_drift"] == pytest.approx(
        np.diff(np.interp([begin, end], time, x))[0], **near
    )
    assert result["distance"] == pytest.approx(
        -np.diff(np.interp([begin, end], time, y))[0], **near
    )
    ahead = np.stack([np.sin(history.course), -np.cos(history.course)])[:, 1:]
    way = np.concatenate([[0.0], np.cumsum((np.diff([x, y]) * ahead).sum(axis=0))])
    assert free["distance"] == pytest.approx(np.diff(np.interp([begin, end], time, way))[0], **near)

    power = (
        np.maximum(readings.servo_torque * readings.servo_velocity, 0.0).sum(axis=-1).mean(axis=-1)
    )
    assert result["servo_work"] == pytest.approx((end - begin) * mean(power)[0], **near)
    share = np.clip((readings.foot_force - 0.01) / 0.02, 0.0, 1.0)
    share = share**2 * (3 - 2 * share)
    speed = np.linalg.norm(readings.foot_velocity[..., :2], axis=-1)
    duty, slid = mean(share.mean(axis=1)), mean((share * speed).mean(axis=1))
    assert [result[f"duty_{limb}"] for limb in LIMBS] == pytest.approx(duty, **near)
    assert result["slip"] == pytest.approx(slid.sum() / duty.sum(), rel=1e-6)

    assert result["cross_track_peak"] == pytest.approx(np.abs(seen(x)).max(), **near)
    assert result["cross_track_rms"] == pytest.approx(np.sqrt(mean(x**2)[0]), **near)
    cycles = int((end - begin) * rate)
    edges = begin + np.arange(cycles + 1) / rate
    means = rate * np.diff(
        [integral(np.stack([x, y], axis=-1), edge) for edge in edges], axis=0
    ).reshape(-1, 2)
    assert history.path.cycles[-1] == cycles
    assert result["cross_track_walked"] == pytest.approx(
        np.abs(means[:, 0]).max(initial=0.0), **near
    )
    if cycles < 3:
        assert np.isnan(free["turning_radius"])
        return
    # Kasa's fit: |p|^2 = 2 c p + constant.
    fit, *_ = np.linalg.lstsq(
        np.column_stack([2 * means, np.ones(cycles)]), (means**2).sum(axis=1), rcond=None
    )
    assert free["turning_radius"] == pytest.approx(
        np.sqrt(fit[2] + fit[0] ** 2 + fit[1] ** 2), rel=1e-6
    )


@pytest.mark.release
@pytest.mark.parametrize("cycles", [4, 5, 6])
def test_a_window_of_whole_cycles_has_them_all_whatever_the_rounding(cycles):
    """In single precision, as in a batch; every rate gives another rounding."""
    readings = jax.tree.map(np.float32, lively(0, ticks=401))
    rates = np.linspace(cycles / 3.2, cycles / 2.7, 101, dtype=np.float32)
    begin, end, distance = (
        np.asarray(edge / rates, np.float32) for edge in (1.0, 1.0 + cycles, 1e9)
    )
    window = Window(begin=begin, end=end, distance=distance)
    _, history = jax.jit(jax.vmap(_run(True), in_axes=(0, None, 0)))(window, readings, rates)
    assert (np.asarray(history.path.cycles)[:, -1] == cycles).all()


@pytest.mark.parametrize("late", [0.0, 0.004, 0.01])
def test_a_window_shorter_than_a_tick_has_numbers(late):
    result, _ = measure(lively(0), begin=0.5 + late, end=0.506 + late)
    assert result["duration"] == pytest.approx(0.006)
    missing = {name for name, value in result.items() if not np.isfinite(value)}
    # Below 1 mm there is no cost of transport, and in a moment not every foot swings.
    costs = {"cost_of_transport", "electrical_cost_of_transport"}
    assert missing == MAY_BE_NAN | costs | {"swing_loaded_front", "swing_loaded_rear"}


#: Metrics without a number in a run as it should be: without a failure, a path, a bend.
MAY_BE_NAN = {
    "failure_time",
    "turning_radius",
    "stride_length",
    "stride_length_cv",
    "stride_time",
    "stance_time",
    "duty_factor",
} | {f"cross_track_{what}" for what in ("peak", "rms", "walked", "noise")}


@functools.cache
def _derivative(on_line: bool) -> Any:
    """The metrics at (window, readings, rate), and their derivatives in a direction."""
    run = _run(on_line)
    return jax.jit(lambda point, towards: jax.jvp(lambda *point: run(*point)[0], point, towards))


@pytest.mark.release
@pytest.mark.parametrize("on_line", [True, False])
@pytest.mark.parametrize("whole_ticks", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_derivatives_are_those_of_finite_differences(seed, whole_ticks, on_line):
    """Of all metrics, towards other readings, ends of the window and frequency of the gait, all at once.

    Ends on a tick are kinks, and derivatives there those of a window that shrinks and cycles that shorten. An extreme
    that lies just there has one of its own.
    """
    random, readings = np.random.default_rng(seed), lively(seed)
    window, rate = (
        (limits(0.5, 1.75), 4.0)
        if whole_ticks
        else (limits(*random.uniform((0.2, 1.5), (0.6, 1.9))), 3.7)
    )
    aside = jax.tree.map(
        lambda leaf: random.normal(size=leaf.shape) * (leaf.std() + 1e-3), readings
    )
    point, towards = (
        (window, readings, rate),
        (Window(begin=0.05, end=-0.07, distance=0.0), aside, 1.0),
    )

    with jax.enable_x64(True):
        point, towards = jax.tree.map(np.float64, (point, towards))

        def metrics_at(step: float) -> dict[str, Any]:
            values = jax.tree.map(lambda here, way: here + step * way, point, towards)
            return _program(on_line)(*values, np.float64(0.0))[0]

        step = 2e-7
        here, after, later = (jax.tree.map(float, metrics_at(step * i)) for i in range(3))
        slopes = jax.tree.map(float, _derivative(on_line)(point, towards)[1])
    for name, slope in slopes.items():
        expected = (4 * after[name] - later[name] - 3 * here[name]) / (2 * step)
        if np.isnan(here[name]):
            assert name in MAY_BE_NAN
        elif not (whole_ticks and name.endswith(("min", "max", "peak"))):
            assert slope == pytest.approx(expected, rel=1e-4, abs=1e-5), name


def nowhere(ticks: int) -> Sensors:
    return jax.tree.map(np.zeros_like, stream(ticks))


def lost(ticks: int) -> Sensors:
    readings = lively(3, ticks)
    readings.servo_torque[40:] = np.nan
    return readings


#: Readings of which some metrics have no number, or a root of nothing.
DEGENERATE = {
    "at rest": stream(61),
    "all readings zero": nowhere(61),
    "straight": stream(61, position=path(0 * TIME[:61], -0.08 * TIME[:61])),
    "a tilted line": stream(61, position=path(0.02 * TIME[:61], -0.08 * TIME[:61])),
    "backward": stream(61, position=path(0 * TIME[:61], 0.08 * TIME[:61])),
    "off the ground": stream(61, foot_force=np.zeros(4)),
    "hardly on the ground": stream(61, foot_force=np.full(4, 0.01 + 1e-9)),
    "a bend": lively(3, 61),
    "a fall": stream(
        61, orientation=every_step(quaternion(roll=np.where(np.arange(61) < 40, 0.0, 1.5)))
    ),
    "a fall before it counts": stream(61, orientation=quaternion(roll=1.5)),
    "a divergence": lost(61),
}


@functools.cache
def _jacobian(on_line: bool) -> Any:
    run = _run(on_line)
    return jax.jit(jax.jacrev(lambda *point: run(*point)[0], argnums=(0, 1, 2)))


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize("on_line", [True, False])
@pytest.mark.parametrize("name", DEGENERATE)
def test_derivatives_are_finite(name, on_line):
    """In reverse, of every metric with respect to everything, beside metrics that are NaN by their meaning.

    In single precision, where squares underflow.
    """
    point = jax.tree.map(np.float32, (limits(0.1, 0.5), DEGENERATE[name], 10.0))
    for metric, slopes in _jacobian(on_line)(*point).items():
        for leaf in jax.tree.leaves(slopes):
            assert leaf.dtype == np.float32
            assert np.isfinite(leaf).all(), metric


def test_a_run_that_was_never_measured_has_no_numbers():
    """Fallen during the warm-up: flagged, with zero duration and NaN instead of made-up zeros."""
    down = every_step(quaternion(roll=np.where(np.arange(401) < 50, 0.0, 1.5)))
    result, _ = measure(stream(401, orientation=down), begin=1.0)
    assert (result["fell"], result["diverged"], result["duration"]) == (1.0, 0.0, 0.0)
    assert result["failure_time"] == pytest.approx(0.5)
    for name in (
        "speed",
        "distance",
        "roll_mean",
        "yaw_max",
        "pitch_std",
        "slip",
        "duty_rear_left",
        "lateral_drift",
    ):
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
        readings = stream(
            401,
            position=position,
            orientation=every_step(quaternion(**{how: np.where(fall, 1.1, 0.0)})),
        )
    result, history = measure(readings)
    assert (result["fell"], result["diverged"], result["failure_time"]) == (
        1.0,
        0.0,
        pytest.approx(2.0),
    )
    assert result["duration"] == pytest.approx(1.99)
    assert result["distance"] == pytest.approx(0.08 * 1.99)
    assert result["speed"] == pytest.approx(0.08)
    assert abs(result["roll_max"]) < 1e-6
    np.testing.assert_array_equal(history.fell, np.arange(401) >= 200)
    measured = {
        name: getattr(history, name) for name in ("time", "way", "mean", "square", "low", "high")
    }
    for name, values in (measured | history.sums).items():
        np.testing.assert_array_equal(
            values[199:], np.broadcast_to(values[199], values[199:].shape), err_msg=name
        )


def test_a_deep_tilt_is_not_yet_a_fall():
    """50 degrees are still measured."""
    result, _ = measure(stream(101, orientation=quaternion(roll=np.radians(50))))
    assert result["fell"] == 0.0
    assert result["roll_max"] == pytest.approx(np.radians(50), abs=1e-6)


#: Sensors that tell a divergence: all but the one whose numbers are the velocities' a step later.
FIELDS = [field.name for field in dataclasses.fields(Sensors) if field.name != "accelerometer"]


def test_an_accelerometer_alone_ends_nothing():
    """It need not be computed where nobody reads it; and nothing of it reaches the accumulators."""
    readings = stream(401, position=path(0 * TIME, -0.08 * TIME))
    whole, _ = measure(readings)
    readings.accelerometer[200:] = np.nan
    assert measure(readings)[0] == pytest.approx(whole, nan_ok=True)


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_divergence_is_kept_and_no_nan_reaches_the_accumulators(name, value):
    """One bad number, in any sensor and any step, ends the measuring for good; what was measured stays, and finite."""
    position = path(0 * TIME, -0.08 * TIME)
    readings = stream(401, position=position, orientation=quaternion(yaw=0.0, roll=0.1))
    getattr(readings, name)[200, 2] = value
    result, history = measure(readings)
    assert (result["fell"], result["diverged"], result["failure_time"]) == (
        0.0,
        1.0,
        pytest.approx(2.0),
    )
    np.testing.assert_array_equal(history.diverged, np.arange(401) >= 200)
    assert result["duration"] == pytest.approx(1.99)
    assert result["distance"] == pytest.approx(0.08 * 1.99)
    assert result["roll_mean"] == pytest.approx(0.1, abs=1e-6)
    assert result["roll_std"] == pytest.approx(0.0, abs=1e-6)
    for leaf in jax.tree.leaves(history):
        assert np.isfinite(leaf[1:]).all()


def failing(how: str, tick: int, ticks: int = 401) -> Sensors:
    """A straight walk that falls, or loses its numbers, in one tick, and goes on as it is then."""
    readings = stream(ticks, position=path(0 * TIME[:ticks], -0.08 * TIME[:ticks]))
    if how == "fall":
        readings.orientation[tick:] = quaternion(roll=1.5)
    else:
        readings.gyro[tick:] = np.nan
    return readings


@pytest.mark.parametrize("how", ["fall", "divergence"])
@pytest.mark.parametrize(
    ("end", "last"), [(2.0, 200), (2.004, 201), (1.9999, 200), (1.99 + 1e-9, 199)]
)
def test_what_happens_after_the_run_does_not_count(how, end, last):
    """The tick in which the run ends is the last that is judged; the next one fails a world that its batch drags on."""
    during, _ = measure(failing(how, last), end=end)
    assert during["fell"] + during["diverged"] == 1.0
    assert during["failure_time"] == pytest.approx(last * DT)
    after, history = measure(failing(how, last + 1), end=end)
    whole, _ = measure(stream(401, position=path(0 * TIME, -0.08 * TIME)), end=end)
    assert after == pytest.approx(whole, abs=1e-4, nan_ok=True)
    assert np.isnan(after["failure_time"])
    assert all(np.isfinite(leaf[1:]).all() for leaf in jax.tree.leaves(history))


@pytest.mark.parametrize("how", ["fall", "divergence"])
def test_what_happens_after_the_distance_does_not_count(how):
    """The cycle that covers 0.15 m ends at 2.0 s; the robot that fails half a second later has arrived."""
    result, _ = measure(failing(how, 250), rate=2.0, distance=0.15)
    assert (result["fell"], result["diverged"], result["duration"]) == (
        0.0,
        0.0,
        pytest.approx(2.0),
    )
    assert np.isnan(result["failure_time"])


def test_the_first_failure_is_the_one_that_counts():
    """A robot that fell and whose numbers are lost afterwards fell, however long its batch goes on."""
    readings = failing("fall", 150)
    readings.gyro[160:] = np.nan
    result, _ = measure(readings)
    assert (result["fell"], result["diverged"], result["failure_time"]) == (
        1.0,
        0.0,
        pytest.approx(1.5),
    )


def test_an_absurd_speed_is_a_divergence():
    """Finite numbers that are no robot's count as diverged too."""
    velocity = np.zeros((101, STEPS, 3))
    velocity[50, 1] = 0.0, 2 * metrics.DIVERGED_SPEED, 0.0
    result, _ = measure(stream(101, linear_velocity=velocity))
    assert result["diverged"] == 1.0
    assert result["duration"] == pytest.approx(0.49)


@pytest.mark.release
def test_every_metric_has_a_unit_and_a_meaning():
    """What `result` returns is what `METRICS` describes."""
    result, _ = measure(stream(11))
    assert set(result) == set(METRICS)
    assert all(metric.unit and metric.doc for metric in METRICS.values())


# --- strides


def steps(lands: dict[str, list[float]], lifts: dict[str, list[float]]) -> np.ndarray:
    """Loads of the feet (ticks, 1, 4) that land and lift at these times; each is up at first."""
    down = np.zeros((len(TIME), 4))
    for i, limb in enumerate(LIMBS):
        for land, lift in zip(lands[limb], lifts[limb], strict=True):
            down[(land - 1e-9 < TIME) & (lift - 1e-9 > TIME), i] = 0.66
    return every_step(down)


def test_strides_go_from_touch_down_to_touch_down():
    """At 100 mm/s: lengths, times and stances as they were made up, with one spread of a population of four feet.

    A bounce at landing, a scrape in mid-swing and a short lift in mid-stance of less than a tenth of a cycle are none.
    """
    lands = {limb: [0.3, 1.2, 2.3, 3.2] for limb in LIMBS}
    lifts = {limb: [0.9, 1.8, 2.9, 3.8] for limb in LIMBS}
    bounced = {limb: sorted([*lands[limb], 0.36, 1.05, 2.6]) for limb in LIMBS}
    left = {limb: sorted([*lifts[limb], 0.33, 1.09, 2.54]) for limb in LIMBS}
    walked = {
        "position": path(np.zeros_like(TIME), -0.1 * TIME),
        "linear_velocity": np.array([0.0, -0.1, 0.0]),
    }
    for these, those, stance in (
        (lands, lifts, 0.6),
        (bounced, left, np.mean([0.57 + 0.04, 0.6, 0.54])),
    ):
        measured, _ = measure(stream(len(TIME), foot_force=steps(these, those), **walked), 1.0)
        assert measured["strides"] == 3
        assert measured["stride_time"] == pytest.approx(2.9 / 3, abs=1e-6)
        assert measured["stride_length"] == pytest.approx(0.1 * 2.9 / 3, rel=1e-3)
        assert measured["stride_length_cv"] == pytest.approx(
            np.std([0.9, 1.1, 0.9], ddof=1) / (2.9 / 3), rel=1e-2
        )
        assert measured["stance_time"] == pytest.approx(stance, abs=0.011)
        assert measured["duty_factor"] == pytest.approx(
            measured["stance_time"] / measured["stride_time"]
        )


def test_only_whole_strides_count_and_too_few_have_no_spread():
    """A stride that began before measuring does not count; of two there is no variability, of none no number at all."""
    lands = {limb: [0.3, 1.3, 2.3, 3.3] for limb in LIMBS}
    lifts = {limb: [0.9, 1.9, 2.9, 3.9] for limb in LIMBS}
    readings = stream(len(TIME), foot_force=steps(lands, lifts))
    two, _ = measure(readings, 1.0, begin=0.6)
    assert two["strides"] == 2
    assert two["stride_time"] == pytest.approx(1.0, abs=1e-6)
    assert np.isnan(two["stride_length_cv"])
    none, _ = measure(readings, 1.0, begin=0.6, end=2.2)
    assert none["strides"] == 0
    assert np.isnan(
        [none[name] for name in ("stride_time", "stride_length", "duty_factor", "stance_time")]
    ).all()
    standing, _ = measure(stream(len(TIME)), 1.0)
    assert standing["strides"] == 0
