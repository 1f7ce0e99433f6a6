"""By which method a tuning steps: along exact gradients, along differences, or by CMA-ES."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import jax.numpy as jnp
import numpy as np
from pydantic import ConfigDict, Field
from scipy.stats import qmc

from nermo_mjx.optimize.estimators import COMMON, Estimator
from nermo_mjx.optimize.objective import (
    AIMS,
    OBJECTIVE_METRICS,
    TRAJECTORY_ERROR,
    Bounds,
    Objective,
    Term,
    objective_metrics,
)
from nermo_mjx.optimize.optimizers import CONTROLLED, LEARNING_RATE, NAMES, Optimizer
from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.rollout import Metric, all_parameters
from nermo_mjx.specs.controllers import code_identity, known_names
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import Fields, JsonSchema, OneOf, Refused, chosen, optional, read
from nermo_mjx.specs.reading import Document, FieldPath, SpecError, describe, read_file
from nermo_mjx.specs.values import MEASURED, ByParameter, Choice, Finite, Numbers, Positive, Whole, check_value
from nermo_mjx.specs.walk import WalkFields, WalkSpec, check_sources, check_workspace, read_walk, written_out

#: Fraction of a parameter's bounds between a point and its neighbours: secants of this width are useful.
STEP: Final = 0.02
#: First standard deviation of CMA-ES, in coordinates u.
SIGMA: Final = 2.0
#: Fields of a tuning file that only some methods read.
_READ_BY: Final = {
    "optimizer": ("gradient", "differences"), "estimator": ("gradient",), "mode": ("gradient",),
    "starts": ("gradient", "differences"),
}  # fmt: skip


class CmaFields(Fields):
    what: ClassVar = "an option of 'cma'"
    sigma: Positive = optional("first standard deviation, in coordinates u, by default 2")
    population: Annotated[int, Whole(4, 100_000)] = optional("points of a generation, by default what fills two cores")


class DifferencesFields(Fields):
    what: ClassVar = "an option of 'differences'"
    scheme: Annotated[str, Choice(("central", "forward"))] = optional("on which sides a slope is measured")
    step: Positive = optional("to the neighbours, as a share of the bounds, by default 0.02")


class MethodFields(OneOf):
    """How an iteration finds its step, as written in a file."""

    alone: ClassVar = ("gradient", "cma", "differences")
    expected: ClassVar = "gradient, cma or differences as a name, or {name: {option: value}}"
    other: ClassVar = "is not a method"
    other_name: ClassVar = "is {name!r}"
    gradient: None = optional("exact derivatives, from MJX")
    cma: CmaFields | None = optional("CMA-ES, on MuJoCo C")
    differences: DifferencesFields | None = optional("differences between neighbours, on MuJoCo C")


@dataclasses.dataclass(frozen=True)
class Method:
    """A method by name.

    Attributes:
        name: `gradient`, `cma` or `differences`.
        sigma, population: of `cma`.
        scheme, step: of `differences`.
    """

    name: str = "gradient"
    sigma: float = SIGMA
    population: int = 16
    scheme: str = "central"
    step: float = STEP

    @property
    def engine(self) -> str:
        """Name of the engine that evaluates."""
        return "mjx" if self.name == "gradient" else "c"

    @property
    def has_gradient(self) -> bool:
        """Whether its history has gradients."""
        return self.name != "cma"

    def neighbours(self, parameters: int) -> int:
        """Runs beside that of a point itself, for differences."""
        return parameters * (2 if self.scheme == "central" else 1)

    def written(self) -> dict[str, Any]:
        """As written in a tuning file; omitted for `gradient`."""
        if self.name == "gradient":
            return {}
        names = ("sigma", "population") if self.name == "cma" else ("scheme", "step")
        return {"method": {self.name: {name: getattr(self, name) for name in names}}}


def reads(method: str, field: str) -> bool:
    """Whether a method reads a field of a tuning file."""
    return method in _READ_BY.get(field, (method,))


def read_method(doc: Document, given: MethodFields | None) -> Method:
    """The method; a field that it does not read is refused."""
    if given is None:
        return Method()
    name, options = given.chosen
    for field, readers in _READ_BY.items():
        if field in doc.data and name not in readers:
            hint = "; give method: {cma: {population: N}}" if field == "starts" else ""
            doc.fail((field,), f"is not read by the method {name}, but by {' and '.join(readers)} alone{hint}.")
    return Method(name, **({} if options is None else options.model_dump(exclude_unset=True)))


# ---
# What a tuning is: the checked content of a tuning file. All errors in it are reported here, before work begins.


# ---
# The sections of a tuning file that a sweep file does not have: tuned parameters, objective, optimizer, estimator.


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


#: How a derivative is computed: chosen by parameter count, in forward mode, or in reverse mode.
MODES: Final = ("auto", "forward", "reverse")
#: Default number of iterations that may gain almost nothing before a tuning stops.
PATIENCE: Final = 6
#: A run counted in gait cycles may not grow longer than this where the frequency is tuned [s].
LONGEST_RUN: Final = 120.0
#: Fields that do not change what an iteration computes: a tuning may be resumed with others.
FREE: Final = ("iterations", "patience", "plots", "video")
#: Fields that a tuning has as they stand in its file.
_PLAIN: Final = ("starts", "iterations", "patience", "seed", "mode", "plots", "video")


class TuningFile(WalkFields):
    """A file for `nermo-mjx tune` and `nermo-mjx landscape`."""

    model_config = ConfigDict(
        json_schema_extra={"required": ["tune", "objective"], "if": {"required": ["metrics"]},
                           "else": {"properties": {"objective": {"items": KNOWN_METRICS}}}}
    )  # fmt: skip
    what: ClassVar = "a field of a tuning"
    sources: ClassVar = "'tune' or 'set'"
    tune: Annotated[dict[str, TunedFields | None], ByParameter()] = Field({}, description="tuned parameters")
    objective: list[TermFields] = optional("terms whose sum is minimized", minItems=1)
    recording: Any = optional("path of the NPZ that trajectory_error compares with", type=["string", "null"])
    method: MethodFields = optional("how an iteration finds its step, by default along exact gradients")
    optimizer: OptimizerFields = optional("how an iteration steps")
    estimator: EstimatorFields = Field(EstimatorFields(exact=None), description="of gradients")
    starts: Annotated[int, Whole(1, 100_000)] = Field(1, description="points tuned in parallel")
    iterations: Annotated[int, Whole(1, 1_000_000)] = Field(40, description="steps")
    patience: Annotated[int, Whole(1, 1_000_000)] = Field(
        PATIENCE, description="iterations in a row that may gain almost nothing before the tuning stops"
    )
    seed: Annotated[int, Whole(0, 2**32 - 1)] = Field(0, description="of the other starts, and of perturbations")
    mode: Annotated[str, Choice(MODES)] = Field("auto", description="how a derivative is computed")
    plots: bool = Field(True, description="whether figures are made at the end")
    video: bool = Field(False, description="whether a video of the best is made at the end")

    @classmethod
    def refuse(cls, key: str) -> None:
        if key in ("vary", "randomize", "sample"):
            raise Refused("is a field of a sweep, not of a tuning: what is to change stands under 'tune'.", key)
        super().refuse(key)


@dataclasses.dataclass(frozen=True)
class Tuning(WalkSpec, Described):
    """A checked tuning of p parameters. Build it with `from_file`, `from_text` or `from_dict`.

    Attributes:
        setup, run, fixed, pilot: see `WalkSpec`.
        tuned: the tuned parameters in the order of the file.
        objective: what is minimized.
        recording: what `trajectory_error` compares with.
        method: by gradient, by differences, or by CMA-ES, whose generations replace the starts.
        optimizer, estimator: how an iteration steps, and from which gradient.
        starts: points that are tuned in parallel in one batch; the first is the given one, the others are drawn.
        iterations: steps; there is one more evaluation, of the point reached by the last step.
        patience: iterations that may gain next to nothing before it stops, see `nermo_mjx.optimize.history`.
        seed: of the other starts, and of the estimator's perturbations.
        mode: how derivatives are taken: `auto`, `forward` or `reverse`.
        plots, video: whether figures, and a video of the best, are made in the end.
    """

    kind: ClassVar = "tuning"
    tuned: tuple[Tuned, ...]
    objective: Objective
    recording: Path | None = None
    optimizer: Optimizer = dataclasses.field(default_factory=Optimizer)
    estimator: Estimator = dataclasses.field(default_factory=Estimator)
    starts: int = 1
    iterations: int = 40
    patience: int = PATIENCE
    seed: int = 0
    mode: str = "auto"
    plots: bool = True
    video: bool = False
    method: Method = dataclasses.field(default_factory=Method)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], *, recorded: bool = True) -> Tuning:
        """Read a YAML tuning file; raises `SpecError`. Without `recorded`, its recording may be gone."""
        return _read(read_file(path, cls.kind), recorded=recorded)

    @classmethod
    def of_document(cls, doc: Document) -> Tuning:
        return _read(doc)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the p tuned parameters; numbers of a point come in this order."""
        return tuple(each.name for each in self.tuned)

    @property
    def objective_metrics(self) -> dict[str, Metric]:
        """What a term may name, by name."""
        return objective_metrics(self.metrics)

    @property
    def bounds(self) -> Bounds:
        """Bounds of the tuned parameters, as arrays (p,)."""
        low, high = (jnp.array([getattr(each, end) for each in self.tuned], float) for end in ("low", "high"))
        return Bounds(low, high, jnp.array([each.periodic for each in self.tuned]))

    def start_points(self) -> np.ndarray:
        """Where each start begins (starts, p): the given point, then Sobol points within the bounds."""
        given = np.array([[each.start for each in self.tuned]])
        exponent = max(self.starts - 2, 0).bit_length()  # a power of two keeps the sequence balanced
        sobol = qmc.Sobol(len(self.tuned), rng=np.random.default_rng(self.seed))
        shares = sobol.random_base2(exponent)[: self.starts - 1]
        low, high = (np.array([getattr(each, end) for each in self.tuned]) for end in ("low", "high"))
        return np.concatenate([given, low + (high - low) * shares])

    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        data = self.walk_fields(folder)
        data["tune"] = {each.name: each.written() for each in self.tuned}
        data["objective"] = [term.written() for term in self.objective.terms]
        if self.recording is not None:
            data["recording"] = self.recording.name if self.recording.parent == folder else str(self.recording)
        data |= self.method.written()
        data["optimizer"] = self.optimizer.written()
        data["estimator"] = self.estimator.written()
        data |= {name: getattr(self, name) for name in _PLAIN}
        return {name: value for name, value in data.items() if reads(self.method.name, name)}

    def decisive(self) -> dict[str, Any]:
        """The fields that may not change: a recording counts beside them, a controller by what it is."""
        data = {key: value for key, value in self.resolved().items() if key not in (*FREE, "recording")}
        return data | code_identity(self.setup)

    def identity(self) -> dict[str, Any]:
        """All that decides an iteration: the `fields`, `defaults` of what they do not name, the `recording`'s digest.

        The number of iterations, figures and video do not count: a tuning can be extended.

        Raises:
            SpecError: the recording cannot be read.
        """
        try:
            recorded = b"" if self.recording is None else self.recording.read_bytes()
        except OSError as error:
            raise SpecError(f"recording is {self.recording}: cannot be read ({error.strerror or error}).") from None
        return {
            "fields": self.decisive(),
            "defaults": {name: about.default for name, about in self.parameters.items()},
            "recording": "" if self.recording is None else hashlib.sha256(recorded).hexdigest(),
        }

    def digest(self) -> str:
        """A hash of the `identity`."""
        return digest_of(*self.identity().values())


def _read(doc: Document, *, recorded: bool = True) -> Tuning:
    with known_names(doc):
        doc = written_out(doc)
        file = read(doc, TuningFile)
    walk = read_walk(doc, file)
    if "distance" in walk["pilot"]:
        doc.fail(("pilot", "straight", "distance"), "ends each run at a distance: such a length jumps by whole cycles "
                 "and has no derivative; give run: {cycles: 8}.")  # fmt: skip
    objective = read_objective(doc, file.objective)
    method = read_method(doc, file.method)
    tuning = Tuning(
        **walk,
        tuned=read_tuned(doc, file.tune, all_parameters(walk["setup"])),
        objective=objective,
        recording=read_recording(doc, file.recording, objective, needed=recorded),
        optimizer=read_optimizer(doc),
        estimator=read_estimator(file.estimator),
        method=method,
        **{name: getattr(file, name) for name in _PLAIN},
    )
    if method.name == "cma":
        tuning = dataclasses.replace(tuning, starts=method.population)
    _check_together(doc, tuning)
    return tuning


def _check_together(doc: Document, tuning: Tuning) -> None:
    """Checks of several fields: a parameter with two sources or without effect, a run too long, a leg too short."""
    check_sources(doc, tuning, {"tune": list(tuning.names)})
    _check_length(doc, tuning)
    ranges = {each.name: np.linspace(each.low, each.high, 5) for each in tuning.tuned}
    check_workspace(doc, tuning.setup, tuning.fixed, {"tune": ranges})


def _check_length(doc: Document, tuning: Tuning) -> None:
    """A run of a given number of cycles lasts longer at a lower frequency."""
    low = {each.name: each.low for each in tuning.tuned}.get("frequency")
    if low is None or "frequency" not in tuning.setup.timing or tuning.run.duration is not None:
        return
    cycles = float(tuning.run.cycles)  # type: ignore[arg-type]
    if cycles > LONGEST_RUN * low:
        lasts = f"would last {cycles / low:g} s" if low > 0 else "would never end"
        doc.fail(("tune", "frequency", "bounds"), f"begins at {low:g} Hz, where {cycles:g} cycles {lasts}: allowed is "
                 f"{cycles / LONGEST_RUN:.3g} Hz or more, or give run: {{duration: seconds}}.")  # fmt: skip
