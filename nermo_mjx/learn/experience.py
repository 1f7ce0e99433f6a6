"""Steps of a batch of worlds under a policy: traced as one scan where the environment is pure, else step by step."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from nermo_mjx.learn.mixture import Mixture
from nermo_mjx.learn.networks import Actor, Statistics
from nermo_mjx.runtime import compiler_options

#: Arrays of a traced environment, or NumPy's of one on the host.
Values = Any


class Stepped(Protocol):
    """The part of an environment's state that learning reads; axes are worlds. See `nermo_mjx.learn.Environment`."""

    observation: Any
    privileged: Any
    reward: Any
    terms: dict[str, Any]
    terminated: Any
    truncated: Any
    final_observation: Any
    final_privileged: Any


class EnvironmentLike(Protocol):
    """A batch of worlds that reset themselves; sizes are those of the arrays' last axes."""

    @property
    def worlds(self) -> int: ...

    @property
    def observation_size(self) -> int: ...

    @property
    def privileged_size(self) -> int: ...

    @property
    def action_size(self) -> int: ...

    @property
    def pure(self) -> bool:
        """Whether `reset` and `step` can be traced."""

    @property
    def step_seconds(self) -> float:
        """Simulated seconds of a step."""

    def reset(self, key: PRNGKeyArray) -> Any: ...

    def step(self, state: Any, action: Any) -> Any: ...


class Experience(NamedTuple):
    """What happened in t steps of n worlds; `final_*` is what followed each step, before a reset.

    Observation and privileged are concatenated in `seen` and `then`: the actor sees only the first columns.
    """

    seen: Float[Values, "t n k"]
    action: Float[Values, "t n a"]
    reward: Float[Values, "t n"]
    terms: dict[str, Float[Values, "t n"]]
    terminated: Bool[Values, "t n"]
    truncated: Bool[Values, "t n"]
    then: Float[Values, "t n k"]


@dataclasses.dataclass
class Scores:
    """Return and length of the current episodes, and a tally of those that ended; on the host.

    The first episode of each world is not counted: it is cut short, so that episodes do not end all at once.
    """

    returns: np.ndarray
    lengths: np.ndarray
    first: np.ndarray

    @classmethod
    def none(cls, worlds: int) -> Scores:
        return cls(np.zeros(worlds), np.zeros(worlds, int), np.ones(worlds, bool))

    def tally(self, experience: Experience) -> dict[str, float]:
        """Numbers of the episodes that ended in these steps: how many, their return, length, and share that lasted."""
        reward, failed, cut = (np.asarray(each) for each in (experience.reward, experience.terminated,
                                                             experience.truncated))  # fmt: skip
        returns, lengths, lasted = list[float](), list[int](), 0
        for t in range(len(reward)):
            self.returns += reward[t]
            self.lengths += 1
            ended = failed[t] | cut[t]
            if ended.any():
                whole = ended & ~self.first
                returns += self.returns[whole].tolist()
                lengths += self.lengths[whole].tolist()
                lasted += int((whole & ~failed[t]).sum())
                self.returns[ended], self.lengths[ended], self.first[ended] = 0.0, 0, False
        many = len(returns)
        means = [sum(each) / many if many else np.nan for each in (returns, lengths, [lasted])]
        terms = {f"term.{name}": float(np.mean(each)) for name, each in experience.terms.items()}
        numbers = dict(zip(("return", "length", "lasted"), map(float, means), strict=True))
        return {"episodes": float(many), **numbers, "reward": float(reward.mean()), **terms}


def both(observation: Any, privileged: Any) -> Float[Array, "*batch k"]:
    """Observation and privileged, concatenated."""
    return jnp.concatenate([jnp.asarray(observation, jnp.float32), jnp.asarray(privileged, jnp.float32)], axis=-1)


def collector(
    environment: EnvironmentLike, steps: int
) -> Callable[[Actor, Statistics, Any, PRNGKeyArray], tuple[Any, Experience]]:
    """A function that lets a policy act for some steps: (actor, statistics, state, key) to (state, experience)."""
    shape = (steps, environment.worlds, environment.action_size)
    if environment.pure:
        return jax.jit(
            lambda actor, statistics, state, key: scanned(
                environment, actor, statistics, state, jax.random.normal(key, shape, jnp.float32)
            ),
            compiler_options=compiler_options(),
        )
    act = jax.jit(_act)
    draw = jax.jit(lambda key: jax.random.normal(key, shape, jnp.float32))

    def collect(actor: Actor, statistics: Statistics, state: Any, key: PRNGKeyArray) -> tuple[Any, Experience]:
        policy, noise = functools.partial(act, actor, statistics), np.asarray(draw(key))
        if isinstance(environment, Mixture):
            return _of_parts(environment, policy, state, noise)
        return _stepped(environment, policy, state, noise)

    return collect


def _stepped(
    environment: EnvironmentLike, policy: Callable[[Any, Any], Array], state: Any, noise: Float[Values, "t n a"]
) -> tuple[Any, Experience]:
    """Steps of an environment on the host, one by one."""
    rows = []
    for each in noise:
        seen = np.concatenate([state.observation, state.privileged], axis=-1, dtype=np.float32)
        action = np.asarray(policy(state.observation, each))
        state = environment.step(state, action)
        then = np.concatenate([state.final_observation, state.final_privileged], axis=-1, dtype=np.float32)
        rows.append(Experience(seen, action, np.asarray(state.reward, np.float32), dict(state.terms),
                               np.asarray(state.terminated), np.asarray(state.truncated), then))  # fmt: skip
    return state, jax.tree.map(lambda *each: np.stack(each), *rows)


def _of_parts(
    mixture: Mixture, policy: Callable[[Any, Any], Array], state: Any, noise: Float[Values, "t n a"]
) -> tuple[Any, Experience]:
    """Steps of several environments on the host. None waits for another one, so that all processors are busy."""
    calls = [functools.partial(_stepped, part, policy, *given)
             for part, *given in zip(mixture.parts, state.engine, mixture.split(noise, 1), strict=True)]  # fmt: skip
    states, found = zip(*mixture.at_once(calls), strict=True)

    def told(i: int, values: Float[Values, "t n k"]) -> Float[Values, "t n k"]:
        observation, privileged = np.split(values, [mixture.observation_size], axis=-1)
        return np.concatenate([observation, mixture.told(i, privileged)], axis=-1)

    parts = [each._replace(seen=told(i, each.seen), then=told(i, each.then)) for i, each in enumerate(found)]
    return mixture.joined(states), jax.tree.map(lambda *each: np.concatenate(each, axis=1), *parts)


def _act(actor: Actor, statistics: Statistics, observation: Any, noise: Array) -> Array:
    observation = jnp.asarray(observation, jnp.float32)
    return actor.sample(statistics.first(observation.shape[-1]).normalized(observation), noise)


def scanned(
    environment: EnvironmentLike, actor: Actor, statistics: Statistics, state: Any, noise: Float[Array, "t n a"]
) -> tuple[Any, Experience]:
    """Steps of a pure environment as one scan, differentiable in the actor.

    If a world's derivative is not finite at some step, the future of that step contributes nothing.
    """

    @jax.checkpoint
    def step(state: Any, noise: Array) -> tuple[Any, Experience]:
        state, action = finite_backwards((state, _act(actor, statistics, state.observation, noise)))
        after = environment.step(state, action)
        return after, Experience(
            both(state.observation, state.privileged), action, jnp.asarray(after.reward, jnp.float32), after.terms,
            after.terminated, after.truncated, both(after.final_observation, after.final_privileged),
        )  # fmt: skip

    return jax.lax.scan(step, state, noise)


@jax.custom_vjp
def finite_backwards(tree: Any) -> Any:
    """The tree; backwards, zeros for each world in which some cotangent is not finite."""
    return tree


def _backwards(_: None, cotangents: Any) -> tuple[Any]:
    leaves = [each for each in jax.tree.leaves(cotangents) if _batched(each)]
    fine = jnp.stack([jnp.isfinite(each).reshape(len(each), -1).all(axis=1) for each in leaves]).all(axis=0)
    return (jax.tree.map(lambda each: jnp.where(fine.reshape(-1, *[1] * (each.ndim - 1)), each, 0.0)
                         if _batched(each) else each, cotangents),)  # fmt: skip


def _batched(cotangent: Any) -> bool:
    """Whether it is the cotangent of one number or more a world: integers and keys have none."""
    return jnp.issubdtype(cotangent.dtype, jnp.floating) and cotangent.ndim > 0


finite_backwards.defvjp(lambda tree: (tree, None), _backwards)
