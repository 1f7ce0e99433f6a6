"""Timing on shared, noisy machines: two alternating programs, compared round by round; and uncached compilation."""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
from jax.experimental.compilation_cache import compilation_cache


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def compare(ours: Callable[[], object], plain: Callable[[], object], rounds: int) -> tuple[float, float, float]:
    """(seconds of `ours`, seconds of `plain`, plain over ours), medians over rounds in which both ran, alternately."""
    pairs = []
    for i in range(rounds):
        if i % 2:
            plain_seconds, our_seconds = seconds(plain), seconds(ours)
        else:
            our_seconds, plain_seconds = seconds(ours), seconds(plain)
        pairs.append((our_seconds, plain_seconds))
    return (
        statistics.median(our for our, _ in pairs),
        statistics.median(plain for _, plain in pairs),
        statistics.median(plain / our for our, plain in pairs),
    )


class Compiled(NamedTuple):
    """A program, and its compile times [s]."""

    trace_s: float
    compile_s: float
    program: Any


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
