"""Straight line, 2.0 m: speed and orientation over gait, frequency, stride and spine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from nermo_mjx.control.parameters import PROFILES
from nermo_mjx.experiments import theory
from nermo_mjx.experiments.cases import AMPLITUDE, FREQUENCIES, LABELS, Case, worlds
from nermo_mjx.experiments.outcome import Column, Outcome
from nermo_mjx.experiments.worlds_run import measured, recorded
from nermo_mjx.rollout import Run, Setup, Simulator

NAME: Final = "straight-line"
DISTANCE: Final = 2.0
#: Gait cycles after which a run ends that does not come to the end of the line, such as one with no stride.
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


def run(
    *,
    engine: str = "auto",
    profiles: Sequence[str] = PROFILES,
    repeats: int = 3,
    seed: int = 0,
    quick: bool = False,
    values: Mapping[str, float] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Outcome:
    """Walk all cases in one batch.

    Args:
        engine: of the simulation.
        profiles: of `PROFILES`.
        repeats, seed: of the shifted starts.
        quick: fewer cases, and half a metre.
        values: parameters for all worlds, by name.
        progress: called with the share done.

    Raises:
        ParameterError: an unknown name, or a value out of range.
    """
    simulator = Simulator(Setup(scene="straight_line", spine="stride_extension"), engine=engine)
    batch = worlds(
        cases(quick), simulator.setup.defaults(), profiles=profiles, repeats=repeats, seed=seed, common=values
    )
    distance = 0.5 if quick else DISTANCE
    length = Run(cycles=_LONGEST / (4 if quick else 1), warmup_cycles=_WARMUP, distance=distance)
    columns, about = measured(simulator, batch, length, progress=progress)
    columns["theory_speed"] = theory.speed(batch.all_values(simulator.setup.defaults()))
    shown = [_case("trt", 0.67, False), _case("trt", 0.67, True)]
    runs = worlds(shown, simulator.setup.defaults(), profiles=profiles[:1], seed=seed, common=values)
    names = [f"trt, 0.67 Hz, {'with' if case.labels['spine'] else 'without'} spine" for case in shown]
    recordings = recorded(simulator, runs, Run(cycles=4.0 if quick else _RECORDED), names)
    return Outcome(NAME, columns, LABELS | _ABOUT | about, recordings)


def stride_linearity(outcome: Outcome, profile: str) -> float:
    """R^2 of the line through speed over stride, trot at 0.8 Hz without spine."""
    rows = outcome.where(profile=profile, gait="trt", frequency=0.8, spine=False, compensated=False)
    stride, speed = (np.asarray(outcome.columns[name], float)[rows] for name in ("stride", "speed"))
    return float(np.corrcoef(stride, speed)[0, 1] ** 2)
