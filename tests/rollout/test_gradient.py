# Tests of rollout/differentiable.py, dynamics/checkpointing.py
"""The walk as a differentiable function, and what it is made of."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.dynamics.checkpointing import checkpointed_scan
from nermo_mjx.robot import load_robot
from nermo_mjx.rollout import Run, Setup
from nermo_mjx.rollout.differentiable import Rollout

ONE_CYCLE = Run(cycles=1, warmup_cycles=0)


def test_readings_at_rest_are_mujocos():
    """A robot put down anywhere reads where its IMU and its joints are; nothing moves or pushes in these readings."""
    robot = load_robot()
    data = mujoco.MjData(robot.model)
    qpos = robot.model.qpos0.copy()
    qpos[robot.joints.root : robot.joints.root + 7] = [0.3, -0.2, 0.06, 0.8, 0.1, -0.2, 0.55]
    qpos[robot.joints.root + 3 : robot.joints.root + 7] /= np.linalg.norm([0.8, 0.1, -0.2, 0.55])
    bent = np.concatenate(
        [
            robot.joints.hip,
            robot.joints.pulley,
            np.ravel(robot.joints.knee),
            [robot.joints.spine_pulley],
        ]
    )
    qpos[bent] = np.linspace(-0.3, 0.3, len(bent))
    data.qpos[:] = qpos
    mujoco.mj_forward(robot.model, data)
    actual, expected = (
        robot.sensors(jax.jit(robot.sensordata_at_rest)(qpos)),
        robot.sensors(data.sensordata),
    )
    np.testing.assert_allclose(actual.position, expected.position, atol=1e-6)
    np.testing.assert_allclose(actual.orientation, expected.orientation, atol=1e-6)
    np.testing.assert_allclose(actual.servo_angle, expected.servo_angle, atol=1e-6)
    np.testing.assert_allclose(actual.knee_angle, expected.knee_angle, atol=1e-6)
    assert not np.any(actual.foot_force)
    assert not np.any(actual.linear_velocity)


@pytest.mark.release
@pytest.mark.parametrize("length", [1, 2, 7, 640, 1500])
def test_a_checkpointed_scan_is_a_scan(length):
    """The same outputs and the same gradient, for lengths that its segments divide and others."""

    def body(carry):
        carry = jnp.sin(1.1 * carry) + 0.01
        return carry, carry

    def total(start, scan):
        return jnp.sum(scan(start) ** 2)

    def plain(start):
        return jax.lax.scan(lambda carry, _: body(carry), start, None, length=length)[1]

    def ours(start):
        return checkpointed_scan(body, start, length)[1]

    start = jnp.asarray(0.7)
    np.testing.assert_allclose(ours(start), plain(start), rtol=1e-6)
    np.testing.assert_allclose(
        jax.grad(total)(start, ours), jax.grad(total)(start, plain), rtol=1e-4, atol=1e-7
    )


@pytest.mark.release
def test_a_rollout_in_float64_does_not_see_that_float32_was_there_before(simulator):
    """JAX keeps what it made of a NumPy array; arrays of the model that both precisions read must not be mixed up."""
    values = {"spine.amplitude": np.array([0.2])}
    simulator("c", spine="stride_extension").run(values, Run(duration=0.02, warmup=0.0))
    with jax.enable_x64(True):
        rollout = Rollout(Setup(spine="stride_extension"), Run(duration=0.02, warmup=0.0))
        shapes = jax.eval_shape(lambda a: rollout({"spine.amplitude": a}), jnp.asarray(0.2))
    assert {leaf.dtype for leaf in jax.tree.leaves(shapes)} == {np.dtype(float)}


def test_default_parameters_in_float64_leave_none_of_it_behind():
    """A program in float32 that closes over the defaults, after one in float64 that did."""

    def scaled(x):
        return x * ControlParameters().gait.stride

    with jax.enable_x64(True):
        assert jax.jit(scaled)(jnp.ones(())).dtype == np.float64
    assert jax.jit(lambda x: scaled(x))(jnp.ones(())).dtype == np.float32
