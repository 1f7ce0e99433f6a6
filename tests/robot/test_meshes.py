# Tests of robot/meshes/body.py, robot/meshes/shapes.py, robot/parts.py
"""The visual body: meshes made from the robot's numbers, closed and small, that change nothing but the picture."""

from __future__ import annotations

import collections
import dataclasses
import runpy
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mujoco import mjx

from nermo_mjx.robot import LIMBS, assemble, assemble_leg, assemble_spine, load_robot
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.meshes.body import grooved_pulley, lower, upper
from nermo_mjx.robot.meshes.shapes import MM, TENDON_RADIUS
from nermo_mjx.robot.parameters import FRONT_LEG
from nermo_mjx.robot.parts import load_part, mjcf_directory, read_obj

FILES = sorted((mjcf_directory() / "meshes").glob("*.obj"))
VIEWS = ("track_side", "track_top", "track_three_quarter")


def standing(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def surface(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) of a mesh geom in the world [m], and its faces."""
    mesh = model.geom_dataid[geom]
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
    turn = data.geom_xmat[geom].reshape(3, 3)
    return model.mesh_vert[start : start + count] @ turn.T + data.geom_xpos[geom], faces


def meshes_of(model: mujoco.MjModel, body: str) -> dict[str, int]:
    """Geoms of a body that show a mesh, by the mesh's name."""
    geoms = np.flatnonzero((model.geom_bodyid == model.body(body).id) & (model.geom_dataid >= 0))
    return {model.mesh(int(model.geom_dataid[geom])).name: int(geom) for geom in geoms}


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, i]] - vertices.mean(axis=0) for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


# --- the files


def test_the_files_are_what_the_script_makes():
    """After a change: `python docs/meshes.py`."""
    texts = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "meshes.py"))["mesh_texts"]()
    assert {path.name for path in FILES} == set(texts)
    for path in FILES:
        assert path.read_bytes() == texts[path.name].encode("ascii"), path.name


def test_the_files_are_small_and_all_in_use():
    """315 kB in all; every file is named in the MJCF."""
    assert sum(path.stat().st_size for path in FILES) < 320_000
    mjcf = "".join(path.read_text() for path in mjcf_directory().glob("*.xml"))
    assert [path.name for path in FILES if f'file="{path.name}"' not in mjcf] == []


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_surface_is_closed_and_seen_from_outside(path):
    """Each edge is passed once in either direction, and the volume is positive: no holes, no faces inside out."""
    vertices, faces = read_obj(path)
    _, corner = np.unique(vertices, axis=0, return_inverse=True)
    edges: collections.Counter[tuple[int, int]] = collections.Counter()
    for face in corner.ravel()[faces].tolist():
        for start, end in zip(face, face[1:] + face[:1], strict=True):
            edges[start, end] += 1
            edges[end, start] -= 1
    assert not any(edges.values())
    assert volume(vertices, faces) > 0


# --- made from the robot's numbers


def test_a_longer_leg_gets_longer_links():
    """10 mm more in the table are 10 mm more in the mesh, between the same barrels."""
    longer = dataclasses.replace(FRONT_LEG, l1=FRONT_LEG.l1 + 0.010, l3=FRONT_LEG.l3 + 0.010)
    for link in (upper, lower):
        short, long = (link(leg, 1.0).vertices[:, 2] for leg in (FRONT_LEG, longer))
        assert long.min() == pytest.approx(short.min() - 10.0, abs=0.05)
        assert long.max() == pytest.approx(short.max(), abs=0.05)


def test_the_tendon_lies_in_the_pulleys_groove():
    """The groove's floor is the published radius less the tendon's; the rim stands above the tendon."""
    x, y, z = grooved_pulley(MM * FRONT_LEG.pulley_radius, 1.5).vertices.T
    radius, outer = np.hypot(y, z), np.abs(x) < 0.6
    floor = radius[outer & (radius > 5.0)].max()
    assert (
        MM * FRONT_LEG.pulley_radius - TENDON_RADIUS - 0.2
        < floor
        < MM * FRONT_LEG.pulley_radius - TENDON_RADIUS
    )
    assert radius.max() > MM * FRONT_LEG.pulley_radius + TENDON_RADIUS
    model = load_robot().model
    for limb in LIMBS:
        assert MM * model.tendon_width[model.tendon(f"{limb}_tendon").id] == pytest.approx(
            TENDON_RADIUS
        )


def test_each_bead_of_the_tail_is_as_wide_as_its_eyelets_and_reaches_to_the_next():
    """Bead by bead: the mesh spans from the joint to the next one, and its eyelets lie where the tendons run."""
    chain = load_part("tail", Geometry())
    for i in range(1, 19):
        mesh = chain.mesh(f"segment_{i}")
        x, y, _ = (np.reshape(mesh.uservert, (-1, 3)) * mesh.scale).T
        offset = chain.body(f"segment_{i + 1}").pos
        assert y.max() == pytest.approx(np.hypot(*offset[1:]) - 0.0004, abs=1e-4)
        assert x.max() - mesh.scale[0] == pytest.approx(chain.site(f"left_{i}").pos[0], abs=1e-4)


def test_the_spines_tendons_pass_the_vertebrae_at_their_eyelets():
    """Each of the 16 points that lead a tendon is within an eyelet's radius of its own vertebra's mesh."""
    model = assemble_spine().compile()
    data = standing(model)
    for i in range(8):
        body = model.site_bodyid[model.site(f"spine_left_{i}").id]
        geoms = np.flatnonzero((model.geom_bodyid == body) & (model.geom_dataid >= 0))
        points = np.concatenate([surface(model, data, int(geom))[0] for geom in geoms])
        for side in ("left", "right"):
            distances = np.linalg.norm(points - data.site(f"spine_{side}_{i}").xpos, axis=1)
            assert distances.min() < 0.0014, (side, i)


def test_servos_sit_where_their_joints_turn():
    """The output of each leg servo is on the axis that it turns, 4 mm inside the leg's plane."""
    model = load_robot().model
    data = standing(model)
    shafts = []
    for geom in (g for g in range(model.ngeom) if model.geom_dataid[g] >= 0):
        if model.mesh(int(model.geom_dataid[geom])).name.endswith("_servo"):
            # The frame of the file, before MuJoCo moved it into the mesh's axes of inertia.
            offset, turn, mesh = np.zeros(3), np.zeros(4), model.geom_dataid[geom]
            mujoco.mju_negPose(offset, turn, model.mesh_pos[mesh], model.mesh_quat[mesh])
            shafts.append(data.geom_xpos[geom] + data.geom_xmat[geom].reshape(3, 3) @ offset)
    for limb in LIMBS:
        for axis in (f"{limb}_hip", f"{limb}_pulley"):
            offset = np.array(shafts) - data.joint(axis).xanchor
            nearest = np.abs(offset[np.argmin(np.linalg.norm(offset, axis=1))])
            np.testing.assert_allclose(nearest, (0.0038, 0.0, 0.0), atol=1e-6, err_msg=axis)


def test_the_right_legs_meshes_are_mirror_images():
    """Vertex for vertex; and they are not turned inside out."""
    model = load_robot().model
    data = standing(model)
    for pair in ("front", "rear"):
        for part in ("pulley", "upper", "lower", "foot"):
            left, right = (meshes_of(model, f"{pair}_{side}_{part}") for side in ("left", "right"))
            assert len(left) == len(right) > 0
            for name, geom in left.items():
                (left_points, faces), (right_points, mirrored) = (
                    surface(model, data, g) for g in (geom, right[name.replace("left", "right")])
                )
                np.testing.assert_allclose(
                    right_points * [-1.0, 1.0, 1.0], left_points, atol=1e-7, err_msg=name
                )
                assert volume(left_points, faces) > 0
                assert volume(right_points, mirrored) > 0


# --- without effect, and complete


def test_what_is_only_seen_weighs_nothing_and_touches_nothing():
    """All meshes are in group 2, every geom of that group has mass 0, and none collides; on the test stands, too."""
    for spec in (assemble(), assemble_leg("rear_right"), assemble_spine()):
        visual_geoms = [geom for geom in spec.geoms if geom.group == 2]
        assert {geom.mass for geom in visual_geoms} == {0.0}
        assert not any(geom.contype or geom.conaffinity for geom in visual_geoms)
        model = spec.compile()
        assert model.nmesh > 0
        assert set(model.geom_group[model.geom_dataid >= 0].tolist()) == {2}


# --- cameras


@pytest.mark.parametrize("view", VIEWS)
def test_a_following_camera_keeps_the_whole_robot_in_view_and_does_not_turn_with_it(view):
    """After a metre's walk, turned left by half a turn, each part is still within a picture of 4 to 3."""
    model = load_robot().model
    data = standing(model)
    level = data.cam(view).xmat.copy()
    data.qpos[:3] += (0.3, -1.0, 0.0)
    data.qpos[3:7] = 0.0, 0.0, 0.0, 1.0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.cam(view).xmat, level, atol=1e-9)
    parts = data.geom_xpos[model.geom_bodyid > 0] - data.cam(view).xpos
    x, y, depth = (parts @ data.cam(view).xmat.reshape(3, 3) * [1.0, 1.0, -1.0]).T
    reach = np.tan(np.radians(model.cam(view).fovy[0]) / 2)
    assert depth.min() > 0.1
    assert np.abs(y / depth).max() < reach
    assert np.abs(x / depth).max() < reach * 4 / 3


def test_the_eyes_look_ahead_and_turn_with_the_head():
    """Along -y, a little down at most; panned by the neck."""
    robot = load_robot()
    data = standing(robot.model)
    ahead = -data.cam("eyes").xmat.reshape(3, 3)[:, 2]
    assert ahead @ (0.0, -1.0, 0.0) > 0.99
    data.qpos[robot.joints.neck] = 0.5
    mujoco.mj_forward(robot.model, data)
    assert -data.cam("eyes").xmat.reshape(3, 3)[:, 2] @ ahead == pytest.approx(
        np.cos(0.5), abs=0.01
    )


# --- light


def test_the_light_from_above_leaves_white_plastic_below_white():
    """Ambient light, headlight and both suns on a level face, seen from above: bright, not overexposed."""
    model = load_robot(scene="maze").model
    head = model.vis.headlight
    light = np.array(head.ambient) + np.array(head.diffuse)
    for diffuse, direction in zip(model.light_diffuse, model.light_dir, strict=True):
        light = light + diffuse * -direction[2] / np.linalg.norm(direction)
    colour = light * model.mat("torso_plastic").rgba[:3]
    assert colour.min() > 0.8
    assert colour.max() < 1.0


@pytest.mark.parametrize("tail", ["rigid", "articulated"])
def test_one_file_holds_the_meshes(tail, tmp_path, monkeypatch):
    """The written MJCF refers to no file, stays below 1 MB, and loads anywhere, in MuJoCo and in MJX."""
    robot = load_robot(tail=tail, scene="maze")
    text = robot.to_xml()
    assert "file=" not in text
    assert "meshdir" not in text
    assert len(text) < 1_000_000
    monkeypatch.chdir(tmp_path)
    loaded = mujoco.MjModel.from_xml_string(text)
    for count in ("nmesh", "nmeshvert", "nmeshface"):
        assert getattr(loaded, count) == getattr(robot.model, count)
    np.testing.assert_allclose(loaded.geom_pos, robot.model.geom_pos, atol=1e-6)
    assert mjx.put_model(loaded).nmesh == loaded.nmesh


@pytest.mark.parametrize("tail", ["rigid", "articulated"])
def test_the_motion_is_the_same_without_any_mesh(tail):
    """A robot stripped of all meshes before it is compiled moves to the bit like the whole one, and like `physical`."""
    robot = load_robot(tail=tail)
    bare = robot.spec.copy()
    for geom in [geom for geom in bare.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH]:
        bare.delete(geom)
    for mesh in list(bare.meshes):
        bare.delete(mesh)
    ends = []
    for model in (robot.model, bare.compile(), robot.physical):
        data, noise = mujoco.MjData(model), np.random.default_rng(3)
        for _ in range(300):
            data.ctrl[:] = noise.uniform(-0.4, 0.4, model.nu)
            mujoco.mj_step(model, data)
        ends.append(np.concatenate([data.qpos, data.qvel, data.sensordata]))
    assert robot.model.nmesh > 30
    assert robot.physical.nmesh == 0
    np.testing.assert_array_equal(ends[1], ends[0])
    np.testing.assert_array_equal(ends[2], ends[0])
