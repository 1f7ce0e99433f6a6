# Tests of robot/scene.py, mjcf/scenes
"""The scenes: courses where the protocols have them, and the maze, where no box is entered unnoticed."""

from __future__ import annotations

import copy
import functools

import mujoco
import numpy as np
import pytest
from fakes.published_maze import BOXES

from nermo_mjx.experiments.walks import maze_course
from nermo_mjx.robot import LIMBS, Robot, load_robot
from nermo_mjx.robot.parts import mjcf_directory
from nermo_mjx.robot.scene import scenes
from nermo_mjx.robot.terrains import TERRAINS

PUBLISHED = ("balance_stand", "flat", "maze", "quarter_circles", "straight_line")
SCENES = (*PUBLISHED, *TERRAINS)
#: A box that stands alone in its row, unturned: its middle.
LONELY = 19
#: How deep a visible part may be inside a box before something reports it [m]: the soft paw around the sole's sphere.
UNNOTICED = 0.002


@functools.cache
def scene(name: str, tail: str = "rigid") -> Robot:
    return load_robot(scene=name, tail=tail)


def standing(
    model: mujoco.MjModel, x: float = 0.0, y: float = 0.0, yaw: float = 0.0
) -> mujoco.MjData:
    """The robot in its stance, turned about the vertical at the spine base, a millimetre above the mat."""
    data = mujoco.MjData(model)
    data.qpos[:3] += x, y, 0.001
    data.qpos[3:7] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    mujoco.mj_forward(model, data)
    return data


def touched(robot: Robot, data: mujoco.MjData) -> set[str]:
    """Names of the robot's geoms in contact with an obstacle."""
    geoms = {
        int(g)
        for contact in data.contact
        for g in contact.geom
        if set(contact.geom) & set(robot.obstacles)
    }
    return {robot.model.geom(g).name for g in geoms - set(robot.obstacles)}


def middle(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Where a fixed geom is in the world (scene elements hang on the world)."""
    return model.geom(name).pos


def test_the_scenes_are_the_published_courses():
    """A common file is not a scene."""
    assert scenes() == SCENES


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_steps_and_looks_like_the_flat_one(name):
    """The floor is named, light, sky and mat are shared, nothing collides by type, and the robot weighs the same."""
    model, flat = scene(name).model, scene("flat").model
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 50)
    assert np.isfinite(data.qpos).all()
    assert model.geom("floor").type == mujoco.mjtGeom.mjGEOM_PLANE
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()
    assert model.body_subtreemass[0] == flat.body_subtreemass[0]
    np.testing.assert_array_equal(model.light_diffuse, flat.light_diffuse)
    np.testing.assert_array_equal(model.light_dir, flat.light_dir)
    for texture in ("sky", "mat"):
        start, address = flat.tex(texture).adr[0], model.tex(texture).adr[0]
        size = int(np.prod([flat.tex(texture).height[0], flat.tex(texture).width[0], 3]))
        np.testing.assert_array_equal(
            model.tex_data[address : address + size], flat.tex_data[start : start + size]
        )


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_stands_alone_as_one_file(name):
    """The MJCF that `model --xml` writes needs no included file, and gives the same model."""
    robot = scene(name)
    reloaded = mujoco.MjModel.from_xml_string(robot.to_xml())
    assert (reloaded.ngeom, reloaded.npair, reloaded.nq) == (
        robot.model.ngeom,
        robot.model.npair,
        robot.model.nq,
    )


@pytest.mark.parametrize("name", PUBLISHED)
def test_only_obstacles_add_contact_pairs_and_the_walk_in_the_open_is_the_same_to_the_bit(name):
    """300 steps from the stance; an open scene has the flat one's eight pairs and none of the geoms for obstacles."""
    robot, flat = scene(name), scene("flat")
    names = [robot.model.geom(i).name for i in range(robot.model.ngeom)]
    if name == "maze":
        assert len(robot.obstacles) == 40
    else:
        assert robot.obstacles == ()
        assert robot.model.npair == 8
        assert not any(geom.endswith("bumper") for geom in names)
    ends = []
    for model in (robot.model, flat.model):
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, 300)
        ends.append((data.qpos.copy(), data.sensordata.copy(), [c.dist for c in data.contact]))
    for free, obstructed in zip(*ends, strict=True):
        np.testing.assert_array_equal(free, obstructed)


def test_the_straight_line_is_two_metres_with_a_tick_every_half():
    model = scene("straight_line").model
    assert middle(model, "end")[1] == -2.0
    assert middle(model, "start")[1] == 0.0
    for i in range(3):
        for side in ("left", "right"):
            assert middle(model, f"tick_{side}_{i}")[1] == pytest.approx(-0.5 * (i + 1))
        assert (
            sum(model.geom(g).name.startswith(f"tick_{i + 1}_dot") for g in range(model.ngeom))
            == i + 1
        )
    lane = [middle(model, f"lane_{i:02}") for i in range(20)]
    np.testing.assert_allclose(np.array(lane)[:, 0], 0.0, atol=1e-12)
    assert all(-2.0 < y < 0.0 for _, y, _ in lane)


@pytest.mark.parametrize("radius", [1.0, 0.5])
@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_the_quarter_circles_leave_the_start_and_end_after_a_right_angle(side, sign, radius):
    """Dashes lie on the circle about (±R, 0), along it, from the start's heading to (±R, -R)."""
    model = scene("quarter_circles").model
    names = [model.geom(i).name for i in range(model.ngeom)]
    dashes = [name for name in names if name.startswith(f"{side}_{radius}_") and name[-1].isdigit()]
    offsets = np.array([middle(model, name) for name in dashes])[:, :2] - [sign * radius, 0.0]
    np.testing.assert_allclose(np.hypot(*offsets.T), radius, rtol=1e-9)
    angle = np.arctan2(-offsets[:, 1], -sign * offsets[:, 0])
    np.testing.assert_allclose(
        angle, (np.arange(len(dashes)) + 0.5) * np.pi / 2 / len(dashes), atol=1e-9
    )
    for name, out in zip(dashes, offsets, strict=True):
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, model.geom(name).quat)
        assert turned.reshape(3, 3)[:2, 1] @ out == pytest.approx(
            0.0, abs=1e-9
        )  # its long side is its y
    np.testing.assert_allclose(
        middle(model, f"{side}_{radius}_end")[:2], [sign * radius, -radius], atol=1e-9
    )


def test_the_mazes_boxes_are_the_published_ones():
    """All 40, in their order: middle, size and yaw (a square's, up to a right angle)."""
    robot = scene("maze")
    model = robot.model
    assert [model.geom(i).name for i in robot.obstacles] == [
        f"obstacle_{i:02}" for i in range(1, 41)
    ]
    for geom, (x, y, yaw) in zip(robot.obstacles, BOXES, strict=True):
        np.testing.assert_allclose(model.geom_pos[geom], [x, y, 0.05], atol=1e-9)
        np.testing.assert_allclose(model.geom_size[geom], 0.05)
        assert model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, model.geom_quat[geom])
        assert np.arctan2(turned[3], turned[0]) == pytest.approx(np.radians(yaw), abs=1e-6)
        assert turned[8] == pytest.approx(1.0)


def test_the_mazes_dots_lie_on_its_course():
    """Every 0.1 m of the path; when they do not, the lines that would are printed."""
    course = maze_course()
    distances = np.arange(1, int(course.length / 0.1) + 1) * 0.1
    samples = course.spacing * np.arange(len(course.x))
    lines = [
        f'    <geom name="path_{i:02}" class="dot" pos="{np.interp(s, samples, course.x):.3f} '
        f'{np.interp(s, samples, course.y):.3f} 0" size="0.008 0.0003" material="path"/>'
        for i, s in enumerate(distances, start=1)
    ]
    text = (mjcf_directory() / "scenes" / "common" / "maze_path.xml").read_text()
    lines_of_file = [line for line in text.splitlines() if "path_" in line]
    assert lines_of_file == lines, "\n".join(
        ["The dots of maze_path.xml for this course are:", *lines]
    )


def test_along_the_course_the_standing_robot_touches_no_box():
    """Every 5 cm of the path, headed along it; its outline keeps 8 cm from every box, the tip of its tail 4 cm."""
    robot, course = scene("maze"), maze_course()
    model = robot.model
    outline = {
        int(g) for geoms in zip(model.pair_geom1, model.pair_geom2, strict=True) for g in geoms
    }
    tail = model.geom("tail_tip").id
    outline -= {*robot.obstacles, model.geom("floor").id, tail}
    gaps, behind = [], []
    for node in range(0, len(course.x), 5):
        # A heading of -pi/2, along -y, is yaw 0.
        data = standing(model, course.x[node], course.y[node], course.heading[node] + np.pi / 2)
        assert not touched(robot, data)
        close = [
            box
            for box in robot.obstacles
            if np.linalg.norm(data.geom_xpos[box] - data.qpos[:3]) < 0.4
        ]
        gaps += [
            mujoco.mj_geomDistance(model, data, box, part, 1.0, None)
            for box in close
            for part in outline
        ]
        behind += [mujoco.mj_geomDistance(model, data, box, tail, 1.0, None) for box in close]
    assert min(gaps) > 0.08
    assert min(behind) > 0.04


@pytest.mark.parametrize("limb", LIMBS)
def test_a_foot_alone_in_a_box_touches_it_with_its_sole(limb):
    """Only the lifted foot's sole is inside: the sole and the box are in contact."""
    robot = scene("maze")
    sole = robot.model.geom(f"{limb}_sole").id
    data = standing(robot.model)
    shift = robot.model.geom_pos[robot.obstacles[LONELY]] - data.geom_xpos[sole]
    data = standing(robot.model, *shift[:2])
    assert f"{limb}_sole" in touched(robot, data)


@pytest.mark.parametrize("pose", ["stance", "stride"])
def test_whichever_way_a_box_comes_its_contact_is_reported_before_it_is_seen_inside(pose):
    """A box slides up to the robot from 24 sides, 13 places aside, face or edge first, to where the outline is touched.

    The tail is left out. In the stride, the spine is bent and the legs are swung.
    """
    robot = scene("maze", "articulated")
    model = copy.copy(robot.model)
    data = mujoco.MjData(model)
    if pose == "stride":
        data.qpos[list(robot.joints.hip)] += 0.3, -0.3, -0.3, 0.3
        data.qpos[list(robot.joints.spine)] += 0.1
    box = robot.obstacles[0]
    geom_pairs = np.stack([model.pair_geom1, model.pair_geom2], axis=1)
    outline = [int(g) for pair in geom_pairs if box in pair for g in pair if g != box]
    body = {g: model.body(model.geom_bodyid[g]).name for g in range(model.ngeom)}
    tail = [g for g in body if body[g].startswith("tail") or model.geom(g).name.startswith("tail")]
    visual_geoms = [g for g in body if model.geom_group[g] == 2 and g not in tail]

    def gap(geoms: list[int], position: np.ndarray) -> float:
        model.geom_pos[box, :2] = position
        mujoco.mj_kinematics(model, data)
        return min(mujoco.mj_geomDistance(model, data, box, g, 1.0, None) for g in geoms)

    met = 0
    for angle in np.radians(np.arange(0, 360, 15)):
        side = np.array([np.cos(angle), np.sin(angle)])
        for aside in np.linspace(-0.12, 0.12, 13):
            for yaw in (angle, angle + np.pi / 4):
                model.geom_quat[box] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
                position = (
                    np.array([0.0, -0.02]) + 0.35 * side + aside * np.array([-side[1], side[0]])
                )
                # A straight march by the free distance never steps over a contact.
                for _ in range(200):
                    free = gap(outline, position)
                    if free < 1e-4 or (position - [0.0, -0.02]) @ side < -0.1:
                        break
                    position = position - free * side
                if free < 1e-4:
                    met += 1
                    assert gap(visual_geoms, position) > -UNNOTICED
    assert met > 400


EXTREMITIES = {
    "nose": ("head", (0.0, -1.0)),
    "left shoulder": ("front_left_upper", (1.0, 0.0)),
    "right shoulder": ("front_right_upper", (-1.0, 0.0)),
    "left hip": ("rear_left_upper", (1.0, 0.0)),
    "right hip": ("rear_right_upper", (-1.0, 0.0)),
    "left knee": ("rear_left_lower", (1.0, 0.0)),
    **{limb.replace("_", " ") + " foot": (f"{limb}_foot", (0.0, -1.0)) for limb in LIMBS},
}


@pytest.mark.parametrize("part", EXTREMITIES)
def test_a_part_of_the_body_that_enters_a_box_is_noticed(part):
    """The part's farthest visible point is put 3 mm inside a box's face, as if the robot had come from outside."""
    robot = scene("maze")
    body, direction = EXTREMITIES[part]
    model, data = robot.model, standing(robot.model)
    visual_geoms = np.flatnonzero(
        (model.geom_bodyid == model.body(body).id) & (model.geom_group == 2)
    ).tolist()
    box = robot.obstacles[LONELY]
    # The distance to the part of this box, moved before it, tells how far the part reaches.
    side = np.array([*direction, 0.0])
    lateral = np.mean([data.geom_xpos[g] for g in visual_geoms], axis=0) * (1.0 - np.abs(side))
    shifted_model = copy.copy(model)
    shifted_model.geom_pos[box] = [*(lateral + 0.35 * side)[:2], 0.05]
    mujoco.mj_kinematics(shifted_model, data)
    gap = min(mujoco.mj_geomDistance(shifted_model, data, box, g, 1.0, None) for g in visual_geoms)
    shift = model.geom_pos[box] - shifted_model.geom_pos[box] + (gap + 0.003) * side
    data = standing(model, *shift[:2])
    assert min(
        mujoco.mj_geomDistance(model, data, box, g, 1.0, None) for g in visual_geoms
    ) == pytest.approx(-0.003, abs=5e-4)
    assert touched(robot, data)
    assert all(contact.dist < 0 for contact in data.contact if box in contact.geom)
