# Tests of sweep/counting.py
"""Which runs of two sides are compared, and intervals of their differences."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from nermo_mjx.sweep.counting import matched, two_stage


def side(*runs: tuple[int, int, float]) -> pd.DataFrame:
    """Runs as (unit, seed, speed)."""
    unit, seed, speed = zip(*runs, strict=True)
    return pd.DataFrame({"speed": speed}, pd.MultiIndex.from_arrays([unit, seed]))


def test_units_with_a_common_seed_have_pairs_and_others_keep_their_own_runs():
    """Unit 0: the runs of seed 8. Unit 1: no common seed, so that all runs count. Unit 2 is on one side alone."""
    base = side((0, 7, 1.0), (0, 8, 2.0), (1, 1, 3.0), (1, 2, 5.0), (2, 1, 9.0))
    other_side = side((0, 8, 4.0), (0, 9, 6.0), (1, 3, 7.0))
    (first, second), paired = matched([base, other_side], [np.full(5, True), np.full(3, True)])
    assert first.index.tolist() == [(0, 8), (1, 1), (1, 2)]
    assert first.speed.tolist() == [2.0, 3.0, 5.0]
    assert second.index.tolist() == [(0, 8), (1, 3)]
    assert second.speed.tolist() == [4.0, 7.0]
    assert paired.tolist() == [0]


def test_a_lost_run_takes_its_partner_along_and_leaves_no_unpaired_run():
    """A common seed makes the unit paired even if the run of one side is lost."""
    base, other_side = side((0, 7, 1.0), (0, 8, 2.0)), side((0, 7, 4.0), (0, 8, 6.0))
    (first, second), paired = matched(
        [base, other_side], [np.array([False, True]), np.full(2, True)]
    )
    assert (first.speed.tolist(), second.speed.tolist(), paired.tolist()) == ([2.0], [6.0], [0])


@pytest.mark.parametrize("variants", [2, 3, 8])
def test_the_interval_over_variants_is_students_over_their_means(variants):
    """Four runs of each variant have little noise, so that the spread of the variants' means decides."""
    random = np.random.default_rng(variants)
    values = np.repeat(random.normal(0.3, 1.0, variants), 4)[:, None] + random.normal(
        0.0, 1e-3, (4 * variants, 1)
    )
    cell = np.repeat(np.arange(variants), 4)
    interval = two_stage(values, cell, np.arange(variants))
    means = values.reshape(variants, 4).mean(axis=1)
    low, high = stats.t.interval(0.95, variants - 1, means.mean(), stats.sem(means))
    assert (interval.estimate[0], interval.low[0], interval.high[0]) == pytest.approx(
        (means.mean(), low, high)
    )
    assert interval.p[0] == pytest.approx(stats.ttest_1samp(means, 0.0).pvalue)


def test_the_interval_of_one_variant_is_welchs():
    """Five runs of each side: Welch's test, whose degrees of freedom are below those of equal spreads."""
    random = np.random.default_rng(1)
    base, second = random.normal(0.0, 1.0, 5), random.normal(2.0, 1.0, 5)
    values = np.concatenate([second, -base])[:, None]
    interval = two_stage(values, np.repeat([0, 1], 5), np.zeros(2, int))
    expected = stats.ttest_ind(second, base, equal_var=False).confidence_interval(0.95)
    assert (interval.low[0], interval.high[0]) == pytest.approx((expected.low, expected.high))
