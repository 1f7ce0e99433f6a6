"""Lines of the report: a published figure, the same figure of both profiles, and whether it holds.

The value of a line as evidence depends on what was known when the twin was made, its kind:

- `fitted`: a term of the objective (`identification.targets`), or a figure that those terms decide;
- `theory`: a formula of the publication against the same formula here; nothing is simulated;
- `chosen`: something was decided with this figure, or one of its group, in view. Mass share, stance, offset
  compensation and the servo gain's bound were chosen with the balance outcomes known, and the masses by the balance
  test's forces and height; the sole's contact and the stride of the turning test with the turning results known; the
  pilot's look-ahead and observers with circles and with trots over frequency and stride, with and without the spine;
  dimensions and stiffnesses were entered by hand;
- `predicted`: none of these. Only predicted lines are evidence. In case of doubt, a line does not count as predicted.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Literal

from nermo_mjx.experiments.judgement import Asked, Interval, Judgement, Value
from nermo_mjx.experiments.outcome import Outcome

Kind = Literal["fitted", "theory", "chosen", "predicted"]
KINDS: Final[tuple[Kind, ...]] = ("predicted", "chosen", "fitted", "theory")


@dataclasses.dataclass(frozen=True)
class Figure:
    """A published figure and how it is measured.

    Attributes:
        name: for display.
        kind: the figure's value as evidence, see the module.
        reported: the published value, and how a measured one is judged.
        measure: from an outcome and a profile to the same figure; NaN or None where it was not measured.
        unit: of a number as it is shown.
        source: place in the publication, and its reading.
    """

    name: str
    kind: Kind
    reported: Judgement
    measure: Callable[[Outcome, str], Value]
    unit: str = ""
    source: str = ""


@dataclasses.dataclass(frozen=True)
class Line:
    """A line of the report; attributes as of `Figure`.

    Attributes:
        judged: kind of judgement, see `judgement`.
        as_published, exact: the figure in the two profiles; None where it was not measured.
        ratio: `exact` over the published number, of an effect over the published effect, or over the nearer end of an
            interval that it lies outside of.
        holds: whether `exact` agrees; None where it was not measured, or is not judged.
        ensemble: share of the identified bodies in which the line holds; None if unknown.
        demanded: interval required by this project only.
        reason: for a line that does not hold, the reason found by tests.
    """

    experiment: str
    figure: str
    kind: Kind
    judged: str
    published: Value | Interval
    as_published: Value
    exact: Value
    ratio: float | None
    holds: bool | None
    ensemble: float | None
    unit: str
    source: str
    demanded: Interval | None
    reason: str


def compare(
    outcome: Outcome,
    figures: Sequence[Figure],
    reasons: Mapping[str, str],
    shares: Mapping[str, float | None] | None = None,
) -> list[Line]:
    """The lines of one experiment.

    Args:
        outcome: of the run; a profile that was not run gives None.
        figures: of the experiment.
        reasons: figure's name -> why it does not hold.
        shares: figure's name -> share of the identified bodies in which it holds.
    """
    return [_line(outcome, figure, reasons, shares or {}) for figure in figures]


def _line(outcome: Outcome, figure: Figure, reasons: Mapping[str, str], shares: Mapping[str, float | None]) -> Line:
    reported, exact = figure.reported, measured(outcome, figure, "exact")
    number = exact is not None and not isinstance(exact, (bool, str))
    ratio = reported.ratio(float(exact)) if number else None  # type: ignore[arg-type]
    holds = agrees(exact, figure)
    return Line(
        experiment=outcome.experiment, figure=figure.name, kind=figure.kind, judged=reported.name,
        published=reported.published, as_published=measured(outcome, figure, "as_published"), exact=exact,
        ratio=ratio if ratio is not None and math.isfinite(ratio) else None, holds=holds,
        ensemble=None if holds is None else shares.get(figure.name), unit=figure.unit, source=figure.source,
        demanded=(reported.low, reported.high) if isinstance(reported, Asked) else None,
        reason=reasons.get(figure.name, "") if holds is False else "",
    )  # fmt: skip


def agrees(value: Value, figure: Figure) -> bool | None:
    """Whether a value agrees with a figure; None without a comparison."""
    return None if value is None else figure.reported.holds(value)


def measured(outcome: Outcome, figure: Figure, profile: str) -> Value:
    """A figure of one profile; None where it was not measured."""
    if profile not in set(outcome.columns["profile"]):
        return None
    value = figure.measure(outcome, profile)
    if value is None or isinstance(value, (bool, str)):
        return value
    return float(value) if math.isfinite(value) else None
