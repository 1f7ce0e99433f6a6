# Tests of control/turning.py, control/parameters.py
"""Speed law, turning curve, stride shares and the radii of theory, against the thesis' figures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nermo_mjx.control import control_parameters, turning
from nermo_mjx.control.parameters import STEERING, Gait, Stance, Turning
from nermo_mjx.control.trajectory import neutral_feet
from nermo_mjx.kinematics.body import feet_positions
from nermo_mjx.kinematics.spine import joint_angle, transform
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import GAIT_PATTERNS
from nermo_mjx.robot.quantity import replace_quantities

#: The published robot.
ROBOT = Geometry()

path_curvature, smallest_radius = jax.jit(turning.path_curvature), jax.jit(turning.smallest_radius)
stride_shares, leg_radius = jax.jit(turning.stride_shares), jax.jit(turning.leg_radius)
slopes_of_turning_curve = jax.jit(jax.grad(turning.turning_curve, argnums=(0, 1)))

rates = st.floats(-1, 1, width=32, allow_subnormal=False)


def turning_of(exponent=5.0, leg=1.0, spine=0.0) -> Turning:
    return Turning(exponent=jnp.float32(exponent), leg=jnp.float32(leg), spine=jnp.float32(spine))


def test_the_trot_at_0_8_hz_with_the_full_stride_walks_at_the_speed_of_theory():
    """6.2.1: 0.096 m/s without the spine, 0.120 m/s with a stride longer by 0.015 m."""
    gait = Gait(
        frequency=np.float32(0.8), gait_factor=np.float32(GAIT_PATTERNS["trot"].gait_factor)
    )
    assert turning.body_speed(gait, 0.06) == pytest.approx(0.096, rel=1e-3)
    assert turning.body_speed(gait, 0.075) == pytest.approx(0.120, rel=1e-3)


@pytest.mark.parametrize("gait", GAIT_PATTERNS)
@pytest.mark.parametrize("frequency", [0.5, 0.67, 0.8])
def test_the_stride_gives_the_commanded_speed_until_it_saturates(gait, frequency):
    parameters = Gait(
        frequency=np.float32(frequency), gait_factor=np.float32(GAIT_PATTERNS[gait].gait_factor)
    )
    largest = turning.body_speed(parameters, 0.06)
    for speed in (0.0, 0.01, 0.04):
        stride = turning.stride_length(parameters, Stance(), speed)
        assert turning.body_speed(parameters, stride) == pytest.approx(speed)
    assert turning.stride_length(parameters, Stance(), 2 * largest) == pytest.approx(0.06)
    shorter = dataclasses.replace(parameters, stride=np.float32(0.8))
    assert turning.stride_length(shorter, Stance(), 2 * largest) == pytest.approx(0.048)


@pytest.mark.parametrize(
    ("rate", "shares"), [(1.0, [0, 1, 0, 1]), (-1.0, [1, 0, 1, 0]), (0.0, [1, 1, 1, 1])]
)
def test_full_input_stops_the_inner_legs(rate, shares):
    """Positive turns left, so the left legs FL and RL are the inner ones; not so where the legs do not turn.

    Erratum 4: t = 0 is not a^0 = 1.
    """
    np.testing.assert_allclose(stride_shares(turning_of(), jnp.float32(rate)), shares, atol=1e-6)
    for still in (turning_of(0.0), turning_of(leg=0.0)):
        np.testing.assert_array_equal(stride_shares(still, jnp.float32(rate)), jnp.ones(4))


@settings(max_examples=50, deadline=None)
@given(rates, st.floats(0, 20, width=32, allow_subnormal=False))
def test_stride_shares_stay_in_range_and_mirror_with_the_turn_rate(rate, exponent):
    shares = stride_shares(turning_of(exponent), jnp.float32(rate))
    assert ((shares >= 0) & (shares <= 1)).all()
    mirrored = stride_shares(turning_of(exponent), jnp.float32(-rate))
    np.testing.assert_array_equal(shares[jnp.asarray([1, 0, 3, 2])], mirrored)


@pytest.mark.parametrize("exponent", [0.3, 1.0, 2.0, 5.0])
def test_the_turning_curve_is_the_signed_power(exponent):
    """(5.38, 5.39) with the sign kept (erratum 4); below 1e-3 a straight line replaces the power."""
    rate = np.array([-1.0, -0.5, -0.01, 0.0, 0.01, 0.5, 1.0])
    curve = turning.turning_curve(jnp.asarray(rate), jnp.float32(exponent))
    np.testing.assert_allclose(curve, np.sign(rate) * np.abs(rate) ** exponent, rtol=1e-5)


def test_the_spine_share_switches_the_spine():
    assert turning.spine_share(turning_of(spine=0.0), jnp.float32(1.0)) == 0.0
    assert turning.spine_share(turning_of(spine=1.0), jnp.float32(-0.4)) == pytest.approx(-0.4)


@pytest.mark.parametrize("exponent", [0.0, 0.1, 0.5, 1.0, 5.0])
@pytest.mark.parametrize("rate", [-1.0, 0.0, 1e-4, 1.0])
def test_the_turning_curve_has_finite_derivatives(rate, exponent):
    """|a|^t has an infinite slope at 0 for t < 1."""
    slopes = slopes_of_turning_curve(jnp.float32(rate), jnp.float32(exponent))
    assert np.isfinite(slopes).all()


def test_the_smallest_radii_are_the_published_ones():
    """turning.simulation.min_radius_no_slip_theory_trt: of the legs (lb) 0.151 m, given to three digits.

    With the spine (mb) it is 0.134 m; the feet's diagonal gives 0.145 m, see `foot_diagonals`.
    """
    straight, left, right = (
        smallest_radius(jnp.float32(0.06), Stance(), jnp.float32(theta), ROBOT)
        for theta in (0.0, 0.1, -0.1)
    )
    assert straight == pytest.approx(0.151, abs=5e-4)
    assert left == pytest.approx(float(right), rel=1e-4)
    assert left == pytest.approx(0.134, rel=0.1)
    assert left < 0.151


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 0.08), st.floats(0.05, 1.0), st.floats(0.1, 0.2))
def test_the_leg_based_radius_is_the_printed_formula(stride, difference, diagonal):
    """(5.40-5.42)."""
    turn = stride * difference / diagonal
    printed = stride * np.sin((np.pi - turn) / 2) / np.sin(turn)
    assert leg_radius(stride, difference, diagonal) == pytest.approx(printed, rel=1e-4)


def test_equal_strides_walk_straight():
    radius, slope = jax.value_and_grad(lambda d: 1 / leg_radius(0.06, d, 0.15))(jnp.float32(0.0))
    assert radius == 0.0
    assert np.isfinite(slope)


def test_the_spine_based_radii_are_those_of_a_bent_line():
    """(5.43, 5.44). Without a rear part, shoulder and hip axes meet at 4 theta_v: r_shoulder = r_hip cos(4 theta_v)."""
    shoulder, hip = turning.spine_radius(jnp.float32(0.1), 0.07, 0.0)
    assert shoulder == pytest.approx(float(hip) * np.cos(0.4), rel=1e-5)
    assert hip == pytest.approx(0.07 / np.sin(0.4), rel=1e-5)
    # l_sp1 + l_sp2 is the distance from shoulder to hip axis (Table A.5).
    assert sum(turning.spine_lengths(ROBOT)) == pytest.approx(0.0615 + 0.0604, abs=1e-4)


# -- the theory inverted: the turn rate that a path needs -----------------------------------------------------------

#: Radii of the experiments, full lock and beyond, and a path that is nearly straight [1/m].
CURVATURES = np.float32([1e-3, 0.1, 0.5, 1.0, 2.0, 3.0, 6.0, 9.0, 20.0])
turn_rates_for = jax.jit(jax.vmap(turning.turn_rate_for, in_axes=(None, 0)))


def steered(steering, **values):
    """Parameters in one precision, so that all cases share a compiled program."""
    return jax.tree.map(np.float32, control_parameters(steering=steering, **values))


@pytest.mark.parametrize("steering", STEERING)
@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0, 5.0, 10.0, 20.0])
def test_the_turn_rate_for_a_curvature_walks_that_curvature_or_is_full_lock(steering, exponent):
    params = steered(steering, **{"turning.exponent": exponent})
    rates = turn_rates_for(params, CURVATURES)
    full = path_curvature(params, jnp.float32(1.0))
    np.testing.assert_allclose(
        path_curvature(params, rates), np.minimum(CURVATURES, full), rtol=1e-4, atol=4e-6
    )
    np.testing.assert_array_equal(np.asarray(rates) == 1.0, full <= CURVATURES)


@pytest.mark.parametrize("steering", STEERING)
def test_left_and_right_paths_need_opposite_turn_rates_and_a_straight_one_none(steering):
    params = steered(steering)
    rates = turn_rates_for(params, CURVATURES)
    assert (np.diff(rates) >= 0).all()
    np.testing.assert_array_equal(turn_rates_for(params, -CURVATURES), -rates)
    np.testing.assert_array_equal(turn_rates_for(params, 1 / np.float32([np.inf, -np.inf])), 0.0)
    rigid = steered("leg", **{"turning.leg": 0.0})  # no turn rate turns without legs and spine
    np.testing.assert_array_equal(turn_rates_for(rigid, CURVATURES), 0.0)


def bent_robots_curvature(theta_v):
    """Curvature of the rigid motion in which the two feet of a diagonal slip least, mean of both diagonals.

    Seen from the torso front feet go straight back, rear feet along the bent hip, all at the same speed.
    """
    feet, pose = (
        np.asarray(feet_positions(theta_v, neutral_feet(Stance()), ROBOT)),
        np.asarray(transform(theta_v, ROBOT)),
    )
    back = [np.array([0.0, 1.0]), pose[:2, 1]]
    curvatures = []
    for pair in ((0, 3), (1, 2)):
        rows = np.array([[[1, 0, -y], [0, 1, x]] for x, y in feet[list(pair), :2]], float).reshape(
            4, 3
        )
        (right, behind, turn), *_ = np.linalg.lstsq(rows, -np.concatenate(back), rcond=None)
        curvatures.append(turn / np.hypot(right, behind))
    return np.mean(curvatures)


def test_a_bent_robot_with_equal_strides_turns_as_two_feet_let_it():
    """0.44 m at 0.1047 rad a joint, not the 0.28 m of (5.43); against the least slip of two feet, within 3 %."""
    full = jnp.float32(1.0)
    for servo in (0.2, 0.4):
        expected = bent_robots_curvature(float(joint_angle(servo, ROBOT)))
        curvature = float(
            path_curvature(steered("spine", **{"spine.max_servo_angle": servo}), full)
        )
        assert curvature == pytest.approx(expected, rel=0.03)
    assert 1 / curvature == pytest.approx(0.441, rel=0.02)


def test_the_expected_curvature_of_the_legs_is_that_of_least_slip_and_the_spines_adds():
    """Oracle for the legs: the rigid motion of two feet of a diagonal that slip least, by least squares."""
    share = 0.3
    rate = jnp.float32(share**0.2)
    feet = np.asarray(feet_positions(0.0, neutral_feet(Stance()), ROBOT))[[0, 3], :2]
    # The left foot steps 1 - share, the right 1; on the ground they slide by what the body's motion does not take up.
    rows = np.array([[[1, 0, -y], [0, 1, x]] for x, y in feet], float).reshape(4, 3)
    motion, *_ = np.linalg.lstsq(rows, -np.array([0.0, 1 - share, 0.0, 1.0]), rcond=None)
    legs = float(path_curvature(steered("leg"), rate))
    assert legs == pytest.approx(motion[2] / -motion[1], rel=0.08)
    assert float(path_curvature(steered("leg"), -rate)) == pytest.approx(-legs, rel=1e-5)

    full = jnp.float32([1.0, -1.0])
    spine, mix = (path_curvature(steered(name), full) for name in ("spine", "mix"))
    assert spine[0] == -spine[1] > 0.0
    np.testing.assert_allclose(mix, path_curvature(steered("leg"), full) + spine, rtol=1e-6)


@jax.jit
def turn_rate(params, radius, servo):
    bent = replace_quantities(params, {"spine.max_servo_angle": servo})
    return turning.turn_rate_for(bent, 1.0 / radius)


slopes_of_turn_rate = jax.jit(jax.grad(turn_rate, argnums=(1, 2)))


@pytest.mark.parametrize("steering", STEERING)
@pytest.mark.parametrize("radius", [0.05, 0.2, 0.5, 1000.0])
def test_the_turn_rates_derivatives_are_those_of_differences(steering, radius):
    """In float64, by the radius and by a parameter of the theory; zero where the turn rate is at full lock."""
    with jax.enable_x64(True):
        params = jax.tree.map(np.float64, control_parameters(steering=steering))
        slopes, step = slopes_of_turn_rate(params, radius, 0.4), 1e-6
        far, near = (turn_rate(params, radius * (1 + change), 0.4) for change in (step, -step))
        larger, smaller = (turn_rate(params, radius, 0.4 + change) for change in (step, -step))
        by_radius, by_servo = (far - near) / (2 * step * radius), (larger - smaller) / (2 * step)
    np.testing.assert_allclose(slopes, [by_radius, by_servo], rtol=1e-5, atol=1e-9)
