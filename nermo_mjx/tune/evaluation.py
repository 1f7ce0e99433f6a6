"""The tuner's interface to a simulation: values, gradients and metrics of a batch of points in one program."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import jax
from jaxtyping import Array, Bool, Float


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Results of n points.

    Attributes:
        value: objective (n,), lower is better.
        gradient: d value / d parameters (n, p), per unit of each parameter; None if not requested.
        metrics: name -> (n,), in the metrics' own units.
        ok: whether the robot walked to the end and all numbers are finite, value and gradient (n,).
    """

    value: Float[Array, " n"]
    gradient: Float[Array, "n p"] | None
    metrics: dict[str, Float[Array, " n"]]
    ok: Bool[Array, " n"]


class Problem(Protocol):
    """A function to be tuned."""

    @property
    def names(self) -> tuple[str, ...]:
        """The p tuned parameters, in the order of a point's numbers."""

    @property
    def simulated_seconds(self) -> float:
        """Simulated time of one world's forward run [s]."""

    @property
    def gradient_cost(self) -> float:
        """Cost of value and gradient of one world, in forward runs."""

    def evaluate(self, points: Float[Array, "n p"], gradient: bool) -> Evaluation:
        """Value and metrics, and on demand gradients, at n points, one world each.

        Called with any n; a second call with the same n and `gradient` must not compile again.
        """
