"""The identification's uncertainty: many bodies that match the published speeds about as well as the best one.

The free parameters are the identified ones and, within plausible ranges, the friction of soles and tail. Prior: uniform
in the logarithms within the bounds. A body belongs to the ensemble if its objective is within a tolerance that was
fixed beforehand; within the tolerance, all are equivalent. `sampling` describes how they are found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final

import numpy as np

from nermo_mjx.experiments.identification.candidates import Candidates
from nermo_mjx.experiments.identification.sampling import Sweep, sample, thin
from nermo_mjx.experiments.identification.space import UNCERTAIN, names, parameters_of, point_of

#: Maximum objective of a body in the ensemble: half of the deviation declared acceptable, at which all targets are off
#: by one tolerance each.
TOLERANCE: Final = 0.5


@dataclasses.dataclass(frozen=True)
class Bodies:
    """An ensemble of n bodies; the first is the default body, if that is within the tolerance.

    Attributes:
        values: model parameter -> (n,).
        objective: (n,).
        weights: (n,); their sum is 1.
        tolerance: of the objective.
        sweeps: of the sampler that found them.
        found: distinct bodies within the tolerance, from which these were selected.
        effective: effective sample size of those found.
        share: estimated share of the prior within the tolerance.
    """

    values: dict[str, np.ndarray]
    objective: np.ndarray
    weights: np.ndarray
    tolerance: float
    sweeps: tuple[Sweep, ...]
    found: int
    effective: float
    share: float


def find_bodies(
    candidates: Candidates,
    best: Mapping[str, float],
    objective: float,
    near: np.ndarray,
    *,
    defaults: Mapping[str, float],
    bodies: int,
    sweeps: int,
    tolerance: float,
    seed: int,
) -> Bodies:
    """Sample the bodies within the tolerance.

    Args:
        candidates: of the space with the friction of sole and tail.
        best: result of the search, at the default frictions, and its objective; becomes the first body.
        near: the search's points within the tolerance, (k, d of the search); the first sweep also starts around them.
        defaults: of all parameters.
        bodies: requested number; sweeps: maximum number.
    """
    friction = point_of(defaults, UNCERTAIN)
    seeds = np.hstack([near, np.tile(friction, (len(near), 1))])
    space = candidates.space
    found = sample(candidates.evaluate, len(space), tolerance=tolerance, size=bodies, sweeps=sweeps, seed=seed,
                   seeds=seeds)  # fmt: skip
    first = objective <= tolerance
    kept = thin(found, bodies - first, seed)
    drawn = parameters_of(kept.points, space)
    values = {name: drawn[name] for name in names(space)}
    costs, weights = kept.costs, kept.weights
    if first:
        values = {name: np.append(best.get(name, defaults[name]), column) for name, column in values.items()}
        costs = np.append(objective, costs)
        # The default body has the average weight of the others.
        weights = np.append(1.0, weights * len(weights)) / (1 + len(weights))
    return Bodies(values, costs, weights, tolerance, found.sweeps, len(found.points), found.effective, found.share)
