"""The contacts' rows against MJX's own: their values, and the derivative to the impedance that is added to them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx.dynamics import impedance, rows
from nermo_mjx.dynamics.jacobians import with_point_jacobians
from nermo_mjx.dynamics.mjx_import import mjx

pytestmark = pytest.mark.compiles

BALL = """
<mujoco>
  <option timestep="0.01"> <flag refsafe="{refsafe}"/> </option>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body pos="0 0 .0998"> <freejoint/> <geom name="ball" size=".1"/> </body>
  </worldbody>
  <contact> <pair geom1="floor" geom2="ball" solref="{solref}" solimp="0.1 0.9 0.0005 0.5 2"/> </contact>
</mujoco>
"""

#: Ours, with our impedances in place of MJX's.
OURS = with_point_jacobians(impedance.make_constraint)


@jax.jit
def at_contact(model: Any, data: Any) -> Any:
    return mjx.collision(model, mjx.crb(model, mjx.com_pos(model, mjx.kinematics(model, data))))


@functools.partial(jax.jit, static_argnums=0)
def made(make: Callable[..., Any], model: Any, data: Any, largest: Any) -> tuple[Any, Any]:
    """The contacts' rows with such an impedance: stiffness and reference acceleration."""
    solimp = rows.inner(data).contact.solimp.at[:, 1].set(largest)
    found = rows.inner(make(model, data.tree_replace({"_impl.contact.solimp": solimp})))
    return found.efc_D, found.efc_aref


@pytest.mark.parametrize("solref", ["0.005 1", "0.03 1.5", "-3000 -40"])
@pytest.mark.parametrize("refsafe", ["enable", "disable"])
def test_slopes_are_those_of_mjxs_rows(refsafe: str, solref: str) -> None:
    """A time constant of half a step, which MuJoCo takes for two unless told not to; a longer one; and stiffness.

    The oracle is a difference of `mjx.make_constraint` in float64.
    """
    with jax.enable_x64(True):
        model = mjx.put_model(mujoco.MjModel.from_xml_string(BALL.format(refsafe=refsafe, solref=solref)))
        data = at_contact(model, mjx.make_data(model).replace(qvel=jnp.array([0.1, 0.0, -0.2, 0.0, 0.0, 0.0])))
        found = jax.jvp(lambda largest: made(OURS, model, data, largest), (0.9,), (1.0,))[1]
        above, below = (made(mjx.make_constraint, model, data, 0.9 + step) for step in (1e-6, -1e-6))
    assert np.any(above[1] != below[1])
    for slope, high, low in zip(found, above, below, strict=True):
        np.testing.assert_allclose(slope, (high - low) / 2e-6, rtol=1e-5, atol=1e-6 * np.abs(high).max())
