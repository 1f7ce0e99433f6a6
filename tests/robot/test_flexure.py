# Tests of robot/equipment.py, robot/assembly.py
"""Compliant joints as chains of hinges: against springs in series, the arc of a bent leaf, and one hinge."""

from __future__ import annotations

import dataclasses

import jax
import mujoco
import numpy as np
import pytest

from nermo_mjx.dynamics import put_data, put_model, step
from nermo_mjx.kinematics.leg import forward_kinematics, four_legs
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import LIMBS, assemble_leg, assemble_spine, load_robot
from nermo_mjx.robot.equipment import MAX_HINGES, chain_of
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import SPINE_GEOMETRY
from nermo_mjx.rollout import Run, Setup

CHAINS = (1, 2, 4, MAX_HINGES)
#: Finite elements of Table A.1: angle under 0.125 N m [rad], and the stiffness that the joint has here [N m/rad].
TORQUE, LEAVES = (
    0.125,
    {"front_left_knee": (0.95, 0.135), "rear_left_knee": (0.65, 0.19), "spine_joint": (0.42, 0.3)},
)


def stand_of(joint: str, hinges: int) -> mujoco.MjSpec:
    """The joint's test stand, with neither tendons nor servos."""
    spec = (
        assemble_spine(hinges=hinges)
        if joint.startswith("spine")
        else assemble_leg(joint.removesuffix("_knee"), hinges=hinges)
    )
    for tendon in list(spec.tendons):
        spec.delete(tendon)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    return spec


def settled(model: mujoco.MjModel, moment: dict[str, float]) -> mujoco.MjData:
    """At rest under pure moments [N m]: each hinge of a chain carries the whole moment."""
    data = mujoco.MjData(model)
    for i in range(model.njnt):
        data.qfrc_applied[model.jnt_dofadr[i]] = moment.get(chain_of(model.joint(i).name), 0.0)
    for _ in range(2500):
        mujoco.mj_step(model, data)
    assert np.abs(data.qvel).max() < 1e-3
    mujoco.mj_forward(model, data)
    return data


def angle(model: mujoco.MjModel, qpos: np.ndarray, joint: str) -> float:
    """Of a joint, or of all that begin so: the sum over the hinges [rad]."""
    return sum(
        qpos[model.jnt_qposadr[i]]
        for i in range(model.njnt)
        if chain_of(model.joint(i).name).startswith(joint)
    )


@pytest.mark.parametrize("hinges", CHAINS)
@pytest.mark.parametrize("joint", LEAVES)
def test_a_chain_bends_as_its_leaf_under_a_moment(joint, hinges):
    """Torque over stiffness, as of one spring, and within 4 % of the finite elements of Table A.1.

    The published "spine joint" can only be the four in series, with 1.2 N m/rad each.
    """
    published, stiffness = LEAVES[joint]
    model = stand_of(joint, hinges).compile()
    moment = (
        {f"spine_joint_{i}": TORQUE for i in range(1, 5)}
        if joint == "spine_joint"
        else {joint: TORQUE}
    )
    loaded, free = (angle(model, settled(model, loads).qpos, joint) for loads in (moment, {}))
    assert loaded - free == pytest.approx(TORQUE / stiffness, rel=1e-3)
    assert loaded - free == pytest.approx(published, rel=0.04)


def test_a_chain_approaches_the_arc_of_a_leaf():
    """The ends of a leaf bent to an arc of angle b are a chord of L sin(b/2) / (b/2) apart; a hinge keeps b = 0's kink.

    The tangents at both ends of the arc meet L tan(b/2) / b from either. From that point, where a single hinge would
    be, the middle of the unbent half is L / 2 away: the next vertebra moves outward by the difference, on either side.
    """
    bend, length = 0.4, SPINE_GEOMETRY.segment_length
    outward = length * (np.tan(bend / 2) / bend - 0.5)
    # By so much do the far link's points move, along both tangents, against those behind one hinge.
    expected = outward * np.array([1 + np.cos(bend), np.sin(bend)])
    missed = []
    for hinges in CHAINS[1:]:
        places = []
        for number in (1, hinges):
            model = assemble_spine(hinges=number).compile()
            data = mujoco.MjData(model)
            for i in range(model.njnt):
                if chain_of(model.joint(i).name) == "spine_joint_1":
                    data.qpos[model.jnt_qposadr[i]] = bend / number
            mujoco.mj_kinematics(model, data)
            site, vertebra = data.site("spine_left_0"), data.body("spine_vertebra_1")
            places.append(site.xmat.reshape(3, 3).T @ vertebra.xpos)
        shift = places[1] - places[0]
        assert shift[2] == pytest.approx(0.0, abs=1e-12)
        missed.append(np.linalg.norm(np.abs(shift[:2]) - expected))
    # Second order: the error of n hinges falls as 1 / n^2.
    assert missed[0] < 0.3 * np.linalg.norm(expected)
    assert missed[0] / missed[-1] == pytest.approx((MAX_HINGES / CHAINS[1]) ** 2, rel=0.05)


def test_the_standing_robot_is_the_same_with_chains():
    """Feet, hips and tendons' lengths in the zero pose are those of one hinge, and so is the mass."""
    hinged, chained = load_robot(), load_robot(hinges=4)
    places = []
    for robot in (hinged, chained):
        data = mujoco.MjData(robot.model)
        mujoco.mj_forward(robot.model, data)
        places.append((data.site_xpos.copy(), data.ten_length.copy()))
    for hinged_value, chained_value in zip(*places, strict=True):
        np.testing.assert_allclose(chained_value, hinged_value, atol=1e-9)
    assert chained.model.body_mass.sum() == pytest.approx(hinged.model.body_mass.sum(), rel=1e-12)
    assert chained.model.nv == hinged.model.nv + 3 * 12
    assert np.shape(chained.joints.knee) == (4, 4)


@pytest.mark.release
def test_a_knees_angle_is_the_sum_over_its_hinges():
    """The sensors' reading, and where the closed form of the leg has the foot: within 0.1 mm in a bent pose."""
    robot = load_robot("nermo_41", hinges=3)
    joints, servo = robot.joints, np.array([[0.5, 0.3], [0.2, 0.1], [-0.4, 0.2], [-0.8, 0.4]])
    pose = forward_kinematics(four_legs(Geometry()), servo, "type3")
    data = mujoco.MjData(robot.model)
    data.qpos[list(joints.hip)] = servo[:, 0]
    data.qpos[np.array(joints.knee)] = np.asarray(pose.knee_angle)[:, None] / 3
    mujoco.mj_forward(robot.model, data)
    np.testing.assert_allclose(
        robot.sensors(data.sensordata).knee_angle, pose.knee_angle, rtol=1e-6
    )
    feet = np.array(
        [(data.site(f"{limb}_foot").xpos - data.site(f"{limb}_axis").xpos)[1:] for limb in LIMBS]
    )
    np.testing.assert_allclose(feet, np.asarray(pose.foot), atol=1e-4)
    resting = robot.sensors(robot.sensordata_at_rest(np.float32(data.qpos)))
    np.testing.assert_allclose(resting.knee_angle, pose.knee_angle, rtol=1e-6)


def test_stiffness_and_damping_are_those_of_the_whole_joint():
    """A parameter of a chained joint is written to each hinge times their number."""
    robot = load_robot(hinges=2)
    model = compile_model(
        robot, {"stiffness.rear_knee": 0.3, "damping.spine": 0.02, "damping.hip": 0.03}
    )
    for joint, stiffness, damping in (
        ("rear_left_knee_hinge_2", 0.6, None),
        ("spine_joint_3_hinge_1", 2.4, 0.04),
        ("front_left_hip", 0.0, 0.03),
    ):
        assert model.joint(joint).stiffness[0] == pytest.approx(stiffness, rel=1e-6)
        assert damping is None or model.joint(joint).damping[0] == pytest.approx(damping, rel=1e-6)


@pytest.mark.release
def test_a_walk_with_chains_is_that_with_hinges(simulator):
    """Leaves of 3 mm hardly differ from hinges: speed within 1 %, roll within 2 % (0.2 and 0.1 % in fact)."""
    run = Run(cycles=4, warmup_cycles=2)
    hinged, chained = (
        simulator("c", spine="stride_extension", hinges=n).run({}, run).metrics for n in (1, 3)
    )
    assert hinged["speed"] != chained["speed"]
    np.testing.assert_allclose(chained["speed"], hinged["speed"], rtol=0.01)
    np.testing.assert_allclose(chained["roll_std"], hinged["roll_std"], rtol=0.02)


@pytest.mark.release
def test_mjx_steps_a_chain_as_c_does():
    """Several hinges on one body, with a taut tendon: 20 steps of a leg's stand."""
    spec = assemble_leg("rear_left", hinges=2)
    spec.option.tolerance = 1e-12
    model = spec.compile()
    data = mujoco.MjData(model)
    data.ctrl[:] = -0.2, 0.6
    with jax.enable_x64(True):
        device = put_model(model)
        state, advance = put_data(model, data), jax.jit(step)
        for _ in range(20):
            state = advance(device, state)
            mujoco.mj_step(model, data)
    np.testing.assert_allclose(np.asarray(state.qpos), data.qpos, atol=1e-7)


def test_hinges_are_part_of_a_setup():
    """They are written with a run, and reach the robot."""
    setup = dataclasses.replace(Setup(), hinges=2)
    assert setup.fields()["hinges"] == 2
    assert setup.load().model.nv == load_robot().model.nv + 12
