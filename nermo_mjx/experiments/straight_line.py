"""Straight line, 2.0 m: speed and orientation over gait, frequency, stride and spine."""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.experiments import cycle, theory
from nermo_mjx.experiments.cases import AMPLITUDE, FREQUENCIES, LABELS, Case, Worlds, measured, recorded, worlds
from nermo_mjx.experiments.outcome import Column, Outcome
from nermo_mjx.experiments.settings import Settings
from nermo_mjx.recording import Recording
from nermo_mjx.rollout import Run, Simulator

NAME: Final = "straight-line"
DISTANCE: Final = 2.0
#: Maximum number of gait cycles of a run that does not reach the end of the line, such as one without a stride.
_LONGEST: Final = 60.0
_WARMUP: Final = 2.0
_RECORDED: Final = 8.0
_ABOUT: Final = {
    "stride": Column("1", "stride length, as a share of the maximum"),
    "spine": Column("1", "whether the spine extends the strides"),
    "compensated": Column("1", "whether the rear legs compensate the hips' rise"),
    "theory_speed": Column("m/s", "speed without slip (5.21, 5.22, 5.33)"),
}


def _case(gait: str, frequency: float, spine: bool, stride: float = 1.0, compensated: bool = False) -> Case:
    return Case(
        {"gait": gait, "frequency": frequency, "stride": stride, "spine": spine, "compensated": compensated},
        gait,
        values={
            "frequency": frequency,
            "stride": stride,
            "spine.amplitude": AMPLITUDE * spine,
            "spine.offset_compensation": float(compensated),
        },
    )


def cases(quick: bool = False) -> tuple[Case, ...]:
    """The published cases; `quick` keeps those at 0.8 Hz and the compensation's."""
    frequencies = FREQUENCIES[-1:] if quick else FREQUENCIES
    both = (False, True)
    gaits = [_case(gait, f, spine) for f in frequencies for gait in ("trt", "trt1") for spine in both]
    lateral = [_case("lat", f, False) for f in frequencies]
    strides = [_case("trt", 0.8, spine, stride) for stride in (0.0, 0.5, 0.8) for spine in both]
    compensated = [_case("trt", 0.67, True, compensated=True)] + ([_case("trt", 0.67, True)] if quick else [])
    return (*gaits, *lateral, *strides, *compensated)


def run(settings: Settings) -> Outcome:
    """Simulate all cases in one batch, and those whose gait cycle is analysed in another, which is recorded.

    Quick: fewer cases, and half a metre.
    """
    simulator = Simulator(settings.setup("straight_line", spine="stride_extension"), engine=settings.engine)
    defaults, quick = simulator.setup.defaults(), settings.quick
    batch = worlds(cases(quick), defaults, settings)
    distance = 0.5 if quick else DISTANCE
    length = Run(cycles=_LONGEST / (4 if quick else 1), warmup_cycles=_WARMUP, distance=distance)
    columns, about = measured(simulator, batch, length, progress=settings.progress)
    columns["theory_speed"] = theory.speed(batch.all_values(defaults))
    looked_into = np.logical_or.reduce([_is(batch, case) for case in cycle_cases()])
    cycles = Run(cycles=_WARMUP + (4.0 if quick else _RECORDED), warmup_cycles=_WARMUP)
    columns |= cycle.measured(simulator, batch, looked_into, cycles)
    recordings = {} if settings.bodies is not None else _recordings(simulator, settings)
    return Outcome(NAME, columns, LABELS | _ABOUT | about | cycle.ABOUT, recordings)


def cycle_cases() -> tuple[Case, ...]:
    """The cases whose gait cycle is described in the publication: trot at 0.8 Hz, with two strides, without and with
    the spine."""
    return tuple(_case("trt", 0.8, spine, stride) for stride in (0.8, 1.0) for spine in (False, True))


def _is(batch: Worlds, case: Case) -> np.ndarray:
    """Mask (n,) of the worlds of a case."""
    return np.logical_and.reduce([batch.labels[name] == value for name, value in case.labels.items()])


def _recordings(simulator: Simulator, settings: Settings) -> dict[str, Recording]:
    shown = [_case("trt", 0.67, False), _case("trt", 0.67, True)]
    runs = worlds(shown, simulator.setup.defaults(), settings.of_one_run())
    names = [f"trt, 0.67 Hz, {'with' if case.labels['spine'] else 'without'} spine" for case in shown]
    return recorded(simulator, runs, Run(cycles=4.0 if settings.quick else _RECORDED), names)


def stride_linearity(outcome: Outcome, profile: str, spine: bool = False) -> float:
    """R^2 of the line through speed over stride, trot at 0.8 Hz; NaN with fewer than three strides."""
    rows = outcome.where(profile=profile, gait="trt", frequency=0.8, spine=spine, compensated=False)
    stride, speed = (np.asarray(outcome.columns[name], float)[rows] for name in ("stride", "speed"))
    if len(np.unique(stride)) < 3:
        return float("nan")
    return float(np.corrcoef(stride, speed)[0, 1] ** 2)
