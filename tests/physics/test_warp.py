# Tests of physics/making.py, physics/mjx_engine.py
"""The engine warp: its requirements, its error messages, and that it walks as C does. Warp also runs on a CPU."""

from __future__ import annotations

import importlib.util
import re

import jax
import mujoco
import numpy as np
import pytest
from conftest import WALKS
from fakes import swinging
from mujoco.batch import Batch

from nermo_mjx import Setup, load_robot
from nermo_mjx.physics import make_engine, mjx_engine, resolve_engine
from nermo_mjx.physics.mjx_engine import MjxEngine, WarpEngine
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout.loop import ClosedLoop

installed = pytest.mark.skipif(
    importlib.util.find_spec("warp") is None,
    reason="warp-lang is not installed (pip install 'nermo-mjx[warp]')",
)


@pytest.fixture
def machine(monkeypatch):
    """`machine(backend, cuda, warp)`: what JAX and Python seem to find from now on."""

    def seem(backend: str, cuda: bool, warp: bool) -> None:
        monkeypatch.setattr(jax, "default_backend", lambda: backend)
        monkeypatch.setattr(
            mjx_engine.backend, "backends", lambda: {"cpu": None} | ({"cuda": None} if cuda else {})
        )
        find = importlib.util.find_spec
        spec = find("numpy") if warp else None
        monkeypatch.setattr(
            importlib.util, "find_spec", lambda name: spec if name == "warp" else find(name)
        )

    return seem


@pytest.mark.parametrize(
    ("backend", "cuda", "warp", "engine"),
    [
        ("cpu", False, False, "c"),
        ("cpu", False, True, "c"),
        ("gpu", True, True, "mjx"),
        ("gpu", True, False, "mjx"),
        ("gpu", False, True, "mjx"),  # of another maker
        ("tpu", False, True, "mjx"),
        ("cpu", True, True, "c"),  # a GPU that JAX was told to leave alone
    ],
)
def test_auto_takes_mjx_on_every_accelerator(machine, backend, cuda, warp, engine):
    machine(backend, cuda, warp)
    assert resolve_engine("auto") == engine


@pytest.mark.parametrize(
    ("backend", "cuda", "warp", "sentence"),
    [
        (
            "cpu",
            False,
            True,
            "it needs an NVIDIA GPU, and JAX computes on cpu here; take the engine mjx or c, or "
            "install nermo-mjx[cuda,warp] on a machine that has one.",
        ),
        ("tpu", False, True, "it needs an NVIDIA GPU, and JAX computes on tpu here; "),
        (
            "gpu",
            True,
            False,
            "the package warp-lang is not installed; install the package with its extra warp.",
        ),
    ],
)
def test_warp_says_in_a_sentence_why_it_cannot_run(machine, backend, cuda, warp, sentence):
    machine(backend, cuda, warp)
    with pytest.raises(ParameterError, match=re.escape(f"engine is 'warp': {sentence}")):
        make_engine("warp", load_robot(), ClosedLoop(load_robot(), Setup().make_controller()))


def test_warp_computes_in_single_precision_only(machine):
    machine("gpu", True, True)
    with (
        jax.enable_x64(True),
        pytest.raises(ParameterError, match="engine is 'warp': it computes in single precision"),
    ):
        resolve_engine("warp")
    assert resolve_engine("warp") == "warp"


@installed
def test_warp_swings_as_mjx_does():
    """With a stop, a contact and a field that differs between worlds; 60 steps in float32."""
    traces = []
    for make in (WarpEngine, MjxEngine):
        session = make(swinging.robot(), swinging.SwayLoop()).open(*swinging.batch(3))
        session.advance(2)
        traces.append(session.record(18))
    warp, mjx = traces
    assert np.ptp(mjx.qpos, axis=1).min() > 0.05
    np.testing.assert_allclose(warp.qpos, mjx.qpos, atol=1e-5)
    np.testing.assert_allclose(warp.sensordata, mjx.sensordata, atol=1e-3)


@installed
@pytest.mark.parametrize(
    ("fault", "sentence"),
    [(0.1, "of 3 walks are not where MuJoCo C has them"), (np.nan, "nan m away")],
)
def test_warp_is_refused_where_it_is_not_where_c_is(simulator, monkeypatch, fault, sentence):
    """From the first ticks on; without the fault the same walks pass."""
    sim = simulator(spine="stride_extension")
    batch = sim.prepare({name: column[:3] for name, column in WALKS.items()})
    WarpEngine(sim.robot, sim.loop).open(batch.params, batch.qpos, batch.fields).advance(2)
    step = mjx_engine._step

    def wrong(model, data):
        result = step(model, data)
        return result.replace(qpos=result.qpos + fault)

    monkeypatch.setattr(mjx_engine, "_step", wrong)
    session = WarpEngine(sim.robot, sim.loop).open(batch.params, batch.qpos, batch.fields)
    with pytest.raises(
        ParameterError, match=f"engine is 'warp': after 2 control ticks .*{sentence}"
    ):
        session.advance(2)


@installed
def test_warp_refuses_gradients():
    """In a sentence, whoever asks."""
    engine = WarpEngine(swinging.robot(), swinging.SwayLoop())
    with pytest.raises(
        ParameterError, match="engine is 'warp': it has no derivatives; take the engine mjx"
    ):
        jax.grad(lambda q: engine.physics_step(engine.model, engine.data.replace(qpos=q)).qpos[0])(
            engine.data.qpos
        )


@installed
def test_warp_has_room_for_all_contacts_and_rows(simulator):
    """Eight contacts and six tendons a world, friction in elliptic cones; contacts are counted for all worlds."""
    sim = simulator()
    engine = WarpEngine(sim.robot, sim.loop)
    assert sim.robot.model.npair == 8
    for worlds in (1, 64):
        data = engine.data_among(worlds)
        assert (data._impl.naconmax, data._impl.njmax) == (8 * worlds, 6 + 8 * 3)
    assert engine.model.opt.ls_iterations == sim.robot.model.opt.ls_iterations, (
        "not the shorter search of MJX-JAX"
    )


@installed
def test_warp_follows_c_from_the_same_state_with_the_same_controls(simulator):
    """200 steps of the robot, each world with its own friction and mass, stay within 1e-5 of C."""
    sim = simulator(spine="stride_extension")
    values = {name: column[:3] for name, column in WALKS.items()}
    values |= {
        "contact.friction": np.array([0.6, 1.0, 1.4]),
        "mass.front": np.array([0.2, 0.1647, 0.15]),
    }
    batch = sim.prepare(values)
    trace = WarpEngine(sim.robot, sim.loop).open(batch.params, batch.qpos, batch.fields).record(40)
    c = Batch(sim.robot.physical, 3)
    for name, field in batch.fields.items():
        c.expand(name)[...] = field
    c.set_const()
    qpos, ctrl = c.bind("qpos"), c.bind("ctrl")
    qpos[...] = batch.qpos
    c.forward()
    for tick in range(40):
        ctrl[...] = trace.ctrl[:, tick]
        c.rollout(sim.loop.steps_per_tick)
        np.testing.assert_allclose(trace.qpos[:, tick], qpos, atol=1e-5)
    assert np.ptp(trace.qpos[:, :, 1], axis=1).min() > 1e-3  # it walks


def test_the_robot_uses_nothing_that_warp_rejects(simulator):
    """Warp has Euler steps, elliptic cones and Newton's solver; what it has not must not creep into the model."""
    option = simulator().robot.physical.opt
    assert option.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert option.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert not option.noslip_iterations
