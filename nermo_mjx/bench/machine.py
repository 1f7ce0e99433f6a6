"""The machine that is measured; timing on it, though it is shared and noisy; and compiling without the cache."""

from __future__ import annotations

import contextlib
import importlib.metadata
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax.experimental.compilation_cache import compilation_cache

from nermo_mjx.runs.code import processor
from nermo_mjx.runtime import cpu_count


def describe() -> dict[str, str | int]:
    """Name of the processor and accelerator, memory, and versions of the numerical packages."""
    devices = jax.devices()
    versions = {name: importlib.metadata.version(name) for name in ("mujoco", "mujoco-mjx", "jax", "jaxlib")}
    return {
        "cpu": processor(),
        "cores": cpu_count(),
        "device": f"{len(devices)} x {devices[0].device_kind}",
        "python": platform.python_version(),
        **versions,
    }


def commit() -> str | None:
    """The commit of the measured source, with a + if files differ from it; None for an installed package."""
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--exclude=*", "--dirty=+", "--abbrev=12"]
    try:
        done = subprocess.run(git, check=False, capture_output=True, text=True)
    except OSError:
        return None
    return done.stdout.strip() or None


def peak_bytes() -> int:
    """Peak memory so far: of the accelerator, or of this process on a CPU."""
    statistics = jax.local_devices()[0].memory_stats() if jax.default_backend() != "cpu" else None
    if statistics and "peak_bytes_in_use" in statistics:
        return int(statistics["peak_bytes_in_use"])
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def compare(ours: Callable[[], object], plain: Callable[[], object], rounds: int) -> tuple[float, float, float]:
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
