"""One measurement an engine: the walking robot with its controller and metrics, against plain physics of the same model."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental.compilation_cache import compilation_cache
from mujoco import rollout

from nermo_mjx.bench.hardware import peak_bytes
from nermo_mjx.bench.timing import compare, seconds
from nermo_mjx.physics.c_engine import CEngine
from nermo_mjx.physics.mjx_engine import MjxEngine, MjxState, mjx
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.rollout.simulator import Batch, Simulator

#: Control ticks in a timed round, and rounds.
TICKS, ROUNDS = {"c": 100, "mjx": 20}, {"c": 7, "mjx": 5}


def _walk(engine: str, worlds: int) -> tuple[Simulator, Batch]:
    """A batch like a sweep's: every world with its own spine amplitude and phase."""
    simulator = Simulator(Setup(spine="stride_extension"), engine)
    values = {
        "frequency": np.full(worlds, 0.8),
        "spine.amplitude": np.linspace(0.0, 0.4, worlds),
        "spine.phase": np.linspace(-1.0, 0.0, worlds),
    }
    return simulator, simulator.prepare(values)


def c_case(worlds: int) -> dict[str, Any]:
    """C engine against one call of `mujoco.rollout` with the same states and servo targets on all cores."""
    simulator, batch = _walk("c", worlds)
    engine = simulator.engine
    assert isinstance(engine, CEngine)
    ticks, steps = TICKS["c"], simulator.loop.steps_per_tick
    compile_s = seconds(lambda: engine.open(batch.params, batch.qpos, batch.fields).advance(1))
    session = engine.open(batch.params, batch.qpos, batch.fields)
    session.advance(ticks)  # past the start-up, into the walk

    size = mujoco.mj_stateSize(simulator.robot.model, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
    state = np.zeros((worlds, size))
    state[:, 1 : 1 + session.qpos.shape[1]] = session.qpos
    state[:, 1 + session.qpos.shape[1] :][:, : session.qvel.shape[1]] = session.qvel
    trace = engine.open(batch.params, batch.qpos, batch.fields).record(2 * ticks)
    control = np.repeat(trace.ctrl[:, ticks:], steps, axis=1)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    data = [mujoco.MjData(simulator.robot.model) for _ in range(cores)]

    with rollout.Rollout(nthread=cores) as pool:
        def plain() -> None:
            pool.rollout(simulator.robot.model, data, state, control)

        plain()
        ours_s, plain_s, ratio = compare(lambda: session.advance(ticks), plain, ROUNDS["c"])
    return _case("c", worlds, ticks * steps, ours_s, plain_s, ratio, simulator) | {"trace_s": 0.0, "compile_s": compile_s, "plain_compile_s": 0.0}


def mjx_case(worlds: int) -> dict[str, Any]:
    """MJX engine against a `lax.scan` over `mjx.step` alone, batch and number of steps the same."""
    simulator, batch = _walk("mjx", worlds)
    engine = simulator.engine
    assert isinstance(engine, MjxEngine)
    ticks, steps = TICKS["mjx"], simulator.loop.steps_per_tick
    session = engine.open(batch.params, batch.qpos, batch.fields)
    arguments = (session.params, session.fields, session.carry, jnp.int32(ticks))

    def plain(state: MjxState, ctrl: jax.Array, count: jax.Array) -> MjxState:
        def step(one: MjxState, target: jax.Array) -> MjxState:
            data = mjx.step(engine.model, engine.data.replace(ctrl=target, **one._asdict()))
            return MjxState(data.qpos, data.qvel, data.act, data.qacc_warmstart)

        return jax.lax.fori_loop(0, count, lambda _, s: jax.vmap(step)(s, ctrl), state)

    ours_trace, ours_compile, program = _compile(engine.advance, *arguments)
    ctrl = jnp.asarray(engine.open(batch.params, batch.qpos, batch.fields).record(1).ctrl[:, 0])
    plain_arguments = (session.carry.physics, ctrl, jnp.int32(ticks * steps))
    plain_trace, plain_compile, plain_program = _compile(jax.jit(plain), *plain_arguments)

    carry = jax.tree.map(jnp.copy, session.carry)

    def run_ours() -> None:
        nonlocal carry
        carry = jax.block_until_ready(program(session.params, session.fields, carry, jnp.int32(ticks)))

    def run_plain() -> None:
        jax.block_until_ready(plain_program(*plain_arguments))

    run_ours(), run_plain()
    ours_s, plain_s, ratio = compare(run_ours, run_plain, ROUNDS["mjx"])
    return _case("mjx", worlds, ticks * steps, ours_s, plain_s, ratio, simulator) | {
        "trace_s": ours_trace,
        "compile_s": ours_compile,
        "plain_trace_s": plain_trace,
        "plain_compile_s": plain_compile,
    }


def _compile(function: Any, *arguments: Any) -> tuple[float, float, Any]:
    """(seconds to trace and lower, seconds to compile with a cold cache, the program)."""
    began = time.perf_counter()
    lowered = function.lower(*arguments)
    traced = time.perf_counter()
    with _without_cache():
        program = lowered.compile()
    return traced - began, time.perf_counter() - traced, program


@contextlib.contextmanager
def _without_cache() -> Iterator[None]:
    """Compile in earnest, though the persistent cache may hold the program."""
    directory = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", directory)
        compilation_cache.reset_cache()


def _case(
    engine: str, worlds: int, steps: int, ours_s: float, plain_s: float, ratio: float, simulator: Simulator
) -> dict[str, Any]:
    rate = worlds * steps / ours_s
    return {
        "engine": engine,
        "worlds": worlds,
        "steps_per_second": rate,
        "plain_steps_per_second": worlds * steps / plain_s,
        "ratio": ratio,
        "seconds_simulated_per_second": rate * simulator.robot.config.timestep,
        "peak_bytes": peak_bytes(),
    }
