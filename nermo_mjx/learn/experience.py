"""What is learned and from what: networks, returns, the steps of many worlds, and the state of learning as one pytree.

Actor and critic are two small networks over normalized observations, as plain pytrees. The actor's mean is tanh of its
last layer, whose weights begin at zero: an untrained policy has no effect, so a residual starts as the controller that
it is added to. Its standard deviation is one parameter per action.

Generalized advantages and TD(lambda) targets distinguish terminations from time limits: a terminated episode has no
future; one truncated at its time limit does, and is bootstrapped with the value at the observation before the reset.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt

from nermo_mjx.learn.environment import Mixture
from nermo_mjx.runtime import compiler_options

#: Weights (in, out) and bias (out,) of each layer.
Layers = tuple[tuple[Array, Array], ...]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Statistics:
    """Running mean and variance of what networks see, by the parallel rule of Chan, Golub and LeVeque (1979).

    Attributes:
        count: values so far; 0 before the first.
        mean, variance: of each entry (k,).
    """

    count: Float[Array, ""]
    mean: Float[Array, " k"]
    variance: Float[Array, " k"]

    @classmethod
    def none(cls, size: int) -> Statistics:
        """Empty statistics, which leave values unchanged."""
        return cls(
            jnp.zeros((), jnp.float32), jnp.zeros(size, jnp.float32), jnp.ones(size, jnp.float32)
        )

    def extended(self, values: Float[Array, "*batch k"]) -> Statistics:
        """With more values."""
        rows = values.reshape(-1, values.shape[-1])
        count, mean, variance = jnp.float32(len(rows)), rows.mean(axis=0), rows.var(axis=0)
        total, difference = self.count + count, mean - self.mean
        spread = (
            self.variance * self.count
            + variance * count
            + difference**2 * self.count * count / total
        )
        return Statistics(total, self.mean + difference * count / total, spread / total)

    def normalized(self, values: Float[Array, "*batch k"]) -> Float[Array, "*batch k"]:
        """Values in standard deviations from the mean, at most ten."""
        return jnp.clip((values - self.mean) / jnp.sqrt(self.variance + 1e-6), -10.0, 10.0)

    def begun(self, values: Float[Array, "*batch k"]) -> Statistics:
        """These statistics, or those of the first values that are known; the untrained mean is zero in any case."""
        first = self.extended(values)
        return jax.tree.map(lambda a, b: jnp.where(self.count == 0, a, b), first, self)

    def first(self, size: int) -> Statistics:
        """Those of the first entries."""
        return Statistics(self.count, self.mean[:size], self.variance[:size])


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Actor:
    """A Gaussian policy.

    Attributes:
        layers: of the network.
        log_std: logarithm of each action's standard deviation (a,).
    """

    layers: Layers
    log_std: Float[Array, " a"]

    def mean(self, observation: Float[Array, "*batch o"]) -> Float[Array, "*batch a"]:
        """The mean action, within (-1, 1), at normalized observations."""
        return jnp.tanh(apply(self.layers, observation))

    def sample(
        self, observation: Float[Array, "*batch o"], noise: Float[Array, "*batch a"]
    ) -> Float[Array, "*batch a"]:
        """The action at standard normal noise; differentiable in policy and observation."""
        return self.mean(observation) + jnp.exp(self.log_std) * noise

    def log_density(
        self, observation: Float[Array, "*batch o"], action: Float[Array, "*batch a"]
    ) -> Float[Array, "*batch"]:
        """The logarithm of an action's probability density."""
        z = (action - self.mean(observation)) * jnp.exp(-self.log_std)
        return (
            -0.5 * (z**2).sum(axis=-1)
            - self.log_std.sum()
            - 0.5 * len(self.log_std) * jnp.log(2 * jnp.pi)
        )

    def entropy(self) -> Float[Array, ""]:
        """Differential entropy [nat]."""
        return (self.log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e)).sum()


def new_actor(
    key: PRNGKeyArray, observed: int, actions: int, hidden: Sequence[int], std: float
) -> Actor:
    """An actor whose mean is zero everywhere."""
    layers = new_layers(key, (observed, *hidden, actions))
    last, bias = layers[-1]
    return Actor(
        (*layers[:-1], (jnp.zeros_like(last), bias)), jnp.full(actions, jnp.log(std), jnp.float32)
    )


def new_layers(key: PRNGKeyArray, sizes: Sequence[int]) -> Layers:
    """Layers of these sizes: orthogonal weights, so that signals keep their length, and no bias."""
    orthogonal = jax.nn.initializers.orthogonal(jnp.sqrt(2.0))
    keys = jax.random.split(key, len(sizes) - 1)
    return tuple(
        (orthogonal(layer_key, (a, b), jnp.float32), jnp.zeros(b, jnp.float32))
        for layer_key, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True)
    )


def apply(layers: Layers, x: Float[Array, "*batch i"]) -> Float[Array, "*batch o"]:
    """The network's output: tanh behind each layer but the last."""
    for weights, bias in layers[:-1]:
        x = jnp.tanh(x @ weights + bias)
    weights, bias = layers[-1]
    return x @ weights + bias


def advantages(
    reward: Float[Array, "t n"],
    value: Float[Array, "t n"],
    next_value: Float[Array, "t n"],
    terminated: Bool[Array, "t n"],
    truncated: Bool[Array, "t n"],
    discount: float,
    trace: float,
) -> Float[Array, "t n"]:
    """Generalized advantage estimates: sums of TD errors, discounted by `discount * trace` within an episode.

    Schulman et al. (2016), equation 16. The TD(lambda) target of a critic is `value + advantages`.

    >>> one = jnp.ones((2, 1))
    >>> cut = jnp.array([[True], [False]])
    >>> advantages(one, 0 * one, 4 * one, ~cut & False, cut, 0.5, 1.0).ravel().tolist()
    [3.0, 3.0]
    >>> advantages(one, 0 * one, 4 * one, cut, ~cut & False, 0.5, 1.0).ravel().tolist()
    [1.0, 3.0]

    Args:
        reward: of each step.
        value, next_value: the critic's, before the step and after it; where the step ended an episode, at its last
            observation, before the reset.
        terminated, truncated: whether the step ended the episode, and whether only its time was over.
        discount: of the next step's reward, gamma.
        trace: lambda; 0 is one step's error, 1 the whole return.
    """
    error = reward + discount * jnp.where(terminated, 0.0, next_value) - value
    goes_on = jnp.where(terminated | truncated, 0.0, discount * trace)

    def back(later: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        error, goes_on = step
        now = error + goes_on * later
        return now, now

    return jax.lax.scan(back, jnp.zeros_like(error[0]), (error, goes_on), reverse=True)[1]


#: Arrays of a traced environment, or NumPy's of one on the host.
Values = Any


class EnvironmentLike(Protocol):
    """A batch of worlds that reset themselves; see `nermo_mjx.learn.Environment`, whose `State` has what is read here.

    Attributes:
        worlds: how many.
        observation_size, privileged_size, action_size: of the arrays' last axes.
        pure: whether `reset` and `step` can be traced.
        step_seconds: simulated seconds of a step.
    """

    worlds: int
    observation_size: int
    privileged_size: int
    action_size: int
    pure: bool
    step_seconds: float

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
class EpisodeScores:
    """Return and length of the current episodes, and a tally of those that ended; on the host.

    The first episode of each world is not counted: it is cut short, so that episodes do not end all at once.
    """

    returns: np.ndarray
    lengths: np.ndarray
    first: np.ndarray

    @classmethod
    def none(cls, worlds: int) -> EpisodeScores:
        return cls(np.zeros(worlds), np.zeros(worlds, int), np.ones(worlds, bool))

    def tally(self, experience: Experience) -> dict[str, float]:
        """Numbers of the episodes that ended in these steps: how many, their return, length, and share that lasted."""
        reward, failed, cut = (
            np.asarray(column)
            for column in (experience.reward, experience.terminated, experience.truncated)
        )
        returns, lengths, lasted = list[float](), list[int](), 0
        for t in range(len(reward)):
            self.returns += reward[t]
            self.lengths += 1
            is_ended = failed[t] | cut[t]
            if is_ended.any():
                is_whole = is_ended & ~self.first
                returns += self.returns[is_whole].tolist()
                lengths += self.lengths[is_whole].tolist()
                lasted += int((is_whole & ~failed[t]).sum())
                self.returns[is_ended], self.lengths[is_ended], self.first[is_ended] = 0.0, 0, False
        episode_count = len(returns)
        means = [
            sum(each) / episode_count if episode_count else np.nan
            for each in (returns, lengths, [lasted])
        ]
        terms = {f"term.{name}": float(np.mean(each)) for name, each in experience.terms.items()}
        numbers = dict(zip(("return", "length", "lasted"), map(float, means), strict=True))
        return {
            "episodes": float(episode_count),
            **numbers,
            "reward": float(reward.mean()),
            **terms,
        }


def both(observation: Any, privileged: Any) -> Float[Array, "*batch k"]:
    """Observation and privileged, concatenated."""
    return jnp.concatenate(
        [jnp.asarray(observation, jnp.float32), jnp.asarray(privileged, jnp.float32)], axis=-1
    )


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

    def collect(
        actor: Actor, statistics: Statistics, state: Any, key: PRNGKeyArray
    ) -> tuple[Any, Experience]:
        policy, noise = functools.partial(act, actor, statistics), np.asarray(draw(key))
        if isinstance(environment, Mixture):
            return _of_parts(environment, policy, state, noise)
        return _stepped(environment, policy, state, noise)

    return collect


def _stepped(
    environment: EnvironmentLike,
    policy: Callable[[Any, Any], Array],
    state: Any,
    noise: Float[Values, "t n a"],
) -> tuple[Any, Experience]:
    """Steps of an environment on the host, one by one."""
    rows = []
    for noise_of_step in noise:
        observation = np.concatenate(
            [state.observation, state.privileged], axis=-1, dtype=np.float32
        )
        action = np.asarray(policy(state.observation, noise_of_step))
        state = environment.step(state, action)
        next_observation = np.concatenate(
            [state.final_observation, state.final_privileged], axis=-1, dtype=np.float32
        )
        rows.append(
            Experience(
                observation,
                action,
                np.asarray(state.reward, np.float32),
                dict(state.terms),
                np.asarray(state.terminated),
                np.asarray(state.truncated),
                next_observation,
            )
        )
    return state, jax.tree.map(lambda *noise_of_step: np.stack(noise_of_step), *rows)


def _of_parts(
    mixture: Mixture, policy: Callable[[Any, Any], Array], state: Any, noise: Float[Values, "t n a"]
) -> tuple[Any, Experience]:
    """Steps of several environments on the host. None waits for another one, so that all processors are busy."""
    calls = [
        functools.partial(_stepped, part, policy, *part_inputs)
        for part, *part_inputs in zip(
            mixture.parts, state.engine, mixture.split(noise, 1), strict=True
        )
    ]
    states, parts_of_experience = zip(*mixture.at_once(calls), strict=True)

    def told(i: int, values: Float[Values, "t n k"]) -> Float[Values, "t n k"]:
        observation, privileged = np.split(values, [mixture.observation_size], axis=-1)
        return np.concatenate([observation, mixture.told(i, privileged)], axis=-1)

    parts = [
        part_experience._replace(
            seen=told(i, part_experience.seen), then=told(i, part_experience.then)
        )
        for i, part_experience in enumerate(parts_of_experience)
    ]
    return mixture.joined(states), jax.tree.map(
        lambda *part_experience: np.concatenate(part_experience, axis=1), *parts
    )


def _act(actor: Actor, statistics: Statistics, observation: Any, noise: Array) -> Array:
    observation = jnp.asarray(observation, jnp.float32)
    return actor.sample(statistics.first(observation.shape[-1]).normalized(observation), noise)


def scanned(
    environment: EnvironmentLike,
    actor: Actor,
    statistics: Statistics,
    state: Any,
    noise: Float[Array, "t n a"],
) -> tuple[Any, Experience]:
    """Steps of a pure environment as one scan."""

    def step(state: Any, noise: Array) -> tuple[Any, Experience]:
        action = _act(actor, statistics, state.observation, noise)
        after = environment.step(state, action)
        return after, Experience(
            both(state.observation, state.privileged),
            action,
            jnp.asarray(after.reward, jnp.float32),
            after.terms,
            after.terminated,
            after.truncated,
            both(after.final_observation, after.final_privileged),
        )

    return jax.lax.scan(step, state, noise)


#: Gradients of a network are clipped to this 2-norm.
MAX_GRADIENT_NORM = 1.0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Learned:
    """A training between two iterations; all that the next one depends on, but for the worlds.

    Attributes:
        actor, critic: networks; the critic also sees what is privileged.
        target: The initial critic, which checkpoints of all releases contain.
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

    def after(self, observations: Float[Array, "*batch k"], steps: Any, **changed: Any) -> Learned:
        """One iteration later: what was seen in so many steps, and what has changed."""
        statistics = self.statistics.extended(observations)
        iteration, steps = self.iteration + 1, self.steps + steps
        return dataclasses.replace(
            self, iteration=iteration, steps=steps, statistics=statistics, **changed
        )

    def random(self, purpose: int) -> PRNGKeyArray:
        """A random key for one purpose of this iteration."""
        key = jax.random.fold_in(jax.random.wrap_key_data(self.key), self.iteration)
        return jax.random.fold_in(key, purpose)


#: Purposes of random numbers.
RESET_KEY, ACTION_KEY, SHUFFLE_KEY = range(3)


def beginning(
    environment: EnvironmentLike, seed: int, hidden: tuple[int, ...], std: float, rate: float
) -> Learned:
    """The learning state before the first step."""
    observed, actions = environment.observation_size, environment.action_size
    size = observed + environment.privileged_size

    @jax.jit  # as a whole: its operations one by one are programs of their own
    def begun(key: PRNGKeyArray) -> Learned:
        key, first, second = jax.random.split(key, 3)
        actor = new_actor(first, observed, actions, hidden, std)
        critic = new_layers(second, (size, *hidden, 1))
        step = descent()
        return Learned(
            actor,
            critic,
            critic,
            Statistics.none(size),
            (step.init(actor), step.init(critic)),
            jnp.float32(rate),
            jax.random.key_data(key),
            jnp.zeros((), jnp.int32),
            jnp.zeros((), jnp.int32),
        )

    learned: Learned = begun(jax.random.key(seed))
    return learned


def descent() -> optax.GradientTransformation:
    """Adam's direction; the learning rate comes with each step."""
    return optax.chain(optax.clip_by_global_norm(MAX_GRADIENT_NORM), optax.scale_by_adam(eps=1e-7))


def stepped(network: Any, gradient: Any, state: Any, rate: Any) -> Any:
    """The network and its optimizer's state one step later.

    A non-finite gradient changes nothing: the step is skipped, and the optimizer is not updated.
    """
    change, after = descent().update(gradient, state)
    fine = jnp.isfinite(optax.global_norm(gradient))
    moved = jax.tree.map(
        lambda x, d: jnp.where(fine, x - rate * d, x).astype(x.dtype), network, change
    )
    return moved, jax.tree.map(lambda new, old: jnp.where(fine, new, old), after, state)
