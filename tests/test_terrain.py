"""Height of the ground: against MuJoCo's own rays from above."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest

from nermo_mjx.robot.scene import Terrain

pytestmark = pytest.mark.compiles

#: Name -> geom, each turned and moved.
GROUNDS = {
    "level plane": "<geom type='plane' size='9 9 1' pos='0.1 0.2 0.3'/>",
    "tilted plane": "<geom type='plane' size='9 9 1' pos='0.1 0.2 0.3' euler='8 -12 40'/>",
    "level box": "<geom type='box' size='0.5 0.3 0.1' pos='0.1 0.2 0.3' euler='0 0 25'/>",
    "tilted box": "<geom type='box' size='0.5 0.3 0.1' pos='0.1 0.2 0.3' euler='20 -15 25'/>",
    "box upside down": "<geom type='box' size='0.5 0.3 0.1' pos='0.1 0.2 0.3' euler='180 0 25'/>",
    "field": "<geom type='hfield' hfield='hills' pos='0.1 0.2 0.3' euler='0 0 25'/>",
    "all": "<geom type='hfield' hfield='hills'/><geom type='box' size='0.5 0.3 0.1' euler='0 20 0'/>"
    "<geom type='plane' size='9 9 1' pos='0 0 0.02'/>",
}


def compiled(geoms: str) -> mujoco.MjModel:
    heights = " ".join(f"{each:.6f}" for each in np.random.default_rng(0).uniform(0, 1, 35))
    return mujoco.MjModel.from_xml_string(
        "<mujoco><asset><hfield name='hills' nrow='5' ncol='7' size='0.8 0.6 0.2 0.1' "
        f"elevation='{heights}'/></asset><worldbody>{geoms}</worldbody></mujoco>"
    )


def from_above(model: mujoco.MjModel, x: float, y: float) -> float:
    """Height where a ray down meets something; -inf where it meets nothing."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hit = np.zeros(1, np.int32)
    distance = mujoco.mj_ray(model, data, np.array([x, y, 5.0]), np.array([0.0, 0, -1]), None, 1, -1, hit)
    return 5.0 - distance if distance >= 0 else -np.inf


@pytest.mark.parametrize("kind", GROUNDS)
def test_the_height_is_where_a_ray_from_above_meets_the_ground(kind):
    """At 200 places in and beside it; beside all of it the height is one that nothing of it is below."""
    model = compiled(GROUNDS[kind])
    places = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 2))
    with jax.enable_x64(True):
        heights = np.asarray(Terrain(model, range(model.ngeom)).height(*places.T))
    rays = np.array([from_above(model, *place) for place in places])
    hit = np.isfinite(rays)
    np.testing.assert_allclose(heights[hit], rays[hit], atol=1e-7)
    assert hit.sum() > 20
    assert len(set(heights[~hit])) <= 1
    assert (heights[~hit] <= rays[hit].min()).all()


def test_the_height_has_the_slope_of_the_ground():
    """On a plane turned by 0.2 rad about y, downhill along x."""
    model = compiled("<geom type='plane' size='9 9 1' euler='0 11.459156 0'/>")
    slope = jax.grad(lambda x: Terrain(model, [0]).height(x, 0.3))(0.5)
    assert float(slope) == pytest.approx(-np.tan(0.2), rel=1e-5)
