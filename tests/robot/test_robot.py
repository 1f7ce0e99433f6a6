# Tests of robot/robot.py, robot/masses.py, robot/assembly.py, robot/parameters.py
"""The assembled robot: masses, symmetry, geometry, contacts, sensors, against published numbers and the kinematics."""

from __future__ import annotations

import ast
import copy
import functools
import itertools
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

import nermo_mjx
from nermo_mjx.kinematics import body, leg, spine
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import (
    LIMBS,
    SERVOS,
    ModelParameters,
    ParameterError,
    Robot,
    RobotConfig,
    assemble,
    load_robot,
)
from nermo_mjx.robot.equipment import TRUNK_GEOMS, servo_joint
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.masses import (
    RIGID_PARTS,
    ROBOT_MASSES,
    TORSO,
    RigidPart,
    part_of,
    physical_model,
)
from nermo_mjx.robot.parameters import BODY_GEOMETRY, FRONT_LEG, REAR_LEG, ROUTINGS, LegGeometry
from nermo_mjx.robot.quantity import quantities, replace_quantities

#: The published robot.
ROBOT = Geometry()

TAILS = ("rigid", "articulated")
#: Neutral foot (y, z) of Table A.7, from the shoulder or hip axis.
STANCE_FOOT = {"front": (-0.005, -0.045), "rear": (0.0, -0.050)}
GEOMETRY = {"front": FRONT_LEG, "rear": REAR_LEG}
MIRROR = np.diag([-1.0, 1.0, 1.0])


def pair_of(limb: str) -> str:
    return limb.split("_")[0]


def other_side(name: str) -> str:
    """The name of the mirror image: left and right change places."""
    swap = {"left": "right", "right": "left"}
    return "_".join(swap.get(word, word) for word in name.split("_"))


def at_rest(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def random_pose(
    robot: Robot, rng: np.random.Generator
) -> tuple[mujoco.MjData, dict[str, np.ndarray]]:
    """The robot somewhere in the air, with random joint angles; all four spine joints share one angle."""
    data, joints = mujoco.MjData(robot.model), robot.joints
    angles = {
        "hip": rng.uniform(-1.5, 1.5, 4),
        "knee": rng.uniform(0.2, 2.8, 4),
        "ankle": rng.uniform(-0.4, 0.4, 4),
        "spine": rng.uniform(-0.15, 0.15, 1),
    }
    data.qpos[joints.root : joints.root + 3] = rng.uniform(-1.0, 1.0, 3)
    data.qpos[joints.root + 3 : joints.root + 7] = rng.normal(size=4)
    for name, values in angles.items():
        data.qpos[np.ravel(getattr(joints, name))] = values
    mujoco.mj_forward(robot.model, data)
    return data, angles


def solve(geometry: LegGeometry, foot: np.ndarray, routing: str) -> leg.LegSolution:
    """The leg's inverse kinematics in double precision, leaves in numpy."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, leg.inverse_kinematics(leg.leg_of(geometry), foot, routing))


def seen_from(data: mujoco.MjData, origin: np.ndarray, matrix: np.ndarray, site: str) -> np.ndarray:
    return matrix.reshape(3, 3).T @ (data.site(site).xpos - origin)


@functools.cache
def targets(n_servos: int, steps: int) -> np.ndarray:
    """Servo targets (steps, n_servos) that swing about the standing pose, differently in every servo."""
    stance = np.array([0.8165] * 2 + [-0.9712] * 2 + [0.1315] * 2 + [0.6623] * 2 + [0.0] * 3)[
        :n_servos
    ]
    amplitude, phase = np.random.default_rng(1).uniform((0.1, 0.0), (0.3, 6.0), (n_servos, 2)).T
    return stance + amplitude * (np.sin(0.05 * np.arange(steps)[:, None] + phase) - np.sin(phase))


def simulate(model: mujoco.MjModel, ctrl: np.ndarray) -> np.ndarray:
    """Positions (steps, nq) of a run from the zero pose."""
    data, rows = mujoco.MjData(model), []
    for row in ctrl:
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    assert data.ncon > 0
    return np.array(rows)


# --- masses


@pytest.mark.parametrize("tail", TAILS)
def test_total_mass_and_its_shares_are_the_stated_ones(tail):
    """270 g within 1 %, 62.8 % of it before the spine (errata 9, 19); the table of masses says the same."""
    robot = load_robot(tail=tail)
    total = float(robot.model.body_mass.sum())
    assert total == pytest.approx(0.270, rel=0.01)
    table = robot.mass_table()
    assert sum(row["mass"] for row in table) == pytest.approx(total)
    front = sum(row["mass"] for row in table if row["group"] == "front")
    # The author's compiled model, cut with two moving vertebrae in front: 212.2 g of 337.9 g.
    assert front / total == pytest.approx(212.2 / 337.9, abs=1e-3)
    assert robot.mass_model.front_mass == pytest.approx(front)
    assert robot.mass_model.rear_mass == pytest.approx(total - front)


def box_inertia(part: RigidPart) -> np.ndarray:
    """Inertia tensor (3, 3) of a uniform box about its centre, along its edges, m/12 (dy^2 + dz^2) and so on."""
    dx, dy, dz = 2.0 * np.array(part.half_size)
    return part.mass / 12.0 * np.diag([dy**2 + dz**2, dx**2 + dz**2, dx**2 + dy**2])


def test_compiled_masses_are_those_of_the_parts():
    """Every moving body has the mass, centre of mass and inertia of its part; every part is used.

    The inertia is compared as a tensor in the frame of the part, so that exchanged axes are found.
    """
    model = load_robot(tail="articulated").model
    data, part_keys = at_rest(model), set()
    for name in (model.body(i).name for i in range(1, model.nbody)):
        part, compiled = part_of(name), model.body(name)
        part_keys.add(next(key for key, value in RIGID_PARTS.items() if value is part))
        assert compiled.mass[0] == pytest.approx(part.mass, rel=1e-12), name
        frame = data.body(name).xmat if part.site is None else data.site("spine_end").xmat
        axes = frame.reshape(3, 3).T @ data.body(name).ximat.reshape(3, 3)
        tensor = axes @ np.diag(compiled.inertia) @ axes.T
        np.testing.assert_allclose(
            tensor, box_inertia(part), rtol=0, atol=1e-9 * np.trace(tensor), err_msg=name
        )
        if part.site is None:
            np.testing.assert_allclose(compiled.ipos, part.com, atol=1e-12, err_msg=name)
    front_pulley = {
        name for name in RIGID_PARTS if RIGID_PARTS[name] is RIGID_PARTS["front_pulley"]
    }
    assert part_keys | front_pulley == set(RIGID_PARTS)
    end = data.site("spine_end")
    hip = end.xmat.reshape(3, 3).T @ (data.body("spine_hip").xipos - end.xpos)
    np.testing.assert_allclose(hip, part_of("spine_hip").com, atol=1e-9)


def test_rigid_tail_has_the_mass_and_centre_of_the_articulated_one():
    """Freezing the tail's 19 joints changes neither mass nor centre of mass, nor the inertia of the whole."""
    rigid, articulated = (load_robot(tail=tail).model for tail in TAILS)
    fused = [row["mass"] for row in load_robot().mass_table() if row["body"] == "spine_hip"]
    tail = RIGID_PARTS["tail_pulley"].mass + 19 * RIGID_PARTS["tail_segment"].mass
    assert fused == pytest.approx([RIGID_PARTS["spine_hip"].mass + tail])
    data = [at_rest(model) for model in (rigid, articulated)]
    assert rigid.body_mass.sum() == pytest.approx(articulated.body_mass.sum(), rel=1e-12)
    np.testing.assert_allclose(data[0].subtree_com[0], data[1].subtree_com[0], atol=1e-12)
    matrices = []
    for model, state in zip((rigid, articulated), data, strict=True):
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, state, full)
        matrices.append(full[:6, :6])
    np.testing.assert_allclose(matrices[0], matrices[1], rtol=1e-9, atol=1e-12)


def test_centres_of_mass_are_those_of_the_compiled_model():
    """Front from the spine base, rear from the spine end, and the whole, as in the author's compiled model (erratum 19).

    In the stance of Table A.7, the author's rear is at (131.92, 3.66) mm behind and above the shoulders, where the spine
    end of Table 5.3 is at (113.17, 16.99); his whole is at (66.12, 6.20). His rear legs are mounted up to 0.55 mm apart.
    """
    masses = load_robot().mass_model
    np.testing.assert_allclose(masses.front_com, (0.0, -0.03434, -0.02472), atol=1e-4)
    np.testing.assert_allclose(masses.rear_com, (0.0, 0.01875, -0.01333), atol=1.5e-4)
    data = at_rest(load_robot().model)
    common = data.subtree_com[0] - data.body("torso").xpos
    np.testing.assert_allclose(common, body.centre_of_mass(masses, 0.0, ROBOT), atol=1e-6)
    np.testing.assert_allclose(common, (0.0, 0.0046, -0.0262), atol=2e-4)


# --- the tail


#: Joints of the author's tail (tail_assets/tail.xml at 736e7ec, compiled), backward and up from the point between the
#: shoulders, in the torso's frame [mm]. The tip is at (317.54, -29.52).
TAIL_JOINTS = (
    (168.25, -4.88),
    (176.25, -7.62),
    (184.26, -10.15),
    (192.26, -12.59),
    (200.27, -14.82),
    (208.27, -16.91),
    (216.27, -18.85),
    (224.28, -20.63),
    (232.28, -22.27),
    (240.28, -23.75),
    (248.28, -25.09),
    (256.29, -26.28),
    (264.29, -27.31),
    (272.29, -28.2),
    (280.29, -28.93),
    (288.29, -29.52),
    (296.29, -29.96),
    (304.29, -30.24),
    (312.29, -30.53),
)


@pytest.mark.parametrize("tail", TAILS)
def test_the_tail_hangs_as_the_authors(tail):
    """All joints and the tip within 0.05 mm in the torso's frame; axes vertical."""
    model = load_robot(tail=tail).model
    data = at_rest(model)
    torso = data.body("torso").xmat.reshape(3, 3)
    shoulders = np.mean(
        [data.body(f"front_{side}_upper").xpos for side in ("left", "right")], axis=0
    )
    tip = 1e3 * (data.geom("tail_tip").xpos - shoulders) @ torso
    assert tip == pytest.approx([0.0, 317.54, -29.52], abs=0.05)
    assert model.geom("tail_tip").size[0] == 0.0037
    if tail == "articulated":
        for number, place in enumerate(TAIL_JOINTS, 1):
            joint = data.joint(f"tail_joint_{number}")
            offset = 1e3 * (joint.xanchor - shoulders) @ torso
            assert offset == pytest.approx([0.0, *place], abs=0.05)
            assert joint.xaxis == pytest.approx([0.0, 0.0, -1.0], abs=5e-3)


@pytest.mark.parametrize("tail", TAILS)
@pytest.mark.parametrize("physics", ["reference", "fast"])
def test_the_tails_tip_touches_when_the_robot_tips_back(tail, physics):
    """Not while it stands; at a pitch of 2.6 degrees nose up in the author's model, here within half a degree."""
    model = load_robot(tail=tail, physics=physics).model
    data = at_rest(model)
    turned = {}
    for degrees in np.arange(0.0, 5.0, 0.05):
        # Nose up about the front feet: the hip sinks, as in the walk.
        angle = -np.radians(degrees)
        data.qpos[:] = model.qpos0
        data.qpos[3:7] = np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0
        mujoco.mj_kinematics(model, data)
        data.qpos[2] += 0.0015 - data.geom("front_left_sole").xpos[2]
        mujoco.mj_forward(model, data)
        touching = {model.geom(int(g)).name for contact in data.contact for g in contact.geom}
        turned[degrees] = "tail_tip" in touching
    first = min(degrees for degrees, touches in turned.items() if touches)
    assert first == pytest.approx(2.6, abs=0.5)


def test_the_force_on_the_tail_is_sensed():
    """A robot put down on its tail: the reading is the sum of the normal forces of the tail's contacts."""
    for tail in TAILS:
        robot = load_robot(tail=tail)
        model, data = robot.model, mujoco.MjData(robot.model)
        data.qpos[3:7] = np.cos(-0.05), np.sin(-0.05), 0.0, 0.0
        mujoco.mj_kinematics(model, data)
        data.qpos[2] += 0.0025 - data.geom("tail_tip").xpos[2]  # 1.2 mm deep
        mujoco.mj_forward(model, data)
        force, total = np.zeros(6), 0.0
        for i, contact in enumerate(data.contact):
            if any(model.geom(int(g)).name.startswith("tail_") for g in contact.geom):
                mujoco.mj_contactForce(model, data, i, force)
                total += force[0]
        assert total > 0.01
        assert float(robot.sensors(data.sensordata).tail_force) == pytest.approx(total, rel=1e-6)


# --- structure


@pytest.mark.parametrize(
    ("robot", "tail", "missing"),
    [
        ("nermo_lite", "rigid", ("tail", "spine_vertical", "head")),
        ("nermo_lite", "articulated", ("spine_vertical", "head")),
        ("nermo_41", "rigid", ("tail",)),
        ("nermo_41", "articulated", ()),
    ],
)
def test_actuators_are_the_servos_in_their_order(robot, tail, missing):
    """`ctrl` is in the order of `SERVOS`, each on the joint it turns; the tail's servo comes with the tail."""
    model = load_robot(robot, tail=tail).model
    servos = [servo for servo in SERVOS if servo not in missing]
    assert [model.actuator(i).name for i in range(model.nu)] == [
        f"{servo}_servo" for servo in servos
    ]
    for i, servo in enumerate(servos):
        assert model.joint(model.actuator_trnid[i, 0]).name == servo_joint(servo)


@pytest.mark.parametrize("tail", TAILS)
def test_left_and_right_mirror_each_other(tail):
    """Mass centres, inertia tensors, joints, sites, geoms and tendons of the right are mirror images of the left."""
    model = load_robot(tail=tail).model
    data = at_rest(model)

    def tensor(name):
        turn = data.body(name).ximat.reshape(3, 3)
        return turn @ np.diag(model.body(name).inertia) @ turn.T

    for name in (model.body(i).name for i in range(1, model.nbody)):
        image = other_side(name)
        assert model.body(image).mass[0] == pytest.approx(model.body(name).mass[0], rel=1e-12)
        np.testing.assert_allclose(
            data.body(image).xipos, MIRROR @ data.body(name).xipos, atol=1e-12, err_msg=name
        )
        np.testing.assert_allclose(
            tensor(image), MIRROR @ tensor(name) @ MIRROR, atol=1e-15, err_msg=name
        )
    for joint in (model.joint(i).name for i in range(1, model.njnt)):
        left, right = data.joint(joint), data.joint(other_side(joint))
        np.testing.assert_allclose(right.xanchor, MIRROR @ left.xanchor, atol=1e-12, err_msg=joint)
        # Limbs hinge about x on both sides, with one sign convention; the axes of all others lie in the mirror plane.
        if joint == other_side(joint):
            assert left.xaxis[0] == pytest.approx(0.0, abs=1e-12), joint
        else:
            np.testing.assert_allclose(np.abs(left.xaxis), (1, 0, 0), atol=1e-12, err_msg=joint)
            np.testing.assert_allclose(right.xaxis, left.xaxis, atol=1e-12, err_msg=joint)
        for field in ("stiffness", "damping", "armature", "range", "qpos0", "qpos_spring"):
            values = (
                getattr(model.joint(joint), field),
                getattr(model.joint(other_side(joint)), field),
            )
            np.testing.assert_array_equal(*values, err_msg=f"{joint} {field}")
    for site in (model.site(i).name for i in range(model.nsite)):
        np.testing.assert_allclose(
            data.site(other_side(site)).xpos, MIRROR @ data.site(site).xpos, atol=1e-12
        )
    for tendon in (model.tendon(i).name for i in range(model.ntendon)):
        ids = model.tendon(tendon).id, model.tendon(other_side(tendon)).id
        assert model.tendon_range[ids[0], 1] == model.tendon_range[ids[1], 1]


def test_mirrored_commands_give_the_mirrored_motion():
    """300 steps on the mat with left and right exchanged end in the mirror image."""
    robot = load_robot()
    ctrl = targets(robot.n_servos, 300)
    image = ctrl[:, [1, 0, 3, 2, 5, 4, 7, 6, 8, 9]] * ([1] * 8 + [-1] * 2)
    original, mirrored = simulate(robot.model, ctrl), simulate(robot.model, image)
    np.testing.assert_allclose(mirrored[:, 0], -original[:, 0], atol=1e-9)
    np.testing.assert_allclose(mirrored[:, 1:3], original[:, 1:3], atol=1e-9)
    np.testing.assert_allclose(mirrored[:, 3:7], original[:, 3:7] * [1, 1, -1, -1], atol=1e-9)
    assert np.ptp(original[:, 0]) > 1e-3  # something happened that could differ


@pytest.mark.parametrize("tail", TAILS)
def test_nothing_touches_but_the_declared_pairs(tail):
    """No two geoms collide by type; the pairs are floor against soles, tail, and the trunk's three spheres.

    Of the articulated tail the three segments before the tip may touch, too.
    """
    model = load_robot(tail=tail).model
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()
    geom_pairs = np.stack([model.pair_geom1, model.pair_geom2], axis=1)
    pairs = {frozenset(model.geom(int(geom)).name for geom in pair) for pair in geom_pairs}
    touching = ["tail_tip", *(f"tail_ground_{i}" for i in (16, 17, 18) if tail == "articulated")]
    touching += [*(f"{limb}_sole" for limb in LIMBS), *TRUNK_GEOMS]
    assert pairs == {frozenset(("floor", part)) for part in touching}
    assert model.npair == len(touching)
    assert model.nv == {"rigid": 28, "articulated": 48}[tail]
    # Robot lying on its side, folded: only declared pairs report contacts.
    data = mujoco.MjData(model)
    data.qpos[2:7] = 0.01, np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0
    mujoco.mj_forward(model, data)
    contact_pairs = {
        frozenset(model.geom(int(g)).name for g in contact.geom) for contact in data.contact
    }
    assert contact_pairs
    assert contact_pairs <= pairs


# --- pose and geometry


@pytest.mark.parametrize("routing", ROUTINGS)
def test_zero_pose_is_the_published_stance(routing):
    """In the model's zero pose the feet stand as Table A.7 says to 0.2 mm, and every tendon is just taut."""
    robot = load_robot(routing=routing)
    data, joints = at_rest(robot.model), robot.joints
    for i, limb in enumerate(LIMBS):
        expected = np.array(STANCE_FOOT[pair_of(limb)])
        solution = solve(GEOMETRY[pair_of(limb)], expected, routing)
        foot = data.site(f"{limb}_foot").xpos - data.site(f"{limb}_axis").xpos
        np.testing.assert_allclose(foot[1:], expected, atol=2e-4)
        qpos = robot.model.qpos0
        pose = qpos[joints.hip[i]], qpos[joints.knee[i]], qpos[joints.pulley[i]]
        np.testing.assert_allclose(
            pose, (solution.servo[0], solution.knee_angle, solution.servo[1]), atol=1e-3
        )
    np.testing.assert_allclose(data.ten_length, robot.model.tendon_range[:, 1], atol=5e-6)
    assert (robot.model.qpos0[list(joints.spine)] == 0.0).all()


def test_zero_pose_stands_on_the_front_feet():
    """With a level torso, Table A.7 puts the front soles on the mat within 0.2 mm, the rear ones 2.1 mm above it.

    Without a load: the soft balls of 3.8 mm then yield, and the torso comes down by what they are larger than 2 mm.
    """
    model = load_robot().model
    data = at_rest(model)
    assert data.body("torso").xpos[2] == pytest.approx(0.0774 + 0.0038)
    clearance = [
        data.geom(f"{limb}_sole").xpos[2] - model.geom(f"{limb}_sole").size[0] for limb in LIMBS
    ]
    # From Tables A.5 and A.7: (hip - shoulder) - (rear - front leg) = 7.1 mm - 5.0 mm.
    np.testing.assert_allclose(clearance, [0.0, 0.0, 0.0021, 0.0021], atol=2e-4)


def test_hips_and_shoulders_are_where_the_kinematics_puts_them():
    """Spine end, hip and shoulder axes equal `transform`, `hips` and `shoulders` to a micrometre, bent or straight."""
    robot, rng = load_robot(), np.random.default_rng(2)
    for _ in range(10):
        data, angles = random_pose(robot, rng)
        torso = data.body("torso")
        axes = np.array([seen_from(data, torso.xpos, torso.xmat, f"{limb}_axis") for limb in LIMBS])
        with jax.enable_x64(True):
            pose, hips = (
                spine.transform(angles["spine"][0], ROBOT),
                body.hips(angles["spine"][0], ROBOT),
            )
        np.testing.assert_allclose(axes[:2], body.shoulders(ROBOT), atol=1e-6)
        np.testing.assert_allclose(axes[2:], hips, atol=1e-6)
        np.testing.assert_allclose(
            seen_from(data, torso.xpos, torso.xmat, "spine_end"), pose[:3, 3], atol=1e-6
        )
        turn = torso.xmat.reshape(3, 3).T @ data.site("spine_end").xmat.reshape(3, 3)
        np.testing.assert_allclose(turn, pose[:3, :3], atol=1e-6)
    np.testing.assert_allclose(body.shoulders(ROBOT)[0], BODY_GEOMETRY.shoulder, atol=1e-7)


def test_legs_are_where_the_kinematics_puts_them():
    """Foot, attachment and knee of all four limbs equal `points` to a micrometre at random joint angles."""
    robot, rng = load_robot(), np.random.default_rng(3)
    for _ in range(10):
        data, angles = random_pose(robot, rng)
        for i, limb in enumerate(LIMBS):
            trunk = (
                data.body("torso").xmat if limb.startswith("front") else data.site("spine_end").xmat
            )
            axis = data.site(f"{limb}_axis").xpos
            with jax.enable_x64(True):
                geometry = leg.leg_of(GEOMETRY[pair_of(limb)])
                expected = leg.points(
                    geometry, angles["hip"][i], angles["knee"][i], angles["ankle"][i]
                )
            for point in ("foot", "attachment"):
                position = seen_from(data, axis, trunk, f"{limb}_{point}")
                np.testing.assert_allclose(
                    position, [0.0, *getattr(expected, point)], atol=1e-6, err_msg=f"{limb} {point}"
                )
            for point, name in (("knee", "lower"), ("ankle", "foot")):
                position = trunk.reshape(3, 3).T @ (data.body(f"{limb}_{name}").xpos - axis)
                np.testing.assert_allclose(
                    position, [0.0, *getattr(expected, point)], atol=1e-6, err_msg=f"{limb} {point}"
                )
            sole = data.geom(f"{limb}_sole").xpos
            np.testing.assert_allclose(sole, data.site(f"{limb}_foot").xpos, atol=1e-12)


@pytest.mark.parametrize("routing", ROUTINGS)
def test_leg_tendons_follow_the_published_law(routing):
    """Length and limit differ by l_t - (l_t0 + r_p (theta_2 + k q2)) within a micrometre, over the feet of a gait.

    This guards the installed MuJoCo too: mujoco 4.0.0 treats side sites differently and moves lengths by centimetres.
    """
    robot = load_robot(routing=routing)
    data, joints, limits = mujoco.MjData(robot.model), robot.joints, robot.model.tendon_range[:, 1]
    rng = np.random.default_rng(4)
    for y, z, off in itertools.product((-0.03, 0.0, 0.03), (-0.003, 0.0, 0.01), (-0.15, 0.0, 0.15)):
        data.qpos[:] = robot.model.qpos0
        excess = {}
        for i, limb in enumerate(LIMBS):
            geometry = GEOMETRY[pair_of(limb)]
            foot = np.add(STANCE_FOOT[pair_of(limb)], (y, z + rng.uniform(-0.001, 0.001)))
            solution = solve(geometry, foot, routing)
            assert solution.reachable
            data.qpos[joints.hip[i]], data.qpos[joints.knee[i]] = (
                solution.servo[0],
                solution.knee_angle,
            )
            data.qpos[joints.pulley[i]] = solution.servo[1] + off
            excess[f"{limb}_tendon"] = -geometry.pulley_radius * geometry.servo_direction * off
        mujoco.mj_kinematics(robot.model, data)
        mujoco.mj_comPos(robot.model, data)
        mujoco.mj_tendon(robot.model, data)
        for name, expected in excess.items():
            tendon = robot.model.tendon(name).id
            assert data.ten_length[tendon] - limits[tendon] == pytest.approx(expected, abs=1e-6), (
                name,
                y,
                z,
                off,
            )


def test_tendon_lengths_of_the_stance_are_known():
    """In the standing pose the tendons are as long as the arc, the tangent and l_t of Table A.4 make them."""
    model = load_robot().model
    lengths = dict(
        zip(
            [model.tendon(i).name for i in range(model.ntendon)],
            at_rest(model).ten_length,
            strict=True,
        )
    )
    for pair, geometry in GEOMETRY.items():
        solution = solve(geometry, np.array(STANCE_FOOT[pair]), "type3")
        attachment = np.asarray(
            leg.points(leg.leg_of(geometry), solution.servo[0], solution.knee_angle).attachment
        )
        # From the tie point, a hair outside the rim, over the knee's side to the tangent towards the hip axis.
        radius, side = geometry.pulley_radius, geometry.knee_direction
        _, y, z = model.site(f"{pair}_left_rim").pos
        tie = np.arctan2(z, side * y) + side * float(solution.servo[1])
        wrap = tie - np.arccos(radius / np.hypot(y, z)) + np.arcsin(radius / geometry.pulley_height)
        tangents = np.sqrt(y**2 + z**2 - radius**2) + np.sqrt(geometry.pulley_height**2 - radius**2)
        expected = radius * wrap + tangents + np.hypot(*attachment)
        assert lengths[f"{pair}_left_tendon"] == pytest.approx(float(expected), abs=2e-6)
    assert lengths["front_left_tendon"] == pytest.approx(0.058448, abs=2e-6)
    assert lengths["rear_left_tendon"] == pytest.approx(0.054375, abs=2e-6)
    assert lengths["spine_left"] == pytest.approx(0.071334, abs=2e-6)


# --- files, names, sensors


@pytest.mark.parametrize("tail", TAILS)
def test_exported_xml_is_self_contained_and_the_same_model(tail):
    """`to_xml` names no file, keeps every order, and gives the same 100 steps: to a millimetre and a milliradian.

    It prints six digits; contacts and stiff tendons amplify the rest to some 1e-4.
    """
    robot = load_robot(tail=tail)
    xml = robot.to_xml()
    assert "file=" not in xml
    assert "<include" not in xml
    assert len(xml) < 1_000_000
    copy = mujoco.MjModel.from_xml_string(xml)
    assert (
        copy.names == robot.model.names
    )  # of bodies, joints, sensors and all the rest, in their order
    for field in (
        "body_mass",
        "body_inertia",
        "body_ipos",
        "jnt_stiffness",
        "dof_damping",
        "dof_armature",
        "qpos_spring",
        "tendon_range",
        "tendon_solref_lim",
        "tendon_solimp_lim",
        "pair_friction",
        "pair_solref",
        "pair_solimp",
        "actuator_gainprm",
        "actuator_biasprm",
        "actuator_ctrlrange",
        "actuator_forcerange",
    ):
        values = getattr(copy, field), getattr(robot.model, field)
        np.testing.assert_allclose(*values, rtol=1e-5, atol=1e-8, err_msg=field)
    for option in ("timestep", "integrator", "cone", "impratio", "disableflags"):
        assert getattr(copy.opt, option) == getattr(robot.model.opt, option), option
    ctrl = targets(robot.n_servos, 100)
    np.testing.assert_allclose(simulate(copy, ctrl), simulate(robot.model, ctrl), atol=1e-3)


@pytest.mark.parametrize("tail", TAILS)
def test_sensors_are_read_by_meaning(tail):
    """Every reading of `Sensors` is that of the MuJoCo sensors with its name, with and without a batch."""
    robot = load_robot(tail=tail)
    model, data = robot.model, mujoco.MjData(robot.model)
    for row in targets(robot.n_servos, 60):
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
    reading = robot.sensors(np.stack([data.sensordata, 2 * data.sensordata]))
    single = robot.sensors(data.sensordata)
    servos = [model.actuator(i).name for i in range(model.nu)]
    expected = {
        name: [name]
        for name in ("position", "orientation", "linear_velocity", "gyro", "accelerometer")
    }
    expected |= {
        f"servo_{quantity}": [f"{servo}_{quantity}" for servo in servos]
        for quantity in ("angle", "velocity", "torque")
    }
    for quantity in ("knee_angle", "foot_force", "foot_position", "foot_velocity"):
        expected[quantity] = [f"{limb}_{quantity}" for limb in LIMBS]
    for name, sources in expected.items():
        readings = np.concatenate([data.sensor(source).data for source in sources])
        got = np.asarray(getattr(single, name))
        np.testing.assert_allclose(got.ravel(), readings, rtol=1e-6, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(
            getattr(reading, name), [got, 2 * got], rtol=1e-6, atol=1e-6, err_msg=name
        )
    assert np.asarray(single.foot_position).shape == (4, 3)
    assert np.asarray(single.foot_force).max() > 0.1
    # The sensors' quantities are those of the state.
    mujoco.mj_forward(model, data)
    fresh = robot.sensors(data.sensordata)
    np.testing.assert_allclose(fresh.knee_angle, data.qpos[np.ravel(robot.joints.knee)], atol=1e-6)
    hips = np.asarray(fresh.servo_angle)[:4]
    np.testing.assert_allclose(hips, data.qpos[list(robot.joints.hip)], atol=1e-6)
    feet = [data.site(f"{limb}_foot").xpos for limb in LIMBS]
    np.testing.assert_allclose(fresh.foot_position, feet, atol=1e-6)


def test_a_diverged_world_stays_diverged():
    """Automatic reset is off: a state that is not finite stays so, to be flagged."""
    model = load_robot().model
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data = mujoco.MjData(model)
    data.qvel[0] = np.nan
    for _ in range(5):
        mujoco.mj_step(model, data)
    assert not np.isfinite(data.qvel).all()


def test_a_change_of_one_robot_reaches_no_other():
    """Each caller has models and a specification of its own, though they are compiled once."""
    ours, fingerprint = load_robot(), load_robot().fingerprint
    ours.model.body_mass[:] = 7.0
    ours.physical.body_mass[:] = 7.0
    ours.spec.body("torso").name = "spoiled"
    unchanged = load_robot(tail="rigid")
    assert unchanged.model.body_mass.max() < 1.0
    assert unchanged.physical.body_mass.max() < 1.0
    assert unchanged.spec.body("spoiled") is None
    assert (
        unchanged.fingerprint
        == ours.fingerprint
        == fingerprint
        != load_robot(tail="articulated").fingerprint
    )
    with pytest.raises(ValueError, match="read-only"):
        unchanged.mass_model.front_com[0] = 7.0


def test_defaults_cannot_be_written():
    """They are shared by all parameter trees."""
    with pytest.raises(ValueError, match="read-only"):
        ModelParameters().servo.kp[...] = 7.0


def test_no_mass_and_no_number_of_a_servo_stands_twice():
    """Defaults of masses and servos, and masses of parts, with three digits or more, are written once in the source."""
    allowed = {
        quantity.default
        for name, quantity in quantities(ModelParameters)
        if name.startswith(("mass.", "servo."))
    }
    allowed |= {part.mass for part in RIGID_PARTS.values()} | {
        mass for masses in ROBOT_MASSES.values() for mass in masses
    }
    allowed = {
        value
        for value in allowed
        if len(f"{value:e}".split("e")[0].replace(".", "").rstrip("0")) >= 3
    }
    assert {0.157, 0.1695, 0.1005, TORSO.mass} <= allowed
    package = Path(nermo_mjx.__file__).parent
    literals = [
        (node.value, path.name)
        for folder in (
            "robot",
            "kinematics",
            "control",
            "physics",
            "dynamics",
            "rollout",
            "experiments",
        )
        for path in sorted((package / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant)
        and isinstance(node.value, float)
        and node.value in allowed
    ]
    assert sorted(value for value, _ in literals) == sorted(allowed), literals


def test_a_robot_is_loaded_from_its_config():
    """As from the same fields by name; beside other arguments it is refused, instead of one of them being ignored."""
    config = RobotConfig(tail="articulated", physics="fast")
    assert (
        load_robot(config).config == load_robot(tail="articulated", physics="fast").config == config
    )
    with pytest.raises(ParameterError, match="robot is a RobotConfig beside other arguments"):
        load_robot(config, hinges=2)


def test_the_servo_of_the_spine_has_a_torque_limit_of_its_own():
    parameters = replace_quantities(
        ModelParameters(), {"servo.torque_limit": 0.4, "servo.spine_torque": 0.25}
    )
    model = assemble(parameters=parameters).compile()
    limits = {model.actuator(i).name: model.actuator(i).forcerange[1] for i in range(model.nu)}
    assert limits.pop("spine_servo") == pytest.approx(0.1)
    assert set(limits.values()) == {0.4}
    varied = compile_model(load_robot(), {"servo.torque_limit": 0.4, "servo.spine_torque": 0.25})
    np.testing.assert_allclose(varied.actuator_forcerange, model.actuator_forcerange)


# --- the model that engines step, without its visual elements


@pytest.mark.parametrize("scene", ["flat", "maze", "balance_stand"])
@pytest.mark.parametrize("tail", TAILS)
def test_it_moves_bit_for_bit_like_the_whole_model(scene, tail):
    """Dropped on the ground with restless servos, every sensor read."""
    robot = load_robot(scene=scene, tail=tail)
    states = []
    for model in (robot.model, robot.physical):
        data = mujoco.MjData(model)
        noise = np.random.default_rng(0)
        for _ in range(300):
            data.ctrl[:] = noise.uniform(-0.4, 0.4, model.nu)
            mujoco.mj_step(model, data)
        assert data.ncon > 0
        states.append(np.concatenate([data.qpos, data.qvel, data.sensordata]))
    np.testing.assert_array_equal(*states)


@pytest.mark.parametrize("scene", ["flat", "maze", "balance_stand"])
def test_ids_that_engines_use_are_those_of_the_whole_model(scene):
    """Bodies, joints, actuators, tendons, sensors and contact pairs."""
    robot = load_robot(scene=scene)
    complete, lean = robot.model, robot.physical
    for kind in ("body", "joint", "actuator", "tendon", "sensor", "pair"):
        count = {"body": "nbody", "joint": "njnt", "actuator": "nu"}.get(kind, f"n{kind}")
        names = [
            [getattr(m, kind)(i).name for i in range(getattr(m, count))] for m in (complete, lean)
        ]
        assert names[0] == names[1], kind
    assert complete.nu > 0


def test_nothing_that_is_only_drawn_is_left():
    """Every geom touches something or leads a tendon, and every site is on a tendon or read."""
    robot = load_robot()
    model = robot.physical
    geoms = {
        *model.pair_geom1.tolist(),
        *model.pair_geom2.tolist(),
        *model.wrap_objid[model.wrap_type == 5].tolist(),
    }
    assert geoms == set(range(model.ngeom))
    assert model.ngeom < 20 < robot.model.ngeom
    assert (model.ncam, model.nlight) == (0, 0)
    assert {model.site(i).name for i in range(model.nsite)} >= {
        "imu",
        "spine_end",
        "front_left_foot",
    }
    assert not [
        i
        for i in range(model.nsite)
        if model.site(i).name.startswith("tail_") and model.site(i).name != "tail_touch"
    ]


def test_degrees_of_freedom():
    """28 with the rigid tail; its 19 joints and its pulley make them 48."""
    assert load_robot().model.nv == 28
    assert load_robot(tail="articulated").model.nv == 48


def test_visual_geoms_are_without_effect():
    """Without the geoms of group 2, but for the pulleys that tendons wrap around, 200 steps are the same to the bit."""
    robot, bare = load_robot(), assemble()
    for geom in list(bare.geoms):
        if geom.group == 2 and not geom.name.endswith("pulley"):
            bare.delete(geom)
    model = bare.compile()
    # Floor, soles, tail's tip, three spheres of the trunk, five pulleys; the tail's pulley is fixed, but still a geom.
    assert model.ngeom == 15 < robot.model.ngeom
    np.testing.assert_array_equal(model.body_mass, robot.model.body_mass)
    ctrl = targets(robot.n_servos, 200)
    np.testing.assert_array_equal(simulate(model, ctrl), simulate(robot.model, ctrl))


def test_the_search_for_islands_is_without_effect():
    """One robot is one island: with MuJoCo's search for others switched on, 300 steps are the same to the bit."""
    robot = load_robot()
    searching = copy.copy(robot.model)
    searching.opt.disableflags &= ~mujoco.mjtDisableBit.mjDSBL_ISLAND.value
    assert searching.opt.disableflags != robot.model.opt.disableflags
    ctrl = targets(robot.n_servos, 300)
    np.testing.assert_array_equal(simulate(searching, ctrl), simulate(robot.model, ctrl))


def test_what_a_pair_or_a_sensor_names_is_not_left_out_as_visual():
    ball = '<geom name="{}" contype="0" conaffinity="0" size="0.01" mass="1"/>'
    spec = mujoco.MjSpec.from_string(f"""
        <mujoco><worldbody><geom name="floor" type="plane" size="1 1 0.1"/>
          <body><freejoint/><site name="read"/><site name="marker"/>{"".join(map(ball.format, "abcd"))}</body>
        </worldbody>
        <contact><pair geom1="floor" geom2="a"/></contact>
        <sensor><framepos objtype="geom" objname="b"/>
          <framepos objtype="site" objname="read" reftype="geom" refname="c"/></sensor></mujoco>""")
    complete = spec.compile()
    lean = physical_model(spec, complete)
    assert [lean.geom(i).name for i in range(lean.ngeom)] == ["floor", "a", "b", "c"]
    assert [lean.site(i).name for i in range(lean.nsite)] == ["read"]
    np.testing.assert_array_equal(lean.body_mass, complete.body_mass)
