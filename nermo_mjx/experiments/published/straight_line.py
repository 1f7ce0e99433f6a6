"""Straight line, speed: section 6.2.1, and the hardware's, 7.1."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from nermo_mjx.experiments import straight_line, theory
from nermo_mjx.experiments.cases import AMPLITUDE, FREQUENCIES
from nermo_mjx.experiments.judgement import Effect, Number, Range, Same, gain
from nermo_mjx.experiments.line import KINDS
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.published import measure, orientation
from nermo_mjx.experiments.published.measure import HARDWARE, Measure, below, figures_of, quotient
from nermo_mjx.experiments.published.walks import GAITS, TROT, at_each, frequencies, mean_of, speed, theory_speed

#: Minimum R^2 for points to count as on a line.
LINEAR: Final = 0.98
_HARDWARE_067: Final = f'{HARDWARE}; "0.6 Hz" there, which is in no test and evidently 0.67 Hz'


def _linear(gait: str) -> Measure:
    def measured(outcome: Outcome, profile: str) -> bool | None:
        found = frequencies(outcome)
        speeds = [speed(gait, f, False)(outcome, profile) for f in found]
        if len(found) < 3 or not np.isfinite(speeds).all():
            return None
        return bool(np.corrcoef(found, speeds)[0, 1] ** 2 >= LINEAR)

    return measured


def _saturates(outcome: Outcome, profile: str) -> bool | None:
    speeds = np.array([speed("lat", f, False)(outcome, profile) for f in FREQUENCIES])
    if not np.isfinite(speeds).all():
        return None
    slower, faster = np.diff(speeds) / np.diff(FREQUENCIES)
    return bool(faster < slower)


def _stride_linear_with_spine(outcome: Outcome, profile: str) -> bool | None:
    """Whether the points with the spine are on a line of their own, above the one without."""
    squared = straight_line.stride_linearity(outcome, profile, spine=True)
    strides = sorted(set(outcome.columns["stride"].tolist()))
    gains = [speed(*TROT, True, s)(outcome, profile) - speed(*TROT, False, s)(outcome, profile) for s in strides]
    return bool(squared >= LINEAR and np.mean(gains) > 0.0) if np.isfinite([squared, *gains]).all() else None


def _trot_over_lateral(spine: bool = False, frequency: float = 0.8) -> measure.Number:
    return quotient(speed("trt", frequency, spine), speed("lat", frequency, False))


def _over_theory(gait: str) -> Callable[[float], measure.Number]:
    return lambda f: quotient(speed(gait, f, False), theory_speed(gait, f, False))


def _with_and_without(gait: str) -> Callable[[float], list[measure.Number]]:
    return lambda f: [speed(gait, f, True), speed(gait, f, False)]


def _gain_of_stride(outcome: Outcome, profile: str) -> float:
    return 1e3 * theory.stride_gain_of(AMPLITUDE)


def _constant(value: float) -> measure.Number:
    return lambda outcome, profile: value


_predicted, _chosen, _fitted, _theory = (figures_of(kind, "6.2.1") for kind in KINDS)
_THEORY: Final = (
    _theory("theory: speed of trt, 0.8 Hz, no spine", Number(96.0), theory_speed(*TROT, False), "mm/s"),
    _theory("theory: speed of trt, 0.8 Hz, spine", Number(120.0), theory_speed(*TROT, True), "mm/s"),
    _theory("theory: longer stride by the spine", Number(15.0), _gain_of_stride, "mm", "6.2.1, (5.33)"),
    _theory("theory: speed of the spine alone (stride 0), 0.8 Hz", Number(24.0), theory_speed(*TROT, True, 0.0),
            "mm/s"),
)  # fmt: skip
_SIMULATION: Final = (
    _predicted("speed of the spine alone (stride 0), 0.8 Hz", Number(19.0), speed(*TROT, True, 0.0), "mm/s",
               "6.2.1: measured, 20 % below theory"),
    _fitted("speed of trt, 0.8 Hz, no spine", Number(86.4), speed(*TROT, False), "mm/s", "6.2.1: 10 % below theory"),
    _fitted("speed of trt over its theory, 0.8 Hz", Effect(0.90), _over_theory("trt")(0.8)),
    *(
        _fitted(f"speed of {gait} over its theory, mean of the frequencies", Effect(0.90), mean_of(_over_theory(gait)),
                source="6.2.1; the identification's ratios to trt decide it")
        for gait in GAITS[1:]
    ),
    _fitted("trot > walking trot > lateral walk at each frequency", Same(True),
            at_each(lambda f: [speed(gait, f, False) for gait in GAITS])),
    *(
        _fitted(f"{gait} faster with the spine at each frequency", Same(True), at_each(_with_and_without(gait)))
        for gait in GAITS[:2]
    ),
    *(
        _fitted(f"speed of trt, {f:g} Hz, spine over none", Effect(ratio), quotient(*_with_and_without("trt")(f)))
        for f, ratio in ((0.5, 1.05), (0.8, 1.22))
    ),
    _fitted("speed of trt over lat, 0.8 Hz, no spine", Effect(1.27), _trot_over_lateral()),
    _fitted("speed of trt with spine over lat, 0.8 Hz", Effect(1.48), _trot_over_lateral(True)),
    _predicted("speed of trt linear in frequency", Same(True), _linear("trt")),
    _predicted("speed of trt1 linear in frequency", Same(True), _linear("trt1")),
    _predicted("speed of lat saturates with frequency", Same(True), _saturates),
    _predicted("speed over stride, R^2 of a line", Range(LINEAR, 1.0), straight_line.stride_linearity,
               source=f"6.2.1: linear; here that is an R^2 of at least {LINEAR:g}"),
    _chosen("speed over stride with the spine: a line, above that without", Same(True), _stride_linear_with_spine,
            source="6.2.1, Figure 6.6(b)"),
)  # fmt: skip
_ON_HARDWARE: Final = (
    _predicted("hardware: speed of trt, 0.67 Hz, no spine", Number(67.0), speed("trt", 0.67, False), "mm/s",
               _HARDWARE_067),
    _chosen("hardware: speed of trt, 0.67 Hz, spine", Number(77.0), speed("trt", 0.67, True), "mm/s", _HARDWARE_067),
    _chosen("hardware: speed of trt, 0.67 Hz, spine over none", Range(1.15, 1.22),
            quotient(*_with_and_without("trt")(0.67)), source=HARDWARE),
    _predicted("hardware: speed of trt over lat, mean of the frequencies", Effect(1.11),
               mean_of(lambda f: _trot_over_lateral(frequency=f)), source=HARDWARE),
    *(
        made(f"hardware below simulation, {name}", gain(share), below(_constant(measured), speed(*case)),
             source=f"{HARDWARE}: its 67 mm/s of trt over 1.11, below this simulation's speed at 0.67 Hz"
                    if name == "lat" else f"{HARDWARE}: its {measured:g} mm/s below this simulation's speed at 0.67 Hz")
        for made, name, share, measured, case in (
            (_predicted, "trt, no spine", 0.12, 67.0, ("trt", 0.67, False)),
            (_chosen, "trt, spine", 0.06, 77.0, ("trt", 0.67, True)),
            (_predicted, "lat", 0.05, 67.0 / 1.11, ("lat", 0.67, False)),
        )
    ),
)  # fmt: skip
FIGURES: Final = (*_THEORY, *_SIMULATION, *orientation.FIGURES, *_ON_HARDWARE)
