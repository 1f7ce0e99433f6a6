# Tests of sweep/sampling.py
"""The rows of a sweep: order, coverage, and that chance is repeatable and local."""

import itertools

import numpy as np
import pytest
from scipy import stats

from nermo_mjx.robot import identified
from nermo_mjx.robot.quantity import Quantity
from nermo_mjx.sweep import Sweep, sample
from nermo_mjx.sweep.sampling import Draw


def rows_of(**spec):
    return sample(Sweep.from_dict(spec))


def test_a_grid_runs_through_the_product_in_the_order_of_the_file():
    """The last axis of the file runs fastest, and repeats of a variant stand side by side."""
    rows = rows_of(
        vary={"frequency": [0.5, 1.0], "duty": [0.4, 0.5, 0.6]}, randomize={"repeats": 2}
    )
    expected = [point for point in itertools.product([0.5, 1.0], [0.4, 0.5, 0.6]) for _ in range(2)]
    assert list(zip(rows.values["frequency"], rows.values["duty"], strict=True)) == expected
    assert rows.variant.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    assert rows.repeat.tolist() == [0, 1] * 6


def test_logspace_is_given_by_its_end_values():
    """logspace [0.1, 10, 3] is 0.1, 1, 10: no exponents."""
    rows = rows_of(vary={"pilot.error_gain": {"logspace": [0.1, 10, 3]}})
    np.testing.assert_allclose(rows.values["pilot.error_gain"], [0.1, 1.0, 10.0], rtol=1e-12)


@pytest.mark.parametrize("sampler", ["sobol", "latin_hypercube"])
def test_samplers_put_one_point_in_each_stratum_of_each_axis(sampler):
    """64 points: each 64th of each axis has exactly one, on the axis' own (linear or logarithmic) scale."""
    vary = {"frequency": {"uniform": [0.5, 1.5]}, "contact.friction": {"loguniform": [0.1, 4.0]}}
    values = rows_of(vary=vary, sample={sampler: 64}, seed=3).values
    for share in (values["frequency"] - 0.5, np.log(values["contact.friction"] / 0.1) / np.log(40)):
        assert sorted(np.floor(share * 64).astype(int)) == list(range(64))


def test_sobol_covers_pairs_better_than_chance():
    """Each of 8 x 8 cells of a pair of axes holds one of 64 Sobol points (a (0, 2)-sequence)."""
    vary = {"frequency": {"uniform": [0, 1]}, "stride": {"uniform": [0, 1]}}
    vary["frequency"] = {"uniform": [1.0, 2.0]}
    values = rows_of(vary=vary, sample={"sobol": 64}).values
    cells = np.floor((values["frequency"] - 1) * 8) * 8 + np.floor(values["stride"] * 8)
    assert len(np.unique(cells)) == 64


def test_a_sobol_sample_of_any_size_is_quiet_and_within_bounds(recwarn):
    """A size that is no power of two is fine; a linspace bounds a sampled axis."""
    values = rows_of(vary={"frequency": {"linspace": [0.4, 1.2, 9]}}, sample={"sobol": 37}).values
    assert len(values["frequency"]) == 37
    assert values["frequency"].min() >= 0.4
    assert values["frequency"].max() <= 1.2
    assert len(np.unique(values["frequency"])) == 37
    assert not [warning for warning in recwarn if "power of 2" in str(warning.message)]


def test_listed_values_are_sampled_alike_often():
    """An axis of listed values takes only these, each as often."""
    values = rows_of(
        vary={"pilot.output_limit": [0.2, 0.5, 0.8, 1.0]}, sample={"latin_hypercube": 40}
    ).values
    listed, counts = np.unique(values["pilot.output_limit"], return_counts=True)
    assert listed.tolist() == [0.2, 0.5, 0.8, 1.0]
    assert counts.tolist() == [10] * 4


@pytest.mark.parametrize("sampler", [{"sobol": 16}, {"latin_hypercube": 16}])
def test_a_seed_repeats_a_sample_and_another_seed_changes_it(sampler):
    """The same seed gives the same table of values, bit by bit."""
    spec = {"vary": {"frequency": {"uniform": [0.5, 1.5]}}, "sample": sampler}
    spec["randomize"] = {"contact.friction": {"uniform": [1.0, 1.6]}}
    first, again, other_seed = (
        rows_of(**spec, seed=1),
        rows_of(**spec, seed=1),
        rows_of(**spec, seed=2),
    )
    for name, column in first.values.items():
        np.testing.assert_array_equal(column, again.values[name])
        assert not np.any(column == other_seed.values[name])


def test_draws_of_a_variant_do_not_depend_on_the_other_variants():
    """More variants, or more repeats, leave the draws of a (variant, repeat) as they were."""
    draw = {"contact.friction": {"uniform": [1.0, 1.6]}}
    few = rows_of(vary={"frequency": [0.5, 0.6]}, randomize={"repeats": 2, **draw})
    three_variants = rows_of(vary={"frequency": [0.5, 0.6, 0.7]}, randomize={"repeats": 3, **draw})
    is_shared = three_variants.repeat < 2
    for name in ("contact.friction", "start.x", "start.phase"):
        np.testing.assert_array_equal(few.values[name], three_variants.values[name][is_shared][:4])
    np.testing.assert_array_equal(few.seed, three_variants.seed[is_shared][:4])


def test_repeats_differ_from_each_other():
    """Three repeats are three different starts, within a millimetre and a degree; the first is that of a single run."""
    rows = rows_of(vary={"frequency": [0.5, 0.6]}, randomize={"repeats": 3})
    for name, most in (
        ("start.x", 1e-3),
        ("start.y", 1e-3),
        ("start.yaw", np.radians(1)),
        ("start.phase", 0.02),
    ):
        assert len(np.unique(rows.values[name])) == 5
        assert np.all((rows.values[name] == 0) == (rows.repeat == 0))
        assert np.abs(rows.values[name]).max() <= most
    assert len(np.unique(rows.seed)) == 6


def test_draws_follow_their_distributions():
    """Mean and spread of 4000 draws lie within four standard errors of the distribution's."""
    draws = {
        "contact.friction": {"uniform": [1.0, 1.6]},
        "mass.front": {"normal": [0.16, 0.01]},
        "stiffness.ankle": {"loguniform": [0.05, 0.2]},
    }
    values = rows_of(vary={"frequency": [0.5]}, randomize={"repeats": 4000, **draws}).values
    error = 4 / np.sqrt(4000)
    assert abs(values["contact.friction"].mean() - 1.3) < error * 0.6 / np.sqrt(12)
    assert abs(values["mass.front"].mean() - 0.16) < error * 0.01
    assert abs(values["mass.front"].std() - 0.01) < error * 0.01
    assert abs(np.log(values["stiffness.ankle"]).mean() - np.log(0.1)) < error * np.log(
        4
    ) / np.sqrt(12)


def test_a_wide_normal_distribution_stays_within_the_parameters_range():
    """Draws are cut off at the range, without piling up at its ends."""
    spec = {
        "vary": {"frequency": [0.5]},
        "randomize": {"repeats": 500, "stance.stance_amplitude": {"normal": [0.0, 0.004]}},
    }
    samples = rows_of(**spec).values["stance.stance_amplitude"]
    assert samples.min() >= 0.0
    assert np.sum(samples == 0.0) == 0
    assert (
        abs(np.median(samples) - 0.6745 * 0.004) < 0.0008
    )  # half-normal: its median is the quartile of the normal


def test_bodies_are_drawn_whole_by_weight_and_leave_other_draws_alone(monkeypatch):
    """All parameters of a row are of one body; bodies come as often as they weigh; other draws stay as they were."""
    text = ["servo.kp,contact.friction,objective,weight", "5,1.1,0,1", "6,1.2,0,2", "7,1.3,0,5"]
    monkeypatch.setattr(
        identified, "bodies", lambda source="identified": identified.read_ensemble(text)
    )
    randomized = {"repeats": 2000, "mass.front": {"uniform": [0.15, 0.17]}}
    spec = {"vary": {"frequency": [0.5, 0.6]}}
    plain, with_bodies = (
        rows_of(**spec, randomize=randomized),
        rows_of(**spec, randomize={"from": "identified", **randomized}),
    )
    assert plain.body is None
    for name, column in plain.values.items():
        np.testing.assert_array_equal(with_bodies.values[name], column)
    np.testing.assert_array_equal(with_bodies.values["servo.kp"], 5.0 + with_bodies.body)
    np.testing.assert_allclose(with_bodies.values["contact.friction"], 1.1 + 0.1 * with_bodies.body)
    shares = np.bincount(with_bodies.body) / len(with_bodies)
    np.testing.assert_allclose(shares, [1 / 8, 2 / 8, 5 / 8], atol=4 * np.sqrt(0.25 / 4000))
    assert abs(np.corrcoef(with_bodies.body, with_bodies.values["mass.front"])[0, 1]) < 4 / np.sqrt(
        4000
    )


@pytest.mark.parametrize(("mean", "std"), [(0.0, 0.004), (0.004, 0.001), (0.01, 0.02)])
def test_a_normal_draw_is_truncated_to_the_parameters_range(mean, std):
    """Quantiles of scipy's truncated normal distribution; a clipped one would have the ends many times."""
    declaration = Quantity(0.0, "m", 0.0, 0.01, "a length")
    draw = Draw.model_validate({"normal": [mean, std]}).of("stance.stance_amplitude", declaration)
    share = np.linspace(0.0, 0.999, 50)
    low, high = (0.0 - mean) / std, (0.01 - mean) / std
    np.testing.assert_allclose(
        draw.at(share), stats.truncnorm.ppf(share, low, high, mean, std), atol=1e-9
    )
