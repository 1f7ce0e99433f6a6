"""Multiple comparisons with the best: which points the data cannot tell from the best one, and which runs decide it.

Hsu (Ann. Stat. 12, 1984): a point may be the best unless its mean is further below the highest one than the largest
of its differences to the others would be by chance. Runs of a repeat share their draws, and count by their distance
from the repeat's mean (Nelson and Matejcik, Manage. Sci. 41, 1995). The noise of each point has its own variance,
moderated by those of the others. Points far below are left out first, at a tenth of the error, so that neither
their number nor their noise counts.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from typing import Final

import numpy as np
from scipy import optimize, special, stats

from nermo_mjx.plotting.shown import CONFIDENCE_LEVEL
from nermo_mjx.sweep.spec import SoughtOptimum

#: Probability of losing the best point before the last look, of all of 1 - `LEVEL`.
EARLY: Final = 0.01
#: Share of a look's error that the points far below take.
_SCREENED: Final = 0.1
#: Steps in which the weights of the points in the means of repeats are found.
_REWEIGHTINGS: Final = 3


@functools.lru_cache(4096)
def hsu_margin(points: int, freedom: int, level: float, skew: float = 0.0) -> float:
    """How many standard errors of a difference the best of some points lies below the highest mean by chance, at most.

    The quantile of the largest of k - 1 Student's t that share one of their two sides and the estimate of the noise; of
    means whose noise has a positive skewness, it is that of Pearson's third kind.

    >>> round(hsu_margin(2, 10, 0.95), 2), round(hsu_margin(5, 10, 0.95), 2)
    (1.81, 2.46)
    """
    middle, shares = (np.arange(100) + 0.5) / 100, (np.arange(60) + 0.5) / 60
    scale = np.sqrt(2 * stats.chi2.ppf(shares, freedom) / freedom)
    below, places = special.ndtr, special.ndtri(middle)
    if skew:
        shape = 4.0 / skew**2  # of a gamma distribution
        below, places = (
            functools.partial(special.gammainc, shape),
            special.gammaincinv(shape, middle),
        )
        scale *= math.sqrt(shape)

    def beyond(far: float) -> float:
        return float((below(places[:, None] + far * scale) ** (points - 1)).mean()) - level

    return float(optimize.brentq(beyond, 0.0, 500.0, xtol=1e-4))


def undistinguished(values: np.ndarray, level: float = CONFIDENCE_LEVEL) -> np.ndarray:
    """Which points may be the best, (k,) bool: the best one is among them with this probability at least.

    >>> undistinguished(np.array([[1.0, 5.0, 5.1], [1.1, 5.2, 5.1], [0.9, 5.1, 5.0], [1.0, 5.0, 5.0]])).tolist()
    [False, True, True]

    Args:
        values: of each repeat and point, (n, k), all finite; higher is better.
        level: the probability.
    """
    mean = values.mean(axis=0)
    best, contenders = int(mean.argmax()), np.full(len(mean), True)
    skew = _skewness(values) / math.sqrt(len(values))
    for share in (_SCREENED, 1 - _SCREENED):
        if (contender_count := int(contenders.sum())) > 1:
            variance, freedom = _noise_variance(values[:, contenders])
            difference_variance = np.zeros(len(mean))
            difference_variance[contenders] = variance
            difference_variance += difference_variance[best]
            margin = hsu_margin(
                contender_count, freedom, 1 - share * (1 - level), round(skew, 1)
            ) * np.sqrt(difference_variance / len(values))
            contenders &= mean >= mean[best] - margin
    return contenders


def _noise_variance(values: np.ndarray) -> tuple[np.ndarray, int]:
    """Variances of the noise of points (k,), and their degrees of freedom.

    Residuals of values (n, k) about the means of repeats and points. Differences to the best point would not do, because
    all of them contain the noise of this one point. Noisy points have little weight in the means of repeats.
    """
    repeats, points = values.shape
    deviations, weights = values - values.mean(axis=0), np.full(points, 1 / points)
    for _ in range(_REWEIGHTINGS):
        rest = deviations - (deviations @ weights)[:, None]
        variance, freedom = moderated_variance(
            (rest**2).sum(axis=0) / ((repeats - 1) * (1 - weights)),
            (repeats - 1) * (points - 1),
            repeats - 1,
        )
        if not variance.all():
            break
        weights = 1 / variance / (1 / variance).sum()
    return variance, freedom


def moderated_variance(
    variance: np.ndarray, all_together: int, freedom: int
) -> tuple[np.ndarray, int]:
    """Variances of several points, each moved towards their common value, and their degrees of freedom.

    The estimate is that of Smyth (Stat. Appl. Genet. Mol. Biol. 3, 2004): the more alike the variances are, the more
    they are moved. Variances that differ only by chance become equal, with the most degrees of freedom.

    >>> moderated_variance(np.array([1.0, 1.2, 0.9, 1.1]), 24, 8)
    (array([1.05, 1.05, 1.05, 1.05]), 24)

    Args:
        variance: Estimated variances (k,), of which some may be 0.
        all_together: Degrees of freedom of their mean.
        freedom: Degrees of freedom of each of them.

    Returns:
        The moderated variances (k,), and the degrees of freedom of each.
    """
    pooled = np.full(len(variance), variance.mean()), all_together
    logarithm = np.log(variance[variance > 0.0])
    excess = -math.inf
    if len(logarithm) > 1:
        excess = float(logarithm.var(ddof=1) - special.polygamma(1, freedom / 2))
    if excess <= special.polygamma(1, all_together / 2):
        return pooled
    prior_freedom = 2 * float(
        optimize.brentq(lambda half: float(special.polygamma(1, half)) - excess, 1e-3, 1e9)
    )
    offset, prior_offset = (
        float(special.digamma(half) - math.log(half)) for half in (freedom / 2, prior_freedom / 2)
    )
    prior = math.exp(float(logarithm.mean()) - offset + prior_offset)
    moderated = (prior_freedom * prior + freedom * variance) / (prior_freedom + freedom)
    return moderated, max(1, min(all_together, int(prior_freedom + freedom)))


def _skewness(values: np.ndarray) -> float:
    """Skewness of the noise of values (n, k) if it is positive, which makes the highest mean one of luck; otherwise 0.

    With fewer than three repeats or points nothing is known, and the result is 0. It is estimated from residuals about the
    means of repeats and points, whose second and third cumulants are smaller by known factors.
    """
    if min(values.shape) < 3:
        return 0.0
    rest = values - values.mean(axis=0) - values.mean(axis=1, keepdims=True) + values.mean()
    second, third = (
        math.prod(1 - m / size for size in values.shape for m in range(1, upto)) for upto in (2, 3)
    )
    square = float((rest**2).mean()) / second
    return max(0.0, float((rest**3).mean()) / third / square**1.5) if third * square > 0.0 else 0.0


@dataclasses.dataclass(frozen=True)
class Judged:
    """What the runs of k points tell of the best one.

    Attributes:
        best: its place; -1 where nothing can be told.
        region: the points that cannot be told from it, (k,) bool.
        contenders: the points with the fewest lost runs, (k,) bool; only they can be the best.
        runs: of each point of the region.
        spent: runs of the second stage.
        wanted: repeats and points that are to be run before more can be told, (m,) each.
        ended: why no more runs are wanted: `few` points are left, the `budget` is spent, or `lost`: of no two repeats
            all contenders have a number; empty while runs are wanted.
    """

    best: int
    region: np.ndarray
    contenders: np.ndarray
    runs: int
    spent: int
    wanted: tuple[np.ndarray, np.ndarray]
    ended: str


def judged(
    values: np.ndarray, is_there: np.ndarray, question: SoughtOptimum, repeats: int
) -> Judged:
    """Judge points by the runs that are there, one block of repeats after the other.

    Args:
        values: of each repeat and point, (n, k); higher is better; NaN where a run is lost or not there.
        is_there: which runs have been made, (n, k) bool.
        question: what is sought.
        repeats: runs of each point in the first block, and in each further one.
    """
    alive, block, spent, no_rows = (
        np.full(values.shape[1], True),
        np.arange(repeats),
        0,
        (np.empty(0, int),) * 2,
    )
    for look in itertools.count(1):
        lacking = (
            ~np.array(
                [is_there[i] if i < len(is_there) else np.zeros(len(alive), bool) for i in block]
            )
            & alive
        )
        if lacking.any():
            rows, points = np.nonzero(lacking)
            return Judged(-1, alive, alive, len(block), spent, (block[rows], points), "")
        is_finite = np.isfinite(values[block])
        lost_counts = (~is_finite).sum(axis=0)
        alive &= lost_counts == lost_counts[alive].min()
        used_values = values[block[is_finite[:, alive].all(axis=1)]][:, alive]
        if len(used_values) < 2:
            return Judged(-1, alive, alive, len(block), spent, no_rows, "lost")
        early_contenders, last, contenders = alive.copy(), alive.copy(), alive.copy()
        early_contenders[alive] = undistinguished(used_values, 1 - EARLY / 2**look)
        last[alive] = undistinguished(
            used_values, CONFIDENCE_LEVEL + (EARLY if question.budget else 0.0)
        )
        price, is_affordable = (
            int(early_contenders.sum()) * repeats,
            bool(question.budget) and early_contenders.sum() <= question.until,
        )
        best = int(np.flatnonzero(alive)[used_values.mean(axis=0).argmax()])
        if is_affordable or spent + price > question.budget:
            region = early_contenders if is_affordable else last
            is_affordable |= bool(question.budget) and region.sum() <= question.until
            return Judged(
                best,
                region,
                contenders,
                len(block),
                spent,
                no_rows,
                "few" if is_affordable else "budget",
            )
        alive, spent = early_contenders, spent + price
        begin = question.fresh + look * repeats
        block = np.append(block, np.arange(begin, begin + repeats))
    raise AssertionError("a budget is finite")
