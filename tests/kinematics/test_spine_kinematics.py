# Tests of kinematics/spine.py
"""The spine's chain against MuJoCo frames and the published numbers; its servo against the tendons' geometry."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from nermo_mjx.kinematics import spine
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import SPINE_GEOMETRY
from nermo_mjx.robot.quantity import replace_quantities

#: The published robot.
ROBOT = Geometry()

transform = jax.jit(spine.transform)
joint_angle, servo_angle = jax.jit(spine.joint_angle), jax.jit(spine.servo_angle)
displaced = jax.jit(lambda displacement: spine.angle_for_displacement(displacement, ROBOT))


def mujoco_chain(longer: float = 0.0) -> mujoco.MjModel:
    """Table 5.3 as nested MuJoCo frames, one hinge a row; every body stands for one modified DH link.

    Args:
        longer: Difference of a segment's length from the published length [m]. Rows 3 to 8 lie between the first
            lateral joint and the last, two rows a segment.
    """
    head, tail = "", ""
    for row, (alpha, a, theta, d) in enumerate(SPINE_GEOMETRY.dh):
        a = a + longer / 2 if 3 <= row <= 8 else a
        head += f'<body name="{row}" pos="{a} 0 {d}" euler="{alpha} 0 {theta}"><joint axis="0 0 1"/><geom size=".001"/>'
        tail += "</body>"
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><worldbody>{head}<site name="end"/>{tail}</worldbody></mujoco>'
    )


def test_the_chain_is_where_mujoco_puts_it():
    """Lateral angles of -theta_v, any vertical angles and any length of a segment give the pose of MuJoCo's frames."""
    rng = np.random.default_rng(0)
    theta, vertical = rng.uniform(-0.4, 0.4, 20), rng.uniform(-0.3, 0.3, (20, 4))
    lengths = np.repeat([0.014, 0.010, 0.022], [10, 5, 5])
    with jax.enable_x64(True):
        ours = np.asarray(
            transform(theta, replace_quantities(ROBOT, {"spine.segment": lengths}), vertical)
        )
    for i in range(20):
        model = mujoco_chain(lengths[i] - 0.014)
        data = mujoco.MjData(model)
        data.qpos[list(SPINE_GEOMETRY.lateral_joints)] = -theta[i]
        data.qpos[list(SPINE_GEOMETRY.vertical_joints)] = vertical[i]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(ours[i, :3, 3], data.site("end").xpos, atol=1e-12)
        np.testing.assert_allclose(ours[i, :3, :3], data.site("end").xmat.reshape(3, 3), atol=1e-12)


def test_neutral_spine_end_is_the_published_one():
    """The straight spine ends at (0, 0.0517, -0.0154), turned by 0.1 degrees at most (erratum to Table A.5)."""
    with jax.enable_x64(True):
        pose = np.asarray(transform(0.0, ROBOT))
    np.testing.assert_allclose(pose[:3, 3], (0.0, 0.0517, -0.0154), atol=5e-5)
    turn = math.acos(min(1.0, (np.trace(pose[:3, :3]) - 1) / 2))
    assert math.degrees(turn) <= 0.1 + 1e-3


@pytest.mark.parametrize("theta_v", [0.0, 0.1, -0.07])
def test_a_constant_angle_gives_what_the_same_angle_in_an_array_gives(theta_v):
    """The one is computed before tracing, the other in the program; also for another length of a segment."""
    robot = replace_quantities(ROBOT, {"spine.segment": np.array([0.014, 0.017])})
    with jax.enable_x64(True):
        expected = np.asarray(transform(np.full(2, theta_v), robot))
        ours = spine.transform(theta_v, robot)
        assert ours.dtype == expected.dtype
        np.testing.assert_allclose(ours, expected, atol=1e-15)


def test_positive_angles_bend_to_the_left():
    """Positive theta_v moves the hip to the left and yaws it by -4 theta_v, so that the torso turns left against it."""
    with jax.enable_x64(True):
        pose = np.asarray(transform(np.array([0.05, 0.1]), ROBOT))
    assert (pose[:, 0, 3] > 0.004).all()
    yaw = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    # The joints are pitched against each other by up to 18 degrees, which costs a few percent of the yaw.
    np.testing.assert_allclose(yaw, [-0.2, -0.4], rtol=0.06)


@pytest.mark.parametrize("theta_v", [0.02, 0.1, -0.15])
def test_four_joints_turn_the_hip_by_less_than_four_angles(theta_v):
    """Erratum 17: 0.380 rad at 0.1 rad a joint, read off the chain; the linear form is within 1 % of it."""
    pose = np.asarray(spine.transform(theta_v, ROBOT))
    turned = -math.atan2(-pose[0, 1], pose[1, 1])  # the torso against the hip, by the way it points
    assert float(spine.yaw(theta_v)) == pytest.approx(turned, rel=1e-2)
    assert float(spine.yaw(0.1)) == pytest.approx(0.380, rel=5e-3)


def test_left_and_right_mirror():
    """Changing the sign of theta_v mirrors the pose in the sagittal plane, and the servo laws are odd."""
    theta = np.linspace(0.0, 0.4, 9)
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    with jax.enable_x64(True):
        np.testing.assert_allclose(
            transform(-theta, ROBOT),
            mirror @ np.asarray(transform(theta, ROBOT)) @ mirror,
            atol=1e-15,
        )
        for law in (
            lambda angle: joint_angle(angle, ROBOT),
            lambda angle: servo_angle(angle, ROBOT),
        ):
            np.testing.assert_allclose(law(-theta), -law(theta), atol=1e-14)


def test_vertical_angles_lift_the_hip():
    """Positive angles of the vertical joints of Nermo 4.1 raise the spine end; zeros change nothing."""
    np.testing.assert_allclose(transform(0.1, ROBOT, np.zeros(4)), transform(0.1, ROBOT), atol=1e-7)
    for joint in np.eye(4):
        assert transform(0.0, ROBOT, 0.1 * joint)[2, 3] > transform(0.0, ROBOT)[2, 3] + 1e-4


def test_servo_law_is_the_published_one():
    """For positive angles joint_angle is (5.26)-(5.29) as printed, and servo_angle inverts it for both signs."""
    servo = np.linspace(0.0, 1.5, 16)
    half, offset = SPINE_GEOMETRY.segment_length / 2, SPINE_GEOMETRY.segment_offset
    radius2, alpha = half**2 + offset**2, math.atan(offset / half)
    segment = SPINE_GEOMETRY.segment_length + SPINE_GEOMETRY.pulley_radius * servo / 4
    published = 2 * alpha - math.pi + np.arccos(1 - segment**2 / (2 * radius2))
    angles = np.concatenate([-servo, servo])
    with jax.enable_x64(True):
        np.testing.assert_allclose(joint_angle(servo, ROBOT), published, atol=1e-12)
        np.testing.assert_allclose(
            servo_angle(joint_angle(angles, ROBOT), ROBOT), angles, atol=1e-12
        )


def test_servo_range_bends_the_joints_by_their_limit():
    """0.4 rad of servo give about 0.1 rad a joint, and the antagonist's own tendon would say so within 1.5 %."""
    angle = float(joint_angle(SPINE_GEOMETRY.max_servo_angle, ROBOT))
    assert angle == pytest.approx(SPINE_GEOMETRY.max_joint_angle, rel=0.05)
    radius, alpha = math.hypot(0.0015, 0.00625), math.atan(0.00625 / 0.0015)
    shortened = 0.003 - SPINE_GEOMETRY.pulley_radius * SPINE_GEOMETRY.max_servo_angle / 4
    inner = math.pi - 2 * alpha - math.acos(1 - shortened**2 / (2 * radius**2))
    assert angle == pytest.approx(inner, rel=0.015)


@pytest.mark.release
def test_displacement_is_inverted_over_the_whole_range():
    """angle_for_displacement undoes the spine end's x, which rises all the way, and saturates beyond."""
    theta = np.linspace(-1, 1, 41) * spine.max_joint_angle()
    with jax.enable_x64(True):
        sideways = np.asarray(transform(theta, ROBOT)[:, 0, 3])
        np.testing.assert_allclose(displaced(sideways), theta, atol=1e-12)
        np.testing.assert_allclose(
            displaced(np.array([-1e30, -0.05, 0.05, 1e30])), theta[[0, 0, -1, -1]], atol=1e-12
        )
        slope = np.asarray(jax.jit(jax.vmap(jax.grad(displaced)))(sideways[1:-1]))
    assert (np.diff(sideways) > 0).all()
    np.testing.assert_allclose(slope * np.gradient(sideways, theta)[1:-1], 1.0, atol=5e-3)


@pytest.mark.parametrize("x64", [False, True])
def test_servo_laws_saturate_with_finite_slopes(x64):
    """Through zero, at the limit and far beyond it, values stay in range and derivatives are finite."""
    limit = spine.max_joint_angle()
    with jax.enable_x64(x64):
        end = float(servo_angle(1e9, ROBOT))
        inputs = jnp.array([0.0, -0.0, limit, -limit, end, -end, 7.0, 1e30, -3e38])
        for law, bound in ((joint_angle, limit), (servo_angle, end)):
            assert (np.abs(law(inputs, ROBOT)) <= bound * (1 + 1e-6)).all()
            slopes = np.asarray(jax.vmap(jax.grad(law), (0, None))(inputs, ROBOT))
            assert np.isfinite(slopes).all()
            assert (slopes[:2] > 0.1).all(), "no dead spot at zero"
            assert (slopes[-3:] == 0).all()


@jax.jit
def everything(value):
    def results(value):
        return (
            spine.transform(value, ROBOT, jnp.stack([value, -value, value, -value])),
            spine.joint_angle(value, ROBOT),
            spine.servo_angle(value, ROBOT),
            spine.angle_for_displacement(value, ROBOT),
        )

    gradient = jax.grad(lambda value: sum(jnp.sum(leaf) for leaf in results(value)))(value)
    return results(value), jax.jacfwd(results)(value), gradient


@pytest.mark.release
@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_any_number_gives_finite_values_and_derivatives(real):
    """Any finite angle, servo angle or displacement gives finite results and derivatives."""
    width = np.finfo(real).bits

    @settings(max_examples=100, deadline=None)
    @example(np.finfo(real).max)
    @given(
        st.floats(width=width, allow_nan=False, allow_infinity=False)
        | st.floats(-0.5, 0.5, width=width)
    )
    def check(value):
        for leaf in jax.tree.leaves(everything(real(value))):
            assert np.isfinite(leaf).all(), value

    with jax.enable_x64(real is np.float64):
        check()
