"""How a published figure is judged: by its size, by its effect, as a bound, as a range, or as an outcome.

An effect is a ratio that expresses how much something changes. It is judged by its size, the ratio minus 1: a spine
without any effect has the ratio 1, which is within 25 % of 1.22, but is not a gain of 22 %.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final, Protocol

#: A number, or the size of an effect, agrees with the publication within this share of it.
AGREES: Final = 0.25
Value = float | bool | str | None
Interval = tuple[float, float]
#: Tolerance for rounding in comparisons of numbers near 1.
_ROUNDING: Final = 1e-9


class Judgement(Protocol):
    """A published value, and the criterion for agreement."""

    @property
    def name(self) -> str:
        """The kind of judgement, for the report."""

    @property
    def published(self) -> Value | Interval:
        """The published value, as shown in the report; None for a figure of this project only."""

    def holds(self, value: Value) -> bool | None:
        """Whether a measured value agrees; None if it is not judged."""

    def ratio(self, value: float) -> float | None:
        """Measured over published; None if that is not meaningful."""


@dataclasses.dataclass(frozen=True)
class Number:
    """A plain number, which agrees within `AGREES` of it."""

    published: float
    name = "number"

    def holds(self, value: Value) -> bool:
        return abs(_number(value) - self.published) <= AGREES * abs(self.published) + _ROUNDING

    def ratio(self, value: float) -> float | None:
        return value / self.published if self.published else None


@dataclasses.dataclass(frozen=True)
class Effect:
    """A ratio of two measurements, judged by its distance from 1.

    It agrees within `AGREES` of the published effect, or within half a unit of the last digit that was published if
    that is more: 1.01 is 0.01 +- 0.005.

    Attributes:
        published: the ratio, or the change itself if `neutral` is 0.
        digits: decimals that were published.
        neutral: the value without an effect.
    """

    published: float
    digits: int = 2
    neutral: float = 1.0

    @property
    def name(self) -> str:
        return "effect" if self.neutral else "gain"

    def holds(self, value: Value) -> bool:
        tolerance = max(AGREES * abs(self.published - self.neutral), 0.5 * 10.0**-self.digits)
        return abs(_number(value) - self.published) <= tolerance + _ROUNDING

    def ratio(self, value: float) -> float | None:
        """The effect over the published effect."""
        size = self.published - self.neutral
        return (value - self.neutral) / size if size else None


def gain(value: float, digits: int = 2) -> Effect:
    """An effect that is given as the change itself, such as a reduction by 0.30."""
    return Effect(value, digits, neutral=0.0)


@dataclasses.dataclass(frozen=True)
class AtMost:
    """A bound: "at most", "always less"."""

    most: float
    name = "bound"

    @property
    def published(self) -> Interval:
        return 0.0, self.most

    def holds(self, value: Value) -> bool:
        return _number(value) <= self.most + _ROUNDING

    def ratio(self, value: float) -> float:
        return _over_nearer_end(value, *self.published)


@dataclasses.dataclass(frozen=True)
class Range:
    """A range, which is not widened; `beyond`: its lower end does not belong to it."""

    low: float
    high: float
    beyond: bool = False
    name = "range"

    @property
    def published(self) -> Interval:
        return self.low, self.high

    def holds(self, value: Value) -> bool:
        number = _number(value)
        inside = self.low - _ROUNDING <= number <= self.high + _ROUNDING
        return inside and not (self.beyond and number <= self.low + _ROUNDING)

    def ratio(self, value: float) -> float:
        return _over_nearer_end(value, self.low, self.high)


@dataclasses.dataclass(frozen=True)
class Same:
    """A trend, an outcome or a count, which agrees if it is identical."""

    published: bool | str | int
    name = "outcome"

    def holds(self, value: Value) -> bool:
        return value == self.published

    def ratio(self, value: float) -> None:
        return None


@dataclasses.dataclass(frozen=True)
class Asked:
    """An interval required by this project only, without a published value."""

    low: float
    high: float
    name = "asked"
    published = None

    def holds(self, value: Value) -> bool:
        return self.low <= _number(value) <= self.high

    def ratio(self, value: float) -> None:
        return None


@dataclasses.dataclass(frozen=True)
class Shown:
    """A number that is shown but not judged: ambiguous in the publication, or unpublished."""

    published: float | None = None
    name = "not judged"

    def holds(self, value: Value) -> None:
        return None

    def ratio(self, value: float) -> float | None:
        return value / self.published if self.published else None


def _number(value: Value) -> float:
    """A measured number; Booleans and texts are not numbers, and never agree with one."""
    return math.nan if value is None or isinstance(value, (bool, str)) else float(value)


def _over_nearer_end(value: float, low: float, high: float) -> float:
    """1 inside an interval; outside, the value over the nearer end."""
    if low <= value <= high:
        return 1.0
    nearer = low if abs(value - low) < abs(value - high) else high
    return value / nearer if nearer else math.nan
