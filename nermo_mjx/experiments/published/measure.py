"""How a figure is measured: small functions from an outcome and a profile to a value, and combinators for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

import numpy as np

from nermo_mjx.control.published import PUBLISHED_CLOCK_RATIO
from nermo_mjx.experiments.judgement import Judgement
from nermo_mjx.experiments.line import Figure, Kind, Value
from nermo_mjx.experiments.outcome import Outcome

Measure = Callable[[Outcome, str], Value]
Number = Callable[[Outcome, str], float]
#: Source of the hardware's figures, with which the twin is also compared.
HARDWARE: Final = "hardware, 7.1"


class Maker(Protocol):
    """Makes figures of one kind; arguments as of `line.Figure`."""

    def __call__(
        self, name: str, reported: Judgement, measure: Measure, unit: str = "", source: str | None = None
    ) -> Figure:
        """A figure."""


def figures_of(kind: Kind, source: str) -> Maker:
    """Makes figures of a kind, with this default source."""
    own = source

    def figure(
        name: str, reported: Judgement, measure: Measure, unit: str = "", source: str | None = None
    ) -> Figure:  # fmt: skip
        return Figure(name, kind, reported, measure, unit, own if source is None else source)

    return figure


def clock(profile: str) -> float:
    """Simulated seconds per second of the controller's clock."""
    return PUBLISHED_CLOCK_RATIO if profile == "as_published" else 1.0


def column(name: str, scale: float = 1.0, **case: object) -> Number:
    """A column's mean over the repeats of a case, times a factor."""
    return lambda outcome, profile: scale * outcome.mean(name, profile=profile, **case)


def quotient(above: Number, below: Number) -> Number:
    """One figure over another; NaN over zero."""

    def measure(outcome: Outcome, profile: str) -> float:
        numerator, denominator = above(outcome, profile), below(outcome, profile)
        return numerator / denominator if denominator else float("nan")

    return measure


def below(one: Number, other: Number) -> Number:
    """Relative difference by which one figure is below another."""
    ratio = quotient(one, other)
    return lambda outcome, profile: 1.0 - ratio(outcome, profile)


def degrees(measure: Number) -> Number:
    """A figure in radians as degrees."""
    return lambda outcome, profile: float(np.degrees(measure(outcome, profile)))


def largest(*measures: Number) -> Number:
    """The largest of the measured ones; NaN if there are none."""

    def measure(outcome: Outcome, profile: str) -> float:
        found = [each(outcome, profile) for each in measures]
        return float(np.nanmax(found)) if np.isfinite(found).any() else float("nan")

    return measure


def whether(test: Callable[..., object], *measures: Number) -> Measure:
    """Whether figures pass a test; None if one of them was not measured."""

    def measure(outcome: Outcome, profile: str) -> bool | None:
        found = [each(outcome, profile) for each in measures]
        return bool(test(*found)) if np.isfinite(found).all() else None

    return measure
