"""Identification: the objective, the parameters' space, and a search that finds what it is made to find."""

import types

import numpy as np
import pytest

from nermo_mjx.experiments.identification import search as identification
from nermo_mjx.experiments.identification.search import (
    FREE,
    TARGETS,
    figures,
    identify,
    objective,
    parameters_of,
    point_of,
)
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Setup


def test_a_residual_counts_tolerances_of_the_logarithm():
    """10 % off is about one; inside an interval it is none; an order is missed by 2 % a unit."""
    value, order = TARGETS["trt, 0.8 Hz, over lat"], TARGETS["trt, 0.8 Hz, over trt1"]
    assert value.residual(np.array(1.27)) == pytest.approx(0.0)
    assert value.residual(np.array(1.27 * np.exp(0.1))) == pytest.approx(1.0)
    assert value.residual(np.array(1.27 * np.exp(-0.2))) == pytest.approx(-2.0)
    np.testing.assert_allclose(order.residual(np.array([3.0, 1.0, np.exp(-0.02)])), [0.0, 0.0, -1.0], atol=1e-12)


def test_a_robot_that_walks_as_published_costs_nothing_and_a_fallen_one_the_most():
    published = {
        name: np.array([t.low, t.low]) if np.isfinite(t.high) else np.array([1.1, 1.1]) for name, t in TARGETS.items()
    }
    costs = objective(published, np.array([False, True]))
    assert costs[0] == pytest.approx(0.0, abs=1e-12)
    assert costs[1] == 10.0
    published["trt, 0.8 Hz, over lat"] = np.array([np.nan, 1.27 * np.exp(0.1)])
    costs = objective(published, np.array([False, False]))
    assert costs[0] == 10.0
    assert costs[1] == pytest.approx(1 / np.sqrt(len(TARGETS)))


def test_the_unit_cube_spans_the_bounds_by_logarithm():
    low, high = parameters_of(np.zeros(len(FREE))), parameters_of(np.ones(len(FREE)))
    middle = parameters_of(np.full(len(FREE), 0.5))
    for free in FREE.values():
        for name in free.names:
            assert (low[name], high[name]) == pytest.approx((free.low, free.high))
            assert middle[name] == pytest.approx(np.sqrt(free.low * free.high))
    point = np.random.default_rng(0).uniform(size=len(FREE))
    np.testing.assert_allclose(point_of(parameters_of(point)), point, atol=1e-12)


def test_the_free_parameters_exist_and_their_bounds_are_allowed():
    from nermo_mjx.rollout import all_parameters

    known = all_parameters()
    for free in FREE.values():
        for name in free.names:
            known[name].check(name, free.low)
            known[name].check(name, free.high)


def test_figures_are_ratios_of_the_right_speeds():
    """Speeds that are all different: each figure is checked against a ratio written out here."""
    cases = [tuple(case.labels.values()) for case in identification._CASES]
    speed = {case: 0.05 + 0.01 * i for i, case in enumerate(cases)}
    found = figures(np.array([[speed[case] for case in cases]]))
    expected = {
        "trt, 0.8 Hz, over theory": speed["trt", 0.8, False] / 0.096,
        "trt, 0.5 Hz, spine over none": speed["trt", 0.5, True] / speed["trt", 0.5, False],
        "trt with spine, 0.8 Hz, over lat": speed["trt", 0.8, True] / speed["lat", 0.8, False],
        "trt1, 0.5 Hz, over lat": speed["trt1", 0.5, False] / speed["lat", 0.5, False],
    }
    assert set(found) == set(TARGETS)
    for name, value in expected.items():
        assert found[name][0] == pytest.approx(value)


class Pretended:
    """A simulator whose speeds depend on the friction alone, and are the published ones at 1.2."""

    def __init__(self, setup=None, engine="auto"):
        self.setup = Setup()

    def run(self, values, run):
        off = np.log(values["contact.friction"] / 1.2)
        base = {("trt", 0.5): 0.06, ("trt", 0.8): 0.0864, ("trt1", 0.5): 0.055, ("trt1", 0.8): 0.08}
        base |= {("lat", 0.5): 0.05, ("lat", 0.8): 0.0864 / 1.27}
        n = len(identification._CASES)
        speed = np.empty(len(off))
        for i in range(len(off)):
            case = identification._CASES[i % n].labels
            gain = {0.5: 1.1, 0.8: 1.2}[case["frequency"]] if case["spine"] else 1.0
            speed[i] = base[case["gait"], case["frequency"]] * gain * np.exp(off[i])
        return types.SimpleNamespace(metrics={"speed": speed}, status=np.full(len(off), "ok"))


def test_the_search_finds_a_known_optimum_and_is_the_same_again(monkeypatch):
    monkeypatch.setattr(identification, "Simulator", Pretended)
    found = identify(samples=16, generations=12, population=8, seed=3)
    assert found.parameters["contact.friction"] == pytest.approx(1.2, rel=0.02)
    assert found.objective < found.start
    assert found.objective == min(found.costs)
    again = identify(samples=16, generations=12, population=8, seed=3)
    assert again.parameters == found.parameters


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"samples": 0}, "samples is 0"),
        ({"generations": 0}, "generations is 0"),
        ({"population": 2}, "population is 2"),
    ],
)
def test_a_search_too_small_is_refused(wrong, sentence):
    with pytest.raises(ParameterError, match=sentence):
        identify(**wrong)
