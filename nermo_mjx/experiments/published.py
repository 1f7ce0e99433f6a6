"""The published figures, the rules by which they are judged, and the lines of the report.

`published.yaml` lists for each figure its value, rule and kind, the sentence and section of the thesis, and the value
that the author's own model and code give, with their settings. `measures` contains the functions that measure figures.

The `rule` of a figure determines whether a value agrees with it:

- `number`: within 25 % of the published number;
- `effect`: a ratio that says how much something changes; within 25 % of its size, the ratio minus 1. A spine without
  any effect has the ratio 1, which is within 25 % of 1.22, but is not a gain of 22 %. `gain`: the change itself;
- `range`: inside of the published interval; `at_most`: below a bound. Neither is widened, except by rounding;
- `outcome`: the same truth value, word or count;
- `none`: shown, but not judged.

For all rules, half a unit of the last published digit (`digits`) counts as rounding. The `tolerance` of a figure replaces
the 25 % if the author's model would not agree within them. The `kind` of a figure determines whether it is evidence for
the twin:

- `fitted`: a term of the objective (`identification`), or a figure that those terms decide;
- `theory`: a formula of the publication, compared with the same formula here, without a simulation;
- `chosen`: this figure, or a figure of its group, was used in a modelling decision;
- `rewritten`: the rule of this figure was changed after the author's own model had failed it;
- `predicted`: all other figures. Only they are evidence. In case of doubt, a figure does not count as predicted.
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
#: Probability of the intervals over bodies and initial states.
INTERVAL: Final = 0.90
#: Tolerance for rounding errors in comparisons of numbers near 1.
_ROUNDING_TOLERANCE: Final = 1e-9


@dataclasses.dataclass(frozen=True)
class Figure:
    """A published figure and how it is measured; see the module.

    Attributes:
        figure: Name of the figure, for display.
        kind, rule: See the module.
        published: Published value, or the two ends of a range; None if only the author's model has a value.
        measure: Function that measures the figure in a `ProfileOutcome`; see `measures`.
        profile: Profile in which the figure is judged.
        unit: Unit in which a number is shown.
        digits: Number of published decimals; None for a number that is not rounded.
        tolerance: Replaces `AGREES`; for a range, the share by which its effects may exceed it. See `reason`.
        author: Value of the author's own model and code.
        settings: Name of the settings of the author's model in `set_ups`.
        section, sentence: Section of the publication, and its statement.
        reason: Reason for the rule, and known reason for a disagreement.
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
        """The value of the publication, or else of the author's model."""
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
        """The value of the figure in a profile; None if it was not measured."""
        if profile not in set(outcome.columns["profile"]):
            return None
        try:
            # A quick run lacks the cases of some figures; the mean of an empty array is not finite, so it is not measured.
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
        """Whether a value agrees with the figure; None without a value, or if the figure is not judged."""
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
        """Measured value relative to the published value.

        For an effect, it is the ratio of the sizes; for an interval, the ratio to its nearer end, or 1 inside.
        """
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
        """Whether an interval contains the published value, or overlaps the published interval."""
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
        recording: Part of the name of the recording; if no name matches, the last recording is shown.
        camera: Name of the camera.
        speed: Speed relative to real time; a long run is shown faster.
        until: Column with the simulated time at which the run reached its end, if there is one.
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
        name: Name, as on the command line.
        run: Function that simulates all cases.
        rows: Function that returns the number of worlds.
        settable: Parameters that can be set for all worlds.
        title: Title in the report.
        description: Procedure and criteria, in sentences.
        quick: Difference between a quick and a full run.
        metrics: Columns that the report shows for every case, with theory next to simulation.
        needs: Column -> the column that must be a number, so that the former is meaningful.
        shot: View of the video.
        walks: Whether a policy can act on top of the published controller.
        own_figures: Figures that replace the figures of `published.yaml`.
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
        """The figures of the experiment."""
        return published_figures(self.name) if self.own_figures is None else self.own_figures


@dataclasses.dataclass(frozen=True)
class Line:
    """A line of the report, keys of report.json.

    Attributes:
        experiment, figure, kind, rule, unit, section, sentence, reason: see `Figure`.
        published, author, settings: Value of the publication, value of the author's model, and its settings.
        author_holds: Whether the author's model agrees; a rule that the original fails is not a criterion.
        as_published, exact, as_built: Value in each profile; None if it was not measured.
        judged_in: Profile that is judged.
        ratio: Value in this profile relative to the reference.
        low, high: Ends of the 90 % interval over identified bodies and initial states; None without bodies.
        covered: Whether the interval contains the published value.
        ensemble: Share of bodies and initial states in which the line holds; None if unknown.
        holds: Whether the value agrees; None if it was not measured, or is not judged.
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
        outcome: Outcome of the run. The values of a profile that was not run are None.
        bodies: Outcome of identified bodies, if they were run. Each body, and each initial state of the default body, is
            then a sample of the interval.
        figures: Figures, by default all figures of the experiment.
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
    """Count lines: all, by `holds` (None: not measured or not judged), and by `covered`.

    Args:
        lines: Lines of report.json.
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
