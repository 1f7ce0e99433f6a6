# Tests of plotting/charts.py, plotting/shown.py
"""Cells of heat maps, colour scales, and intervals of means."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from nermo_mjx.plotting.charts import cell_edges, cell_means, colour_scale
from nermo_mjx.plotting.shown import half_width


def test_cells_end_half_way_between_their_centres():
    """The first cell and the last reach as far outward as inward, also on a logarithmic axis."""
    np.testing.assert_allclose(
        cell_edges(np.array([1.0, 2.0, 4.0]), log=False), [0.5, 1.5, 3.0, 5.0]
    )
    edges = cell_edges(np.array([1.0, 10.0, 1000.0]), log=True)
    np.testing.assert_allclose(np.log10(edges), [-0.5, 0.5, 2.0, 4.0])
    low, high = cell_edges(np.array([5.0]), log=False)
    assert low < 5.0 < high


def test_values_of_a_cell_are_averaged_and_an_empty_cell_is_empty():
    """Three columns and two rows; a lost run does not count."""
    x, y = np.array([0.0, 0.0, 1.0, 2.0, 2.0]), np.array([5.0, 5.0, 5.0, 6.0, 6.0])
    means = cell_means(
        x,
        y,
        np.array([1.0, 3.0, 4.0, np.nan, 7.0]),
        np.array([0.0, 1.0, 2.0]),
        np.array([5.0, 6.0]),
    )
    np.testing.assert_array_equal(means, [[2.0, np.nan], [4.0, np.nan], [np.nan, 7.0]])


@pytest.mark.parametrize("count", [2, 3, 10, 200])
def test_the_interval_of_a_mean_is_students(count):
    values = np.random.default_rng(count).normal(size=count)
    low, high = stats.t.interval(0.95, count - 1, values.mean(), stats.sem(values))
    assert half_width(values.std(ddof=1), count) == pytest.approx((high - low) / 2)
    assert np.isnan(half_width(1.0, 1))


def test_few_outliers_do_not_take_the_colours():
    """One value of a hundred is far away: the scale ends before it, and says at which end."""
    values = np.append(np.arange(99.0), 1000.0)
    scale, extend = colour_scale(values)
    assert (scale.vmin, extend) == (0.0, "max")
    assert 90.0 < scale.vmax < 100.0
    scale, extend = colour_scale(-values)
    assert (scale.vmax, extend) == (0.0, "min")
