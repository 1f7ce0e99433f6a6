"""What a tuning is: the checked content of a tuning file. All errors in it are reported here, before work begins."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import jax.numpy as jnp
import numpy as np
from pydantic import ConfigDict, Field
from scipy.stats import qmc

from nermo_mjx.optimize.estimators import ESTIMATORS, Estimator, Exact
from nermo_mjx.optimize.objective import (
    AIMS,
    OBJECTIVE_METRICS,
    TRAJECTORY_ERROR,
    Bounds,
    Objective,
    Term,
    objective_metrics,
    read_objective,
)
from nermo_mjx.optimize.optimizers import CONTROLLED, LEARNING_RATE, NAMES, Optimizer
from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.rollout import Metric, all_parameters
from nermo_mjx.rollout.run import too_many
from nermo_mjx.specs.controllers import code_identity, known_names
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import Fields, Refused, chosen, optional, read
from nermo_mjx.specs.model import Spec, named, one_of, written
from nermo_mjx.specs.reading import Document, FieldPath, SpecError, describe, dump, read_file
from nermo_mjx.specs.values import ByParameter, Choice, Ends, Positive, Whole, check_value
from nermo_mjx.specs.walk import WalkFields, WalkSpec, check_sources, check_workspace, read_walk, written_out

# ---
# By which method a tuning steps: along exact gradients, along differences, or by CMA-ES.


class Method(Spec):
    """How an iteration finds its step.

    Attributes:
        name: in a tuning file.
        engine: name of the engine that evaluates.
        has_gradient: whether its history has gradients.
        unread: fields of a tuning file that it does not read.
    """

    name: ClassVar[str]
    engine: ClassVar[str] = "c"
    has_gradient: ClassVar[bool] = True
    unread: ClassVar[tuple[str, ...]] = ()


@dataclasses.dataclass(frozen=True)
class Gradient(Method):
    """Exact derivatives, from MJX."""

    name = "gradient"
    engine = "mjx"
    what = "an option of 'gradient'"


@dataclasses.dataclass(frozen=True)
class Generations(Method):
    """CMA-ES, on MuJoCo C."""

    name = "cma"
    has_gradient = False
    unread = ("optimizer", "estimator", "mode", "starts")
    what = "an option of 'cma'"
    sigma: Positive = 2.0
    """first standard deviation, in coordinates u"""
    population: Annotated[int, Whole(4, 100_000)] = 16
    """points of a generation, which replace the starts; 16 fill two cores"""


@dataclasses.dataclass(frozen=True)
class Differences(Method):
    """Differences between neighbours, on MuJoCo C."""

    name = "differences"
    unread = ("estimator", "mode")
    what = "an option of 'differences'"
    scheme: Annotated[str, Choice(("central", "forward"))] = "central"
    """on which sides a slope is measured"""
    step: Positive = 0.02
    """to the neighbours, as a share of the bounds: secants of this width are useful"""

    def neighbours(self, parameters: int) -> int:
        """Runs beside that of a point itself."""
        return parameters * (2 if self.scheme == "central" else 1)


#: Methods by their names in files.
METHODS: Final[Mapping[str, type[Method]]] = {each.name: each for each in (Gradient, Generations, Differences)}

# ---
# The other sections of a tuning file that a sweep file does not have: tuned parameters, objective, optimizer.


#: Periodic parameters and their periods.
_PERIODS: Final = {
    "spine.phase": 2 * math.pi,
    "start.yaw": 2 * math.pi,
    "start.phase": 1.0,
    "offset": 1.0,
    "limb.phase": 1.0,
}


def period_of(name: str) -> float | None:
    """The period of a parameter; None if it is not periodic."""
    return _PERIODS.get(name, _PERIODS.get(name.rpartition(".")[0]))


def is_turn(name: str, low: float, high: float) -> bool:
    """Whether bounds of a parameter are one whole period apart, up to their rounding: 3.14 is meant as pi."""
    period = period_of(name)
    return period is not None and abs(high - low - period) <= 1e-3 * period


@dataclasses.dataclass(frozen=True)
class Tuned(Spec):
    """One tuned parameter, in its own unit; `low` and `high` of a periodic one are exactly one period apart."""

    what = "a field of a tuned parameter"
    expected = "{bounds: [low, high], start: number}, both optional"
    elsewhere = ("name",)
    bounds: Ends = None  # type: ignore[assignment]  # none cannot be written in a file
    """by default its range"""
    start: float = None  # type: ignore[assignment]
    """value of the first start, by default the parameter's"""
    periodic: bool = False
    """whether it wraps around from one bound to the other"""
    name: str = ""

    @property
    def low(self) -> float:
        """The lower bound."""
        return self.bounds[0]

    @property
    def high(self) -> float:
        """The upper bound."""
        return self.bounds[1]

    def of(self, doc: Document, name: str, about: Quantity) -> Tuned:
        """The parameter of that name, with what a file leaves out; raises `SpecError`."""
        path: FieldPath = ("tune", name)
        low, high = self.bounds or (about.low, about.high)
        if not math.isfinite(low) or not math.isfinite(high):
            doc.fail((*path, "bounds"), f"is [{low:g}, {high:g}]: expected finite numbers.")
        if low >= high:
            doc.fail((*path, "bounds"), f"is [{low:g}, {high:g}]: the lower one comes first.")
        if self.periodic:
            period = period_of(name)
            if period is None:
                doc.fail(
                    (*path, "periodic"),
                    f"is true, but {name} does not come back to the same place; periodic are spine.phase, start.phase, "
                    "start.yaw, offset.* and limb.phase.*.",
                )
            if not is_turn(name, low, high):
                apart = f"the bounds [{low:g}, {high:g}] are not one period of {period:.5g} apart."
                doc.fail((*path, "periodic"), f"is true, but {apart}")
            middle = 0.5 * (low + high)
            low, high = middle - 0.5 * period, middle + 0.5 * period
        # An open bound is allowed: no iterate ever stands on a bound; a closed one counts with its rounding.
        for bound in (low, high):
            if not about.low - 1e-6 * abs(about.low) <= bound <= about.high + 1e-6 * abs(about.high):
                doc.fail((*path, "bounds"), f"has the bound {bound:g}: allowed is {about.allowed()}.")
        start = float(about.default) if self.start is None else self.start
        if self.start is not None:
            check_value(doc, (*path, "start"), name, about, start)
        if not low <= start <= high:
            bounds = f"[{low:g}, {high:g}]"
            if self.start is not None:
                doc.fail((*path, "start"), f"is {start:g}: allowed is within the bounds, {bounds}.")
            doc.fail(
                path, f"has no start, and its default {start:g} is outside of its bounds, {bounds}: give a start.", name
            )
        return dataclasses.replace(self, name=name, bounds=(low, high), start=start)


class OptimizerFields(Fields):
    """Adam with a controlled rate, a line search, or an optimizer of optax by name, with its options."""

    expected: ClassVar = "a name or {name: adam, learning_rate: 0.1}"
    short: ClassVar = ({"enum": [*NAMES]},)
    __pydantic_extra__: dict[str, float | bool | str | dict[str, Any]]
    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)
    name: str = chosen("adam", NAMES, "controlled_adam, line_search, or a function of optax")
    learning_rate: Positive | dict[str, Any] = LEARNING_RATE
    """in coordinates u a step; or a schedule such as {cosine: {init_value: 0.1, decay_steps: 40}}"""
    clip: Positive = optional("a longer gradient is clipped to this norm")

    @classmethod
    def written_out(cls, given: Any) -> Any:
        return {"name": given} if isinstance(given, str) else given

    @classmethod
    def refuse(cls, key: str) -> None:
        """Every other field is an option of the optimizer."""

    @classmethod
    def optimizer(cls, doc: Document) -> Optimizer:
        """The optimizer of a file, whose options are as they stand there."""
        options = {"name": "adam", **cls.written_out(doc.data.get("optimizer", CONTROLLED))}
        clip = float(options.pop("clip")) if "clip" in options else None
        try:
            return Optimizer(options.pop("name"), options, clip)
        except ParameterError as error:
            subject, _, message = str(error).partition(" ")
            doc.fail(tuple(subject.split(".")), message, subject)


def _read_recording(doc: Document, given: Any, objective: Objective, *, needed: bool) -> Path | None:
    """The file under `recording`, which is there if it is `needed`; its path counts from the tuning file's folder."""
    wanted = TRAJECTORY_ERROR in objective.metrics
    if given is None:
        if wanted:
            missing = f"names {TRAJECTORY_ERROR}, but there is no 'recording' to compare with: give the path of an NPZ."
            doc.fail(("objective",), missing)
        return None
    if not isinstance(given, str):
        doc.fail(("recording",), f"is {describe(given)}: expected the path of an NPZ.")
    path = (Path(doc.source).parent / given if doc.lines else Path(given)).expanduser().resolve()
    if needed and not path.is_file():
        doc.fail(("recording",), f"is {given!r}: there is no file {path}.")
    if not wanted:
        doc.fail(("recording",), f"is not read: no term of the objective names {TRAJECTORY_ERROR}.")
    return path


#: How a derivative is computed: chosen by parameter count, in forward mode, or in reverse mode.
MODES: Final = ("auto", "forward", "reverse")
#: A run counted in gait cycles may not grow longer than this where the frequency is tuned [s].
LONGEST_RUN: Final = 120.0
#: Fields that do not change what an iteration computes: a tuning may be resumed with others.
FREE: Final = ("iterations", "patience", "plots", "video")
#: Fields that a tuning has as they stand in its file.
_PLAIN: Final = ("starts", "iterations", "patience", "seed", "mode", "plots", "video")
_KNOWN_METRICS: Final[Any] = {"properties": {aim: {"enum": [*OBJECTIVE_METRICS]} for aim in AIMS}}


class TuningFile(WalkFields):
    """A file for `nermo-mjx tune` and `nermo-mjx landscape`."""

    model_config = ConfigDict(
        use_attribute_docstrings=True,
        json_schema_extra={
            "required": ["tune", "objective"],
            "if": {"required": ["metrics"]},
            "else": {"properties": {"objective": {"items": _KNOWN_METRICS}}},
        },
    )
    what: ClassVar = "a field of a tuning"
    sources: ClassVar = "'tune' or 'set'"
    tune: Annotated[dict[str, Tuned | None], ByParameter()] = Field({})
    """tuned parameters"""
    objective: list[Term] = optional("terms whose sum is minimized", minItems=1)
    recording: Any = optional("path of the NPZ that trajectory_error compares with", type=["string", "null"])
    method: Annotated[Method, one_of("TuningMethod", "is not a method", METHODS)] = Field(default_factory=Gradient)
    """how an iteration finds its step: along exact or measured gradients, or by CMA-ES, whose generations replace the
    starts"""
    optimizer: OptimizerFields = optional("how an iteration steps")
    estimator: Annotated[Estimator, one_of("Estimator", "is not an estimator", ESTIMATORS)] = Field(
        default_factory=Exact
    )
    """of gradients"""
    starts: Annotated[int, Whole(1, 100_000)] = 1
    """points that are tuned in parallel in one batch; the first is the given one, the others are drawn"""
    iterations: Annotated[int, Whole(1, 1_000_000)] = 40
    """steps; there is one more evaluation, of the point reached by the last step"""
    patience: Annotated[int, Whole(1, 1_000_000)] = 6
    """iterations in a row that may gain almost nothing before the tuning stops"""
    seed: Annotated[int, Whole(0, 2**32 - 1)] = 0
    """of the other starts, and of perturbations"""
    mode: Annotated[str, Choice(MODES)] = "auto"
    """how a derivative is computed"""
    plots: bool = True
    """whether figures are made at the end"""
    video: bool = False
    """whether a video of the best is made at the end"""

    @classmethod
    def refuse(cls, key: str) -> None:
        if key in ("vary", "randomize", "sample"):
            raise Refused("is a field of a sweep, not of a tuning: what is to change stands under 'tune'.", key)
        super().refuse(key)


@dataclasses.dataclass(frozen=True)
class Tuning(WalkSpec, Described):
    """A checked tuning of p parameters. Build it with `from_file`, `from_text` or `from_dict`.

    The fields from `tuned` on are those of `TuningFile`, which documents them; `tuned` are the parameters under `tune`
    in the order of the file.
    """

    kind: ClassVar = "tuning"
    tuned: tuple[Tuned, ...]
    objective: Objective
    recording: Path | None = None
    optimizer: Optimizer = dataclasses.field(default_factory=Optimizer)
    estimator: Estimator = dataclasses.field(default_factory=Exact)
    starts: int = 1
    iterations: int = 40
    patience: int = 6
    seed: int = 0
    mode: str = "auto"
    plots: bool = True
    video: bool = False
    method: Method = dataclasses.field(default_factory=Gradient)

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

    def seconds(self, values: Mapping[str, float]) -> float:
        """How long a run with these parameters lasts [s]."""
        timing = {name: value for name, value in (self.constants | dict(values)).items() if name in self.setup.timing}
        return float(self.run.seconds(self.setup.cycle_rate(timing))[1])

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
        data["tune"] = {each.name: _without_false(each) for each in self.tuned}
        data["objective"] = [written(term) for term in self.objective.terms]
        if self.recording is not None:
            data["recording"] = self.recording.name if self.recording.parent == folder else str(self.recording)
        if not isinstance(self.method, Gradient):
            data["method"] = named(self.method, METHODS)
        data["optimizer"] = self.optimizer.written()
        exact = isinstance(self.estimator, Exact)
        data["estimator"] = "exact" if exact else {self.estimator.name: _without_false(self.estimator)}
        data |= {name: getattr(self, name) for name in _PLAIN}
        return {name: value for name, value in data.items() if name not in self.method.unread}

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

    def without_path(self) -> Tuning:
        """As far as it decides the objective at a point: without optimizer, estimator, starts and seed."""
        return dataclasses.replace(self, optimizer=Optimizer("adam"), estimator=Exact(), starts=1, seed=0)

    def digest(self) -> str:
        """A hash of the `identity`."""
        return digest_of(*self.identity().values())


def _without_false(spec: Spec) -> dict[str, Any]:
    return {name: value for name, value in written(spec).items() if value is not False}


def _read(doc: Document, *, recorded: bool = True) -> Tuning:
    with known_names(doc):
        doc = written_out(doc)
        file = read(doc, TuningFile)
    walk = read_walk(doc, file)
    if "distance" in walk["pilot"]:
        doc.fail(
            ("pilot", "straight", "distance"),
            "ends each run at a distance: such a length jumps by whole cycles and has no derivative; give run: "
            "{cycles: 8}.",
        )
    objective, method = read_objective(doc, file.objective), file.method
    for field in method.unread:
        if field in doc.data:
            readers = " and ".join(name for name, other in METHODS.items() if field not in other.unread)
            hint = "; give method: {cma: {population: N}}" if field == "starts" else ""
            doc.fail((field,), f"is not read by the method {method.name}, but by {readers} alone{hint}.")
    if not file.tune:
        example = "{spine.amplitude: {bounds: [0, 0.4], start: 0.05}}"
        doc.fail(("tune",), f"is missing or empty: expected parameters such as {example}.")
    parameters = all_parameters(walk["setup"])
    tuning = Tuning(
        **walk,
        tuned=tuple((each or Tuned()).of(doc, name, parameters[name]) for name, each in file.tune.items()),
        objective=objective,
        recording=_read_recording(doc, file.recording, objective, needed=recorded),
        optimizer=OptimizerFields.optimizer(doc),
        estimator=file.estimator,
        method=method,
        **{name: getattr(file, name) for name in _PLAIN},
    )
    if isinstance(method, Generations):
        tuning = dataclasses.replace(tuning, starts=method.population)
    if wrong := too_many(tuning.starts * max(tuning.estimator.samples, 1)):
        doc.fail(("starts",), f"is {tuning.starts:,}, each with its samples: {wrong}")
    check_sources(doc, tuning, {"tune": list(tuning.names)})
    low = {each.name: each.low for each in tuning.tuned}.get("frequency")
    if low is not None and "frequency" in tuning.setup.timing and tuning.run.duration is None:
        # A run of a given number of cycles lasts longer at a lower frequency.
        cycles = float(tuning.run.cycles)  # type: ignore[arg-type]
        if cycles > LONGEST_RUN * low:
            lasts = f"would last {cycles / low:g} s" if low > 0 else "would never end"
            doc.fail(
                ("tune", "frequency", "bounds"),
                f"begins at {low:g} Hz, where {cycles:g} cycles {lasts}: allowed is {cycles / LONGEST_RUN:.3g} Hz or "
                "more, or give run: {duration: seconds}.",
            )
    ranges = {each.name: np.linspace(each.low, each.high, 5) for each in tuning.tuned}
    check_workspace(doc, tuning.setup, tuning.fixed, {"tune": ranges})
    return tuning


#: Runs of the sweep that starts from a best point: from slightly different starts, to show whether it is fragile.
REPEATS: Final = 3


def sweep_of(walk: WalkSpec, head: str, values: Mapping[str, float], seed: int, folder: Path | None = None) -> str:
    """A sweep file of a found point: setup, run and `set`, run a few times from slightly different starts.

    Args:
        walk: what was tuned or searched.
        head: a line about the point.
        values: its parameters.
        seed: of the starts.
        folder: where the file is to stand, see `walk_fields`.
    """
    data = walk.walk_fields(folder) | {"set": {**walk.fixed, **values}, "randomize": {"repeats": REPEATS}}
    return f"# {head}\n" + dump({**data, "seed": seed, "plots": False})
