"""Benchmarks of this machine: throughput, compile time, memory and start-up, and the cost of a gradient."""

from __future__ import annotations

import dataclasses
import datetime
import importlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, Final

from nermo_mjx.bench.machine import commit, describe
from nermo_mjx.robot import ParameterError

__all__ = ["CASES", "Benchmark", "Option", "apart", "plan", "run_bench", "run_of"]


@dataclasses.dataclass(frozen=True)
class Option:
    """An option that a measurement is repeated over.

    Attributes:
        default: values that are measured by default; a line that does not name the option was made with the first.
        allowed: names; None for any positive number.
        whole: whether the number is whole.
    """

    default: tuple[Any, ...]
    allowed: tuple[Any, ...] | None = None
    whole: bool = False

    def check(self, name: str, value: Any) -> None:
        """Raises `ParameterError` unless the value is allowed."""
        if self.allowed is not None and value not in self.allowed:
            raise ParameterError(f"{name} is {value!r}: allowed is one of {', '.join(map(str, self.allowed))}.")
        if self.allowed is None and not (0 < value < float("inf") and (value == int(value) or not self.whole)):
            range_ = "a whole number from 1" if self.whole else "(0, inf)"
            raise ParameterError(f"{name} is {value:g}: allowed is {range_}.")


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """A measurement: a function of its options that returns one line of figures.

    Attributes:
        about: what it measures, for listings.
        place: module and name of the function; it is imported in the process that measures.
        options: by name.
    """

    about: str
    place: str
    options: Mapping[str, Option]


_BY_ENGINE: Final = {"engine": Option(("c", "mjx"), ("c", "mjx", "warp")), "worlds": Option((64,), whole=True)}
_MODES: Final = ("forward", "reverse")
CASES: Final[dict[str, Benchmark]] = {
    "throughput": Benchmark(
        "a walk with its controller and metrics against plain physics",
        "nermo_mjx.bench.cases:throughput_case",
        _BY_ENGINE,
    ),
    "gradient": Benchmark(
        "value and gradient of a walk against the walk alone",
        "nermo_mjx.bench.cases:gradient_case",
        {"mode": Option(_MODES, _MODES), "worlds": Option((16,), whole=True), "cycles": Option((1.0,))},
    ),
    "startup": Benchmark(
        "from a new process to the first control tick, stage by stage, with a cold and a warm cache",
        "nermo_mjx.bench.cases:startup_case",
        _BY_ENGINE,
    ),
}


def plan(cases: Sequence[str], chosen: Mapping[str, Sequence[Any]]) -> list[tuple[str, dict[str, Any]]]:
    """(name, options) of each measurement: all combinations of the chosen values, or of the defaults.

    Args:
        cases: names from `CASES`.
        chosen: option -> values; missing or empty ones have their default.

    Raises:
        ParameterError: an unknown case, a value that is not allowed, or an option that none of the cases has.
    """
    for name in cases:
        if name not in CASES:
            raise ParameterError(f"case is {name!r}: allowed is one of {', '.join(CASES)}.")
    for option, values in chosen.items():
        owners = [CASES[name].options[option] for name in cases if option in CASES[name].options]
        if values and not owners:
            having = [name for name, case in CASES.items() if option in case.options]
            raise ParameterError(f"{option} is given, but not measured: it is an option of {' and '.join(having)}.")
        for owner, value in itertools.product(owners, values or ()):
            owner.check(option, value)
    planned = []
    for name in cases:
        options = CASES[name].options
        values = [tuple(chosen.get(key) or option.default) for key, option in options.items()]
        planned += [(name, dict(zip(options, row, strict=True))) for row in itertools.product(*values)]
    return planned


def run_bench(
    cases: Sequence[str] = ("throughput",),
    options: Mapping[str, Sequence[Any]] | None = None,
    progress: Callable[[int, int], None] | None = None,
    keep: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Measure on this machine, each measurement in its own process.

    This isolates the peak of memory, protects the other measurements if one fails or runs out of memory, and keeps this
    process from holding the accelerator.

    Args:
        cases: names from `CASES`.
        options: option of a case -> values; each combination is measured.
        progress: called with (measurements done, measurements in all).
        keep: called with the run of each single measurement, as soon as it is finished.

    Returns:
        `{"date", "commit", "hardware": {...}, "cases": [{"case", ...}]}`. A case that failed has `error`, a sentence,
        instead of figures. `ratio` of an engine is the plain time over ours: 1 means that controller and metrics are
        free; that of a gradient is its time over the time of the walk alone.

    Raises:
        ParameterError: see `plan`.
    """
    planned = plan(cases, options or {})
    lines, hardware = [], None
    for done, (name, chosen) in enumerate(planned):
        if progress:
            progress(done, len(planned))
        found, line = apart(CASES[name], chosen)
        lines.append({"case": name, **chosen, **line})
        # The process may have ended early: a figure without its machine is useless.
        hardware = found or hardware or apart(Benchmark("", "builtins:dict", {}), {})[0]
        if keep:
            keep(run_of(hardware, lines[-1:]))
    if progress:
        progress(len(planned), len(planned))
    return run_of(hardware, lines)


def run_of(hardware: dict[str, Any] | None, lines: list[dict[str, Any]]) -> dict[str, Any]:
    """What is stored of measurements made now: date, commit, hardware and lines of figures."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"date": now, "commit": commit(), "hardware": hardware, "cases": lines}


def apart(case: Benchmark, options: dict[str, Any]) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """(hardware, figures) of one measurement, made in a new process; no hardware if that ended early."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(_measure, case.place, options).result()
        except BrokenProcessPool:
            return None, {"error": "the process ended without a result; most often it ran out of memory."}


def _measure(place: str, options: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """(hardware, figures) of one measurement, in this process; an error becomes the figures' only entry."""
    module, _, name = place.partition(":")
    try:
        figures = getattr(importlib.import_module(module), name)(**options)
    except Exception as error:  # whatever it is, continue with the others
        figures = {"error": f"{type(error).__name__}: {error}".strip().split("\n")[0]}
    return describe(), figures
