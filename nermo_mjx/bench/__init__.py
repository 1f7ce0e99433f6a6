"""Throughput, compile time and memory of each engine on this machine, against plain physics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from nermo_mjx.bench.cases import c_case, mjx_case
from nermo_mjx.bench.hardware import describe
from nermo_mjx.robot import ParameterError

#: The registry of measurements: engine -> (what measures it, batch sizes measured by default).
CASES: dict[str, tuple[Callable[[int], dict[str, Any]], tuple[int, ...]]] = {
    "c": (c_case, (64, 1024)),
    "mjx": (mjx_case, (64,)),
}


def run_bench(
    engines: Sequence[str] | None = None,
    worlds: Sequence[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure engines on this machine.

    Args:
        engines: names from `CASES`; all by default.
        worlds: batch sizes; each engine's own by default.
        progress: called with (cases done, cases in all).

    Returns:
        `{"hardware": {...}, "cases": [...]}`; `ratio` is plain time over ours, 1 means that the controller is free.

    Raises:
        ParameterError: an unknown engine, or a batch size below 1.
    """
    for name in engines or ():
        if name not in CASES:
            raise ParameterError(f"engine is {name!r}: allowed is one of {', '.join(CASES)}.")
    for size in worlds or ():
        if size < 1:
            raise ParameterError(f"worlds is {size}: allowed is a whole number from 1.")
    plan = [(name, size) for name in engines or CASES for size in worlds or CASES[name][1]]
    cases = []
    for done, (name, size) in enumerate(plan):
        if progress:
            progress(done, len(plan))
        cases.append(CASES[name][0](size))
    if progress:
        progress(len(plan), len(plan))
    return {"hardware": describe(), "cases": cases}
