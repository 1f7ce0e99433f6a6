"""Lines of the report: each published figure beside the author's model and the three profiles, and whether it holds.

The figures are data, in `published.yaml`: value, rule, kind, the sentence of the thesis that the rule stands for, its
section, how it is measured (`measures`), and what the author's own model and code give, with their settings.

How a figure is judged, its `rule`:

- `number`: within 25 % of the published one;
- `effect`: a ratio that says how much something changes; within 25 % of its size, the ratio minus 1. A spine without
  any effect has the ratio 1, which is within 25 % of 1.22, but is not a gain of 22 %. `gain`: the change itself;
- `range`: inside of the published interval, `at_most`: below a bound; neither is widened, except by rounding;
- `outcome`: the same truth, word or count;
- `none`: shown only.

All count half a unit of the last published digit (`digits`) as rounding. A `tolerance` of a figure's own replaces the
25 %, where the author's model would fail them. The value of a line as evidence depends on what was known when the twin
was made, its kind:

- `fitted`: a term of the objective (`identification`), or a figure that those terms decide;
- `theory`: a formula of the publication against the same formula here; nothing is simulated;
- `chosen`: something was decided with this figure, or one of its group, in view;
- `predicted`: none of these. Only predicted lines are evidence. In case of doubt, a line does not count as predicted.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any, Final, Literal, get_args

import numpy as np
import yaml

from nermo_mjx.control.parameters import PROFILES
from nermo_mjx.experiments.cases import BODY, Outcome
from nermo_mjx.experiments.measures import Value, Words

Kind = Literal["predicted", "chosen", "fitted", "theory"]
Rule = Literal["number", "effect", "gain", "range", "at_most", "outcome", "none"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
#: A number, or the size of an effect, agrees with the publication within this share of it.
AGREES: Final = 0.25
#: The share of bodies and starts that an interval holds.
INTERVAL: Final = 0.90
#: Tolerance for rounding errors in comparisons of numbers near 1.
_ROUNDING: Final = 1e-9
Interval = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Figure:
    """A published figure and how it is measured; see the module.

    Attributes:
        figure: its name, for display.
        kind, rule: see the module.
        published: value; of a range two numbers; None for one that is compared with the author's model alone.
        measure: expression of `measures.Words`.
        profile: the set-up in which it is judged: that which made it.
        unit: of a number as it is shown.
        digits: decimals that were published; None for a number that is not rounded.
        tolerance: in place of `AGREES`, or of a range the share by which its effects may go beyond; see `reason`.
        author: what the author's own model and code give; settings: name of their settings in `set_ups`.
        section: place in the publication; sentence: what it says there.
        reason: why the rule is what it is, and why a line does not hold, as far as tests have shown it.
    """

    figure: str
    kind: Kind
    rule: Rule
    measure: str
    published: Any = None
    profile: str = "as_published"
    unit: str = ""
    digits: int | None = None
    tolerance: float | None = None
    author: Value | list[float] = None
    settings: str = ""
    section: str = ""
    sentence: str = ""
    reason: str = ""

    def __post_init__(self) -> None:
        for name, allowed in (("kind", KINDS), ("rule", get_args(Rule)), ("profile", PROFILES)):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{self.figure}: {name} is {getattr(self, name)!r}: allowed is {', '.join(allowed)}.")

    @functools.cached_property
    def code(self) -> Any:
        """The compiled measure."""
        return compile(self.measure, self.figure, "eval")

    @property
    def reference(self) -> Any:
        """What a value is compared with: the publication, or else the author's model."""
        return self.author if self.published is None else self.published

    @property
    def rounding(self) -> float:
        """Half a unit of the last published digit."""
        return _ROUNDING + (0.0 if self.digits is None else 0.5 * 10.0**-self.digits)

    def measured(self, outcome: Outcome, profile: str) -> Value:
        """The figure in a profile; None where it was not measured."""
        return Words(outcome, profile).evaluate(self.code) if profile in set(outcome.columns["profile"]) else None

    def holds(self, value: Value | Sequence[float]) -> bool | None:
        """Whether a value agrees; None if there is none, or it is not judged."""
        if value is None or self.rule == "none":
            return None
        if isinstance(value, list | tuple):  # of the author's model, over several cases
            return all(self.holds(each) for each in value)
        if self.rule == "outcome":
            return value == self.reference
        if isinstance(value, bool | str):
            return False
        if self.rule == "at_most":
            return value <= self.reference + self.rounding
        if self.rule == "range":
            low, high = self.reference
            share = self.tolerance or 0.0
            return low - share * abs(low - 1) - self.rounding <= value <= high + share * abs(high - 1) + self.rounding
        size = abs(self.reference - self.neutral)
        return abs(value - self.reference) <= max((self.tolerance or AGREES) * size + _ROUNDING, self.rounding)

    @property
    def neutral(self) -> float:
        """The value without an effect."""
        return 1.0 if self.rule == "effect" else 0.0

    def ratio(self, value: Value) -> float | None:
        """Measured over published; of an effect, the sizes; of an interval, over its nearer end, or 1 inside of it."""
        if not _is_number(value) or self.reference is None or isinstance(self.reference, bool | str):
            return None
        assert isinstance(value, float | int)
        if isinstance(self.reference, list):
            low, high = self.reference
            nearer = min(max(value, low), high)
            found = 1.0 if nearer == value else value / nearer if nearer else math.inf
        else:
            size = self.reference - self.neutral
            found = (value - self.neutral) / size if size else math.inf
        return float(found) if math.isfinite(found) else None

    def covered(self, low: float | None, high: float | None) -> bool | None:
        """Whether the published value lies in an interval; of a published interval, whether both overlap."""
        if low is None or high is None or self.rule in ("none", "outcome"):
            return None
        if self.rule == "at_most":
            return low <= self.reference + self.rounding
        least, most = self.reference if isinstance(self.reference, list) else (self.reference, self.reference)
        return low <= most + self.rounding and least - self.rounding <= high


@functools.cache
def _content() -> dict[str, Any]:
    text = resources.files("nermo_mjx.experiments").joinpath("published.yaml").read_text(encoding="utf-8")
    return dict(yaml.safe_load(text))


@functools.cache
def figures(experiment: str) -> tuple[Figure, ...]:
    """The published figures of an experiment, in the order of the report."""
    return tuple(Figure(**entry) for entry in _content()["figures"].get(experiment, []))


def set_ups() -> dict[str, str]:
    """The settings in which the author's model was run, by name."""
    return dict(_content()["set_ups"])


@dataclasses.dataclass(frozen=True)
class Line:
    """A line of the report, keys of report.json.

    Attributes:
        experiment, figure, kind, rule, unit, section, sentence: see `Figure`.
        published, author, settings: the publication's value, the author's model's, and its settings.
        author_holds: whether that would hold: a criterion that the original fails is none.
        as_published, exact, as_built: the figure in the profiles; None where it was not measured.
        judged_in: the profile that is judged.
        ratio: of that to the reference.
        low, high: the 90 % interval over identified bodies and starts; None without bodies.
        covered: whether the published value lies in it.
        ensemble: share of those in which the line holds; None if unknown.
        holds: None where it was not measured, or is not judged.
        reason: see `Figure`.
    """

    experiment: str
    figure: str
    kind: Kind
    rule: Rule
    published: Any
    author: Any
    settings: str
    author_holds: bool | None
    as_published: Value
    exact: Value
    as_built: Value
    judged_in: str
    ratio: float | None
    low: float | None
    high: float | None
    covered: bool | None
    ensemble: float | None
    holds: bool | None
    unit: str
    section: str
    sentence: str
    reason: str


def compare(outcome: Outcome, bodies: Outcome | None = None, chosen: Sequence[Figure] | None = None) -> list[Line]:
    """The lines of one experiment.

    Args:
        outcome: of the run; a profile that was not run gives None.
        bodies: of the identified bodies in it, if they were run.
        chosen: figures, by default those of the experiment.
    """
    parts = _parts(outcome, bodies)
    return [_line(outcome, each, parts) for each in (figures(outcome.experiment) if chosen is None else chosen)]


def _parts(outcome: Outcome, bodies: Outcome | None) -> list[Outcome]:
    """Each start of the experiment's own body, and each other body with its start; nothing without other bodies."""
    if bodies is None:
        return []
    starts = [outcome.only(repeat=int(i)) for i in np.unique(outcome.columns["repeat"])]
    return starts + [bodies.only(**{BODY: int(i)}) for i in np.unique(bodies.columns[BODY])]


def _line(outcome: Outcome, figure: Figure, parts: Sequence[Outcome]) -> Line:
    values: dict[str, Any] = {profile: figure.measured(outcome, profile) for profile in PROFILES}
    own = values[figure.profile]
    spread = [figure.measured(part, figure.profile) for part in parts]
    low, high = _interval(spread)
    holds = [figure.holds(value) for value in spread]
    judged = figure.rule != "none" and any(value is not None for value in spread)
    return Line(
        experiment=outcome.experiment, **{name: getattr(figure, name) for name in _COPIED}, **values,
        author_holds=figure.holds(figure.author) if figure.published is not None else None, judged_in=figure.profile,
        ratio=figure.ratio(own), low=low, high=high, covered=figure.covered(low, high),
        ensemble=sum(each is True for each in holds) / len(holds) if judged else None, holds=figure.holds(own),
    )  # fmt: skip


_COPIED: Final = ("figure", "kind", "rule", "published", "author", "settings", "unit", "section", "sentence", "reason")


def _interval(values: Sequence[Value]) -> tuple[float | None, float | None]:
    """The 90 % interval of measured numbers, by order statistics (Weibull), which end at the extremes."""
    numbers = [float(value) for value in values if _is_number(value)]  # type: ignore[arg-type]
    if len(numbers) < 2:
        return None, None
    tail = (1.0 - INTERVAL) / 2
    low, high = np.quantile(numbers, [tail, 1.0 - tail], method="weibull")
    return float(low), float(high)


def _is_number(value: Value) -> bool:
    return value is not None and not isinstance(value, bool | str)


def counts(lines: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Number of lines, of those that hold, and of those that were not measured or are not judged; coverage.

    Args:
        lines: of report.json.
    """
    holds, covered = ([line[name] for line in lines] for name in ("holds", "covered"))
    return {
        "lines": len(holds),
        "hold": holds.count(True),
        "do_not_hold": holds.count(False),
        "not_measured": holds.count(None),
        "covered": covered.count(True),
        "not_covered": covered.count(False),
    }
