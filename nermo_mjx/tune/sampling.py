"""Placement of the worlds of an estimate: how many, how far from their point, and with which random numbers."""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt

#: For which of a tuning's estimates the perturbations are the same.
COMMON: Final = ("none", "starts", "iterations", "both")


@dataclasses.dataclass(frozen=True)
class Estimator:
    """How a gradient is estimated; hashable, so that it is static in compiled programs.

    Attributes:
        name: a key of `nermo_mjx.tune.estimators.ESTIMATORS`.
        samples: perturbed worlds of each start, an even number; 0 for `exact`.
        sigma: standard deviation of the perturbations, in coordinates u (`nermo_mjx.tune.bounds`).
        common: common random numbers: the same perturbations for all `starts`, for all `iterations`, for `both`, or
            `none`.
        gamma: most bias that a mixture accepts from the first order, in standard errors of the zeroth.
        normalized: whether each world's gradient counts with length 1, for `smoothed`.
    """

    name: str = "exact"
    samples: int = 0
    sigma: float = 0.0
    common: str = "none"
    gamma: float = 1.0
    normalized: bool = False

    @property
    def worlds(self) -> int:
        """Worlds of each start."""
        return 1 + self.samples

    @property
    def needs_gradient(self) -> bool:
        """Whether the worlds' own gradients are wanted."""
        return self.name != "evolution"

    def written(self) -> str | dict[str, Any]:
        """As written in a tuning file."""
        if self.name == "exact":
            return self.name
        options: dict[str, Any] = {"samples": self.samples, "sigma": self.sigma, "common": self.common}
        own = {"gamma": self.gamma} if self.name == "mixture" else {}
        return {self.name: options | own | ({"normalized": True} if self.normalized else {})}


def perturbations(
    estimator: Estimator, key: UInt[Array, " 2"], iteration: Int[Array, ""], starts: int, parameters: int
) -> Float[Array, "starts k p"]:
    """The noise e of each start's k = samples / 2 pairs, a function of the key and the iteration's number alone."""
    base = jax.random.fold_in(jax.random.wrap_key_data(key), 0 if _shared(estimator, "iterations") else iteration)
    which = jnp.zeros(starts, int) if _shared(estimator, "starts") else jnp.arange(starts)
    keys = jax.vmap(lambda start: jax.random.fold_in(base, start))(which)
    return jax.vmap(lambda one: jax.random.normal(one, (estimator.samples // 2, parameters)))(keys)


def offsets(estimator: Estimator, noise: Float[Array, "*starts k p"]) -> Float[Array, "*starts worlds p"]:
    """Where each start's worlds stand relative to its point: the centre, the first halves, the second halves."""
    step = estimator.sigma * noise
    centre = jnp.zeros((*step.shape[:-2], 1, step.shape[-1]), step.dtype)
    return jnp.concatenate([centre, step, -step], axis=-2)


def _shared(estimator: Estimator, what: str) -> bool:
    return estimator.common in (what, "both")
