"""Ways of learning: proximal policy optimization, and the policy's exact gradient through the physics.

PPO is that of Schulman et al. (2017), with the clipped objective and a critic that may see more. Short-horizon
actor-critic is that of Xu et al. (2022), "SHAC": a horizon of some control steps is differentiated exactly; what
follows it is the value of a critic, which learns TD(lambda) targets of a slow copy of itself. The landscape stays
smooth because no derivative passes through more than one horizon, and no return through none.
"""

from __future__ import annotations

import dataclasses
import functools
import time
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
    collector,
    scanned,
    stepped,
)
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runtime import compiler_options
from nermo_mjx.specs.model import Spec
from nermo_mjx.specs.values import Positive, Share, Whole

#: One iteration: (learned, state of the worlds) to the same after it, what happened, and numbers about it.
Iteration = Callable[[Learned, Any], tuple[Learned, Any, Experience, dict[str, Any]]]
_Hidden = Annotated[tuple[Annotated[int, Whole(1, 4096)], ...], Field(strict=False)]

#: Bounds of a learning rate that follows the policy's change, and the factor of a change of it.
_SLOWEST, _FASTEST, _FACTOR = 1e-5, 1e-2, 1.5
#: Decay of Adam's moments for exact gradients: those of successive horizons differ more than those of minibatches.
BETAS = (0.7, 0.95)


class Algorithm(Spec):
    """What all ways of learning have in common; each declares these fields, which documents them there."""

    horizon: int
    discount: float
    trace: float
    epochs: int
    minibatches: int
    rate: float
    std: float
    hidden: tuple[int, ...]

    def begin(self, environment: EnvironmentLike, seed: int) -> Learned:
        """What there is before the first step."""
        return beginning(environment, seed, self.hidden, self.std, self.rate)

    def parts(self, learned: Learned, count: int) -> Array:
        """Places (epochs * minibatches, n) of what each minibatch of an iteration has, of `count` steps."""
        keys = jax.random.split(learned.random(SHUFFLING), self.epochs)
        shuffled = jax.vmap(lambda key: jax.random.permutation(key, count))(keys)
        size = count // self.minibatches
        return shuffled[:, : size * self.minibatches].reshape(-1, size)


def _value_loss(critic: Any, seen: Float[Array, "n k"], target: Float[Array, " n"]) -> Array:
    return 0.5 * ((apply(critic, seen)[:, 0] - target) ** 2).mean()


@dataclasses.dataclass(frozen=True)
class PPO(Algorithm):
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

    def iteration(self, environment: EnvironmentLike) -> Iteration:
        collect = collector(environment, self.horizon)
        update = jax.jit(functools.partial(self._updated, environment.observation_size))
        key = jax.jit(lambda learned: learned.random(ACTING))

        def iterate(learned: Learned, state: Any) -> tuple[Learned, Any, Experience, dict[str, Any]]:
            began = time.process_time()
            state, experience = collect(learned.actor, learned.statistics, state, key(learned))
            spent = time.process_time() - began
            learned, numbers = update(learned, experience._replace(terms={}))
            return learned, state, experience, numbers if environment.pure else numbers | {"environment_cpu": spent}

        return iterate

    def _updated(self, observed: int, learned: Learned, found: Experience) -> tuple[Learned, dict[str, Array]]:
        statistics = learned.statistics.begun(found.seen)
        seen, then = (statistics.normalized(each) for each in (found.seen, found.then))
        value, next_value = (apply(learned.critic, each)[..., 0] for each in (seen, then))
        gain = advantages(found.reward, value, next_value, found.terminated, found.truncated, self.discount, self.trace)
        old = learned.actor.log_density(seen[..., :observed], found.action)
        rows = jax.tree.map(
            lambda each: each.reshape(-1, *each.shape[2:]), (seen, found.action, old, gain, value + gain)
        )
        count = len(rows[0])

        def step(carry: tuple[Any, ...], part: Array) -> tuple[tuple[Any, ...], dict[str, Array]]:
            actor, critic, (of_actor, of_critic) = carry
            seen, action, old, gain, target = jax.tree.map(lambda each: each[part], rows)

            def policy_loss(actor: Any) -> tuple[Array, Array]:
                change = actor.log_density(seen[:, :observed], action) - old
                scaled = (gain - gain.mean()) / (gain.std() + 1e-8)
                ratio = jnp.exp(change)
                clipped = jnp.clip(ratio, 1.0 - self.clip, 1.0 + self.clip)
                loss = -jnp.minimum(ratio * scaled, clipped * scaled).mean() - self.entropy * actor.entropy()
                return loss, (ratio - 1.0 - change).mean()

            slope, kl = jax.grad(policy_loss, has_aux=True)(actor)
            miss, of_value = jax.value_and_grad(_value_loss)(critic, seen, target)
            actor, of_actor = stepped(actor, slope, of_actor, learned.rate)
            critic, of_critic = stepped(critic, of_value, of_critic, self.rate)
            return (actor, critic, (of_actor, of_critic)), {"kl": kl, "value_loss": miss}

        before = (learned.actor, learned.critic, learned.optimizers)
        (actor, critic, optimizers), numbers = jax.lax.scan(step, before, self.parts(learned, count))
        # The change by all steps of an iteration. Within one it grows from zero: a rate that followed it there would
        # first be raised with every step, and then be too high.
        kl, rate = numbers["kl"][-self.minibatches :].mean(), learned.rate
        if self.kl is not None:  # lowered where the policy changes twice as much as aimed at, raised at half as much
            slower, faster = kl > 2.0 * self.kl, kl < 0.5 * self.kl
            rate = jnp.where(slower, rate / _FACTOR, jnp.where(faster, rate * _FACTOR, rate))
            rate = jnp.clip(rate, _SLOWEST, _FASTEST)
        about = {
            "kl": kl,
            "value_loss": numbers["value_loss"].mean(),
            "explained": 1.0 - jnp.var(gain) / (jnp.var(value + gain) + 1e-12),
            "rate": rate,
            "std": jnp.exp(actor.log_std).mean(),
        }
        after = learned.after(found.seen, count, actor=actor, critic=critic, optimizers=optimizers, rate=rate)
        return after, about


@dataclasses.dataclass(frozen=True)
class ShortHorizon(Algorithm):
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
    hidden: _Hidden = (64, 64)
    """units of each hidden layer, for both actor and critic"""

    def iteration(self, environment: EnvironmentLike) -> Iteration:
        """See `Iteration`; raises `ParameterError` if the environment cannot be traced."""
        if not environment.pure:
            raise ParameterError("engine has no derivative: training by short_horizon needs the engine mjx.")
        return jax.jit(functools.partial(self._iterated, environment), compiler_options=compiler_options())

    def _iterated(
        self, environment: EnvironmentLike, learned: Learned, state: Any
    ) -> tuple[Learned, Any, Experience, dict[str, Array]]:
        shape = (self.horizon, environment.worlds, environment.action_size)
        noise = jax.random.normal(learned.random(ACTING), shape, jnp.float32)
        statistics = learned.statistics.begun(both(state.observation, state.privileged))

        def loss(actor: Actor) -> tuple[Array, Any]:
            after, found = scanned(environment, actor, statistics, state, noise)
            follows = apply(learned.target, statistics.normalized(found.then))[..., 0]
            gained = self._discounted(found, follows)
            return -gained.mean() / self.horizon - self.entropy * actor.entropy(), (after, found, follows)

        (value, (after, found, follows)), slope = jax.value_and_grad(loss, has_aux=True)(learned.actor)
        actor, of_actor = stepped(learned.actor, slope, learned.optimizers[0], learned.rate, BETAS)
        critic, of_critic, miss, explained = self._criticized(learned, statistics, found, follows)
        target = jax.tree.map(lambda slow, new: slow + self.follow * (new - slow), learned.target, critic)
        numbers = {
            "loss": value,
            "gradient": optax.global_norm(slope),
            "value_loss": miss,
            "explained": explained,
            "rate": learned.rate,
            "std": jnp.exp(actor.log_std).mean(),
        }
        changed = {"actor": actor, "critic": critic, "target": target, "optimizers": (of_actor, of_critic)}
        return learned.after(found.seen, shape[0] * shape[1], **changed), after, found, numbers

    def _discounted(self, found: Experience, follows: Float[Array, "t n"]) -> Float[Array, " n"]:
        """The horizon's discounted rewards and the value after it, (5) of the paper; each episode starts afresh."""

        def forward(carry: tuple[Array, Array], step: tuple[Array, ...]) -> tuple[tuple[Array, Array], None]:
            total, weight = carry
            reward, value, terminated, truncated, is_last = step
            cut = (truncated | is_last) & ~terminated
            total = total + weight * (reward + self.discount * jnp.where(cut, value, 0.0))
            return (total, jnp.where(terminated | truncated, 1.0, self.discount * weight)), None

        zero = jnp.zeros_like(found.reward[0])
        last = jnp.arange(self.horizon) == self.horizon - 1
        steps = (found.reward, follows, found.terminated, found.truncated, last)
        return jax.lax.scan(forward, (zero, zero + 1.0), steps)[0][0]

    def _criticized(
        self, learned: Learned, statistics: Any, found: Experience, follows: Float[Array, "t n"]
    ) -> tuple[Any, Any, Array, Array]:
        """The critic after its passes over TD(lambda) targets, its optimizer, its loss, and the variance explained."""
        seen = statistics.normalized(found.seen)
        value = apply(learned.target, seen)[..., 0]
        gain = advantages(found.reward, value, follows, found.terminated, found.truncated, self.discount, self.trace)
        seen, target = seen.reshape(-1, seen.shape[-1]), jax.lax.stop_gradient((value + gain).ravel())

        def step(carry: tuple[Any, Any], part: Array) -> tuple[tuple[Any, Any], Array]:
            critic, optimizer = carry
            value, slope = jax.value_and_grad(_value_loss)(critic, seen[part], target[part])
            return stepped(critic, slope, optimizer, self.critic_rate), value

        parts = self.parts(learned, len(target))
        (critic, optimizer), misses = jax.lax.scan(step, (learned.critic, learned.optimizers[1]), parts)
        return critic, optimizer, misses.mean(), 1.0 - jnp.var(gain) / (jnp.var(target) + 1e-12)
