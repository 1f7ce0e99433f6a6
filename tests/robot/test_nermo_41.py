# Tests of robot/assembly.py, robot/geometry.py
"""Nermo 4.1: the vertical spine against MuJoCo, what its servos do to the simulated robot, and its controller."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx import Run, Setup, Simulator, load_robot
from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.control.spine_modes import SagittalModes
from nermo_mjx.kinematics import body, spine
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import assemble_spine
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.quantity import replace_quantities
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.rollout.eye_metrics import head_orientation, head_rate
from nermo_mjx.runtime import compiler_options

#: The published robot.
ROBOT = Geometry()

LIMBS = ("front_left", "front_right", "rear_left", "rear_right")
BOUND = {"gait": "bound", "robot": "nermo_41"}


@pytest.fixture(scope="module")
def robot():
    return load_robot("nermo_41", tail="articulated")


def seen_from_torso(data: mujoco.MjData, point: np.ndarray) -> np.ndarray:
    torso = data.body("torso")
    return torso.xmat.reshape(3, 3).T @ (point - torso.xpos)


def test_it_has_the_published_servos_mass_and_length(robot):
    """Table 4.1: 13 servos, 275 g, and 405 mm from the nose to the tip of the tail.

    With the tail where the author's model has it, and the nose 53 mm in front of the tilt axis as in that model, the
    length is 403.6 mm.
    """
    assert robot.servos[8:] == ("spine", "neck", "tail", "spine_vertical", "head")
    assert len(robot.servos) == 13
    assert robot.model.body_mass.sum() == pytest.approx(0.275, abs=1e-6)
    assert load_robot("nermo_41").model.body_mass.sum() == pytest.approx(0.275, abs=1e-6)
    model, data = robot.model, mujoco.MjData(robot.model)
    mujoco.mj_forward(model, data)
    nose = min(
        (
            data.geom_xpos[i]
            + model.mesh_vert[first : first + count] @ data.geom_xmat[i].reshape(3, 3).T
        )[:, 1].min()
        for i in range(model.ngeom)
        if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH
        for mesh in [model.geom_dataid[i]]
        for first, count in [(model.mesh_vertadr[mesh], model.mesh_vertnum[mesh])]
    )
    tip = data.geom("tail_tip").xpos[1] + model.geom("tail_tip").size[0]
    assert tip - nose == pytest.approx(0.405, abs=0.002)


def test_the_same_joint_angles_put_the_hip_where_mujoco_has_it(robot):
    """Any lateral and vertical angles: spine end, its rotation, hip axes and rear feet within 1e-6 m of the model's."""
    model, data, joints = robot.model, mujoco.MjData(robot.model), robot.joints
    rng = np.random.default_rng(2)
    for theta, vertical in rng.uniform(-0.15, 0.15, (8, 2)):
        mujoco.mj_resetData(model, data)
        data.qpos[:7] = [0.1, -0.2, 0.5, *rng.normal(size=4)]
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        data.qpos[np.ravel(joints.spine)], data.qpos[np.ravel(joints.spine_vertical)] = (
            theta,
            vertical,
        )
        mujoco.mj_kinematics(model, data)
        with jax.enable_x64(True):
            pose = np.asarray(spine.transform(np.array(theta), ROBOT, np.full(4, vertical)))
            hips = np.asarray(body.hips(np.array(theta), ROBOT, np.array(vertical)))
            points = np.array([[0.0, 0.0], [0.0, 0.0], [0.003, -0.05], [-0.01, -0.045]])
            feet = np.asarray(
                body.feet_positions(np.array(theta), points, ROBOT, np.array(vertical))
            )[2:]
        end = data.site("spine_end")
        np.testing.assert_allclose(seen_from_torso(data, end.xpos), pose[:3, 3], atol=1e-6)
        turn = data.body("torso").xmat.reshape(3, 3).T @ end.xmat.reshape(3, 3)
        np.testing.assert_allclose(turn, pose[:3, :3], atol=1e-6)
        for index, limb in enumerate(("rear_left", "rear_right")):
            axis = data.site(f"{limb}_axis").xpos
            np.testing.assert_allclose(seen_from_torso(data, axis), hips[index], atol=1e-6)
            foot = axis + end.xmat.reshape(3, 3) @ [0.0, *points[2 + index]]
            np.testing.assert_allclose(seen_from_torso(data, foot), feet[index], atol=1e-6)


@pytest.mark.release
def test_a_world_of_its_own_geometry_has_its_hips_where_the_kinematics_say(robot):
    """Longer segments, a smaller pulley and a wider hip: hip axis within 1e-6 m, and no tendon slack or tight."""
    values = {
        "geometry.spine.segment": 0.018,
        "geometry.spine.pulley_radius": 0.0055,
        "geometry.hip.x": 0.045,
    }
    model, joints = compile_model(robot, values), robot.joints
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    spines = [i for i in range(model.ntendon) if model.tendon(i).name.startswith("spine_")]
    np.testing.assert_allclose(data.ten_length[spines], model.tendon_range[spines, 1], atol=1e-7)
    data.qpos[list(joints.spine)], data.qpos[list(joints.spine_vertical)] = 0.08, -0.06
    mujoco.mj_kinematics(model, data)
    geometry = replace_quantities(
        Geometry(), {name.removeprefix("geometry."): value for name, value in values.items()}
    )
    with jax.enable_x64(True):
        hips = np.asarray(body.hips(np.array(0.08), geometry, np.array(-0.06)))
    np.testing.assert_allclose(
        seen_from_torso(data, data.site("rear_left_axis").xpos), hips[0], atol=1e-6
    )


def test_each_servo_bends_its_own_plane_by_the_published_law():
    """On the test stand all four joints of a plane bend equally, within 4 % of (5.26); the other plane stays
    straight."""
    model = assemble_spine(robot="nermo_41").compile()
    data = mujoco.MjData(model)
    planes = [[f"spine_{plane}_{i}" for i in range(1, 5)] for plane in ("joint", "vertical")]
    for lateral, vertical in ((0.4, 0.0), (0.0, 0.4), (0.0, -0.4), (-0.3, 0.3)):
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = lateral, vertical
        mujoco.mj_step(model, data, 700)
        for servo, names in zip((lateral, vertical), planes, strict=True):
            bent = np.array([data.joint(name).qpos[0] for name in names])
            expected = float(spine.joint_angle(np.array(servo), ROBOT))
            np.testing.assert_allclose(bent, expected, atol=0.04 * abs(expected) + 5e-4)
            assert np.ptp(bent) < 1e-3


def test_positive_lifts_the_hip_and_lowers_the_nose(robot):
    """Signs: a positive vertical angle lifts the hip against the torso, a positive tilt turns the eyes down."""
    model, data, joints = robot.model, mujoco.MjData(robot.model), robot.joints

    def look() -> tuple[float, float]:
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        return data.site("spine_end").xpos[2], -data.cam("eyes").xmat.reshape(3, 3)[2, 2]

    hip, gaze = look()
    data.qpos[list(joints.spine_vertical)], data.qpos[list(joints.head_tilt)] = 0.1, 0.3
    lifted, lowered = look()
    assert lifted > hip + 0.005
    assert math.asin(lowered) - math.asin(gaze) == pytest.approx(-0.3, abs=1e-6)


def test_the_eyes_are_tracked_through_both_servos_of_the_head(robot):
    """Attitude and angular velocity of the head, from the robot's sensors, are those of MuJoCo's body."""
    model, data, rng = robot.model, mujoco.MjData(robot.model), np.random.default_rng(5)
    for _ in range(4):
        data.qpos[:] = rng.uniform(-0.4, 0.4, model.nq)
        data.qpos[3:7] = rng.normal(size=4)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        data.qvel[:] = rng.uniform(-2.0, 2.0, model.nv)
        mujoco.mj_forward(model, data)
        velocity, head = np.zeros(6), model.body("head").id
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, head, velocity, 1)
        with jax.enable_x64(True):
            sensors = robot.sensors(jnp.asarray(data.sensordata))
            quaternion, rate = np.asarray(head_orientation(sensors)), np.asarray(head_rate(sensors))
        assert abs(quaternion @ data.xquat[head]) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(rate, velocity[:3], atol=1e-9)


def test_springs_dampers_and_masses_reach_what_it_has_more(robot):
    """`stiffness.spine` and `damping.spine` hold for all eight joints; `mass.front` has its own default, 174.5 g."""
    defaults = Setup(robot="nermo_41").defaults()
    assert defaults["mass.front"] == pytest.approx(0.1745)
    model = compile_model(robot, {"stiffness.spine": 0.9, "damping.spine": 0.05, "mass.rear": 0.11})
    names = [f"spine_{plane}_{i}" for plane in ("joint", "vertical") for i in range(1, 5)]
    assert {float(model.joint(name).stiffness[0]) for name in names} == {0.9}
    assert {float(model.joint(name).damping[0]) for name in names} == {0.05}
    assert model.body_mass.sum() == pytest.approx(0.1745 + 0.11, rel=1e-6)


def test_the_sagittal_extension_flexes_at_touch_down_and_steering_leaves_less_of_it():
    """-A cos(2 pi phase), clipped to q_max; of a turn rate of 0.5 steering leaves half, of full lock nothing (5.46)."""
    values = {"spine.sagittal_amplitude": 0.3, "spine.sagittal_phase": 0.0, "turning.spine": 1.0}
    params = replace_quantities(
        ControlParameters(), {name: jnp.asarray(value) for name, value in values.items()}
    )
    modes, level = SagittalModes("sagittal_extension"), jnp.zeros(())

    def angle(phase: float, turn_rate: float = 0.0) -> float:
        return float(modes(params, jnp.asarray(phase), jnp.asarray(turn_rate), level, level))

    assert angle(0.0) == pytest.approx(-0.3)
    assert angle(0.25) == pytest.approx(0.0, abs=1e-6)
    assert angle(0.5) == pytest.approx(0.3)
    assert angle(0.5, 0.5) == pytest.approx(0.15)
    assert angle(0.5, -1.0) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize(
    ("mode", "lower", "upper"), [("none", 0.0, 0.04), ("sagittal_extension", 0.08, 0.13)]
)
def test_a_bound_walks_forward_with_and_without_the_vertical_spine(simulator, mode, lower, upper):
    """It neither falls nor stands. At 0.4 rad of servo the vertical joints bend by about 0.1 rad; held, they give way
    to the feet's impacts by a third of that at most: of docs/model.md's identified body (the default's by 0.042)."""
    sim = simulator(**BOUND, spine=mode)
    damped = {"damping.knee": 0.02531, "damping.ankle": 0.02531, "damping.spine": 0.09242}
    result = sim.run(damped, Run(cycles=5, warmup_cycles=2), record=True)
    assert result.metrics["fell"][0] == 0.0
    assert result.metrics["speed"][0] > 0.015
    bent = np.abs(result.recording().qpos[:, np.ravel(sim.robot.joints.spine_vertical)])
    assert lower < bent.max() < upper


@pytest.mark.release
def test_pitch_balance_calms_the_torso_without_costing_speed(simulator):
    """In the lateral walk the pitch's standard deviation is less than half of that with the gain 0."""
    sim = simulator(robot="nermo_41", gait="lateral_walk", spine="pitch_balance")
    result = sim.run({"spine.pitch_gain": np.array([0.0, 2.0])}, Run(cycles=8, warmup_cycles=3))
    free, balanced = result.metrics["pitch_std"]
    assert balanced < 0.5 * free
    assert result.metrics["speed"][1] > 0.95 * result.metrics["speed"][0]


@pytest.mark.release
def test_it_starts_on_its_feet_whatever_the_spine_does(simulator):
    """In the cycle's phase where the spine flexes most, too: neither a foot nor the tail starts in the ground."""
    sim = simulator(**BOUND, spine="sagittal_extension")
    model = sim.robot.model
    data = mujoco.MjData(model)
    phases = np.array([0.0, 0.3, 0.6])
    for qpos in sim.prepare({"start.phase": phases}, Run(cycles=0.05)).qpos:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        soles = [
            data.geom(f"{limb}_sole").xpos[2] - model.geom(f"{limb}_sole").size[0] for limb in LIMBS
        ]
        assert min(soles) == pytest.approx(-1e-5, abs=5e-6)
        assert min(data.contact.dist) > -1e-4
    assert sim.run({"start.phase": phases}, Run(cycles=6, warmup_cycles=2)).status.tolist() == 3 * [
        "ok"
    ]


@pytest.mark.long  # this program of MJX compiles for a minute; test_walk_gradient.py has that of Nermo-Lite
def test_mjx_walks_as_c_does_and_its_slopes_are_those_of_c():
    """A third of a bound in float64: the speed of both engines, and its derivatives against differences of C's."""
    point = {
        "spine.sagittal_amplitude": 0.2,
        "spine.sagittal_phase": 0.6,
        "spine.pitch_gain": 0.5,
        "stiffness.spine": 1.1,
        "mass.front": 0.17,
    }
    setup = Setup(**BOUND, spine="sagittal_extension+pitch_balance")
    run, first, share = Run(cycles=0.3, warmup_cycles=0), np.array(list(point.values())), 1e-6
    with jax.enable_x64(True):
        rollout = Rollout(setup, run, "mjx")

        def speed(values):
            return rollout(dict(zip(point, values, strict=True)))["speed"]

        def with_slopes(values):
            directions = jnp.eye(len(point))
            return jax.vmap(
                lambda direction: jax.jvp(speed, (values,), (direction,)), out_axes=(None, 0)
            )(directions)

        value, slopes = jax.jit(with_slopes, compiler_options=compiler_options())(
            jnp.asarray(first)
        )
        points = first + first * share * np.concatenate([np.zeros((1, 5)), np.eye(5), -np.eye(5)])
        simulator = Simulator(setup, "c")
        simulator.engine.model.opt.tolerance = 0.0
        reference, *ends = simulator.run(dict(zip(point, points.T, strict=True)), run).metrics[
            "speed"
        ]
    high, low = np.split(np.array(ends), 2)
    assert value == pytest.approx(reference, rel=1e-6)
    np.testing.assert_allclose(slopes, (high - low) / (2 * share * first), rtol=1e-3)
