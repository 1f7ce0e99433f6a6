"""How a figure is judged: numbers within a quarter, effects on their size, bounds and ranges as they are."""

import math

import pytest

from nermo_mjx.experiments.judgement import Asked, AtMost, Effect, Number, Range, Same, Shown, gain

NAN = math.nan


@pytest.mark.parametrize(
    ("judgement", "holding", "failing"),
    [
        (Number(86.4), [86.4, 64.8, 108.0], [64.7, 108.1, NAN, True, "pass"]),
        (Number(-0.5), [-0.5, -0.4, -0.62], [-0.37, -0.63, 0.5]),
        # 22 % faster: 16.5 to 27.5 %.
        (Effect(1.22), [1.22, 1.165, 1.275], [1.0, 1.16, 1.28, 0.78, NAN]),
        # 1 % faster: half a unit of the last digit is more than a quarter of it.
        (Effect(1.01), [1.01, 1.005, 1.015], [1.0, 1.004, 1.016]),
        (Effect(1.03), [1.0225, 1.0375], [1.022, 1.038, 1.0]),
        # 15 % less: 11.25 to 18.75 %.
        (Effect(0.85), [0.85, 0.8125, 0.8875], [1.0, 0.81, 0.89, 1.15]),
        (Effect(0.713, digits=3), [0.713, 0.642, 0.784], [1.0, 0.64, 0.79]),
        (Effect(2.0, digits=1), [1.75, 2.25], [1.74, 2.26, 1.0]),
        (gain(0.32), [0.24, 0.40], [0.0, 0.23, 0.41, -0.32]),
        (gain(0.0, digits=1), [0.0, 0.05, -0.05], [0.06, -0.06]),
        (AtMost(2.0), [0.1, 2.0], [2.01, NAN]),
        (Range(1.25, 1.40), [1.25, 1.40], [1.24, 1.41, NAN]),
        (Range(1.0, 1.25, beyond=True), [1.001, 1.25], [1.0, 0.99, 1.26]),
        (Same(True), [True], [False]),
        (Same("pass"), ["pass"], ["fail"]),
        (Same(11), [11, 11.0], [10, 11.5]),
        (Asked(0.5, 1.0), [0.5, 0.8], [0.49, 1.01]),
    ],
)
def test_what_holds_and_what_does_not(judgement, holding, failing):
    assert [judgement.holds(value) for value in holding] == [True] * len(holding)
    assert [judgement.holds(value) for value in failing] == [False] * len(failing)


@pytest.mark.parametrize("ratio", [1.05, 1.22, 1.27, 1.48, 2.86, 1.5, 0.85, 0.875, 1.01, 1.03, 0.71, 0.713, 1.11, 2.0])
def test_no_effect_is_never_the_published_one(ratio):
    """A spine that does nothing has the ratio 1, and fails every published effect."""
    digits = max(2, len(f"{ratio:g}".partition(".")[2]))
    assert not Effect(ratio, digits).holds(1.0)
    assert not gain(ratio - 1.0, digits).holds(0.0)


def test_what_is_only_shown_is_not_judged():
    assert Shown(-0.5).holds(-0.5) is None
    assert (Shown(-0.5).published, Shown().published) == (-0.5, None)


@pytest.mark.parametrize(
    ("judgement", "value", "ratio"),
    [
        (Number(80.0), 60.0, 0.75),
        (Number(0.0), 1.0, None),
        (Effect(1.22), 1.11, 0.5),
        (Effect(0.8), 1.1, -0.5),
        (gain(0.4), 0.3, 0.75),
        (gain(0.0, 1), 0.3, None),
        (Range(1.1, 1.5), 1.2, 1.0),
        (Range(1.25, 1.5), 1.0, 0.8),
        (Range(0.5, 0.8), 1.0, 1.25),
        (AtMost(2.0), 3.0, 1.5),
        (AtMost(2.0), 0.2, 1.0),
        (Asked(0.5, 1.0), 0.2, None),
        (Shown(2.0), 3.0, 1.5),
        (Shown(), 3.0, None),
        (Same(2), 2.0, None),
    ],
)
def test_the_ratio_of_an_effect_is_that_of_its_size_and_of_a_range_over_its_nearer_end(judgement, value, ratio):
    assert judgement.ratio(value) == (None if ratio is None else pytest.approx(ratio))


def test_what_was_published_is_what_the_report_shows():
    assert Effect(1.22).published == 1.22
    assert AtMost(2.0).published == (0.0, 2.0)
    assert Range(1.15, 1.22).published == (1.15, 1.22)
    assert Asked(0.5, 1.0).published is None
    assert [each.name for each in (Number(1.0), Effect(1.2), gain(0.2), AtMost(1.0), Range(0, 1), Same(True))] == [
        "number", "effect", "gain", "bound", "range", "outcome",
    ]  # fmt: skip
