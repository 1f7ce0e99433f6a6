"""Time from a new process to its first control tick: stage by stage, with a cold and with a warm cache."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from typing import Any, Final

#: The steps of a sweep before its first tick, timed; run by a new interpreter.
PROGRAM: Final = """
import json, sys, time
began = time.perf_counter()
def lap():
    global began
    now = time.perf_counter()
    took, began = now - began, now
    return took
engine, worlds = sys.argv[1], int(sys.argv[2])
import nermo_mjx
import jax, numpy as np
from nermo_mjx.rollout import Run, Setup, Simulator
stages = {"import_s": lap()}
simulator = Simulator(Setup(spine="stride_extension"), engine)
stages["model_s"] = lap()
values = {"frequency": np.full(worlds, 0.8), "spine.amplitude": np.linspace(0.0, 0.4, worlds)}
batch = simulator.prepare(values, Run(cycles=2))
stages["parameters_s"] = lap()
session = simulator.engine.open(batch.params, batch.qpos, batch.fields)
jax.block_until_ready(session.loop_state)
stages["open_s"] = lap()
session.advance(1)
jax.block_until_ready(session.loop_state)
stages["first_tick_s"] = lap()
print(json.dumps(stages))
"""


def startup_case(engine: str, worlds: int) -> dict[str, Any]:
    """Stages of a start with a cold cache, and of a second one with the cache that the first left [s]."""
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = (_start(engine, worlds, cache) for _ in range(2))
    return {
        "cold_s": sum(cold.values()), "warm_s": sum(warm.values()),
        "cold": cold, "warm": warm,
    }  # fmt: skip


def _start(engine: str, worlds: int, cache: str) -> dict[str, float]:
    environment = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, engine, str(worlds)], env=environment | {"NERMO_MJX_CACHE": cache},
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(done.stderr.strip().split("\n")[-1])
    stages: dict[str, float] = json.loads(done.stdout.strip().split("\n")[-1])
    return stages
