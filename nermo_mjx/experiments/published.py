"""The published figures, how they are measured and judged, and the lines of the report that result.

The figures are data, in `published.yaml`: value, rule, kind, the sentence of the thesis that the rule stands for, its
section, how it is measured (`Words`), and what the author's own model and code give, with their settings.

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

import builtins
import dataclasses
import functools
import math
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import resources
from typing import Any, Final, Literal, get_args

import numpy as np
import yaml

from nermo_mjx.experiments import theory
from nermo_mjx.experiments.cases import AMPLITUDE, BODY, FREQUENCIES, PROFILES, Outcome, Settings, clock
from nermo_mjx.experiments.walks import FULL_LOCK, GAITS, HARDWARE_STRIDE, STRATEGIES
from nermo_mjx.robot.parameters import LIMBS

Kind = Literal["predicted", "chosen", "fitted", "theory"]
Rule = Literal["number", "effect", "gain", "range", "at_most", "outcome", "none"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
Value = float | bool | str | None
Number = np.floating[Any]
#: A number, or the size of an effect, agrees with the publication within this share of it.
AGREES: Final = 0.25
#: The share of bodies and starts that an interval holds.
INTERVAL: Final = 0.90
#: Tolerance for rounding errors in comparisons of numbers near 1.
_ROUNDING: Final = 1e-9


@dataclasses.dataclass(frozen=True)
class Figure:
    """A published figure and how it is measured; see the module.

    Attributes:
        figure: its name, for display.
        kind, rule: see the module.
        published: value; of a range two numbers; None for one that is compared with the author's model alone.
        measure: expression of `Words`.
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

    @property
    def neutral(self) -> float:
        """The value without an effect."""
        return 1.0 if self.rule == "effect" else 0.0

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

    def ratio(self, value: Value) -> float | None:
        """Measured over published; of an effect, the sizes; of an interval, over its nearer end, or 1 inside of it."""
        if value is None or self.reference is None or isinstance(value, bool | str):
            return None
        if isinstance(self.reference, bool | str):
            return None
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

    def choose(self, outcome: Outcome) -> str | None:
        """Name of the recording that is shown; None if there is none."""
        names = list(outcome.recordings)
        return next((name for name in names if self.recording in name), names[-1] if names else None)


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A published experiment; its texts are in `experiments.yaml`.

    Attributes:
        name: as on the command line.
        run: simulates all its cases.
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
    run: Callable[[Settings], Outcome]
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
        return figures(self.name) if self.own_figures is None else self.own_figures


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


def compare(outcome: Outcome, bodies: Outcome | None = None, chosen: Sequence[Figure] | None = None) -> list[Line]:
    """The lines of one experiment.

    Args:
        outcome: of the run; a profile that was not run gives None.
        bodies: of the identified bodies in it, if they were run: each of these with its start, and each start of the
            experiment's own body, is then a sample of the interval.
        chosen: figures, by default those of the experiment.
    """
    samples: list[Outcome] = []
    if bodies is not None:
        samples = [outcome.only(repeat=int(i)) for i in np.unique(outcome.columns["repeat"])]
        samples += [bodies.only(**{BODY: int(i)}) for i in np.unique(bodies.columns[BODY])]
    copied = {field.name for field in dataclasses.fields(Line)} & {field.name for field in dataclasses.fields(Figure)}
    lines = []
    for figure in figures(outcome.experiment) if chosen is None else chosen:
        values: dict[str, Any] = {profile: figure.measured(outcome, profile) for profile in PROFILES}
        own = values[figure.profile]
        spread = [figure.measured(each, figure.profile) for each in samples]
        # Measured numbers, by order statistics (Weibull), which end at the extremes.
        numbers = [float(value) for value in spread if value is not None and not isinstance(value, bool | str)]
        tail, low, high = (1.0 - INTERVAL) / 2, None, None
        if len(numbers) > 1:
            low, high = np.quantile(numbers, [tail, 1.0 - tail], method="weibull").tolist()
        judged = figure.rule != "none" and any(value is not None for value in spread)
        lines.append(
            Line(
                experiment=outcome.experiment,
                author_holds=figure.holds(figure.author) if figure.published is not None else None,
                judged_in=figure.profile,
                ratio=figure.ratio(own),
                low=low,
                high=high,
                covered=figure.covered(low, high),
                ensemble=sum(figure.holds(value) is True for value in spread) / len(spread) if judged else None,
                holds=figure.holds(own),
                **{name: getattr(figure, name) for name in copied},
                **values,
            )
        )
    return lines


def counts(lines: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Number of lines, of those that hold, and of those that were not measured or are not judged; coverage.

    Args:
        lines: of report.json.
    """
    holds, covered = ([line[name] for line in lines] for name in ("holds", "covered"))
    counted = {"hold": holds.count(True), "do_not_hold": holds.count(False), "not_measured": holds.count(None)}
    return {"lines": len(lines), **counted, "covered": covered.count(True), "not_covered": covered.count(False)}


# --- measures: the vocabulary of published.yaml, words over the outcome of one profile

#: Minimum R^2 for points to count as on a line.
LINEAR: Final = 0.98
#: The published straight lines by gait, without and with the spine.
SPINE_GAITS: Final = GAITS[:2]
_ANGLE: Final = re.compile(r"(roll|pitch|yaw)_(mean|std|min|max)|pitch_peak_up")


class Words:
    """The words, bound to an outcome and a profile; angles in degrees, speeds in mm/s, other lengths in metres.

    A `measure` is an expression of them, such as `speed("trt", 0.8, True) / speed("trt", 0.8)`. A word that finds no
    such case, or no number, makes the whole figure unmeasured. Times and speeds are in the controller's clock.
    """

    def __init__(self, outcome: Outcome, profile: str) -> None:
        self._outcome, self._profile, self._missing = outcome, profile, False
        self._clock, self._stride = clock(profile), HARDWARE_STRIDE if profile == "as_built" else 1.0

    def evaluate(self, code: Any) -> Value:
        """Value of a compiled expression; None if a word found nothing, or it is not a finite number."""
        names = {name: getattr(self, name) for name in dir(self) if not name.startswith("_")}
        self._missing = False
        # A quick run has no cases for some figures: the mean of nothing is not finite, so not measured.
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore", category=RuntimeWarning):
            value = eval(code, {"__builtins__": {}, **_CONSTANTS, **names})
        if self._missing or value is None:
            return None
        if isinstance(value, bool | np.bool_ | str):
            return value if isinstance(value, str) else bool(value)
        return float(value) if math.isfinite(value) else None

    def mean(self, column: str, **case: Any) -> Number:
        """Mean of a column over the repeats of a case, in SI units and simulated time."""
        value = self._outcome.mean(column, profile=self._profile, **case)
        self._missing |= not math.isfinite(value)
        return np.float64(value)

    def worlds(self, column: str, **case: Any) -> np.ndarray:
        """A column of all worlds of the profile that match, (n,), in SI units and simulated time."""
        return np.asarray(self._outcome.columns[column], float)[self._outcome.where(profile=self._profile, **case)]

    def simulation(self) -> Words:
        """The words over the published simulation's profile, to which the hardware is compared."""
        return Words(self._outcome, "as_published")

    # straight line

    def walk(
        self, column: str, gait: str, frequency: float, spine: bool = False, *stride: float, **case: Any
    ) -> Number:
        """A column of a straight walk, at the profile's own stride if none is named; angles in degrees."""
        case = {"compensated": False, "stride": stride[0] if stride else self._stride} | case
        value = self.mean(column, gait=gait, frequency=frequency, spine=spine, **case)
        return np.degrees(value) if _ANGLE.fullmatch(column) else value

    def speed(self, *case: Any) -> Number:
        """Speed of a walk [mm/s]; arguments as for `walk`."""
        return 1e3 * self._clock * self.walk("speed", *case)

    def theory_speed(self, *case: Any) -> Number:
        """The same without slip."""
        return 1e3 * self._clock * self.walk("theory_speed", *case)

    def gain(self, gait: str, frequency: float) -> Number:
        """Speed with the spine over that without."""
        return self.speed(gait, frequency, True) / self.speed(gait, frequency)

    def ratio(self, column: str, gait: str = "trt", frequency: float = 0.8) -> Number:
        """A column with the spine over that without."""
        return self.walk(column, gait, frequency, True) / self.walk(column, gait, frequency)

    def compensated(self, column: str) -> Number:
        """A column with offset compensation over that without, trot at 0.67 Hz with the spine."""
        return self.walk(column, "trt", 0.67, True, compensated=True) / self.walk(column, "trt", 0.67, True)

    def amplitude(self, angle: str, gait: str, frequency: float, spine: bool, compensated: bool = False) -> Number:
        """Half the range of an angle [deg]."""
        ends = (f"{angle}_min", f"{angle}_max")
        low, high = (self.walk(end, gait, frequency, spine, compensated=compensated) for end in ends)
        return 0.5 * (high - low)

    def stride_line(self, spine: bool) -> float:
        """R^2 of the line through speed over stride, trot at 0.8 Hz; NaN with fewer than three strides."""
        case = {"gait": "trt", "frequency": 0.8, "spine": spine, "compensated": False}
        stride, speed = (self.worlds(name, **case) for name in ("stride", "speed"))
        return float(np.corrcoef(stride, speed)[0, 1] ** 2) if len(np.unique(stride)) >= 3 else math.nan

    def stride_gain(self) -> float:
        """Stride gained without slip by the spine (5.33) [mm]."""
        return 1e3 * theory.stride_gain_of(AMPLITUDE)

    # turning

    def turn(self, column: str, gait: str, frequency: float, radius: float, strategy: str) -> Number:
        """A column of a turn to the left."""
        case = {"gait": gait, "frequency": frequency, "radius": radius, "strategy": strategy}
        return self.mean(column, side="left", stride=self._stride, **case)

    def turn_time(self, strategy: str) -> Number:
        """Time for the quarter circle of 0.5 m, trot at 0.67 Hz [s]."""
        return self.turn("time", "trt", 0.67, 0.5, strategy) / self._clock

    def lock(self, gait: str, strategy: str, frequency: float = 0.67) -> Number:
        """Smallest radius: that of the path at full lock [m]."""
        return self.turn("turning_radius", gait, frequency, FULL_LOCK, strategy)

    def followed(self, strategy: str, gait: str = "trt", frequency: float = 0.67, radius: float = 0.5) -> bool:
        """Whether all repeats followed a quarter circle."""
        return bool(self.turn("followed", gait, frequency, radius, strategy) == 1.0)

    def _circles(self) -> list[tuple[str, float, float]]:
        columns = self._outcome.only(side="left", profile=self._profile, stride=self._stride).columns
        names = ("gait", "frequency", "radius")
        return sorted({row for row in zip(*(columns[name].tolist() for name in names), strict=True) if row[2] > 0})

    def lost(self) -> str | None:
        """The quarter circles that were not followed, in words."""
        circles = self._circles()
        lost = [(*circle, name) for circle in circles for name in STRATEGIES if not self.followed(name, *circle)]
        texts = [f"{gait}, {f:g} Hz, {strategy}, {radius:g} m" for gait, f, radius, strategy in lost]
        return ("; ".join(texts) or "none") if circles else None

    def compared(self, *strategies: str) -> list[tuple[Number, ...]]:
        """Speeds of strategies on every quarter circle that all of them followed; none unmeasures the figure."""
        found = [
            tuple(self.turn("speed", *circle, strategy) for strategy in strategies)
            for circle in self._circles()
            if builtins.all(self.followed(strategy, *circle) for strategy in strategies)
        ]
        self._missing |= not found
        return found

    def mirrored(self) -> bool:
        """Whether right equals left within the spread of the repeats, in speed and in the radius at full lock.

        A single repeat has no spread: then within 0.2 %, to which rounding errors grow along the path.
        """
        rows = self._outcome.where(profile=self._profile, side="right")
        self._missing |= not rows.any()
        for row in np.flatnonzero(rows):
            names = ("gait", "frequency", "radius", "strategy", "stride")
            labels = {name: self._outcome.columns[name][row] for name in names}
            for name in ("speed",) if labels["radius"] > 0 else ("speed", "turning_radius"):
                left, right = (self.worlds(name, side=side, **labels) for side in ("left", "right"))
                spread = max(np.ptp(left), np.ptp(right))
                if not abs(left.mean() - right.mean()) <= (spread if len(left) > 1 else 2e-3 * left.mean()):
                    return False
        return True

    # balance

    def verdict(self, limb: str, sbc: bool) -> str:
        """Whether a leg passed in all repeats: pass, fail, or the share that did."""
        passed = self.lift("passed", limb, sbc)
        return {1.0: "pass", 0.0: "fail"}.get(float(passed), f"{passed:.0%} pass")

    def lift(self, column: str, limb: str, sbc: bool) -> Number:
        """A column of a lift."""
        return self.mean(column, leg=limb, sbc=sbc)

    def rest(self, pair: str, sbc: bool) -> Number:
        """Size of the resting pitch, mean of left and right [rad]."""
        return np.mean([abs(self.lift("pitch_rest", f"{pair}_{side}", sbc)) for side in ("left", "right")])

    def force(self, foot: str, lifted: str, sbc: bool) -> Number:
        """Force of a foot [N] on four feet, just before a leg is lifted; mean of the case and its mirror image."""
        swap = {"left": "right", "right": "left"}
        mirror = [f"{pair}_{swap[side]}" for pair, side in (limb.split("_") for limb in (foot, lifted))]
        return np.mean([self.lift(f"force_shift_{f}", leg, sbc) for f, leg in ((foot, lifted), mirror)])

    # maze

    def maze(self, column: str, spine: bool) -> Number:
        """A column of the maze; time [s], mean_speed [mm/s] and angles [deg]."""
        value = self.mean(column, spine=spine)
        if column == "time":
            return value / self._clock
        if column == "mean_speed":
            return 1e3 * self._clock * value
        return np.degrees(value) if column.endswith("_std") else value

    def maze_ratio(self, column: str) -> Number:
        """With the spine over without."""
        return self.maze(column, True) / self.maze(column, False)


def farthest(values: Sequence[float], low: float, high: float) -> float:
    """The value that lies farthest outside of an interval, or the one nearest to its ends."""
    return builtins.max(values, key=lambda value: max(low - value, value - high))


def falls(values: Iterable[float]) -> bool:
    """Whether values decrease strictly."""
    return bool((np.diff(list(values)) < 0.0).all())


def saturates(x: Sequence[float], y: Sequence[float]) -> bool:
    """Whether the slope decreases."""
    return falls(np.diff(y) / np.diff(x))


def _extreme(end: Any, values: np.ndarray) -> float:
    """Of the values that are numbers; NaN without any."""
    finite = values[~np.isnan(values)]
    return float(end(finite)) if len(finite) else math.nan


_CONSTANTS: Final[dict[str, Any]] = {
    **{"F": FREQUENCIES, "GAITS": GAITS, "SPINE_GAITS": SPINE_GAITS, "LIMBS": LIMBS, "LINEAR": LINEAR},
    **{"farthest": farthest, "falls": falls, "saturates": saturates, "average": np.mean, "abs": abs},
    **{"degrees": np.degrees, "largest": lambda x: _extreme(np.max, x), "smallest": lambda x: _extreme(np.min, x)},
    "on_a_line": lambda x, y: bool(np.corrcoef(x, y)[0, 1] ** 2 >= LINEAR),
    "all": lambda values: builtins.all(list(values)),
    "max": lambda values: builtins.max(values, default=math.nan),
}
