"""Confidence intervals of a mean over variants whose runs are repeated: a two-stage bootstrap.

Variants are drawn with replacement, and within each drawn variant its runs. Both stages together would count the runs'
noise twice, because the variants' means already contain it, so these are shrunk towards their mean first (Davison and
Hinkley, Bootstrap Methods and their Application, 1997, section 3.8; Ng, Grieve and Carpenter, Stata Journal 13, 2013).
Few repeats are treated with caution: deviations from a mean of n are scaled by sqrt(n / (n - 1)), and the whole by
the ratio of Student's t quantile to the normal one. `scipy.stats.bootstrap` has one stage only.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from scipy import stats

#: Resamples; the same ones in each call, so that the same table gives the same intervals.
RESAMPLES: Final = 4000
#: Variants above which only their means are resampled: that many show the runs' noise without a second stage.
MANY_VARIANTS: Final = 400
#: Variants above which nothing is resampled: the resampled mean of that many is normal.
MOST_DRAWN: Final = 10_000
_LEVEL: Final = 0.95
#: Numbers of a block of resamples that are held at once.
_HELD: Final = 4_000_000


@dataclasses.dataclass(frozen=True)
class Interval:
    """Estimates of m metrics, (m,) each.

    Attributes:
        estimate: the mean over the variants.
        low, high: its 95 % confidence interval; NaN where the noise is unknown (one variant, and one run per cell).
        p: probability of an estimate as far from 0 by chance, two-sided; NaN without an interval. It is the larger of
            the share of resamples beyond 0 and Student's t, because few runs have no resamples far out.
    """

    estimate: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray


def two_stage(values: np.ndarray, cell: np.ndarray, variant: np.ndarray) -> Interval:
    """The mean over variants of the sum of their cells' means.

    >>> two_stage(np.array([[1.0], [1.0], [3.0], [3.0]]), np.array([0, 0, 1, 1]), np.array([0, 1])).estimate
    array([2.])

    Args:
        values: of each run, (n, m), all finite; those of the side to subtract carry a minus sign.
        cell: the cell of each run, (n,), from 0 to c - 1; runs of a cell are exchangeable.
        variant: the variant of each cell, (c,), from 0 to v - 1.
    """
    cells, variants = len(variant), int(variant.max()) + 1
    count = np.bincount(cell, minlength=cells)
    mean = _sums(values, cell, cells) / count[:, None]
    apart = values - mean[cell]
    rounding = 1e-12 * np.abs(values).max(axis=0)
    apart[np.abs(apart) <= rounding] = 0.0
    # Squared standard error of each cell's mean; unknown for a single run.
    noise = _sums(apart**2, cell, cells) / (count * np.maximum(count - 1, 1))[:, None]
    each = _sums(mean, variant, variants)
    each[np.abs(each) <= rounding] = 0.0
    estimate = each.mean(axis=0)
    within = noise.sum(axis=0) / variants**2
    across = each.var(axis=0, ddof=1) / variants if variants > 1 else np.zeros_like(within)
    deviation, shrink = each - estimate, np.ones_like(within)
    runs_too = variants <= MANY_VARIANTS
    if runs_too:
        shrink = np.sqrt(np.maximum(1 - np.divide(within, across, out=np.ones_like(within), where=across > 0), 0))
    deviation = deviation * shrink * np.sqrt(variants / max(variants - 1, 1))
    apart = apart * np.sqrt(count / np.maximum(count - 1, 1))[cell][:, None]
    rng, drawn = np.random.default_rng(0), np.empty((RESAMPLES, values.shape[1]))
    members = np.split(np.argsort(cell, kind="stable"), np.cumsum(count)[:-1])
    block = max(1, _HELD // max(variants, len(cell)))
    if variants > MOST_DRAWN:
        drawn[:] = rng.normal(size=(RESAMPLES, 1)) * np.sqrt(across)
    for start in range(0, RESAMPLES if variants <= MOST_DRAWN else 0, block):
        size = min(block, RESAMPLES - start)
        picked = rng.integers(variants, size=(size, variants)) + variants * np.arange(size)[:, None]
        often = np.bincount(picked.ravel(), minlength=size * variants).reshape(size, variants)
        part = often @ deviation
        for k, runs in enumerate(members) if runs_too else ():
            picks = rng.multinomial(often[:, variant[k]] * len(runs), np.full(len(runs), 1 / len(runs)))
            part += picks @ apart[runs] / len(runs)
        drawn[start : start + size] = part / variants
    freedom = _freedom(noise / variants**2, count, np.maximum(across - within, 0), variants)
    drawn *= stats.t.ppf((1 + _LEVEL) / 2, freedom) / stats.norm.ppf((1 + _LEVEL) / 2)
    unknown = variants == 1 and bool((count == 1).any())
    low, high = estimate + np.quantile(drawn, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2], axis=0)
    p = _chance(estimate, drawn, np.maximum(across, within), freedom)
    nan = np.full_like(estimate, np.nan)
    return Interval(estimate, *((nan, nan, nan) if unknown else (low, high, p)))


def _sums(values: np.ndarray, place: np.ndarray, places: int) -> np.ndarray:
    """Sums of rows (n, m) by their place, (places, m)."""
    total = np.zeros((places, values.shape[1]))
    np.add.at(total, place, values)
    return total


def _freedom(noise: np.ndarray, count: np.ndarray, between: np.ndarray, variants: int) -> np.ndarray:
    """Degrees of freedom of the variance of the estimate (m,), by Satterthwaite's rule.

    Args:
        noise: each cell's share of that variance, (c, m), and `count` its runs, (c,).
        between: what the variants add, (m,), beyond the noise of their runs.
    """
    known = count > 1
    square = (noise[known] ** 2 / (count[known] - 1)[:, None]).sum(axis=0) + between**2 / max(variants - 1, 1)
    whole = (noise.sum(axis=0) + between) ** 2
    return np.divide(whole, square, out=np.full_like(whole, np.inf), where=square > 0)


def _chance(estimate: np.ndarray, drawn: np.ndarray, variance: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    beyond = np.minimum((estimate + drawn <= 0).sum(axis=0), (estimate + drawn >= 0).sum(axis=0))
    far = np.divide(np.abs(estimate), np.sqrt(variance), out=np.full_like(estimate, np.inf), where=variance > 0)
    student = 2 * stats.t.sf(far, freedom)
    p = np.minimum(np.maximum(2 * (beyond + 1) / (len(drawn) + 1), student), 1.0)
    return np.where(estimate == 0, 1.0, p)
