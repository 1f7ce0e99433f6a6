"""How a figure is measured: small functions from an outcome and a profile to a value, and how they are joined."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from nermo_mjx.control.parameters import PUBLISHED_CLOCK_RATIO
from nermo_mjx.experiments.line import Value
from nermo_mjx.experiments.outcome import Outcome

Measure = Callable[[Outcome, str], Value]
Number = Callable[[Outcome, str], float]
#: Source of figures of the hardware, which the twin is compared with as well.
HARDWARE: Final = "hardware, 7.1"


def clock(profile: str) -> float:
    """Simulated seconds per second of the controller's clock."""
    return PUBLISHED_CLOCK_RATIO if profile == "as_published" else 1.0


def quotient(above: Number, below: Number) -> Number:
    """One figure over another; NaN over zero."""

    def measure(outcome: Outcome, profile: str) -> float:
        numerator, denominator = above(outcome, profile), below(outcome, profile)
        return numerator / denominator if denominator else float("nan")

    return measure


def below(one: Number, other: Number) -> Number:
    """By what share one figure is below another."""
    ratio = quotient(one, other)
    return lambda outcome, profile: 1.0 - ratio(outcome, profile)


def degrees(measure: Number) -> Number:
    """A figure in radians as degrees."""
    return lambda outcome, profile: float(np.degrees(measure(outcome, profile)))
