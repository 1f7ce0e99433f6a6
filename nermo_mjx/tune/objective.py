"""What a tuning minimizes: a weighted sum of terms over named metrics, pure JAX."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Final

import jax.numpy as jnp
from jaxtyping import Array, Float

from nermo_mjx.rollout import METRICS, Metric

#: The term that compares with a recording; the tuning's file names it under `recording`.
TRAJECTORY_ERROR: Final = "trajectory_error"
#: Metrics about the outcome of a run rather than the quality of the walk: flags, or functions of the run's length.
_NO_AIM: Final = ("distance", "duration", "fell", "diverged", "failure_time")
TRAJECTORY_METRIC: Final = Metric("1", "mean squared difference from the recording, over its variance", "low")
#: Aims of a term for its metric.
AIMS: Final = ("maximize", "minimize", "hold")


def objective_metrics(metrics: Mapping[str, Metric] = METRICS) -> dict[str, Metric]:
    """What a term may name, of the metrics that a run gives.

    >>> "speed" in objective_metrics(), "fell" in objective_metrics()
    (True, False)
    """
    aims = {name: about for name, about in metrics.items() if name not in _NO_AIM}
    return aims | {TRAJECTORY_ERROR: TRAJECTORY_METRIC}


#: What a term may name without custom metrics.
OBJECTIVE_METRICS: Final = objective_metrics()


@dataclasses.dataclass(frozen=True)
class Term:
    """One term of the objective.

    Attributes:
        aim: `maximize`: -weight m / scale; `minimize`: weight m / scale; `hold`: weight ((m - at) / scale)^2.
        metric: m, a key of `objective_metrics`.
        weight: how much the term counts.
        scale: what counts as one, in the metric's unit; makes terms of different units comparable.
        at: value that is held, in the metric's unit.
    """

    aim: str
    metric: str
    weight: float = 1.0
    scale: float = 1.0
    at: float = 0.0

    def value(self, m: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """The term at a value of its metric."""
        if self.aim == "hold":
            return self.weight * ((m - self.at) / self.scale) ** 2
        return (-self.weight if self.aim == "maximize" else self.weight) * (m / self.scale)

    def written(self) -> dict[str, Any]:
        """As written in a tuning file."""
        held = {"at": self.at} if self.aim == "hold" else {}
        return {self.aim: self.metric, **held, "weight": self.weight, "scale": self.scale}


@dataclasses.dataclass(frozen=True)
class Objective:
    """A sum of terms; lower is better."""

    terms: tuple[Term, ...]

    @property
    def metrics(self) -> tuple[str, ...]:
        """The metrics that the terms read, each once."""
        return tuple(dict.fromkeys(term.metric for term in self.terms))

    def value(self, metrics: Mapping[str, Any]) -> Float[Array, "*n"]:
        """The objective from metrics, name -> (*n,), in SI units and radians.

        Only what the terms name is read, so that a NaN elsewhere does no harm. It is finite, and so is its derivative,
        wherever these metrics are; where one of them is NaN (nothing was measured), so is the objective.
        """
        total = self.terms[0].value(jnp.asarray(metrics[self.terms[0].metric]))
        for term in self.terms[1:]:
            total = total + term.value(jnp.asarray(metrics[term.metric]))
        return total
