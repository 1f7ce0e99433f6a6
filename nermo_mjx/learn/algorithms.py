"""Proximal policy optimization (Schulman et al., 2017), with the clipped objective and a critic that may see more."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from pydantic import Field

from nermo_mjx.learn.experience import (
    ACTION_KEY,
    SHUFFLE_KEY,
    EnvironmentLike,
    Experience,
    Learned,
    advantages,
    apply,
    beginning,
    collector,
    stepped,
)
from nermo_mjx.specs.model import Spec
from nermo_mjx.specs.values import Positive, Share, Whole

#: One iteration: (learned, state of the worlds) to the same after it, what happened, and numbers about it.
Iteration = Callable[[Learned, Any], tuple[Learned, Any, Experience, dict[str, Any]]]
_Hidden = Annotated[tuple[Annotated[int, Whole(1, 4096)], ...], Field(strict=False)]

#: Bounds of a learning rate that follows the policy's change, and the factor of a change of it.
_SMALLEST_RATE, _LARGEST_RATE, _RATE_FACTOR = 1e-5, 1e-2, 1.5


def _value_loss(
    critic: Any, observations: Float[Array, "n k"], target: Float[Array, " n"]
) -> Array:
    return 0.5 * ((apply(critic, observations)[:, 0] - target) ** 2).mean()


@dataclasses.dataclass(frozen=True)
class PPO(Spec):
    """Proximal policy optimization, on MuJoCo C.

    An iteration is `horizon` steps of all worlds, and `epochs` passes over them.
    """

    what = "an option of 'ppo'"
    horizon: Annotated[int, Whole(1, 10_000)] = 16
    """control steps of each world in an iteration"""
    discount: Share = 0.97
    """gamma, of the next control step's reward"""
    trace: Share = 0.95
    """lambda of the advantages"""
    epochs: Annotated[int, Whole(1, 1_000)] = 4
    """passes over an iteration's steps"""
    minibatches: Annotated[int, Whole(1, 10_000)] = 4
    """parts of a pass"""
    clip: Positive = 0.2
    """how far the probability ratio may move"""
    rate: Positive = 1e-3
    """learning rate, the first one if it follows the policy's change"""
    kl: float | None = 0.01
    """change of the policy that the rate follows [nat]; null: none"""
    entropy: Annotated[float, Field(ge=0)] = 1e-3
    """weight of the policy's entropy"""
    std: Positive = 0.3
    """initial standard deviation of the actions"""
    hidden: _Hidden = (64, 64)
    """units of each hidden layer, for both actor and critic"""

    def begin(self, environment: EnvironmentLike, seed: int) -> Learned:
        """The state of learning before the first step."""
        return beginning(environment, seed, self.hidden, self.std, self.rate)

    def iteration(self, environment: EnvironmentLike) -> Iteration:
        """A function that does one iteration, see `Iteration`."""
        collect = collector(environment, self.horizon)
        update = jax.jit(functools.partial(self._updated, environment.observation_size))
        key = jax.jit(lambda learned: learned.random(ACTION_KEY))

        def iterate(
            learned: Learned, state: Any
        ) -> tuple[Learned, Any, Experience, dict[str, Any]]:
            began = time.process_time()
            state, experience = collect(learned.actor, learned.statistics, state, key(learned))
            spent = time.process_time() - began
            learned, numbers = update(learned, experience._replace(terms={}))
            return (
                learned,
                state,
                experience,
                numbers if environment.pure else numbers | {"environment_cpu": spent},
            )

        return iterate

    def _adapted(self, rate: Array, kl: Array) -> Array:
        """The learning rate, lowered where the policy changes twice as much as desired, raised at half as much."""
        if self.kl is None:
            return rate
        slower, faster = kl > 2.0 * self.kl, kl < 0.5 * self.kl
        rate = jnp.where(slower, rate / _RATE_FACTOR, jnp.where(faster, rate * _RATE_FACTOR, rate))
        return jnp.clip(rate, _SMALLEST_RATE, _LARGEST_RATE)

    # Long because one update of the algorithm can be read next to the paper.
    def _updated(
        self, observed: int, learned: Learned, experience: Experience
    ) -> tuple[Learned, dict[str, Array]]:
        statistics = learned.statistics.begun(experience.seen)
        observations, next_observations = (
            statistics.normalized(values) for values in (experience.seen, experience.then)
        )
        value, next_value = (
            apply(learned.critic, values)[..., 0] for values in (observations, next_observations)
        )
        gain = advantages(
            experience.reward,
            value,
            next_value,
            experience.terminated,
            experience.truncated,
            self.discount,
            self.trace,
        )
        old = learned.actor.log_density(observations[..., :observed], experience.action)
        rows = jax.tree.map(
            lambda values: values.reshape(-1, *values.shape[2:]),
            (observations, experience.action, old, gain, value + gain),
        )
        count = len(rows[0])

        def step(carry: tuple[Any, ...], part: Array) -> tuple[tuple[Any, ...], dict[str, Array]]:
            actor, critic, (of_actor, of_critic) = carry
            observations, action, old_log_density, advantage, target = jax.tree.map(
                lambda values: values[part], rows
            )

            def policy_loss(actor: Any) -> tuple[Array, Array]:
                change = actor.log_density(observations[:, :observed], action) - old_log_density
                scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                ratio = jnp.exp(change)
                clipped = jnp.clip(ratio, 1.0 - self.clip, 1.0 + self.clip)
                loss = (
                    -jnp.minimum(ratio * scaled, clipped * scaled).mean()
                    - self.entropy * actor.entropy()
                )
                return loss, (ratio - 1.0 - change).mean()

            slope, kl = jax.grad(policy_loss, has_aux=True)(actor)
            miss, of_value = jax.value_and_grad(_value_loss)(critic, observations, target)
            actor, of_actor = stepped(actor, slope, of_actor, learned.rate)
            critic, of_critic = stepped(critic, of_value, of_critic, self.rate)
            return (actor, critic, (of_actor, of_critic)), {"kl": kl, "value_loss": miss}

        previous = (learned.actor, learned.critic, learned.optimizers)
        # Which steps (epochs * minibatches, n) each minibatch contains.
        keys = jax.random.split(learned.random(SHUFFLE_KEY), self.epochs)
        shuffled = jax.vmap(lambda key: jax.random.permutation(key, count))(keys)
        size = count // self.minibatches
        parts = shuffled[:, : size * self.minibatches].reshape(-1, size)
        (actor, critic, optimizers), numbers = jax.lax.scan(step, previous, parts)
        # The change by all steps of an iteration. Within one it grows from zero: a rate that followed it there would
        # first be raised with every step, and then be too high.
        kl = numbers["kl"][-self.minibatches :].mean()
        rate = self._adapted(learned.rate, kl)
        statistics_of_update = {
            "kl": kl,
            "value_loss": numbers["value_loss"].mean(),
            "explained": 1.0 - jnp.var(gain) / (jnp.var(value + gain) + 1e-12),
            "rate": rate,
            "std": jnp.exp(actor.log_std).mean(),
        }
        updated = learned.after(
            experience.seen, count, actor=actor, critic=critic, optimizers=optimizers, rate=rate
        )
        return updated, statistics_of_update
