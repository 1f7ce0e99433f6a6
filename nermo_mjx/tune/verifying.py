"""Verification of start and best: simulated in MuJoCo C, from starts that the tuning has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from nermo_mjx.rollout.start import START_SPREAD
from nermo_mjx.sweep.simulating import SimulatorLike
from nermo_mjx.tune.objective import TRAJECTORY_ERROR
from nermo_mjx.tune.simulated import SimulatedProblem
from nermo_mjx.tune.spec import Tuning

#: Walks of each point.
WALKS: Final = 8
#: Tells these draws from all others of a tuning's seed.
_UNSEEN: Final = 0x5EED


def verified(tuning: Tuning, points: Mapping[str, Mapping[str, float]], simulator: SimulatorLike) -> dict[str, Any]:
    """Results of named points on the engine `c`, each simulated from the same few slightly different starts.

    Starts are spread like those of a sweep's repeats. A walk that is compared with a recording has its start, and is
    simulated once.

    Args:
        points: name -> values of the tuned parameters.

    Returns:
        `engine`, `walks`, and of each point under its name `walks_ok`, the means `objective` and `metrics` over the
        completed walks, and `lowest` and `highest` objective of them; None if there are none.
    """
    alone = TRAJECTORY_ERROR in tuning.objective.metrics
    walks = 1 if alone else WALKS
    problem = SimulatedProblem(tuning, simulator=simulator)
    rng = np.random.default_rng([tuning.seed, _UNSEEN])
    known = {*tuning.constants, *tuning.names}
    spread = {name: rng.uniform(-width, width, walks) for name, width in START_SPREAD.items()
              if name in tuning.parameters and name not in known and not alone}  # fmt: skip
    at = np.repeat([[each[name] for name in tuning.names] for each in points.values()], walks, axis=0)
    value, metrics, ok = problem.walk(at, {name: np.tile(column, len(points)) for name, column in spread.items()})
    found: dict[str, Any] = {"engine": "c", "walks": walks}
    for i, name in enumerate(points):
        mine = np.arange(i * walks, (i + 1) * walks)
        mine = mine[ok[mine]]
        found[name] = None if not len(mine) else {
            "walks_ok": len(mine),
            "objective": float(value[mine].mean()),
            "lowest": float(value[mine].min()),
            "highest": float(value[mine].max()),
            "metrics": {metric: float(metrics[metric][mine].mean()) for metric in tuning.objective.metrics},
        }  # fmt: skip
    return found
