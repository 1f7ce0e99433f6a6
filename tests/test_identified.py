"""The ensemble of bodies that comes with the package: within bounds and tolerance, around the default body."""

import numpy as np
import pytest

from nermo_mjx.experiments.ensemble import FREE_IN, TOLERANCE, UNCERTAIN, names
from nermo_mjx.robot import identified
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import ParameterError, quantities

ALL = FREE_IN["as_published"] | UNCERTAIN


@pytest.mark.parametrize("name", ["damping.knee", "damping.ankle", "damping.spine", "servo.kp", "servo.kv"])
def test_the_default_body_is_among_the_identified_ones(name):
    """Within 90 % of the weight; the damping is the author's, which the identification knows nothing of."""
    values, weights = identified.bodies().values[name], identified.bodies().weights
    default = {name: about.default for name, about in quantities(ModelParameters)}[name]
    below = weights[values < default].sum()
    assert 0.05 < below < 0.95


def test_every_body_is_within_the_bounds_and_the_tolerance():
    ensemble = identified.bodies()
    assert tuple(ensemble.values) == names(ALL)
    for free in ALL.values():
        for name in free.names:
            assert free.low <= ensemble.values[name].min() <= ensemble.values[name].max() <= free.high
    assert ensemble.objective.min() >= 0
    assert ensemble.objective.max() <= TOLERANCE
    np.testing.assert_array_equal(ensemble.values["damping.knee"], ensemble.values["damping.ankle"])


def test_the_bodies_are_distinct_and_weighed():
    ensemble = identified.bodies()
    assert len(np.unique(np.array(list(ensemble.values.values())), axis=1).T) == len(ensemble) >= 8
    assert ensemble.weights.min() > 0
    assert ensemble.weights.sum() == pytest.approx(1.0)


def test_bodies_are_chosen_without_repeats_and_by_seed():
    few = len(identified.bodies()) // 2
    chosen, again, other = identified.choose(few, 1), identified.choose(few, 1), identified.choose(few, 2)
    rows = np.array(list(chosen.values())).T
    assert rows.shape == (few, len(names(ALL)))
    assert len(np.unique(rows, axis=0)) == few
    np.testing.assert_array_equal(rows, np.array(list(again.values())).T)
    assert not np.array_equal(rows, np.array(list(other.values())).T)
    known = set(map(tuple, np.array(list(identified.bodies().values.values())).T))
    assert set(map(tuple, rows)) <= known


def test_all_bodies_are_chosen_in_their_order():
    ensemble = identified.bodies()
    chosen = identified.choose(len(ensemble), 5)
    for name, column in ensemble.values.items():
        np.testing.assert_array_equal(chosen[name], column)


@pytest.mark.parametrize("n", [0, 100_000])
def test_more_bodies_than_there_are_is_refused_with_their_number(n):
    with pytest.raises(ParameterError, match=rf"bodies is {n}: allowed is 1 to {len(identified.bodies())}"):
        identified.choose(n, 0)


FILE = """# made for a test
servo.kp,contact.friction,objective,weight
5.0,1.4,0.2,0.25
6.0,1.2,0.3,0.75
"""


def test_even_shares_draw_bodies_by_weight():
    """A quarter of the weight: the first quarter of the shares."""
    ensemble = identified.read_ensemble(FILE.splitlines())
    np.testing.assert_array_equal(ensemble.at(np.array([0.0, 0.2499, 0.25, 0.999999])), [0, 0, 1, 1])
    assert ensemble.take(np.array([1, 1]))["servo.kp"].tolist() == [6.0, 6.0]


def test_the_fingerprint_is_of_the_bodies_and_not_of_the_comments():
    first = identified.read_ensemble(FILE.splitlines())
    assert identified.read_ensemble(FILE.splitlines()[1:]).fingerprint == first.fingerprint
    assert identified.read_ensemble(FILE.replace("6.0", "6.1").splitlines()).fingerprint != first.fingerprint
