# Tests of robot/terrains.py
"""Height of the ground against MuJoCo's rays from above, and a world of a batch against a model of its own."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest

from nermo_mjx import Setup
from nermo_mjx.learn import Environment, Task
from nermo_mjx.physics.variation import Variation, compile_model, vary
from nermo_mjx.robot import ModelParameters, load_robot
from nermo_mjx.robot.quantity import replace_quantities
from nermo_mjx.robot.scene import Terrain
from nermo_mjx.robot.terrains import TERRAIN_DISTANCE, TERRAINS, TerrainShape, gates
from nermo_mjx.specs.walk import unread
from nermo_mjx.sweep import Sweep

#: What carries the robot.
GROUNDS = [name for name, kind in TERRAINS.items() if not kind.obstacle]


def other_shape(scene: str) -> dict[str, float]:
    """Everything a quarter more than by default, and moved."""
    return {
        f"terrain.{name}": 1.25 * value if value else 0.04
        for name, value in TERRAINS[scene].defaults.items()
    }


def tree_of(values: dict[str, float]) -> TerrainShape:
    return TerrainShape(**{name.partition(".")[2]: value for name, value in values.items()})


def ray_height(model: mujoco.MjModel, data: mujoco.MjData, scene: str, x: float, y: float) -> float:
    """Where a ray from above first meets the ground, through the robot."""
    height, geom = 5.0, np.zeros(1, np.int32)
    while True:
        height -= mujoco.mj_ray(
            model, data, np.array([x, y, height]), np.array([0.0, 0, -1]), None, 1, -1, geom
        )
        if model.geom(int(geom[0])).name.startswith((scene, "floor")):
            return height
        height -= 1e-6


@pytest.mark.release
@pytest.mark.parametrize("scene", GROUNDS)
def test_the_height_of_a_shape_is_that_of_the_model_with_its_fields(scene):
    """At 150 places about the way, of a shape that is not the compiled one: what a batch's worlds are told is there."""
    robot, values = load_robot(scene=scene), other_shape(scene)
    with jax.enable_x64(True):
        model = compile_model(robot, values)
        places = np.random.default_rng(0).uniform([-0.5, -3.0], [0.5, 0.4], (150, 2))
        heights = np.asarray(robot.terrain.height(*places.T, tree_of(values)))
        default_heights = np.asarray(robot.terrain.height(*places.T))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(
        heights, [ray_height(model, data, scene, *position) for position in places], atol=1e-7
    )
    assert np.abs(heights - default_heights).max() > 1e-3


@pytest.mark.release
def test_terrains_have_the_sizes_of_the_published_ones():
    """Height along the middle of the way, by default."""
    ahead = np.arange(0.0, 2.0, 0.005) + 0.0025
    profile = {
        name: np.asarray(load_robot(scene=name).terrain.height(0.0 * ahead, -ahead))
        for name in GROUNDS
    }
    plank = profile["planks"]
    np.testing.assert_allclose(
        plank[(ahead > TERRAIN_DISTANCE) & (ahead < TERRAIN_DISTANCE + 0.1)], 0.01, atol=1e-7
    )
    assert (
        plank[(ahead > TERRAIN_DISTANCE + 0.105) & (ahead < TERRAIN_DISTANCE + 0.195)].max() == 0.0
    )
    np.testing.assert_array_equal(
        np.diff(np.flatnonzero(np.diff(plank) > 0.005)), 40
    )  # every 0.2 m
    rise = profile["ramp"][(ahead > TERRAIN_DISTANCE) & (ahead < 1.9)]
    np.testing.assert_allclose(np.diff(rise) / 0.005, np.tan(np.radians(10.0)), rtol=1e-3)
    assert rise[0] < 0.001
    assert profile["logs"].max() == pytest.approx(0.01, abs=1e-4)
    bumps = np.flatnonzero(
        (profile["logs"][1:-1] >= profile["logs"][:-2])
        & (profile["logs"][1:-1] > profile["logs"][2:])
    )
    np.testing.assert_allclose(np.diff(bumps), 30, atol=1)  # every 0.15 m
    stairs = np.flatnonzero(np.diff(profile["stairs"]) > 0.005)
    np.testing.assert_array_equal(np.diff(stairs), 30)
    assert len(stairs) == 7
    assert profile["stairs"][-1] == 0.0 or profile["stairs"].max() == pytest.approx(0.07)
    assert 0.0 <= profile["rough"].min() < profile["rough"].max() <= 0.01 + 1e-7


def test_the_spiral_stair_rises_along_its_circle_and_gates_alternate():
    angle = (TERRAIN_DISTANCE + 0.15 * (np.arange(15) + 0.5)) / 0.5
    heights = load_robot(scene="spiral_stairs").terrain.height(
        0.5 * (1 - np.cos(angle)), -0.5 * np.sin(angle)
    )
    np.testing.assert_allclose(heights, 0.01 * np.arange(1, 16), atol=1e-6)
    model = load_robot(scene="slalom").model
    left, right = (model.geom(f"slalom_{i}").pos for i in (0, 1))
    assert left[0] - right[0] == pytest.approx(0.2 + 2 * 0.01)
    np.testing.assert_allclose(
        gates(TerrainShape(**TERRAINS["slalom"].defaults))[:2, 0], [0.06, -0.06]
    )
    np.testing.assert_allclose(
        (left + right)[:2] / 2, gates(TerrainShape(**TERRAINS["slalom"].defaults))[0]
    )


@pytest.mark.release
@pytest.mark.parametrize("scene", TERRAINS)
def test_a_world_of_a_batch_stands_on_its_own_ground(scene):
    """Dropped ahead of the start, two worlds of a batch end where the robot does in a model of each alone."""
    robot, shape_values = load_robot(scene=scene, physics="fast"), other_shape(scene)
    shapes = [
        {f"terrain.{name}": value for name, value in TERRAINS[scene].defaults.items()},
        shape_values,
    ]
    variation, start = Variation(robot), robot.physical.qpos0.copy()
    start[1:3] += [-0.4, 0.02]
    values = {name: np.array([shape[name] for shape in shapes]) for name in shape_values}
    fields = variation.batch(replace_quantities(ModelParameters(), values), 2, values)
    batch = mujoco.batch.Batch(robot.physical, 2)
    vary(batch, robot.physical, fields)
    qpos = batch.bind("qpos")
    qpos[...] = start
    batch.step(nstep=40)
    for world, shape in enumerate(shapes):
        model = compile_model(robot, shape)
        data = mujoco.MjData(model)
        data.qpos[:] = start
        mujoco.mj_step(model, data, 40)
        np.testing.assert_allclose(qpos[world], data.qpos, atol=1e-5)
    assert np.abs(qpos[0] - qpos[1]).max() > 1e-4


@pytest.mark.release
def test_an_environment_draws_a_ground_for_each_episode():
    task = Task(
        randomize={"terrain.height": (0.0, 0.02), "terrain.shift": (-0.3, -0.2)},
        episode_length=0.05,
    )
    environment = Environment(Setup(scene="planks", physics="fast"), worlds=2, task=task)
    state = environment.reset(0)
    scan = [
        i for i, name in enumerate(environment.privileged_names) if name.startswith("height_scan_")
    ]
    first = state.privileged[:, scan]
    for _ in range(5):
        state = environment.step(state, np.zeros((2, 9)))
    second = state.privileged[:, scan]
    assert state.truncated.all()
    # Each world has its own ground, and another one in its second episode.
    assert np.abs(first[0] - first[1]).max() > 0.05
    assert (np.abs(first - second).max(axis=1) > 0.05).all()


def test_a_scene_reads_its_own_shape_only():
    assert unread(Setup(), "terrain.height") == ("scene", "planks")
    assert unread(Setup(scene="logs"), "terrain.height") is None
    # All parameters at once, as a table or `defaults` gives them.
    assert Setup().world(Setup().defaults() | {"frequency": 0.8}).control.gait.frequency == 0.8


def test_a_fixed_shape_goes_to_the_scenes_that_read_it():
    sweep = Sweep.from_dict(
        {"vary": {"scene": ["flat", "planks"]}, "set": {"terrain.height": 0.004}}
    )
    assert [dict(structure.constants) for structure in sweep.structures] == [
        {},
        {"terrain.height": 0.004},
    ]


# --- single surfaces

#: Name -> geom, each turned and moved.
SURFACES = {
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
    heights = " ".join(f"{height:.6f}" for height in np.random.default_rng(0).uniform(0, 1, 35))
    return mujoco.MjModel.from_xml_string(
        "<mujoco><asset><hfield name='hills' nrow='5' ncol='7' size='0.8 0.6 0.2 0.1' "
        f"elevation='{heights}'/></asset><worldbody>{geoms}</worldbody></mujoco>"
    )


def from_above(model: mujoco.MjModel, x: float, y: float) -> float:
    """Height where a ray down meets something; -inf where it meets nothing."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hit = np.zeros(1, np.int32)
    distance = mujoco.mj_ray(
        model, data, np.array([x, y, 5.0]), np.array([0.0, 0, -1]), None, 1, -1, hit
    )
    return 5.0 - distance if distance >= 0 else -np.inf


@pytest.mark.parametrize("kind", SURFACES)
def test_the_height_is_where_a_ray_from_above_meets_the_ground(kind):
    """At 200 places in and beside it; beside all of it the height is one that nothing of it is below."""
    model = compiled(SURFACES[kind])
    places = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 2))
    with jax.enable_x64(True):
        heights = np.asarray(Terrain(model, range(model.ngeom)).height(*places.T))
    rays = np.array([from_above(model, *position) for position in places])
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
