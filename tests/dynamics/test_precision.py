# Tests of dynamics/precision.py
"""Matrix products of physics and controller ask for full precision, also where a GPU's default is TF32."""

from __future__ import annotations

import re
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx.dynamics import differentiable, make_data, put_model
from nermo_mjx.physics.lanes import Lanes
from nermo_mjx.rollout import Run, Setup, metrics

#: A ball on a stick that lies on the ground: inertia, contacts, a tendon's limit.
STICK = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body pos="0 0 .09">
      <freejoint/> <geom type="capsule" size=".1 .2" euler="0 90 0"/> <site name="a"/>
      <body pos=".3 0 0"> <joint axis="0 1 0" damping=".1"/> <geom size=".1"/> <site name="b" pos=".1 0 0"/> </body>
    </body>
  </worldbody>
  <tendon> <spatial limited="true" range="0 .35"> <site site="a"/> <site site="b"/> </spatial> </tendon>
</mujoco>
"""


def products(function: Any, *arguments: Any) -> list[str]:
    """Precision of each matrix product in the program of a function, as lowered for XLA."""
    lowered = function if hasattr(function, "lower") else jax.jit(function)
    text = lowered.lower(*arguments).as_text()
    return re.findall(r"stablehlo\.dot_general.*?precision = \[(\w+, \w+)\]", text)


def highest(precisions: list[str]) -> bool:
    return bool(precisions) and set(precisions) == {"HIGHEST, HIGHEST"}


def test_a_program_of_jax_alone_asks_for_less() -> None:
    """Otherwise the tests below could not fail."""
    assert products(lambda x: x @ x, jnp.eye(3)) == ["DEFAULT, DEFAULT"]


@pytest.fixture(scope="module")
def stick() -> tuple[Any, Any]:
    model = put_model(mujoco.MjModel.from_xml_string(STICK))
    return model, make_data(model)


@pytest.mark.release
def test_a_step_of_physics_and_its_derivatives_have_it(stick: tuple[Any, Any]) -> None:
    """Forward and reverse mode, also where JAX traces the derivative after the step, outside of it."""
    model, data = stick
    step = jax.jit(lambda qvel: differentiable.step(model, data.replace(qvel=qvel)).qvel)
    ones = jnp.ones(model.nv)
    assert highest(products(step, ones))
    assert highest(products(lambda qvel: jax.jvp(step, (qvel,), (ones,)), ones))
    assert highest(products(jax.grad(lambda qvel: step(qvel).sum()), ones))


@pytest.mark.release
def test_the_controller_between_two_ticks_of_c_has_it(simulator: Any) -> None:
    """The loop of controller and metrics, its start, and the metrics of a run."""
    sim = simulator(spine="stride_extension")
    batch = sim.prepare({"frequency": np.array([0.8])}, Run(cycles=1))
    session = sim.engine.open(batch.params, batch.qpos, batch.fields)
    assert highest(products(session.loop.step, *session.arguments))
    state = jax.tree.map(lambda leaf: leaf[:1], session.loop_state.metrics)
    assert "DEFAULT, DEFAULT" not in products(Lanes(metrics.result)._program, state, batch.mass)


@pytest.mark.release
def test_a_tick_of_the_robot_in_mjx_has_it(simulator: Any) -> None:
    """Of all worlds of a device, as `advance` runs it, and of one world, as a rollout does."""
    sim = simulator("mjx", spine="stride_extension")
    batch = sim.prepare({"frequency": np.full(2, 0.8)}, Run(cycles=1))
    session = sim.engine.open(batch.params, batch.qpos, batch.fields)
    assert highest(
        products(sim.engine.advance, session.params, session.fields, session.carry, jnp.int32(1))
    )
    world = jax.tree.map(lambda leaf: leaf[0], (session.params, session.fields, session.carry))
    assert highest(products(sim.engine.tick, *world))


@pytest.mark.release
def test_one_setup_serves_programs_in_32_and_in_64_bits():
    """Also while a program of the other kind is kept; the oracle is a setup that has only been used in one."""

    def servos(setup, phase):
        return (
            setup.make_controller()
            .initial_servo(setup.world({"frequency": 0.8}).control, phase)
            .hip
        )

    shared_setup = Setup()
    trace = jax.jit(lambda phase: servos(shared_setup, phase)).trace(0.1)
    with jax.enable_x64(True):
        np.testing.assert_array_equal(servos(shared_setup, 0.1), servos(Setup(), 0.1))
        assert servos(shared_setup, 0.1).dtype == np.float64
    assert trace.jaxpr.out_avals[0].dtype == np.float32
