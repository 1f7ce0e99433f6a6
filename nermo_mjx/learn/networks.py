"""Actor and critic: two small networks over normalized observations, as plain pytrees.

The actor's mean is tanh of its last layer, whose weights begin at zero: an untrained policy has no effect,
so a residual starts as the controller that it is added to. Its standard deviation is one parameter per action.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

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
        return cls(jnp.zeros((), jnp.float32), jnp.zeros(size, jnp.float32), jnp.ones(size, jnp.float32))

    def extended(self, values: Float[Array, "*batch k"]) -> Statistics:
        """With more values."""
        more = values.reshape(-1, values.shape[-1])
        count, mean, variance = jnp.float32(len(more)), more.mean(axis=0), more.var(axis=0)
        total, apart = self.count + count, mean - self.mean
        spread = self.variance * self.count + variance * count + apart**2 * self.count * count / total
        return Statistics(total, self.mean + apart * count / total, spread / total)

    def normalized(self, values: Float[Array, "*batch k"]) -> Float[Array, "*batch k"]:
        """Values in standard deviations from the mean, at most ten."""
        return jnp.clip((values - self.mean) / jnp.sqrt(self.variance + 1e-6), -10.0, 10.0)

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

    def mean(self, seen: Float[Array, "*batch o"]) -> Float[Array, "*batch a"]:
        """The mean action, within (-1, 1), at normalized observations."""
        return jnp.tanh(apply(self.layers, seen))

    def sample(self, seen: Float[Array, "*batch o"], noise: Float[Array, "*batch a"]) -> Float[Array, "*batch a"]:
        """The action at standard normal noise; differentiable in policy and observation."""
        return self.mean(seen) + jnp.exp(self.log_std) * noise

    def log_density(self, seen: Float[Array, "*batch o"], action: Float[Array, "*batch a"]) -> Float[Array, "*batch"]:
        """The logarithm of an action's probability density."""
        z = (action - self.mean(seen)) * jnp.exp(-self.log_std)
        return -0.5 * (z**2).sum(axis=-1) - self.log_std.sum() - 0.5 * len(self.log_std) * jnp.log(2 * jnp.pi)

    def entropy(self) -> Float[Array, ""]:
        """Differential entropy [nat]."""
        return (self.log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e)).sum()


def new_actor(key: PRNGKeyArray, observed: int, actions: int, hidden: Sequence[int], std: float) -> Actor:
    """An actor whose mean is zero everywhere."""
    layers = new_layers(key, (observed, *hidden, actions))
    last, bias = layers[-1]
    return Actor((*layers[:-1], (jnp.zeros_like(last), bias)), jnp.full(actions, jnp.log(std), jnp.float32))


def new_layers(key: PRNGKeyArray, sizes: Sequence[int]) -> Layers:
    """Layers of these sizes: orthogonal weights, so that signals keep their length, and no bias."""
    orthogonal = jax.nn.initializers.orthogonal(jnp.sqrt(2.0))
    keys = jax.random.split(key, len(sizes) - 1)
    return tuple((orthogonal(each, (a, b), jnp.float32), jnp.zeros(b, jnp.float32))
                 for each, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True))  # fmt: skip


def apply(layers: Layers, x: Float[Array, "*batch i"]) -> Float[Array, "*batch o"]:
    """The network's output: tanh behind each layer but the last."""
    for weights, bias in layers[:-1]:
        x = jnp.tanh(x @ weights + bias)
    weights, bias = layers[-1]
    return x @ weights + bias
