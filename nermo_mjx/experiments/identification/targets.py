"""Targets of the identification: published speeds on the straight line, the cases that give them, the objective."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from nermo_mjx.experiments.cases import AMPLITUDE, Case


@dataclasses.dataclass(frozen=True)
class Target:
    """A published ratio of speeds: its value, or a lower bound if only an order is published.

    Attributes:
        low, high: published interval; equal for a value.
        tolerance: deviation of the logarithm that counts as one.
    """

    low: float
    high: float
    tolerance: float

    def residual(self, value: np.ndarray) -> np.ndarray:
        """Deviation from the interval in tolerances, signed; NaN if undefined."""
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.log(value)
        over = np.maximum(logarithm - math.log(self.high), 0.0) if math.isfinite(self.high) else 0.0
        return (over + np.minimum(logarithm - math.log(self.low), 0.0)) / self.tolerance


def _value(ratio: float) -> Target:
    return Target(ratio, ratio, 0.1)


#: An order: at least this ratio.
_ORDER: Final = Target(1.0, math.inf, 0.02)
#: Section 6.2.1 of the publication; the spine makes the trot faster by between 5 % and 22 %, the latter at 0.8 Hz.
TARGETS: Final[dict[str, Target]] = {
    "trt, 0.8 Hz, over theory": _value(0.9),
    "trt, 0.8 Hz, spine over none": _value(1.22),
    "trt, 0.5 Hz, spine over none": Target(1.05, 1.22, 0.1),
    "trt1, 0.8 Hz, spine over none": _ORDER,
    "trt1, 0.5 Hz, spine over none": _ORDER,
    "trt, 0.8 Hz, over lat": _value(1.27),
    "trt with spine, 0.8 Hz, over lat": _value(1.48),
    "trt, 0.8 Hz, over trt1": _ORDER,
    "trt, 0.5 Hz, over trt1": _ORDER,
    "trt1, 0.8 Hz, over lat": _ORDER,
    "trt1, 0.5 Hz, over lat": _ORDER,
}

CASES: Final = tuple(
    Case(
        {"gait": gait, "frequency": frequency, "spine": spine},
        gait,
        values={"frequency": frequency, "spine.amplitude": AMPLITUDE * spine},
    )
    for frequency in (0.5, 0.8)
    for gait, spine in (("trt", False), ("trt", True), ("trt1", False), ("trt1", True), ("lat", False))
)
#: No-slip speed of the trot at 0.8 Hz (5.22) [m/s].
_THEORY: Final = 0.096
#: Objective of a candidate that falls, diverges, or walks backwards: worse than any completed walk.
FAILED: Final = 10.0


def figures(speed: np.ndarray) -> dict[str, np.ndarray]:
    """The figures of `TARGETS` from speeds of shape (candidates, cases)."""

    def at(gait: str, frequency: float, spine: bool = False) -> np.ndarray:
        cases = [tuple(case.labels.values()) for case in CASES]
        return np.asarray(speed[:, cases.index((gait, frequency, spine))])

    return {
        "trt, 0.8 Hz, over theory": at("trt", 0.8) / _THEORY,
        "trt, 0.8 Hz, spine over none": at("trt", 0.8, True) / at("trt", 0.8),
        "trt, 0.5 Hz, spine over none": at("trt", 0.5, True) / at("trt", 0.5),
        "trt1, 0.8 Hz, spine over none": at("trt1", 0.8, True) / at("trt1", 0.8),
        "trt1, 0.5 Hz, spine over none": at("trt1", 0.5, True) / at("trt1", 0.5),
        "trt, 0.8 Hz, over lat": at("trt", 0.8) / at("lat", 0.8),
        "trt with spine, 0.8 Hz, over lat": at("trt", 0.8, True) / at("lat", 0.8),
        "trt, 0.8 Hz, over trt1": at("trt", 0.8) / at("trt1", 0.8),
        "trt, 0.5 Hz, over trt1": at("trt", 0.5) / at("trt1", 0.5),
        "trt1, 0.8 Hz, over lat": at("trt1", 0.8) / at("lat", 0.8),
        "trt1, 0.5 Hz, over lat": at("trt1", 0.5) / at("lat", 0.5),
    }


def objective(found: Mapping[str, np.ndarray], failed: np.ndarray) -> np.ndarray:
    """Root of the mean squared residual of each candidate; `failed` ones, and what is not a number, count as 10."""
    squares = np.mean([TARGETS[name].residual(found[name]) ** 2 for name in TARGETS], axis=0)
    return np.where(failed | ~np.isfinite(squares), FAILED, np.sqrt(squares))
