"""The gait clock: published stance shares and offsets, and phases that stay in their cycle whatever the frequency."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nermo_mjx.control import trajectory
from nermo_mjx.control.parameters import Gait
from nermo_mjx.robot.parameters import GAIT_PATTERNS

shares = st.floats(0, 1, width=32, allow_subnormal=False)
PHASES = (np.arange(2000) + 0.5) / 2000


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
    ended, begun = progress[:-1][~same_half], progress[1:][~same_half]
    assert (ended > 1 - 3e-3).all()
    assert (begun < 3e-3).all()


def test_the_phase_integrates_a_frequency_that_changes_on_the_fly():
    """The oracle is the integral in float64; the circle closes, so the distance is taken modulo 1."""
    frequency = np.random.default_rng(0).uniform(0.1, 5.0, 2000).astype(np.float32)
    phase = jnp.zeros(())
    for value in frequency[:200]:
        phase = trajectory.advance(phase, value, 0.01)
    distance = (float(phase) - frequency[:200].astype(float).sum() * 0.01 + 0.5) % 1.0 - 0.5
    assert abs(distance) < 1e-5  # 200 roundings of 6e-8


@settings(max_examples=50, deadline=None)
@given(st.floats(-1e6, 1e6, width=32, allow_subnormal=False), st.lists(shares, min_size=4, max_size=4), shares)
def test_any_phase_offset_and_duty_give_a_state_in_range(phase, offset, duty):
    """Duty 0 and 1 are refused where parameters are built; in a traced program they saturate."""
    wrapped = trajectory.wrap(jnp.float32(phase))
    assert 0.0 <= wrapped < 1.0
    limbs = trajectory.limb_states(Gait(duty=jnp.float32(duty), offset=jnp.asarray(offset, jnp.float32)), wrapped)
    assert ((limbs.progress >= 0) & (limbs.progress <= 1)).all()


def test_a_phase_just_below_zero_wraps_to_less_than_one():
    """-1e-9 modulo 1 rounds to 1.0 in float32, which is not a phase."""
    assert trajectory.wrap(jnp.float32(-1e-9)) < 1.0


def test_the_trot_moves_its_diagonal_pairs_together_and_keeps_two_feet_on_the_ground():
    """FL with RR, FR with RL."""
    stance = np.asarray(trajectory.limb_states(gait_of("trt"), jnp.asarray(PHASES)).stance)
    np.testing.assert_array_equal(stance[:, [0, 1]], stance[:, [3, 2]])
    assert (stance.sum(axis=1) == 2).all()


def test_the_lateral_walk_never_stands_on_fewer_than_two_feet():
    """Four legs with a duty of 0.68 stand on 2.72 feet on average."""
    stance = np.asarray(trajectory.limb_states(gait_of("lat"), jnp.asarray(PHASES)).stance)
    assert stance.sum(axis=1).min() >= 2
    assert stance.sum(axis=1).mean() == pytest.approx(4 * 0.68, abs=2e-3)
