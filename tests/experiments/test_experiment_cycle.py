# Tests of experiments/walks.py
"""What is taken from the course over a gait cycle, on made-up walks whose answer is known."""

import types

import numpy as np
import pytest

from nermo_mjx.experiments.walks import CYCLE, PARTS, folded, of_world, pitch_course, rear_slip
from nermo_mjx.robot import LIMBS
from nermo_mjx.rollout import Run

OFFSETS = dict(zip(LIMBS, (0.5, 0.0, 0.0, 0.5), strict=True))
MIDDLE = (np.arange(PARTS) + 0.5) / PARTS


def test_folding_takes_away_noise_mean_and_drift():
    random = np.random.default_rng(0)
    phase = np.arange(0.0, 40.0, 0.01)
    walk = (
        0.3
        + 0.002 * phase
        + 0.05 * np.sin(2 * np.pi * phase)
        + random.normal(0.0, 0.02, len(phase))
    )
    np.testing.assert_allclose(folded(phase, walk), 0.05 * np.sin(2 * np.pi * MIDDLE), atol=0.01)


@pytest.mark.parametrize("cycles", [1, 2, 3])
def test_peaks_are_counted_over_the_seam_of_the_cycle_too(cycles):
    course = 0.04 * np.cos(2 * np.pi * cycles * MIDDLE) + 0.001 * np.cos(2 * np.pi * 17 * MIDDLE)
    found = pitch_course(course - course.mean(), 0.5, [0.5, 0.0, 0.0, 0.5])
    assert found["pitch_peaks"] == cycles


def test_a_torso_that_does_not_pitch_has_no_peak():
    assert pitch_course(np.zeros(PARTS), 0.5, [0.0, 0.5])["pitch_peaks"] == 0.0


def test_nose_up_is_up_and_the_lift_off_is_a_quarter_cycle():
    """Positive pitch is nose down. A leg of offset 0 and duty 0.6 lifts off at 0.6, so that 0.6 to 0.85 counts."""
    courses = (-0.03 * np.exp(-(((MIDDLE - where) / 0.03) ** 2)) for where in (0.71, 0.31))
    inside, outside = (pitch_course(course, 0.6, [0.0]) for course in courses)
    assert inside["pitch_peak_up"] == outside["pitch_peak_up"] == pytest.approx(0.03, abs=0.001)
    assert inside["pitch_lift_off"] == pytest.approx(0.03, abs=0.001)
    assert outside["pitch_lift_off"] == pytest.approx(0.0, abs=0.001)


def test_slip_is_that_of_loaded_rear_feet_by_the_part_of_their_stance():
    """A rear foot that slides at 10, 20 and 30 mm/s through its stance, and at 30 until it is off the ground."""
    phase = np.arange(0.0, 5.0, 1e-3)
    force, velocity = np.zeros((len(phase), 4)), np.zeros((len(phase), 4, 3))
    for i, limb in enumerate(LIMBS):
        since = (phase - OFFSETS[limb]) % 1.0
        force[:, i] = since < 0.55
        velocity[:, i, 1] = np.select([since < 0.5 / 3, since < 1.0 / 3], [0.01, 0.02], 0.03)
        velocity[:, i, 2] = 9.0
    # Front feet, and what moves without a load, do not count.
    velocity[:, :2, 0] = 5.0
    velocity[force == 0.0] = 7.0
    found = rear_slip(phase, force, velocity, 0.5, OFFSETS)
    assert list(found.values()) == pytest.approx([0.01, 0.02, 0.03], rel=1e-9)


def test_a_walk_is_reduced_over_whole_cycles_after_the_warm_up():
    """Two nose-up peaks a cycle, and a yaw that goes with the spine; what happens in the warm-up does not count."""
    frequency, warmup = 0.8, 2.0
    time = 0.01 * np.arange(1, round(10 / frequency / 0.01) + 1)
    phase = 0.01 + frequency * time
    swing = np.sin(2 * np.pi * phase)
    pitch, yaw = 0.02 * np.cos(4 * np.pi * phase), 0.1 * swing
    pitch[phase < warmup] = 1.0
    half = 0.5 * np.stack([pitch, yaw], axis=-1)
    # Rz(yaw) Rx(pitch), as attitude has it.
    (cx, sx), (cz, sz) = ((np.cos(h), np.sin(h)) for h in half.T)
    servo = np.zeros((len(time), 10))
    servo[:, 8] = 0.4 * swing
    sensors = {
        "orientation": np.stack([cz * cx, cz * sx, sz * sx, sz * cx], axis=-1),
        "servo_angle": servo,
        "foot_force": np.ones((len(time), 4)),
        "foot_velocity": np.zeros((len(time), 4, 3)),
    }
    trace = types.SimpleNamespace(
        time=time, sensors={name: values[None] for name, values in sensors.items()}
    )
    values = {"frequency": frequency, "tracking.clock_ratio": 1.0, "start.phase": 0.01, "duty": 0.5}
    values |= {f"offset.{limb}": offset for limb, offset in OFFSETS.items()}
    found = of_world(trace, 0, values, Run(cycles=10.0, warmup_cycles=warmup))
    assert set(found) == set(CYCLE)
    assert found["pitch_peaks"] == 2.0
    assert found["pitch_peak_up"] == pytest.approx(0.02, rel=0.02)
    assert found["yaw_spine_correlation"] == pytest.approx(1.0, abs=1e-3)
    still = of_world(
        types.SimpleNamespace(
            time=time, sensors=trace.sensors | {"servo_angle": np.zeros((1, len(time), 10))}
        ),
        0,
        values,
        Run(cycles=10.0, warmup_cycles=warmup),
    )
    assert np.isnan(still["yaw_spine_correlation"])
