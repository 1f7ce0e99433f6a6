# Tests of control/pilot.py, control/path.py
"""Paths, the PD pilot and commands given as tables."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nermo_mjx.control import pilot
from nermo_mjx.control.controller import named_pilot
from nermo_mjx.control.parameters import ControlParameters, Pilot
from nermo_mjx.control.path import PATHS
from nermo_mjx.kinematics.spine import servo_angle
from nermo_mjx.robot import SERVOS, load_robot
from nermo_mjx.robot.geometry import Geometry

arc, straight = jax.jit(PATHS["arc"]), jax.jit(PATHS["straight"])
steer, heading = jax.jit(pilot.steer), jax.jit(pilot.heading)
metres = st.floats(-5, 5)


def pilot_of(**values) -> Pilot:
    return Pilot(**{name: jnp.float32(value) for name, value in values.items()})


def test_a_robot_to_the_left_of_its_path_is_steered_to_the_right():
    """x is to the left, and a negative turn rate turns right."""
    point = straight(Pilot(), jnp.asarray([0.01, -1.0, 0.05]))
    assert point.error == pytest.approx(0.01)
    published = pilot_of(error_gain=40.0, change_gain=300.0)
    assert steer(published, point.error, jnp.zeros(())) == pytest.approx(-40.0 * 0.01)
    assert steer(published, jnp.zeros(()), jnp.float32(1e-3)) == pytest.approx(-0.3)


@settings(max_examples=60, deadline=None)
@given(
    metres,
    metres,
    st.floats(0.0625, 1000.0, width=32, allow_subnormal=False),
    st.sampled_from([-1.0, 1.0]),
)
def test_the_arcs_error_is_the_distance_to_the_circle_with_a_sign(x, y, radius, direction):
    """The oracle is hypot in float64; left of a left arc is inside, left of a right arc is outside."""
    x, y = float(np.float32(x)), float(np.float32(y))
    expected = direction * (radius - np.hypot(x - direction * radius, y))
    point = arc(pilot_of(radius=radius, direction=direction), jnp.asarray([x, y, 0.0]))
    assert point.error == pytest.approx(expected, abs=5e-6, rel=1e-5)


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_the_arc_bends_to_its_direction_and_guidance_is_added_before_the_limit(direction):
    positions = jnp.asarray([[0.3, -0.2, 0.0], [0.0, 0.0, 0.0]])
    params = pilot_of(radius=0.5, direction=direction, error_gain=10.0, output_limit=0.8)
    np.testing.assert_allclose(arc(params, positions).curvature, direction * 2.0)
    turns = [
        float(steer(params, jnp.float32(error), jnp.float32(0.0), 0.6))
        for error in (0.0, 0.02, -0.1)
    ]
    assert turns == pytest.approx([0.6, 0.4, 0.8])
    angle = np.linspace(0, np.pi / 2, 7)
    on_it = np.stack(
        [direction * 0.5 * (1 - np.cos(angle)), -0.5 * np.sin(angle), 0 * angle], axis=-1
    )
    np.testing.assert_allclose(arc(params, jnp.asarray(on_it)).error, 0.0, atol=1e-7)


def test_the_arc_has_a_finite_gradient_at_its_centre():
    slope = jax.jit(jax.grad(lambda position: arc(pilot_of(radius=0.5), position).error))(
        jnp.asarray([0.5, 0.0, 0.0])
    )
    assert np.isfinite(slope).all()


@settings(max_examples=40, deadline=None)
@given(st.floats(-1e30, 1e30), st.floats(-1e30, 1e30), st.sampled_from((*PATHS, "waypoints")))
def test_the_turn_rate_is_limited_for_any_position(x, y, name):
    position = jnp.asarray([x, y, 0.0], jnp.float32)
    course = [(0.0, 0.0), (0.0, -1.0), (0.5, -2.0)] if name == "waypoints" else None
    controller = named_pilot(name, course, None)
    error = controller.locate(ControlParameters(), position, jnp.zeros(())).error
    assert abs(steer(pilot_of(output_limit=0.5), error, error)) <= 0.5


def test_a_table_is_interpolated_or_held():
    line = pilot.tabulated([0.0, 1.0, 2.0], [0.0, 0.1, 0.1], [0.0, -1.0, 1.0])
    speed, turn = line(jnp.float32(0.5))
    assert (float(speed), float(turn)) == pytest.approx((0.05, -0.5))
    steps = pilot.tabulated([0.0, 1.0, 2.0], 0.1, [0.0, -1.0, 1.0], hold=True)
    turns = [float(steps(jnp.float32(time))[1]) for time in (-1.0, 0.0, 0.99, 1.0, 1.5, 2.0, 9.0)]
    assert turns == [0.0, 0.0, 0.0, -1.0, -1.0, 1.0, 1.0]
    # Compared by value, so that two equal controllers share a compiled program.
    table, equal = pilot.tabulated([0, 1], 0.1, 0.0), pilot.tabulated(np.arange(2.0), 0.1, [0, 0])
    assert (table, hash(table)) == (equal, hash(equal))


@pytest.mark.parametrize(("path", "direction"), [(straight, 1.0), (arc, 1.0), (arc, -1.0)])
@pytest.mark.parametrize("radius", [0.5, 0.7])
def test_the_tangent_points_along_the_path_and_the_error_grows_to_its_left(path, direction, radius):
    """At the origin every path heads -y; a quarter of a circle on, it heads to the side it bends to.

    The oracle for the error is its slope: it points to the left of the way ahead.
    """
    params, position = pilot_of(radius=radius, direction=direction), jnp.asarray([0.1, -0.3, 0.05])
    np.testing.assert_allclose(path(params, jnp.zeros(3)).tangent, [0.0, -1.0], atol=1e-6)
    if path is arc:
        quarter = jnp.array([radius * direction, -radius, 0.05])
        np.testing.assert_allclose(path(params, quarter).tangent, [direction, 0.0], atol=1e-6)
    slope = jax.jit(jax.grad(lambda point: path(params, point).error))(position)
    ahead = path(params, position).tangent
    np.testing.assert_allclose(slope[:2], [-ahead[1], ahead[0]], atol=1e-5)


@pytest.mark.parametrize("bend", [0.1, -0.06])
@pytest.mark.parametrize("turn", [0.0, 0.9])
def test_the_heading_of_a_bent_robot_is_half_way_between_torso_and_hip(bend, turn):
    """Of MuJoCo's robot with four equal angles of the spine, relative to paths in two directions."""
    robot = load_robot()
    data, joints = mujoco.MjData(robot.model), robot.joints
    data.qpos[:] = robot.model.qpos0
    data.qpos[joints.root + 3 : joints.root + 7] = Rotation.from_euler("z", 0.4).as_quat(
        scalar_first=True
    )
    data.qpos[list(joints.spine)] = bend
    mujoco.mj_forward(robot.model, data)
    backward = [
        frame.xmat.reshape(3, 3)[:2, 1] for frame in (data.body("torso"), data.site("spine_end"))
    ]
    yaw = [np.arctan2(-x, y) for x, y in backward]
    assert abs(yaw[0] - yaw[1]) > 3 * abs(bend)
    sensors = robot.sensors(jnp.asarray(data.sensordata, jnp.float32))
    bent = sensors.servo_angle.at[SERVOS.index("spine")].set(float(servo_angle(bend, Geometry())))
    tangent = jnp.asarray([np.sin(turn), -np.cos(turn)], jnp.float32)
    point = dataclasses.replace(straight(Pilot(), jnp.zeros(3)), tangent=tangent)
    result = heading(point, dataclasses.replace(sensors, servo_angle=bent), Geometry())
    assert result == pytest.approx(np.mean(yaw) - turn, abs=0.03 * abs(yaw[0] - yaw[1]))
