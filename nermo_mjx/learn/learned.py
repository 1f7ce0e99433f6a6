"""The learning state of a training: networks, optimizer states, statistics and counters, as one pytree."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt

from nermo_mjx.learn.experience import EnvironmentLike
from nermo_mjx.learn.networks import Actor, Layers, Statistics, new_actor, new_layers

#: Gradients of a network are clipped to this 2-norm.
LONGEST_STEP = 1.0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Learned:
    """A training between two iterations; all that the next one depends on, but for the worlds.

    Attributes:
        actor, critic: networks; the critic also sees what is privileged.
        target: a slow copy of the critic, if the algorithm uses one; otherwise the initial critic.
        statistics: of observation and privileged, side by side.
        optimizers: states of optax, of actor and critic.
        rate: learning rate of the actor's next step.
        key: data of the random key (2,), from which, with the iteration's number, all noise follows.
        iteration, steps: done so far; steps of all worlds together.
    """

    actor: Actor
    critic: Layers
    target: Layers
    statistics: Statistics
    optimizers: tuple[Any, Any]
    rate: Float[Array, ""]
    key: UInt[Array, " 2"]
    iteration: Int[Array, ""]
    steps: Int[Array, ""]

    def random(self, purpose: int) -> PRNGKeyArray:
        """A random key for one purpose of this iteration."""
        key = jax.random.fold_in(jax.random.wrap_key_data(self.key), self.iteration)
        return jax.random.fold_in(key, purpose)


#: Purposes of random numbers.
RESET, ACTING, SHUFFLING = range(3)


def beginning(environment: EnvironmentLike, seed: int, hidden: tuple[int, ...], std: float, rate: float) -> Learned:
    """The learning state before the first step."""
    key, first, second = jax.random.split(jax.random.key(seed), 3)
    actor = new_actor(first, environment.observation_size, environment.action_size, hidden, std)
    size = environment.observation_size + environment.privileged_size
    critic = new_layers(second, (size, *hidden, 1))
    step = descent()
    return Learned(
        actor, critic, critic, Statistics.none(size), (step.init(actor), step.init(critic)), jnp.float32(rate),
        jax.random.key_data(key), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32),
    )  # fmt: skip


def descent(betas: tuple[float, float] = (0.9, 0.999)) -> optax.GradientTransformation:
    """Adam's direction; the learning rate comes with each step."""
    return optax.chain(optax.clip_by_global_norm(LONGEST_STEP), optax.scale_by_adam(*betas, eps=1e-7))


def stepped(network: Any, gradient: Any, state: Any, rate: Any, betas: tuple[float, float] = (0.9, 0.999)) -> Any:
    """The network and its optimizer's state one step later.

    A non-finite gradient changes nothing: the step is skipped, and the optimizer is not updated.
    """
    change, after = descent(betas).update(gradient, state)
    fine = jnp.isfinite(optax.global_norm(gradient))
    moved = jax.tree.map(lambda x, d: jnp.where(fine, x - rate * d, x).astype(x.dtype), network, change)
    return moved, jax.tree.map(lambda new, old: jnp.where(fine, new, old), after, state)
