"""Which metrics of a sweep have a better direction, and which: built-in metrics, and custom ones that declare it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import pyarrow as pa

from nermo_mjx.rollout import METRICS, Metric

#: Metrics with a better direction, and which one it is.
OBJECTIVES: Final = {
    "speed": "max",
    "cost_of_transport": "min",
    "servo_work": "min",
    "slip": "min",
    "roll_std": "min",
    "pitch_std": "min",
    "yaw_std": "min",
    "lateral_drift": "nearest zero",
}
_SIDES: Final = {"high": "max", "low": "min"}


def sides_of(metrics: Mapping[str, Metric]) -> dict[str, str]:
    """The metrics with a better direction, and which one it is.

    >>> sides_of(METRICS)["speed"]
    'max'
    """
    own = {name: _SIDES[about.better] for name, about in metrics.items() if name not in METRICS and about.better}
    return {name: side for name, side in OBJECTIVES.items() if name in metrics} | own


def sides_in(schema: pa.Schema) -> dict[str, str]:
    """The same of a table's columns."""
    about = {field.name: (field.metadata or {}).get(b"better") for field in schema}
    return sides_of({name: Metric("", "", better and better.decode()) for name, better in about.items()})


def cost(side: str, values: np.ndarray) -> np.ndarray:
    """Values of a metric with this better direction so that less is better; without one, less where it is higher."""
    return {"": -values, "max": -values, "min": values, "nearest zero": np.abs(values)}[side]
