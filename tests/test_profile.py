"""The profile of a physics step: its stages are those of the step, and their costs follow what is in the model."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest
import swinging

from nermo_mjx.bench.profile import MJX_STAGES, profile, profile_stage
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.robot import ParameterError


@pytest.mark.compiles
def test_the_profile_of_c_is_the_whole_step():
    """Every stage takes time, together they are the step, and MuJoCo's clock is off afterwards: it slows every step."""
    result = profile("c")
    stages = {row["stage"]: row for row in result["stages"]}
    assert set(MJX_STAGES) - {"sensors"} < set(stages)
    assert min(row["us"] for row in stages.values()) > 0.0
    assert sum(row["us"] for row in stages.values()) == pytest.approx(result["step_us"])
    assert sum(row["share"] for row in stages.values()) == pytest.approx(1.0)
    assert mujoco.get_mjcb_time() is None


@pytest.mark.slow
def test_the_stages_of_mjx_make_a_step():
    """One stage after the other, each a program of its own, moves a driven pendulum that touches ground as C does."""
    reference = mujoco.MjModel.from_xml_string(swinging.XML)
    data = mujoco.MjData(reference)
    data.qpos[:], data.qvel[:], data.ctrl[:] = 0.1, -0.8, 0.2
    model = mjx.put_model(reference)
    batch = jax.vmap(lambda _: mjx.put_data(reference, data))(np.arange(2))
    rows = {}
    for name, stage in MJX_STAGES.items():
        rows[name], batch = profile_stage(model, stage, batch)
        assert min(rows[name][figure] for figure in ("us", "trace_s", "compile_s")) > 0.0
    assert rows["tendons"]["operations"] == 0  # it has none
    assert rows["solver"]["operations"] > rows["inertia"]["operations"] > 0
    mujoco.mj_step(reference, data)
    assert data.ncon > 0
    for world in range(2):
        np.testing.assert_allclose(batch.qpos[world], data.qpos, rtol=1e-5)
        np.testing.assert_allclose(batch.qvel[world], data.qvel, rtol=1e-4)
        np.testing.assert_allclose(batch.qfrc_constraint[world], data.qfrc_constraint, rtol=1e-3)


def test_an_engine_without_a_profile_is_refused():
    """With the names that exist."""
    with pytest.raises(ParameterError, match="engine is 'warp': allowed is 'c' or 'mjx'"):
        profile("warp")
