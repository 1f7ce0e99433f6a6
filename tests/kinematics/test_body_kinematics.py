# Tests of kinematics/body.py
"""Hips, diagonals, centre of mass and balance against a MuJoCo body built from the same numbers."""

from __future__ import annotations

import functools
import itertools

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from nermo_mjx.kinematics import body
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.masses import MassModel
from nermo_mjx.robot.parameters import BODY_GEOMETRY, LIMBS, SPINE_GEOMETRY

#: The published robot.
ROBOT = Geometry()

FRONT_COM, REAR_COM = (0.0, -0.0317, -0.0270), (0.0, 0.0310, -0.0160)
MASSES = MassModel(0.1647, 0.1053, np.array(FRONT_COM), np.array(REAR_COM))
#: Feet (y, z) of the walking stance (Table A.7), of the balance test's stance, and in the middle of a lateral gait.
WALKING = np.array([[-0.005, -0.045]] * 2 + [[0.0, -0.050]] * 2)
BALANCING = np.array([[-0.0161, -0.0498]] * 2 + [[0.0287, -0.0558]] * 2)
STRIDING = np.array([[-0.020, -0.045], [0.010, -0.045], [0.010, -0.050], [-0.015, -0.050]])
#: All sixteen ways to stand.
STANCES = np.array(list(itertools.product([False, True], repeat=4)))

balance_angle = jax.jit(body.balance_angle)


@functools.cache
def mujoco_body() -> mujoco.MjModel:
    """The spine's DH chain with a mass and two shoulders before it, a mass and two hips behind it."""
    (sx, sy, sz), (hx, hy, hz) = BODY_GEOMETRY.shoulder, BODY_GEOMETRY.hip

    def point_mass(com, mass):
        return f'<inertial pos="{com[0]} {com[1]} {com[2]}" mass="{mass}" diaginertia="1e-6 1e-6 1e-6"/>'

    chain = "".join(
        f'<body pos="{a} 0 {d}" euler="{alpha} 0 {theta}">{point_mass((0, 0, 0), 1e-12)}'
        + ('<joint axis="0 0 -1"/>' if row in SPINE_GEOMETRY.lateral_joints else "")
        for row, (alpha, a, theta, d) in enumerate(SPINE_GEOMETRY.dh)
    )
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><compiler angle="radian" boundmass="0"/><worldbody><body name="front">
      {point_mass(FRONT_COM, MASSES.front_mass)}
      <site name="shoulder_left" pos="{sx} {sy} {sz}"/><site name="shoulder_right" pos="{-sx} {sy} {sz}"/>
      {chain}<body name="rear">
        {point_mass(REAR_COM, MASSES.rear_mass)}
        <site name="hip_left" pos="{hx} {hy} {hz}"/><site name="hip_right" pos="{-hx} {hy} {hz}"/>
      </body>{"</body>" * len(SPINE_GEOMETRY.dh)}
    </body></worldbody></mujoco>""")


def mujoco_at(theta_v: float) -> mujoco.MjData:
    data = mujoco.MjData(mujoco_body())
    data.qpos[:] = theta_v
    mujoco.mj_forward(mujoco_body(), data)
    return data


def mujoco_feet(data: mujoco.MjData, feet: np.ndarray) -> np.ndarray:
    """Feet (4, 3) that hang at (y, z) in the frames of MuJoCo's shoulder and hip sites."""
    sites = [
        data.site(name) for name in ("shoulder_left", "shoulder_right", "hip_left", "hip_right")
    ]
    return np.array(
        [
            site.xpos + site.xmat.reshape(3, 3) @ (0.0, *foot)
            for site, foot in zip(sites, feet, strict=True)
        ]
    )


def right_of(point: np.ndarray, front: np.ndarray, rear: np.ndarray) -> float:
    """How far right of the line from the rear to the front foot a point lies, seen from above (y is backward)."""
    forward = (front - rear)[:2] / np.linalg.norm((front - rear)[:2])
    return float(np.dot((point - rear)[:2], (forward[1], -forward[0])))


def test_hips_and_centre_of_mass_are_where_mujoco_puts_them():
    """Hip axes, their rise, the diagonals, the feet and the centre of mass equal those of the MuJoCo body."""
    theta = np.linspace(-0.3, 0.3, 13)
    with jax.enable_x64(True):
        hips, rise, lengths = (
            body.hips(theta, ROBOT),
            body.hip_height_offset(theta, ROBOT),
            body.diagonals(theta, ROBOT),
        )
        com, feet = (
            body.centre_of_mass(MASSES, theta, ROBOT),
            body.feet_positions(theta, STRIDING, ROBOT),
        )
    neutral = mujoco_at(0.0)
    for i, angle in enumerate(theta):
        data = mujoco_at(angle)
        for side, name in enumerate(("left", "right")):
            opposite = ("right", "left")[side]
            hip = data.site(f"hip_{name}").xpos
            np.testing.assert_allclose(hips[i, side], hip, atol=1e-12)
            np.testing.assert_allclose(
                rise[i, side], hip[2] - neutral.site(f"hip_{name}").xpos[2], atol=1e-12
            )
            diagonal = np.linalg.norm(
                data.site(f"shoulder_{name}").xpos - data.site(f"hip_{opposite}").xpos
            )
            np.testing.assert_allclose(lengths[i, side], diagonal, atol=1e-12)
        np.testing.assert_allclose(com[i], data.subtree_com[0], atol=1e-10)
        np.testing.assert_allclose(feet[i], mujoco_feet(data, STRIDING), atol=1e-12)


def test_neutral_positions_are_the_published_ones():
    """Shoulders and hips of the straight spine are those of Table A.5 with its errata, left before right."""
    np.testing.assert_allclose(body.shoulders(ROBOT)[0], (0.0368, -0.0615, -0.0324), atol=1e-7)
    np.testing.assert_allclose(
        body.hips(0.0, ROBOT), [(0.0428, 0.0604, -0.0253), (-0.0428, 0.0604, -0.0253)], atol=1e-4
    )
    np.testing.assert_allclose(body.hip_height_offset(0.0, ROBOT), 0.0, atol=1e-8)


def test_bending_left_extends_the_front_left_diagonal():
    """Both diagonals are monotonic over the usable range, in opposite senses, and mirror each other (erratum 7)."""
    with jax.enable_x64(True):
        lengths = np.asarray(body.diagonals(np.linspace(-0.1, 0.1, 41), ROBOT))
    assert (np.diff(lengths[:, 0]) > 0).all()
    assert (np.diff(lengths[:, 1]) < 0).all()
    np.testing.assert_allclose(lengths[:, 0], lengths[::-1, 1], atol=1e-12)


@pytest.mark.release
def test_stride_gain_is_the_published_one():
    """0.1 rad a joint gains about 0.015 m a stride, and the gain is monotonic and odd in the angle."""
    assert float(body.stride_gain(0.1, ROBOT)) == pytest.approx(0.015, abs=5e-4)
    gains = np.asarray(body.stride_gain(np.linspace(-0.1, 0.1, 21), ROBOT))
    assert (np.diff(gains) > 0).all()
    np.testing.assert_allclose(gains, -gains[::-1], atol=1e-7)


def test_stride_gain_is_what_stiff_legs_would_walk():
    """The gain is the mean backward travel of the standing shoulder and hip, seen from the body's heading."""

    def stations(theta_v):
        """y of the front left shoulder and rear right hip along the heading, from the midpoint of the girdles."""
        data = mujoco_at(theta_v)
        left, right, hip_left, hip_right = (
            data.site(name).xpos[:2]
            for name in ("shoulder_left", "shoulder_right", "hip_left", "hip_right")
        )
        axis = hip_left - hip_right
        heading = np.arctan2(axis[1], axis[0]) / 2
        backward = np.array([-np.sin(heading), np.cos(heading)])
        middle = (left + right + hip_left + hip_right) / 4
        return np.array([(left - middle) @ backward, (hip_right - middle) @ backward])

    for theta_v in (0.03, 0.1):
        travel = np.mean(stations(theta_v) - stations(-theta_v))
        assert float(body.stride_gain(theta_v, ROBOT)) == pytest.approx(travel, rel=1e-4)


def test_mass_model_may_be_batched():
    """Masses and centres with leading axes give one centre of mass each."""
    scale = np.array([0.5, 1.0, 2.0])
    batch = MassModel(
        0.1647 * scale, np.full(3, 0.1053), np.tile(FRONT_COM, (3, 1)), np.tile(REAR_COM, (3, 1))
    )
    batch_result = body.centre_of_mass(batch, 0.05, ROBOT)
    for i in range(3):
        single = MassModel(0.1647 * scale[i], 0.1053, np.array(FRONT_COM), np.array(REAR_COM))
        np.testing.assert_allclose(
            batch_result[i], body.centre_of_mass(single, 0.05, ROBOT), atol=1e-7
        )


def test_diagonal_distance_is_published_and_signed():
    """(5.35) without its absolute value: positive to the right of the line from rear to front foot."""
    rng = np.random.default_rng(0)
    point, f, r = rng.uniform(-0.1, 0.1, (3, 30, 2))
    a, b, c = f[:, 1] - r[:, 1], r[:, 0] - f[:, 0], f[:, 0] * r[:, 1] - f[:, 1] * r[:, 0]
    published = (a * point[:, 0] + b * point[:, 1] + c) / np.hypot(a, b)
    with jax.enable_x64(True):
        ours = body.diagonal_distance(point, f, r)
    np.testing.assert_allclose(ours, published, atol=1e-12)
    np.testing.assert_allclose(
        ours, [right_of(*row) for row in zip(point, f, r, strict=True)], atol=1e-12
    )
    # The robot's right is -x; forward is -y.
    assert float(
        body.diagonal_distance(*np.array([(-0.01, 0.0), (0.0, -0.1), (0.0, 0.1)]))
    ) == pytest.approx(0.01)


@pytest.mark.parametrize(
    "feet", [WALKING, BALANCING, STRIDING], ids=["walking", "balancing", "striding"]
)
@pytest.mark.parametrize("lift", [0.0, 0.009])
def test_balance_meets_its_condition_in_mujoco(feet, lift):
    """For every stance the MuJoCo body at the returned angle has the wanted d, or the best that the limit allows."""
    limit = 0.1
    with jax.enable_x64(True):
        angles = np.asarray(
            balance_angle(MASSES, np.broadcast_to(feet, (16, 4, 2)), STANCES, ROBOT, lift, limit)
        )
    solved = 0
    for stance, angle in zip(STANCES, angles, strict=True):
        front, rear = np.flatnonzero(stance[:2]), 2 + np.flatnonzero(stance[2:])
        if stance.sum() == 4 or not (len(front) and len(rear)):
            assert angle == 0.0
            continue
        # Of three feet, the pair that are not on the same side carries.
        f, r = next((f, r) for f in front for r in rear if stance.sum() == 2 or (f - r) % 2)
        (third,) = set(np.flatnonzero(stance)) - {f, r} or {None}

        def distance(theta_v, point=None, f=f, r=r):
            data = mujoco_at(theta_v)
            ground = mujoco_feet(data, feet)
            return right_of(
                data.subtree_com[0] if point is None else ground[point], ground[f], ground[r]
            )

        expected = 0.0 if third is None else lift * np.sign(distance(0.0, point=third))
        reached, ends = distance(angle), [distance(-limit), distance(limit)]
        assert abs(angle) <= limit
        assert reached == pytest.approx(np.clip(expected, min(ends), max(ends)), abs=1e-9)
        solved += abs(reached - expected) < 1e-9
    # In the walking stance 0.1 rad are not enough for the diagonal, in the stance of the balance test they are.
    assert solved >= (4 if feet is BALANCING else 0)


def test_the_spine_bends_towards_balance():
    """With a hind leg up the centre of mass lies behind the diagonal; the spine bends to the side of the lifted leg."""
    lifted = {limb: np.array([name != limb for name in LIMBS]) for limb in LIMBS}
    left, right = (
        float(balance_angle(MASSES, BALANCING, lifted[limb], ROBOT, 0.009))
        for limb in ("rear_left", "rear_right")
    )
    assert left == pytest.approx(-right, abs=1e-5)
    assert abs(left) > 0.05
    # With the rear left leg up, the front left - rear right diagonal carries; the third foot is the front right one.
    before, after = (
        right_of(data.subtree_com[0], *mujoco_feet(data, BALANCING)[[0, 3]])
        for data in (mujoco_at(0.0), mujoco_at(left))
    )
    assert before < 0 < after


@pytest.mark.release
def test_balance_without_a_published_lift_reaches_the_limit():
    """A lift that no angle can reach gives the limit, whatever the limit."""
    stance = np.array([True, True, False, True])
    for limit in (0.02, 0.1):
        assert abs(
            float(balance_angle(MASSES, BALANCING, stance, ROBOT, 0.5, limit))
        ) == pytest.approx(limit, rel=1e-4)


@pytest.mark.release
def test_balance_is_differentiable():
    """The implicit derivatives with respect to feet and lift are central differences of the solution."""
    stance, feet = np.array([True, False, True, True]), BALANCING
    with jax.enable_x64(True):

        def solve(y, lift):
            return balance_angle(MASSES, jnp.asarray(feet).at[3, 0].set(y), stance, ROBOT, lift)

        y, lift, step = feet[3, 0], 0.009, 1e-6
        gradient = jax.jit(jax.grad(solve, argnums=(0, 1)))(y, lift)
        numeric = (
            (solve(y + step, lift) - solve(y - step, lift)) / (2 * step),
            (solve(y, lift + step) - solve(y, lift - step)) / (2 * step),
        )
        np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-8)
        assert abs(gradient[1]) > 1.0


@jax.jit
def everything(values):
    """All body functions of any numbers, for all stances, with forward and reverse derivatives."""

    def results(values):
        theta, lift, feet = values[0], values[1], values[2:10].reshape(4, 2)
        return (
            body.hips(theta, ROBOT),
            body.hip_height_offset(theta, ROBOT),
            body.diagonals(theta, ROBOT),
            body.stride_gain(theta, ROBOT),
            body.centre_of_mass(MASSES, theta, ROBOT),
            body.balance_angle(MASSES, feet, STANCES, ROBOT, lift),
        )

    gradient = jax.grad(lambda values: sum(jnp.sum(leaf) for leaf in results(values)))(values)
    return results(values), jax.jacfwd(results)(values), gradient


def numbers(dtype):
    """Ten numbers, any finite ones or of the size of feet and angles."""
    width = np.finfo(dtype).bits
    any_finite = st.floats(width=width, allow_nan=False, allow_infinity=False)
    return hnp.arrays(dtype, 10, elements=any_finite | st.floats(-0.125, 0.125, width=width))


@pytest.mark.release
@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_any_numbers_give_finite_values_and_derivatives(real):
    """Any finite angle, lift and feet, for every stance, give finite results and derivatives."""

    @settings(max_examples=100, deadline=None)
    @example(np.zeros(10, real))
    @example(np.full(10, np.finfo(real).max))
    @given(numbers(real))
    def check(values):
        for leaf in jax.tree.leaves(everything(values)):
            assert np.isfinite(leaf).all(), values

    with jax.enable_x64(real is np.float64):
        check()
