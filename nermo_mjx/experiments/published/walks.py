"""Measures of walks on the straight line that several figures share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from nermo_mjx.experiments.cases import FREQUENCIES
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.published.measure import Number, clock

GAITS: Final = ("trt", "trt1", "lat")
#: The case that most figures are of.
TROT: Final = ("trt", 0.8)


def walk(
    column: str, gait: str, frequency: float, spine: bool, *, stride: float = 1.0, compensated: bool = False
) -> Number:
    """A column's mean over the repeats of one case."""

    def measure(outcome: Outcome, profile: str) -> float:
        case = {"gait": gait, "frequency": frequency, "spine": spine, "stride": stride, "compensated": compensated}
        return outcome.mean(column, profile=profile, **case)

    return measure


def speed(gait: str, frequency: float, spine: bool, stride: float = 1.0) -> Number:
    """Speed on the controller's clock [mm/s]."""
    measure = walk("speed", gait, frequency, spine, stride=stride)
    return lambda outcome, profile: 1e3 * clock(profile) * measure(outcome, profile)


def theory_speed(gait: str, frequency: float, spine: bool, stride: float = 1.0) -> Number:
    """The same without slip [mm/s]."""
    measure = walk("theory_speed", gait, frequency, spine, stride=stride)
    return lambda outcome, profile: 1e3 * clock(profile) * measure(outcome, profile)


def frequencies(outcome: Outcome) -> list[float]:
    """Frequencies at which all gaits were walked."""
    rows = outcome.where(gait="lat")
    return sorted(set(np.asarray(outcome.columns["frequency"], float)[rows].tolist()))


def mean_of(measure: Callable[[float], Number]) -> Number:
    """Mean of a figure over the published frequencies; NaN if one was not run."""
    return lambda outcome, profile: float(np.mean([measure(f)(outcome, profile) for f in FREQUENCIES]))


def at_each(compared: Callable[[float], list[Number]]) -> Callable[[Outcome, str], bool | None]:
    """Whether figures decrease from the first to the last at each frequency; None if one was not measured."""

    def measure(outcome: Outcome, profile: str) -> bool | None:
        rows = np.array([[each(outcome, profile) for each in compared(f)] for f in frequencies(outcome)])
        return bool((np.diff(rows, axis=1) < 0.0).all()) if np.isfinite(rows).all() else None

    return measure
