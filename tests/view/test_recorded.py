# Tests of view/recorded.py, view/clip.py
"""Attitude, means over a gait cycle, and quaternions of a recording."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from nermo_mjx.view.clip import without_jumps
from nermo_mjx.view.recorded import _over_cycle, attitude_of, spans


def test_the_attitude_is_that_of_scipy_in_degrees_with_a_yaw_without_jumps():
    """Intrinsic z-x-y Euler angles; yaw goes on beyond half a turn."""
    time = np.linspace(0.0, 1.0, 200)
    angles = np.stack([7.0 * time, 0.8 * np.sin(9 * time), 1.5 * np.cos(5 * time)], axis=1)
    quaternions = Rotation.from_euler("ZXY", angles).as_quat(scalar_first=True)
    np.testing.assert_allclose(attitude_of(quaternions), np.rad2deg(angles[:, ::-1]), atol=1e-9)


def test_the_mean_over_a_cycle_is_shown_where_the_whole_cycle_was_recorded():
    """Of t + sin(2 pi t / T) it is t; half a cycle at either end has no number."""
    time, period = np.linspace(1.0, 3.0, 2001), 0.5
    mean = _over_cycle(time + np.sin(2 * np.pi * time / period), time, period)
    has_full_cycle = (time >= 1.25 - 1e-9) & (time <= 2.75 + 1e-9)
    np.testing.assert_allclose(mean[has_full_cycle], time[has_full_cycle], atol=1e-6)
    assert np.isnan(mean[~has_full_cycle]).all()
    assert (~has_full_cycle).sum() == 500
    assert np.isnan(_over_cycle(np.ones(1), np.zeros(1), period)).all()


def test_quaternions_without_jumps_are_the_same_rotations_and_never_far_from_the_one_before():
    """Signs change twice in a row, once, and for a whole stretch."""
    turns = Rotation.from_rotvec(np.linspace(0.0, 4.0, 40)[:, None] * [0.2, 0.5, 0.8])
    smooth = turns.as_quat(scalar_first=True)
    signs = np.ones(40)
    signs[[5, 6, 9]] = -1.0
    signs[20:33] = -1.0
    flipped = np.stack([smooth * signs[:, None], smooth], axis=1)
    steady = without_jumps(flipped)
    assert ((steady[1:] * steady[:-1]).sum(axis=-1) > 0.9).all()
    for i in range(2):
        residual_rotation = Rotation.from_quat(steady[:, i], scalar_first=True) * turns.inv()
        np.testing.assert_allclose(residual_rotation.magnitude(), 0.0, atol=1e-12)


def test_a_stretch_lasts_from_the_sample_before_it():
    """A sample stands for the time since the sample before."""
    time = np.arange(1, 7) * 0.1
    intervals = spans(np.array([True, False, True, True, False, True]), time)
    np.testing.assert_allclose(intervals, [(0.0, 0.1), (0.2, 0.2), (0.5, 0.1)])
