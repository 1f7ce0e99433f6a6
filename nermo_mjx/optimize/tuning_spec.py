"""The checked content of a tuning file. Errors are reported before the tuning starts."""

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
from pydantic import BeforeValidator, ConfigDict, Field
from scipy.stats import qmc

from nermo_mjx.files import MAX_FILE_BYTES, read_bytes
from nermo_mjx.lazy import warn_former
from nermo_mjx.optimize.objective import (
    AIMS,
    OBJECTIVE_METRICS,
    TRAJECTORY_ERROR,
    Bounds,
    Objective,
    ObjectiveTerm,
    objective_metrics,
    read_objective,
)
from nermo_mjx.optimize.optimizers import CONTROLLED, LEARNING_RATE, OPTIMIZER_NAMES, Optimizer
from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.rollout import Metric, all_parameters
from nermo_mjx.rollout.differentiable import MJX_GRADIENT, engine_for
from nermo_mjx.rollout.run import Run, too_many
from nermo_mjx.specs.controllers import code_identity, known_names
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import Fields, Refused, optional, read
from nermo_mjx.specs.model import Spec, named_section, one_of, written
from nermo_mjx.specs.reading import Document, FieldPath, SpecError, describe, read_file
from nermo_mjx.specs.values import (
    QUANTITY_SCHEMA,
    ByParameter,
    Choice,
    Ends,
    Positive,
    Whole,
    check_value,
)
from nermo_mjx.specs.walk import (
    WalkFields,
    WalkSpec,
    check_reach,
    check_sources,
    read_walk,
    with_body,
    written_out,
)

# ---
# The methods of a tuning, with their options.


class TuningMethod(Spec):
    """The method by which an iteration of a tuning finds its step.

    Attributes:
        name: Name in a file.
    """

    name: ClassVar[str]

    def gradient_cost(self, parameters: int) -> float:
        """Cost of the value and gradient with respect to so many parameters, in runs."""
        return 1.0

    def engine_for(self, parameters: int) -> str:
        """Name of the engine that evaluates."""
        return "c"


@dataclasses.dataclass(frozen=True)
class Gradient(TuningMethod):
    """The derivative at the point: on a CPU by narrow central differences in MuJoCo C, on MJX by reverse mode."""

    name, what = "local_gradient", "an option of 'local_gradient'"

    def gradient_cost(self, parameters: int) -> float:
        return 1.0 + 2.0 * parameters if self.engine_for(parameters) == "c" else MJX_GRADIENT

    def engine_for(self, parameters: int) -> str:
        return engine_for(parameters)


@dataclasses.dataclass(frozen=True)
class Differences(TuningMethod):
    """Differences between the point and neighbours at a distance of about an optimizer's step, in MuJoCo C."""

    name, what = "wide_differences", "an option of 'wide_differences'"
    scheme: Annotated[str, Choice(("central", "forward"))] = "central"
    """on which sides a slope is measured"""
    step: Positive = 0.02
    """distance to the neighbours, as a fraction of the bounds"""

    def gradient_cost(self, parameters: int) -> float:
        return 1.0 + parameters * (2 if self.scheme == "central" else 1)


#: Methods by their names in files.
TUNING_METHODS: Final[Mapping[str, type[TuningMethod]]] = {
    m.name: m for m in (Gradient, Differences)
}
#: Former names of methods, which files may contain; the identity of a tuning in its directory contains them, too.
FORMER_METHODS: Final = {"gradient": "local_gradient", "differences": "wide_differences"}
#: Numbers of parameters up to which a local gradient is as good as a secant, and up to which a secant is about as good as
#: CMA-ES; 2, 16 and 64 parameters have been measured (docs/benchmarks/rematch.md).
MOST_EXACT, MOST_SECANTS = 8, 32


def default_method(parameters: int) -> TuningMethod | None:
    """The default method for so many parameters; None if the file must contain the method."""
    if parameters > MOST_SECANTS:
        return None
    return Gradient() if parameters <= MOST_EXACT else Differences(scheme="forward")


# ---
# A tuning file: tuned parameters, objective, optimizer.


#: Names or prefixes of the names of periodic parameters, and their periods.
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
    """Whether bounds of a parameter are one period apart, up to their rounding; 3.14 means pi, for example."""
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
    start: Annotated[float, Field(json_schema_extra=QUANTITY_SCHEMA)] = None  # type: ignore[assignment]
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

    def of(self, doc: Document, name: str, declaration: Quantity) -> Tuned:
        """The parameter of that name with the defaults of missing fields; raises `SpecError`."""
        path: FieldPath = ("tune", name)
        low, high = self.bounds or (declaration.low, declaration.high)
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
                message = (
                    f"the bounds [{low:g}, {high:g}] are not one period of {period:.5g} apart."
                )
                doc.fail((*path, "periodic"), f"is true, but {message}")
            middle = 0.5 * (low + high)
            low, high = middle - 0.5 * period, middle + 0.5 * period
        # An open bound is allowed, because points never reach a bound; a closed bound is compared after rounding.
        for bound in (low, high):
            if (
                not declaration.low - 1e-6 * abs(declaration.low)
                <= bound
                <= declaration.high + 1e-6 * abs(declaration.high)
            ):
                doc.fail(
                    (*path, "bounds"),
                    f"has the bound {bound:g}: allowed is {declaration.allowed()}.",
                )
        start = float(declaration.default) if self.start is None else self.start
        bounds = f"[{low:g}, {high:g}]"
        if self.start is not None:
            check_value(doc, (*path, "start"), name, declaration, start)
            if not low <= start <= high:
                doc.fail((*path, "start"), f"is {start:g}: allowed is within the bounds, {bounds}.")
        elif not low <= start <= high:
            lacks = f"has no start, and its default {start:g} is outside of its bounds, {bounds}: give a start."
            doc.fail(path, lacks, name)
        return dataclasses.replace(self, name=name, bounds=(low, high), start=start)


class OptimizerFields(Fields):
    """Adam with a controlled rate, or an optimizer of optax by name, with its options."""

    expected: ClassVar = "a name or {name: adam, learning_rate: 0.1}"
    short: ClassVar = ({"enum": [*OPTIMIZER_NAMES]},)
    __pydantic_extra__: dict[str, float | bool | str | dict[str, Any]]
    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)
    name: str = Field(
        default="adam",
        description="controlled_adam, or a function of optax",
        json_schema_extra={"enum": [*OPTIMIZER_NAMES]},
    )
    learning_rate: Positive | dict[str, Any] = LEARNING_RATE
    """in coordinates u a step; or a schedule such as {cosine: {init_value: 0.1, decay_steps: 40}}"""
    clip: Positive = optional("a longer gradient is clipped to this norm")

    @classmethod
    def written_out(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @classmethod
    def refuse(cls, key: str) -> None:
        """Every other field is an option of the optimizer."""

    @classmethod
    def optimizer(cls, doc: Document) -> Optimizer:
        """The optimizer with the options of a file."""
        options = {"name": "adam", **cls.written_out(doc.data.get("optimizer", CONTROLLED))}
        clip = float(options.pop("clip")) if "clip" in options else None
        try:
            return Optimizer(options.pop("name"), options, clip)
        except ParameterError as error:
            subject, _, message = str(error).partition(" ")
            doc.fail(tuple(subject.split(".")), message, subject)


#: Longest duration of a run with a number of gait cycles, if the frequency is tuned [s].
LONGEST_RUN: Final = 120.0
#: Advice in place of CMA-ES in a tuning.
_SEARCH: Final = "run nermo-mjx search with method: cma"
#: Fields that do not change the iterations, so that a tuning can be resumed with other values.
_FREE_OF_TUNING: Final = ("iterations", "patience", "plots")
#: Fields that a tuning has in the same form as its file.
_PLAIN: Final = ("starts", "iterations", "patience", "seed", "plots")
_KNOWN_METRICS: Final[Any] = {"properties": {aim: {"enum": [*OBJECTIVE_METRICS]} for aim in AIMS}}


def _present_method(value: Any) -> Any:
    """The method of a file with its present name."""
    if isinstance(value, dict):
        return {_present_method(name): options for name, options in value.items()}
    if present := FORMER_METHODS.get(str(value)):
        warn_former(f"method: {value}", f"method: {present}", FutureWarning)
    return present or value


class TuningFile(WalkFields):
    """A file for `nermo-mjx tune`."""

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
    objective: list[ObjectiveTerm] = optional("terms whose sum is minimized", minItems=1)
    recording: Any = optional(
        "path of the NPZ that trajectory_error compares with", type=["string", "null"]
    )
    method: Annotated[
        TuningMethod,
        one_of(
            "TuningMethod",
            "is not a method",
            TUNING_METHODS,
            {"cma": f"which was removed: {_SEARCH}"},
        ),
        BeforeValidator(_present_method),
    ] = optional(
        "how an iteration finds its step: along local gradients or wide differences; the default depends on the number "
        "of parameters"
    )
    optimizer: OptimizerFields = optional("how an iteration steps")
    starts: Annotated[int, Whole(1, 100_000)] = 1
    """points that are tuned in parallel in one batch; the first is the given one, the others are drawn"""
    iterations: Annotated[int, Whole(1, 1_000_000)] = 40
    """steps; there is one more evaluation, of the point reached by the last step"""
    patience: Annotated[int, Whole(1, 1_000_000)] = 6
    """iterations in a row that may gain almost nothing before the tuning stops"""
    seed: Annotated[int, Whole(0, 2**32 - 1)] = 0
    """of the other starts"""
    plots: bool = True
    """whether figures are made at the end"""

    @classmethod
    def written_out(cls, value: Any) -> Any:
        """Remove `video: false`, which the directories of earlier releases contain."""
        data = super().written_out(value)
        return (
            {key: data[key] for key in data if key != "video" or data[key]}
            if isinstance(data, dict)
            else data
        )

    @classmethod
    def refuse(cls, key: str) -> None:
        if key == "video":
            replay = "nermo-mjx replay RUNS --row 0 --video FILE.mp4"
            raise Refused(
                f"was removed: run nermo-mjx sweep DIR/tuned.yaml --out RUNS, and {replay}.", key
            )
        if key in ("vary", "randomize", "sample"):
            raise Refused(
                "is a field of a sweep, not of a tuning: what is to change stands under 'tune'.",
                key,
            )
        super().refuse(key)


@dataclasses.dataclass(frozen=True)
class Tuning(WalkSpec, Described):
    """A checked tuning of p parameters. Build it with `from_file`, `from_text` or `from_dict`.

    `TuningFile` documents the fields from `tuned` on; `tuned` contains the parameters under `tune` in the order of the
    file.
    """

    kind: ClassVar = "tuning"
    tuned: tuple[Tuned, ...]
    objective: Objective
    recording: Path | None
    optimizer: Optimizer
    starts: int
    iterations: int
    patience: int
    seed: int
    plots: bool
    method: TuningMethod

    @classmethod
    def from_file(
        cls, path: str | os.PathLike[str], body: str | None = None, *, recorded: bool = True
    ) -> Tuning:
        """See `Described.from_file`. Without `recorded`, the file of the recording may be missing."""
        return _read_tuning(with_body(read_file(path, cls.kind), body), recorded=recorded)

    @classmethod
    def of_document(cls, doc: Document) -> Tuning:
        return _read_tuning(doc)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the p tuned parameters, in the order of a point's numbers."""
        return tuple(parameter.name for parameter in self.tuned)

    @property
    def objective_metrics(self) -> dict[str, Metric]:
        """The metrics that are allowed in a term, by name."""
        return objective_metrics(self.metrics)

    @property
    def bounds(self) -> Bounds:
        """Bounds of the tuned parameters, as arrays (p,)."""
        low, high = (
            jnp.array([getattr(parameter, end) for parameter in self.tuned], float)
            for end in ("low", "high")
        )
        return Bounds(low, high, jnp.array([parameter.periodic for parameter in self.tuned]))

    @property
    def engine(self) -> str:
        """Name of the engine that evaluates."""
        return self.method.engine_for(len(self.names))

    def seconds(self, values: Mapping[str, float]) -> float:
        """Duration of a run with these parameters [s]."""
        timing = {
            name: value
            for name, value in (self.constants | dict(values)).items()
            if name in self.setup.timing
        }
        return float(self.run.seconds(self.setup.cycle_rate(timing))[1])

    def start_points(self) -> np.ndarray:
        """The initial point of each start (starts, p): the given point, then Sobol points within the bounds."""
        first_points = np.array([[parameter.start for parameter in self.tuned]])
        exponent = max(
            self.starts - 2, 0
        ).bit_length()  # a power of two keeps the sequence balanced
        sobol = qmc.Sobol(len(self.tuned), rng=np.random.default_rng(self.seed))
        shares = sobol.random_base2(exponent)[: self.starts - 1]
        low, high = (
            np.array([getattr(parameter, end) for parameter in self.tuned])
            for end in ("low", "high")
        )
        return np.concatenate([first_points, low + (high - low) * shares])

    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        data = self.walk_fields(folder)
        data["tune"] = {parameter.name: _without_false(parameter) for parameter in self.tuned}
        data["objective"] = [written(term) for term in self.objective.terms]
        if self.recording is not None:
            data["recording"] = (
                self.recording.name if self.recording.parent == folder else str(self.recording)
            )
        if self.method != default_method(len(self.tuned)):
            data["method"] = named_section(self.method, TUNING_METHODS)
        data["optimizer"] = self.optimizer.written()
        data |= {name: getattr(self, name) for name in _PLAIN}
        return data

    def decisive(self) -> dict[str, Any]:
        """The fields that a resumed tuning may not change; a controller is identified by its content.

        A method has its former name here, so that the directory of an older version contains the same tuning.
        """
        data = {
            key: value
            for key, value in self.resolved().items()
            if key not in (*_FREE_OF_TUNING, "recording")
        }
        for former, present in FORMER_METHODS.items():
            if present in data.get("method", ()):
                data["method"] = {former: data["method"][present]}
        return data | code_identity(self.setup)

    def identity(self) -> dict[str, Any]:
        """All inputs of an iteration: `fields`, `defaults` of missing fields, and the digest of the `recording`.

        The number of iterations and the figures are not inputs, so that a tuning can be extended.

        Raises:
            SpecError: The recording cannot be read.
        """
        try:
            recorded = b"" if self.recording is None else read_bytes(self.recording, MAX_FILE_BYTES)
        except OSError as error:
            raise SpecError(
                f"recording is {self.recording}: cannot be read ({error.strerror or error})."
            ) from None
        return {
            "fields": self.decisive(),
            "defaults": {
                name: declaration.default for name, declaration in self.parameters.items()
            },
            "recording": "" if self.recording is None else hashlib.sha256(recorded).hexdigest(),
        }

    def digest(self) -> str:
        """A hash of the `identity`."""
        return digest_of(*self.identity().values())


def _without_false(spec: Spec) -> dict[str, Any]:
    return {name: value for name, value in written(spec).items() if value is not False}


def _refuse_distance(doc: Document, run: Run) -> None:
    """Report an error if runs end at a distance, because their derivatives do not exist."""
    if run.distance is not None:
        why = "such a length jumps by whole cycles and has no derivative; give run: {cycles: 8}."
        doc.fail(("pilot", "straight", "distance"), f"ends each run at a distance: {why}")


def _read_recording(doc: Document, value: Any, objective: Objective, recorded: bool) -> Path | None:
    """The path of the recording of the objective, if any; with `recorded`, the file must exist."""
    compared = TRAJECTORY_ERROR in objective.metrics
    if value is None:
        if compared:
            message = f"names {TRAJECTORY_ERROR}, but there is no 'recording' to compare with: give the path of an NPZ."
            doc.fail(("objective",), message)
        return None
    if not isinstance(value, str):
        doc.fail(("recording",), f"is {describe(value)}: expected the path of an NPZ.")
    folder = Path(doc.source).parent if doc.lines else Path()
    recording = (folder / value).expanduser().resolve()
    if recorded and not recording.is_file():
        doc.fail(("recording",), f"is {value!r}: there is no file {recording}.")
    if not compared:
        doc.fail(("recording",), f"is not read: no term of the objective names {TRAJECTORY_ERROR}.")
    return recording


def _read_tuning(doc: Document, *, recorded: bool = True) -> Tuning:
    with known_names(doc):
        doc = written_out(doc)
        file = read(doc, TuningFile)
    walk = read_walk(doc, file)
    _refuse_distance(doc, walk["run"])
    objective = read_objective(doc, file.objective)
    method = file.method or default_method(len(file.tune))
    if method is None:
        secant_note = f"with more than {MOST_SECANTS} parameters"
        doc.fail(
            ("method",),
            f"is missing: {secant_note}, name local_gradient or wide_differences, or {_SEARCH}.",
        )
    recording = _read_recording(doc, file.recording, objective, recorded)
    if not file.tune:
        example = "{spine.amplitude: {bounds: [0, 0.4], start: 0.05}}"
        doc.fail(("tune",), f"is missing or empty: expected parameters such as {example}.")
    parameters = all_parameters(walk["setup"])
    tuning = Tuning(
        **walk,
        tuned=tuple(
            (declared or Tuned()).of(doc, name, parameters[name])
            for name, declared in file.tune.items()
        ),
        objective=objective,
        recording=recording,
        optimizer=OptimizerFields.optimizer(doc),
        method=method,
        **{name: getattr(file, name) for name in _PLAIN},
    )
    walks = method.gradient_cost(len(tuning.names)) if tuning.engine == "c" else 1
    if wrong := too_many(round(tuning.starts * walks)):
        doc.fail(("starts",), f"is {tuning.starts:,}, each with {walks:g} walks: {wrong}")
    check_sources(doc, tuning, {"tune": list(tuning.names)})
    low = {declared.name: declared.low for declared in tuning.tuned}.get("frequency")
    if low is not None and "frequency" in tuning.setup.timing and tuning.run.duration is None:
        # A run with a number of cycles lasts longer at a lower frequency.
        cycles = float(tuning.run.cycles)  # type: ignore[arg-type]
        if cycles > LONGEST_RUN * low:
            lasts = f"would last {cycles / low:g} s" if low > 0 else "would never end"
            doc.fail(
                ("tune", "frequency", "bounds"),
                f"begins at {low:g} Hz, where {cycles:g} cycles {lasts}: allowed is {cycles / LONGEST_RUN:.3g} Hz or "
                "more, or give run: {duration: seconds}.",
            )
    ranges = {
        declared.name: np.linspace(declared.low, declared.high, 5) for declared in tuning.tuned
    }
    check_reach(doc, tuning.setup, tuning.fixed, {"tune": ranges})
    return tuning
