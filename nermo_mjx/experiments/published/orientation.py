"""Straight line, orientation: section 6.2.1, and 7.2.1 on feet and pitch; none of it was used to fit the body."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from nermo_mjx.experiments import theory
from nermo_mjx.experiments.judgement import AtMost, Effect, Range, Same, Shown
from nermo_mjx.experiments.judgement import Number as Size
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.published.measure import Measure, Number, degrees, figures_of, largest, quotient, whether
from nermo_mjx.experiments.published.walks import GAITS, TROT, at_each, frequencies, walk

#: Largest effect of compensation on pitch and yaw that counts as none, relative to its effect on the roll.
_LEFT: Final = 0.05
#: Correlation above which one angle follows another: half of its variance.
_FOLLOWS: Final = 0.7
_MEAN_PITCH: Final = (
    '6.2.1, ambiguous and not judged: it "pitches forward", but a right-handed angle about the left is negative for '
    "nose up; here negative is nose up"
)


def _over(column: str) -> Number:
    """With the spine over without, trot at 0.8 Hz."""
    return quotient(walk(column, *TROT, True), walk(column, *TROT, False))


def _amplitude(angle: str, gait: str, frequency: float, spine: bool, *, compensated: bool = False) -> Number:
    low, high = (walk(f"{angle}_{end}", gait, frequency, spine, compensated=compensated) for end in ("min", "max"))
    return lambda outcome, profile: 0.5 * (high(outcome, profile) - low(outcome, profile))


def _compensated(column: str) -> Number:
    """With offset compensation over without, trot at 0.67 Hz with the spine."""
    return quotient(walk(column, "trt", 0.67, True, compensated=True), walk(column, "trt", 0.67, True))


def _noisier(angle: str) -> Measure:
    """Whether the spine makes an angle noisier, in each gait that has it and at each frequency."""
    both = [
        at_each(lambda f, gait=gait: [walk(f"{angle}_std", gait, f, spine) for spine in (True, False)])  # type: ignore[misc]
        for gait in GAITS[:2]
    ]

    def measure(outcome: Outcome, profile: str) -> bool | None:
        found = [each(outcome, profile) for each in both]
        return None if None in found else all(found)

    return measure


def _yaw_most_at_low_duty(outcome: Outcome, profile: str) -> bool | None:
    """Whether the trot's yaw, which has the lowest duty, is the noisiest at each frequency."""
    rows = np.array([[walk("yaw_std", g, f, False)(outcome, profile) for g in GAITS] for f in frequencies(outcome)])
    return bool((rows[:, :1] > rows[:, 1:]).all()) if np.isfinite(rows).all() else None


def _largest_pitch_std(outcome: Outcome, profile: str) -> float:
    """Largest of all cases of the experiment [deg]."""
    stds = np.asarray(outcome.columns["pitch_std"], float)[outcome.where(profile=profile)]
    return float(np.degrees(np.nanmax(stds))) if np.isfinite(stds).any() else float("nan")


def _either(measure: Callable[[bool], Number]) -> Number:
    """The larger of without and with the spine."""
    return largest(*(measure(spine) for spine in (False, True)))


def _size(column: str, spine: bool) -> Number:
    """Amplitude of an angle, trot at 0.8 Hz [rad]."""
    ends = [walk(f"{column}_{end}", *TROT, spine) for end in ("min", "max")]
    return lambda outcome, profile: max(abs(end(outcome, profile)) for end in ends)


def _peak(spine: bool, stride: float = 1.0) -> Number:
    return walk("pitch_peak_up", *TROT, spine, stride=stride)


def _from_standing(outcome: Outcome, profile: str) -> float:
    """Mean pitch, relative to the torso's attitude when standing [rad]."""
    return walk("pitch_mean", *TROT, False)(outcome, profile) - theory.standing_pitch()


def _upward_pitch(spine: bool) -> Number:
    """Largest pitch, nose up from level [deg]."""
    pitch = degrees(walk("pitch_min", *TROT, spine))
    return lambda outcome, profile: -pitch(outcome, profile)


_figure: Final = figures_of("predicted", "6.2.1")
_ROLL_AND_YAW: Final = (
    *(_figure(f"{angle} std higher with the spine", Same(True), _noisier(angle)) for angle in ("roll", "pitch", "yaw")),
    _figure("roll std of trt, 0.8 Hz, spine over none", Range(1.25, 1.40), _over("roll_std")),
    _figure("yaw std of trt, 0.8 Hz, spine over none", Effect(2.86), _over("yaw_std")),
    _figure("yaw amplitude of trt, 0.8 Hz, spine over none", Effect(1.50),
            quotient(_amplitude("yaw", *TROT, True), _amplitude("yaw", *TROT, False))),
    _figure("yaw follows the spine's angle", Same(True),
            whether(lambda correlation: correlation >= _FOLLOWS, walk("yaw_spine_correlation", *TROT, True)),
            source="6.2.1, Figure 6.8"),
    _figure("largest roll of trt, 0.8 Hz, spine", Size(8.0), degrees(_size("roll", True)), "deg",
            "6.2.1, in a sentence on the stride extension"),
    _figure("largest roll of trt, 0.8 Hz, no spine", Shown(8.0), degrees(_size("roll", False)), "deg",
            "6.2.1, the other reading of the same sentence; not judged"),
    _figure("roll std falls with duty: trt > trt1 > lat at each frequency", Same(True),
            at_each(lambda f: [walk("roll_std", gait, f, False) for gait in GAITS])),
    _figure("yaw std largest at the lowest duty", Same(True), _yaw_most_at_low_duty),
    _figure("roll std of trt, 0.67 Hz, spine, compensated over not", Effect(0.85), _compensated("roll_std")),
    _figure("roll amplitude of trt, 0.67 Hz, spine, compensated over not", Effect(0.875, digits=3),
            quotient(_amplitude("roll", "trt", 0.67, True, compensated=True), _amplitude("roll", "trt", 0.67, True))),
    _figure("compensation lowers the roll, and leaves pitch and yaw", Same(True),
            whether(
                lambda roll, *rest: roll < 1.0 - _LEFT and all(abs(ratio - 1.0) <= _LEFT for ratio in rest),
                *(_compensated(f"{angle}_std") for angle in ("roll", "pitch", "yaw")),
            ), source=f"Figure A.9; here: by more than {_LEFT:.0%}, and within that"),
)  # fmt: skip
_PITCH: Final = (
    _figure("mean pitch of trt, 0.8 Hz, no spine", Shown(-0.5), degrees(walk("pitch_mean", *TROT, False)), "deg",
            _MEAN_PITCH),
    _figure("mean pitch of trt, 0.8 Hz, no spine, from the standing attitude", Shown(-0.5), degrees(_from_standing),
            "deg", f"{_MEAN_PITCH}; from the attitude in which four neutral feet hold the torso, a degree nose up"),
    _figure("largest pitch std of all cases", AtMost(2.0), _largest_pitch_std, "deg", "6.2.1: always less"),
    _figure("pitch std of trt, 0.8 Hz, spine over none", Range(1.0, 1.25, beyond=True), _over("pitch_std"),
            source='6.2.1: "minimally higher"; here that is more than 1, and at most 1.25'),
    _figure("pitch std of trt, 0.8 Hz, stride 1.0 over 0.8", AtMost(1.5),
            _either(lambda spine: quotient(*(walk("pitch_std", *TROT, spine, stride=each) for each in (1.0, 0.8)))),
            source="6.2.1; the larger of without and with the spine"),
    _figure("upward pitch peak of trt, 0.8 Hz, spine over none", Effect(2.0, digits=1),
            quotient(_peak(True), _peak(False)), source="6.2.1; nose up, of the mean course over a gait cycle"),
    _figure("upward pitch peak of trt, 0.8 Hz, stride 1.0 over 0.8", Effect(1.50),
            quotient(_peak(False), _peak(False, 0.8)), source="6.2.1; without the spine, as the text does not say"),
    _figure("pitch peaks in a gait cycle of trt, 0.8 Hz", Same(2), walk("pitch_peaks", *TROT, False),
            source="6.2.1, Figure 6.10"),
    _figure("largest upward pitch of trt, 0.8 Hz", Size(4.0), _either(_upward_pitch), "deg",
            "7.2.1: up to 4 degrees upwards during lift-off; of level, as the author's model has 3.7 to 3.9"),
    _figure("pitch of trt at lift-off above its mean, 0.8 Hz", Shown(4.0),
            _either(lambda spine: degrees(walk("pitch_lift_off", *TROT, spine))), "deg", "7.2.1, the other reading"),
)  # fmt: skip
_FEET: Final = (
    _figure("front feet carry more than rear feet", Same(True),
            whether(lambda share: share > 0.5, walk("front_load_share", *TROT, False)), source="7.2.1"),
    _figure("rear feet slip most at lift-off", Same(True),
            whether(
                lambda first, middle, last: last > max(first, middle),
                *(walk(f"slip_rear_{part}", *TROT, False) for part in ("touch_down", "mid_stance", "lift_off")),
            ), source="7.2.1"),
)  # fmt: skip
FIGURES: Final = (*_ROLL_AND_YAW, *_PITCH, *_FEET)
