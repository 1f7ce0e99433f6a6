# Tests of cli/options.py
"""Assignments of parameters on the command line."""

from __future__ import annotations

import pytest

from nermo_mjx import all_parameters
from nermo_mjx.cli.options import assigned
from nermo_mjx.cli.output import WrongUse


def test_the_last_assignment_of_a_parameter_wins() -> None:
    parameters = all_parameters()
    assert assigned(["frequency=0.5", "frequency = 0.8"], parameters) == {"frequency": 0.8}
    values = assigned(["stiffness.*=0.5", "stiffness.spine=1.5", "spine.phase=90 deg"], parameters)
    assert (values["stiffness.spine"], values["stiffness.ankle"]) == (1.5, 0.5)
    assert values["spine.phase"] == pytest.approx(1.5707963)
    with pytest.raises(WrongUse, match="--set frequency: expected NAME=VALUE"):
        assigned(["frequency"], parameters)
