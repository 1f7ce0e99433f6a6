# Tests of physics/engine.py, physics/mjx_engine.py, physics/c_engine.py
"""The engines agree, never recompile for a new value, and reuse compiled programs from the cache."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from conftest import WALKS

from nermo_mjx.physics import resolve_engine
from nermo_mjx.rollout import Run


@pytest.mark.release
def test_c_engine_equals_one_mj_step_at_a_time(simulator):
    """A batch of the C engine is bit for bit what `mj_step` gives for the same servo targets, world by world.

    Jacobians are sparse in both; MuJoCo's default for so few joints, dense, rounds differently.
    """
    sim = simulator(spine="stride_extension")
    batch = sim.prepare({name: values[:3] for name, values in WALKS.items()})
    trace = sim.engine.open(batch.params, batch.qpos, batch.fields).record(40)
    model = copy.copy(sim.robot.model)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    data = mujoco.MjData(model)
    for world in range(3):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = batch.qpos[world]
        mujoco.mj_forward(model, data)
        for tick in range(40):
            data.ctrl[:] = trace.ctrl[world, tick]
            for _ in range(sim.loop.steps_per_tick):
                mujoco.mj_step(model, data)
            np.testing.assert_array_equal(data.qpos, trace.qpos[world, tick])


@pytest.mark.release
def test_a_world_that_diverges_is_flagged_and_leaves_the_others_alone(
    simulator, tmp_path, monkeypatch, capfd
):
    """A world whose numbers are lost half-way is flagged and keeps what it had measured; its neighbour goes on."""
    sim = simulator(spine="stride_extension")
    batch = sim.prepare(
        {name: values[:2] for name, values in WALKS.items()}, Run(cycles=3, warmup_cycles=1)
    )
    disturbed, reference = (
        sim.engine.open(batch.params, batch.qpos, batch.fields) for _ in range(2)
    )
    for session in (disturbed, reference):
        session.advance(200)
    disturbed._blocks[0].batch.bind("qvel")[1] = np.nan
    monkeypatch.chdir(tmp_path)
    for session in (disturbed, reference):
        session.advance(100)
    assert list(tmp_path.iterdir()) == []  # no log file of MuJoCo's
    assert capfd.readouterr().err == ""
    np.testing.assert_array_equal(disturbed.loop_state.metrics.diverged, [False, True])
    np.testing.assert_array_equal(disturbed.qpos[0], reference.qpos[0])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(disturbed.loop_state.metrics))
    assert disturbed.loop_state.metrics.time[1] == pytest.approx(
        0.75, abs=0.03
    )  # measured from 1.25 s to 2.0 s


@pytest.mark.release
def test_new_values_never_recompile_on_the_c_engine(simulator, compilations):
    """After one run of a batch size, other values of any parameter, also of the body, compile nothing."""
    sim = simulator(spine="stride_extension")
    run = Run(cycles=2, warmup_cycles=1)
    first = {
        "frequency": np.array([0.8, 0.7]),
        "spine.amplitude": np.array([0.1, 0.2]),
        "contact.friction": np.array([1.0, 1.1]),
    }
    sim.run(first, run)
    compilations.clear()
    sim.run({name: 1.01 * values for name, values in first.items()}, Run(cycles=3, warmup_cycles=1))
    assert compilations == []


def test_auto_takes_the_c_engine_on_a_cpu():
    if jax.default_backend() == "cpu":
        assert resolve_engine("auto") == "c"


@pytest.mark.long
@pytest.mark.release
def test_mjx_makes_each_tick_of_a_walk_as_c_does(walks, simulator):
    """From each state of MJX's walks C goes on for a tick with the same servo targets, and comes to MJX's next state.

    In float32: 99 % of the ticks within 8e-6 m or rad and 7e-3 m/s or rad/s, as measured. The legs' tendons go taut
    within 0.1 mm, of which float32 knows 4 nm: with a stiff onset it is 9e-7 m or rad and 2e-4 m/s or rad/s.
    """
    sim, trace = simulator("mjx", spine="stride_extension"), walks("mjx").trace
    model = sim.robot.model
    data = mujoco.MjData(model)
    worlds, ticks = trace.qpos.shape[:2]
    differences = np.zeros((2, worlds, ticks - 1))
    for world, tick in np.ndindex(worlds, ticks - 1):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = trace.qpos[world, tick], trace.qvel[world, tick]
        data.ctrl[:] = trace.ctrl[world, tick + 1]
        mujoco.mj_step(model, data, sim.loop.steps_per_tick)
        differences[0, world, tick] = np.abs(trace.qpos[world, tick + 1] - data.qpos).max()
        differences[1, world, tick] = np.abs(trace.qvel[world, tick + 1] - data.qvel).max()
    position, velocity = np.quantile(differences, 0.99, axis=(1, 2))
    assert position < 1e-5
    assert velocity < 1e-2
    # In one tick of two hundred a tendon goes taut, or a foot lands, a step earlier or later by a rounding error.
    assert np.mean(differences[0] > 1e-5) < 0.01
    assert differences[0].max() < 5e-3


@pytest.mark.release
def test_mjx_and_c_measure_the_same_gait(walks):
    """Over four measured cycles the engines' gait metrics agree within 3 %; angles within 3 % or 0.1 degrees."""
    c, mjx = walks("c"), walks("mjx")
    assert list(c.status) == list(mjx.status) == ["ok"] * 8
    for name in ("speed", "distance", "slip", "servo_work", "cost_of_transport"):
        np.testing.assert_allclose(mjx.metrics[name], c.metrics[name], rtol=0.03, err_msg=name)
    for angle in ("roll", "pitch", "yaw"):
        for statistic in ("mean", "std", "min", "max"):
            name = f"{angle}_{statistic}"
            ours, reference = mjx.metrics[name], c.metrics[name]
            np.testing.assert_allclose(
                ours, reference, rtol=0.03, atol=np.radians(0.1), err_msg=name
            )


@pytest.mark.long
@pytest.mark.release
def test_mjx_varies_the_body_within_a_batch_as_c_does(simulator, compilations):
    """Masses with the constants MuJoCo derives from them, lengths, friction, springs, dampers and servos, by world.

    Other values of all of them compile nothing.
    """
    values = {
        "frequency": 0.8,
        "contact.friction": np.array([0.3, 1.0, 1.4]),
        "mass.front": np.array([0.2, 0.1647, 0.15]),
        "geometry.rear_leg.upper": np.array([0.036, 0.0317, 0.029]),
        "geometry.spine.segment": np.array([0.012, 0.014, 0.016]),
        "stiffness.spine": np.array([12.0, 1.2, 1.0]),
        "damping.spine": np.array([0.3, 0.09, 0.05]),
        "damping.knee": np.array([0.004, 0.005, 0.008]),
        "servo.kp": np.array([5.0, 6.3, 8.0]),
    }
    run = Run(cycles=1, warmup_cycles=0)
    c, mjx = (
        simulator(engine, spine="stride_extension").run(values, run).metrics
        for engine in ("c", "mjx")
    )
    for name in ("speed", "servo_work", "roll_std"):
        np.testing.assert_allclose(mjx[name], c[name], rtol=0.01, err_msg=name)
        assert np.ptp(c[name]) > 0.05 * c[name].mean()
    compilations.clear()
    others = simulator("mjx", spine="stride_extension").run(
        {name: 0.99 * value for name, value in values.items()}, run
    )
    assert compilations == []
    assert not np.array_equal(others.metrics["speed"], mjx["speed"])


@pytest.mark.release
@pytest.mark.parametrize("engine", ["c", "mjx"])
def test_a_run_that_may_end_early_measures_its_last_tick(walks, simulator, engine: str) -> None:
    """Whatever is beside it: runs that end within the same tick, the last one of a block, or later ones."""
    walks(engine)
    sim, warmup = simulator(engine, spine="stride_extension"), np.full(8, 0.05)
    alike, mixed = (
        np.full(8, 0.245),
        0.01 * np.array([24.5, 24.0, 25.0, 30.0, 49.5, 24.5, 26.0, 20.0]),
    )
    results = [
        sim.run(WALKS, Run(duration=end, warmup=warmup, distance=1.0), record=True)
        for end in (alike, mixed)
    ]
    for result, end in zip(results, (alike, mixed), strict=True):
        np.testing.assert_allclose(result.metrics["duration"], end - warmup, atol=1e-6)
    for name in results[0].metrics:
        selected = [result.metrics[name][alike == mixed] for result in results]
        np.testing.assert_allclose(*selected, rtol=1e-5, atol=1e-7, err_msg=name)


@pytest.mark.release
def test_new_values_never_recompile_on_mjx(walks, simulator, compilations):
    """Other parameters, and another length of the run, use the program that is there."""
    walks("mjx")
    sim = simulator("mjx", spine="stride_extension")
    compilations.clear()
    sim.run(
        {name: 0.99 * values for name, values in WALKS.items()},
        Run(cycles=1, warmup_cycles=0),
        record=True,
    )
    assert compilations == []


@pytest.mark.release
def test_a_world_is_small_in_the_scan(simulator):
    """What a world carries from tick to tick, its controller and metrics included, stays below 4 KiB."""
    sim = simulator("mjx", spine="stride_extension")
    batch = sim.prepare({"frequency": 0.8})
    params, qpos = jax.tree.map(lambda leaf: leaf[0], (batch.params, np.float32(batch.qpos)))
    qvel, readings = (
        np.zeros(n, np.float32) for n in (sim.robot.model.nv, sim.robot.model.nsensordata)
    )
    carry = jax.eval_shape(sim.engine.start, params, qpos, qvel, readings)
    assert 1024 < sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(carry)) < 4096


CACHED = """
import jax, json
import numpy as np
import nermo_mjx
seen = []
jax.monitoring.register_event_listener(lambda event, **about: seen.append(event))
from nermo_mjx.rollout import Run, Setup, Simulator
result = Simulator(Setup(), {engine!r}).run({{"frequency": np.full({worlds}, 0.8)}}, Run(duration=0.1))
counts = {{name: seen.count("/jax/compilation_cache/cache_" + name) for name in ("hits", "misses")}}
print(json.dumps(counts | {{"ok": int((result.status == "ok").sum())}}))
"""


def _in_a_process_of_its_own(cache: Path, engine: str, worlds: int) -> dict[str, int]:
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "PJRT_"))
    }
    environment |= {
        "NERMO_MJX_CACHE": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    command = [sys.executable, "-c", CACHED.format(engine=engine, worlds=worlds)]
    process = subprocess.run(
        command, capture_output=True, text=True, env=environment, check=True, timeout=540
    )
    return json.loads(process.stdout)


@pytest.mark.release
@pytest.mark.parametrize(
    ("engine", "worlds"), [("c", 2), pytest.param("mjx", 64, marks=pytest.mark.long)]
)
def test_the_next_process_reuses_compiled_programs(tmp_path, engine, worlds):
    """The first process fills the persistent cache, the second finds every program there, and neither hangs.

    64 worlds is the size at which JAX 0.10.2 hangs on two cores with its own choice of threads.
    """
    first = _in_a_process_of_its_own(tmp_path, engine, worlds)
    second = _in_a_process_of_its_own(tmp_path, engine, worlds)
    assert first["ok"] == second["ok"] == worlds
    assert first["misses"] > 0
    assert second["misses"] == 0
    assert second["hits"] > 0


@pytest.mark.release
def test_sparse_jacobians_are_the_dense_ones(simulator):
    """From the same states in contact, a step with sparse Jacobians accelerates as one with dense ones."""
    sim = simulator(spine="stride_extension")
    batch = sim.prepare({name: values[:3] for name, values in WALKS.items()})
    trace = sim.engine.open(batch.params, batch.qpos, batch.fields).record(40)
    models = [copy.copy(sim.engine.model) for _ in range(2)]
    models[1].opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    for world in range(3):
        for tick in range(5, 40, 5):
            sparse, dense = (mujoco.MjData(model) for model in models)
            for model, data in zip(models, (sparse, dense), strict=True):
                data.qpos[:], data.qvel[:] = trace.qpos[world, tick], trace.qvel[world, tick]
                data.ctrl[:] = trace.ctrl[world, tick]
                mujoco.mj_forward(model, data)
            assert sparse.ncon > 0
            np.testing.assert_allclose(
                sparse.qacc, dense.qacc, atol=1e-6 * np.abs(dense.qacc).max()
            )
