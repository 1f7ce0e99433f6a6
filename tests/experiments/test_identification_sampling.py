"""The ensemble's sampler against regions whose share of the cube and moments are known in closed form."""

import math

import numpy as np
import pytest

from nermo_mjx.experiments.ensemble import sample_bodies, thin

pytestmark = pytest.mark.compiles


def ball(radius, centre):
    """An objective whose value 0.5 is a sphere of this radius about a centre."""
    return lambda points: 0.5 * np.linalg.norm(points - centre, axis=1) / radius


def drawn(radius, seed, **more):
    settings = {"tolerance": 0.5, "size": 256, "sweeps": 5, "seed": seed} | more
    return sample_bodies(ball(radius, np.full(6, 0.5)), 6, **settings)


@pytest.mark.parametrize("radius", [0.5, 0.35])
def test_share_and_moments_of_a_ball(radius):
    """A ball in six dimensions: volume pi^3 r^6 / 6, mean square distance 6/8 r^2, to a few standard errors."""
    samples = [drawn(radius, seed) for seed in range(6)]
    volume = math.pi**3 / 6 * radius**6
    assert np.mean([each.share for each in samples]) == pytest.approx(volume, rel=0.12)
    for each in samples:
        assert each.share == pytest.approx(volume, rel=0.25)
        away = each.points - 0.5
        assert each.weights @ np.sum(away**2, axis=1) == pytest.approx(0.75 * radius**2, rel=0.06)
        np.testing.assert_allclose(each.weights @ away, 0.0, atol=5 * radius / math.sqrt(8 * each.effective))
        assert each.costs.max() <= 0.5
        assert each.effective > 150
        assert each.sweeps[-1]["acceptance"] > 0.35


def test_a_corner_that_is_cut_off_by_the_cube_is_covered_evenly():
    """Half a ball against a side: the mean height over a flat side of a half ball in six dimensions is known."""
    radius, centre = 0.4, np.array([0.0, 0.5, 0.5, 0.5, 0.5, 0.5])
    samples = [
        sample_bodies(ball(radius, centre), 6, tolerance=0.5, size=256, sweeps=5, seed=seed) for seed in range(12)
    ]
    volume = math.pi**3 / 12 * radius**6
    # Mean of x over a half ball in d dimensions: r V(d-1) / ((d+1) V(d) / 2), V of unit balls.
    height = radius * (8 * math.pi**2 / 15) / (7 * math.pi**3 / 12)
    assert np.mean([each.share for each in samples]) == pytest.approx(volume, rel=0.15)
    assert np.mean([each.weights @ each.points[:, 0] for each in samples]) == pytest.approx(height, rel=0.06)


def test_seeds_leave_no_bias():
    """Points that crowd in one corner of the region to begin from: the mean stays in its middle."""
    seeds = 0.5 + 0.18 * np.random.default_rng(0).uniform(0.8, 1.0, (50, 6)) * np.array([1, 0, 0, 0, 0, 0])
    samples = [drawn(0.25, seed, seeds=seeds) for seed in range(4)]
    assert np.mean([each.weights @ each.points[:, 0] for each in samples]) == pytest.approx(0.5, abs=0.015)


def test_two_regions_apart_are_both_found_in_their_proportion():
    """Balls of radius 0.3 and 0.2 in two dimensions: 9 to 4."""

    def objective(points):
        return np.minimum(ball(0.3, np.array([0.3, 0.3]))(points), ball(0.2, np.array([0.8, 0.8]))(points))

    found = sample_bodies(objective, 2, tolerance=0.5, size=256, sweeps=5, seed=1)
    large = found.points[:, 0] + found.points[:, 1] < 1.1
    assert found.weights[large].sum() == pytest.approx(9 / 13, abs=0.05)


def test_the_same_seed_gives_the_same_points_and_another_one_others():
    first, again, other = drawn(0.35, 1), drawn(0.35, 1), drawn(0.35, 2)
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.weights, again.weights)
    assert len(np.intersect1d(first.points[:, 0], other.points[:, 0])) == 0


def test_it_ends_when_enough_is_known_and_after_so_many_sweeps():
    everywhere = drawn(10.0, 0)
    assert len(everywhere.sweeps) == 1
    assert everywhere.share == 1.0
    assert everywhere.effective == pytest.approx(256)
    rare = drawn(0.2, 0, sweeps=2)
    assert [each["candidates"] for each in rare.sweeps] == [256, 256, 256]
    assert rare.sweeps[1]["level"] > 0.5


def test_a_region_that_is_not_there_gives_no_points():
    nothing = drawn(0.35, 0, tolerance=-1.0, sweeps=1)
    assert (len(nothing.points), nothing.share, nothing.effective) == (0, 0.0, 0.0)


def test_thinning_keeps_what_the_weights_say():
    """Half the points, distinct, of nearly equal weight; over many seeds, their mean is that of all of them."""
    found = drawn(0.35, 0)
    assert len(found.points) > 300
    mean = found.weights @ found.points
    means, heaviest = [], []
    for seed in range(60):
        kept = thin(found, 128, seed)
        assert len(np.unique(kept.points, axis=0)) == 128
        assert kept.weights.sum() == pytest.approx(1.0)
        means.append(kept.weights @ kept.points)
        heaviest.append(kept.weights.max() / kept.weights.mean())
    # 30 of these points weigh more than a 128th: they are always in, and keep what they weigh beyond.
    assert np.mean(heaviest) < found.weights.max() / found.weights.mean() / 2
    np.testing.assert_allclose(np.mean(means, axis=0), mean, atol=4 * 0.12 / math.sqrt(128 * 60))
    assert thin(found, 10_000, 0) is found
