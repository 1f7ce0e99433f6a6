"""Tracing and compiling, timed apart and with a cold cache."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
from jax.experimental.compilation_cache import compilation_cache


class Compiled(NamedTuple):
    """A program, and what it took to make it [s]."""

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
    """Compile in earnest, though the persistent cache may hold the program."""
    directory = getattr(jax.config, "jax_compilation_cache_dir")  # noqa: B009 (jax declares its options at run time)
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", directory)
        compilation_cache.reset_cache()
