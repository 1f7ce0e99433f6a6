"""Tests of nermo_mjx.sweep.counting: which runs of two sides are compared."""

from __future__ import annotations

import numpy as np
import pandas as pd

from nermo_mjx.sweep.counting import matched


def side(*runs: tuple[int, int, float]) -> pd.DataFrame:
    """Runs as (unit, seed, speed)."""
    unit, seed, speed = zip(*runs, strict=True)
    return pd.DataFrame({"speed": speed}, pd.MultiIndex.from_arrays([unit, seed]))


def test_units_with_a_common_seed_have_pairs_and_others_keep_their_own_runs():
    """Unit 0: the runs of seed 8. Unit 1: no common seed, so that all runs count. Unit 2 is on one side alone."""
    base = side((0, 7, 1.0), (0, 8, 2.0), (1, 1, 3.0), (1, 2, 5.0), (2, 1, 9.0))
    other = side((0, 8, 4.0), (0, 9, 6.0), (1, 3, 7.0))
    (first, second), paired = matched([base, other], [np.full(5, True), np.full(3, True)])
    assert first.index.tolist() == [(0, 8), (1, 1), (1, 2)]
    assert first.speed.tolist() == [2.0, 3.0, 5.0]
    assert second.index.tolist() == [(0, 8), (1, 3)]
    assert second.speed.tolist() == [4.0, 7.0]
    assert paired.tolist() == [0]


def test_a_lost_run_takes_its_partner_along_and_leaves_no_unpaired_run():
    """A common seed makes the unit paired even if the run of one side is lost."""
    base, other = side((0, 7, 1.0), (0, 8, 2.0)), side((0, 7, 4.0), (0, 8, 6.0))
    (first, second), paired = matched([base, other], [np.array([False, True]), np.full(2, True)])
    assert (first.speed.tolist(), second.speed.tolist(), paired.tolist()) == ([2.0], [6.0], [0])
