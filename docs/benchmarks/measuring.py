"""What the studies beside this file share: timing on a noisy machine, and lines of results with their origin."""

from __future__ import annotations

import contextlib
import datetime
import json
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import jax
from jax.experimental.compilation_cache import compilation_cache
from jaxtyping import Array

from nermo_mjx.bench import machine_description
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.rollout.run import Run
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.runs.files import replace_file

#: The derivative: of the mean speed by the two parameters of the stride extension.
NAMES: Final = ("spine.amplitude", "spine.phase")
FREQUENCY: Final = 0.8  # [Hz]


def differentiable_walk(
    cycles: float,
) -> tuple[Rollout, Callable[[Array], tuple[Array, dict[str, Array]]]]:
    """A walk of a number of gait cycles, and its speed and metrics as a function of `NAMES`."""
    rollout = Rollout(Setup(spine="stride_extension"), Run(cycles=cycles, warmup_cycles=0), "mjx")

    def walk(point: Array) -> tuple[Array, dict[str, Array]]:
        metrics = rollout({"frequency": FREQUENCY, **dict(zip(NAMES, point, strict=True))})
        return metrics["speed"], metrics

    return rollout, walk


def with_gradient(walk: Callable[[Array], tuple[Array, Any]], mode: str) -> Callable[[Array], Any]:
    """The gradient of a walk's value, with the value and the rest of what it returns, in a mode of MJX."""

    def kept(point: Array) -> tuple[Array, Any]:
        value, rest = walk(point)
        return value, (value, rest)

    return {"forward": jax.jacfwd, "reverse": jax.jacrev}[mode](kept, has_aux=True)


def run_of(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """What is stored of measurements made now: date, commit, hardware and lines of figures."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"date": now, "commit": commit(), "hardware": machine_description(), "cases": lines}


def commit() -> str | None:
    """The commit of the measured source, with a + if files differ from it; None for an installed package."""
    git = [
        "git",
        "-C",
        str(Path(__file__).parent),
        "describe",
        "--always",
        "--exclude=*",
        "--dirty=+",
        "--abbrev=12",
    ]
    try:
        done = subprocess.run(git, check=False, capture_output=True, text=True)
    except OSError:
        return None
    return done.stdout.strip() or None


def append(path: Path, run: Mapping[str, Any]) -> None:
    """Append a run to a file as one line; existing lines are unchanged."""
    before = path.read_bytes() if path.exists() else b""
    replace_file(path, before + json.dumps(run).encode() + b"\n")


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def compare(
    ours: Callable[[], object], plain: Callable[[], object], rounds: int
) -> tuple[float, float, float]:
    """(seconds of `ours`, seconds of `plain`, plain over ours), medians over rounds in which both ran, alternately."""
    pairs = []
    for i in range(rounds):
        took = {work: seconds(work) for work in ((ours, plain) if i % 2 == 0 else (plain, ours))}
        pairs.append((took[ours], took[plain]))
    ours_s, plain_s = (statistics.median(times) for times in zip(*pairs, strict=True))
    return ours_s, plain_s, statistics.median(plain / our for our, plain in pairs)


class Compiled(NamedTuple):
    """A program, and its compile times [s]."""

    trace_s: float
    compile_s: float
    program: Any


def compiling(ours: Compiled, plain: Compiled) -> dict[str, float]:
    """The compile times of a measurement and of its baseline [s], as its line has them."""
    times = {"trace_s": ours.trace_s, "compile_s": ours.compile_s}
    return times | {"plain_trace_s": plain.trace_s, "plain_compile_s": plain.compile_s}


def compile_cold(function: Any, *arguments: Any) -> Compiled:
    """Seconds to trace and lower, seconds to compile with a cold cache, and the program."""
    began = time.perf_counter()
    lowered = function.lower(*arguments)
    traced = time.perf_counter()
    with _without_cache():
        program = lowered.compile()
    return Compiled(traced - began, time.perf_counter() - traced, program)


@contextlib.contextmanager
def _without_cache() -> Iterator[None]:
    """Compile without using the persistent cache."""
    directory = getattr(jax.config, "jax_compilation_cache_dir")  # noqa: B009 (jax declares its options at run time)
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", directory)
        compilation_cache.reset_cache()
