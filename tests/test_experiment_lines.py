"""Cases, the batch they become, and the lines that compare an outcome with the publication."""

import numpy as np
import pytest

from nermo_mjx.control.published import SIMULATED
from nermo_mjx.experiments import maze, straight_line, theory, turning
from nermo_mjx.experiments.cases import AMPLITUDE, Case, worlds
from nermo_mjx.experiments.judgement import Asked, AtMost, Effect, Number, Range, Same, Shown
from nermo_mjx.experiments.line import Figure, agrees, compare
from nermo_mjx.experiments.outcome import Outcome, joined
from nermo_mjx.experiments.published import FIGURES, REASONS
from nermo_mjx.experiments.settings import Settings
from nermo_mjx.robot import load_robot
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Setup

# --- cases and worlds


def test_the_straight_line_has_the_published_cases():
    """3 frequencies x (trt, trt1) x (ns, s) and lat ns; trt 0.8 Hz over four strides; and the compensated one."""
    labels = [tuple(case.labels.values()) for case in straight_line.cases()]
    assert len(labels) == len(set(labels)) == 3 * (2 * 2 + 1) + 3 * 2 + 1
    assert {label[:3] for label in labels if label[0] == "trt"} >= {("trt", 0.8, s) for s in (0.0, 0.5, 0.8, 1.0)}


def test_turning_has_the_published_cases_and_their_mirror_images():
    """At the stride of the test's text, 0.8; circles of 0.5 m and full lock also at the other reading, 1.0."""
    at = {stride: [case for case in turning.cases() if case.values["stride"] == stride] for stride in (0.8, 1.0)}
    left = [case for case in at[0.8] if case.labels["side"] == "left"]
    assert len(left) == 3 * 3 * 3 * 3
    assert {case.labels["stride"] for case in left} == {0.8}
    other = {tuple({**case.labels, "stride": 0.8}.items()) for case in at[1.0]}
    assert len(other) == 3 * 3 * 2 * 3
    assert other == {tuple(case.labels.items()) for case in left if case.labels["radius"] != 1.0}
    right = [case for case in turning.cases() if case.labels["side"] == "right"]
    twins = {tuple({**case.labels, "side": "left"}.items()) for case in right}
    assert twins <= {tuple(case.labels.items()) for case in left}


def test_a_batch_is_every_case_in_every_profile_as_often_as_asked():
    cases = [Case({"name": name}, "trt", values={"frequency": f}) for name, f in (("slow", 0.5), ("fast", 0.8))]
    batch = worlds(cases, Setup().defaults(), Settings(repeats=3, seed=7))
    assert len(batch.labels["profile"]) == 2 * 2 * 3
    np.testing.assert_array_equal(batch.values["frequency"], np.tile(np.repeat([0.5, 0.8], 3), 2))
    published = batch.labels["profile"] == "as_published"
    np.testing.assert_array_equal(batch.values["tracking.clock_ratio"], np.where(published, 0.4, 1.0))


def test_repeats_differ_and_cases_start_alike():
    """Three repeats of a deterministic run are not three repeats; a case is compared from the same starts."""
    cases = [Case({"name": name}, "trt") for name in ("one", "other")]
    batch = worlds(cases, Setup().defaults(), Settings(("exact",), repeats=3, seed=1))
    for name, width in (("start.x", 1e-3), ("start.yaw", np.radians(1.0)), ("start.phase", 0.02)):
        shifts = batch.values[name].reshape(2, 3)
        np.testing.assert_array_equal(shifts[0], shifts[1])
        assert len(np.unique(shifts[0])) == 3
        assert np.abs(shifts).max() <= width
    again = worlds(cases, Setup().defaults(), Settings(("exact",), repeats=3, seed=2))
    assert not np.array_equal(again.values["start.x"], batch.values["start.x"])


def test_a_case_goes_before_what_is_common_to_all_worlds():
    batch = worlds(
        [Case({}, "trt", values={"frequency": 0.8})],
        Setup().defaults(),
        Settings(values={"contact.friction": 1.3, "frequency": 0.5}),
    )
    assert set(batch.values["contact.friction"]) == {1.3}
    assert set(batch.values["frequency"]) == {0.8}


@pytest.mark.parametrize(
    ("wrong", "sentence"), [({"repeats": 0}, "repeats is 0"), ({"profiles": ("exakt",)}, "profile is 'exakt'")]
)
def test_a_wrong_batch_is_refused(wrong, sentence):
    with pytest.raises(ParameterError, match=sentence):
        worlds([Case({}, "trt")], Setup().defaults(), Settings(**wrong))


def test_bodies_walk_all_cases_and_keep_what_the_cases_decide():
    cases = [Case({"name": name}, "trt", values={"frequency": f}) for name, f in (("slow", 0.5), ("fast", 0.8))]
    bodies = {"contact.friction": np.array([0.9, 1.1, 1.3]), "frequency": np.array([9.0, 9.0, 9.0])}
    settings = Settings(("exact",), repeats=2, values={"servo.kp": 6.0}, bodies=bodies)
    batch = worlds(cases, Setup().defaults(), settings)
    assert list(batch.labels) == ["profile", "body", "name", "repeat"]
    np.testing.assert_array_equal(batch.labels["body"], np.repeat([1, 2, 3], 4))
    np.testing.assert_array_equal(batch.values["contact.friction"], np.repeat([0.9, 1.1, 1.3], 4))
    np.testing.assert_array_equal(batch.values["frequency"], np.tile([0.5, 0.5, 0.8, 0.8], 3))
    assert set(batch.values["servo.kp"]) == {6.0}
    one = worlds(cases, Setup().defaults(), settings.but(bodies=None))
    np.testing.assert_array_equal(batch.values["start.x"], np.tile(one.values["start.x"], 3))


@pytest.mark.parametrize("bodies", [{}, {"a": np.zeros(0)}, {"a": np.zeros(2), "b": np.zeros(3)}])
def test_bodies_without_one_number_of_values_are_refused(bodies):
    with pytest.raises(ParameterError, match="bodies has"):
        worlds([Case({}, "trt")], Setup().defaults(), Settings(bodies=bodies))


def test_outcomes_are_joined_and_taken_apart_by_body():
    parts = [outcome(profile=["exact"] * 2, body=[i, i + 1], speed=[0.1 * i, 0.2 * i]) for i in (1, 3)]
    whole = joined(parts)
    assert whole.columns["body"].tolist() == [1, 2, 3, 4]
    assert whole.of_body(3).columns["speed"].tolist() == pytest.approx([0.3])
    assert list(whole.of_body(3).columns) == ["profile", "speed"]


def test_a_column_that_a_table_does_not_have_is_not_measured():
    assert np.isnan(outcome(profile=["exact"], speed=[1.0]).mean("slip", profile="exact"))


# --- theory


def test_the_theory_of_speed_is_the_published_one():
    """6.2.1: 96 mm/s, 120 mm/s with the spine, 24 mm/s with the spine alone; trot at 0.8 Hz.

    Within 6 %: (5.33) gives 15.8 mm a stride, the publication rounds to 15 mm.
    """
    values = {**Setup().defaults(), "frequency": 0.8}
    rows = [(1.0, 0.0), (1.0, AMPLITUDE), (0.0, AMPLITUDE)]
    batch = {name: np.full(3, value) for name, value in values.items()}
    batch |= {"stride": np.array([row[0] for row in rows]), "spine.amplitude": np.array([row[1] for row in rows])}
    np.testing.assert_allclose(theory.speed(batch), [0.096, 0.120, 0.024], rtol=0.06)


@pytest.mark.parametrize(("steering", "radius", "tolerance"), [("leg", 0.151, 0.005), ("mix", 0.134, 0.10)])
def test_the_theory_of_the_smallest_radius_is_the_published_one(steering, radius, tolerance):
    """Mix-based within 10 %: no reading of d_diag gives both published radii (`turning.foot_diagonals`)."""
    assert theory.smallest_radius(steering) == pytest.approx(radius, rel=tolerance)


@pytest.mark.compiles
@pytest.mark.parametrize(("servo", "radius"), [(0.3, 0.590), (0.35, 0.505), (0.4, 0.441), (0.587, 0.297)])
def test_two_feet_with_equal_strides_turn_less_than_the_formula_says(servo, radius):
    """A reference computation's radii of least slip; (5.43) has 0.281 m at 0.4 rad, for feet like wheels on axles."""
    assert theory.equal_stride_radius(servo) == pytest.approx(radius, abs=6e-4)
    assert theory.equal_stride_radius(servo, 0.048) == pytest.approx(radius, abs=1e-3)
    assert theory.equal_stride_radius(-servo) == pytest.approx(radius, abs=1e-3)
    assert theory.equal_stride_radius(servo) > 0.281


def test_the_theory_of_the_radius_takes_the_stride():
    """(5.40-5.42): nearly the same, because the leg-based radius is that of the diagonal."""
    assert theory.smallest_radius("leg", 0.048) == pytest.approx(theory.smallest_radius("leg"), rel=0.01)
    assert theory.smallest_radius("leg", 0.048) != theory.smallest_radius("leg")


def test_the_robot_stands_a_degree_nose_up():
    """Table A.7 and A.5: front feet 45 mm below a shoulder at -32.4, rear feet 50 mm below a hip at -25.3."""
    assert np.degrees(theory.standing_pitch()) == pytest.approx(np.degrees(np.arctan2(-2.1, 121.9 + 5.0)), abs=0.02)


def test_the_spine_lengthens_a_stride_by_what_was_published():
    """6.2.1: 15 mm; (5.33) gives 15.8."""
    assert theory.stride_gain_of(0.4) == pytest.approx(0.015, rel=0.06)


def test_the_centre_of_mass_lies_inside_for_front_legs_and_outside_for_rear_legs():
    """So that without balance compensation front legs can be lifted and rear legs not; left is as right."""
    masses, feet = load_robot().mass_model, np.array([[-0.005, -0.045]] * 2 + [[0.0, -0.050]] * 2)
    margin = [theory.stability(masses, feet, limb) for limb in range(4)]
    assert margin[0] == pytest.approx(margin[1], abs=1e-8)
    assert margin[2] == pytest.approx(margin[3], abs=1e-8)
    assert margin[0] > 0.003 > -0.003 > margin[2]
    # Both triangles share the diagonals, so the margins are opposite.
    assert margin[0] == pytest.approx(-margin[2], abs=1e-8)


# --- lines


def outcome(**columns) -> Outcome:
    return Outcome("made-up", {name: np.array(values) for name, values in columns.items()}, {}, {})


TWO = outcome(profile=["exact", "exact", "as_published"], speed=[0.9, 1.1, 0.5])


def figure(reported, **more) -> Figure:
    return Figure("speed", "predicted", reported, lambda o, p: o.mean("speed", profile=p), **more)


@pytest.mark.parametrize(
    ("reported", "published", "ratio", "holds"),
    [
        (Number(1.0), 1.0, 1.0, True),
        (Number(1.3), 1.3, 1 / 1.3, True),
        (Number(1.4), 1.4, 1 / 1.4, False),
        (Number(0.8), 0.8, 1.25, True),
        (Number(0.79), 0.79, 1 / 0.79, False),
        (Effect(1.22), 1.22, 0.0, False),
        (Range(0.5, 1.5), (0.5, 1.5), 1.0, True),
        (Range(1.1, 1.5), (1.1, 1.5), 1 / 1.1, False),
        (AtMost(1.1), (0.0, 1.1), 1.0, True),
        (AtMost(0.8), (0.0, 0.8), 1.25, False),
        (Asked(0.95, 1.2), None, None, True),
        (Asked(1.05, 1.2), None, None, False),
    ],
)
def test_a_line_has_what_was_published_what_was_measured_and_whether_it_holds(reported, published, ratio, holds):
    (line,) = compare(TWO, [figure(reported)], {"speed": "known"}, {"speed": 0.75})
    assert (line.exact, line.as_published) == (pytest.approx(1.0), 0.5)
    assert line.published == published
    assert line.ratio == (None if ratio is None else pytest.approx(ratio))
    assert line.holds is holds
    assert line.reason == ("" if holds else "known")
    assert (line.kind, line.judged, line.ensemble) == ("predicted", reported.name, 0.75)
    assert line.demanded == ((reported.low, reported.high) if isinstance(reported, Asked) else None)


def test_trends_and_words_hold_if_they_are_the_same():
    assert agrees(True, figure(Same(True))) is True
    assert agrees(False, figure(Same(True))) is False
    assert agrees("pass", figure(Same("fail"))) is False


def test_what_is_only_shown_does_not_hold_or_fail():
    (line,) = compare(TWO, [figure(Shown(0.5))], {"speed": "known"}, {"speed": 0.75})
    assert (line.published, line.exact, line.holds, line.reason, line.ensemble) == (0.5, 1.0, None, "", None)


def test_a_profile_that_was_not_run_is_no_number():
    (line,) = compare(outcome(profile=["as_published"], speed=[0.5]), [figure(Number(1.0))], {})
    assert (line.exact, line.holds, line.ratio) == (None, None, None)


def test_every_reason_belongs_to_a_figure():
    for name, reasons in REASONS.items():
        assert set(reasons) <= {figure.name for figure in FIGURES[name]}


def test_figures_have_names_of_their_own():
    for figures in FIGURES.values():
        names = [figure.name for figure in figures]
        assert len(names) == len(set(names))


def test_the_followed_bound_is_a_twentieth_of_the_radius_but_no_less_than_the_robot_sways():
    np.testing.assert_allclose(turning.bound(np.array([1.0, 0.5, 0.1])), [0.05, 0.025, 0.025])


def test_the_maze_is_walked_without_and_with_the_spine():
    without, with_spine = maze.cases()
    assert (without.steering, with_spine.steering) == ("leg", "mix")
    assert with_spine.values["spine.amplitude"] == AMPLITUDE


def test_profiles_are_those_of_the_controller():
    assert SIMULATED == ("exact", "as_published")
