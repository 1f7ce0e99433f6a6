# Tests of robot/scene.py
"""Custom scenes: from a file, a text or an `MjSpec` to a robot that stands, walks and falls in it."""

from __future__ import annotations

import dataclasses
import pickle

import mujoco
import numpy as np
import pytest
from command import call
from conftest import shared_simulator

from nermo_mjx.robot import LIMBS, ParameterError, load_robot
from nermo_mjx.robot.scene import resolve_scene, scene_geoms
from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.rollout.run import DEPTH
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep import Sweep

PLANE = "<geom name='floor' type='plane' size='0 0 0.1' pos='0 0 {height}'/>"
#: A walled yard: a floor half a metre up, a step on it, a bench of two boxes on a body, and a lawn to look at.
YARD = """
<mujoco model="yard">
  <default>
    <default class="ground"><geom type="box"/></default>
    <default class="obstacle"><geom type="box"/><default class="seat"><geom size="0.1 0.1 0.01"/></default></default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.1" pos="0 0 0.5"/>
    <geom class="ground" size="0.2 0.2 0.01" pos="1 0 0.51"/>
    <body name="torso" pos="0 -1 0.5">
      <geom name="leg" class="obstacle" size="0.02 0.02 0.1" pos="0 0 0.1"/>
      <geom name="seat" class="seat" pos="0 0 0.21"/>
    </body>
    <geom name="lawn" size="0.1" pos="0 0 0.5"/>
  </worldbody>
</mujoco>
"""


def scene(inside: str = PLANE.format(height=0), model: str = "own") -> str:
    return f"<mujoco model='{model}'><worldbody>{inside}</worldbody></mujoco>"


def standing(simulator: Simulator, **start: float) -> mujoco.MjData:
    """The robot as a run puts it down."""
    data = mujoco.MjData(simulator.robot.model)
    data.qpos[:] = simulator.prepare(
        {f"start.{name}": value for name, value in start.items()}
    ).qpos[0]
    mujoco.mj_forward(simulator.robot.model, data)
    return data


# --- what a scene may be


def test_a_scene_without_sky_lights_and_colours_has_those_of_the_bundled_ones():
    """And one with its own keeps them; what the robot touches, and the text, are the same."""
    bare = load_robot(scene=scene()).model
    assert [bare.tex_type[i] for i in range(bare.ntex)].count(
        mujoco.mjtTexture.mjTEXTURE_SKYBOX
    ) == 1
    assert bare.nlight == load_robot().model.nlight
    assert bare.geom_matid[bare.geom("floor").id] >= 0
    custom_scene = """<mujoco><asset><texture name="sky" type="skybox" builtin="flat" rgb1="0 0 0" width="8" height="8"/></asset>
      <worldbody><light name="lamp" pos="0 0 2"/><geom name="floor" type="plane" size="0 0 0.1" rgba="1 0 0 1"/>
      </worldbody></mujoco>"""
    dressed = load_robot(scene=custom_scene).model
    assert dressed.nlight == 1
    assert [dressed.tex_type[i] for i in range(dressed.ntex)].count(
        mujoco.mjtTexture.mjTEXTURE_SKYBOX
    ) == 1
    np.testing.assert_allclose(dressed.geom_rgba[dressed.geom("floor").id], [1, 0, 0, 1])
    assert "nermo_sky" not in resolve_scene(scene())


def test_a_file_a_text_and_a_specification_are_one_scene(tmp_path, monkeypatch):
    """Setups are equal, have one hash, and survive a pickle; the file is found from where one stands."""
    (tmp_path / "yard.xml").write_text(YARD)
    monkeypatch.chdir(tmp_path)
    spec = mujoco.MjSpec.from_string(YARD)
    setups = [Setup(scene=scene) for scene in ("yard.xml", tmp_path / "yard.xml", YARD, spec)]
    assert len(set(setups)) == 1
    assert setups[0].load().fingerprint == load_robot(scene=spec).fingerprint
    assert pickle.loads(pickle.dumps(setups[0])) == setups[0]
    assert dataclasses.replace(setups[0], gait="lateral_walk").scene == setups[0].scene
    assert setups[0] != Setup(scene=YARD.replace("0.51", "0.52"))
    assert [geom.contype for geom in spec.geoms] == [1] * 5  # what was given is as it was


def test_only_ground_and_obstacles_touch_the_robot():
    """Classes decide, one inside of another, too; what stands on a body is fixed to the world, and names are given."""
    robot = load_robot(scene=YARD, tail="articulated")
    model = robot.model
    assert scene_geoms(robot.config.scene).ground == ("floor", "ground_0")
    assert {model.geom(i).name for i in robot.obstacles} == {"leg", "seat"}
    assert (
        model.nbody == load_robot(tail="articulated").model.nbody
    )  # the bench is called as the robot's torso
    np.testing.assert_allclose(model.geom("seat").pos, [0, -1, 0.71])
    touching = {model.geom(i).name for geoms in (model.pair_geom1, model.pair_geom2) for i in geoms}
    assert "lawn" not in touching
    assert {"floor", "ground_0", "leg", "seat", "torso_bumper"} < touching
    assert not model.geom_contype.any()


def test_a_warning_of_a_command_is_one_sentence(tmp_path):
    """Not the line of code that it comes from; also where several parts read the scene."""
    file = tmp_path / "scene.xml"
    file.write_text(scene().replace("<worldbody>", "<option solver='PGS'/><worldbody>"))
    errors = call("model", "--scene", file, "--json").stderr
    assert errors.count("its option has solver") == 1
    assert errors.startswith("nermo-mjx: scene is ")
    assert "Warning" not in errors
    assert ".py" not in errors


@pytest.mark.filterwarnings("ignore:scene is MJCF. its option has")
def test_settings_of_a_scene_do_not_reach_the_robot():
    """Its solver, steps and masses are its own; gravity is the scene's."""
    settings = (
        "<option gravity='0 0 -5' solver='PGS' iterations='3'/>"
        "<compiler boundmass='7' discardvisual='true' autolimits='false'/>"
    )
    custom, flat = (
        load_robot(scene=scene().replace("<worldbody>", f"{element}<worldbody>")).model
        for element in (settings, "<option gravity='0 0 -5'/>")
    )
    assert custom.opt.gravity[2] == -5
    assert custom.body_mass.sum() == flat.body_mass.sum() == load_robot().model.body_mass.sum()
    for option in ("solver", "iterations", "disableflags", "timestep"):
        assert (
            getattr(custom.opt, option)
            == getattr(flat.opt, option)
            == getattr(load_robot().model.opt, option)
        ), option
    assert custom.ngeom == flat.ngeom


def test_meshes_are_found_beside_the_file(tmp_path):
    """In the folder that the file names, from wherever the robot is built."""
    (tmp_path / "shapes").mkdir()
    (tmp_path / "shapes" / "wedge.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    text = scene(PLANE.format(height=0) + "<geom name='wedge' type='mesh' mesh='wedge'/>").replace(
        "<worldbody>",
        "<compiler meshdir='shapes'/><asset><mesh name='wedge' file='wedge.obj'/></asset><worldbody>",
    )
    (tmp_path / "own.xml").write_text(text)
    assert (
        load_robot(scene=tmp_path / "own.xml").model.geom("wedge").type
        == mujoco.mjtGeom.mjGEOM_MESH
    )


def test_what_a_text_becomes_is_read_as_itself():
    """Otherwise a directory would not recognise its own scene; even with rotations that MuJoCo rounds while writing."""
    turned = YARD.replace('pos="0 -1 0.5"', 'pos="0 -1 0.5" euler="0 0 33.3"')
    for text in (YARD, turned, scene()):
        assert resolve_scene(resolve_scene(text)) == resolve_scene(text)


WRONG = {
    "no name": (
        "yard",
        "scene is 'yard': allowed is 'balance_stand' or .* or the path of an MJCF file",
    ),
    "no file": ("yard.xml", "scene is 'yard.xml': there is no such file"),
    "no MJCF": (scene("<ball/>"), "MuJoCo refuses it: XML Error: .*'ball', line 1"),
    "no mesh": (
        scene().replace(
            "<worldbody>", "<asset><mesh name='m' file='gone.obj'/></asset><worldbody>"
        ),
        "gone.obj",
    ),
    "no ground": (
        scene("<geom size='1'/>"),
        "it has no ground: .* class 'ground', or the name 'floor'",
    ),
    "round ground": (
        scene("<geom name='floor' size='1'/>"),
        "the ground 'floor', a sphere; allowed is a plane, a box",
    ),
    "steep ground": (
        scene("<geom name='floor' type='plane' size='1 1 1' euler='90 0 0'/>"),
        "'floor', .* too steep",
    ),
    "a joint": (
        scene(PLANE.format(height=0) + "<body><joint name='hinge'/><geom size='1'/></body>"),
        "it has a joint 'hinge', and only the robot may",
    ),
    "mocap": (
        scene(PLANE.format(height=0) + "<body name='hand' mocap='true'><geom size='1'/></body>"),
        "it has a body 'hand' that moves",
    ),
    "a part's name": (
        scene(PLANE.format(height=0) + "<geom name='tail_tip' size='1'/>"),
        "beside the robot it has a repeated name 'tail_tip' in geom",
    ),
    "gravity": (
        scene().replace("<worldbody>", "<option gravity='0 0 1'/><worldbody>"),
        r"gravity with which ground\.slope is 3\.14159",
    ),
    "weightless": (
        scene().replace("<worldbody>", "<option gravity='0 0 -0.01'/><worldbody>"),
        r"ground\.gravity is 0\.01: allowed is \[0\.1, 30\]",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_scene_that_cannot_be_is_refused_in_a_sentence(case):
    """Before anything runs, with what is wrong in it."""
    wrong, message = WRONG[case]
    with pytest.raises(ParameterError, match=message) as error:
        Setup(scene=wrong)
    assert str(error.value).count("\n") == 0
    assert str(error.value).startswith("scene ")


# --- in a spec file


def test_a_sweep_finds_a_scene_beside_its_file_and_keeps_it(tmp_path):
    """The resolved file holds the scene itself, so that it reads back as the same sweep where the file is gone."""
    (tmp_path / "yard.xml").write_text(YARD)
    path = tmp_path / "sweep.yaml"
    path.write_text("scene: yard.xml\nvary: {frequency: [0.5, 0.8]}\nrun: {cycles: 3}\n")
    sweep = Sweep.from_file(path)
    assert sweep.setup == Setup(scene=YARD)
    (tmp_path / "yard.xml").unlink()
    reloaded = Sweep.from_text(sweep.to_yaml())
    assert (reloaded, reloaded.digest()) == (sweep, sweep.digest())
    (tmp_path / "yard.xml").write_text(YARD.replace("0.51", "0.52"))
    assert Sweep.from_file(path).digest() != sweep.digest()
    assert (
        Sweep.from_dict(
            {
                "scene": mujoco.MjSpec.from_string(YARD),
                "vary": {"frequency": [0.5, 0.8]},
                "run": {"cycles": 3},
            }
        ).digest()
        == sweep.digest()
    )


@pytest.mark.parametrize("wrong", ["gone.xml", "<mujoco/>", "flatt"])
def test_a_file_says_where_a_wrong_scene_stands(wrong):
    """With the line and the field."""
    with pytest.raises(SpecError, match=r"^s\.yaml:2: field 'scene' "):
        Sweep.from_text(
            f"gait: trot\nscene: {wrong!r}\nvary: {{frequency: [0.5, 0.8]}}\n", "s.yaml"
        )


# --- where the ground is


@pytest.mark.release
def test_the_robot_starts_on_what_is_beneath_it():
    """On the raised floor, and on the step: the deepest contact is as deep as on the flat, wherever it starts."""
    simulator = shared_simulator(Setup(scene=YARD), "c")
    for initial, height in (
        ({}, 0.5),
        ({"x": 1.0}, 0.52),
        ({"x": 1.0, "y": 0.03, "yaw": 2.0}, 0.52),
        ({"x": 2.0}, 0.5),
    ):
        data = standing(simulator, **initial)
        assert min(contact.dist for contact in data.contact) == pytest.approx(-DEPTH, abs=1e-6)
        feet = [data.site(f"{limb}_foot").xpos[2] for limb in LIMBS]
        assert min(feet) == pytest.approx(height, abs=0.01)


def test_a_foot_on_a_step_lifts_the_whole_robot():
    """With its left feet over the step no foot is inside of it: the highest ground decides."""
    data = standing(shared_simulator(Setup(scene=YARD), "c"), x=0.77)
    assert {data.contact[i].dist > -2 * DEPTH for i in range(data.ncon)} == {True}
    feet = {limb: data.site(f"{limb}_foot").xpos[2] for limb in LIMBS}
    assert min(feet["front_left"], feet["rear_left"]) == pytest.approx(0.52, abs=0.01)


@pytest.mark.release
def test_a_walk_half_a_metre_up_is_the_walk_on_the_flat(simulator):
    """Height above the ground counts, for falls, too."""
    values, run = {"frequency": np.array([0.5, 0.8])}, Run(cycles=2, warmup_cycles=1)
    up = Simulator(Setup(scene=scene(PLANE.format(height=0.5))), "c").run(values, run)
    flat = simulator().run(values, run)
    assert list(up.status) == ["ok", "ok"]
    for name in ("speed", "roll_std", "pitch_std", "servo_work", "duty_rear_left"):
        np.testing.assert_allclose(up.metrics[name], flat.metrics[name], rtol=1e-3, err_msg=name)


@pytest.mark.release
@pytest.mark.parametrize("height", [-1.0, 0.5])
def test_a_robot_that_lies_on_its_belly_has_fallen_at_any_height(height):
    """Released with its legs in the ground it may stand up or not; with its torso at the ground it has fallen at
    once."""
    sim = Simulator(Setup(scene=scene(PLANE.format(height=height))), "c")
    batch = sim.prepare({"frequency": np.full(2, 0.8)}, Run(cycles=2, warmup_cycles=0))
    batch.qpos[1, sim.robot.joints.root + 2] = height + 0.02
    session = sim.engine.open(batch.params, batch.qpos, batch.fields)
    session.advance(1)
    np.testing.assert_array_equal(session.loop_state.metrics.fell, [False, True])


@pytest.mark.release
def test_who_walks_off_an_edge_has_fallen():
    """A platform without a floor: beside it, lower than its foot is a fall."""
    plank = scene("<geom name='floor' type='box' size='0.3 0.2 0.1' pos='0 0 0.4'/>")
    result = Simulator(Setup(scene=plank), "c").run({"frequency": 0.8}, Run(duration=6.0))
    assert result.status[0] == "fell"
    assert 1.0 < result.metrics["failure_time"][0] < 6.0


# --- gravity, slope and friction


def test_the_defaults_of_the_ground_are_the_scenes_gravity():
    """On the moon, on a slope to the left: what is not named keeps it, and one that is named is turned about it."""
    moon, rise = 1.62, 0.1
    pull = f"{-moon * np.sin(rise)} 0 {-moon * np.cos(rise)}"
    text = scene().replace("<worldbody>", f"<option gravity='{pull}'/><worldbody>")
    defaults = Setup(scene=text).defaults()
    assert [
        defaults[f"ground.{name}"] for name in ("gravity", "slope", "direction")
    ] == pytest.approx([moon, rise, np.pi / 2], rel=1e-4)
    plain = Setup().defaults()
    assert [plain[f"ground.{name}"] for name in ("gravity", "slope", "direction")] == [
        9.81,
        0.0,
        0.0,
    ]
    sim = Simulator(Setup(scene=text), "c")
    (varied_gravity,) = sim.prepare({"ground.slope": rise}).fields["opt.gravity"]
    np.testing.assert_allclose(varied_gravity, sim.robot.model.opt.gravity, atol=1e-6)


@pytest.mark.release
def test_a_slope_takes_its_share_of_the_weight(simulator):
    """In steady walks the mean force on feet and tail is m g cos(slope), and the mass's; uphill the rear bears more."""
    values = {
        "frequency": 0.8,
        "ground.slope": np.array([0.0, 0.15, -0.15, 0.0]),
        "ground.gravity": np.array([9.81, 9.81, 9.81, 5.0]),
    }
    result = simulator().run(values, Run(cycles=6, warmup_cycles=2))
    assert list(result.status) == ["ok"] * 4
    metrics, mass = result.metrics, simulator().robot.model.body_mass.sum()
    load = sum(metrics[f"load_{limb}"] for limb in LIMBS) / (1.0 - metrics["tail_load_share"])
    np.testing.assert_allclose(
        load, mass * values["ground.gravity"] * np.cos(values["ground.slope"]), rtol=0.02
    )
    share, speed = metrics["front_load_share"], metrics["speed"]
    assert share[1] < share[0] < share[2]
    assert speed[1] < speed[0] < speed[2]
    weight = mass * values["ground.gravity"]
    np.testing.assert_allclose(
        metrics["cost_of_transport"],
        metrics["servo_work"] / weight / metrics["distance"],
        rtol=1e-5,
    )


@pytest.mark.parametrize(("direction", "axis"), [(0.0, 1), (np.pi / 2, 0)])
def test_a_slope_rises_in_its_direction(direction, axis):
    """Gravity pulls a robot with yaw 0 backward (+y) where it rises ahead, and to the right (-x) where to the left."""
    values = {"ground.slope": 0.2, "ground.direction": direction}
    (pull,) = shared_simulator(Setup(), "c").prepare(values).fields["opt.gravity"]
    expected = [0.0, 0.0, -9.81 * np.cos(0.2)]
    expected[axis] = 9.81 * np.sin(0.2) * (1 if axis else -1)
    np.testing.assert_allclose(pull, expected, atol=1e-12)
