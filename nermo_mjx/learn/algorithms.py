"""Proximal policy optimization (PPO; Schulman et al., 2017) with the clipped objective.

The names are those of the paper, so that `PPO._update` can be read next to it: the advantage, the return, the probability
ratio, the policy loss and the value loss. The actor and the critic are separate networks, because the critic also receives
privileged inputs. Both are functions of arrays: `PPO` contains options only, and the state is a `LearningState`.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array
from pydantic import Field

from nermo_mjx.learn.experience import (
    ACTION_KEY,
    SHUFFLE_KEY,
    EnvironmentLike,
    Experience,
    LearningState,
    apply,
    apply_gradient,
    estimate_advantages,
    make_collector,
    make_learning_state,
)
from nermo_mjx.specs.model import Spec
from nermo_mjx.specs.values import Positive, Share, Whole

#: One iteration: from the learning state and the state of the worlds to both afterwards, the experience, and statistics.
Iteration = Callable[[LearningState, Any], tuple[LearningState, Any, Experience, dict[str, Any]]]
_Hidden = Annotated[tuple[Annotated[int, Whole(1, 4096)], ...], Field(strict=False)]

#: Bounds of an adaptive learning rate, and the factor of one adaptation.
_SMALLEST_RATE, _LARGEST_RATE, _RATE_FACTOR = 1e-5, 1e-2, 1.5


@dataclasses.dataclass(frozen=True)
class PPO(Spec):
    """Proximal policy optimization.

    An iteration simulates `horizon` steps in all worlds, and learns in `epochs` passes over these steps.
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

    def begin(self, environment: EnvironmentLike, seed: int) -> LearningState:
        """Initialize the learning state."""
        return make_learning_state(environment, seed, self.hidden, self.std, self.rate)

    def make_iteration(self, environment: EnvironmentLike) -> Iteration:
        """Make the function that performs one iteration, see `Iteration`."""
        collect = make_collector(environment, self.horizon)
        update = jax.jit(functools.partial(self._update, environment.observation_size))
        action_key = jax.jit(lambda learned: learned.random_key(ACTION_KEY))

        def iterate(
            learned: LearningState, state: Any
        ) -> tuple[LearningState, Any, Experience, dict[str, Any]]:
            began = time.process_time()
            state, experience = collect(
                learned.actor, learned.statistics, state, action_key(learned)
            )
            cpu = {} if environment.pure else {"environment_cpu": time.process_time() - began}
            learned, statistics = update(learned, experience._replace(terms={}))
            return learned, state, experience, statistics | cpu

        return iterate

    def _adapt_rate(self, rate: Array, kl: Array) -> Array:
        """Lower the learning rate if the policy changes more than twice as much as desired, and raise it if less than half."""
        if self.kl is None:
            return rate
        is_too_fast, is_too_slow = kl > 2.0 * self.kl, kl < 0.5 * self.kl
        rate = jnp.where(
            is_too_fast, rate / _RATE_FACTOR, jnp.where(is_too_slow, rate * _RATE_FACTOR, rate)
        )
        return jnp.clip(rate, _SMALLEST_RATE, _LARGEST_RATE)

    # Long because one update of the algorithm can be read next to the paper.
    def _update(
        self, observation_size: int, learned: LearningState, experience: Experience
    ) -> tuple[LearningState, dict[str, Array]]:
        """Learn from the experience of one iteration: the next state, and statistics.

        The actor receives the first `observation_size` columns of the critic's input.
        """
        statistics = learned.statistics.initialize(experience.critic_input)
        inputs, next_inputs = (
            statistics.normalize(values)
            for values in (experience.critic_input, experience.next_critic_input)
        )
        value, next_value = (
            apply(learned.critic, values)[..., 0] for values in (inputs, next_inputs)
        )
        advantages = estimate_advantages(
            experience.reward,
            value,
            next_value,
            experience.terminated,
            experience.truncated,
            self.discount,
            self.trace,
        )
        returns = value + advantages
        log_density = learned.actor.log_density(inputs[..., :observation_size], experience.action)
        batch = jax.tree.map(
            lambda values: values.reshape(-1, *values.shape[2:]),
            (inputs, experience.action, log_density, advantages, returns),
        )
        count = len(batch[0])

        def step(carry: tuple[Any, ...], rows: Array) -> tuple[tuple[Any, ...], dict[str, Array]]:
            actor, critic, (actor_optimizer, critic_optimizer) = carry
            inputs, action, old_log_density, advantage, target = jax.tree.map(
                lambda values: values[rows], batch
            )

            def policy_loss(actor: Any) -> tuple[Array, Array]:
                new_log_density = actor.log_density(inputs[:, :observation_size], action)
                log_ratio = new_log_density - old_log_density
                scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                ratio = jnp.exp(log_ratio)
                clipped = jnp.clip(ratio, 1.0 - self.clip, 1.0 + self.clip)
                loss = (
                    -jnp.minimum(ratio * scaled, clipped * scaled).mean()
                    - self.entropy * actor.entropy()
                )
                return loss, (ratio - 1.0 - log_ratio).mean()

            def value_loss(critic: Any) -> Array:
                return 0.5 * ((apply(critic, inputs)[:, 0] - target) ** 2).mean()

            policy_gradient, kl = jax.grad(policy_loss, has_aux=True)(actor)
            loss, value_gradient = jax.value_and_grad(value_loss)(critic)
            actor, actor_optimizer = apply_gradient(
                actor, policy_gradient, actor_optimizer, learned.rate
            )
            critic, critic_optimizer = apply_gradient(
                critic, value_gradient, critic_optimizer, self.rate
            )
            networks = (actor, critic, (actor_optimizer, critic_optimizer))
            return networks, {"kl": kl, "value_loss": loss}

        # Rows of each minibatch, (epochs * minibatches, n).
        keys = jax.random.split(learned.random_key(SHUFFLE_KEY), self.epochs)
        shuffled = jax.vmap(lambda key: jax.random.permutation(key, count))(keys)
        size = count // self.minibatches
        minibatches = shuffled[:, : size * self.minibatches].reshape(-1, size)
        (actor, critic, optimizers), losses = jax.lax.scan(
            step, (learned.actor, learned.critic, learned.optimizers), minibatches
        )
        # The rate follows the change by all steps of an iteration. Within an iteration, the change grows from zero, so
        # that a rate that followed each step would first be raised every time, and then be too high.
        kl = losses["kl"][-self.minibatches :].mean()
        rate = self._adapt_rate(learned.rate, kl)
        update_statistics = {
            "kl": kl,
            "value_loss": losses["value_loss"].mean(),
            "explained": 1.0 - jnp.var(advantages) / (jnp.var(returns) + 1e-12),
            "rate": rate,
            "std": jnp.exp(actor.log_std).mean(),
        }
        updated = learned.advance(
            experience.critic_input,
            count,
            actor=actor,
            critic=critic,
            optimizers=optimizers,
            rate=rate,
        )
        return updated, update_statistics
