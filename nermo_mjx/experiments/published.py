"""The published figures, how they are measured and judged, and the lines of the report that result.

The figures are data, in `published.yaml`: value, rule, kind, the sentence of the thesis that the rule stands for, its
section, and what the author's own model and code give, with their settings. How each is measured: `measures`.

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
- `rewritten`: the rule of this figure was changed after the author's own model had failed it;
- `predicted`: none of these. Only predicted lines are evidence. In case of doubt, a line does not count as predicted.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np

from nermo_mjx.experiments.cases import BODY, PROFILES, CaseRuns, Settings
from nermo_mjx.experiments.measures import MEASURES, Measure, NotMeasured, ProfileOutcome
from nermo_mjx.specs.reading import read_file

Kind = Literal["predicted", "rewritten", "chosen", "fitted", "theory"]
Rule = Literal["number", "effect", "gain", "range", "at_most", "outcome", "none"]
LINE_KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
Value = float | bool | str | None
#: A number, or the size of an effect, agrees with the publication within this share of it.
AGREES: Final = 0.25
#: The share of bodies and starts that an interval holds.
INTERVAL: Final = 0.90
#: Tolerance for rounding errors in comparisons of numbers near 1.
_ROUNDING_TOLERANCE: Final = 1e-9


@dataclasses.dataclass(frozen=True)
class Figure:
    """A published figure and how it is measured; see the module.

    Attributes:
        figure: its name, for display.
        kind, rule: see the module.
        published: value; of a range two numbers; None for one that is compared with the author's model alone.
        measure: of a profile's outcome; see `measures`.
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
    measure: Measure
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
        for name, allowed in (
            ("kind", LINE_KINDS),
            ("rule", get_args(Rule)),
            ("profile", PROFILES),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(
                    f"{self.figure}: {name} is {getattr(self, name)!r}: allowed is {', '.join(allowed)}."
                )

    @property
    def reference(self) -> Any:
        """What a value is compared with: the publication, or else the author's model."""
        return self.author if self.published is None else self.published

    @property
    def rounding(self) -> float:
        """Half a unit of the last published digit."""
        return _ROUNDING_TOLERANCE + (0.0 if self.digits is None else 0.5 * 10.0**-self.digits)

    @property
    def neutral(self) -> float:
        """The value without an effect."""
        return 1.0 if self.rule == "effect" else 0.0

    def measured(self, outcome: CaseRuns, profile: str) -> Value:
        """The figure in a profile; None where it was not measured."""
        if profile not in set(outcome.columns["profile"]):
            return None
        try:
            # A quick run has no cases for some figures: the mean of nothing is not finite, so not measured.
            with (
                np.errstate(all="ignore"),
                warnings.catch_warnings(action="ignore", category=RuntimeWarning),
            ):
                value = self.measure(ProfileOutcome(outcome, profile))
        except NotMeasured:
            return None
        if isinstance(value, bool | np.bool_ | str):
            return value if isinstance(value, str) else bool(value)
        return float(value) if math.isfinite(value) else None

    def holds(self, value: Value | Sequence[float]) -> bool | None:
        """Whether a value agrees; None if there is none, or it is not judged."""
        if value is None or self.rule == "none":
            return None
        if isinstance(value, list | tuple):  # of the author's model, over several cases
            return all(self.holds(element) for element in value)
        if self.rule == "outcome":
            return value == self.reference
        if isinstance(value, bool | str):
            return False
        if self.rule == "at_most":
            return value <= self.reference + self.rounding
        if self.rule == "range":
            low, high = self.reference
            share = self.tolerance or 0.0
            return (
                low - share * abs(low - 1) - self.rounding
                <= value
                <= high + share * abs(high - 1) + self.rounding
            )
        size = abs(self.reference - self.neutral)
        return abs(value - self.reference) <= max(
            (self.tolerance or AGREES) * size + _ROUNDING_TOLERANCE, self.rounding
        )

    def ratio(self, value: Value) -> float | None:
        """Measured over published; of an effect, the sizes; of an interval, over its nearer end, or 1 inside of it."""
        if value is None or self.reference is None or isinstance(value, bool | str):
            return None
        if isinstance(self.reference, bool | str):
            return None
        if isinstance(self.reference, list):
            low, high = self.reference
            nearer = min(max(value, low), high)
            quotient = 1.0 if nearer == value else value / nearer if nearer else math.inf
        else:
            size = self.reference - self.neutral
            quotient = (value - self.neutral) / size if size else math.inf
        return float(quotient) if math.isfinite(quotient) else None

    def covered(self, low: float | None, high: float | None) -> bool | None:
        """Whether the published value lies in an interval; of a published interval, whether both overlap."""
        if low is None or high is None or self.rule in ("none", "outcome"):
            return None
        if self.rule == "at_most":
            return low <= self.reference + self.rounding
        lowest, highest = (
            self.reference if isinstance(self.reference, list) else (self.reference, self.reference)
        )
        return low <= highest + self.rounding and lowest - self.rounding <= high


@functools.cache
def _content() -> dict[str, Any]:
    return read_file(Path(__file__).with_name("published.yaml")).data


@functools.cache
def published_figures(experiment: str) -> tuple[Figure, ...]:
    """The published figures of an experiment, in the order of the report."""
    measures = MEASURES.get(experiment, {})
    return tuple(
        Figure(**entry, measure=measures[entry["figure"]])
        for entry in _content()["figures"].get(experiment, [])
    )


def set_ups() -> dict[str, str]:
    """The settings in which the author's model was run, by name."""
    return dict(_content()["set_ups"])


# --- an experiment, and the lines of its report


@dataclasses.dataclass(frozen=True)
class Shot:
    """The content of a video.

    Attributes:
        recording: part of the recording's name; if none matches, the last recording is shown.
        camera: a following view.
        speed: 1 is real time; a run that has an end is shown faster if it would take too long.
        until: column with the simulated time at which the run reached its end, if it has one.
    """

    recording: str = ""
    camera: str = "three_quarter"
    speed: float = 1.0
    until: str = ""

    def choose(self, outcome: CaseRuns) -> str | None:
        """Name of the recording that is shown; None if there is none."""
        names = list(outcome.recordings)
        return next(
            (name for name in names if self.recording in name), names[-1] if names else None
        )


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A published experiment; its texts are in `experiments.yaml`.

    Attributes:
        name: as on the command line.
        run: simulates all its cases.
        rows: how many worlds these are.
        settable: parameters that may be set for all its worlds.
        title: for the report.
        description: what is done and when it counts, in sentences.
        quick: what a quick run omits.
        metrics: columns shown in the report for every case, with theory next to simulation.
        needs: column -> the column that must be a number for it to be meaningful.
        shot: the view of the video.
        walks: whether another controller can take the place of the published one.
        own_figures: in place of those of `published.yaml`.
    """

    name: str
    run: Callable[[Settings], CaseRuns]
    rows: Callable[[Settings], int]
    settable: frozenset[str]
    title: str
    description: str
    quick: str = "nothing is left out"
    metrics: Sequence[str] = ()
    needs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    shot: Shot = dataclasses.field(default_factory=Shot)
    walks: bool = False
    own_figures: tuple[Figure, ...] | None = None

    @property
    def figures(self) -> tuple[Figure, ...]:
        """Published figures, and how they are measured here."""
        return published_figures(self.name) if self.own_figures is None else self.own_figures


@dataclasses.dataclass(frozen=True)
class Line:
    """A line of the report, keys of report.json.

    Attributes:
        experiment, figure, kind, rule, unit, section, sentence, reason: see `Figure`.
        published, author, settings: the publication's value, the author's model's, and its settings.
        author_holds: whether that would hold: a criterion that the original fails is none.
        as_published, exact, as_built: the figure in the profiles; None where it was not measured.
        judged_in: the profile that is judged.
        ratio: of that to the reference.
        low, high: the 90 % interval over identified bodies and starts; None without bodies.
        covered: whether the published value lies in it.
        ensemble: share of those in which the line holds; None if unknown.
        holds: None where it was not measured, or is not judged.
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


def published_lines(
    outcome: CaseRuns, bodies: CaseRuns | None = None, figures: Sequence[Figure] | None = None
) -> list[Line]:
    """The lines of one experiment.

    Args:
        outcome: of the run; a profile that was not run gives None.
        bodies: of the identified bodies in it, if they were run: each of these with its start, and each start of the
            experiment's own body, is then a sample of the interval.
        figures: figures, by default those of the experiment.
    """
    samples: list[CaseRuns] = []
    if bodies is not None:
        samples = [outcome.only(repeat=int(i)) for i in np.unique(outcome.columns["repeat"])]
        samples += [bodies.only(**{BODY: int(i)}) for i in np.unique(bodies.columns[BODY])]
    copied = {field.name for field in dataclasses.fields(Line)} & {
        field.name for field in dataclasses.fields(Figure)
    }
    lines = []
    for figure in published_figures(outcome.experiment) if figures is None else figures:
        values: dict[str, Any] = {
            profile: figure.measured(outcome, profile) for profile in PROFILES
        }
        profile_outcome = values[figure.profile]
        spread = [figure.measured(sample, figure.profile) for sample in samples]
        # Measured numbers, by order statistics (Weibull), which end at the extremes.
        numbers = [
            float(value)
            for value in spread
            if value is not None and not isinstance(value, bool | str)
        ]
        tail, low, high = (1.0 - INTERVAL) / 2, None, None
        if len(numbers) > 1:
            low, high = np.quantile(numbers, [tail, 1.0 - tail], method="weibull").tolist()
        judged = figure.rule != "none" and any(value is not None for value in spread)
        lines.append(
            Line(
                experiment=outcome.experiment,
                author_holds=figure.holds(figure.author) if figure.published is not None else None,
                judged_in=figure.profile,
                ratio=figure.ratio(profile_outcome),
                low=low,
                high=high,
                covered=figure.covered(low, high),
                ensemble=sum(figure.holds(value) is True for value in spread) / len(spread)
                if judged
                else None,
                holds=figure.holds(profile_outcome),
                **{name: getattr(figure, name) for name in copied},
                **values,
            )
        )
    return lines


def line_counts(lines: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Number of lines, of those that hold, and of those that were not measured or are not judged; coverage.

    Args:
        lines: of report.json.
    """
    holds, covered = ([line[name] for line in lines] for name in ("holds", "covered"))
    counted = {
        "hold": holds.count(True),
        "do_not_hold": holds.count(False),
        "not_measured": holds.count(None),
    }
    return {
        "lines": len(lines),
        **counted,
        "covered": covered.count(True),
        "not_covered": covered.count(False),
    }
