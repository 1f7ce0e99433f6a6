"""The measurements: throughput of a walk, the cost of its gradient, and the start of a process."""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array
from mujoco import rollout

from nermo_mjx.bench.machine import Compiled, compare, compile_cold, compiling, peak_bytes
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.physics.c_engine import CEngine
from nermo_mjx.physics.mjx_engine import MjxEngine
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.rollout.run import Run
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.rollout.simulator import Batch, Simulator
from nermo_mjx.runtime import compiler_options, cpu_count

#: Control ticks in a timed round, and rounds.
TICKS, ROUNDS = {"c": 100, "scan": 20}, {"c": 15, "scan": 5}


def throughput_case(engine: str, worlds: int) -> dict[str, Any]:
    """Steps per second of a walk, and of a plain MuJoCo program for the same model."""
    return c_case(worlds) if engine == "c" else scan_case(engine, worlds)


def _walk(engine: str, worlds: int) -> tuple[Simulator, Batch]:
    """A batch like that of a sweep: every world has its own spine amplitude and phase."""
    simulator = Simulator(Setup(spine="stride_extension"), engine)
    values = {
        "frequency": np.full(worlds, 0.8),
        "spine.amplitude": np.linspace(0.0, 0.4, worlds),
        "spine.phase": np.linspace(-1.0, 0.0, worlds),
    }
    return simulator, simulator.prepare(values)


def c_case(worlds: int) -> dict[str, Any]:
    """C engine against one call of `mujoco.rollout`, with the same states and servo targets.

    Both have all cores, and the same model but for sparse Jacobians: plain MuJoCo chooses dense ones for so few joints.
    """
    simulator, batch = _walk("c", worlds)
    engine = simulator.engine
    assert isinstance(engine, CEngine)
    ticks, steps = TICKS["c"], simulator.loop.steps_per_tick
    session = engine.open(batch.params, batch.qpos, batch.fields)
    # Neither `loop.step` itself nor the function in it: JAX has cached both since the session was opened.
    tick = inspect.unwrap(session.loop.step)
    ours = compile_cold(jax.jit(lambda *given: tick(*given), compiler_options=compiler_options()), *session.arguments)
    session.advance(ticks)  # past the start-up phase

    size = mujoco.mj_stateSize(simulator.robot.physical, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
    state = np.zeros((worlds, size))
    state[:, 1 : 1 + session.qpos.shape[1]] = session.qpos
    state[:, 1 + session.qpos.shape[1] :][:, : session.qvel.shape[1]] = session.qvel
    trace = engine.open(batch.params, batch.qpos, batch.fields).record(2 * ticks)
    control = np.repeat(trace.ctrl[:, ticks:], steps, axis=1)
    cores = cpu_count()
    data = [mujoco.MjData(simulator.robot.physical) for _ in range(cores)]

    with rollout.Rollout(nthread=cores) as pool:

        def plain() -> None:
            pool.rollout(simulator.robot.physical, data, state, control)

        plain()
        ours_s, plain_s, ratio = compare(lambda: session.advance(ticks), plain, ROUNDS["c"])
    nothing = Compiled(0.0, 0.0, None)  # plain C compiles nothing
    return _case(simulator, worlds, ticks * steps, ours_s, plain_s) | compiling(ours, nothing) | {"ratio": ratio}


def scan_case(name: str, worlds: int) -> dict[str, Any]:
    """An engine of MJX against the scan a user would write: `mjx.step` carrying `mjx.Data`, same batch and targets.

    `loop_cost` is the time of controller and metrics, relative to the same engine playing back the targets.

    Args:
        name: `mjx` or `warp`, also of the plain scan's implementation.
        worlds: size of the batch.
    """
    simulator, batch = _walk(name, worlds)
    engine = simulator.engine
    assert isinstance(engine, MjxEngine)
    ticks, steps = TICKS["scan"], simulator.loop.steps_per_tick
    session = engine.open(batch.params, batch.qpos, batch.fields)
    count = jnp.int32(ticks)
    ours = compile_cold(engine.advance, session.params, session.fields, session.carry, count)

    walking = jax.block_until_ready(ours.program(session.params, session.fields, session.carry, count))
    states, ctrl = walking.physics, _targets(simulator, batch, ticks)
    blank = engine.data_among(worlds)
    data = jax.jit(jax.vmap(lambda one: one.into(blank)))(states)

    def scan(data: mjx.Data, ctrl: jax.Array) -> mjx.Data:
        def tick(data: mjx.Data, target: jax.Array) -> tuple[mjx.Data, None]:
            return jax.vmap(lambda one, goal: mjx.step(engine.model, one.replace(ctrl=goal)))(data, target), None

        return jax.lax.scan(tick, data, ctrl)[0]

    plain = compile_cold(jax.jit(scan), data, ctrl)
    puppets = type(engine)(simulator.robot, Puppet(steps), engine.devices.count)
    strings = jnp.moveaxis(ctrl[::steps], 0, 1)
    hung = walking._replace(loop=jnp.zeros(worlds, jnp.int32))

    # Each round all walk the same steps. The carry is donated, so each program gets a copy.
    def run_ours() -> None:
        jax.block_until_ready(ours.program(session.params, session.fields, jax.tree.map(jnp.copy, walking), count))

    def run_plain() -> None:
        jax.block_until_ready(plain.program(data, ctrl))

    def run_puppets() -> None:
        jax.block_until_ready(puppets.advance(strings, session.fields, jax.tree.map(jnp.copy, hung), count))

    run_ours()
    run_plain()
    run_puppets()
    ours_s, plain_s, ratio = compare(run_ours, run_plain, ROUNDS["scan"])
    loop_cost = 1.0 / compare(run_ours, run_puppets, ROUNDS["scan"])[2] - 1.0
    carry = sum(leaf.nbytes for leaf in jax.tree.leaves(walking)) // worlds
    own = {"ratio": ratio, "loop_cost": loop_cost, "carry_bytes_per_world": carry}
    return _case(simulator, worlds, ticks * steps, ours_s, plain_s) | compiling(ours, plain) | own


@dataclasses.dataclass(frozen=True)
class Puppet:
    """A loop that plays back given targets, (ticks, n_servos) for each world, repeatedly: physics alone."""

    steps_per_tick: int

    def init(self, params: jax.Array, sensordata: jax.Array) -> jax.Array:
        """The tick, 0."""
        return jnp.int32(0)

    def step(self, params: jax.Array, state: jax.Array, sensordata: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The next tick, and this one's targets."""
        return state + 1, params[state % len(params)]


def _targets(simulator: Simulator, batch: Batch, ticks: int) -> jax.Array:
    """Servo targets of a walk, one row per physics step (ticks * steps, worlds, servos), from the C engine."""
    engine = CEngine(simulator.robot, simulator.loop)
    trace = engine.open(batch.params, batch.qpos, batch.fields).record(2 * ticks)
    steps = np.repeat(np.moveaxis(trace.ctrl[:, ticks:], 0, 1), simulator.loop.steps_per_tick, axis=0)
    return jnp.asarray(steps)


def _case(simulator: Simulator, worlds: int, steps: int, ours_s: float, plain_s: float) -> dict[str, Any]:
    rate = worlds * steps / ours_s
    return {
        "steps_per_second": rate,
        "plain_steps_per_second": worlds * steps / plain_s,
        "seconds_simulated_per_second": rate * simulator.robot.config.timestep,
        "peak_bytes": peak_bytes(),
    }


#: The derivative: of the mean speed by the two parameters of the stride extension.
NAMES: Final = ("spine.amplitude", "spine.phase")
FREQUENCY: Final = 0.8  # [Hz]
GRADIENT_ROUNDS: Final = 3


def differentiable_walk(cycles: float) -> tuple[Rollout, Callable[[Array], tuple[Array, dict[str, Array]]]]:
    """A walk of a number of gait cycles, and its speed and metrics as a function of `NAMES`."""
    rollout = Rollout(Setup(spine="stride_extension"), Run(cycles=cycles, warmup_cycles=0), "mjx")

    def walk(point: Array) -> tuple[Array, dict[str, Array]]:
        metrics = rollout({"frequency": FREQUENCY, **dict(zip(NAMES, point, strict=True))})
        return metrics["speed"], metrics

    return rollout, walk


def gradient_case(mode: str, worlds: int, cycles: float) -> dict[str, Any]:
    """Value and gradient in one mode against the value alone: same walk, same batch, alternating.

    Args:
        mode: `forward` or `reverse`.
        worlds: size of the batch.
        cycles: length of the walk in gait cycles.
    """
    rollout, walk = differentiable_walk(cycles)
    points = np.stack([np.linspace(0.05, 0.35, worlds), np.linspace(-1.0, 0.0, worlds)], axis=1)
    batch = jnp.asarray(points, float)
    plain = compile_cold(jax.jit(jax.vmap(walk)), batch)
    derivative = {"forward": jax.jacfwd, "reverse": jax.jacrev}[mode]

    def with_value(point: Array) -> Any:
        value, rest = walk(point)
        return value, (value, rest)

    ours = compile_cold(jax.jit(jax.vmap(derivative(with_value, has_aux=True))), batch)

    def run(program: Any) -> None:
        jax.block_until_ready(program(batch))

    run(plain.program)
    run(ours.program)
    ours_s, plain_s, ratio = compare(lambda: run(ours.program), lambda: run(plain.program), GRADIENT_ROUNDS)
    steps = round(rollout.seconds({"frequency": FREQUENCY}) / rollout.robot.config.timestep)
    figures = {"engine": "mjx", "forward_s": plain_s, "gradient_s": ours_s, "ratio": 1.0 / ratio}
    figures |= {"steps_per_second": worlds * steps / ours_s, "plain_steps_per_second": worlds * steps / plain_s}
    for name, program in (("temporary_bytes_per_world", ours), ("plain_temporary_bytes_per_world", plain)):
        # In addition to arguments and results, as planned by the compiler.
        figures[name] = int(program.program.memory_analysis().temp_size_in_bytes) // worlds
    return figures | compiling(ours, plain) | {"peak_bytes": peak_bytes()}


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
if engine == "c":
    from nermo_mjx.learn import Training
    from nermo_mjx.learn.experience import RESET
    training = Training.from_dict({"worlds": 256, "steps": 1})
    environment = training.environment(engine)
    learned = training.algorithm.begin(environment, training.seed)
    iterate = training.algorithm.iteration(environment)
    jax.block_until_ready(iterate(learned, environment.reset(learned.random(RESET)))[0])
    stages["training_s"] = lap()
print(json.dumps(stages))
"""


def startup_case(engine: str, worlds: int) -> dict[str, Any]:
    """Stages of a start with a cold cache, and of a second one with the cache that the first left [s].

    `cold_s` and `warm_s` are to the first tick; on `c` a training of 256 worlds follows, to its first iteration's end.
    """
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = (_start(engine, worlds, cache) for _ in range(2))
    ticks = [sum(took for stage, took in each.items() if stage != "training_s") for each in (cold, warm)]
    return {"cold_s": ticks[0], "warm_s": ticks[1], "cold": cold, "warm": warm}


def _start(engine: str, worlds: int, cache: str) -> dict[str, float]:
    environment = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, engine, str(worlds)],
        env=environment | {"NERMO_MJX_CACHE": cache},
        check=False,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip().split("\n")[-1])
    stages: dict[str, float] = json.loads(done.stdout.strip().split("\n")[-1])
    return stages
