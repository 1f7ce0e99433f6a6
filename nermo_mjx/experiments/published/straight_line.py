"""Straight line: sections 6.2.1 (speed) and 6.2.2 (orientation)."""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.experiments import straight_line
from nermo_mjx.experiments.cases import FREQUENCIES
from nermo_mjx.experiments.line import Figure
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.published.measure import HARDWARE, Measure, Number, clock, degrees, quotient

#: R^2 from which points count as on a line.
LINEAR: Final = 0.98


def _walk(column: str, gait: str, frequency: float, spine: bool, *, stride: float = 1.0, compensated: bool = False):
    def measure(outcome: Outcome, profile: str) -> float:
        return outcome.mean(
            column, profile=profile, gait=gait, frequency=frequency, spine=spine, stride=stride, compensated=compensated
        )

    return measure


def _speed(gait: str, frequency: float, spine: bool, stride: float = 1.0) -> Number:
    speed = _walk("speed", gait, frequency, spine, stride=stride)
    return lambda outcome, profile: 1e3 * clock(profile) * speed(outcome, profile)


def _amplitude(angle: str, gait: str, frequency: float, spine: bool, *, compensated: bool = False) -> Number:
    low, high = (_walk(f"{angle}_{end}", gait, frequency, spine, compensated=compensated) for end in ("min", "max"))
    return lambda outcome, profile: 0.5 * (high(outcome, profile) - low(outcome, profile))


def _largest_roll(outcome: Outcome, profile: str) -> float:
    ends = (_walk(f"roll_{end}", "trt", 0.8, False)(outcome, profile) for end in ("min", "max"))
    return float(np.degrees(max(map(abs, ends))))


def _hardware_speed(spine: bool) -> Number:
    """At 0.6 Hz, between 0.5 and 0.67 Hz."""

    def measure(outcome: Outcome, profile: str) -> float:
        speeds = [float(_speed("trt", f, spine)(outcome, profile)) for f in FREQUENCIES[:2]]
        return float(np.interp(0.6, FREQUENCIES[:2], speeds))

    return measure


def _measured_frequencies(outcome: Outcome) -> list[float]:
    rows = outcome.where(gait="lat")
    return sorted(set(np.asarray(outcome.columns["frequency"], float)[rows].tolist()))


def _ordered(outcome: Outcome, profile: str) -> bool:
    speeds = [
        [_speed(gait, f, False)(outcome, profile) for gait in ("trt", "trt1", "lat")]
        for f in _measured_frequencies(outcome)
    ]
    return all(trot > walking > lateral for trot, walking, lateral in speeds)


def _faster(gait: str) -> Measure:
    def measure(outcome: Outcome, profile: str) -> bool:
        return all(
            _speed(gait, f, True)(outcome, profile) > _speed(gait, f, False)(outcome, profile)
            for f in _measured_frequencies(outcome)
        )

    return measure


def _linear(gait: str) -> Measure:
    def measure(outcome: Outcome, profile: str) -> bool | None:
        rows = outcome.where(profile=profile, gait=gait, spine=False, stride=1.0, compensated=False)
        frequency, speed = (np.asarray(outcome.columns[name], float)[rows] for name in ("frequency", "speed"))
        if len(set(frequency.tolist())) < 3:
            return None
        return bool(np.corrcoef(frequency, speed)[0, 1] ** 2 >= LINEAR)

    return measure


def _saturates(outcome: Outcome, profile: str) -> bool | None:
    speeds = [_speed("lat", f, False)(outcome, profile) for f in FREQUENCIES]
    if not np.isfinite(np.array(speeds, float)).all():
        return None
    low, middle, high = (float(speed) for speed in speeds)
    slopes = (middle - low) / (FREQUENCIES[1] - FREQUENCIES[0]), (high - middle) / (FREQUENCIES[2] - FREQUENCIES[1])
    return bool(slopes[1] < slopes[0])


def _noisier(angle: str) -> Measure:
    def measure(outcome: Outcome, profile: str) -> bool:
        pairs = [
            (_walk(f"{angle}_std", gait, f, True), _walk(f"{angle}_std", gait, f, False))
            for gait in ("trt", "trt1")
            for f in _measured_frequencies(outcome)
        ]
        return all(with_spine(outcome, profile) > without(outcome, profile) for with_spine, without in pairs)

    return measure


def _stride_linear(outcome: Outcome, profile: str) -> float:
    return straight_line.stride_linearity(outcome, profile)


_TROT: Final = ("trt", 0.8)
FIGURES: Final = (
    Figure(
        "theory: speed of trt, 0.8 Hz, no spine",
        96.0,
        quotient(_walk("theory_speed", *_TROT, False), lambda o, p: 1e-3 / clock(p)),
        "mm/s",
        "6.2.1",
    ),
    Figure(
        "theory: speed of trt, 0.8 Hz, spine",
        120.0,
        quotient(_walk("theory_speed", *_TROT, True), lambda o, p: 1e-3 / clock(p)),
        "mm/s",
        "6.2.1",
    ),
    Figure(
        "theory: speed of the spine alone (stride 0), 0.8 Hz",
        24.0,
        quotient(_walk("theory_speed", *_TROT, True, stride=0.0), lambda o, p: 1e-3 / clock(p)),
        "mm/s",
        "6.2.1",
    ),
    Figure(
        "speed of the spine alone (stride 0), 0.8 Hz",
        24.0,
        _speed(*_TROT, True, 0.0),
        "mm/s",
        "6.2.1, theory",
    ),
    Figure("speed of trt, 0.8 Hz, no spine", 86.4, _speed(*_TROT, False), "mm/s", "6.2.1: 10 % below theory"),
    Figure("trot > walking trot > lateral walk at each frequency", True, _ordered, source="6.2.1"),
    Figure("trt faster with the spine at each frequency", True, _faster("trt"), source="6.2.1"),
    Figure("trt1 faster with the spine at each frequency", True, _faster("trt1"), source="6.2.1"),
    Figure(
        "speed of trt, 0.5 Hz, spine over none",
        1.05,
        quotient(_speed("trt", 0.5, True), _speed("trt", 0.5, False)),
        source="6.2.1",
    ),
    Figure(
        "speed of trt, 0.8 Hz, spine over none",
        1.22,
        quotient(_speed(*_TROT, True), _speed(*_TROT, False)),
        source="6.2.1",
        demanded=(1.15, 1.30),
    ),
    Figure(
        "speed of trt over lat, 0.8 Hz, no spine",
        1.27,
        quotient(_speed(*_TROT, False), _speed("lat", 0.8, False)),
        source="6.2.1",
        demanded=(1.15, 1.45),
    ),
    Figure(
        "speed of trt with spine over lat, 0.8 Hz",
        1.48,
        quotient(_speed(*_TROT, True), _speed("lat", 0.8, False)),
        source="6.2.1",
    ),
    Figure("speed of trt linear in frequency", True, _linear("trt"), source="6.2.1"),
    Figure("speed of trt1 linear in frequency", True, _linear("trt1"), source="6.2.1"),
    Figure("speed of lat saturates with frequency", True, _saturates, source="6.2.1"),
    Figure(
        "speed over stride, R^2 of a line",
        (LINEAR, 1.0),
        _stride_linear,
        source="6.2.1: linear",
        demanded=(LINEAR, 1.0),
    ),
    Figure("roll std higher with the spine", True, _noisier("roll"), source="6.2.2"),
    Figure("yaw std higher with the spine", True, _noisier("yaw"), source="6.2.2"),
    Figure(
        "roll std of trt, 0.8 Hz, spine over none",
        (1.25, 1.40),
        quotient(_walk("roll_std", *_TROT, True), _walk("roll_std", *_TROT, False)),
        source="6.2.2",
    ),
    Figure(
        "yaw std of trt, 0.8 Hz, spine over none",
        2.86,
        quotient(_walk("yaw_std", *_TROT, True), _walk("yaw_std", *_TROT, False)),
        source="6.2.2",
    ),
    Figure(
        "yaw amplitude of trt, 0.8 Hz, spine over none",
        1.50,
        quotient(_amplitude("yaw", *_TROT, True), _amplitude("yaw", *_TROT, False)),
        source="6.2.2",
    ),
    Figure("largest roll of trt, 0.8 Hz, no spine", 8.0, _largest_roll, "deg", "6.2.2"),
    Figure("mean pitch of trt, 0.8 Hz, no spine", -0.5, degrees(_walk("pitch_mean", *_TROT, False)), "deg", "6.2.2"),
    Figure(
        "pitch std of trt, 0.8 Hz, no spine", (0.0, 2.0), degrees(_walk("pitch_std", *_TROT, False)), "deg", "6.2.2"
    ),
    Figure(
        "pitch std of trt, 0.8 Hz, spine over none",
        2.0,
        quotient(_walk("pitch_std", *_TROT, True), _walk("pitch_std", *_TROT, False)),
        source="6.2.2",
    ),
    Figure(
        "pitch std of trt, 0.8 Hz, stride 1.0 over 0.8",
        (0.0, 1.5),
        quotient(_walk("pitch_std", *_TROT, False), _walk("pitch_std", *_TROT, False, stride=0.8)),
        source="6.2.2",
    ),
    Figure(
        "roll std of trt, 0.67 Hz, spine, compensated over not",
        0.85,
        quotient(_walk("roll_std", "trt", 0.67, True, compensated=True), _walk("roll_std", "trt", 0.67, True)),
        source="6.2.2",
        demanded=(0.0, 0.90),
    ),
    Figure(
        "roll amplitude of trt, 0.67 Hz, spine, compensated over not",
        0.875,
        quotient(_amplitude("roll", "trt", 0.67, True, compensated=True), _amplitude("roll", "trt", 0.67, True)),
        source="6.2.2",
    ),
    Figure("hardware: speed of trt, 0.6 Hz, no spine", 67.0, _hardware_speed(False), "mm/s", HARDWARE),
    Figure("hardware: speed of trt, 0.6 Hz, spine", 77.0, _hardware_speed(True), "mm/s", HARDWARE),
    Figure(
        "hardware: speed of trt, spine over none",
        (1.15, 1.22),
        quotient(_hardware_speed(True), _hardware_speed(False)),
        source=HARDWARE,
    ),
    Figure(
        "hardware: speed of trt over lat",
        1.11,
        quotient(_speed("trt", 0.67, False), _speed("lat", 0.67, False)),
        source=HARDWARE,
    ),
)
