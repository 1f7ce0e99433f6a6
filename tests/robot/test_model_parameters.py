# Tests of robot/model_parameters.py
"""Gravity in the frame of a slope."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nermo_mjx.robot.model_parameters import gravity_values, gravity_vector


@pytest.mark.parametrize(
    ("slope", "direction"), [(0.2, 0.0), (0.2, np.pi / 2), (-0.3, 0.7), (0.5, -2.5)]
)
def test_gravity_on_a_slope_is_that_of_the_level_world_seen_from_the_slope(slope, direction):
    """The slope's frame is turned about the level line across the rise, so that its axis ahead points upward."""
    ahead = np.array([np.sin(direction), -np.cos(direction), 0.0])
    frame = Rotation.from_rotvec(slope * np.cross(ahead, [0.0, 0.0, 1.0]))
    assert np.sign(frame.apply(ahead)[2]) == np.sign(slope)
    expected = frame.inv().apply([0.0, 0.0, -9.81])
    np.testing.assert_allclose(gravity_vector(9.81, slope, direction), expected, atol=1e-12)
    back = gravity_values(expected)
    np.testing.assert_allclose(gravity_vector(*back.values()), expected, atol=1e-12)
    assert back["ground.slope"] == pytest.approx(abs(slope))
