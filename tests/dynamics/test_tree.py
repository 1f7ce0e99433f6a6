# Tests of dynamics/tree.py, dynamics/jacobians.py, dynamics/spatial.py
"""The passes over the kinematic tree against MuJoCo's C, on trees of all kinds of joints."""

from __future__ import annotations

from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from nermo_mjx.dynamics import make_data, put_model, rows, tree
from nermo_mjx.dynamics.jacobians import point_jacobian
from nermo_mjx.robot import load_robot

#: Several joints on a body, off-centre anchors, turned frames, branches, a free body with children, a slide on a turned
#: parent, a body without mass, one that is led, with a child.
ALL_JOINTS = """
<mujoco><option gravity="0.3 -0.2 -9.81"/><default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="cart" pos="0.1 0.2 0.3" quat="0.9 0.1 0.3 -0.2">
    <joint type="slide" axis="1 0.2 0"/><joint type="hinge" axis="0.1 1 0" pos="0.03 0 0.02" ref="0.2"/>
    <joint type="slide" axis="0 0 1"/>
    <geom type="box" size=".1 .05 .02" pos="0.02 0.01 0" quat="0.8 0.3 0.1 0.2"/>
    <site pos="0.1 0.1 0" quat="0.5 0.5 0.1 0.2"/>
    <body pos="0 0 0.2" quat="0.7 0 0.7 0.1">
      <joint type="ball" pos="0.01 0.02 0.03"/><geom type="capsule" size=".02 .1" pos="0 0 .1"/>
      <body pos="0 0 0.2"><joint type="hinge" axis="0 1 1"/><joint type="hinge" axis="1 0 0" pos="0 0 .01"/>
        <geom type="sphere" size=".03" pos=".02 0 .05"/>
        <body pos="0 0.1 0"><site/><body pos="0 0.1 0.1"><geom size="0.02"/></body></body>
      </body>
    </body>
    <body pos="0 -0.3 0"><geom type="ellipsoid" size=".02 .03 .05"/></body>
  </body>
  <body name="flyer" pos="0 0 1"><freejoint/><geom type="box" size=".1 .2 .3" pos="0.05 0 0"/>
    <body pos="0.1 0 0.3"><joint type="hinge" axis="0 0 1" armature="0.02"/>
      <geom type="sphere" size=".05" pos="0.1 0 0"/></body>
  </body>
  <body name="led" mocap="true" pos="0.4 0.5 0.6" quat="0.2 0.3 0.4 0.5"><geom size="0.02"/>
    <body pos="0.1 0 0"><geom size="0.02"/></body></body>
</worldbody></mujoco>
"""


def after(kind: str, sparse: bool) -> tuple[mujoco.MjModel, mujoco.MjData, Any]:
    """A model, C's data of a state with velocities, and ours in float64."""
    model = (
        mujoco.MjModel.from_xml_string(ALL_JOINTS)
        if kind == "all joints"
        else load_robot(tail=kind).physical
    )
    model.opt.jacobian = (
        mujoco.mjtJacobian.mjJAC_SPARSE if sparse else mujoco.mjtJacobian.mjJAC_DENSE
    )
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    random, data = np.random.default_rng(1), mujoco.MjData(model)
    change = random.normal(size=model.nv) * 0.4
    mujoco.mj_integratePos(model, data.qpos, change, 1.0)
    data.qpos[:] *= 1.0 + 1e-3 * (model.nq == 16)  # lengths of quaternions that drifted
    data.qvel[:] = random.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    with jax.enable_x64(True):
        ours = put_model(model)

        def passes(qpos: Any, qvel: Any) -> Any:
            data = make_data(ours).replace(qpos=qpos, qvel=qvel)
            for function in (tree.kinematics, tree.com_pos, tree.crb, tree.com_vel, tree.rne):
                data = function(ours, data)
            return data, rows.inner(data).cinert, mjx.full_m(ours, data)

        arrays = jax.tree.map(np.asarray, jax.jit(passes)(np.array(data.qpos), np.array(data.qvel)))
    return model, data, arrays


@pytest.mark.release(cases=("rigid-False", "all joints-False", "articulated-True"))
@pytest.mark.parametrize(
    ("kind", "sparse"),
    [("all joints", False), ("all joints", True), ("rigid", False), ("articulated", True)],
)
def test_what_goes_along_the_tree_is_as_in_c(kind: str, sparse: bool) -> None:
    """Places, axes, inertias and velocities; and how a point on each body moves with each velocity."""
    model, data, (ours_of_tree, bodies, joints) = after(kind, sparse)
    for field in (
        "qpos",
        "xpos",
        "xquat",
        "xmat",
        "xipos",
        "ximat",
        "xanchor",
        "xaxis",
        "geom_xpos",
        "geom_xmat",
        "site_xpos",
        "site_xmat",
        "subtree_com",
        "cdof",
        "cvel",
        "cdof_dot",
        "qfrc_bias",
    ):
        right, ours = np.asarray(getattr(data, field)), getattr(ours_of_tree, field)
        scale = 1e-12 * (1.0 + np.abs(right).max())
        np.testing.assert_allclose(
            ours.reshape(right.shape), right, rtol=1e-9, atol=scale, err_msg=field
        )
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    np.testing.assert_allclose(joints, inertia, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(bodies[1:], data.cinert[1:], rtol=1e-9, atol=1e-14)
    ours = put_model(model)
    for body in range(model.nbody):
        point = data.xipos[body] + 0.1
        position, rotation = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, position, rotation, point, body)
        with jax.enable_x64(True):
            moves, turns = point_jacobian(ours, ours_of_tree, jax.numpy.asarray(point), body)
        np.testing.assert_allclose(moves, position.T, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(turns, rotation.T, rtol=1e-9, atol=1e-12)
