"""The objective, a weighted sum of terms over named metrics in pure JAX, and the coordinates of a tuning."""

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

#: The term that compares a walk with a recording; `recording` in the tuning's file defines it.
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
    """The metrics of a run that are allowed in a term, by name.

    >>> "speed" in objective_metrics(), "fell" in objective_metrics()
    (True, False)
    """
    aims = {name: declaration for name, declaration in metrics.items() if name not in _NO_AIM}
    return aims | {TRAJECTORY_ERROR: TRAJECTORY_METRIC}


#: Built-in metrics that are allowed in a term.
OBJECTIVE_METRICS: Final = objective_metrics()


class _Metrics(Choice):
    """A field for the metric of a term, a built-in or a custom one."""

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
        """The name of the metric m."""
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
        """Names of the metrics that the terms read, each once."""
        return tuple(dict.fromkeys(term.metric for term in self.terms))

    def value(self, metrics: Mapping[str, Any]) -> Float[Array, "*n"]:
        """The objective (*n,) from metrics (*n,) by name, in SI units and radians.

        The function reads only the metrics of the terms, so that a NaN in another metric has no effect. If these metrics
        are finite, the objective and its derivative are finite. If one of them is NaN, for example because nothing was
        measured, the objective is NaN.
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
# A periodic parameter (an angle whose bounds are a whole turn apart) can cross its bounds. Its coordinate is
# proportional to the parameter, and x wraps around to the other side:
#
#     x = low + (high - low) frac(1/2 + u/4),    dx/du = (high - low) / 4
#
# In the middle of the bounds, both kinds have the slope (high - low) / 4: a unit of u is the same fraction of every
# parameter's range, so that one learning rate and one standard deviation suit all parameters.


#: A point closer to a bound than this share of the range is moved inwards, because on the bound u is infinite and dx/du
#: is zero.
EDGE: Final = 0.01
#: A step ends at least at this share of the range from a bound, because dx/du is too small to return from closer points.
FURTHEST: Final = 0.001


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Bounds:
    """Bounds of p parameters, in the parameters' own units.

    Attributes:
        low, high: Ends of each range (p,); the ends of a periodic parameter are one period apart.
        periodic: Whether the parameter is periodic (p,).
    """

    low: Float[Array, " p"]
    high: Float[Array, " p"]
    periodic: Bool[Array, " p"]


def to_unconstrained(bounds: Bounds, x: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """Coordinates u of parameters x within their bounds.

    A bounded parameter that is closer to its bound than `EDGE` (1 % of the range) is moved to this distance, where the
    slope is 1/25 of the slope in the middle. Therefore u is finite, and a starting point on a bound can leave the bound.
    """
    share = (x - bounds.low) / (bounds.high - bounds.low)
    inside = jnp.clip(share, EDGE, 1.0 - EDGE)
    return jnp.where(bounds.periodic, 4.0 * (share - 0.5), jnp.log(inside) - jnp.log1p(-inside))


def from_unconstrained(bounds: Bounds, u: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """Parameters x (p,) at coordinates u (p,); x is within the bounds for every finite u."""
    turn = 0.5 + 0.25 * u
    share = jnp.where(bounds.periodic, turn - jnp.floor(turn), jax.nn.sigmoid(u))
    return jnp.clip(bounds.low + (bounds.high - bounds.low) * share, bounds.low, bounds.high)


def slope(bounds: Bounds, u: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """The derivative dx/du at u (p,).

    By the chain rule, d value/du = d value/dx dx/du. Therefore the product of this derivative and a gradient with respect
    to the parameters is the gradient with respect to the coordinates.
    """
    share = jax.nn.sigmoid(u)
    return (bounds.high - bounds.low) * jnp.where(bounds.periodic, 0.25, share * (1.0 - share))


def confine(bounds: Bounds, u: Float[Array, "*n p"]) -> Float[Array, "*n p"]:
    """Coordinates at least `FURTHEST` away from the bounds; periodic coordinates do not change."""
    limit = jnp.log((1.0 - FURTHEST) / FURTHEST)
    return jnp.where(bounds.periodic, u, jnp.clip(u, -limit, limit))


# ---
# The tuner's interface to a simulation: values, gradients and metrics of a batch of points in one program.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Results of n points.

    Attributes:
        value: Objective (n,); lower is better.
        gradient: Derivative of the value with respect to the parameters (n, p), per unit of each parameter; None if not
            requested.
        metrics: Metrics (n,) by name, in their units.
        ok: Whether the robot walked to the end, and the value and the gradient are finite (n,).
    """

    value: Float[Array, " n"]
    gradient: Float[Array, "n p"] | None
    metrics: dict[str, Float[Array, " n"]]
    ok: Bool[Array, " n"]


class Problem(Protocol):
    """The function that a tuning minimizes."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the p tuned parameters, in the order of a point's numbers."""

    @property
    def simulated_seconds(self) -> float:
        """Simulated time of one world's forward run [s]."""

    @property
    def gradient_cost(self) -> float:
        """Cost of the value and gradient of one world, in forward runs."""

    def evaluate(self, points: Float[Array, "n p"], gradient: bool) -> Evaluation:
        """The value and metrics, and with `gradient` the gradients, at n points, one world each.

        The number of points can be any n; a second call with the same n and `gradient` must not compile again.
        """
