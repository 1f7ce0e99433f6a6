"""MuJoCo's own speed test of MJX (`mjx-testspeed`) on the robot's model, as its users know it from other models."""

from __future__ import annotations

import copy
import os
from typing import Any, Final

from nermo_mjx.bench.hardware import peak_bytes
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.rollout.setup import Setup

STEPS: Final = 100


def speedtest_case(worlds: int) -> dict[str, Any]:
    """Steps per second of `mjx.benchmark` with its defaults: one iteration of Newton's method, four of line search.

    The robot stands, with no controller, and its solver stops long before convergence: this is an upper bound of MJX's
    speed with this model, not a walk.
    """
    model = copy.copy(Setup(spine="stride_extension").load().physical)
    flags = os.environ.get("XLA_FLAGS")
    try:
        jit_s, run_s, steps = mjx.benchmark(model, STEPS, worlds)
    finally:  # it leaves modified flags behind
        if flags is not None:
            os.environ["XLA_FLAGS"] = flags
    return {"engine": "mjx", "steps_per_second": steps / run_s, "compile_s": jit_s, "peak_bytes": peak_bytes()}
