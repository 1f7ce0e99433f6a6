"""Short-horizon actor-critic: the policy's gradient through the physics, Xu et al. (2022), "SHAC".

A horizon of some control steps is differentiated exactly; what follows it is the value of a critic. The critic learns
TD(lambda) targets of a slow copy of itself. The landscape stays smooth because no derivative passes through more than
one horizon, and no return through none.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float
from pydantic import Field

from nermo_mjx.learn.experience import (
    ACTING,
    SHUFFLING,
    Actor,
    EnvironmentLike,
    Experience,
    Learned,
    advantages,
    apply,
    beginning,
    both,
    scanned,
    stepped,
)
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runtime import compiler_options
from nermo_mjx.specs.model import Spec
from nermo_mjx.specs.values import Positive, Share, Whole

#: Decay of Adam's moments: the gradients of successive horizons differ more than those of minibatches.
BETAS = (0.7, 0.95)


@dataclasses.dataclass(frozen=True)
class ShortHorizon(Spec):
    """The policy's exact gradient over short horizons, on MJX.

    An iteration is `horizon` steps of all worlds and one step of the actor.
    """

    what = "an option of 'short_horizon'"
    horizon: Annotated[int, Whole(1, 10_000)] = 16
    """control steps of each world that a derivative passes through"""
    discount: Share = 0.97
    """gamma, of the next control step's reward"""
    trace: Share = 0.95
    """lambda of the critic's targets"""
    epochs: Annotated[int, Whole(1, 1_000)] = 16
    """passes of the critic over an iteration's steps"""
    minibatches: Annotated[int, Whole(1, 10_000)] = 4
    """parts of a pass"""
    rate: Positive = 5e-4
    """learning rate of the actor. The robot learned nothing at 0.003, which suits a point mass"""
    critic_rate: Positive = 1e-3
    """learning rate of the critic"""
    follow: Share = 0.3
    """fraction by which the slow copy moves to the critic per iteration"""
    entropy: Annotated[float, Field(ge=0)] = 0.0
    """weight of the policy's entropy, with respect to its standard deviation"""
    std: Positive = 0.1
    """initial standard deviation of the actions"""
    hidden: Annotated[tuple[Annotated[int, Whole(1, 4096)], ...], Field(strict=False)] = (64, 64)
    """units of each hidden layer, for both actor and critic"""

    def begin(self, environment: EnvironmentLike, seed: int) -> Learned:
        """What there is before the first step."""
        return beginning(environment, seed, self.hidden, self.std, self.rate)

    def iteration(
        self, environment: EnvironmentLike
    ) -> Callable[[Learned, Any], tuple[Learned, Any, Experience, dict[str, Any]]]:
        """One iteration: (learned, state of the worlds) to the same after it, what happened, and numbers about it.

        Raises:
            ParameterError: the environment cannot be traced.
        """
        if not environment.pure:
            raise ParameterError("engine has no derivative: training by short_horizon needs the engine mjx.")
        return jax.jit(functools.partial(_iterated, self, environment), compiler_options=compiler_options())


def _iterated(
    shac: ShortHorizon, environment: EnvironmentLike, learned: Learned, state: Any
) -> tuple[Learned, Any, Experience, dict[str, Array]]:
    shape = (shac.horizon, environment.worlds, environment.action_size)
    noise = jax.random.normal(learned.random(ACTING), shape, jnp.float32)
    # The first observations are all that is known of their scale; the untrained mean is zero in any case.
    first = learned.statistics.extended(both(state.observation, state.privileged))
    statistics = jax.tree.map(lambda a, b: jnp.where(learned.statistics.count == 0, a, b), first, learned.statistics)

    def loss(actor: Actor) -> tuple[Array, Any]:
        after, found = scanned(environment, actor, statistics, state, noise)
        follows = apply(learned.target, statistics.normalized(found.then))[..., 0]
        gained = _discounted(shac, found, follows)
        return -gained.mean() / shac.horizon - shac.entropy * actor.entropy(), (after, found, follows)

    (value, (after, found, follows)), slope = jax.value_and_grad(loss, has_aux=True)(learned.actor)
    actor, of_actor = stepped(learned.actor, slope, learned.optimizers[0], learned.rate, BETAS)
    critic, of_critic, miss, explained = _criticized(shac, learned, statistics, found, follows)
    target = jax.tree.map(lambda slow, new: slow + shac.follow * (new - slow), learned.target, critic)
    numbers = {
        "loss": value,
        "gradient": optax.global_norm(slope),
        "value_loss": miss,
        "explained": explained,
        "rate": learned.rate,
        "std": jnp.exp(actor.log_std).mean(),
    }
    learned = dataclasses.replace(
        learned,
        actor=actor,
        critic=critic,
        target=target,
        optimizers=(of_actor, of_critic),
        statistics=learned.statistics.extended(found.seen),
        iteration=learned.iteration + 1,
        steps=learned.steps + shape[0] * shape[1],
    )
    return learned, after, found, numbers


def _discounted(shac: ShortHorizon, found: Experience, follows: Float[Array, "t n"]) -> Float[Array, " n"]:
    """The horizon's discounted rewards and the value after it, (5) of the paper; each episode in it starts afresh."""

    def forward(carry: tuple[Array, Array], step: tuple[Array, ...]) -> tuple[tuple[Array, Array], None]:
        total, weight = carry
        reward, value, terminated, truncated, is_last = step
        cut = (truncated | is_last) & ~terminated
        total = total + weight * (reward + shac.discount * jnp.where(cut, value, 0.0))
        return (total, jnp.where(terminated | truncated, 1.0, shac.discount * weight)), None

    zero = jnp.zeros_like(found.reward[0])
    last = jnp.arange(shac.horizon) == shac.horizon - 1
    steps = (found.reward, follows, found.terminated, found.truncated, last)
    return jax.lax.scan(forward, (zero, zero + 1.0), steps)[0][0]


def _criticized(
    shac: ShortHorizon, learned: Learned, statistics: Any, found: Experience, follows: Float[Array, "t n"]
) -> tuple[Any, Any, Array, Array]:
    """The critic after its passes over TD(lambda) targets, its optimizer, its loss, and the variance it explains."""
    seen = statistics.normalized(found.seen)
    value = apply(learned.target, seen)[..., 0]
    gain = advantages(found.reward, value, follows, found.terminated, found.truncated, shac.discount, shac.trace)
    seen, target = seen.reshape(-1, seen.shape[-1]), jax.lax.stop_gradient((value + gain).ravel())
    size = len(target) // shac.minibatches
    keys = jax.random.split(learned.random(SHUFFLING), shac.epochs)
    orders = jax.vmap(lambda key: jax.random.permutation(key, len(target)))(keys)

    def step(carry: tuple[Any, Any], part: Array) -> tuple[tuple[Any, Any], Array]:
        critic, optimizer = carry

        def miss(critic: Any) -> Array:
            return 0.5 * ((apply(critic, seen[part])[:, 0] - target[part]) ** 2).mean()

        value, slope = jax.value_and_grad(miss)(critic)
        return stepped(critic, slope, optimizer, shac.critic_rate), value

    parts = orders[:, : size * shac.minibatches].reshape(-1, size)
    (critic, optimizer), misses = jax.lax.scan(step, (learned.critic, learned.optimizers[1]), parts)
    return critic, optimizer, misses.mean(), 1.0 - jnp.var(gain) / (jnp.var(target) + 1e-12)
