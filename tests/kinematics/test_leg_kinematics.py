# Tests of kinematics/leg.py
"""The leg model against MuJoCo, the published spiral model, finite differences and its own inverse."""

from __future__ import annotations

import dataclasses
import functools
import math

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from nermo_mjx.kinematics import leg as kin
from nermo_mjx.kinematics import leg as leg_module
from nermo_mjx.kinematics.leg import arm_range
from nermo_mjx.robot import geometry as geometry_module
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import FRONT_LEG, IDLER_RADIUS, REAR_LEG, ROUTINGS, LegGeometry

#: The published robot.
ROBOT = Geometry()

GEOMETRIES = [pytest.param(FRONT_LEG, id="front"), pytest.param(REAR_LEG, id="rear")]
#: Hip angles of the tests [rad]: well beyond the robot's +-0.7.
HIP = 1.5

forward = jax.jit(kin.forward_kinematics, static_argnames="routing")
inverse = jax.jit(kin.inverse_kinematics, static_argnames="routing")
jacobian = jax.jit(kin.jacobian, static_argnames="routing")
knee_range = jax.jit(leg_module.knee_range, static_argnames="routing")
knee_servo = jax.jit(kin.knee_servo, static_argnames="routing")
pull = jax.jit(geometry_module.pull, static_argnames="routing")


def poses(leg: kin.Leg, routing: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Hip and knee angles spread over the leg's range, in double precision, of shape (n, *leg)."""
    rng = np.random.default_rng(0)
    q1 = rng.uniform(-HIP, HIP, (n, *np.shape(leg.l1)))
    low, high, _ = knee_range(leg, q1, routing)
    return q1, np.asarray(low + (high - low) * rng.uniform(0, 1, q1.shape))


@functools.cache
def mujoco_leg(g: LegGeometry) -> mujoco.MjModel:
    """The leg as three hinges, with a tendon for each routing; that of type 1 reaches the pulley at its top."""
    s, l1, l2, l3, l4 = g.knee_direction, g.l1, g.l2, g.l3, g.l4
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><compiler angle="radian"/><worldbody>
      <site name="axis"/> <site name="guide" pos="0 {g.guide[0]} {g.guide[1]}"/>
      <site name="behind" pos="0 {-0.05 * s} {g.pulley_height + g.pulley_radius}"/>
      <site name="beside_pulley" pos="0 {0.02 * s} {g.pulley_height}"/>
      <site name="lead" pos="0 0 {geometry_module.lead_height(g)}"/>
      <site name="beside" pos="0 {-2 * s * IDLER_RADIUS} 0"/>
      <geom name="idler" type="cylinder" size="{IDLER_RADIUS} 0.01" zaxis="1 0 0"/>
      <geom name="pulley" type="cylinder" size="{g.pulley_radius} 0.01" pos="0 0 {g.pulley_height}" zaxis="1 0 0"/>
      <body>
        <joint name="hip" axis="1 0 0"/> <geom size="0.001"/>
        <body pos="0 0 {-l1}">
          <joint name="knee" axis="{s} 0 0"/> <geom size="0.001"/>
          <site name="knee"/> <site name="attachment" pos="0 0 {-l2}"/>
          <body pos="0 0 {-l3}" euler="{-g.theta3} 0 0">
            <joint name="ankle" axis="-1 0 0"/> <geom size="0.001"/>
            <site name="ankle"/> <site name="foot" pos="0 0 {-l4}"/>
          </body>
        </body>
      </body>
    </worldbody><tendon>
      <spatial name="type1">
        <site site="behind"/><geom geom="pulley" sidesite="beside_pulley"/><site site="attachment"/>
      </spatial>
      <spatial name="type2"><site site="guide"/><site site="attachment"/></spatial>
      <spatial name="type3"><site site="axis"/><site site="attachment"/></spatial>
      <spatial name="type3_idler">
        <site site="lead"/><geom geom="idler" sidesite="beside"/><site site="attachment"/>
      </spatial>
    </tendon></mujoco>""")


def test_an_idler_couples_knee_and_hip_by_its_radius():
    """A swing of the hip winds up the tendon: the servo makes up r_i / r_p of it, in front and behind, forward; with
    type 3 nothing."""
    for geometry in (FRONT_LEG, REAR_LEG):
        leg = kin.leg_of(geometry)
        for routing, share in (
            ("type3", 0.0),
            ("type3_idler", -IDLER_RADIUS / geometry.pulley_radius),
        ):
            servo = np.asarray(kin.knee_servo(leg, np.array([-0.2, 0.3]), np.full(2, 1.4), routing))
            assert servo[1] - servo[0] == pytest.approx(0.5 * share, abs=1e-6)


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_points_are_where_mujoco_puts_them(geometry):
    """The same hip, knee and ankle angles give the same points of the leg as a chain of MuJoCo hinges."""
    model = mujoco_leg(geometry)
    data = mujoco.MjData(model)
    with jax.enable_x64(True):
        q1, theta = poses(kin.leg_of(geometry), "type3", 40)
        ankle = np.linspace(-0.5, 0.5, 40)
        ours = kin.points(kin.leg_of(geometry), q1, theta, ankle)
    for i in range(40):
        data.qpos[:] = q1[i], theta[i], ankle[i]
        mujoco.mj_forward(model, data)
        for name, point in ours._asdict().items():
            np.testing.assert_allclose(point[i], data.site(name).xpos[1:], atol=1e-12)


@pytest.mark.parametrize("routing", ROUTINGS)
@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_tendon_lengths_are_those_of_mujoco(geometry, routing):
    """Types 2 and 3 equal MuJoCo's tendon length, and where it is wound up, MuJoCo's up to a constant.

    MuJoCo has a tendon jump off its idler where B is above that.
    """
    model = mujoco_leg(geometry)
    data = mujoco.MjData(model)
    leg = kin.leg_of(geometry)
    with jax.enable_x64(True):
        q1, theta = poses(leg, routing, 40)
        if routing == "type3_idler":
            below = np.asarray(kin.points(leg, q1, theta).attachment)[:, 1] < 0.0
            q1, theta = q1[below], theta[below]
            assert len(q1) > 20
        ours = np.asarray(pull(leg, q1, theta, routing))
    theirs = []
    for angles in zip(q1, theta, strict=True):
        data.qpos[:2] = angles
        mujoco.mj_forward(model, data)
        theirs.append(data.tendon(routing).length[0])
    difference = ours - theirs
    np.testing.assert_allclose(
        difference, difference[0] if routing in ("type1", "type3_idler") else 0.0, atol=1e-12
    )


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_type_1_agrees_with_the_published_spiral(geometry):
    """The knee found for (q1, q2) is a solution of the spiral model (5.3-5.11), solved here with scipy."""
    g, s = geometry, geometry.knee_direction
    leg = kin.leg_of(g)
    with jax.enable_x64(True):
        q1, theta = poses(leg, "type1", 25)
        q2 = np.asarray(knee_servo(leg, q1, theta, "type1"))
        knee_angle = forward(leg, np.stack([q1, q2], -1), routing="type1").knee_angle
        ours = np.asarray(kin.points(leg, q1, knee_angle).attachment)

    def spiral(length: float, servo: float) -> np.ndarray:
        wrap = (length - g.tendon_length) / g.pulley_radius - g.servo_direction * servo
        radius = math.hypot(length, g.pulley_radius)
        angle = math.atan(length / g.pulley_radius) - wrap
        return np.array([s * radius * math.cos(angle), g.pulley_height - radius * math.sin(angle)])

    lengths = np.linspace(1e-4, 0.08, 400)
    for i in range(25):
        knee = g.l1 * np.array([math.sin(q1[i]), -math.cos(q1[i])])

        def gap(length: float, servo: float = q2[i], knee: np.ndarray = knee) -> float:
            return float(np.linalg.norm(spiral(length, servo) - knee)) - g.l2

        gaps = np.array([gap(length) for length in lengths])
        roots = [
            brentq(gap, *lengths[j : j + 2], xtol=1e-15)
            for j in np.flatnonzero(gaps[:-1] * gaps[1:] <= 0)
        ]
        assert min(np.linalg.norm(spiral(root, q2[i]) - ours[i]) for root in roots) < 1e-9


@pytest.mark.parametrize(("x64", "tolerance"), [(True, 1e-9), (False, 2e-4)])
@pytest.mark.parametrize("routing", ROUTINGS)
def test_inverse_undoes_forward(routing, x64, tolerance):
    """inverse(forward(servo)) returns the servo angles, and forward(inverse(foot)) the foot, for all four legs."""
    with jax.enable_x64(x64):
        legs = kin.four_legs(ROBOT)
        q1, theta = poses(legs, routing, 2000)
        servo = jnp.stack([jnp.asarray(q1), knee_servo(legs, q1, theta, routing)], axis=-1)
        pose = forward(legs, servo, routing=routing)
        solution = inverse(legs, pose.foot, routing=routing)
        solved_pose = forward(legs, solution.servo, routing=routing)
        np.testing.assert_allclose(pose.knee_angle, theta, atol=tolerance)
        np.testing.assert_allclose(solution.servo, servo, atol=tolerance)
        np.testing.assert_allclose(solution.knee_angle, theta, atol=tolerance)
        np.testing.assert_allclose(solved_pose.foot, pose.foot, atol=1e-12 if x64 else 1e-6)
        assert pose.reachable.all()
        assert solution.reachable.all()


@pytest.mark.parametrize("routing", ROUTINGS)
def test_pulling_the_tendon_always_flexes_the_knee(routing):
    """Over the whole knee range the tendon's length falls with the knee angle, with a lever of at least 0.4 mm."""
    with jax.enable_x64(True):
        legs = kin.four_legs(ROBOT)
        q1 = np.random.default_rng(1).uniform(-2.0, 2.0, (500, 4))
        low, high, works = knee_range(legs, q1, routing)
        theta = low + (high - low) * np.linspace(0, 1, 30)[:, None, None]
        lever = np.asarray(
            jax.jvp(
                lambda angle: pull(legs, q1, angle, routing), (theta,), (jnp.ones_like(theta),)
            )[1]
        )
    assert works.all()
    assert (lever < -4e-4).all()


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_neutral_stance_bends_the_knee_its_own_way(geometry):
    """At the neutral stance of Table A.7 the front knee points backward, the rear knee forward."""
    neutral = np.array((-0.005, -0.045) if geometry is FRONT_LEG else (0.0, -0.050))
    solution = inverse(kin.leg_of(geometry), neutral, routing="type3")
    points = kin.points(kin.leg_of(geometry), solution.servo[0], solution.knee_angle)
    np.testing.assert_allclose(points.foot, neutral, atol=1e-6)
    assert solution.reachable
    # y of the knee times z of the foot: negative where the knee lies behind the line from axis to foot.
    side = points.knee[0] * points.foot[1] - points.knee[1] * points.foot[0]
    assert np.sign(side) == geometry.knee_direction


def test_published_balance_stance_has_the_published_height():
    """With theta_2 = 0 in type 3, the servo angles of the balance test put the COM about 0.057 m above the ground."""
    front = forward(kin.leg_of(FRONT_LEG), np.array([0.42, 0.60]), routing="type3").foot
    rear = forward(kin.leg_of(REAR_LEG), np.array([-0.15, -0.66]), routing="type3").foot
    # Shoulder, hip and COM below the spine base (Table A.5; COM of the two-mass model); soles of 2 mm radius.
    ground = 0.5 * ((-0.0324 + front[1]) + (-0.0253 + rear[1])) - 0.002
    assert -0.0287 - ground == pytest.approx(0.057, abs=0.003)


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_unreachable_feet_go_to_the_nearest_reachable_one(geometry):
    """No foot of a dense sample of the workspace is nearer to the wanted one than the returned foot."""
    leg = kin.leg_of(geometry)
    low, high = arm_range(leg)
    q1, theta = np.meshgrid(np.linspace(-np.pi, np.pi, 721), np.linspace(low, high, 60))
    workspace = np.asarray(kin.points(leg, q1, theta).foot).reshape(-1, 2)
    angle = np.linspace(-np.pi, np.pi, 12, endpoint=False)
    direction = np.stack([np.sin(angle), np.cos(angle)], -1)
    targets = np.concatenate([radius * direction for radius in (0.001, 0.004, 0.08, 0.3, 3.0)])
    solution = inverse(leg, targets, routing="type3")
    ours = np.linalg.norm(solution.foot - targets, axis=-1)
    best = np.linalg.norm(workspace[None] - targets[:, None], axis=-1).min(axis=1)
    assert not solution.reachable.any()
    assert (ours < best + 1e-6).all()
    np.testing.assert_allclose(ours, best, atol=5e-4)  # the sample's spacing


@pytest.mark.parametrize("routing", ROUTINGS)
def test_huge_feet_and_servos_saturate(routing):
    """A foot at 1e30 m gives the stretched leg in its direction; a servo at 1e30 rad the end of the knee's range."""
    leg = kin.leg_of(FRONT_LEG)
    near, far = (
        inverse(leg, np.array([0.0, -size], np.float32), routing=routing) for size in (0.3, 1e30)
    )
    np.testing.assert_allclose(near.servo, far.servo, atol=1e-6)
    assert not far.reachable
    low, high, _ = knee_range(leg, jnp.asarray(0.2), routing)
    tight, slack = (
        forward(leg, np.array([0.2, size], np.float32), routing=routing) for size in (-1e30, 1e30)
    )
    np.testing.assert_allclose(tight.knee_angle, high, atol=2e-5)
    np.testing.assert_allclose(slack.knee_angle, low, atol=2e-5)
    assert not tight.reachable
    assert not slack.reachable


@pytest.mark.release
@pytest.mark.parametrize("routing", ROUTINGS)
def test_jacobian_is_the_finite_difference(routing):
    """d(y, z)/d(q1, q2) equals a central difference of the forward kinematics, for all four legs."""
    with jax.enable_x64(True):
        legs = kin.four_legs(ROBOT)
        q1, theta = poses(legs, routing, 50)
        servo = np.stack([q1, knee_servo(legs, q1, theta, routing)], axis=-1)
        ours = jacobian(legs, servo, routing=routing)
        # Away from the ends of the knee's range, where the pose saturates within the step.
        low, high, _ = knee_range(legs, q1, routing)
        inner = np.asarray((theta > low + 0.02) & (theta < high - 0.02))
        for column, step in enumerate(1e-6 * np.eye(2)):
            difference = (
                forward(legs, servo + step, routing=routing).foot
                - forward(legs, servo - step, routing=routing).foot
            ) / 2e-6
            np.testing.assert_allclose(
                ours[..., column][inner], difference[inner], rtol=1e-5, atol=1e-8
            )


def test_the_geometry_is_differentiable():
    """The implicit derivative of type 1 with respect to a link length, through the solver, is the finite difference."""
    with jax.enable_x64(True):
        leg, servo = kin.leg_of(REAR_LEG), jnp.array([0.3, -0.5])

        def foot(length):
            return forward(dataclasses.replace(leg, l2=length), servo, routing="type1").foot

        l2 = jnp.asarray(leg.l2)
        difference = (foot(l2 + 1e-6) - foot(l2 - 1e-6)) / 2e-6
        np.testing.assert_allclose(jax.jacfwd(foot)(l2), difference, rtol=1e-6)
        np.testing.assert_allclose(jax.jacrev(foot)(l2), difference, rtol=1e-6)


def test_legs_and_batches_broadcast():
    """Four legs with a batch of feet (N, 4, 2) give what each leg gives alone, also under vmap."""
    legs = kin.four_legs(ROBOT)
    feet = np.array([0.0, -0.045]) + np.random.default_rng(2).uniform(-0.01, 0.01, (5, 4, 2))
    batch_result = inverse(legs, feet, routing="type2")
    mapped = jax.jit(jax.vmap(lambda foot: kin.inverse_kinematics(legs, foot, "type2")))(feet)
    for limb, geometry in enumerate((FRONT_LEG, FRONT_LEG, REAR_LEG, REAR_LEG)):
        single_result = inverse(kin.leg_of(geometry), feet[:, limb], routing="type2")
        np.testing.assert_allclose(batch_result.servo[:, limb], single_result.servo, atol=1e-6)
    np.testing.assert_allclose(batch_result.servo, mapped.servo, atol=1e-6)
    assert jax.eval_shape(functools.partial(kin.jacobian, routing="type2"), legs, feet).shape == (
        5,
        4,
        2,
        2,
    )


@jax.jit
def everything(values):
    """All results of both directions for four legs and three routings, and both their derivatives."""
    legs = kin.four_legs(ROBOT)

    def results(values):
        poses = [kin.forward_kinematics(legs, values, routing) for routing in ROUTINGS]
        solutions = [kin.inverse_kinematics(legs, values, routing) for routing in ROUTINGS]
        return [(p.foot, p.knee_angle) for p in poses], [
            (s.servo, s.knee_angle, s.foot) for s in solutions
        ]

    value, push = jax.linearize(results, values)
    # Every leg depends on its own pair alone, so two tangents hold the whole Jacobian.
    tangents = jax.vmap(push)(jnp.broadcast_to(jnp.eye(2, dtype=values.dtype)[:, None], (2, 4, 2)))
    return value, tangents, jax.linear_transpose(push, values)(jax.tree.map(jnp.ones_like, value))


def assert_finite(values):
    for leaf in jax.tree.leaves(everything(values)):
        assert np.isfinite(leaf).all(), values


def pairs(dtype):
    """Four pairs of any finite numbers, half of them of the size of a leg."""
    width = np.finfo(dtype).bits
    any_finite = st.floats(width=width, allow_nan=False, allow_infinity=False)
    return hnp.arrays(dtype, (4, 2), elements=any_finite | st.floats(-0.125, 0.125, width=width))


@pytest.mark.release
@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_any_numbers_give_finite_values_and_derivatives(real):
    """Servo angles or feet may be any finite numbers: values, jvp and grad hold no NaN and no infinity."""
    check = given(pairs(real))(assert_finite)
    for values in (
        np.zeros((4, 2), real),
        np.full((4, 2), np.finfo(real).max),
        np.full((4, 2), -np.finfo(real).max),
    ):
        check = example(values)(check)
    with jax.enable_x64(real is np.float64):
        settings(max_examples=100, deadline=None)(check)()


@pytest.mark.release
@pytest.mark.parametrize("x64", [False, True])
def test_the_border_of_the_workspace_has_finite_derivatives(x64):
    """Feet and servos exactly on the border, and a rounding error to either side of it, are differentiable."""
    with jax.enable_x64(x64):
        legs = kin.four_legs(ROBOT)
        for q1 in (-1.2, 0.0, 0.7):
            for routing in ROUTINGS:
                for end in knee_range(legs, q1, routing)[:2]:
                    end = jnp.broadcast_to(end, (4,))
                    foot = kin.points(legs, q1, end).foot
                    servo = jnp.stack(
                        [jnp.full(4, q1), knee_servo(legs, q1, end, routing)], axis=-1
                    )
                    for values in (foot, servo):
                        for scale in (1 - 3e-7, 1.0, 1 + 3e-7):
                            assert_finite(scale * values)
