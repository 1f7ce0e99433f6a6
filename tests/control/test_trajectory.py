# Tests of control/trajectory.py
"""Foot paths against scipy's splines, the published tracking lag against its recursion, and the gait clock."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from nermo_mjx.control import trajectory
from nermo_mjx.control.parameters import Gait, Stance, Tracking
from nermo_mjx.robot.parameters import GAIT_PATTERNS

position = jax.jit(trajectory.foot_position, static_argnames="form")
weights = jax.jit(trajectory.weights, static_argnames="form")

KNOTS = np.array([0.0, 0.5, 1.0])
PROGRESS = np.linspace(0.0, 1.0, 101)
shares = st.floats(0, 1, width=32, allow_subnormal=False)
PHASES = (np.arange(2000) + 0.5) / 2000
coordinate = st.floats(-0.125, 0.125, width=32, allow_subnormal=False)


def path(points, form="cubic"):
    return np.asarray(position(np.asarray(points, np.float32), PROGRESS, form))


@settings(max_examples=40, deadline=None)
@given(st.lists(coordinate, min_size=6, max_size=6))
def test_the_cubic_path_is_the_clamped_spline_in_y_and_the_natural_spline_in_z(values):
    """scipy's CubicSpline with the same boundary conditions is the oracle; the tolerance is float32 rounding."""
    points = np.reshape(values, (3, 2))
    y = CubicSpline(KNOTS, points[:, 0], bc_type="clamped")(PROGRESS)
    z = CubicSpline(KNOTS, points[:, 1], bc_type="natural")(PROGRESS)
    np.testing.assert_allclose(path(points), np.stack([y, z], axis=-1), atol=1e-7)


@settings(max_examples=20, deadline=None)
@given(st.lists(coordinate, min_size=6, max_size=6))
def test_the_other_forms_are_the_polyline_and_the_parabola_through_the_points(values):
    points = np.reshape(values, (3, 2))
    line = np.stack([np.interp(PROGRESS, KNOTS, column) for column in points.T], axis=-1)
    parabola = np.stack(
        [np.polyval(np.polyfit(KNOTS, column, 2), PROGRESS) for column in points.T], axis=-1
    )
    np.testing.assert_allclose(path(points, "linear"), line, atol=1e-7)
    np.testing.assert_allclose(path(points, "parabolic"), parabola, atol=1e-7)


def test_the_derivative_of_the_path_is_finite_and_continuous_over_the_mid_point():
    points = jnp.asarray([[0.03, -0.05], [0.0, -0.04], [-0.03, -0.05]])
    velocity = jax.jit(jax.vmap(jax.jacfwd(lambda progress: position(points, progress))))
    slope = velocity(jnp.asarray([0.0, 0.49999, 0.5, 0.50001, 1.0]))
    assert np.isfinite(slope).all()
    np.testing.assert_allclose(slope[1], slope[3], atol=1e-5)
    np.testing.assert_allclose(slope[2, 0], 1.5 * -0.06, rtol=1e-5)  # m1 = 3/2 (P2 - P0)
    np.testing.assert_allclose(slope[jnp.asarray([0, 4]), 0], 0.0, atol=1e-7)


def test_a_stance_foot_is_pressed_down_and_moves_backward_and_a_swing_foot_is_raised_and_moves_forward():
    """Backward is +y. Amplitudes and neutral positions are those of Table A.7."""
    stance, down = Stance(), jnp.asarray([True, False, True, False])
    points = np.asarray(trajectory.nominal_points(stance, down, jnp.full(4, 0.06)))
    neutral = np.array([[-0.005, -0.045], [-0.005, -0.045], [0.0, -0.05], [0.0, -0.05]])
    np.testing.assert_allclose(
        points[:, 1, 1] - neutral[:, 1], [-0.005, 0.01, -0.005, 0.01], atol=1e-7
    )
    np.testing.assert_allclose(
        points[:, 2, 0] - neutral[:, 0], [0.03, -0.03, 0.03, -0.03], atol=1e-7
    )
    np.testing.assert_allclose(
        points[:, 0, 0] - neutral[:, 0], [-0.03, 0.03, -0.03, 0.03], atol=1e-7
    )
    np.testing.assert_allclose(points[:, [0, 2], 1], neutral[:, 1:].repeat(2, axis=1), atol=1e-7)


def test_a_plan_starts_where_the_foot_is():
    start = jnp.asarray(np.random.default_rng(0).uniform(-0.05, 0.05, (4, 2)), jnp.float32)
    points = trajectory.plan(Stance(), start, jnp.ones(4, bool), jnp.full(4, 0.06))
    np.testing.assert_array_equal(position(points, jnp.zeros(4)), start)


def test_exact_tracking_closes_the_whole_error_and_has_a_finite_derivative():
    """(1 - g)^n has an infinite slope at g = 1, which a gradient must not meet."""
    tracking = Tracking()
    assert trajectory.share_closed(tracking, 0.01) == 1.0
    slope = jax.grad(lambda t: trajectory.share_closed(t, 0.01))(
        jax.tree.map(jnp.asarray, tracking)
    )
    assert np.isfinite(slope.foot_gain)
    assert np.isfinite(slope.clock_ratio)


@pytest.mark.parametrize("rate", [50.0, 80.0, 100.0, 500.0])
def test_the_lag_does_not_depend_on_the_control_rate(rate):
    """The oracle is the published recursion: 11 % of the error in each tick of 1/100 s of the controller's clock."""
    published = Tracking(foot_gain=np.float32(0.11), clock_ratio=np.float32(0.4))
    closed = float(trajectory.share_closed(published, 1.0 / rate))
    left_after_a_second = (1.0 - closed) ** rate
    assert left_after_a_second == pytest.approx((1.0 - 0.11) ** (100.0 / 0.4), rel=1e-3)


@pytest.mark.parametrize("form", trajectory.FORMS)
def test_the_weights_of_the_control_points_sum_to_one(form):
    """So a path moves with its points, and a foot whose points coincide stands still."""
    np.testing.assert_allclose(weights(PROGRESS, form).sum(axis=-2), 1.0, atol=1e-6)


# -- clock ---------------------------------------------------------------------------------------------------------


def gait_of(name: str) -> Gait:
    pattern = GAIT_PATTERNS[name]
    return Gait(duty=np.float32(pattern.duty), offset=np.float32(pattern.offsets))


@pytest.mark.parametrize("name", GAIT_PATTERNS)
def test_each_leg_stands_for_the_duty_share_of_the_cycle_from_its_offset_on(name):
    """Tables A.2 and A.6: stance while (phase - offset) mod 1 < duty."""
    limbs = trajectory.limb_states(gait_of(name), jnp.asarray(PHASES))
    pattern = GAIT_PATTERNS[name]
    np.testing.assert_allclose(np.mean(limbs.stance, axis=0), pattern.duty, atol=1e-3)
    local = (PHASES[:, None] - np.asarray(pattern.offsets)) % 1.0
    np.testing.assert_array_equal(limbs.stance, local < pattern.duty)


@pytest.mark.parametrize("name", GAIT_PATTERNS)
def test_progress_runs_from_zero_to_one_in_each_half_cycle(name):
    limbs = trajectory.limb_states(gait_of(name), jnp.asarray(PHASES))
    progress, stance = np.asarray(limbs.progress), np.asarray(limbs.stance)
    same_half = stance[1:] == stance[:-1]
    assert (np.diff(progress, axis=0)[same_half] > 0).all()
    assert progress.min() < 2e-3
    assert progress.max() > 1 - 2e-3
    ends, starts = progress[:-1][~same_half], progress[1:][~same_half]
    assert (ends > 1 - 3e-3).all()
    assert (starts < 3e-3).all()


def test_the_phase_integrates_a_frequency_that_changes_on_the_fly():
    """The oracle is the integral in float64; the circle closes, so the distance is taken modulo 1."""
    frequency = np.random.default_rng(0).uniform(0.1, 5.0, 2000).astype(np.float32)
    phase = jnp.zeros(())
    for value in frequency[:200]:
        phase = trajectory.advance(phase, value, 0.01)
    distance = (float(phase) - frequency[:200].astype(float).sum() * 0.01 + 0.5) % 1.0 - 0.5
    assert abs(distance) < 1e-5  # 200 roundings of 6e-8


@settings(max_examples=50, deadline=None)
@example(
    phase=-1e-9, offset=[0.0] * 4, duty=0.5
)  # modulo 1 it rounds to 1.0 in float32, which is not a phase
@given(
    st.floats(-1e6, 1e6, width=32, allow_subnormal=False),
    st.lists(shares, min_size=4, max_size=4),
    shares,
)
def test_any_phase_offset_and_duty_give_a_state_in_range(phase, offset, duty):
    """Duty 0 and 1 are refused where parameters are built; in a traced program they saturate."""
    wrapped = trajectory.wrap(jnp.float32(phase))
    assert 0.0 <= wrapped < 1.0
    limbs = trajectory.limb_states(
        Gait(duty=jnp.float32(duty), offset=jnp.asarray(offset, jnp.float32)), wrapped
    )
    assert ((limbs.progress >= 0) & (limbs.progress <= 1)).all()


def test_the_trot_keeps_its_diagonal_pairs_on_the_ground_and_the_lateral_walk_two_feet_at_least():
    """FL with RR, FR with RL. Four legs with a duty of 0.68 stand on 2.72 feet on average."""
    trot, lateral = (
        np.asarray(trajectory.limb_states(gait_of(name), jnp.asarray(PHASES)).stance)
        for name in ("trot", "lateral_walk")
    )
    np.testing.assert_array_equal(trot[:, [0, 1]], trot[:, [3, 2]])
    assert (trot.sum(axis=1) == 2).all()
    assert lateral.sum(axis=1).min() >= 2
    assert lateral.sum(axis=1).mean() == pytest.approx(4 * 0.68, abs=2e-3)
