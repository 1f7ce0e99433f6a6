"""Generalized advantages and TD(lambda) targets, distinguishing terminations from time limits.

A terminated episode has no future; one truncated at its time limit does, and is bootstrapped with the value at the
observation before the reset. Arrays are (steps, worlds).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


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
