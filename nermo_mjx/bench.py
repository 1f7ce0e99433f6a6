"""Benchmarks of this machine: throughput and memory of each engine, and the start of a process.

`docs/benchmarks` compares with plain physics, measures gradients, searches and other models, and keeps the results.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, Final

import jax
import numpy as np

from nermo_mjx.physics.making import ENGINES
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.rollout.simulator import Simulator
from nermo_mjx.runs.code import processor
from nermo_mjx.runtime import cpu_count

#: Control ticks in a timed round, and rounds: the median counts, since machines are shared and noisy.
ROUND_TICKS, TIMED_ROUNDS = 20, 9


def run_bench(
    cases: Sequence[str],
    engines: Sequence[str] = ("c", "mjx"),
    worlds: Sequence[int] = (64,),
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure on this machine, each measurement in its own process.

    This isolates the peak of memory, protects the other measurements if one fails or runs out of memory, and keeps this
    process from holding the accelerator.

    Args:
        cases: names of `BENCHMARKS`.
        engines, worlds: each combination is measured; `worlds` is the size of the batch.
        progress: called with (measurements done, measurements in all).

    Returns:
        `{"hardware": {...}, "cases": [{"case", "engine", "worlds", ...}]}`. A case that failed has `error`, a sentence,
        instead of figures.

    Raises:
        ParameterError: an unknown case or engine, or an empty batch.
    """
    for name, requested, allowed in (("case", cases, BENCHMARKS), ("engine", engines, ENGINES)):
        if unknown := [choice for choice in requested if choice not in allowed]:
            raise ParameterError(
                f"{name} is {unknown[0]!r}: allowed is one of {', '.join(allowed)}."
            )
    if empty := [size for size in worlds if size < 1]:
        raise ParameterError(f"worlds is {empty[0]}: allowed is a whole number from 1.")
    planned = [(case, engine, size) for case in cases for engine in engines for size in worlds]
    lines = []
    for count, (case, engine, size) in enumerate(planned):
        if progress:
            progress(count, len(planned))
        lines += [
            {
                "case": case,
                "engine": engine,
                "worlds": size,
                **apart(BENCHMARKS[case], engine, size),
            }
        ]
    if progress:
        progress(len(planned), len(planned))
    return {"hardware": apart(machine_description), "cases": lines}


def apart(measure: Callable[..., dict[str, Any]], *options: Any) -> dict[str, Any]:
    """The figures of one measurement, made in a new process; a failure is their only entry, `error`."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(measure, *options).result()
        except BrokenProcessPool:
            return {"error": "the process ended without a result; most often it ran out of memory."}
        except Exception as error:  # whatever it is, continue with the others
            return {"error": f"{type(error).__name__}: {error}".strip().split("\n")[0]}


def measurement_table(lines: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of measurements of one case; a start has a row for each state of the cache, a failure none.

    Headings end with > where texts are on the right.
    """
    rows: list[dict[str, Any]] = []
    for line in lines:
        options = {key: line[key] for key in ("engine", "worlds")}
        starts = [
            {**options, "cache": cache, "to the first tick_s": line[f"{cache}_s"], **line[cache]}
            for cache in line
            if cache in CACHE_STATES
        ]
        figures = {key: value for key, value in line.items() if key != "case"}
        rows += starts or ([] if "error" in line else [figures])
    keys = list(dict.fromkeys(key for row in rows for key in row))

    def heading(key: str) -> str:
        for ending, unit in (("_bytes", " [MB]"), ("_s", " [s]")):
            if key.endswith(ending):
                return key.removesuffix(ending).replace("_", " ") + unit + ">"
        return key if key in ("engine", "cache") else key.replace("_", " ") + ">"

    def cell(key: str, value: Any) -> str:
        if value is None or isinstance(value, str):
            return value or "-"
        value = value / 1e6 if key.endswith("_bytes") else value
        return f"{value:,.2f}" if value < 100 and isinstance(value, float) else f"{value:,.0f}"

    return [heading(key) for key in keys], [
        [cell(key, row.get(key)) for key in keys] for row in rows
    ]


def throughput(engine: str, worlds: int) -> dict[str, Any]:
    """Physics steps per second of a walk with controller and metrics, and how long it takes to start.

    Every world has its own spine amplitude and phase, as in a sweep. `start_s`, until the first ticks are done,
    includes compiling, unless the programs are in the cache.
    """
    simulator = Simulator(Setup(spine="stride_extension"), engine)
    values = {
        "frequency": np.full(worlds, 0.8),
        "spine.amplitude": np.linspace(0.0, 0.4, worlds),
        "spine.phase": np.linspace(-1.0, 0.0, worlds),
    }
    batch = simulator.prepare(values)
    times = [time.perf_counter()]
    session = simulator.engine.open(batch.params, batch.qpos, batch.fields)
    for _ in range(1 + TIMED_ROUNDS):
        session.advance(ROUND_TICKS)
        jax.block_until_ready(session.loop_state)
        times.append(time.perf_counter())
    start_s, *rounds = np.diff(times).tolist()
    round_s = statistics.median(rounds)
    steps = worlds * ROUND_TICKS * simulator.loop.steps_per_tick
    return {
        "steps_per_second": steps / round_s,
        "simulated_seconds_per_second": steps / round_s * simulator.robot.config.timestep,
        "start_s": start_s,
        "peak_bytes": peak_bytes(),
    }


#: States of the cache of compiled programs at a start.
CACHE_STATES: Final = ("cold", "warm")
#: The steps of a sweep before its first tick, timed; run by a new interpreter.
STARTUP_PROGRAM: Final = """
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
if engine == "c":
    from nermo_mjx.learn import Training
    from nermo_mjx.learn.experience import RESET_KEY
    training = Training.from_dict({"worlds": 256, "steps": 1})
    environment = training.environment(engine)
    learned = training.algorithm.begin(environment, training.seed)
    iterate = training.algorithm.make_iteration(environment)
    jax.block_until_ready(iterate(learned, environment.reset(learned.random_key(RESET_KEY)))[0])
    stages["training_s"] = lap()
print(json.dumps(stages))
"""


def startup(engine: str, worlds: int) -> dict[str, Any]:
    """Stages of a start with a cold cache, and of a second one with the cache that the first left [s].

    `cold_s` and `warm_s` are to the first tick; on `c` a training of 256 worlds follows, to its first iteration's end.
    """
    environment = {
        key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"
    }
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as cache:
        for state in CACHE_STATES:
            process = subprocess.run(
                [sys.executable, "-c", STARTUP_PROGRAM, engine, str(worlds)],
                env=environment | {"NERMO_MJX_CACHE": cache},
                check=False,
                capture_output=True,
                text=True,
            )
            if process.returncode:
                raise RuntimeError(process.stderr.strip().split("\n")[-1])
            stages = json.loads(process.stdout.strip().split("\n")[-1])
            figures[f"{state}_s"] = sum(
                took for stage, took in stages.items() if stage != "training_s"
            )
            figures[state] = stages
    return figures


#: The measurements by name: functions of an engine and the size of a batch.
BENCHMARKS: Final[dict[str, Callable[[str, int], dict[str, Any]]]] = {
    "throughput": throughput,
    "startup": startup,
}


def machine_description() -> dict[str, Any]:
    """Name of the processor and accelerator, and versions of the numerical packages."""
    devices = jax.devices()
    versions = {
        name: importlib.metadata.version(name) for name in ("mujoco", "mujoco-mjx", "jax", "jaxlib")
    }
    return {
        "cpu": processor(),
        "cores": cpu_count(),
        "device": f"{len(devices)} x {devices[0].device_kind}",
        "python": platform.python_version(),
        **versions,
    }


def peak_bytes() -> int | None:
    """Peak memory so far: of the accelerator, or of this process on a CPU; None on Windows, where it is unknown."""
    memory = jax.local_devices()[0].memory_stats() if jax.default_backend() != "cpu" else None
    if memory and "peak_bytes_in_use" in memory:
        return int(memory["peak_bytes_in_use"])
    if sys.platform == "win32":
        return None
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
        1 if sys.platform == "darwin" else 1024
    )
