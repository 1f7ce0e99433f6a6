"""What the runs of a batch say about its points: costs, measures, and whether constraints hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from nermo_mjx.search.sections import Aim


@dataclasses.dataclass(frozen=True)
class Scores:
    """Results of n points.

    Attributes:
        cost: (n, k), less is better: one column for one objective, of a front one for each; NaN where a run failed.
        measures: (n, m) of an atlas; NaN where a run failed.
        violation: how far the constraints are from holding, (n,), each in units of its bound; 0 where they hold.
        ok: whether all runs walked to the end with finite numbers, (n,).
        jacobian: of the first g points, d (quality, *measures) / d fractions of the bounds, (g, 1 + m, p), where the
            quality is minus the cost; None if not requested.
    """

    cost: np.ndarray
    measures: np.ndarray
    violation: np.ndarray
    ok: np.ndarray
    jacobian: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.ok)

    @property
    def allowed(self) -> np.ndarray:
        """Points (n,) that walked to the end and keep to the constraints."""
        return self.ok & (self.violation == 0.0)

    @property
    def quality(self) -> np.ndarray:
        """Of one objective, more is better (n,)."""
        return -self.cost[:, 0]

    def joined(self, other: Scores) -> Scores:
        """These points, then the others; without gradients."""
        both = {name: np.concatenate([getattr(self, name), getattr(other, name)])
                for name in ("cost", "measures", "violation", "ok")}  # fmt: skip
        return Scores(**both)


def scores_of(aim: Aim, repeats: int, metrics: Mapping[str, np.ndarray], well: np.ndarray) -> Scores:
    """The scores of points, each with all of its repeats side by side.

    A metric counts by its mean over the repeats. A point of which one run failed counts as the worst.

    Args:
        metrics: name -> (n * repeats,), at least those of the aim.
        well: which runs succeeded (n * repeats,).
    """
    means = {name: np.asarray(metrics[name], float).reshape(-1, repeats).mean(axis=1) for name in aim.metrics}
    ok: np.ndarray = np.logical_and.reduce(np.asarray(well, bool).reshape(-1, repeats), axis=1)
    terms = [np.asarray(term.value(means[term.metric]), float) for term in aim.objective.terms]
    cost = np.stack(terms, axis=1) if aim.pareto else np.sum(terms, axis=0)[:, None]
    measures = np.empty((len(ok), len(aim.measures)))
    for i, measure in enumerate(aim.measures):
        measures[:, i] = means[measure.metric]
    violation = np.zeros(len(ok))
    for limit in aim.limits:
        value, unit = means[limit.metric], max(abs(b) for b in (limit.low, limit.high) if np.isfinite(b)) or 1.0
        violation += np.maximum(value - limit.high, 0.0) / unit + np.maximum(limit.low - value, 0.0) / unit
    ok &= np.isfinite(cost).all(axis=1) & np.isfinite(measures).all(axis=1) & np.isfinite(violation)
    lost = ~ok
    cost[lost], measures[lost], violation[lost] = np.nan, np.nan, np.nan
    return Scores(cost, measures, violation, ok)


def ranked_cost(scores: Scores, worst: float) -> np.ndarray:
    """One finite cost a point (n,), by which any method can rank: allowed points, then the least violation, then falls.

    Args:
        worst: highest cost of an allowed point so far; it only has to be finite.
    """
    cost = np.where(scores.allowed, scores.cost[:, 0], worst + 1.0 + np.nan_to_num(scores.violation))
    fallen = worst + 2.0 + np.nanmax(np.append(scores.violation, 0.0))
    return np.where(scores.ok, cost, fallen)


def cells_of(aim: Aim, measures: np.ndarray) -> np.ndarray:
    """The cell of each point of an atlas, (n,): the last measure runs fastest; -1 outside of the ranges, or lost.

    Args:
        measures: (n, m).
    """
    cell, inside = np.zeros(len(measures), int), np.isfinite(measures).all(axis=1)
    for values, measure in zip(np.where(inside[:, None], measures, 0.0).T, aim.measures, strict=True):
        inside &= (values >= measure.low) & (values <= measure.high)
        place = np.floor((values - measure.low) / (measure.high - measure.low) * measure.cells)
        cell = cell * measure.cells + np.clip(place, 0, measure.cells - 1).astype(int)
    return np.where(inside, cell, -1)


def elites_of(aim: Aim, scores: Scores) -> tuple[np.ndarray, np.ndarray]:
    """Filled cells in order, (k,), and the best allowed point of each, (k,); of equal points the first."""
    cell = np.where(scores.allowed, cells_of(aim, scores.measures), -1)
    order = np.lexsort((np.arange(len(cell)), -scores.quality, cell))
    order = order[cell[order] >= 0]
    cells, first = np.unique(cell[order], return_index=True)
    return cells, order[first]
