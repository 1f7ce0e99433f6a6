"""Throughput, compile time and memory of each engine on this machine, against plain physics."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

from nermo_mjx.bench.cases import c_case, mjx_case
from nermo_mjx.bench.gradient import gradient_case
from nermo_mjx.bench.hardware import describe
from nermo_mjx.bench.tuning import tuning_case
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout.derivative import MODES

#: The registry of measurements: engine -> (what measures it, batch sizes measured by default).
CASES: dict[str, tuple[Callable[[int], dict[str, Any]], tuple[int, ...]]] = {
    "c": (c_case, (64, 1024)),
    "mjx": (mjx_case, (64,)),
}

#: Of the measurements of gradients, on the engine `mjx`: batch size, and gait cycles of a walk.
GRADIENT_WORLDS, GRADIENT_CYCLES = (64,), (1.0,)


def run_bench(
    engines: Sequence[str] | None = None,
    worlds: Sequence[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
    gradients: Sequence[str] = (),
    cycles: Sequence[float] | None = None,
    tunings: Sequence[float] = (),
) -> dict[str, Any]:
    """Measure engines, the cost of gradients, or what tuning finds, on this machine.

    Args:
        engines: names from `CASES`; all by default, and none where something else is measured.
        worlds: batch sizes; each case's own by default.
        progress: called with (cases done, cases in all).
        gradients: modes to measure, `forward` and `reverse`.
        cycles: lengths of the walks that are differentiated, in gait cycles; 1 by default.
        tunings: frequencies of the trots that are tuned, see `tuning_case` [Hz].

    Returns:
        `{"hardware": {...}, "cases": [...]}`. `ratio` of an engine is plain time over ours, 1 means that the controller
        is free; that of a gradient is its time over the time of the walk alone.

    Raises:
        ParameterError: an unknown engine or mode, a batch size below 1, a length of 0 or less.
    """
    for mode in gradients:
        if mode not in MODES[1:]:
            raise ParameterError(f"gradient is {mode!r}: allowed is one of {', '.join(MODES[1:])}.")
    for length in cycles or ():
        if not 0 < length < float("inf"):
            raise ParameterError(f"cycles is {length:g}: allowed is (0, inf).")
    for frequency in tunings:
        if not 0 < frequency < float("inf"):
            raise ParameterError(f"tuning is {frequency:g}: allowed is (0, inf).")
    for name in engines or ():
        if name not in CASES:
            raise ParameterError(f"engine is {name!r}: allowed is one of {', '.join(CASES)}.")
    for size in worlds or ():
        if size < 1:
            raise ParameterError(f"worlds is {size}: allowed is a whole number from 1.")
    chosen = engines or (() if gradients or tunings else tuple(CASES))
    plan = [functools.partial(CASES[name][0], size) for name in chosen for size in worlds or CASES[name][1]]
    plan += [
        functools.partial(gradient_case, mode, size, length)
        for mode in gradients for size in worlds or GRADIENT_WORLDS for length in cycles or GRADIENT_CYCLES
    ]  # fmt: skip
    plan += [functools.partial(tuning_case, frequency) for frequency in tunings]
    cases = []
    for done, measure in enumerate(plan):
        if progress:
            progress(done, len(plan))
        cases.append(measure())
    if progress:
        progress(len(plan), len(plan))
    return {"hardware": describe(), "cases": cases}
