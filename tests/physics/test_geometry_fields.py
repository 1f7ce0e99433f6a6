# Tests of physics/geometry_fields.py
"""Parabolas through the ends of a parameter's range."""

from __future__ import annotations

import numpy as np

from nermo_mjx.physics.geometry_fields import _parabola


def test_a_parabola_has_the_slope_and_the_curvature_at_its_middle():
    """Of 3 x + 5 x^2 and of -2 x - x^2, from their values at two points on either side of 0."""
    slope, curve = np.array([3.0, -2.0]), np.array([5.0, -1.0])

    def at(x: float) -> np.ndarray:
        return slope * x + curve * x**2

    coefficients = _parabola(-0.1, at(-0.1), 0.3, at(0.3))
    np.testing.assert_allclose(coefficients, [slope, curve], rtol=1e-12)
