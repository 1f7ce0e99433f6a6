# Tests of robot/identified.py
"""The ensemble of bodies that comes with the package: within bounds and tolerance, around the default body."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest

from nermo_mjx.robot import identified
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import ParameterError, quantities


@pytest.mark.parametrize(
    "name", ["damping.knee", "damping.ankle", "damping.spine", "servo.kp", "servo.kv"]
)
def test_the_default_body_is_among_the_identified_ones(name):
    """Within 90 % of the weight; the damping is the author's, which the identification knows nothing of."""
    values, weights = identified.bodies().values[name], identified.bodies().weights
    default = {name: quantity.default for name, quantity in quantities(ModelParameters)}[name]
    below = weights[values < default].sum()
    assert 0.05 < below < 0.95


@pytest.fixture(scope="module")
def script():
    """The script that identifies from the published speeds."""
    path = Path(__file__).parents[2] / "docs/benchmarks/published_speeds.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_body_is_within_the_bounds_and_the_tolerance(script):
    ensemble, bounds = identified.bodies(), script.bounds("as_published")
    assert {*ensemble.values} == {"damping.ankle", *bounds}
    for name, (low, high) in bounds.items():
        assert low <= ensemble.values[name].min() <= ensemble.values[name].max() <= high
    assert ensemble.objective.min() >= 0
    assert ensemble.objective.max() <= 0.5
    np.testing.assert_array_equal(ensemble.values["damping.knee"], ensemble.values["damping.ankle"])


@pytest.mark.long
@pytest.mark.release
def test_robot_instances_that_were_identified_have_the_objective_of_their_walks(script):
    """Real walks of the first instance, as near as another compiler lets them. The expected objective is the shipped
    one, which an earlier release computed."""
    ensemble, names = identified.bodies(), list(script.bounds("as_published"))
    problem = script.PublishedSpeeds(dict.fromkeys(names, math.nan), "as_published")
    residuals = problem.predict(np.array([ensemble.values[name][:1] for name in names]).T)
    np.testing.assert_allclose(
        np.sqrt(np.mean(residuals**2, axis=1)), ensemble.objective[:1], atol=0.02
    )


def test_bodies_are_distinct_weighed_and_chosen_without_repeats_and_by_seed():
    ensemble = identified.bodies()
    assert ensemble.weights.min() > 0
    assert ensemble.weights.sum() == pytest.approx(1.0)
    rows = {}
    for n, seed in ((len(ensemble), 5), (len(ensemble) // 2, 1), (len(ensemble) // 2, 2)):
        rows[seed] = np.array(list(identified.choose(n, seed).values())).T
        assert rows[seed].shape == (n, len(ensemble.values))
        assert len(np.unique(rows[seed], axis=0)) == n >= 4
        np.testing.assert_array_equal(
            rows[seed], np.array(list(identified.choose(n, seed).values())).T
        )
    np.testing.assert_array_equal(rows[5].T, list(ensemble.values.values()))  # all, in their order
    assert not np.array_equal(rows[1], rows[2])
    assert set(map(tuple, rows[1])) <= set(map(tuple, rows[5]))


def test_more_bodies_begin_with_those_of_fewer_and_the_first_is_drawn_by_weight():
    ensemble = identified.bodies()
    for n in (1, 5, 12):
        for name, column in identified.choose(n, 7).items():
            np.testing.assert_array_equal(column, identified.choose(13, 7)[name][:n])
    heaviest = ensemble.values["damping.knee"][np.argsort(ensemble.weights)[-8:]]
    first = np.array([identified.choose(1, seed)["damping.knee"][0] for seed in range(1000)])
    expected = np.sort(ensemble.weights)[-8:].sum()
    assert np.isin(first, heaviest).mean() == pytest.approx(
        expected, abs=4 * np.sqrt(expected * (1 - expected) / 1000)
    )


@pytest.mark.parametrize("n", [0, 100_000])
def test_more_bodies_than_there_are_is_refused_with_their_number(n):
    with pytest.raises(
        ParameterError, match=rf"bodies is {n}: allowed is 1 to {len(identified.bodies())}"
    ):
        identified.choose(n, 0)


FILE = """# made for a test
servo.kp,contact.friction,objective,weight
5.0,1.4,0.2,0.25
6.0,1.2,0.3,0.75
"""


def test_even_shares_draw_bodies_by_weight_and_comments_do_not_count():
    """A quarter of the weight: the first quarter of the shares."""
    ensemble = identified.read_ensemble(FILE.splitlines())
    np.testing.assert_array_equal(
        ensemble.at(np.array([0.0, 0.2499, 0.25, 0.999999])), [0, 0, 1, 1]
    )
    assert ensemble.take(np.array([1, 1]))["servo.kp"].tolist() == [6.0, 6.0]
    assert identified.read_ensemble(FILE.splitlines()[1:]).fingerprint == ensemble.fingerprint
    assert (
        identified.read_ensemble(FILE.replace("6.0", "6.1").splitlines()).fingerprint
        != ensemble.fingerprint
    )
