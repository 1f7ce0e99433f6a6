"""The sections of a tuning file that a sweep file does not have: tuned parameters, objective, optimizer, estimator."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

from pydantic import ConfigDict, Field

from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.specs.fields import Fields, JsonSchema, OneOf, Refused, chosen, optional
from nermo_mjx.specs.reading import Document, FieldPath, describe
from nermo_mjx.specs.values import MEASURED, Choice, Finite, Numbers, Positive, Whole, check_value
from nermo_mjx.tune.objective import AIMS, OBJECTIVE_METRICS, TRAJECTORY_ERROR, Objective, Term, objective_metrics
from nermo_mjx.tune.optimizer import CONTROLLED, LEARNING_RATE, NAMES, Optimizer
from nermo_mjx.tune.sampling import COMMON, Estimator

#: Periodic parameters and their periods.
_PERIODS: Final = {
    "spine.phase": 2 * math.pi, "start.yaw": 2 * math.pi, "start.phase": 1.0, "offset": 1.0, "limb.phase": 1.0,
}  # fmt: skip
#: Share of a period by which written bounds may miss it: 3.14 is meant as pi.
_ROUNDING: Final = 1e-3
_OBJECTIVE: Final = "a list such as [{maximize: speed}, {minimize: roll_std, weight: 0.5, scale: 0.05}]"


@dataclasses.dataclass(frozen=True)
class Tuned:
    """One tuned parameter, in its own unit.

    Attributes:
        low, high: bounds; of a periodic parameter they are exactly one period apart.
        start: value of the first start.
        periodic: whether it wraps around from one bound to the other.
    """

    name: str
    low: float
    high: float
    start: float
    periodic: bool = False

    def written(self) -> dict[str, Any]:
        """As written in a tuning file."""
        return {"bounds": [self.low, self.high], "start": self.start} | ({"periodic": True} if self.periodic else {})


class TunedFields(Fields):
    """A tuned parameter, as written in a file."""

    what: ClassVar = "a field of a tuned parameter"
    expected: ClassVar = "{bounds: [low, high], start: number}, both optional"
    bounds: Annotated[list[Finite], Numbers("[low, high]", 2, 2)] = optional("by default its range")
    start: float = optional("value of the first start, by default the parameter's")
    periodic: bool = Field(False, description="whether it wraps around from one bound to the other")


class _Metrics(Choice):
    """A metric that a term may name: a built-in or a custom one."""

    def check(self, value: Any) -> str:
        return Choice(tuple(objective_metrics(MEASURED.get()))).check(value)

    def schema(self, own: JsonSchema) -> JsonSchema:
        return {"anyOf": [super().schema(own), {"type": "string"}]}


_Metric = Annotated[str, _Metrics(tuple(OBJECTIVE_METRICS))]
#: Schema of a term of a file without custom metrics.
KNOWN_METRICS: Final[Any] = {"properties": {aim: {"enum": [*OBJECTIVE_METRICS]} for aim in AIMS}}


class TermFields(Fields):
    """A term of the objective, as written in a file."""

    what: ClassVar = "a field of a term"
    expected: ClassVar = _OBJECTIVE
    model_config = ConfigDict(
        json_schema_extra={"oneOf": [{"required": [aim]} for aim in AIMS],
                           "dependencies": {"hold": ["at"], "at": ["hold"]}}
    )  # fmt: skip
    maximize: _Metric = optional("- weight m / scale")
    minimize: _Metric = optional("weight m / scale")
    hold: _Metric = optional("weight ((m - at) / scale)^2")
    at: Finite = optional("the value that is held, in the metric's unit")
    weight: Positive = optional("how much the term counts, by default 1")
    scale: Positive = optional("what counts as one, in the metric's unit, by default 1")

    @classmethod
    def written_out(cls, given: Any) -> Any:
        if isinstance(given, dict) and set(given) <= set(cls.names()):
            aims = [key for key in given if key in AIMS]
            if len(aims) != 1:
                raise Refused(f"is {describe(given)}: expected one of {', '.join(AIMS)} with the name of a metric.")
            if "at" in given and aims != ["hold"]:
                raise Refused("is not a field of a term that holds nothing; allowed are weight, scale.", "at")
            if aims == ["hold"] and "at" not in given:
                raise Refused(f"holds {given['hold']} without 'at': give the value to hold it at.")
        return given


class OptimizerFields(Fields):
    """Adam with a controlled rate, a line search, or an optimizer of optax by name, with its options."""

    expected: ClassVar = "a name or {name: adam, learning_rate: 0.1}"
    short: ClassVar = ({"enum": [*NAMES]},)
    __pydantic_extra__: dict[str, float | bool | str | dict[str, Any]]
    model_config = ConfigDict(extra="allow")
    name: str = chosen("adam", NAMES, "controlled_adam, line_search, or a function of optax")
    learning_rate: Positive | dict[str, Any] = Field(
        LEARNING_RATE, description="in coordinates u a step; or a schedule such as {cosine: {init_value: 0.1, "
                                   "decay_steps: 40}}")  # fmt: skip
    clip: Positive = optional("a longer gradient is clipped to this norm")

    @classmethod
    def written_out(cls, given: Any) -> Any:
        return {"name": given} if isinstance(given, str) else given

    @classmethod
    def refuse(cls, key: str) -> None:
        """Every other field is an option of the optimizer."""


class Exact(Fields):
    what: ClassVar = "an option of 'exact'"


class Sampled(Fields):
    what: ClassVar = "an option of an estimator with samples"
    example: ClassVar = "{samples: 8, sigma: 0.1}"
    samples: Annotated[int, Whole(2, 100_000, even=True)] = Field(description="perturbed worlds of each start")
    sigma: Positive = Field(description="standard deviation of the perturbations, in coordinates u")
    common: Annotated[str, Choice(COMMON)] = Field("none", description="for which the perturbations are the same")


class Smoothed(Sampled):
    normalized: bool = Field(False, description="whether each world's gradient counts with length 1")


class Mixture(Sampled):
    samples: Annotated[int, Whole(4, 100_000, even=True)] = Field(description="perturbed worlds of each start")
    gamma: Positive = Field(
        1.0, description="most bias accepted from the first order, in standard errors of the zeroth"
    )


class EstimatorFields(OneOf):
    """How a gradient is estimated, as written in a file."""

    alone: ClassVar = ("exact",)
    expected: ClassVar = "exact or one of smoothed, evolution, mixture as {smoothed: {samples: 8, sigma: 0.1}}"
    other: ClassVar = "is not an estimator"
    other_name: ClassVar = "is {name!r}"
    exact: Exact | None = optional("the derivative at the point itself")
    smoothed: Smoothed = optional("the mean derivative around the point")
    evolution: Sampled = optional("from differences of the objective, without derivatives")
    mixture: Mixture = optional("both, weighted by their variances")


def period_of(name: str) -> float | None:
    """The period of a parameter; None if it is not periodic."""
    return _PERIODS.get(name, _PERIODS.get(name.rpartition(".")[0]))


def read_tuned(
    doc: Document, given: Mapping[str, TunedFields | None], parameters: Mapping[str, Quantity]
) -> tuple[Tuned, ...]:
    """The parameters under `tune`, in the order of the file."""
    if not given:
        doc.fail(("tune",), "is missing or empty: expected parameters such as "
                            "{spine.amplitude: {bounds: [0, 0.4], start: 0.05}}.")  # fmt: skip
    return tuple(
        _read_parameter(doc, name, each or TunedFields.model_validate({}), parameters[name])
        for name, each in given.items()
    )


def _read_parameter(doc: Document, name: str, given: TunedFields, about: Quantity) -> Tuned:
    path: FieldPath = ("tune", name)
    if name in MEASURED.get():
        doc.fail(path, "cannot be tuned: in the history its name is a metric's.", name)
    low, high = _read_bounds(doc, name, given, about)
    if given.start is None:
        start = float(about.default)
        if not low <= start <= high:
            doc.fail(path, f"has no start, and its default {start:g} is outside of its bounds, [{low:g}, {high:g}]: "
                           "give a start.", name)  # fmt: skip
    else:
        start = given.start
        check_value(doc, (*path, "start"), name, about, start)
        if not low <= start <= high:
            doc.fail((*path, "start"), f"is {start:g}: allowed is within the bounds, [{low:g}, {high:g}].")
    return Tuned(name, low, high, start, given.periodic)


def _read_bounds(doc: Document, name: str, given: TunedFields, about: Quantity) -> tuple[float, float]:
    path: FieldPath = ("tune", name, "bounds")
    low, high = given.bounds or (about.low, about.high)
    if not math.isfinite(low) or not math.isfinite(high):
        doc.fail(path, f"is [{low:g}, {high:g}]: expected finite numbers.")
    if low >= high:
        doc.fail(path, f"is [{low:g}, {high:g}]: the lower one comes first.")
    if given.periodic:
        low, high = _whole_period(doc, (*path[:2], "periodic"), name, low, high)
    # An open bound is allowed here, because no iterate ever stands on a bound; a closed one counts with its rounding.
    for bound in (low, high):
        if not about.low - 1e-6 * abs(about.low) <= bound <= about.high + 1e-6 * abs(about.high):
            doc.fail(path, f"has the bound {bound:g}: allowed is {about.allowed()}.")
    return low, high


def _whole_period(doc: Document, path: FieldPath, name: str, low: float, high: float) -> tuple[float, float]:
    """The bounds about their middle, exactly one period apart."""
    period = period_of(name)
    if period is None:
        doc.fail(path, f"is true, but {name} does not come back to the same place; periodic are "
                       "spine.phase, start.phase, start.yaw, offset.* and limb.phase.*.")  # fmt: skip
    if abs(high - low - period) > _ROUNDING * period:
        doc.fail(path, f"is true, but the bounds [{low:g}, {high:g}] are not one period of {period:.5g} apart.")
    middle = 0.5 * (low + high)
    return middle - 0.5 * period, middle + 0.5 * period


def read_objective(doc: Document, given: Sequence[TermFields] | None) -> Objective:
    """The weighted terms under `objective`."""
    if not given:
        doc.fail(("objective",), f"is missing or empty: expected {_OBJECTIVE}.")
    terms: list[Term] = []
    for i, each in enumerate(given):
        numbers = each.model_dump(include={"at", "weight", "scale"}, exclude_unset=True)
        aim = next(aim for aim in AIMS if aim in each.model_fields_set)
        term = Term(aim, getattr(each, aim), **numbers)
        if (aim, term.metric) in [(other.aim, other.metric) for other in terms]:
            doc.fail(("objective", i), f"is '{aim}: {term.metric}' again: give it once, with a weight.")
        terms.append(term)
    return Objective(tuple(terms))


def read_recording(doc: Document, given: Any, objective: Objective, *, needed: bool = True) -> Path | None:
    """The file under `recording`, which is there if it is `needed`; its path counts from the tuning file's folder."""
    wanted = TRAJECTORY_ERROR in objective.metrics
    if given is None:
        if wanted:
            doc.fail(("objective",), f"names {TRAJECTORY_ERROR}, but there is no 'recording' to compare with: give the "
                                     "path of an NPZ.")  # fmt: skip
        return None
    if not isinstance(given, str):
        doc.fail(("recording",), f"is {describe(given)}: expected the path of an NPZ.")
    path = (Path(doc.source).parent / given if doc.lines else Path(given)).expanduser().resolve()
    if needed and not path.is_file():
        doc.fail(("recording",), f"is {given!r}: there is no file {path}.")
    if not wanted:
        doc.fail(("recording",), f"is not read: no term of the objective names {TRAJECTORY_ERROR}.")
    return path


def read_optimizer(doc: Document) -> Optimizer:
    """The optimizer, whose options are those of the file as they stand there."""
    given = doc.data.get("optimizer", CONTROLLED)
    options = {"name": "adam", **OptimizerFields.written_out(given)}
    clip = float(options.pop("clip")) if "clip" in options else None
    try:
        return Optimizer(options.pop("name"), options, clip)
    except ParameterError as error:
        subject, _, message = str(error).partition(" ")
        doc.fail(tuple(subject.split(".")), message, subject)


def read_estimator(given: EstimatorFields) -> Estimator:
    """The estimator."""
    name, options = given.chosen
    return Estimator() if name == "exact" else Estimator(name, **dict(options))
