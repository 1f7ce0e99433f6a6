# Tests of dynamics/differentiable.py
"""How well a step is solved, in a hard case; and its result in MJX's other functions."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx.dynamics import make_data, put_data, put_model, solver, step, step_with_verdict
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.runtime import compiler_options

#: A light finger of two links on a body, in stiff contacts.
FINGER = """<mujoco><option timestep=".002" cone="elliptic" impratio="100"/><default><geom solref=".004 1"
solimp=".99 .9999 .0001" friction="1 .01 .001" condim="4"/></default><worldbody><geom type="plane" size="3 3 .1"/>
<body pos="0 0 .05"><freejoint/><geom type="sphere" size=".05" mass="1"/><body pos=".06 0 -.03">
<joint axis="0 1 0" damping="1e-4"/><geom type="capsule" size=".01" fromto="0 0 0 .08 0 0" mass=".001"/>
<body pos=".08 0 0"><joint axis="0 1 0"/><geom type="sphere" size=".012" mass=".001"/></body></body></body></worldbody>
</mujoco>"""
#: States whose solve took more than 20 rounds, in float64, and states that float32 had wrong by up to 4,000 times.
STATES = np.array(
    """-0.000411 -0.007269 0.047211 0.99954 0.027415 0.01035 -0.007755 0.033335 -0.001776
0 0 0 0 0 0 0 0
0.016524 -0.016339 0.046902 0.99934 -0.030108 0.00547 -0.019596 0.050511 0.007083
-0.613547 1.13328 -0.784445 0.119175 -0.284907 0.001178 -0.559545 0.43814
-0.005168 -0.015484 0.046248 0.999796 -0.011944 0.004756 0.01557 0.036272 0.001935
0 0 0 0 0 0 0 0
-0.0268409 0.0183961 0.0471339 0.9999251 0.0115085 -0.0038476 0.0015842 0.0010669 0.0220147
-0.321547 -2.967184 -0.760059 0.183712 -0.440468 0.769821 1.015327 -0.147772
-0.0101393 0.0364674 0.0486867 0.9996783 -0.0073705 -0.0154661 -0.0186995 -0.0048282 -0.0137079
0.690894 0.202552 -0.910176 1.46849 1.099495 0.019003 0.783586 1.712908
0.0462073 -0.0157439 0.0484196 0.9999821 -0.001955 0.0056581 -7.21e-05 -0.011224 -0.0173523
3.066037 -0.077345 -2.016661 -0.648601 0.67804 -0.500008 1.360446 1.002398""".split(),  # noqa: SIM905
    float,
).reshape(6, -1)


def _compared(double: bool, states: np.ndarray = STATES) -> tuple[np.ndarray, Any]:
    """Errors of the velocities after a step, against C, as a share of the largest, and the verdicts."""
    model = mujoco.MjModel.from_xml_string(FINGER)
    model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0, 500, 100
    states, ends = np.float32(states).astype(float), []
    for state in states:
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = np.split(state, [model.nq])
        mujoco.mj_normalizeQuat(model, data.qpos)
        state[: model.nq] = data.qpos
        mujoco.mj_step(model, data)
        ends.append(data.qvel.copy())
    with jax.enable_x64(double):
        device = put_model(model)
        blank = make_data(device)

        def one(state: Any) -> Any:
            new_data, verdict = step_with_verdict(
                device, blank.replace(qpos=state[: model.nq], qvel=state[model.nq :])
            )
            return new_data.qvel, verdict

        result, verdicts = jax.jit(jax.vmap(one), compiler_options=compiler_options())(
            jnp.asarray(states)
        )
    largest = np.abs(ends).max(axis=1)
    return np.abs(np.asarray(result) - ends).max(axis=1) / largest, jax.tree.map(
        np.asarray, verdicts
    )


@pytest.mark.release
@pytest.mark.parametrize("double", [False, True], ids=["float32", "float64"])
def test_light_links_in_stiff_contacts_move_as_in_c(double: bool) -> None:
    """In float32 to about 100 times the rounding of the inputs; the verdict says so."""
    errors, verdict = _compared(double)
    assert errors.max() < (1e-9 if double else 1e-4)
    assert verdict.converged.all()
    assert verdict.residual.max() < (1e-8 if double else 1e-3)
    assert verdict.rounds.max() > 20


@pytest.mark.release
def test_a_solve_that_is_stopped_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """With five rounds, what is wrong has not converged, and its residual is large."""
    monkeypatch.setattr(solver, "MAX_ROUNDS", 5)
    errors, verdict = _compared(True)
    assert (errors > 1e-3).sum() >= 3
    assert not verdict.converged[errors > 1e-6].any()
    assert (verdict.residual[errors > 1e-3] > 1e-6).all()
    assert verdict.rounds.max() == 5


def _shapes(tree: Any) -> list[tuple[int, ...]]:
    return [jnp.shape(leaf) for leaf in jax.tree.leaves(tree)]


TWO = """<mujoco><worldbody><geom type="plane" size="3 3 .1"/><body pos="0 0 .0495"><freejoint/>
<geom type="capsule" size=".05 .1" euler="0 90 0"/><body pos="0 0 .06"><joint name="j" axis="0 1 0" {}/>
<geom size=".03" pos=".1 0 .1" mass=".1"/></body></body></worldbody></mujoco>"""


@pytest.mark.release
@pytest.mark.parametrize(
    ("mode", "joint"),
    [
        ("closed over", ""),
        ("an argument", ""),
        ("randomized", ""),
        ("randomized", 'frictionloss=".1" range="-10 10"'),
    ],
)
def test_results_pass_through_mjxs_functions(mode: str, joint: str) -> None:
    """`get_data`, `put_data` of it, a further step, kinematics and a picture's scene, with contacts that are C's."""
    model = mujoco.MjModel.from_xml_string(TWO.format(joint))
    device = put_model(model)
    start = make_data(device)
    if mode == "randomized":
        axes = jax.tree.map(lambda _: None, device).tree_replace(
            {"dof_frictionloss": 0, "body_mass": 0}
        )
        batched_models = device.tree_replace(
            {
                "dof_frictionloss": jnp.stack(
                    [device.dof_frictionloss, device.dof_frictionloss + 0.1]
                ),
                "body_mass": jnp.stack([device.body_mass, 1.2 * device.body_mass]),
            }
        )
        batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), start)
        advance = jax.jit(jax.vmap(step, in_axes=(axes, 0)))
        after = advance(batched_models, advance(batched_models, batch))
        got = mjx.get_data(model, after)[0]
        after = jax.tree.map(lambda leaf: leaf[0], after)
    else:
        advance = (
            jax.jit(step) if mode == "an argument" else jax.jit(lambda _, data: step(device, data))
        )
        after = advance(device, advance(device, start))
        got = mjx.get_data(model, after)
    assert jax.tree.structure(after) == jax.tree.structure(start)
    assert _shapes(after) == _shapes(start)
    assert got.ncon == np.sum(np.asarray(after._impl.contact.dist) <= 0) > 0
    assert type(after) is mjx.Data
    assert np.asarray(jax.jit(mjx.kinematics)(device, after).xpos).shape == (model.nbody, 3)
    scene = mujoco.MjvScene(model, 100)
    mujoco.mjv_updateScene(
        model, got, mujoco.MjvOption(), None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL, scene
    )
    assert scene.ngeom >= model.ngeom
    reference = mujoco.MjData(model)
    reference.qpos[:], reference.qvel[:] = got.qpos, got.qvel
    mujoco.mj_forward(model, reference)
    reference_data = put_data(model, reference)
    assert _shapes(reference_data) == _shapes(after)
    assert np.isfinite(
        advance(
            *((batched_models, batch) if mode == "randomized" else (device, reference_data))
        ).qpos
    ).all()
