# Tests of physics/open_loop.py
"""`physics.trajectory` against differences of MuJoCo's own steps, for every kind of joint, row and actuator."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from fakes.composites import IN_THEIR_PLACE, mjcf

from nermo_mjx import ParameterError
from nermo_mjx.physics import trajectory

FREE = '<body pos="0 0 {z}" euler="10 20 30"><freejoint/><geom type="{kind}" size=".1 .08 .06" mass=".5"/></body>'
CHAIN = """<body pos="0 0 1"><joint name="a" axis="0 1 0" damping=".1" {a}/>
  <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>
  <body pos=".3 0 0"><joint name="b" axis="0 1 0" {b}/><geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>
    <site name="tip" pos=".3 0 0"/></body></body><site name="fixed" pos=".2 0 1.3"/>"""
MOTOR = '<actuator><motor joint="a" gear="2"/></actuator>'
PLANE = '<geom type="plane" size="5 5 .1"/>'


TENDON = '<tendon><spatial {0}><site site="fixed"/><site site="tip"/></spatial></tendon>'
MODELS = {
    **IN_THEIR_PLACE,
    "a box on the ground": mjcf(PLANE + FREE.format(z=0.1, kind="box")),
    "an elliptic contact": mjcf(
        PLANE + FREE.format(z=0.1, kind="ellipsoid"), option='cone="elliptic" impratio="10"'
    ),
    "a limit at rest": mjcf(CHAIN.format(a='limited="true" range="-60 20"', b=""), MOTOR),
    "a ball joint": mjcf(
        '<body pos="0 0 1"><joint type="ball" stiffness="1"/><geom size=".1" pos=".1 .2 .3"/></body>'
    ),
    "dry friction": mjcf(CHAIN.format(a='frictionloss=".3"', b=""), MOTOR),
    "implicitfast": mjcf(
        CHAIN.format(a="", b=""),
        '<actuator><position joint="a" kp="30" kv="3" ctrlrange="-1 1" forcerange="-60 60"/></actuator>',
        'integrator="implicitfast"',
    ),
    "implicit": mjcf(
        CHAIN.format(a="", b=""),
        '<actuator><general joint="a" gaintype="affine" gainprm="5 1 -1" biastype="affine" '
        'biasprm="0 -9 -1"/></actuator>',
        'integrator="implicit" density="1000"',
    ),
    "Runge-Kutta": mjcf(CHAIN.format(a="", b='stiffness="5"'), MOTOR, 'integrator="RK4"'),
    "a tendon": mjcf(
        CHAIN.format(a="", b=""),
        TENDON.format('limited="true" range="0 .5" stiffness="20"') + MOTOR,
    ),
    "a muscle": mjcf(
        CHAIN.format(a="", b=""),
        TENDON.format('name="t"')
        + '<actuator><muscle tendon="t" ctrlrange="0 1" lengthrange=".1 .8"/></actuator>',
    ),
    "activations": mjcf(
        CHAIN.format(a="", b=""),
        '<actuator><intvelocity joint="a" kp="20" actrange="-1 1"/><general joint="b" dyntype="filterexact" '
        'dynprm=".05" gainprm="3" actearly="true"/><general joint="a" dyntype="filter" dynprm=".1"/></actuator>',
    ),
    "an equality": mjcf(
        CHAIN.format(a="", b=""),
        '<equality><joint joint1="a" joint2="b" polycoef=".1 .5"/></equality>' + MOTOR,
    ),
    "a weld": mjcf(
        FREE.format(z=1, kind="box").replace("<body", '<body name="box"'),
        '<equality><weld body1="box" relpose="0 0 1 1 0 0 0"/></equality>',
    ),
    "noslip": mjcf(
        PLANE + FREE.format(z=0.1, kind="box"), option='noslip_iterations="3" cone="elliptic"'
    ),
}
PUBLIC = (
    Path(next(iter(importlib.util.find_spec("mujoco").submodule_search_locations)))
    / "mjx"
    / "test_data"
)
FILES = (
    "humanoid/humanoid.xml",
    "barkour_v0/assets/barkour_v0_mjx.xml",
    "convex.xml",
    "pendula.xml",
    "tendon/wrap_sidesite.xml",
    "sensor/model.xml",
)


def moved(model: mujoco.MjModel, steps: int) -> tuple[np.ndarray, ...]:
    """A state on the way, and controls within their ranges."""
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    low, high = np.where(
        model.actuator_ctrllimited[:, None] > 0, model.actuator_ctrlrange, [-1.0, 1.0]
    ).T
    data.qvel[:] = 0.1 * random.standard_normal(model.nv)
    data.ctrl[:] = low + (high - low) * random.uniform(0.3, 0.7, model.nu)
    mujoco.mj_step(model, data, 150)
    ctrl = low + (high - low) * random.uniform(0.3, 0.7, (steps, model.nu))
    return data.qpos.copy(), data.qvel.copy(), data.act.copy(), ctrl


def error(model: mujoco.MjModel, steps: int = 5) -> float:
    """Of the derivative along a random direction of start and controls, beside differences of MuJoCo's own steps."""
    qpos, qvel, act, ctrl = moved(model, steps)
    random = np.random.default_rng(1)
    motion, step = trajectory(model), 1e-6
    tight = motion.model
    turn, *vectors = (
        random.standard_normal(shape) for shape in (model.nv, model.nv, model.na, ctrl.shape)
    )
    linear_model = motion.linearized(qpos, qvel, ctrl, act)
    x = np.concatenate([turn, vectors[0], vectors[1]])
    for t in range(steps):
        x = linear_model.a[t] @ x + linear_model.b[t] @ vectors[2][t]

    def end(sign: float) -> mujoco.MjData:
        data = mujoco.MjData(tight)
        data.qpos[:], data.qvel[:], data.act[:] = (
            qpos,
            qvel + sign * step * vectors[0],
            act + sign * step * vectors[1],
        )
        mujoco.mj_integratePos(tight, data.qpos, turn, sign * step)
        for t in range(steps):
            data.ctrl[:] = ctrl[t] + sign * step * vectors[2][t]
            mujoco.mj_step(tight, data)
        return data

    up, down, dq = end(1.0), end(-1.0), np.zeros(model.nv)
    mujoco.mj_differentiatePos(tight, dq, 2 * step, down.qpos, up.qpos)
    expected = np.concatenate(
        [dq, (up.qvel - down.qvel) / (2 * step), (up.act - down.act) / (2 * step)]
    )
    return float(np.abs(x - expected).max() / np.abs(expected).max())


@pytest.mark.parametrize("name", MODELS)
def test_every_kind_of_model_has_the_derivative_of_differences(name: str) -> None:
    model = mujoco.MjModel.from_xml_string(MODELS[name])
    assert error(model) < 1e-5


@pytest.mark.parametrize("name", FILES)
def test_public_models_have_the_derivative_of_differences(name: str) -> None:
    """Light links in stiff contacts, with accelerations of 1e5 rad/s^2, as well."""
    assert error(mujoco.MjModel.from_xml_path(str(PUBLIC / name))) < 2e-6


def test_states_are_those_of_mujoco() -> None:
    model = mujoco.MjModel.from_xml_string(MODELS["activations"])
    qpos, qvel, act, ctrl = moved(model, 6)
    motion, data = trajectory(model), mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = qpos, qvel, act
    with jax.enable_x64(True):
        states = motion(qpos, qvel, ctrl, act)
    for t in range(6):
        data.ctrl[:] = ctrl[t]
        mujoco.mj_step(motion.model, data)
        np.testing.assert_allclose(states.qpos[t + 1], data.qpos, atol=1e-12)
        np.testing.assert_allclose(states.act[t + 1], data.act, atol=1e-12)


@pytest.mark.release
def test_all_transformations_agree_and_a_batch_is_one_call() -> None:
    model = mujoco.MjModel.from_xml_string(MODELS["a box on the ground"])
    qpos, qvel, _, ctrl = moved(model, 8)
    motion, direction = trajectory(model), np.random.default_rng(2).standard_normal(model.nv)

    def height(velocity):
        states = motion(qpos, velocity, ctrl)
        return states.qpos[-1, 2] + 0.1 * states.qvel[:, 3].sum()

    with jax.enable_x64(True):
        slope = jax.grad(height)(qvel)
        np.testing.assert_allclose(
            jax.jvp(height, (qvel,), (direction,))[1], slope @ direction, rtol=1e-10
        )
        np.testing.assert_allclose(jax.jit(jax.jacfwd(height))(qvel), slope, rtol=1e-10)
        several = jax.jit(jax.vmap(jax.grad(height)))(np.stack([qvel, qvel + 0.01, qvel]))
        for batched_slope in (several[0], several[2]):
            np.testing.assert_allclose(batched_slope, slope, rtol=1e-10)
        ends = [height(qvel + 1e-6 * sign * direction) for sign in (1, -1)]
        assert float(slope @ direction) == pytest.approx(float(ends[0] - ends[1]) / 2e-6, rel=1e-5)


def test_a_quaternion_is_differentiated_along_what_turns_it() -> None:
    model = mujoco.MjModel.from_xml_string(MODELS["a ball joint"])
    qpos, qvel, _, ctrl = moved(model, 5)
    motion = trajectory(model)
    with jax.enable_x64(True):
        slope = np.asarray(jax.jacrev(lambda start: motion(start, qvel, ctrl).qpos[-1])(qpos))
        ends = [
            motion(qpos + 1e-6 * sign * axis, qvel, ctrl).qpos[-1]
            for axis in np.eye(4)
            for sign in (1, -1)
        ]
    differences = np.reshape(ends, (4, 2, 4))
    expected = ((differences[:, 0] - differences[:, 1]) / 2e-6).T
    np.testing.assert_allclose(slope, expected, atol=1e-6)


def test_a_step_at_which_a_contact_begins_is_told() -> None:
    """A sphere that stands exactly on the border of its contact."""
    model = mujoco.MjModel.from_xml_string(
        mjcf(
            PLANE
            + '<body pos="0 0 .1"><joint type="slide" axis="0 0 1"/><geom size=".1" solimp=".9 .95 .001"/></body>'
        )
    )
    motion, ctrl = trajectory(model), np.zeros((1, 0))
    assert motion.linearized([0.0], [0.0], ctrl).kinks.tolist() == [True]
    assert motion.linearized([0.01], [0.0], ctrl).kinks.tolist() == [False]
    with jax.enable_x64(True):
        with pytest.warns(
            UserWarning, match=r"active contacts or limits changes within 1e-08 at 1 steps \(0\)"
        ):
            jax.grad(lambda z: motion(z, jnp.zeros(1), ctrl).qvel[-1, 0])(jnp.zeros(1))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            jax.grad(lambda z: motion(z, jnp.zeros(1), ctrl).qvel[-1, 0])(jnp.full(1, 0.01))


def test_a_control_at_the_end_of_its_range_has_the_slope_within() -> None:
    model = mujoco.MjModel.from_xml_string(MODELS["implicitfast"])
    slopes = [
        trajectory(model).linearized([0.1, 0.2], [0.0, 0.0], [[u]]).b[0, 2, 0]
        for u in (0.5, 1.0, 1.5)
    ]
    assert slopes[1] == pytest.approx(slopes[0], rel=1e-4)
    assert slopes[2] == 0.0


def test_what_cannot_be_done_is_refused_in_a_sentence() -> None:
    model = mujoco.MjModel.from_xml_string(MODELS["dry friction"])
    motion, still = trajectory(model), jnp.zeros(2)
    with pytest.raises(ParameterError, match=r"qpos has shape \(3,\): expected \(2,\)"):
        motion(jnp.zeros(3), still, jnp.zeros((4, 1)))
    with pytest.raises(ParameterError, match=r"ctrl has shape \(4, 2\): expected \(steps, 1\)"):
        motion(still, still, jnp.zeros((4, 2)))
    with pytest.raises(ParameterError, match=r"first derivatives only: .* nermo_mjx.dynamics.step"):
        jax.hessian(lambda u: motion(still, still, u).qpos[-1, 0])(jnp.zeros((4, 1)))
