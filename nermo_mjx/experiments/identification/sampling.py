"""Points distributed uniformly over the part of a unit cube where an expensive objective is within a tolerance.

A sequential Monte Carlo sampler (adaptive multiple importance sampling; Cornuet et al., 2012). The prior is uniform
over the cube. A Sobol sample of it comes first; then, in each sweep, as many proposals from a mixture of normal
distributions around the best points, with their covariance, where the level decreases to the tolerance as points
permit. Every point ever evaluated is weighted by the prior over the mean proposal density of all sweeps, so that each
one within the tolerance counts, no matter which sweep found it, and the initial centres hardly matter. Since the Sobol
sample is part of that mean, no weight can exceed the number of sweeps plus one.

Metropolis moves from the same starts would cost the same and end with fewer distinct points, still close to them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist
from scipy.stats import qmc

#: Minimum number of centres of a mixture, as a fraction of a sweep's points.
_CENTRES: Final = 1 / 8
#: Share of the first sweep's proposals around the seeds.
_SEEDED: Final = 0.25
#: Number of draws to estimate the share of a mixture that lies in the cube.
_INSIDE: Final = 20_000


@dataclasses.dataclass(frozen=True)
class Sweep:
    """One sweep: how many points it proposed, the level its centres lay within, and the share within the tolerance."""

    proposed: int
    level: float
    acceptance: float


@dataclasses.dataclass(frozen=True)
class Sample:
    """Points within the tolerance.

    Attributes:
        points: in the cube, (m, d).
        costs: their objective, (m,).
        weights: of a uniform distribution over the region, (m,); their sum is 1.
        sweeps: the Sobol sample, and the sweeps after it.
        share: estimated share of the cube within the tolerance, a few per cent too low if it is small.
        effective: effective sample size (Kish).
    """

    points: np.ndarray
    costs: np.ndarray
    weights: np.ndarray
    sweeps: tuple[Sweep, ...]
    share: float
    effective: float


class _Mixture:
    """Normal distributions with a common covariance around centres (k, d), with shares (k,), truncated to the unit
    cube."""

    def __init__(
        self, centres: np.ndarray, shares: np.ndarray, covariance: np.ndarray, random: np.random.Generator
    ) -> None:
        self.centres, self.shares = centres, shares
        self.root = np.linalg.cholesky(covariance)
        self.inside = float(np.mean(_in_cube(self._unbounded(_INSIDE, random))))

    def draw(self, n: int, random: np.random.Generator) -> np.ndarray:
        """Points (n, d)."""
        points = np.empty((0, self.centres.shape[1]))
        while len(points) < n:
            drawn = self._unbounded(n, random)
            points = np.vstack([points, drawn[_in_cube(drawn)]])
        return points[:n]

    def density(self, points: np.ndarray) -> np.ndarray:
        """Density at points (n, d) of the cube, (n,); at a centre, that of the others, since it would find itself."""
        white, centres = (solve_triangular(self.root, each.T, lower=True).T for each in (points, self.centres))
        away = cdist(white, centres, "sqeuclidean")
        own = away == 0.0
        density = np.where(own, 0.0, np.exp(-0.5 * away)) @ self.shares / (1.0 - own @ self.shares)
        volume = (2 * np.pi) ** (points.shape[1] / 2) * np.prod(np.diag(self.root))
        return density / (volume * self.inside)

    def _unbounded(self, n: int, random: np.random.Generator) -> np.ndarray:
        chosen = random.choice(len(self.centres), n, p=self.shares)
        return self.centres[chosen] + random.standard_normal((n, self.centres.shape[1])) @ self.root.T


def sample(
    evaluate: Callable[[np.ndarray], np.ndarray],
    dimension: int,
    *,
    tolerance: float,
    size: int,
    sweeps: int,
    seed: int,
    seeds: np.ndarray | None = None,
) -> Sample:
    """Sample the region until the effective sample size reaches `size`, or for the given number of sweeps.

    Args:
        evaluate: objective of points (n, d), (n,).
        dimension: d.
        tolerance: of the objective.
        size: points per sweep, and requested effective sample size.
        sweeps: maximum number after the Sobol sample.
        seed: makes it repeatable.
        seeds: additional points (k, d) to start from; their origin does not matter.
    """
    random = np.random.default_rng((seed, dimension, size))
    points = qmc.Sobol(dimension, rng=random).random_base2(max(size - 1, 1).bit_length())[:size]
    fewest = min(max(dimension + 2, int(_CENTRES * size)), size)
    costs, mixtures, made = evaluate(points), list[_Mixture](), [Sweep(size, np.inf, 0.0)]
    while True:
        weights = _weights(points, mixtures)
        within = costs <= tolerance
        if len(made) > sweeps or _effective(weights[within]) >= size:
            break
        level = max(tolerance, float(np.sort(costs)[fewest - 1]))
        near = costs <= level
        mixtures.append(_mixture(points[near], weights[near], seeds if len(made) == 1 else None, random))
        proposed = mixtures[-1].draw(size, random)
        points, costs = np.vstack([points, proposed]), np.concatenate([costs, evaluate(proposed)])
        made.append(Sweep(size, level, 0.0))
    found = [dataclasses.replace(each, acceptance=float(np.mean(within[i * size : (i + 1) * size])))
             for i, each in enumerate(made)]  # fmt: skip
    share = float(np.sum(weights[within]) / len(points))
    total = weights[within].sum() or 1.0
    return Sample(points[within], costs[within], weights[within] / total, tuple(found), share,
                  _effective(weights[within]))  # fmt: skip


def thin(sample: Sample, n: int, seed: int) -> Sample:
    """At most n of the points, selected roughly in proportion to weight, so that the remaining weights are similar."""
    if len(sample.points) <= n:
        return sample
    taken = _inclusion(sample.weights, n)
    random = np.random.default_rng((seed, n))
    order = random.permutation(len(taken))
    # Systematic sampling: marks one apart on the line of the shares, from one random start.
    ends = np.cumsum(taken[order])
    marks = np.floor(ends - random.uniform())
    kept = np.sort(order[np.diff(marks, prepend=-1.0) > 0])
    weights = sample.weights[kept] / taken[kept]
    return dataclasses.replace(sample, points=sample.points[kept], costs=sample.costs[kept],
                               weights=weights / weights.sum())  # fmt: skip


def _inclusion(weights: np.ndarray, n: int) -> np.ndarray:
    """Probability that each point is among n, in proportion to its weight but at most 1, (m,)."""
    certain = np.zeros(len(weights), bool)
    while True:
        rest = np.where(certain, 0.0, weights)
        chance = np.where(certain, 1.0, rest * (n - certain.sum()) / rest.sum())
        over = (chance > 1.0) & ~certain
        if not over.any():
            return chance
        certain |= over


def _mixture(
    centres: np.ndarray, weights: np.ndarray, seeds: np.ndarray | None, random: np.random.Generator
) -> _Mixture:
    """Normal distributions about weighted centres, with the bandwidth of a density estimate (Silverman)."""
    shares, d = weights / weights.sum(), centres.shape[1]
    away = centres - shares @ centres
    covariance = (away.T * shares) @ away + 1e-4 * np.eye(d)
    width = (4 / ((d + 2) * _effective(weights))) ** (2 / (d + 4))
    if seeds is not None and len(seeds):
        centres = np.vstack([centres, seeds])
        shares = np.concatenate([(1 - _SEEDED) * shares, np.full(len(seeds), _SEEDED / len(seeds))])
    return _Mixture(centres, shares, width * covariance, random)


def _weights(points: np.ndarray, mixtures: list[_Mixture]) -> np.ndarray:
    """The prior's density, 1, over the mean proposal density; sweeps are of equal size."""
    proposed = np.ones(len(points))
    for mixture in mixtures:
        proposed += mixture.density(points)
    return (1 + len(mixtures)) / proposed


def _effective(weights: np.ndarray) -> float:
    return float(weights.sum() ** 2 / np.sum(weights**2)) if len(weights) else 0.0


def _in_cube(points: np.ndarray) -> np.ndarray:
    return np.all((points >= 0) & (points <= 1), axis=1)
