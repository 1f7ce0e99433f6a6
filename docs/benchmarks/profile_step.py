"""Time of a physics step, stage by stage, in the middle of a walk.

`c` is measured by MuJoCo's own timers, one world on one core. `mjx` is measured stage by stage: each is a separate
program over all worlds, so the figures do not include XLA's gains from fusing stages. Their operations are counted
before XLA optimises, because compile time depends on these.
"""

from __future__ import annotations

import json
import re
import statistics
import time
from collections.abc import Callable
from typing import Any, Final

import click
import jax
import mujoco
import numpy as np
from measuring import compile_cold, seconds

from nermo_mjx.dynamics import differentiable
from nermo_mjx.dynamics.integration import integrate
from nermo_mjx.dynamics.mjx_copy import adapted
from nermo_mjx.dynamics.mjx_import import Solved, mjx
from nermo_mjx.physics.c_engine import CEngine
from nermo_mjx.physics.mjx_engine import MjxEngine
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.rollout.simulator import Simulator

#: Control ticks of the walk before the profile begins, and ticks over which C is profiled.
WARMUP, TICKS = 100, 100
ROUNDS: Final = 15

Stage = Callable[[mjx.Model, mjx.Data], mjx.Data]

#: The stages of a step of the engine `mjx`, in order; a test compares them with `differentiable.step`.
MJX_STAGES: Final[dict[str, Stage]] = {
    "kinematics": lambda m, d: mjx.camlight(m, mjx.com_pos(m, mjx.kinematics(m, d))),
    "tendons": mjx.tendon,
    "inertia": mjx.crb,
    "collision": adapted.collision_driver.collision,
    "constraint": lambda m, d: mjx.transmission(m, differentiable.make_constraint(m, d)),
    "velocity": differentiable.velocity,
    "forces": lambda m, d: differentiable.acceleration(m, mjx.fwd_actuation(m, d)),
    "solver": differentiable.solve,
    "sensors": lambda m, d: mjx.sensor_acc(m, mjx.sensor_vel(m, mjx.sensor_pos(m, d))),
    "integration": lambda m, d: integrate(m, d, differentiable.forward),
}

#: MuJoCo's timers of each stage.
C_TIMERS: Final = {
    "inertia": "POS_INERTIA",
    "collision": "POS_COLLISION",
    "constraint": "POS_MAKE",
    "velocity": "VELOCITY",
    "forces": "ACTUATION",
    "solver": "CONSTRAINT",
    "integration": "ADVANCE",
}


def profile(engine: str, worlds: int = 64, setup: Setup | None = None) -> dict[str, Any]:
    """The cost of each stage of a physics step.

    Args:
        engine: `c` (one world, whatever `worlds` is) or `mjx`.
        worlds: batch size of `mjx`.
        setup: of the walk; by default that of the other measurements.

    Returns:
        `{"engine", "worlds", "step_us", "stages": [{"stage", "us", "share", ...}]}`, times for one step of one world
        [µs]. A stage of `mjx` also has `operations`, `trace_s` and `compile_s`.
    """
    if engine not in ("c", "mjx"):
        raise ParameterError(f"engine is {engine!r}: allowed is 'c' or 'mjx'.")
    simulator = Simulator(setup or Setup(spine="stride_extension"), engine)
    batch = simulator.prepare(
        {
            "frequency": 0.8,
            "spine.amplitude": np.linspace(0.0, 0.4, worlds),
            "spine.phase": np.linspace(-1, 0, worlds),
        }
    )
    walk = (
        CEngine(simulator.robot, simulator.loop)
        .open(batch.params, batch.qpos, batch.fields)
        .record(WARMUP + TICKS)
    )
    rows = _c_stages(simulator, walk) if engine == "c" else _mjx_stages(simulator, walk)
    total = sum(row["us"] for row in rows)
    for row in rows:
        row["share"] = row["us"] / total
    return {
        "engine": engine,
        "worlds": 1 if engine == "c" else worlds,
        "step_us": total,
        "stages": rows,
    }


def _c_stages(simulator: Simulator, walk: Any) -> list[dict[str, Any]]:
    """MuJoCo's timers over a walk; kinematics and tendons, which share one, are separated by calling each alone."""
    model, steps = simulator.robot.physical, simulator.loop.steps_per_tick
    data, world = mujoco.MjData(model), -1
    data.qpos[:], data.qvel[:] = walk.qpos[world, WARMUP - 1], walk.qvel[world, WARMUP - 1]
    names, rows = (*C_TIMERS.values(), "POS_KINEMATICS", "STEP"), []
    mujoco.set_mjcb_time(time.perf_counter)
    try:
        for tick in range(WARMUP, WARMUP + TICKS):
            data.ctrl[:] = walk.ctrl[world, tick]
            mujoco.mj_step(model, data, steps)
            rows.append(
                [data.timer[getattr(mujoco.mjtTimer, f"mjTIMER_{name}")].duration for name in names]
            )
    finally:
        mujoco.set_mjcb_time(None)
    # The median over ticks: a step during which another process ran took a thousand times as long.
    took = dict(zip(names, 1e6 / steps * np.median(np.diff(rows, axis=0), axis=0), strict=True))
    us = {stage: float(took[timer]) for stage, timer in C_TIMERS.items()}
    kinematics, tendons = (
        _alone(function, model, data) for function in (mujoco.mj_kinematics, mujoco.mj_tendon)
    )
    share = tendons / (tendons + kinematics)
    placed = float(took["POS_KINEMATICS"])
    us = {"kinematics": (1 - share) * placed, "tendons": share * placed} | us
    us["sensors and other"] = float(took["STEP"]) - sum(us.values())
    return [{"stage": stage, "us": value} for stage, value in us.items()]


def _alone(function: Callable[..., None], model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Seconds of one call."""
    calls = 100

    def repeat() -> None:
        for _ in range(calls):
            function(model, data)

    return min(seconds(repeat) for _ in range(ROUNDS)) / calls


def _mjx_stages(simulator: Simulator, walk: Any) -> list[dict[str, Any]]:
    """Each stage as a separate program, applied to the results of the previous stages in a walking batch."""
    engine = simulator.engine
    assert isinstance(engine, MjxEngine)
    state = {name: getattr(walk, name)[:, WARMUP - 1] for name in ("qpos", "qvel")}
    # As in a walk, the solver starts from the acceleration of the previous step.
    state["qacc_warmstart"] = _accelerations(simulator, **state, ctrl=walk.ctrl[:, WARMUP - 1])
    state["ctrl"] = walk.ctrl[:, WARMUP]
    real = engine.data.qpos.dtype
    data = jax.vmap(lambda one: Solved.of(engine.data.replace(**one)))(
        {key: np.asarray(each, real) for key, each in state.items()}
    )
    rows = []
    for name, stage in MJX_STAGES.items():
        row, data = profile_stage(engine.model, stage, data)
        rows.append({"stage": name} | row)
    return rows


def _accelerations(
    simulator: Simulator, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray
) -> np.ndarray:
    """Accelerations (n, nv) of the worlds in these states, from C."""
    data, rows = mujoco.MjData(simulator.robot.physical), []
    for data.qpos[:], data.qvel[:], data.ctrl[:] in zip(qpos, qvel, ctrl, strict=True):
        mujoco.mj_forward(simulator.robot.physical, data)
        rows.append(data.qacc.copy())
    return np.array(rows)


def profile_stage(
    model: mjx.Model, stage: Stage, data: mjx.Data
) -> tuple[dict[str, Any], mjx.Data]:
    """The figures of one stage of MJX as a separate program, and the data after it."""
    leaves, shape = jax.tree.flatten(data)
    changed: list[int] = []

    def run(leaves: list[jax.Array]) -> list[jax.Array]:
        # Only the stage's own results are returned: copies of the rest would be timed, too.
        def one(leaves: list[jax.Array]) -> list[jax.Array]:
            after = jax.tree.leaves(stage(model, jax.tree.unflatten(shape, leaves)))
            changed[:] = [
                i for i, (old, new) in enumerate(zip(leaves, after, strict=True)) if new is not old
            ]
            return [after[i] for i in changed]

        return jax.vmap(one)(leaves)

    function = jax.jit(run)
    compiled = compile_cold(function, leaves)
    operations = len(re.findall(r"= \"?(?:stablehlo|chlo)\.", function.lower(leaves).as_text()))
    made = jax.block_until_ready(compiled.program(leaves))
    took = [seconds(lambda: jax.block_until_ready(compiled.program(leaves))) for _ in range(ROUNDS)]
    for i, leaf in zip(changed, made, strict=True):
        leaves[i] = leaf
    worlds = leaves[0].shape[0]
    row = {
        "us": 1e6 * statistics.median(took) / worlds,
        "operations": operations,
        "trace_s": compiled.trace_s,
        "compile_s": compiled.compile_s,
    }
    return row, jax.tree.unflatten(shape, leaves)


@click.command(help=__doc__)
@click.option("--engine", type=click.Choice(["c", "mjx"]), default="c")
@click.option("--worlds", type=click.IntRange(1), default=64)
def main(engine: str, worlds: int) -> None:
    print(json.dumps(profile(engine, worlds), indent=2))


if __name__ == "__main__":
    main()
