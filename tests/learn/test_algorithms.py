# Tests of learn/algorithms.py, learn/experience.py
"""PPO on a point mass in closed form; advantages against sums written out."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fakes.learn_toy import PointMass

from nermo_mjx.learn.algorithms import PPO
from nermo_mjx.learn.experience import (
    RESET_KEY,
    Actor,
    EpisodeScores,
    Experience,
    LearningState,
    Statistics,
    collect_traced,
    estimate_advantages,
    make_optimizer,
)

QUICK = PPO(hidden=(16, 16))


def trained(algorithm, environment, iterations, seed=0):
    """What was learned, and the numbers of each iteration."""
    iterate, learned = algorithm.make_iteration(environment), algorithm.begin(environment, seed)
    state, scores, rows = (
        environment.reset(learned.random_key(RESET_KEY)),
        EpisodeScores.empty(environment.worlds),
        [],
    )
    for _ in range(iterations):
        learned, state, experience, numbers = iterate(learned, state)
        rows.append(
            scores.tally(experience) | {name: float(value) for name, value in numbers.items()}
        )
    return learned, rows


def bits(learned):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(learned)]


@functools.cache
def long_training():
    """PPO until it learns no more."""
    return trained(QUICK, PointMass(64), 400)


def returned(learned, episodes=64):
    """Mean return of whole episodes under the policy's mean."""
    environment = PointMass(episodes)
    state, total = environment.reset(jax.random.key(99)), np.zeros(episodes)
    state = state._replace(tick=jnp.zeros_like(state.tick))
    quiet = dataclasses.replace(learned.actor, log_std=jnp.full(2, -20.0))
    _, steps_of_scan = jax.jit(functools.partial(collect_traced, environment))(
        quiet, learned.statistics, state, jnp.zeros((60, episodes, 2))
    )
    running = np.ones(episodes, bool)
    for reward, is_end in zip(
        np.asarray(steps_of_scan.reward),
        np.asarray(steps_of_scan.terminated | steps_of_scan.truncated),
        strict=True,
    ):
        total += reward * running
        running &= ~is_end
    return total.mean()


def test_the_tally_leaves_out_each_worlds_first_episode():
    """It is cut short; a world whose first episode fails at once is counted from its second on."""
    steps = np.arange(1.0, 7.0)
    ends = np.array([[0, 1, 0, 0, 1, 0], [1, 0, 0, 1, 0, 1]], bool).T
    falls = np.array([[0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 1]], bool).T
    reward, nothing = np.stack([steps, 10 * steps], axis=1), np.zeros((6, 2, 1))
    experience = Experience(
        nothing, nothing, reward, {"near": reward}, falls, ends & ~falls, nothing
    )
    numbers = EpisodeScores.empty(2).tally(experience)
    assert numbers["episodes"] == 3
    np.testing.assert_allclose(numbers["return"], ((3 + 4 + 5) + (20 + 30 + 40) + (50 + 60)) / 3)
    np.testing.assert_allclose(numbers["length"], (3 + 3 + 2) / 3)
    np.testing.assert_allclose(numbers["lasted"], 2 / 3)
    np.testing.assert_allclose(numbers["reward"], reward.mean())


def test_advantages_are_sums_of_errors_up_to_the_episodes_end():
    """Against the definition, written out; a time limit is bootstrapped, a fall is not."""
    rng = np.random.default_rng(0)
    reward, value, next_value = rng.normal(size=(3, 9, 5))
    fallen = rng.random((9, 5)) < 0.2
    cut = (rng.random((9, 5)) < 0.2) & ~fallen
    result = estimate_advantages(reward, value, next_value, fallen, cut, 0.9, 0.7)
    for world in range(5):
        for t in range(9):
            total = 0.0
            for k in range(t, 9):
                future = 0.0 if fallen[k, world] else 0.9 * next_value[k, world]
                total += (0.9 * 0.7) ** (k - t) * (reward[k, world] + future - value[k, world])
                if fallen[k, world] or cut[k, world]:
                    break
            assert result[t, world] == pytest.approx(total, abs=1e-5)


def test_statistics_in_parts_are_those_of_the_whole():
    values = np.random.default_rng(1).normal(3.0, 2.0, (40, 6)).astype(np.float32)
    parts = Statistics.empty(6).extend(values[:7]).extend(values[7:])
    np.testing.assert_allclose(parts.mean, values.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(parts.variance, values.var(axis=0), rtol=1e-4)


def test_two_steps_on_the_clipped_objective_are_those_of_the_definition():
    """Against Schulman et al. (2017) and Adam, written out in NumPy, for two actions at one observation.

    The first step makes both actions less probable. That is right for the second, whose advantage is negative, and
    wrong for the first: the objective must pull it back, although its probability ratio is outside of the clip.
    """
    action, gain, std, rate = np.array([0.3, 0.45]), np.array([1.0, -1.0]), 0.3, 0.1
    ppo = PPO(epochs=2, minibatches=1, discount=0.0, trace=0.0, kl=None, entropy=0.0)
    actor = Actor(((jnp.zeros((1, 1)), jnp.zeros(1)),), jnp.full(1, np.log(std), jnp.float32))
    critic = ((jnp.zeros((1, 1)), jnp.zeros(1)),)
    key, zero = jax.random.key_data(jax.random.key(0)), jnp.zeros((), jnp.int32)
    states = (make_optimizer().init(actor), make_optimizer().init(critic))
    learned = LearningState(
        actor, critic, critic, Statistics.empty(1), states, jnp.float32(rate), key, zero, zero
    )
    no, inputs = jnp.zeros((1, 2), bool), jnp.zeros((1, 2, 1))
    experience = Experience(
        inputs,
        jnp.asarray(action[None, :, None], jnp.float32),
        jnp.asarray(gain[None]),
        {},
        no,
        no,
        inputs,
    )
    updated, _ = jax.jit(functools.partial(ppo._update, 1))(learned, experience)

    def log_density(bias: float, log_std: float) -> np.ndarray:
        return -0.5 * ((action - np.tanh(bias)) / np.exp(log_std)) ** 2 - log_std

    def loss(point: np.ndarray) -> float:
        ratio = np.exp(log_density(*point) - log_density(0.0, np.log(std)))
        return -np.minimum(ratio * gain, np.clip(ratio, 0.8, 1.2) * gain).mean()

    point, mean, square = np.array([0.0, np.log(std)]), np.zeros(2), np.zeros(2)
    for step in (1, 2):
        slope = np.array(
            [(loss(point + 1e-6 * e) - loss(point - 1e-6 * e)) / 2e-6 for e in np.eye(2)]
        )
        slope /= max(1.0, float(np.linalg.norm(slope)))
        mean, square = 0.9 * mean + 0.1 * slope, 0.999 * square + 0.001 * slope**2
        point = point - rate * mean / (1 - 0.9**step) / (np.sqrt(square / (1 - 0.999**step)) + 1e-7)
    bias, log_std = float(updated.actor.layers[0][1][0]), float(updated.actor.log_std[0])
    assert (bias, log_std) == pytest.approx(tuple(point), abs=1e-4)


def test_an_untrained_policy_does_nothing():
    """So that a residual begins as the controller that it is added to."""
    learned = QUICK.begin(PointMass(4), 3)
    assert (learned.actor.mean(jnp.ones((7, 4))) == 0).all()
    assert float(jnp.exp(learned.actor.log_std[0])) == pytest.approx(QUICK.std)


@pytest.mark.release
def test_one_seed_gives_the_same_weights_bit_for_bit_and_another_does_not():
    """Also where each step is a call of the host, as on the engine c."""
    host, repeated, scan, other_seed = (
        trained(QUICK, PointMass(16, pure=pure), 3, seed)[0]
        for pure, seed in ((False, 0), (False, 0), (True, 0), (True, 1))
    )
    assert bits(host) == bits(repeated)
    np.testing.assert_allclose(host.actor.layers[0][0], scan.actor.layers[0][0], atol=1e-5)
    assert bits(scan) != bits(other_seed)


@pytest.mark.release
def test_ppo_learns_to_hold_the_mass():
    """From the return of doing nothing to near that of the exact gradient; it lasts, and the critic knows why."""
    learned, rows = long_training()
    assert returned(QUICK.begin(PointMass(64), 0)) < -5.0
    assert returned(learned) > -1.5
    assert rows[-1]["lasted"] == 1.0
    assert rows[-1]["explained"] > 0.9


@pytest.mark.release
def test_the_learning_rate_holds_the_policys_change_near_its_aim():
    """By one factor per iteration, down or up, however many steps an iteration has."""
    _, rows = long_training()
    factors = np.array(
        [following["rate"] / previous["rate"] for previous, following in itertools.pairwise(rows)]
    )
    assert np.isclose(factors[:, None], [1 / 1.5, 1.0, 1.5], rtol=1e-5).any(axis=1).all()
    assert (factors != 1.0).any()
    assert 0.5 * QUICK.kl < np.median([row["kl"] for row in rows[20:]]) < 2.0 * QUICK.kl
