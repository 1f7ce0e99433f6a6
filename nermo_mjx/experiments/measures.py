"""How each published figure is measured: a function of one profile of an experiment's outcome.

Angles are in degrees, speeds in mm/s, and other lengths in metres, unless the figure has another unit. Times and speeds
are measured by the controller's clock. `published.yaml` lists the published values with which the figures are compared.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from nermo_mjx.experiments import theory
from nermo_mjx.experiments.cases import AMPLITUDE, FREQUENCIES, CaseRuns, clock
from nermo_mjx.experiments.walks import FULL_LOCK, HARDWARE_STRIDE, STRATEGIES, WALK_GAITS
from nermo_mjx.plotting.shown import spoken
from nermo_mjx.robot.parameters import LEGS, LIMBS

Number = np.floating[Any]
#: Minimum R^2 for points to count as on a line.
LINEAR: Final = 0.98
#: The published straight lines by gait, without and with the spine.
SPINE_GAITS: Final = WALK_GAITS[:2]
_ANGLE: Final = re.compile(r"(roll|pitch|yaw)_(mean|std|min|max)|pitch_peak_up")


class NotMeasured(Exception):
    """The outcome does not contain the case of a figure, or a finite number for it."""


class ProfileOutcome:
    """The outcome of an experiment in one profile.

    A method raises `NotMeasured` if the outcome does not contain the case, or no finite number for it.
    """

    def __init__(self, outcome: CaseRuns, profile: str) -> None:
        self._outcome, self._profile = outcome, profile
        self._clock, self._stride = (
            clock(profile),
            HARDWARE_STRIDE if profile == "as_built" else 1.0,
        )

    def mean(self, column: str, **case: Any) -> Number:
        """Mean of a column over the repeats of a case, in SI units and simulated time."""
        value = self._outcome.mean(column, profile=self._profile, **case)
        if not math.isfinite(value):
            raise NotMeasured
        return np.float64(value)

    def worlds(self, column: str, **case: Any) -> np.ndarray:
        """A column of all worlds of the profile that match, (n,), in SI units and simulated time."""
        values = np.asarray(self._outcome.columns[column], float)[
            self._outcome.where(profile=self._profile, **case)
        ]
        if not len(values):
            raise NotMeasured
        return values

    # straight line

    def walk(
        self,
        column: str,
        gait: str,
        frequency: float,
        spine: bool = False,
        *stride: float,
        **case: Any,
    ) -> Number:
        """A column of a straight walk, at the profile's own stride if none is named; angles in degrees."""
        case = {"compensated": False, "stride": stride[0] if stride else self._stride} | case
        value = self.mean(column, gait=gait, frequency=frequency, spine=spine, **case)
        return np.degrees(value) if _ANGLE.fullmatch(column) else value

    def speed(self, *case: Any) -> Number:
        """Speed of a walk [mm/s]; arguments as for `walk`."""
        return 1e3 * self._clock * self.walk("speed", *case)

    def theory_speed(self, *case: Any) -> Number:
        """Speed of a walk without slip [mm/s]; arguments as for `walk`."""
        return 1e3 * self._clock * self.walk("theory_speed", *case)

    def gain(self, gait: str, frequency: float) -> Number:
        """Speed with the spine, divided by the speed without it."""
        return self.speed(gait, frequency, True) / self.speed(gait, frequency)

    def below_simulation(self, gait: str, spine: bool = False) -> Number:
        """Share by which the speed at 0.67 Hz is below the speed in the published simulation."""
        simulated = ProfileOutcome(self._outcome, "as_published").speed(gait, 0.67, spine)
        return 1 - self.speed(gait, 0.67, spine) / simulated

    def speeds(self, gait: str) -> list[Number]:
        """Speed at each of `FREQUENCIES`."""
        return [self.speed(gait, frequency) for frequency in FREQUENCIES]

    def gains(self, gait: str, frequencies: Sequence[float] = FREQUENCIES) -> list[Number]:
        """`gain` at each frequency."""
        return [self.gain(gait, frequency) for frequency in frequencies]

    def ratio(self, column: str, gait: str = "trot", frequency: float = 0.8) -> Number:
        """A column with the spine, divided by the column without it."""
        return self.walk(column, gait, frequency, True) / self.walk(column, gait, frequency)

    def ratios(self, column: str) -> list[Number]:
        """`ratio` of both trots at each of `FREQUENCIES`."""
        return [
            self.ratio(column, gait, frequency) for gait in SPINE_GAITS for frequency in FREQUENCIES
        ]

    def growths(self, column: str) -> list[Number]:
        """Growth of a column of the trot with each step of the frequency, without and with the spine."""
        return [
            self.walk(column, "trot", high, spine) / self.walk(column, "trot", low, spine) - 1
            for low, high in itertools.pairwise(FREQUENCIES)
            for spine in (False, True)
        ]

    def largest_roll(self, spine: bool) -> Number:
        """Largest roll to either side, trot at 0.8 Hz [deg]."""
        return max(abs(self.walk(end, "trot", 0.8, spine)) for end in ("roll_min", "roll_max"))

    def compensated(self, column: str) -> Number:
        """A column with offset compensation, divided by the column without it: trot at 0.67 Hz with the spine."""
        return self.walk(column, "trot", 0.67, True, compensated=True) / self.walk(
            column, "trot", 0.67, True
        )

    def amplitude(
        self, angle: str, gait: str, frequency: float, spine: bool, compensated: bool = False
    ) -> Number:
        """Half the range of an angle [deg]."""
        ends = (f"{angle}_min", f"{angle}_max")
        low, high = (
            self.walk(end, gait, frequency, spine, compensated=compensated) for end in ends
        )
        return 0.5 * (high - low)

    def stride_line(self, spine: bool) -> float:
        """R^2 of the line through speed over stride, trot at 0.8 Hz; NaN with fewer than three strides."""
        case = {"gait": "trot", "frequency": 0.8, "spine": spine, "compensated": False}
        stride, speed = (self.worlds(name, **case) for name in ("stride", "speed"))
        return (
            float(np.corrcoef(stride, speed)[0, 1] ** 2)
            if len(np.unique(stride)) >= 3
            else math.nan
        )

    def stride_gain(self) -> float:
        """Stride gained without slip by the spine (5.33) [mm]."""
        return 1e3 * theory.stride_gain_of(AMPLITUDE)

    # turning

    def turn(
        self, column: str, gait: str, frequency: float, radius: float, strategy: str
    ) -> Number:
        """A column of a turn to the left."""
        case = {"gait": gait, "frequency": frequency, "radius": radius, "strategy": strategy}
        return self.mean(column, side="left", stride=self._stride, **case)

    def turn_time(self, strategy: str) -> Number:
        """Time for the quarter circle of 0.5 m, trot at 0.67 Hz [s]."""
        return self.turn("time", "trot", 0.67, 0.5, strategy) / self._clock

    def lock(self, gait: str, strategy: str, frequency: float = 0.67) -> Number:
        """Smallest radius: the radius of the path at full lock [m]."""
        return self.turn("turning_radius", gait, frequency, FULL_LOCK, strategy)

    def theory_lock(self, strategy: str) -> Number:
        """Smallest radius of the trot without slip [m]."""
        return self.turn("theory_radius", "trot", 0.67, FULL_LOCK, strategy)

    def tighter(
        self, gait: str, strategy: str, other_strategy: str, frequency: float = 0.67
    ) -> Number:
        """Share by which a strategy's smallest radius is below the radius of another strategy."""
        return 1 - self.lock(gait, strategy, frequency) / self.lock(gait, other_strategy, frequency)

    def followed(
        self, strategy: str, gait: str = "trot", frequency: float = 0.67, radius: float = 0.5
    ) -> bool:
        """Whether all repeats followed a quarter circle."""
        return bool(self.turn("followed", gait, frequency, radius, strategy) == 1.0)

    def _circles(self) -> list[tuple[str, float, float]]:
        columns = self._outcome.only(
            side="left", profile=self._profile, stride=self._stride
        ).columns
        names = ("gait", "frequency", "radius")
        return sorted(
            {
                row
                for row in zip(*(columns[name].tolist() for name in names), strict=True)
                if row[2] > 0
            }
        )

    def lost(self) -> str:
        """The quarter circles that were not followed, in words."""
        circles = self._circles()
        lost = [
            (*circle, name)
            for circle in circles
            for name in STRATEGIES
            if not self.followed(name, *circle)
        ]
        texts = [
            f"{spoken(gait)}, {f:g} Hz, {strategy}, {radius:g} m"
            for gait, f, radius, strategy in lost
        ]
        if not circles:
            raise NotMeasured
        return "; ".join(texts) or "none"

    def compared(self, *strategies: str) -> list[tuple[Number, ...]]:
        """Speeds of strategies, a row for each quarter circle that all strategies followed."""
        rows = [
            tuple(self.turn("speed", *circle, strategy) for strategy in strategies)
            for circle in self._circles()
            if all(self.followed(strategy, *circle) for strategy in strategies)
        ]
        if not rows:
            raise NotMeasured
        return rows

    def mirrored(self) -> bool:
        """Whether right equals left within the spread of the repeats, in speed and in the radius at full lock.

        A single repeat has no spread: then within 0.2 %, to which rounding errors grow along the path.
        """
        rows = self._outcome.where(profile=self._profile, side="right")
        if not rows.any():
            raise NotMeasured
        for row in np.flatnonzero(rows):
            names = ("gait", "frequency", "radius", "strategy", "stride")
            labels = {name: self._outcome.columns[name][row] for name in names}
            for name in ("speed",) if labels["radius"] > 0 else ("speed", "turning_radius"):
                left, right = (self.worlds(name, side=side, **labels) for side in ("left", "right"))
                spread = max(np.ptp(left), np.ptp(right))
                if not abs(left.mean() - right.mean()) <= (
                    spread if len(left) > 1 else 2e-3 * left.mean()
                ):
                    return False
        return True

    # balance

    def verdict(self, limb: str, sbc: bool) -> str:
        """Whether a leg passed in all repeats: pass, fail, or the share of the repeats that passed."""
        passed = self.lift("passed", limb, sbc)
        return {1.0: "pass", 0.0: "fail"}.get(float(passed), f"{passed:.0%} pass")

    def lift(self, column: str, limb: str, sbc: bool) -> Number:
        """A column of a lift."""
        return self.mean(column, leg=limb, sbc=sbc)

    def rest(self, pair: str, sbc: bool) -> Number:
        """Size of the resting pitch, mean of left and right [rad]."""
        return np.mean(
            [abs(self.lift("pitch_rest", f"{pair}_{side}", sbc)) for side in ("left", "right")]
        )

    def force(self, foot: str, lifted: str, sbc: bool) -> Number:
        """Force of a foot [N] on four feet, just before a leg is lifted; mean of the case and its mirror image."""
        swap = {"left": "right", "right": "left"}
        mirror = [
            f"{pair}_{swap[side]}" for pair, side in (limb.split("_") for limb in (foot, lifted))
        ]
        return np.mean(
            [self.lift(f"force_shift_{f}", leg, sbc) for f, leg in ((foot, lifted), mirror)]
        )

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
        """A column with the spine, divided by the column without it; see `maze`."""
        return self.maze(column, True) / self.maze(column, False)

    # the stand of the leg

    def shortens(self, routing: str, other_routing: str) -> bool:
        """Whether a routing has a shorter lever arm on the knee than another one, in both pairs of legs."""
        force = [
            [self.mean("force", pair=pair, routing=r, hinges=1) for r in (routing, other_routing)]
            for pair in LEGS
        ]
        return all(first_force < second_force for first_force, second_force in force)


def farthest(values: Sequence[Number], low: float, high: float) -> Number:
    """The value that lies farthest outside of an interval, or the one nearest to its ends."""
    return max(values, key=lambda value: max(low - value, value - high))


def falls(values: Iterable[Any]) -> bool:
    """Whether values decrease strictly."""
    return bool((np.diff(list(values)) < 0.0).all())


def saturates(x: Sequence[float], y: Sequence[Number]) -> bool:
    """Whether the slope decreases."""
    return falls(np.diff(y) / np.diff(x))


def on_a_line(x: Sequence[float], y: Sequence[Number]) -> bool:
    """Whether the R^2 of the line through points is at least `LINEAR`."""
    return bool(np.corrcoef(x, y)[0, 1] ** 2 >= LINEAR)


def every(values: Iterable[Any]) -> bool:
    """Whether all values are true.

    All values are computed, so that a figure is not measured if a part of it is missing.
    """
    return all(list(values))


# --- the figures

Measure = Callable[[ProfileOutcome], float | bool | str | np.generic]


def _spoken(*names: str) -> dict[str, str]:
    """The names by their display forms."""
    return {name.replace("_", " "): name for name in names}


#: Spine of a walk through the maze -> whether it is active.
_SPINE_STATES: Final = {"without": False, "with": True}
#: Lift of a leg -> the leg, and whether the spine compensates the balance.
_LIFTS: Final = {
    f"{text} lifted, {word}": (limb, sbc)
    for word, sbc in _SPINE_STATES.items()
    for text, limb in _spoken(*LIMBS).items()
}
#: Columns of the maze whose values are published, and a column without and with the spine.
_MAZE_COLUMNS: Final = ("time", "mean_speed", "roll_std", "pitch_std")
_MAZE_CASES: Final = {
    f"{text} {word}": (column, spine)
    for text, column in _spoken(*_MAZE_COLUMNS).items()
    for word, spine in _SPINE_STATES.items()
}


def _family(
    figure: str, measure: Callable[..., Any], arguments: Mapping[str, Any]
) -> dict[str, Measure]:
    """Figures that differ in one argument of their measure.

    Args:
        figure: Name of the figures, with {} in place of the text of the argument.
        measure: Function of a `ProfileOutcome` and the argument.
        arguments: Text -> argument.
    """

    def with_argument(argument: Any) -> Measure:
        return lambda measured: measure(measured, argument)

    return {figure.format(text): with_argument(argument) for text, argument in arguments.items()}


#: The measures by experiment and figure, as in `published.yaml`.
MEASURES: Final[Mapping[str, Mapping[str, Measure]]] = {
    "straight-line": {
        **_family(
            "speed of {} over its theory, mean of the frequencies",
            lambda measured, gait: np.mean(
                [measured.speed(gait, f) / measured.theory_speed(gait, f) for f in FREQUENCIES]
            ),
            _spoken(*WALK_GAITS[1:]),
        ),
        **_family(
            "{} faster with the spine at each frequency",
            lambda measured, gait: min(measured.gains(gait)) > 1,
            _spoken(*SPINE_GAITS),
        ),
        **_family(
            "speed of {} linear in frequency",
            lambda measured, gait: on_a_line(FREQUENCIES, measured.speeds(gait)),
            _spoken(*SPINE_GAITS),
        ),
        **_family(
            "{} std higher with the spine",
            lambda measured, angle: min(measured.ratios(f"{angle}_std")) > 1,
            _spoken("roll", "pitch", "yaw"),
        ),
        **_family(
            "largest roll of trot, 0.8 Hz, {}",
            ProfileOutcome.largest_roll,
            {"spine": True, "no spine": False},
        ),
        "theory: speed of trot, 0.8 Hz, no spine": lambda measured: measured.theory_speed(
            "trot", 0.8
        ),
        "theory: speed of trot, 0.8 Hz, spine": lambda measured: measured.theory_speed(
            "trot", 0.8, True
        ),
        "theory: longer stride by the spine": ProfileOutcome.stride_gain,
        "theory: speed of the spine alone (stride 0), 0.8 Hz": lambda measured: (
            measured.theory_speed("trot", 0.8, True, 0.0)
        ),
        "speed of the spine alone (stride 0), 0.8 Hz": lambda measured: measured.speed(
            "trot", 0.8, True, 0.0
        ),
        "speed of trot, 0.8 Hz, no spine": lambda measured: measured.speed("trot", 0.8),
        "speed of trot over its theory, 0.8 Hz": lambda measured: (
            measured.speed("trot", 0.8) / measured.theory_speed("trot", 0.8)
        ),
        "trot > walking trot > lateral walk at each frequency": lambda measured: every(
            falls(measured.speed(g, f) for g in WALK_GAITS) for f in FREQUENCIES
        ),
        "speed of trot, 0.5 and 0.67 Hz, spine over none": lambda measured: farthest(
            measured.gains("trot", FREQUENCIES[:2]), 1.05, 1.22
        ),
        "speed of trot, 0.8 Hz, spine over none": lambda measured: measured.gain("trot", 0.8),
        "speed of trot over lateral walk, 0.8 Hz, no spine": lambda measured: (
            measured.speed("trot", 0.8) / measured.speed("lateral_walk", 0.8)
        ),
        "speed of trot with spine over lateral walk, 0.8 Hz": lambda measured: (
            measured.speed("trot", 0.8, True) / measured.speed("lateral_walk", 0.8)
        ),
        "speed of lateral walk saturates with frequency": lambda measured: saturates(
            FREQUENCIES, measured.speeds("lateral_walk")
        ),
        "speed over stride, R^2 of a line": lambda measured: measured.stride_line(False),
        "speed over stride with the spine: a line, above that without": lambda measured: (
            measured.stride_line(True) >= LINEAR
            and every(
                measured.speed("trot", 0.8, True, s) > measured.speed("trot", 0.8, False, s)
                for s in (0.0, 0.5, 0.8, 1.0)
            )
        ),
        "roll std, spine over none, trot and walking trot at each frequency": lambda measured: (
            farthest(measured.ratios("roll_std"), 1.25, 1.4)
        ),
        "roll std of trot grows with each frequency step": lambda measured: (
            min(measured.growths("roll_std")) > 0
        ),
        "growth of roll std of trot with a frequency step, mean": lambda measured: np.mean(
            measured.growths("roll_std")
        ),
        "yaw std of trot with the spine, 0.8 Hz": lambda measured: measured.walk(
            "yaw_std", "trot", 0.8, True
        ),
        "yaw std of trot, 0.8 Hz, spine over none": lambda measured: measured.ratio("yaw_std"),
        "yaw amplitude of trot, 0.8 Hz, spine over none": lambda measured: (
            measured.amplitude("yaw", "trot", 0.8, True)
            / measured.amplitude("yaw", "trot", 0.8, False)
        ),
        "yaw follows the spine's angle": lambda measured: (
            measured.walk("yaw_spine_correlation", "trot", 0.8, True) >= 0.7
        ),
        "roll std falls with duty, 0.8 Hz: trot > walking trot > lateral walk": lambda measured: (
            falls(measured.walk("roll_std", g, 0.8) for g in WALK_GAITS)
        ),
        "yaw std with the spine larger at the lower duty, trot > walking trot": lambda measured: (
            every(
                measured.walk("yaw_std", "trot", f, True)
                > measured.walk("yaw_std", "walking_trot", f, True)
                for f in FREQUENCIES
            )
        ),
        "roll std of trot, 0.67 Hz, spine, compensated over not": lambda measured: (
            measured.compensated("roll_std")
        ),
        "roll amplitude of trot, 0.67 Hz, spine, compensated over not": lambda measured: (
            measured.amplitude("roll", "trot", 0.67, True, True)
            / measured.amplitude("roll", "trot", 0.67, True)
        ),
        "compensation lowers the roll, and leaves pitch and yaw": lambda measured: (
            measured.compensated("roll_std") < 1
            and every(abs(measured.compensated(a) - 1) <= 0.15 for a in ("pitch_std", "yaw_std"))
        ),
        "standing pitch": lambda measured: measured.walk("pitch_mean", "stand", 0.8, False, 0.0),
        "mean pitch of trot, 0.8 Hz, no spine": lambda measured: measured.walk(
            "pitch_mean", "trot", 0.8
        ),
        "largest pitch std of all cases": lambda measured: np.nanmax(
            np.degrees(measured.worlds("pitch_std"))
        ),
        "pitch std of trot, 0.8 Hz, spine minus none": lambda measured: (
            measured.walk("pitch_std", "trot", 0.8, True) - measured.walk("pitch_std", "trot", 0.8)
        ),
        "pitch std of trot, 0.8 Hz, stride 1.0 over 0.8": lambda measured: max(
            measured.walk("pitch_std", "trot", 0.8, s, 1.0)
            / measured.walk("pitch_std", "trot", 0.8, s, 0.8)
            for s in (False, True)
        ),
        "upward pitch peak of trot, 0.8 Hz, spine over none": lambda measured: measured.ratio(
            "pitch_peak_up"
        ),
        "upward pitch peak of trot, 0.8 Hz, stride 1.0 over 0.8": lambda measured: (
            measured.walk("pitch_peak_up", "trot", 0.8)
            / measured.walk("pitch_peak_up", "trot", 0.8, False, 0.8)
        ),
        "pitch peaks in a gait cycle of trot, 0.8 Hz": lambda measured: measured.walk(
            "pitch_peaks", "trot", 0.8
        ),
        "largest upward pitch of trot, 0.8 Hz": lambda measured: max(
            -measured.walk("pitch_min", "trot", 0.8, s) for s in (False, True)
        ),
        "front feet carry more than rear feet": lambda measured: (
            measured.walk("front_load_share", "trot", 0.8) > 0.5
        ),
        "rear feet slip most at lift-off": lambda measured: (
            measured.walk("slip_rear_lift_off", "trot", 0.8)
            > max(
                measured.walk(f"slip_rear_{part}", "trot", 0.8)
                for part in ("touch_down", "mid_stance")
            )
        ),
        "hardware: speed of trot, 0.67 Hz, no spine": lambda measured: measured.speed("trot", 0.67),
        "hardware: speed of trot, 0.67 Hz, spine": lambda measured: measured.speed(
            "trot", 0.67, True
        ),
        "hardware: speed of trot, 0.67 Hz, spine over none": lambda measured: measured.gain(
            "trot", 0.67
        ),
        "hardware: speed of trot, 0.5 and 0.8 Hz, spine over none": lambda measured: farthest(
            measured.gains("trot", (0.5, 0.8)), 1.15, 1.22
        ),
        "hardware: speed of trot over lateral walk, mean of the frequencies": lambda measured: (
            np.mean(
                [measured.speed("trot", f) / measured.speed("lateral_walk", f) for f in FREQUENCIES]
            )
        ),
        "hardware below simulation, trot, no spine": lambda measured: measured.below_simulation(
            "trot"
        ),
        "hardware below simulation, trot, spine": lambda measured: measured.below_simulation(
            "trot", True
        ),
        "hardware below simulation, lateral walk": lambda measured: measured.below_simulation(
            "lateral_walk"
        ),
    },
    "turning": {
        **_family(
            "time for 0.5 m, trot, 0.67 Hz, {}-based",
            ProfileOutcome.turn_time,
            _spoken(*STRATEGIES),
        ),
        **_family(
            "hardware: time for 0.5 m, trot, 0.67 Hz, {}-based",
            ProfileOutcome.turn_time,
            _spoken(*STRATEGIES),
        ),
        **_family(
            "hardware: 0.5 m, trot, 0.67 Hz, followed, {}-based",
            ProfileOutcome.followed,
            _spoken(*STRATEGIES),
        ),
        **_family(
            "time for 0.5 m, trot, 0.67 Hz, {}- over leg-based",
            lambda measured, strategy: measured.turn_time(strategy) / measured.turn_time("leg"),
            _spoken("spine", "mix"),
        ),
        **_family(
            "smallest radius of trot, {}-based",
            lambda measured, strategy: measured.lock("trot", strategy),
            _spoken("leg", "mix"),
        ),
        **_family(
            "smallest radius of trot above theory, {}-based",
            lambda measured, strategy: (
                measured.lock("trot", strategy) / measured.theory_lock(strategy) - 1
            ),
            _spoken("leg", "mix"),
        ),
        **_family(
            "smallest radius of {}, mix-based below leg-based",
            lambda measured, gait: measured.tighter(gait, "mix", "leg"),
            _spoken(*WALK_GAITS),
        ),
        **_family(
            "theory: smallest radius, {}-based",
            ProfileOutcome.theory_lock,
            _spoken("leg", "mix"),
        ),
        **_family(
            "speed, spine- over mix-based, {}, 1.0 m, 0.5 Hz",
            lambda measured, gait: (
                measured.turn("speed", gait, 0.5, 1.0, "spine")
                / measured.turn("speed", gait, 0.5, 1.0, "mix")
            ),
            _spoken(*SPINE_GAITS),
        ),
        "spine-based turning fastest wherever it follows the path": lambda measured: every(
            a > b
            for other_steering in ("leg", "mix")
            for a, b in measured.compared("spine", other_steering)
        ),
        "mix-based turning between leg- and spine-based": lambda measured: every(
            a < b < c for a, b, c in measured.compared("leg", "mix", "spine")
        ),
        "speed, spine- over leg-based, mean of all paths": lambda measured: np.mean(
            [a / b for a, b in measured.compared("spine", "leg")]
        ),
        "largest gain in speed, spine- over leg-based": lambda measured: max(
            a / b - 1 for a, b in measured.compared("spine", "leg")
        ),
        "leg-based turning loses speed": lambda measured: every(
            a < b for a, b in measured.compared("leg", "spine")
        ),
        "spine-based turning has the more limited range of radii": lambda measured: every(
            measured.lock(g, "spine", f) > measured.lock(g, "leg", f)
            for g in WALK_GAITS
            for f in FREQUENCIES
        ),
        "paths not followed": ProfileOutcome.lost,
        "smallest radius of all, mix-based": lambda measured: np.nanmin(
            measured.worlds("turning_radius", strategy="mix", radius=0.0)
        ),
        "smallest radius of lateral walk by the spine, 0.5 Hz": lambda measured: measured.lock(
            "lateral_walk", "spine", 0.5
        ),
        "smallest radius of lateral walk by the spine, 0.8 Hz, above 0.5 m": lambda measured: (
            measured.lock("lateral_walk", "spine", 0.8) > 0.5
        ),
        "smallest radius of lateral walk by the spine, 0.8 Hz": lambda measured: measured.lock(
            "lateral_walk", "spine", 0.8
        ),
        "smallest radius of trot, 0.5 Hz, mix- below spine-based": lambda measured: (
            measured.tighter("trot", "mix", "spine", 0.5)
        ),
        "smallest radius of lateral walk, 0.8 Hz, mix- below spine-based": lambda measured: (
            measured.tighter("lateral_walk", "mix", "spine", 0.8)
        ),
        "theory: spine-based full lock (5.43)": lambda measured: measured.theory_lock("spine"),
        "theory: spine-based full lock, two feet with equal strides": lambda measured: (
            measured.turn("theory_equal_strides", "trot", 0.67, 0.0, "spine")
        ),
        "smallest radius off theory, mean of all cases": lambda measured: np.mean(
            abs(
                measured.worlds("turning_radius", radius=0.0, side="left")
                / measured.worlds("theory_radius", radius=0.0, side="left")
                - 1
            )
        ),
        "right turns as left turns": ProfileOutcome.mirrored,
    },
    "balance": {
        **_family(
            "{} balance compensation",
            lambda measured, lift: measured.verdict(*lift),
            _LIFTS,
        ),
        **_family(
            "hardware: {} compensation",
            lambda measured, lift: measured.verdict(*lift),
            _LIFTS,
        ),
        **_family(
            "resting pitch reduced by compensation, {} legs",
            lambda measured, pair: 1 - measured.rest(pair, True) / measured.rest(pair, False),
            _spoken("front", "rear"),
        ),
        **_family(
            "impact of the {} foot without compensation",
            lambda measured, leg: measured.lift("impact", leg, False),
            _spoken("rear_right", "rear_left"),
        ),
        "height of the centre of mass": lambda measured: (
            1e3
            * np.mean(
                [measured.lift("com_height", leg, sbc) for leg in LIMBS for sbc in (False, True)]
            )
        ),
        "force of the rear left foot, without compensation": lambda measured: measured.force(
            "rear_left", "rear_left", False
        ),
        "force of the rear left foot, with compensation": lambda measured: measured.force(
            "rear_left", "rear_left", True
        ),
        "force of the front right foot, with compensation": lambda measured: measured.force(
            "front_right", "rear_left", True
        ),
        "front left and rear right carry most, with compensation": lambda measured: (
            measured.force("front_left", "rear_left", True)
            + measured.force("rear_right", "rear_left", True)
            > measured.force("front_right", "rear_left", True)
            + measured.force("rear_left", "rear_left", True)
        ),
    },
    "maze": {
        **_family(
            "end reached {} spine",
            lambda measured, spine: measured.maze("reached", spine) == 1,
            _SPINE_STATES,
        ),
        **_family(
            "no box touched {} spine",
            lambda measured, spine: measured.maze("touched", spine) == 0,
            _SPINE_STATES,
        ),
        **_family("{} spine", lambda measured, case: measured.maze(*case), _MAZE_CASES),
        **_family(
            "{} with spine over without",
            ProfileOutcome.maze_ratio,
            _spoken(*_MAZE_COLUMNS),
        ),
        **_family(
            "{} higher with the spine",
            lambda measured, column: measured.maze_ratio(column) > 1,
            _spoken("roll_std", "pitch_std"),
        ),
        "hardware: time saved with the spine": lambda measured: 1 - measured.maze_ratio("time"),
    },
    "body": {
        **_family(
            "{}",
            lambda measured, column: 1e3 * measured.mean(column),
            _spoken("mass", "length", "height", "width") | {"shoulder to hip": "scapula_pelvis"},
        ),
        "servos": lambda measured: measured.mean("servos"),
        "bend of a front knee under load": lambda measured: measured.mean("bend_front_knee"),
        "bend of a rear knee under load": lambda measured: measured.mean("bend_rear_knee"),
        "bend of the spine under load": lambda measured: measured.mean("bend_spine"),
        "largest angle of a spine joint": lambda measured: measured.mean("spine_joint_limit"),
    },
    "leg-stand": {
        **_family(
            "bend of a {} knee under load, 4 hinges",
            lambda measured, pair: measured.mean("bend", pair=pair, routing="type3", hinges=4),
            _spoken("front", "rear"),
        ),
        **_family(
            "routing {} has a shorter lever arm on the knee than type 1",
            lambda measured, routing: measured.shortens(routing, "type1"),
            {"type 2": "type2", "type 3": "type3"},
        ),
        "adjusted type 3 has the shortest lever arm": lambda measured: measured.shortens(
            "type3_idler", "type3"
        ),
        "only with type 3 the knee is independent of the hip": lambda measured: every(
            (abs(measured.mean("coupling", pair=p, routing=r, hinges=1)) < 0.01) == (r == "type3")
            for p in ("front", "rear")
            for r in ("type1", "type2", "type3")
        ),
    },
    "spine-stand": {
        "bend of the spine under load, 4 hinges": lambda measured: measured.mean(
            "bend", robot="nermo_lite", hinges=4
        ),
    },
}
