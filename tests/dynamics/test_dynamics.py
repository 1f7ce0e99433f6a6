# Tests of dynamics/checking.py, dynamics/mjx_import.py
"""The step for any model: what it brings and refuses, tendons wound round something, and its own check."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import nermo_mjx.dynamics
from nermo_mjx.dynamics import checking, differentiable, make_data, put_model, tree
from nermo_mjx.dynamics.mjx_copy import adapted
from nermo_mjx.runtime import compiler_options

ROOM = Path(nermo_mjx.dynamics.__file__).parent
BALL = """
<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .0993"><freejoint/><geom size=".1"/></body>
</worldbody></mujoco>
"""


def test_the_room_imports_nothing_of_the_robot() -> None:
    """No file of it, not even where a function is called."""
    allowed = {"nermo_mjx.lazy", "nermo_mjx.shapes", "nermo_mjx.dynamics"}
    for path in ROOM.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            ours = {name for name in names if name.startswith("nermo_mjx")}
            assert all(
                any(name == package or name.startswith(f"{package}.") for package in allowed)
                for name in ours
            ), path


@pytest.mark.release
def test_importing_the_step_brings_nothing_of_the_robot() -> None:
    code = (
        "import sys; from nermo_mjx.dynamics import forward, step; import nermo_mjx.dynamics as room;"
        "[getattr(room, name) for name in room.__all__];"
        "print([name for name in sys.modules if name.startswith('nermo_mjx.')])"
    )
    brought = ast.literal_eval(
        subprocess.run([sys.executable, "-c", code], text=True, capture_output=True).stdout
    )
    top = (
        "nermo_mjx.lazy",
        "nermo_mjx.trust",
        "nermo_mjx.version",
    )  # which the package itself imports
    others = ("nermo_mjx.dynamics", "nermo_mjx.shapes", *top)
    assert {name for name in brought if not name.startswith(others)} == set()


def test_what_it_refuses_is_said_in_a_sentence() -> None:
    ball = mujoco.MjModel.from_xml_string(BALL)
    model = put_model(ball)
    data = make_data(model)
    still = put_model(
        mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>')
    )
    batch = jax.vmap(lambda height: data.replace(qpos=data.qpos.at[2].set(height)))(jnp.arange(2.0))
    discrete = model.tree_replace({"opt.integrator": mjx.IntegratorType.DISCRETE})
    for arguments, message in (
        (
            (discrete, data),
            r"^integrator is DISCRETE: allowed is one of EULER, RK4, IMPLICITFAST, which MJX has\.$",
        ),
        ((still, make_data(still)), r"^the model has no joints: allowed is one that can move"),
        (
            (model, batch),
            r"^qpos has the shape \(2, 7\): allowed is \(7,\), that of one world; use jax\.vmap",
        ),
    ):
        for function in (nermo_mjx.dynamics.step, nermo_mjx.dynamics.forward):
            with pytest.raises(ValueError, match=message):
                function(*arguments)


@pytest.mark.release
def test_what_is_none_of_mjx_is_refused() -> None:
    """In a process without the tests' own check of types."""
    code = f"""
import mujoco
from mujoco import mjx
from nermo_mjx.dynamics import make_data, put_model, step
ball = mujoco.MjModel.from_xml_string('''{BALL}''')
model = put_model(ball)
data = make_data(model)
for given in ((ball, data), (mjx.put_model(ball), data), (model, mujoco.MjData(ball))):
    try:
        step(*given)
    except ValueError as error:
        print(error)
"""
    lines = subprocess.run(
        [sys.executable, "-c", code], text=True, capture_output=True
    ).stdout.splitlines()
    model = "nermo_mjx.dynamics.put_model; mjx.put_model omits fields that this step reads."
    assert lines[-3:] == [
        f"model is of mujoco.MjModel: allowed is a result of {model}",
        f"model is of mujoco.Model: allowed is a result of {model}",
        "data is of mujoco.MjData: allowed is a result of nermo_mjx.dynamics.make_data or put_data.",
    ]


#: Ends of one tendon lie on both sides of a cylinder; another runs past one, begins inside of one, and comes through.
WOUND = """
<mujoco><default><geom contype="0" conaffinity="0" mass="1"/></default><worldbody>
  <geom name="drum" type="cylinder" size=".1 .2" euler="90 0 0"/><geom name="ball" size=".1" pos="0 .5 0"/>
  <geom name="hub" type="cylinder" size=".05 .2" euler="90 0 0" pos=".1 0 0"/>
  <site name="above" pos="-.1 0 .2"/><site name="over" pos="0 .4 .4"/><site name="through" pos="0 0 0"/>
  <site name="in_hub" pos=".1 0 0"/><site name="from" pos="-.5 0 .11"/><site name="inner" pos=".1 0 .01"/>
  <body pos=".4 0 .1"><joint axis="0 1 0"/><joint type="slide" axis="0 1 0"/><geom size=".05" pos="0 0 -.1"/>
    <site name="a" pos="0 0 -.12"/><site name="b" pos="0 .3 .4"/></body>
</worldbody><tendon>
  <spatial><site site="from"/><geom geom="drum" sidesite="above"/><site site="a"/></spatial>
  <spatial><site site="from"/><geom geom="ball" sidesite="over"/><site site="b"/></spatial>
  <spatial><site site="inner"/><geom geom="hub" sidesite="above"/><site site="a"/></spatial>
  <spatial><site site="from"/><geom geom="drum" sidesite="through"/><site site="a"/></spatial>
  <spatial><site site="above"/><geom geom="hub" sidesite="in_hub"/><site site="b"/></spatial>
</tendon></mujoco>
"""


@pytest.mark.release
def test_tendons_have_their_moment_arms_for_a_derivative() -> None:
    """Also those that touch nothing, or in one point: the derivative of MJX's own is NaN there. The oracle is C."""
    model = mujoco.MjModel.from_xml_string(WOUND)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.05, 0.02
    mujoco.mj_forward(model, data)
    arms = np.zeros((model.ntendon, model.nv))
    mujoco.mju_sparse2dense(
        arms, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind
    )
    with jax.enable_x64(True):
        device = put_model(model)
        blank = make_data(device)

        def lengths(qpos: Any) -> Any:
            tendon_data: Any = adapted.smooth.tendon(
                device, tree.com_pos(device, tree.kinematics(device, blank.replace(qpos=qpos)))
            )
            return tendon_data.ten_length, (tendon_data.ten_length, tendon_data._impl.ten_J)

        slopes, (length, moments) = jax.jit(jax.jacrev(lengths, has_aux=True))(
            jnp.asarray(data.qpos)
        )
    np.testing.assert_allclose(length, data.ten_length, rtol=1e-9)
    np.testing.assert_allclose(moments, arms, atol=1e-9)
    np.testing.assert_allclose(slopes, arms, atol=1e-9)


@pytest.mark.release
def test_a_cylinder_collides_with_a_derivative() -> None:
    """A capsule that lies on it: MJX looks for the closest points by descent, whose own derivative is NaN inside."""
    xml = """<mujoco><worldbody><geom type="cylinder" size=".1 .2" euler="90 0 0"/>
    <body pos="0 .02 .145"><freejoint/><geom type="capsule" size=".05 .1" euler="0 80 10"/></body></worldbody>
    </mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    with jax.enable_x64(True):
        device = put_model(model)
        blank = make_data(device)

        def distance(height: Any) -> Any:
            data = tree.kinematics(device, blank.replace(qpos=blank.qpos.at[2].set(height)))
            return adapted.collision_driver.collision(device, data)._impl.contact.dist[0]

        values = jax.jit(jax.vmap(jax.value_and_grad(distance)))(
            0.145 + 1e-6 * jnp.arange(-1.0, 2.0)
        )
    (low, middle, high), slopes = (np.asarray(values_of_points) for values_of_points in values)
    assert middle < 0.0
    np.testing.assert_allclose(slopes[1], (high - low) / 2e-6, rtol=1e-5)


@pytest.mark.parametrize("width", [0.0, 0.3])
def test_a_muscle_has_a_derivative_in_float32(width: float) -> None:
    """(u - a) / tau, Millard et al. (2013), with tau = 0.01 (0.5 + 1.5 a) while u is well above a."""

    def rate(excitation: Any, activation: Any) -> Any:
        rates: Any = adapted.support.muscle_dynamics(
            excitation, activation, jnp.array([0.01, 0.04, width])
        )
        return rates

    rise, fall = jax.grad(rate, argnums=(0, 1))(jnp.float32(0.4), jnp.float32(0.1))
    assert rise == pytest.approx(1.0 / 0.0065, rel=1e-5)
    assert fall == pytest.approx(-1.0 / 0.0065 - 0.3 * 0.015 / 0.0065**2, rel=1e-5)


@pytest.mark.long
@pytest.mark.release
def test_the_check_finds_a_derivative_that_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """With ours all is well; without the solution's derivative, as if contacts had none, it is not."""
    model = mujoco.MjModel.from_xml_string(BALL)
    data, options = mujoco.MjData(model), dict(compiler_options())
    data.qvel[:2] = 1.0, 0.3  # it slides
    assert checking.check_gradient(model, data, steps=2, options=options).error < 1e-6
    cut = differentiable._solution
    monkeypatch.setattr(
        differentiable,
        "_solution",
        lambda *arguments, **keywords: jax.lax.stop_gradient(cut(*arguments, **keywords)),
    )
    result = checking.check_gradient(model, data, steps=2, options=options)
    assert result.is_finite
    assert result.error > 0.1
    assert result.spread < 1e-5


def test_the_differences_choose_their_width_and_the_gradient_has_no_say() -> None:
    """Of the pair that agrees best, the one that agrees better with its other neighbour."""
    result = checking.GradientCheck(
        group=np.zeros(2, int),
        gradient=np.array([5.0, 5.0]),
        differences=np.array([[1.1, 2.0], [1.001, 2.0], [1.0, 2.0], [0.9, 2.0], [0.1, 2.0]]),
        end=np.zeros(1),
    )
    assert checking.DIFFERENCE_WIDTHS[result.chosen] == 1e-5
    assert result.spread == pytest.approx(1e-3 / np.hypot(1.0, 2.0))
    assert not np.isfinite(
        checking.distance(result.group, np.array([np.nan, 0.0]), result.differences[0])
    )
