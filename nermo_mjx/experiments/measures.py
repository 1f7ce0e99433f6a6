"""The vocabulary in which `published.yaml` says how a figure is measured: words over the outcome of one profile.

A `measure` is an expression of these words, such as `speed("trt", 0.8, True) / speed("trt", 0.8)`. A word that finds no
such case, or no number, makes the whole figure unmeasured. Times and speeds are in the controller's clock.
"""

from __future__ import annotations

import builtins
import math
import re
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from nermo_mjx.control.parameters import PUBLISHED_CLOCK_RATIO
from nermo_mjx.experiments import theory
from nermo_mjx.experiments.cases import AMPLITUDE, FREQUENCIES, Outcome
from nermo_mjx.experiments.walks import FULL_LOCK, GAITS, HARDWARE_STRIDE, STRATEGIES
from nermo_mjx.robot.parameters import LIMBS

Value = float | bool | str | None
#: Minimum R^2 for points to count as on a line.
LINEAR: Final = 0.98
#: The published straight lines by gait, without and with the spine.
SPINE_GAITS: Final = GAITS[:2]
_ANGLE: Final = re.compile(r"(roll|pitch|yaw)_(mean|std|min|max)|pitch_peak_up")


def clock(profile: str) -> float:
    """Simulated seconds per second of the controller's clock."""
    return PUBLISHED_CLOCK_RATIO if profile == "as_published" else 1.0


class Words:
    """The words, bound to an outcome and a profile; angles in degrees, speeds in mm/s, other lengths in metres."""

    def __init__(self, outcome: Outcome, profile: str) -> None:
        self._outcome, self._profile, self._missing = outcome, profile, False
        self._stride = HARDWARE_STRIDE if profile == "as_built" else 1.0

    def evaluate(self, code: Any) -> Value:
        """Value of a compiled expression; None if a word found nothing, or it is not a finite number."""
        names = {name: getattr(self, name) for name in dir(self) if not name.startswith("_")}
        self._missing = False
        with np.errstate(all="ignore"):
            value = eval(code, {"__builtins__": {}, **_CONSTANTS, **names})
        if self._missing or value is None:
            return None
        if isinstance(value, bool | np.bool_ | str):
            return value if isinstance(value, str) else bool(value)
        return float(value) if math.isfinite(value) else None

    def mean(self, column: str, **case: Any) -> np.floating[Any]:
        """Mean of a column over the repeats of a case, in SI units and simulated time."""
        value = self._outcome.mean(column, profile=self._profile, **case)
        self._missing |= not math.isfinite(value)
        return np.float64(value)

    def simulation(self) -> Words:
        """The words over the published simulation's profile, to which the hardware is compared."""
        return Words(self._outcome, "as_published")

    # straight line

    def walk(
        self, column: str, gait: str, frequency: float, spine: bool = False, stride: float | None = None,
        compensated: bool = False,
    ) -> np.floating[Any]:  # fmt: skip
        """A column of a straight walk, at the profile's own stride if none is named; angles in degrees."""
        value = self.mean(column, gait=gait, frequency=frequency, spine=spine, compensated=compensated,
                          stride=self._stride if stride is None else stride)  # fmt: skip
        return np.degrees(value) if _ANGLE.fullmatch(column) else value

    def speed(self, gait: str, frequency: float, spine: bool = False, stride: float | None = None) -> np.floating[Any]:
        """Speed [mm/s]."""
        return 1e3 * clock(self._profile) * self.walk("speed", gait, frequency, spine, stride)

    def theory_speed(
        self, gait: str, frequency: float, spine: bool = False, stride: float | None = None
    ) -> np.floating[Any]:
        """Speed without slip [mm/s]."""
        return 1e3 * clock(self._profile) * self.walk("theory_speed", gait, frequency, spine, stride)

    def over_theory(self, gait: str) -> np.floating[Any]:
        """Speed over its theory, mean of the frequencies."""
        return np.mean([self.speed(gait, f) / self.theory_speed(gait, f) for f in FREQUENCIES])

    def gain(self, gait: str, frequency: float) -> np.floating[Any]:
        """Speed with the spine over that without."""
        return self.speed(gait, frequency, True) / self.speed(gait, frequency)

    def ratio(self, column: str, gait: str = "trt", frequency: float = 0.8) -> np.floating[Any]:
        """A column with the spine over that without."""
        return self.walk(column, gait, frequency, True) / self.walk(column, gait, frequency)

    def compensated(self, column: str) -> np.floating[Any]:
        """A column with offset compensation over that without, trot at 0.67 Hz with the spine."""
        return self.walk(column, "trt", 0.67, True, compensated=True) / self.walk(column, "trt", 0.67, True)

    def amplitude(
        self, angle: str, gait: str, frequency: float, spine: bool, compensated: bool = False
    ) -> np.floating[Any]:
        """Half the range of an angle [deg]."""
        low, high = (self.walk(f"{angle}_{end}", gait, frequency, spine, None, compensated) for end in ("min", "max"))
        return 0.5 * (high - low)

    def largest_roll(self, spine: bool) -> np.floating[Any]:
        """Largest roll to either side, trot at 0.8 Hz [deg]."""
        return max(abs(self.walk(f"roll_{end}", "trt", 0.8, spine)) for end in ("min", "max"))

    def noisier(self, angle: str) -> bool:
        """Whether the spine makes an angle noisier, in each gait that has it and at each frequency."""
        return bool(np.all([self.ratio(f"{angle}_std", g, f) > 1.0 for g in SPINE_GAITS for f in FREQUENCIES]))

    def largest_pitch_std(self) -> float:
        """Largest of all cases of the experiment [deg]."""
        rows = self._outcome.where(profile=self._profile)
        stds = np.degrees(np.asarray(self._outcome.columns["pitch_std"], float)[rows])
        return float(np.nanmax(stds)) if np.isfinite(stds).any() else math.nan

    def stride_line(self, spine: bool) -> float:
        """R^2 of the line through speed over stride, trot at 0.8 Hz; NaN with fewer than three strides."""
        rows = self._outcome.where(profile=self._profile, gait="trt", frequency=0.8, spine=spine, compensated=False)
        stride, speed = (np.asarray(self._outcome.columns[name], float)[rows] for name in ("stride", "speed"))
        return float(np.corrcoef(stride, speed)[0, 1] ** 2) if len(np.unique(stride)) >= 3 else math.nan

    def stride_gain(self) -> float:
        """Stride gained without slip by the spine (5.33) [mm]."""
        return 1e3 * theory.stride_gain_of(AMPLITUDE)

    # turning

    def turn(self, column: str, gait: str, frequency: float, radius: float, strategy: str) -> np.floating[Any]:
        """A column of a turn to the left."""
        return self.mean(column, side="left", gait=gait, frequency=frequency, radius=radius, strategy=strategy,
                         stride=self._stride)  # fmt: skip

    def turn_time(self, strategy: str) -> np.floating[Any]:
        """Time for the quarter circle of 0.5 m, trot at 0.67 Hz [s]."""
        return self.turn("time", "trt", 0.67, 0.5, strategy) / clock(self._profile)

    def lock(self, gait: str, strategy: str, frequency: float = 0.67) -> np.floating[Any]:
        """Smallest radius: that of the path at full lock [m]."""
        return self.turn("turning_radius", gait, frequency, FULL_LOCK, strategy)

    def theory_lock(self, strategy: str, column: str = "theory_radius") -> np.floating[Any]:
        """The same without slip [m]."""
        return self.turn(column, "trt", 0.67, FULL_LOCK, strategy)

    def followed(self, strategy: str, gait: str = "trt", frequency: float = 0.67, radius: float = 0.5) -> bool:
        """Whether all repeats followed a quarter circle."""
        return bool(self.turn("followed", gait, frequency, radius, strategy) == 1.0)

    def _circles(self) -> list[tuple[str, float, float]]:
        names, profile = ("gait", "frequency", "radius"), self._profile
        columns = self._outcome.only(side="left", profile=profile, stride=self._stride).columns
        return sorted({row for row in zip(*(columns[name].tolist() for name in names), strict=True) if row[2] > 0})

    def lost(self) -> str | None:
        """The quarter circles that were not followed, in words."""
        circles = self._circles()
        names = [f"{gait}, {f:g} Hz, {strategy}, {radius:g} m" for gait, f, radius in circles for strategy in STRATEGIES
                 if not self.followed(strategy, gait, f, radius)]  # fmt: skip
        return ("; ".join(names) or "none") if circles else None

    def compared(self, *strategies: str) -> list[tuple[np.floating[Any], ...]]:
        """Speeds of strategies on every quarter circle that all of them followed; none unmeasures the figure."""
        found = [
            tuple(self.turn("speed", *circle, strategy) for strategy in strategies)
            for circle in self._circles()
            if builtins.all(self.followed(strategy, *circle) for strategy in strategies)
        ]
        self._missing |= not found
        return found

    def smallest_lock(self, strategy: str) -> float:
        """Smallest radius over all gaits and frequencies [m]."""
        rows = self._outcome.where(profile=self._profile, strategy=strategy, radius=FULL_LOCK)
        radii = np.asarray(self._outcome.columns["turning_radius"], float)[rows]
        return float(np.nanmin(radii)) if np.isfinite(radii).any() else math.nan

    def off_theory(self) -> float:
        """Mean relative deviation of the smallest radii from theory, over all gaits, frequencies and strategies."""
        rows = self._outcome.where(profile=self._profile, radius=FULL_LOCK, side="left")
        radius, plan = (np.asarray(self._outcome.columns[n], float)[rows] for n in ("turning_radius", "theory_radius"))
        return float(np.mean(np.abs(radius / plan - 1.0))) if rows.any() else math.nan

    def mirrored(self) -> bool:
        """Whether right equals left within the spread of the repeats, in speed and in the radius at full lock.

        A single repeat has no spread: then within 0.2 %, to which rounding errors grow along the path.
        """
        outcome, rows = self._outcome, self._outcome.where(profile=self._profile, side="right")
        self._missing |= not rows.any()
        for row in np.flatnonzero(rows):
            names = ("profile", "gait", "frequency", "radius", "strategy", "stride")
            labels = {name: outcome.columns[name][row] for name in names}
            for name in ("speed",) if labels["radius"] > 0 else ("speed", "turning_radius"):
                left, right = (
                    np.asarray(outcome.columns[name], float)[outcome.where(side=side, **labels)]
                    for side in ("left", "right")
                )
                spread = max(np.ptp(left), np.ptp(right))
                if not abs(left.mean() - right.mean()) <= (spread if len(left) > 1 else 2e-3 * left.mean()):
                    return False
        return True

    # balance

    def verdict(self, limb: str, sbc: bool) -> str:
        """Whether a leg passed in all repeats: pass, fail, or the share that did."""
        passed = self.mean("passed", leg=limb, sbc=sbc)
        return {1.0: "pass", 0.0: "fail"}.get(float(passed), f"{passed:.0%} pass")

    def lift(self, column: str, limb: str, sbc: bool) -> np.floating[Any]:
        """A column of a lift."""
        return self.mean(column, leg=limb, sbc=sbc)

    def rest(self, pair: str, sbc: bool) -> np.floating[Any]:
        """Size of the resting pitch, mean of left and right [rad]."""
        return np.mean([abs(self.lift("pitch_rest", f"{pair}_{side}", sbc)) for side in ("left", "right")])

    def force(self, foot: str, lifted: str, sbc: bool) -> np.floating[Any]:
        """Force of a foot [N] on four feet, just before a leg is lifted; mean of the case and its mirror image."""
        swap = {"left": "right", "right": "left"}
        mirror = [f"{pair}_{swap[side]}" for pair, side in (limb.split("_") for limb in (foot, lifted))]
        pairs = ((foot, lifted), tuple(mirror))
        return np.mean([self.lift(f"force_shift_{f}", leg, sbc) for f, leg in pairs])

    # maze

    def maze(self, column: str, spine: bool) -> np.floating[Any]:
        """A column of the maze; time [s], mean_speed [mm/s] and angles [deg]."""
        value = self.mean(column, spine=spine)
        if column == "time":
            return value / clock(self._profile)
        if column == "mean_speed":
            return 1e3 * clock(self._profile) * value
        return np.degrees(value) if column.endswith("_std") else value

    def maze_ratio(self, column: str) -> np.floating[Any]:
        """With the spine over without."""
        return self.maze(column, True) / self.maze(column, False)


def farthest(values: Sequence[float], low: float, high: float) -> float:
    """The value that lies farthest outside of an interval, or the one nearest to its ends."""
    return builtins.max(values, key=lambda value: max(low - value, value - high))


def falls(values: Iterable[float]) -> bool:
    """Whether values decrease strictly."""
    return bool((np.diff(list(values)) < 0.0).all())


def on_a_line(x: Sequence[float], y: Sequence[float]) -> bool:
    """Whether points are on a line: R^2 of at least `LINEAR`."""
    return bool(np.corrcoef(x, y)[0, 1] ** 2 >= LINEAR)


def saturates(x: Sequence[float], y: Sequence[float]) -> bool:
    """Whether the slope decreases."""
    return bool((np.diff(np.diff(y) / np.diff(x)) < 0.0).all())


def _largest(values: Iterable[float]) -> float:
    """NaN without any."""
    return builtins.max(values, default=math.nan)


_CONSTANTS: Final = {
    "F": FREQUENCIES, "GAITS": GAITS, "SPINE_GAITS": SPINE_GAITS, "LIMBS": LIMBS, "LINEAR": LINEAR,
    "farthest": farthest, "falls": falls, "on_a_line": on_a_line, "saturates": saturates, "average": np.mean,
    "all": lambda values: builtins.all(list(values)), "max": _largest, "abs": abs,
}  # fmt: skip
