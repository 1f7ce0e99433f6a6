"""The body alone: dimensions, mass, and the finite elements' load case, against their closed forms."""

import numpy as np
import pytest

from nermo_mjx.experiments import stands
from nermo_mjx.experiments.cases import Settings, texts
from nermo_mjx.experiments.published import compare
from nermo_mjx.robot import ParameterError


@pytest.fixture(scope="module")
def outcome():
    return stands.run_body(Settings())


def test_a_row_a_profile_and_the_same_in_both(outcome):
    assert outcome.columns["profile"].tolist() == ["exact", "as_published", "as_built"]
    for name in texts("columns")["body"]:
        assert outcome.columns[name][0] == outcome.columns[name][1], name
    assert set(outcome.columns) <= set(outcome.about)


@pytest.mark.parametrize(
    ("column", "angle"),
    [("bend_front_knee", 0.125 / 0.135), ("bend_rear_knee", 0.125 / 0.19), ("bend_spine", 4 * 0.125 / 1.2)],
)
def test_springs_bend_by_torque_over_stiffness(outcome, column, angle):
    """Table A.1: 0.135, 0.19 and four times 1.2 N m/rad in series."""
    assert outcome.mean(column, profile="exact") == pytest.approx(angle, rel=1e-3)


def test_another_spring_bends_otherwise():
    stiff = stands.run_body(Settings(("exact",), values={"stiffness.front_knee": 0.27}))
    assert stiff.mean("bend_front_knee", profile="exact") == pytest.approx(0.125 / 0.27, rel=1e-3)


def test_a_spine_of_little_damping_is_waited_for():
    """An identified body's spine still swings after the default one's time; the bend under load is the same."""
    soft = stands.run_body(Settings(("exact",), values={"damping.spine": 0.0034}))
    assert soft.mean("bend_spine") == pytest.approx(4 * 0.125 / 1.2, rel=1e-3)


def test_the_published_dimensions_are_the_robots(outcome):
    """Nermo-Lite: 270 g and 11 servos; Nermo: 405 x 91 x 90 mm, within a quarter; A.5: 121.9 mm between the axes."""
    assert outcome.mean("mass", profile="exact") == pytest.approx(0.270, rel=0.01)
    assert outcome.mean("servos", profile="exact") == 11
    for column, size in (("length", 0.405), ("height", 0.091), ("width", 0.090)):
        assert outcome.mean(column, profile="exact") == pytest.approx(size, rel=0.25), column
    assert outcome.mean("scapula_pelvis", profile="exact") == pytest.approx(0.1219, abs=2e-4)


def test_every_line_of_the_body_is_measured_and_none_is_called_a_prediction(outcome):
    lines = compare(outcome)
    assert all(line.exact is not None for line in lines)
    assert {line.kind for line in lines} == {"chosen"}


def test_bodies_have_their_own_rows():
    masses = np.array([0.16, 0.17])
    several = stands.run_body(Settings(("exact",), bodies={"mass.front": masses}))
    assert several.columns["body"].tolist() == [1, 2]
    np.testing.assert_allclose(np.diff(several.columns["mass"]), 0.01)
    assert "body" not in stands.run_body(Settings(("exact",))).columns


def test_what_is_no_parameter_of_the_body_is_refused():
    with pytest.raises(ParameterError, match="frequency"):
        stands.run_body(Settings(values={"frequency": 0.5}))
