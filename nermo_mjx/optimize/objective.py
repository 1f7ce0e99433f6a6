"""What is minimized: a weighted sum of terms over named metrics, pure JAX; and in which coordinates a tuning moves."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from pydantic import ConfigDict

from nermo_mjx.rollout import METRICS, Metric
from nermo_mjx.specs.fields import JsonSchema, Refused
from nermo_mjx.specs.model import Spec
from nermo_mjx.specs.reading import Document
from nermo_mjx.specs.values import FILE_METRICS, Choice, Finite, Positive

#: The term that compares with a recording; the tuning's file names it under `recording`.
TRAJECTORY_ERROR: Final = "trajectory_error"
#: Metrics about the outcome of a run rather than the quality of the walk: flags, or functions of the run's length.
_NO_AIM: Final = ("distance", "duration", "fell", "diverged", "failure_time")
TRAJECTORY_METRIC: Final = Metric(
    "1", "mean squared difference from the recording, over its variance", "low"
)
#: Aims of a term for its metric.
AIMS: Final = ("maximize", "minimize", "hold")
OBJECTIVE_FORM: Final = (
    "a list such as [{maximize: speed}, {minimize: roll_std, weight: 0.5, scale: 0.05}]"
)


def objective_metrics(metrics: Mapping[str, Metric] = METRICS) -> dict[str, Metric]:
    """What a term may name, of the metrics that a run gives.

    >>> "speed" in objective_metrics(), "fell" in objective_metrics()
    (True, False)
    """
    aims = {name: declaration for name, declaration in metrics.items() if name not in _NO_AIM}
    return aims | {TRAJECTORY_ERROR: TRAJECTORY_METRIC}


#: What a term may name without custom metrics.
OBJECTIVE_METRICS: Final = objective_metrics()


class _Metrics(Choice):
    """A metric that a term may name: a built-in or a custom one."""

    def check(self, value: Any) -> str:
        return Choice(tuple(objective_metrics(FILE_METRICS.get()))).check(value)

    def schema(self, base: JsonSchema) -> JsonSchema:
        return {"anyOf": [super().schema(base), {"type": "string"}]}


_Metric = Annotated[str, _Metrics(tuple(OBJECTIVE_METRICS))]


@dataclasses.dataclass(frozen=True)
class ObjectiveTerm(Spec):
    """A term of the objective, for a metric m: exactly one of `maximize`, `minimize` and `hold` names it."""

    __pydantic_config__ = ConfigDict(
        **Spec.__pydantic_config__,
        json_schema_extra={
            "oneOf": [{"required": [aim]} for aim in AIMS],
            "dependencies": {"hold": ["at"], "at": ["hold"]},
        },
    )
    what = "a field of a term"
    expected = OBJECTIVE_FORM
    maximize: _Metric = None  # type: ignore[assignment]  # none cannot be written in a file
    """- weight m / scale"""
    minimize: _Metric = None  # type: ignore[assignment]
    """weight m / scale"""
    hold: _Metric = None  # type: ignore[assignment]
    """weight ((m - at) / scale)^2"""
    at: Finite = None  # type: ignore[assignment]
    """the value that is held, in the metric's unit"""
    weight: Positive = 1.0
    """how much the term counts"""
    scale: Positive = 1.0
    """what counts as one, in the metric's unit; makes terms of different units comparable"""

    def __post_init__(self) -> None:
        named = [aim for aim in AIMS if getattr(self, aim) is not None]
        if len(named) != 1:
            raise Refused(
                f"names {len(named)} metrics: expected one, under {', '.join(AIMS[:-1])} or {AIMS[-1]}."
            )
        if self.at is not None and self.hold is None:
            raise Refused(
                "is not a field of a term that holds nothing; allowed are weight, scale.", "at"
            )
        if self.at is None and self.hold is not None:
            raise Refused(f"holds {self.hold} without 'at': give the value to hold it at.")

    @property
    def aim(self) -> str:
        """One of `AIMS`."""
        return next(aim for aim in AIMS if getattr(self, aim) is not None)

    @property
    def metric(self) -> str:
        """The name of m."""
        return str(getattr(self, self.aim))

    def value(self, m: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """The term at a value of its metric."""
        if self.aim == "hold":
            return self.weight * ((m - self.at) / self.scale) ** 2
        return (-self.weight if self.aim == "maximize" else self.weight) * (m / self.scale)


@dataclasses.dataclass(frozen=True)
class Objective:
    """A sum of terms; lower is better."""

    terms: tuple[ObjectiveTerm, ...]

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


def read_objective(doc: Document, terms: Sequence[ObjectiveTerm] | None) -> Objective:
    """The weighted terms of a file; raises `SpecError`."""
    if not terms:
        doc.fail(("objective",), f"is missing or empty: expected {OBJECTIVE_FORM}.")
    term_keys = [(term.aim, term.metric) for term in terms]
    for i, (aim, metric) in enumerate(term_keys):
        if (aim, metric) in term_keys[:i]:
            doc.fail(("objective", i), f"is '{aim}: {metric}' again: give it once, with a weight.")
    return Objective(tuple(terms))


# ---
# Unbounded coordinates for bounded parameters, so that every step of an optimizer stays within bounds.
#
# A parameter x in (low, high) is the smooth image of a coordinate u that may take any value:
#
#     x = low + (high - low) sigmoid(u),         dx/du = (high - low) sigmoid(u) (1 - sigmoid(u))
#
# A periodic parameter (an angle whose bounds are a whole turn) has no bounds to stay away from. Its coordinate is
# proportional to it, and x wraps around to the other side:
#
#     x = low + (high - low) frac(1/2 + u/4),    dx/du = (high - low) / 4
#
# In the middle of the bounds both have the slope (high - low) / 4: a unit of u is the same fraction of every
# parameter's range, so that one learning rate and one standard deviation suit all.


#: A point nearer to a bound than this share of the range is moved in: on the bound itself u is infinite and dx/du zero.
EDGE: Final = 0.01
#: No step leads nearer to a bound than this share of the range: from beyond, returning would take forever.
FURTHEST: Final = 0.001


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Bounds:
    """Bounds of p parameters, in the parameters' own units.

    Attributes:
        low, high: ends of each range (p,); of a periodic parameter they are one period apart.
        periodic: whether the ends are the same place (p,).
    """

    low: Float[Array, " p"]
    high: Float[Array, " p"]
    periodic: Bool[Array, " p"]


def to_unconstrained(bounds: Bounds, x: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """Coordinates u of parameters x within their bounds.

    A bounded parameter on its bound, or within `EDGE` of it, is taken as `EDGE` inside: 1 % of the range, where the
    slope is a 25th of that in the middle. u is never infinite, so that a start on a bound can leave it.
    """
    share = (x - bounds.low) / (bounds.high - bounds.low)
    inside = jnp.clip(share, EDGE, 1.0 - EDGE)
    return jnp.where(bounds.periodic, 4.0 * (share - 0.5), jnp.log(inside) - jnp.log1p(-inside))


def from_unconstrained(bounds: Bounds, u: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """Parameters x at coordinates u; within the bounds for every finite u."""
    turn = 0.5 + 0.25 * u
    share = jnp.where(bounds.periodic, turn - jnp.floor(turn), jax.nn.sigmoid(u))
    return jnp.clip(bounds.low + (bounds.high - bounds.low) * share, bounds.low, bounds.high)


def slope(bounds: Bounds, u: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """dx/du at u.

    By the chain rule d value/du = d value/dx dx/du, a gradient to the parameters times this is one to the coordinates.
    """
    share = jax.nn.sigmoid(u)
    return (bounds.high - bounds.low) * jnp.where(bounds.periodic, 0.25, share * (1.0 - share))


def confine(bounds: Bounds, u: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """Coordinates that a step may end at: not nearer to a bound than `FURTHEST`; a periodic one may be anywhere."""
    limit = jnp.log((1.0 - FURTHEST) / FURTHEST)
    return jnp.where(bounds.periodic, u, jnp.clip(u, -limit, limit))


# ---
# The tuner's interface to a simulation: values, gradients and metrics of a batch of points in one program.


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
