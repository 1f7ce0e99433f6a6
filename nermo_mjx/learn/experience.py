"""Experience and learning state: networks, advantages, collection of steps in many worlds, and the pytree of a training.

The actor and the critic are two small networks over normalized observations, as plain pytrees. The actor's mean is tanh of
its last layer, whose weights are zero at first. Therefore an untrained policy has no effect, and a residual starts as the
controller that it corrects. The standard deviation is one parameter for each action.

Generalized advantages and TD(lambda) returns distinguish terminations from time limits. After a termination there is no
future reward. At a time limit, the return is bootstrapped with the value of the observation before the reset.

Guarantees: equal states and keys give equal results, on the engine `c` bit for bit, whatever the number of threads. All
functions return new objects; only `EpisodeScores`, on the host, changes in place. The fields of `LearningState` are those of
checkpoints of all releases.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
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
    """Running mean and variance of a network's inputs, by the parallel rule of Chan, Golub and LeVeque (1979).

    Attributes:
        count: Number of inputs so far; 0 before the first.
        mean, variance: Moments of each entry (k,).
    """

    count: Float[Array, ""]
    mean: Float[Array, " k"]
    variance: Float[Array, " k"]

    @classmethod
    def empty(cls, size: int) -> Statistics:
        """Statistics of no inputs, which leave values unchanged."""
        return cls(
            jnp.zeros((), jnp.float32), jnp.zeros(size, jnp.float32), jnp.ones(size, jnp.float32)
        )

    def extend(self, values: Float[Array, "*batch k"]) -> Statistics:
        """Statistics with additional inputs."""
        rows = values.reshape(-1, values.shape[-1])
        count, mean, variance = jnp.float32(len(rows)), rows.mean(axis=0), rows.var(axis=0)
        total, difference = self.count + count, mean - self.mean
        spread = (
            self.variance * self.count
            + variance * count
            + difference**2 * self.count * count / total
        )
        return Statistics(total, self.mean + difference * count / total, spread / total)

    def normalize(self, values: Float[Array, "*batch k"]) -> Float[Array, "*batch k"]:
        """Express values in standard deviations from the mean, at most ten."""
        return jnp.clip((values - self.mean) / jnp.sqrt(self.variance + 1e-6), -10.0, 10.0)

    def initialize(self, values: Float[Array, "*batch k"]) -> Statistics:
        """These statistics; if they are empty, the statistics of `values`. An untrained actor's mean is zero with both."""
        first = self.extend(values)
        return jax.tree.map(lambda a, b: jnp.where(self.count == 0, a, b), first, self)

    def take(self, size: int) -> Statistics:
        """Statistics of the first entries."""
        return Statistics(self.count, self.mean[:size], self.variance[:size])


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Actor:
    """A Gaussian policy.

    Attributes:
        layers: Layers of the network.
        log_std: Logarithm of each action's standard deviation (a,).
    """

    layers: Layers
    log_std: Float[Array, " a"]

    def mean(self, observation: Float[Array, "*batch o"]) -> Float[Array, "*batch a"]:
        """Mean action, within (-1, 1), at normalized observations."""
        return jnp.tanh(apply(self.layers, observation))

    def sample(
        self, observation: Float[Array, "*batch o"], noise: Float[Array, "*batch a"]
    ) -> Float[Array, "*batch a"]:
        """Action for standard normal noise; differentiable with respect to policy and observation."""
        return self.mean(observation) + jnp.exp(self.log_std) * noise

    def log_density(
        self, observation: Float[Array, "*batch o"], action: Float[Array, "*batch a"]
    ) -> Float[Array, "*batch"]:
        """Logarithm of an action's probability density."""
        z = (action - self.mean(observation)) * jnp.exp(-self.log_std)
        return (
            -0.5 * (z**2).sum(axis=-1)
            - self.log_std.sum()
            - 0.5 * len(self.log_std) * jnp.log(2 * jnp.pi)
        )

    def entropy(self) -> Float[Array, ""]:
        """Differential entropy [nat]."""
        return (self.log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e)).sum()


def make_actor(
    key: PRNGKeyArray, inputs: int, actions: int, hidden: Sequence[int], std: float
) -> Actor:
    """Make an actor whose mean is zero everywhere."""
    layers = make_layers(key, (inputs, *hidden, actions))
    last, bias = layers[-1]
    return Actor(
        (*layers[:-1], (jnp.zeros_like(last), bias)), jnp.full(actions, jnp.log(std), jnp.float32)
    )


def make_layers(key: PRNGKeyArray, sizes: Sequence[int]) -> Layers:
    """Make layers of these sizes, with orthogonal weights, so that signals keep their length, and without bias."""
    orthogonal = jax.nn.initializers.orthogonal(jnp.sqrt(2.0))
    keys = jax.random.split(key, len(sizes) - 1)
    return tuple(
        (orthogonal(layer_key, shape, jnp.float32), jnp.zeros(shape[1], jnp.float32))
        for layer_key, shape in zip(keys, itertools.pairwise(sizes), strict=True)
    )


def apply(layers: Layers, x: Float[Array, "*batch i"]) -> Float[Array, "*batch o"]:
    """Output of a network, with tanh after each layer except for the last."""
    for weights, bias in layers[:-1]:
        x = jnp.tanh(x @ weights + bias)
    weights, bias = layers[-1]
    return x @ weights + bias


def estimate_advantages(
    reward: Float[Array, "t n"],
    value: Float[Array, "t n"],
    next_value: Float[Array, "t n"],
    terminated: Bool[Array, "t n"],
    truncated: Bool[Array, "t n"],
    discount: float,
    trace: float,
) -> Float[Array, "t n"]:
    """Generalized advantage estimates: sums of TD errors, discounted by `discount * trace` within an episode.

    Schulman et al. (2016), equation 16. The TD(lambda) return is the value plus the advantage.

    >>> one = jnp.ones((2, 1))
    >>> cut = jnp.array([[True], [False]])
    >>> estimate_advantages(one, 0 * one, 4 * one, ~cut & False, cut, 0.5, 1.0).ravel().tolist()
    [3.0, 3.0]
    >>> estimate_advantages(one, 0 * one, 4 * one, cut, ~cut & False, 0.5, 1.0).ravel().tolist()
    [1.0, 3.0]

    Args:
        reward: Reward of each step.
        value, next_value: Values before and after the step, by the critic. If the step ended an episode, `next_value` is
            the value of the last observation before the reset.
        terminated, truncated: Whether the step ended the episode, and whether only the episode's time was over.
        discount: Gamma, the weight of the next step's reward.
        trace: Lambda; 0 for the error of one step, 1 for the whole return.
    """
    td_error = reward + discount * jnp.where(terminated, 0.0, next_value) - value
    decay = jnp.where(terminated | truncated, 0.0, discount * trace)

    def accumulate(later: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        td_error, decay = step
        advantage = td_error + decay * later
        return advantage, advantage

    return jax.lax.scan(accumulate, jnp.zeros_like(td_error[0]), (td_error, decay), reverse=True)[1]


#: Arrays of a traced environment, or NumPy arrays of an environment on the host.
Values = Any


class EnvironmentLike(Protocol):
    """A batch of worlds that reset themselves; the states are like `State` of `nermo_mjx.learn.Environment`.

    Attributes:
        worlds: Number of worlds.
        observation_size, privileged_size, action_size: Lengths of the arrays' last axes.
        pure: Whether `reset` and `step` can be traced.
        step_seconds: Simulated seconds of a step.
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
    """Transitions of t steps in n worlds.

    Attributes:
        critic_input: Observation and privileged input before each step, concatenated; the actor receives only the first
            columns.
        action, reward: Action and reward of each step.
        terms: Values of each term of the reward, by name.
        terminated, truncated: Whether the step ended the episode, and whether only the episode's time was over.
        next_critic_input: Observation and privileged input after each step, before a reset.
    """

    critic_input: Float[Values, "t n k"]
    action: Float[Values, "t n a"]
    reward: Float[Values, "t n"]
    terms: dict[str, Float[Values, "t n"]]
    terminated: Bool[Values, "t n"]
    truncated: Bool[Values, "t n"]
    next_critic_input: Float[Values, "t n k"]


@dataclasses.dataclass
class EpisodeScores:
    """Returns and lengths of the current episodes, and a tally of the episodes that ended; on the host.

    The first episode of each world is not counted, because it is cut short, so that episodes do not end all at once.

    Attributes:
        returns, lengths: Return and length of the current episode in each world.
        is_first: Whether the current episode of each world is the first one.
    """

    returns: np.ndarray
    lengths: np.ndarray
    is_first: np.ndarray

    @classmethod
    def empty(cls, worlds: int) -> EpisodeScores:
        """Scores before the first step."""
        return cls(np.zeros(worlds), np.zeros(worlds, int), np.ones(worlds, bool))

    def tally(self, experience: Experience) -> dict[str, float]:
        """Count the episodes that ended in these steps: their number, mean return and length, and the fraction that lasted."""
        reward, failed, truncated = (
            np.asarray(column)
            for column in (experience.reward, experience.terminated, experience.truncated)
        )
        returns, lengths, lasted = list[float](), list[int](), list[bool]()
        for t in range(len(reward)):
            self.returns += reward[t]
            self.lengths += 1
            is_ended = failed[t] | truncated[t]
            is_whole = is_ended & ~self.is_first
            returns += self.returns[is_whole].tolist()
            lengths += self.lengths[is_whole].tolist()
            lasted += (~failed[t][is_whole]).tolist()
            self.returns[is_ended], self.lengths[is_ended], self.is_first[is_ended] = 0.0, 0, False
        count = len(returns)
        scores: dict[str, list[Any]] = {"return": returns, "length": lengths, "lasted": lasted}
        return {
            "episodes": float(count),
            **{name: sum(column) / count if count else np.nan for name, column in scores.items()},
            "reward": float(reward.mean()),
            **{f"term.{name}": float(np.mean(term)) for name, term in experience.terms.items()},
        }


def make_collector(
    environment: EnvironmentLike, steps: int
) -> Callable[[Actor, Statistics, Any, PRNGKeyArray], tuple[Any, Experience]]:
    """Make a function that lets a policy act for some steps: (actor, statistics, state, key) to (state, experience)."""
    shape = (steps, environment.worlds, environment.action_size)
    if environment.pure:
        return jax.jit(
            lambda actor, statistics, state, key: collect_traced(
                environment, actor, statistics, state, jax.random.normal(key, shape, jnp.float32)
            ),
            compiler_options=compiler_options(),
        )
    act = jax.jit(_act)
    sample_noise = jax.jit(lambda key: jax.random.normal(key, shape, jnp.float32))

    def collect(
        actor: Actor, statistics: Statistics, state: Any, key: PRNGKeyArray
    ) -> tuple[Any, Experience]:
        policy, noise = functools.partial(act, actor, statistics), np.asarray(sample_noise(key))
        if isinstance(environment, Mixture):
            return _collect_from_parts(environment, policy, state, noise)
        return _collect_on_host(environment, policy, state, noise)

    return collect


def _experience(state: Any, action: Any, next_state: Any, numpy: Any) -> Experience:
    """The transition of one step, in arrays of the module `numpy`: NumPy, or `jax.numpy`."""

    def concatenate(*parts: Any) -> Any:
        return numpy.concatenate([numpy.asarray(part, np.float32) for part in parts], axis=-1)

    return Experience(
        concatenate(state.observation, state.privileged),
        action,
        numpy.asarray(next_state.reward, np.float32),
        dict(next_state.terms),
        numpy.asarray(next_state.terminated),
        numpy.asarray(next_state.truncated),
        concatenate(next_state.final_observation, next_state.final_privileged),
    )


def _collect_on_host(
    environment: EnvironmentLike,
    policy: Callable[[Any, Any], Array],
    state: Any,
    noise: Float[Values, "t n a"],
) -> tuple[Any, Experience]:
    """Simulate the steps of an environment on the host one after another: the last state, and the transitions."""
    steps = []
    for step_noise in noise:
        action = np.asarray(policy(state.observation, step_noise))
        next_state = environment.step(state, action)
        steps.append(_experience(state, action, next_state, np))
        state = next_state
    return state, jax.tree.map(lambda *leaves: np.stack(leaves), *steps)


def _collect_from_parts(
    mixture: Mixture, policy: Callable[[Any, Any], Array], state: Any, noise: Float[Values, "t n a"]
) -> tuple[Any, Experience]:
    """Simulate the steps of several environments on the host. Each runs in its own thread, to use all processors."""
    part_inputs = zip(mixture.parts, state.engine, mixture.split(noise, 1), strict=True)
    calls = [
        functools.partial(_collect_on_host, part, policy, part_state, part_noise)
        for part, part_state, part_noise in part_inputs
    ]
    states, experiences = zip(*mixture.run_in_threads(calls), strict=True)

    def widen(i: int, values: Float[Values, "t n k"]) -> Float[Values, "t n k"]:
        observation, privileged = np.split(values, [mixture.observation_size], axis=-1)
        return np.concatenate([observation, mixture.widen(i, privileged)], axis=-1)

    parts = [
        part._replace(
            critic_input=widen(i, part.critic_input),
            next_critic_input=widen(i, part.next_critic_input),
        )
        for i, part in enumerate(experiences)
    ]
    return mixture.join(states), jax.tree.map(
        lambda *leaves: np.concatenate(leaves, axis=1), *parts
    )


def _act(actor: Actor, statistics: Statistics, observation: Any, noise: Array) -> Array:
    observation = jnp.asarray(observation, jnp.float32)
    return actor.sample(statistics.take(observation.shape[-1]).normalize(observation), noise)


def collect_traced(
    environment: EnvironmentLike,
    actor: Actor,
    statistics: Statistics,
    state: Any,
    noise: Float[Array, "t n a"],
) -> tuple[Any, Experience]:
    """Simulate the steps of a pure environment in one scan: the last state, and the transitions."""

    def step(state: Any, noise: Array) -> tuple[Any, Experience]:
        action = _act(actor, statistics, state.observation, noise)
        next_state = environment.step(state, action)
        return next_state, _experience(state, action, next_state, jnp)

    return jax.lax.scan(step, state, noise)


#: Gradients of a network are clipped to this 2-norm.
MAX_GRADIENT_NORM = 1.0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LearningState:
    """The state of a training between two iterations: all inputs of the next iteration, except for the worlds.

    Attributes:
        actor, critic: Networks; the critic also receives the privileged input.
        target: Initial critic, which checkpoints of all releases contain.
        statistics: Statistics of the critic's input, whose first columns are the observation.
        optimizers: States of optax, of actor and critic.
        rate: Learning rate of the actor's next step.
        key: Data of the random key (2,), which determines all random numbers, together with the iteration.
        iteration, steps: Number of iterations, and of control steps of all worlds, so far.
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

    def advance(
        self, critic_input: Float[Array, "*batch k"], steps: Any, **changes: Any
    ) -> LearningState:
        """The state one iteration later: statistics with the critic's inputs, `steps` more control steps, changed fields."""
        return dataclasses.replace(
            self,
            iteration=self.iteration + 1,
            steps=self.steps + steps,
            statistics=self.statistics.extend(critic_input),
            **changes,
        )

    def random_key(self, purpose: int) -> PRNGKeyArray:
        """Random key for one purpose of this iteration."""
        key = jax.random.fold_in(jax.random.wrap_key_data(self.key), self.iteration)
        return jax.random.fold_in(key, purpose)


#: Purposes of random numbers.
RESET_KEY, ACTION_KEY, SHUFFLE_KEY = range(3)


def make_learning_state(
    environment: EnvironmentLike, seed: int, hidden: tuple[int, ...], std: float, rate: float
) -> LearningState:
    """Make the learning state before the first step."""
    observation_size = environment.observation_size
    size = observation_size + environment.privileged_size

    @jax.jit  # compiled as a whole, because each operation outside of this function would be a separate program
    def initialize(key: PRNGKeyArray) -> LearningState:
        key, first, second = jax.random.split(key, 3)
        actor = make_actor(first, observation_size, environment.action_size, hidden, std)
        critic = make_layers(second, (size, *hidden, 1))
        optimizer = make_optimizer()
        return LearningState(
            actor,
            critic,
            critic,
            Statistics.empty(size),
            (optimizer.init(actor), optimizer.init(critic)),
            jnp.float32(rate),
            jax.random.key_data(key),
            jnp.zeros((), jnp.int32),
            jnp.zeros((), jnp.int32),
        )

    learned: LearningState = initialize(jax.random.key(seed))
    return learned


def make_optimizer() -> optax.GradientTransformation:
    """Adam with clipped gradients. The learning rate is an argument of each step."""
    return optax.chain(optax.clip_by_global_norm(MAX_GRADIENT_NORM), optax.scale_by_adam(eps=1e-7))


def apply_gradient(network: Any, gradient: Any, state: Any, rate: Any) -> Any:
    """Change a network by one step of its optimizer: the network, and the optimizer's state.

    If the gradient is not finite, the step is skipped, and both stay as they are.
    """
    update, next_state = make_optimizer().update(gradient, state)
    is_finite = jnp.isfinite(optax.global_norm(gradient))
    changed = jax.tree.map(
        lambda x, d: jnp.where(is_finite, x - rate * d, x).astype(x.dtype), network, update
    )
    return changed, jax.tree.map(lambda new, old: jnp.where(is_finite, new, old), next_state, state)
