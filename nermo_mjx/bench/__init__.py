"""Benchmarks of this machine: throughput, compile time and memory of each engine against plain physics, and more."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, Final

from nermo_mjx.bench.hardware import commit, describe
from nermo_mjx.bench.registry import CASES, Benchmark, plan

__all__ = ["CASES", "run_bench"]


def run_bench(
    cases: Sequence[str] = ("throughput",),
    options: Mapping[str, Sequence[Any]] | None = None,
    progress: Callable[[int, int], None] | None = None,
    keep: Callable[[dict[str, Any]], None] | None = None,
    known: Callable[[str, dict[str, Any]], bool] = lambda name, chosen: False,
) -> dict[str, Any]:
    """Measure on this machine, each measurement in its own process.

    This isolates the peak of memory, protects the other measurements if one fails or runs out of memory, and keeps this
    process from holding the accelerator.

    Args:
        cases: names from `CASES`.
        options: option of a case -> values; each combination is measured.
        progress: called with (measurements done, measurements in all).
        keep: called with the run of each single measurement, as soon as it is finished.
        known: tells which measurements, of cases that are made `once`, already exist.

    Returns:
        `{"date", "commit", "hardware": {...}, "cases": [{"case", ...}]}`. A case that failed has `error`, a sentence,
        instead of figures. `ratio` of an engine is the plain time over ours: 1 means that controller and metrics are
        free; that of a gradient is its time over the time of the walk alone.

    Raises:
        ParameterError: see `registry.plan`.
    """
    planned = [(name, chosen) for name, chosen in plan(cases, options or {})
               if not (CASES[name].once and known(name, chosen))]  # fmt: skip
    lines, hardware = [], None
    for done, (name, chosen) in enumerate(planned):
        if progress:
            progress(done, len(planned))
        found, line = apart(CASES[name], chosen)
        lines.append({"case": name, **chosen, **line})
        # The process may have ended early: a figure without its machine is useless.
        hardware = found or hardware or apart(_NOTHING, {})[0]
        if keep:
            keep(_run(hardware, lines[-1:]))
    if progress:
        progress(len(planned), len(planned))
    return _run(hardware, lines)


#: A case without a measurement, which only reports the hardware.
_NOTHING: Final = Benchmark("", "builtins:dict", {})


def _run(hardware: dict[str, Any] | None, lines: list[dict[str, Any]]) -> dict[str, Any]:
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"date": now, "commit": commit(), "hardware": hardware, "cases": lines}


def apart(case: Benchmark, options: dict[str, Any]) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """(hardware, figures) of one measurement, made in a new process; no hardware if that ended early."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(measure, case, options).result()
        except BrokenProcessPool:
            return None, {"error": "the process ended without a result; most often it ran out of memory."}


def measure(case: Benchmark, options: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """(hardware, figures) of one measurement, in this process; an error becomes the figures' only entry."""
    try:
        figures = case.measure(**options)
    except Exception as error:  # whatever it is, continue with the others
        figures = {"error": f"{type(error).__name__}: {error}".strip().split("\n")[0]}
    return describe(), figures
