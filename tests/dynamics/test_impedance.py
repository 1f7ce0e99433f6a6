# Tests of dynamics/impedance.py
"""Accelerations of equality constraints at constant joint velocities."""

from __future__ import annotations

import jax
import mujoco
import numpy as np

from nermo_mjx.dynamics import put_data, put_model
from nermo_mjx.dynamics.impedance import with_rates
from nermo_mjx.dynamics.rows import inner

#: Two bodies that float apart, one with an arm: its residuals are large, and its anchors differ.
LINKED = """<mujoco><worldbody>
<body name="a" pos="0 0 1"><freejoint/><geom size=".1"/>
  <body name="arm" pos=".2 0 0"><joint axis="0 1 1"/><geom size=".05" pos=".1 0 0"/></body></body>
<body name="b" pos=".3 .2 1.1" euler="20 30 40"><freejoint/><geom size=".1"/></body>
</worldbody><equality>
<connect body1="arm" body2="b" anchor=".05 .1 -.02"/>
<weld body1="arm" body2="b" anchor=".1 .02 .03" relpose=".2 .1 -.1 1 .2 .1 -.3" torquescale="0.7"/>
</equality></mujoco>"""


def test_accelerations_of_connects_and_welds_are_second_differences_of_mujocos_residuals() -> None:
    """Along a motion with constant velocities the rates of a row, J' v, are the second derivative of its residual."""
    model = mujoco.MjModel.from_xml_string(LINKED)
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    mujoco.mj_integratePos(model, data.qpos, random.normal(size=model.nv), 0.3)
    velocity, start = random.normal(size=model.nv), data.qpos.copy()

    def residual(time: float) -> np.ndarray:
        moved_data = mujoco.MjData(model)
        moved_data.qpos[:] = start
        mujoco.mj_integratePos(model, moved_data.qpos, velocity, time)
        mujoco.mj_forward(model, moved_data)
        assert moved_data.ne == 9
        return moved_data.efc_pos[:9].copy()

    step = 1e-4
    expected = (residual(step) - 2 * residual(0.0) + residual(-step)) / step**2
    data.qvel[:] = velocity
    mujoco.mj_forward(model, data)
    with jax.enable_x64(True):
        device = put_model(model)
        start_data = put_data(model, data)
        end_data = jax.jit(lambda data: with_rates(device, data))(start_data)
        change = np.asarray(inner(start_data).efc_aref - inner(end_data).efc_aref)
    np.testing.assert_allclose(change[:9], expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    assert not change[9:].any(), "rows of contacts stay"
