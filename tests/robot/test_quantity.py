# Tests of robot/quantity.py
"""Ranges of parameters, with open and closed bounds."""

from __future__ import annotations

import numpy as np
import pytest

from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.quantity import Quantity


@pytest.mark.parametrize(
    ("value", "closed", "opened"),
    [
        (1.0, True, False),
        (3.0, True, False),
        (np.float32(1.2), True, True),
        (np.nextafter(1.0, 2.0), True, True),
        (np.nextafter(3.0, 2.0), True, True),
        (0.9, False, False),
        (3.1, False, False),
        (np.nan, False, False),
        (np.inf, False, False),
        ([2.0, 1.0], True, False),
        ([2.0, 3.1], False, False),
    ],
)
def test_a_closed_range_contains_its_bounds_and_an_open_range_does_not(value, closed, opened):
    for is_open, allowed in ((False, closed), (True, opened)):
        quantity = Quantity(2.0, "m", 1.0, 3.0, "a length", open_low=is_open, open_high=is_open)
        if allowed:
            quantity.check("length", value)
        else:
            with pytest.raises(
                ParameterError, match=r"length is .*: allowed is (\(1, 3\)|\[1, 3\]) m\."
            ):
                quantity.check("length", value)
