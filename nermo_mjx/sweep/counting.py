"""Which runs count: the one notion of a variant's runs, for every mean, rank, interval, pair and figure.

A run counts for a metric if it ended well and has a number for it; else it is lost. How a run ended counts of all runs.
Runs are repeats of a variant if all that is varied is the same, and partners if their seed is the same, too.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy import sparse, stats

from nermo_mjx.plotting.shown import CONFIDENCE_LEVEL, cost, half_width

if TYPE_CHECKING:
    import pandas as pd  # imported where it is used: it takes half a second

#: Metrics that say what became of a run; all runs have them.
OF_ALL_RUNS: Final = ("fell", "diverged")
#: Why a run that ended well is lost, beside the other statuses.
NO_NUMBER: Final = "no number"


def counts(name: str, values: np.ndarray, well: np.ndarray) -> np.ndarray:
    """Which runs (n,) count for a metric, of its values (n,) and whether the runs ended well (n,).

    >>> counts("speed", np.array([0.1, np.nan, 0.2]), np.array([True, True, False])).tolist()
    [True, False, False]
    """
    return np.isfinite(values) & (well | (name in OF_ALL_RUNS))


def losses(status: np.ndarray, good: np.ndarray) -> dict[str, int]:
    """Why runs (n,) do not count, and how many: their status, or `NO_NUMBER` where they ended well."""
    return dict(
        sorted(
            Counter(
                NO_NUMBER if reason == "ok" else reason for reason in status[~good].tolist()
            ).items()
        )
    )


def losses_text(losses_by_reason: Mapping[str, int]) -> str:
    """Numbers of failed runs by reason, in brackets, such as ` (3 fell, 1 no number)`; empty without any."""
    return (
        f" ({', '.join(f'{count:,} {why}' for why, count in losses_by_reason.items())})"
        if losses_by_reason
        else ""
    )


@dataclasses.dataclass(frozen=True)
class Tally:
    """A metric over the runs of v variants.

    Attributes:
        runs: of each variant, (v,), lost ones included.
        count: those that count, (v,).
        mean: of these, (v,); NaN without one.
        std: their standard deviation, (v,); NaN of fewer than two, whose spread is unknown.
    """

    runs: np.ndarray
    count: np.ndarray
    mean: np.ndarray
    std: np.ndarray

    @property
    def lost(self) -> np.ndarray:
        """The share of each variant's runs that is lost, (v,)."""
        return 1.0 - self.count / np.maximum(self.runs, 1)

    @property
    def half(self) -> np.ndarray:
        """Half the 95 % interval of each mean, (v,)."""
        return half_width(self.std, self.count)

    def ranked(self, side: str) -> np.ndarray:
        """The variants with a mean, the best first, (k,): one with lost runs comes after all with fewer lost.

        Args:
            side: which values are better, as `plotting.shown.cost` has it.
        """
        order = np.lexsort((cost(side, self.mean), self.lost))
        return order[np.isfinite(self.mean[order])]


@dataclasses.dataclass(frozen=True)
class Variants:
    """The variants of a table.

    Attributes:
        all: the number of variants, those without a run so far included.
        number: index of each that has runs, (variants,).
        first: its first run, (variants,).
        place: where the variant of each run stands here, (runs,).
        values: the varied parameters, name -> (variants,).
    """

    all: int
    number: np.ndarray
    first: np.ndarray
    place: np.ndarray
    values: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, variant: np.ndarray) -> Variants:
        """Of the variant of each run, (rows,)."""
        number, first, variant_index = np.unique(variant, return_index=True, return_inverse=True)
        return cls(int(variant.max()) + 1, number, first, variant_index)

    def tally(self, values: np.ndarray, good: np.ndarray) -> Tally:
        """A metric over the repeats, of its values (runs,) and which runs count, (runs,)."""
        good_index, good_values, size = (
            self.place[good],
            np.asarray(values[good], float),
            len(self.number),
        )
        count = np.bincount(good_index, minlength=size)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.bincount(good_index, good_values, size) / count
            square = np.bincount(
                good_index, (good_values - mean[good_index]) ** 2, size
            ) / np.where(count > 1, count - 1.0, np.nan)
        return Tally(np.bincount(self.place, minlength=size), count, mean, np.sqrt(square))


def same_values(values: np.ndarray) -> np.ndarray:
    """Values (n,), those that differ in their last digits by one of them; NaN stays NaN.

    >>> len(set(same_values(np.array([0.7, 7 * 0.1, 0.8])).tolist()))
    2
    """
    distinct, distinct_index = np.unique(values, return_inverse=True)
    with np.errstate(invalid="ignore"):
        is_new = ~(np.diff(distinct) <= 1e-12 * np.abs(distinct[1:]) + 1e-15)
    first = np.append(True, is_new)[: len(distinct)]
    return np.asarray(distinct[first][np.cumsum(first) - 1][distinct_index])


def sums(values: np.ndarray, index: np.ndarray, places: int) -> np.ndarray:
    """Sums of rows (n, m) by their place, (places, m), in the order of the rows."""
    rows = np.arange(len(index))
    return np.asarray(
        sparse.csr_matrix((np.ones(len(index)), (index, rows)), (places, len(index))) @ values
    )


# ---
# Partners: which runs of two sides are pairs.


def matched(
    sides: Sequence[pd.DataFrame], good: Sequence[np.ndarray]
) -> tuple[list[pd.DataFrame], pd.Index]:
    """The values of two sides over the units (variants, or those in a group) that both have.

    In a unit with a common seed, runs with the same seed are pairs, and the others are left out; in a unit without one,
    each side has its own runs. Runs of one unit and seed count once, by their mean.

    >>> import pandas as pd
    >>> keys = [pd.MultiIndex.from_arrays([[0, 0], seeds]) for seeds in ([7, 8], [8, 9])]
    >>> sides = [pd.DataFrame({"speed": [1.0, 2.0]}, index) for index in keys]
    >>> (first, second), paired = matched(sides, [np.array([True, True])] * 2)
    >>> first.index.get_level_values(1).tolist(), second.speed.tolist(), paired.tolist()
    ([8], [1.0], [0])

    Args:
        sides: a line a run, indexed by unit and seed.
        good: which runs count, (n,) of each side.

    Returns:
        Both sides, sorted, indexed by unit and seed; and the units whose runs are pairs, or would be.
    """
    paired = sides[0].index.intersection(sides[1].index).unique(0)
    means = [
        side[is_good].groupby(level=[0, 1]).mean()
        for side, is_good in zip(sides, good, strict=True)
    ]
    shared = means[0].index.intersection(means[1].index)
    kept_means = [
        mean[mean.index.isin(shared) | ~mean.index.isin(paired, level=0)] for mean in means
    ]
    common_groups = kept_means[0].index.unique(0).intersection(kept_means[1].index.unique(0))
    return [
        side_means[side_means.index.isin(common_groups, level=0)] for side_means in kept_means
    ], paired


# ---
# Intervals of a mean over variants whose runs are repeated, by Student's t; docs/comparisons.md says why.
#
# The variants' means alone tell how far off their mean is, whatever share of their spread is the noise of their runs,
# and whatever their numbers of runs (Ibragimov and Mueller, J. Bus. Econ. Stat. 28, 2010). Where they are closer
# together by chance than this noise allows, it has the wider interval, which counts. Of one variant it is all there is,
# by Welch's t, with no more degrees of freedom than if both sides had the same spread: few runs may have a small one.


#: Number of runs of a cell that may be equal by chance, because a metric has steps.
_FEW_RUNS: Final = 3


class Interval(NamedTuple):
    """Estimates of m metrics, (m,) each, or with groups (groups, m).

    Attributes:
        estimate: the mean over the variants.
        low, high: its 95 % confidence interval; NaN where the noise is unknown (one variant, and one run per cell).
        p: probability of an estimate as far from 0 by chance, two-sided; NaN without an interval.
    """

    estimate: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray


def two_stage(
    values: np.ndarray,
    cell: np.ndarray,
    variant: np.ndarray,
    group: np.ndarray | None = None,
    observed: np.ndarray | None = None,
) -> Interval:
    """The mean over variants of the sum of their cells' means, with its interval and p-value.

    >>> two_stage(np.array([[1.0], [1.0], [3.0], [3.0]]), np.array([0, 0, 1, 1]), np.array([0, 1])).estimate
    array([2.])

    Args:
        values: of each run, (n, m), all finite; those of the side to subtract carry a minus sign.
        cell: the cell of each run, (n,), from 0 to c - 1; runs of a cell are exchangeable.
        variant: the variant of each cell, (c,), from 0 to v - 1.
        group: the group of each variant, (v,), from 0 to g - 1; none is empty. Without it, all are one.
        observed: Values of each metric (k, m) whose smallest difference is its resolution. The noise of a cell of a few
            equal values is that of rounding to it, so that they do not make a certain mean. By default `values`; the
            resolution of values that are all equal is then their magnitude, and 1 for zeros.
    """
    cells, variants = len(variant), int(variant.max()) + 1
    owner_group = np.zeros(variants, int) if group is None else group
    groups, owner = int(owner_group.max()) + 1, owner_group[variant]
    count, several = (
        np.bincount(cell, minlength=cells)[:, None],
        np.bincount(owner_group, minlength=groups)[:, None],
    )
    freedom, single = np.maximum(count - 1, 1), several == 1
    mean = sums(values, cell, cells) / count
    rounding = 1e-12 * np.abs(values).max(axis=0)
    noise = sums(_without(values - mean[cell], rounding) ** 2, cell, cells) / (count * freedom)
    tied = (noise == 0.0) & (count > 1) & (count <= _FEW_RUNS)
    for metric in np.flatnonzero(tied.any(axis=0)):
        resolution = (
            resolution_of(values[:, metric]) or float(np.abs(values[:, metric]).max()) or 1.0
            if observed is None
            else resolution_of(observed[:, metric])
        )
        noise[tied[:, metric], metric] = resolution**2 / 12 / count[tied[:, metric], 0]
    rest_sums = _without(sums(mean, variant, variants), rounding)
    estimate = sums(rest_sums, owner_group, groups) / several
    across = sums(
        _without(rest_sums - estimate[owner_group], rounding) ** 2, owner_group, groups
    ) / (several * np.maximum(several - 1, 1))
    within_variance = sums(noise, owner, groups)
    with np.errstate(divide="ignore", invalid="ignore"):
        welch, largest_freedom = (
            sums(squares, owner, groups) ** 2 / sums(squares**2 / freedom, owner, groups)
            for squares in (noise, 1.0 / count)
        )
        degrees = np.where(single, np.fmin(welch, largest_freedom), several - 1.0)
        error, smallest_error = (
            np.sqrt(np.where(single, within_variance, across)),
            np.sqrt(within_variance) / several,
        )
        half = np.maximum(
            stats.t.ppf((1 + CONFIDENCE_LEVEL) / 2, degrees) * error,
            stats.norm.ppf((1 + CONFIDENCE_LEVEL) / 2) * smallest_error,
        )
        far = np.abs(estimate) / error, np.abs(estimate) / smallest_error
        p = 2 * np.where(
            estimate == 0, 0.5, np.maximum(stats.t.sf(far[0], degrees), stats.norm.sf(far[1]))
        )
    unknown = single & (sums((count == 1) * 1.0, owner, groups) > 0)
    half, p = np.where(unknown, np.nan, half), np.where(unknown, np.nan, p)
    estimates = (estimate, estimate - half, estimate + half, p)
    return Interval(*((part[0] for part in estimates) if group is None else estimates))


def resolution_of(values: np.ndarray) -> float:
    """Smallest difference between two different values of (n,); 0 if all are equal.

    >>> resolution_of(np.array([2.0, 5.0, 2.0])), resolution_of(np.array([4.0, 4.0]))
    (3.0, 0.0)
    """
    distinct = np.unique(same_values(values[np.isfinite(values)]))
    return float(np.diff(distinct).min()) if len(distinct) > 1 else 0.0


def _without(values: np.ndarray, rounding: np.ndarray) -> np.ndarray:
    """Values (n, m) without what is rounding, (m,)."""
    return np.where(np.abs(values) <= rounding, 0.0, values)
