"""Lines of the report: a published figure, the same figure of both profiles, and whether it holds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from nermo_mjx.experiments.outcome import Outcome

#: A number agrees with the publication within this share of it.
AGREES: Final = 0.25
Value = float | bool | str | None


@dataclasses.dataclass(frozen=True)
class Figure:
    """A published figure and how it is measured.

    Attributes:
        name: what it is, in the reader's words.
        published: a number, the two ends of an interval, whether a trend holds, or an outcome in a word; None for a
            figure that only this project asks for.
        measure: from an outcome and a profile to the same figure; NaN or None where it was not measured.
        unit: of a number as it is shown.
        source: where the publication has it.
        demanded: interval that this project asks of the profile `exact` beyond the 25 %, if any.
    """

    name: str
    published: Value | tuple[float, float]
    measure: Callable[[Outcome, str], Value]
    unit: str = ""
    source: str = ""
    demanded: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True)
class Line:
    """A line of the report; attributes as of `Figure`.

    Attributes:
        as_published, exact: the figure in the two profiles; None where it was not measured.
        ratio: `exact` over the published number, or over the nearer end of an interval that it lies outside of.
        holds: whether `exact` agrees: a number within 25 % (and within what is demanded), a trend or word as published.
        reason: for a line that does not hold, the reason that was found and tested.
    """

    experiment: str
    figure: str
    published: Value | tuple[float, float]
    as_published: Value
    exact: Value
    ratio: float | None
    holds: bool | None
    unit: str
    source: str
    demanded: tuple[float, float] | None
    reason: str


def compare(outcome: Outcome, figures: Sequence[Figure], reasons: Mapping[str, str]) -> list[Line]:
    """The lines of one experiment.

    Args:
        outcome: of the run; a profile that was not run gives None.
        figures: of the experiment.
        reasons: figure's name -> why it does not hold.
    """
    return [_line(outcome, figure, reasons) for figure in figures]


def _line(outcome: Outcome, figure: Figure, reasons: Mapping[str, str]) -> Line:
    values = {profile: _measured(outcome, figure, profile) for profile in ("as_published", "exact")}
    exact = values["exact"]
    ratio = _ratio(exact, figure.published)
    holds = agrees(exact, figure)
    return Line(
        experiment=outcome.experiment, figure=figure.name, published=figure.published, **values, ratio=ratio,
        holds=holds, unit=figure.unit, source=figure.source, demanded=figure.demanded,
        reason=reasons.get(figure.name, "") if holds is False else "",
    )  # fmt: skip


def agrees(value: Value, figure: Figure) -> bool | None:
    """Whether a value agrees with a figure; None where there is nothing to compare."""
    if value is None or (figure.published is None and figure.demanded is None):
        return None
    if isinstance(value, (bool, str)) or isinstance(figure.published, (bool, str)):
        return value == figure.published
    if figure.published is not None:
        ratio = _ratio(value, figure.published)
        if ratio is None or abs(ratio - 1.0) > AGREES:
            return False
    return figure.demanded is None or figure.demanded[0] <= value <= figure.demanded[1]


def _measured(outcome: Outcome, figure: Figure, profile: str) -> Value:
    if profile not in set(outcome.columns["profile"]):
        return None
    value = figure.measure(outcome, profile)
    if value is None or isinstance(value, (bool, str)):
        return value
    return float(value) if math.isfinite(value) else None


def _ratio(value: Value, published: Value | tuple[float, float]) -> float | None:
    if isinstance(value, (bool, str)) or value is None or isinstance(published, (bool, str)) or published is None:
        return None
    low, high = published if isinstance(published, tuple) else (published, published)
    if low <= value <= high:
        return value / low if low == high and low else 1.0
    nearer = low if abs(value - low) < abs(value - high) else high
    return value / nearer if nearer else None
