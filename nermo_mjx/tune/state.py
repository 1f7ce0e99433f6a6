"""State of a tuning: everything that its next iteration depends on, as one pytree of arrays."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt

from nermo_mjx.tune.bounds import to_unconstrained
from nermo_mjx.tune.spec import Tuning


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TuneState:
    """A tuning of p parameters from several starts, before an iteration.

    Attributes:
        u: points in unbounded coordinates (starts, p), see `nermo_mjx.tune.bounds`.
        optimizer: state of the optimizer, every leaf with a leading axis of starts.
        iteration: iterations done.
        key: data of the random key (2,); an iteration's perturbations follow from it and the iteration's number.
        best_u: the best point of each start so far (starts, p); its beginning, where none walked to the end yet.
        best_value: objective there (starts,); infinite, where none walked to the end yet.
        best_iteration: iteration that evaluated it (starts,); -1, where none walked to the end yet.
    """

    u: Float[Array, "starts p"]
    optimizer: Any
    iteration: Int[Array, ""]
    key: UInt[Array, " 2"]
    best_u: Float[Array, "starts p"]
    best_value: Float[Array, " starts"]
    best_iteration: Int[Array, " starts"]


def initial_state(tuning: Tuning) -> TuneState:
    """The state before the first iteration."""
    u = to_unconstrained(tuning.bounds, jnp.asarray(tuning.start_points(), float))
    return TuneState(
        u=u,
        optimizer=jax.vmap(tuning.optimizer.init)(u),
        iteration=jnp.zeros((), int),
        key=jax.random.key_data(jax.random.key(tuning.seed)),
        best_u=u,
        best_value=jnp.full(len(u), jnp.inf, u.dtype),
        best_iteration=jnp.full(len(u), -1),
    )
