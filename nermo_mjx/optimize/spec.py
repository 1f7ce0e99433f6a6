"""What a tuning and a search are: the checked content of their files. Errors are reported here, before work begins."""

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
from pydantic import BeforeValidator, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import core_schema
from pydantic_core.core_schema import CoreSchema
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
from nermo_mjx.optimize.optimizers import CONTROLLED, LEARNING_RATE, NAMES, Optimizer
from nermo_mjx.robot.quantity import ParameterError, Quantity, did_you_mean
from nermo_mjx.rollout import Metric, all_parameters
from nermo_mjx.rollout.differentiable import MJX_GRADIENT, engine_for
from nermo_mjx.rollout.run import Run, too_many
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.specs.controllers import code_identity, known_names
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import Fields, JsonSchema, OneOf, Refused, optional, read
from nermo_mjx.specs.model import Spec, named_section, one_of, written
from nermo_mjx.specs.reading import Document, FieldPath, SpecError, describe, dump, read_file
from nermo_mjx.specs.values import (
    FILE_METRICS,
    QUANTITY_SCHEMA,
    ByParameter,
    Checked,
    Choice,
    Ends,
    Finite,
    Numbers,
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
from nermo_mjx.sweep.sampling import Axis, read_axis, read_draw
from nermo_mjx.sweep.spec import Randomized, Sweep, start_draws
from nermo_mjx.sweep.structures import Structure

# ---
# Methods, with their options. The methods of a tuning step from given points; those of a search look for the best.


class TuningMethod(Spec):
    """How an iteration of a tuning finds its step.

    Attributes:
        name: in a file.
    """

    name: ClassVar[str]

    def gradient_cost(self, parameters: int) -> float:
        """Cost of value and gradient, in runs."""
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


class SearchMethod(Spec):
    """How a search chooses its points.

    Attributes:
        name: in a file.
        aims: what it is for: one `objective`, several (`pareto`), an `atlas`.
        library: needed in addition to NumPy and SciPy.
    """

    name: ClassVar[str]
    aims: ClassVar[tuple[str, ...]]
    library: ClassVar[str] = "scipy"


@dataclasses.dataclass(frozen=True)
class Cma(SearchMethod):
    """CMA-ES with restarts, for one objective."""

    name, aims, library, what = "cma", ("objective",), "cma", "an option of 'cma'"
    sigma: Positive = 0.2
    """first standard deviation, as a share of the bounds"""
    restarts: Annotated[str, Choice(("bipop", "ipop", "none"))] = "bipop"
    """restarts after convergence: bipop, alternating large and small populations; ipop: increasing ones"""


@dataclasses.dataclass(frozen=True)
class Nsga2(SearchMethod):
    """NSGA-II, for several objectives."""

    name, aims, library, what = "nsga2", ("pareto",), "pymoo", "an option of 'nsga2'"


@dataclasses.dataclass(frozen=True)
class CmaMe(SearchMethod):
    """CMA-ME, for an atlas."""

    name, aims, library, what = "cma_me", ("atlas",), "ribs", "an option of 'cma_me'"
    sigma: Positive = 0.15
    """first standard deviation, as a share of the bounds"""
    emitters: Annotated[int, Whole(1, 1000)] = 4
    """number of parallel searches"""


@dataclasses.dataclass(frozen=True)
class Sobol(SearchMethod):
    """Points of a Sobol sequence, for comparison."""

    name, aims, what = "sobol", ("objective", "pareto", "atlas"), "an option of 'sobol'"


#: Methods by their names in files; of a search the first one for an aim is its default.
TUNING_METHODS: Final[Mapping[str, type[TuningMethod]]] = {
    m.name: m for m in (Gradient, Differences)
}
#: Former names of methods of a tuning, which files may still contain; directories know a tuning by them.
FORMER_METHODS: Final = {"gradient": "local_gradient", "differences": "wide_differences"}
#: Numbers of parameters up to which a local gradient takes a tuning as far as a secant does, and up to which a secant
#: takes it about as far as CMA-ES does: 2, 16 and 64 have been measured (docs/benchmarks/rematch.md).
MOST_EXACT, MOST_SECANTS = 8, 32
SEARCH_METHODS: Final[Mapping[str, type[SearchMethod]]] = {
    m.name: m for m in (Cma, Nsga2, CmaMe, Sobol)
}


def default_method(parameters: int) -> TuningMethod | None:
    """The method of a tuning of so many parameters whose file names none; None if the file has to name one."""
    if parameters > MOST_SECANTS:
        return None
    return Gradient() if parameters <= MOST_EXACT else Differences(scheme="forward")


# ---
# A tuning file: tuned parameters, objective, optimizer.


#: Periodic parameters, or what names of such begin with, and their periods.
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
            if (
                not about.low - 1e-6 * abs(about.low)
                <= bound
                <= about.high + 1e-6 * abs(about.high)
            ):
                doc.fail(
                    (*path, "bounds"), f"has the bound {bound:g}: allowed is {about.allowed()}."
                )
        start, bounds = (
            float(about.default) if self.start is None else self.start,
            f"[{low:g}, {high:g}]",
        )
        if self.start is not None:
            check_value(doc, (*path, "start"), name, about, start)
            if not low <= start <= high:
                doc.fail((*path, "start"), f"is {start:g}: allowed is within the bounds, {bounds}.")
        elif not low <= start <= high:
            lacks = f"has no start, and its default {start:g} is outside of its bounds, {bounds}: give a start."
            doc.fail(path, lacks, name)
        return dataclasses.replace(self, name=name, bounds=(low, high), start=start)


class OptimizerFields(Fields):
    """Adam with a controlled rate, or an optimizer of optax by name, with its options."""

    expected: ClassVar = "a name or {name: adam, learning_rate: 0.1}"
    short: ClassVar = ({"enum": [*NAMES]},)
    __pydantic_extra__: dict[str, float | bool | str | dict[str, Any]]
    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)
    name: str = Field(
        default="adam",
        description="controlled_adam, or a function of optax",
        json_schema_extra={"enum": [*NAMES]},
    )
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


#: A run counted in gait cycles may not grow longer than this where the frequency is tuned [s].
LONGEST_RUN: Final = 120.0
#: What replaces CMA-ES in a tuning.
_SEARCH: Final = "run nermo-mjx search with method: cma"
#: Fields that do not change what an iteration computes: a tuning may be resumed with others.
_FREE_OF_TUNING: Final = ("iterations", "patience", "plots")
#: Fields that a tuning has as they stand in its file.
_PLAIN: Final = ("starts", "iterations", "patience", "seed", "plots")
_KNOWN_METRICS: Final[Any] = {"properties": {aim: {"enum": [*OBJECTIVE_METRICS]} for aim in AIMS}}


def _present_method(given: Any) -> Any:
    """The method of a file with its present name."""
    if isinstance(given, dict):
        return {_present_method(name): options for name, options in given.items()}
    if present := FORMER_METHODS.get(str(given)):
        warn_former(f"method: {given}", f"method: {present}", FutureWarning)
    return present or given


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
    def written_out(cls, given: Any) -> Any:
        """Without `video: false`, which the directories of earlier releases contain."""
        data = super().written_out(given)
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

    The fields from `tuned` on are those of `TuningFile`, which documents them; `tuned` are the parameters under `tune`
    in the order of the file.
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
        """See `Described.from_file`. Without `recorded`, its recording may be gone."""
        return _read_tuning(with_body(read_file(path, cls.kind), body), recorded=recorded)

    @classmethod
    def of_document(cls, doc: Document) -> Tuning:
        return _read_tuning(doc)

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
        low, high = (
            jnp.array([getattr(each, end) for each in self.tuned], float) for end in ("low", "high")
        )
        return Bounds(low, high, jnp.array([each.periodic for each in self.tuned]))

    @property
    def engine(self) -> str:
        """Name of the engine that evaluates."""
        return self.method.engine_for(len(self.names))

    def seconds(self, values: Mapping[str, float]) -> float:
        """How long a run with these parameters lasts [s]."""
        timing = {
            name: value
            for name, value in (self.constants | dict(values)).items()
            if name in self.setup.timing
        }
        return float(self.run.seconds(self.setup.cycle_rate(timing))[1])

    def start_points(self) -> np.ndarray:
        """Where each start begins (starts, p): the given point, then Sobol points within the bounds."""
        given = np.array([[each.start for each in self.tuned]])
        exponent = max(
            self.starts - 2, 0
        ).bit_length()  # a power of two keeps the sequence balanced
        sobol = qmc.Sobol(len(self.tuned), rng=np.random.default_rng(self.seed))
        shares = sobol.random_base2(exponent)[: self.starts - 1]
        low, high = (
            np.array([getattr(each, end) for each in self.tuned]) for end in ("low", "high")
        )
        return np.concatenate([given, low + (high - low) * shares])

    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        data = self.walk_fields(folder)
        data["tune"] = {each.name: _without_false(each) for each in self.tuned}
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
        """The fields that may not change: a recording counts beside them, a controller by what it is.

        A method keeps its former name here, so that a directory of an older version contains the same tuning.
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
        """All that decides an iteration: the `fields`, `defaults` of what they do not name, the `recording`'s digest.

        The number of iterations, and figures do not count: a tuning can be extended.

        Raises:
            SpecError: the recording cannot be read.
        """
        try:
            recorded = b"" if self.recording is None else read_bytes(self.recording, MAX_FILE_BYTES)
        except OSError as error:
            raise SpecError(
                f"recording is {self.recording}: cannot be read ({error.strerror or error})."
            ) from None
        return {
            "fields": self.decisive(),
            "defaults": {name: about.default for name, about in self.parameters.items()},
            "recording": "" if self.recording is None else hashlib.sha256(recorded).hexdigest(),
        }

    def without_path(self) -> Tuning:
        """As far as it decides the objective at a point: without optimizer, starts and seed."""
        return dataclasses.replace(self, optimizer=Optimizer("adam"), starts=1, seed=0)

    def digest(self) -> str:
        """A hash of the `identity`."""
        return digest_of(*self.identity().values())


def _without_false(spec: Spec) -> dict[str, Any]:
    return {name: value for name, value in written(spec).items() if value is not False}


def _refuse_distance(doc: Document, run: Run) -> None:
    """Fail if runs end at a distance where derivatives are wanted."""
    if run.distance is not None:
        why = "such a length jumps by whole cycles and has no derivative; give run: {cycles: 8}."
        doc.fail(("pilot", "straight", "distance"), f"ends each run at a distance: {why}")


def _read_tuning(doc: Document, *, recorded: bool = True) -> Tuning:
    with known_names(doc):
        doc = written_out(doc)
        file = read(doc, TuningFile)
    walk = read_walk(doc, file)
    _refuse_distance(doc, walk["run"])
    objective, method = (
        read_objective(doc, file.objective),
        file.method or default_method(len(file.tune)),
    )
    if method is None:
        many = f"with more than {MOST_SECANTS} parameters"
        doc.fail(
            ("method",),
            f"is missing: {many}, name local_gradient or wide_differences, or {_SEARCH}.",
        )
    recording: Path | None = None
    compared = TRAJECTORY_ERROR in objective.metrics
    if file.recording is not None:
        if not isinstance(file.recording, str):
            doc.fail(("recording",), f"is {describe(file.recording)}: expected the path of an NPZ.")
        folder = Path(doc.source).parent if doc.lines else Path()
        recording = (folder / file.recording).expanduser().resolve()
        if recorded and not recording.is_file():
            doc.fail(("recording",), f"is {file.recording!r}: there is no file {recording}.")
        if not compared:
            doc.fail(
                ("recording",), f"is not read: no term of the objective names {TRAJECTORY_ERROR}."
            )
    elif compared:
        missing = f"names {TRAJECTORY_ERROR}, but there is no 'recording' to compare with: give the path of an NPZ."
        doc.fail(("objective",), missing)
    if not file.tune:
        example = "{spine.amplitude: {bounds: [0, 0.4], start: 0.05}}"
        doc.fail(("tune",), f"is missing or empty: expected parameters such as {example}.")
    parameters = all_parameters(walk["setup"])
    tuning = Tuning(
        **walk,
        tuned=tuple(
            (each or Tuned()).of(doc, name, parameters[name]) for name, each in file.tune.items()
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
    check_reach(doc, tuning.setup, tuning.fixed, {"tune": ranges})
    return tuning


#: Runs of the sweep that starts from a best point: from slightly different starts, to show whether it is fragile.
REPEATS: Final = 3


def sweep_of(
    walk: WalkSpec, head: str, values: Mapping[str, float], seed: int, folder: Path | None = None
) -> str:
    """A sweep file of a found point: setup, run and `set`, run a few times from slightly different starts.

    Args:
        walk: what was tuned or searched.
        head: a line about the point.
        values: its parameters.
        seed: of the starts.
        folder: where the file is to stand, see `walk_fields`.
    """
    data = walk.walk_fields(folder) | {
        "set": {**walk.fixed, **values},
        "randomize": {"repeats": REPEATS},
    }
    return f"# {head}\n" + dump({**data, "seed": seed, "plots": False})


# ---
# A search file: what is wanted, and for how long.


MOST_EVALUATIONS: Final = 10_000_000
#: Cells of an atlas, all measures together.
MOST_CELLS: Final = 1_000_000


def searched() -> tuple[str, ...]:
    """Metrics that a search may name, custom ones among them, while its file is read."""
    return tuple(name for name in objective_metrics(FILE_METRICS.get()) if name != TRAJECTORY_ERROR)


@dataclasses.dataclass(frozen=True)
class Limit(Spec):
    """A constraint: a metric's mean over the repeats lies within the bounds."""

    what = "a field of a constraint"
    expected = "{max: x}, {min: x} or both"
    elsewhere = ("metric",)
    min: Finite = None  # type: ignore[assignment]  # none cannot be written in a file
    """lowest value that is allowed, in the metric's unit"""
    max: Finite = None  # type: ignore[assignment]
    """highest value that is allowed, in the metric's unit"""
    metric: str = ""

    def __post_init__(self) -> None:
        if self.min is None and self.max is None:
            raise Refused(f"is empty: expected {self.expected}.")
        if self.low > self.high:
            raise Refused(f"allows {self.low:g} to {self.high:g}: the lower one comes first.")

    @property
    def low(self) -> float:
        """The lowest value, or minus infinity."""
        return -math.inf if self.min is None else self.min

    @property
    def high(self) -> float:
        """The highest value, or infinity."""
        return math.inf if self.max is None else self.max


class BudgetFields(OneOf):
    """The budget of a search, as written in a file."""

    short: ClassVar = ({"type": "integer", "minimum": 1, "maximum": MOST_EVALUATIONS},)
    expected: ClassVar = "a number of evaluations, or {simulated_seconds: S}"
    other: ClassVar = "is not a budget"
    evaluations: Annotated[int, Whole(1, MOST_EVALUATIONS)] = optional("number of evaluated points")
    simulated_seconds: Positive = optional("total simulated time of all runs [s]")

    @classmethod
    def written_out(cls, given: Any) -> Any:
        number = isinstance(given, int | float) and not isinstance(given, bool)
        return {"evaluations": given} if number else super().written_out(given)


class KeepFields(Fields):
    what: ClassVar = "a field of what is kept"
    expected: ClassVar = "{best: N}, or of an atlas {elites: N}"
    best: Annotated[int, Whole(0, 10_000)] = optional(
        "recordings of the best points, or along a front"
    )
    elites: Annotated[int, Whole(0, 10_000)] = optional(
        "number of an atlas's elites to record, evenly chosen"
    )


@dataclasses.dataclass(frozen=True)
class Measure:
    """One axis of an atlas, written as [low, high, cells]: a metric, its range, and in how many cells it is divided."""

    metric: str
    low: float
    high: float
    cells: int


@dataclasses.dataclass(frozen=True)
class Aim:
    """What a search wants.

    Attributes:
        objective: of a search with one, or of an atlas; of a front its terms are the objectives.
        pareto: whether each term is an objective of its own.
        measures: axes of the atlas.
        limits: what a point must keep to.
    """

    objective: Objective
    pareto: bool = False
    measures: tuple[Measure, ...] = ()
    limits: tuple[Limit, ...] = ()

    @property
    def kind(self) -> str:
        """One of `SearchMethod.aims`."""
        return "atlas" if self.measures else "pareto" if self.pareto else "objective"

    @property
    def metrics(self) -> tuple[str, ...]:
        """Every metric that counts, each once."""
        measured, limited = (
            (each.metric for each in self.measures),
            (each.metric for each in self.limits),
        )
        return tuple(dict.fromkeys([*self.objective.metrics, *measured, *limited]))

    def written(self) -> dict[str, Any]:
        """As written in a search file."""
        terms = [written(term) for term in self.objective.terms]
        data: dict[str, Any] = {"pareto" if self.pareto else "objective": terms}
        if self.measures:
            data["atlas"] = {
                each.metric: [each.low, each.high, each.cells] for each in self.measures
            }
        if self.limits:
            data["subject_to"] = {each.metric: written(each) for each in self.limits}
        return data


def _read_aim(doc: Document, file: SearchFile) -> Aim:
    """What the file wants: `objective` or `pareto`, `atlas` and `subject_to`."""
    pareto = file.pareto is not None
    terms = file.pareto if pareto else file.objective
    if pareto and file.objective is not None:
        doc.fail(
            ("pareto",),
            "stands beside 'objective': give the terms of one objective there, or several objectives here, not both.",
        )
    if pareto and file.atlas:
        doc.fail(
            ("pareto",),
            "stands beside 'atlas', which takes one objective: put it under 'objective'.",
        )
    if pareto and len(terms) < 2:
        doc.fail(
            ("pareto",),
            f"has {len(terms)} entries: expected two or more; one alone stands under 'objective'.",
        )
    for i, term in enumerate(terms or ()):
        if term.metric == TRAJECTORY_ERROR:
            path = ("pareto" if pareto else "objective", i, term.aim)
            doc.fail(
                path, f"is {TRAJECTORY_ERROR}, which needs a recording: only a tuning has one."
            )
    for section in ("atlas", "subject_to"):
        for name in getattr(file, section):
            if name not in searched():
                allowed = f"{', '.join(searched())}{did_you_mean(name, searched())}"
                doc.fail(
                    (section, name), f"is not a metric that can be aimed at; allowed are {allowed}"
                )
    for name, (low, high, cells) in file.atlas.items():
        if not (math.isfinite(low) and math.isfinite(high)) or low >= high:
            doc.fail(
                ("atlas", name),
                f"has the range {low:g} to {high:g}: expected finite numbers, the lower one first.",
            )
        if cells != int(cells) or not 1 <= cells <= MOST_CELLS:
            doc.fail(
                ("atlas", name),
                f"has {cells:g} cells: expected a whole number from 1 to {MOST_CELLS:,}.",
            )
    return Aim(
        read_objective(doc, terms),
        pareto,
        tuple(
            Measure(name, low, high, int(cells)) for name, (low, high, cells) in file.atlas.items()
        ),
        tuple(dataclasses.replace(limit, metric=name) for name, limit in file.subject_to.items()),
    )


#: Fields that do not change which points are evaluated: a search may be resumed with others.
_FREE_OF_SEARCH: Final = ("budget", "keep", "plots")
#: Fields of other files, and what stands in their place here.
_FOREIGN: Final = {
    "sample": "how points are chosen is the method's: put sobol under 'method' for a sample",
    "tune": "what is to change stands under 'vary'",
    "iterations": "how long it runs is its 'budget'",
    "chunk": "how many points are evaluated together is its 'batch'",
}


class OneOrMore(Checked):
    """A list, of which one entry may stand alone."""

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        def listed(given: Any) -> Any:
            return [given] if isinstance(given, dict) else given

        return core_schema.no_info_before_validator_function(listed, handler(source))

    def schema(self, own: JsonSchema) -> JsonSchema:
        return {"anyOf": [own, own["items"]]}


class SearchFile(WalkFields):
    """A file for `nermo-mjx search`."""

    model_config = ConfigDict(
        json_schema_extra={"required": ["vary"]}, use_attribute_docstrings=True
    )
    what: ClassVar = "a field of a search"
    sources: ClassVar = "'vary', 'set' or 'randomize'"
    vary: Annotated[dict[str, Axis], ByParameter()] = Field({})
    """searched parameters with their bounds"""
    objective: Annotated[list[ObjectiveTerm], OneOrMore()] = optional(
        "a term, or several whose sum is minimized"
    )
    pareto: list[ObjectiveTerm] = optional("several objectives, each a term")
    atlas: dict[
        str, Annotated[list[float], Numbers("[low, high, cells]", 3, 3, of_parameter=False)]
    ] = Field({})
    """measures by metric: [low, high, cells] of each"""
    subject_to: dict[str, Limit] = Field({})
    """constraints by metric: {max: x}, {min: x}"""
    method: Annotated[SearchMethod, one_of("SearchMethod", "is not a method", SEARCH_METHODS)] = (
        optional("search method; the default depends on the objectives")
    )
    budget: BudgetFields = Field(BudgetFields.model_validate(1000.0))
    """how long it runs, 1000 evaluations by default; the batch that reaches it is the last"""
    batch: Annotated[int, Whole(4, 100_000)] = optional(
        "points that are evaluated together, a generation"
    )
    randomize: Randomized = Field(Randomized.model_validate({}))
    """what is drawn at random in each run"""
    seed: Annotated[int, Whole(0, 2**32 - 1)] = 0
    """the same seed makes the same search"""
    keep: KeepFields = Field(KeepFields())
    """recordings that are kept"""
    plots: bool = True
    """whether figures are drawn in the end"""

    @classmethod
    def refuse(cls, key: str) -> None:
        if key in _FOREIGN:
            raise Refused(f"is not a field of a search: {_FOREIGN[key]}.", key)
        super().refuse(key)


@dataclasses.dataclass(frozen=True)
class Search(Described):
    """A checked search over p parameters. Build it with `from_file`, `from_text` or `from_dict`.

    Attributes:
        sweep: what is run: the walk, the bounds (`axes`), what is drawn, and the repeats of each point.
        aim: what is wanted.
        evaluations, simulated_seconds: the budget, one of the two.
        batch: points that are evaluated together; None lets the runner choose.
        keep: number of recordings that are kept.
        method, plots: see `SearchFile`.
    """

    kind: ClassVar = "search"
    sweep: Sweep
    aim: Aim
    method: SearchMethod
    evaluations: int | None
    simulated_seconds: float | None
    batch: int | None
    keep: int
    plots: bool

    @classmethod
    def of_document(cls, doc: Document) -> Search:
        return _read_search(doc)

    @property
    def setup(self) -> Setup:
        """The static choices."""
        return self.sweep.setup

    @property
    def run(self) -> Run:
        """How long each run lasts."""
        return self.sweep.run

    @property
    def names(self) -> tuple[str, ...]:
        """The p searched parameters, in the order of the file."""
        return tuple(axis.name for axis in self.sweep.axes)

    @property
    def repeats(self) -> int:
        """Runs of each point."""
        return self.sweep.repeats

    def seconds(self, values: Mapping[str, np.ndarray], runs: int) -> np.ndarray:
        """How long each of some runs is simulated (runs,) [s].

        Args:
            values: parameters that differ between runs, name -> (runs,).
        """
        known = self.sweep.constants | dict(values)
        rate = self.setup.cycle_rate(
            {name: known[name] for name in self.setup.timing if name in known}
        )
        return np.broadcast_to(np.asarray(self.run.seconds(rate)[1], float), runs)

    def reached(self, evaluations: int, simulated_seconds: float) -> float:
        """The share of the budget that is used up; 1 or more where it is."""
        if self.evaluations is not None:
            return evaluations / self.evaluations
        assert self.simulated_seconds is not None
        return simulated_seconds / self.simulated_seconds

    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        data = {
            key: value
            for key, value in self.sweep.resolved(folder).items()
            if key not in ("sample", "plots")
        }
        options = {
            k: v for k, v in written(self.method).items() if v != getattr(type(self.method), k)
        }
        data |= self.aim.written() | {
            "method": {self.method.name: options} if options else self.method.name
        }
        data["budget"] = (
            self.evaluations
            if self.evaluations is not None
            else {"simulated_seconds": self.simulated_seconds}
        )
        if self.batch is not None:
            data["batch"] = self.batch
        data["keep"] = {"elites" if self.aim.measures else "best": self.keep}
        return data | {"plots": self.plots}

    def decisive(self) -> dict[str, Any]:
        """The fields that decide which points are evaluated; a controller counts by what it is."""
        data = {key: value for key, value in self.resolved().items() if key not in _FREE_OF_SEARCH}
        return data | code_identity(self.setup)

    def digest(self) -> str:
        """A hash of all that decides the rows of the table, defaults of what the file does not name included."""
        # The number of points of the sweep inside is no decision: which points there are, is the method's.
        return digest_of(self.decisive(), dataclasses.replace(self.sweep, samples=1).digest())


def _read_search(doc: Document) -> Search:
    with known_names(doc):
        doc = written_out(doc)
        file = read(doc, SearchFile)
        aim = _read_aim(doc, file)
    walk = read_walk(doc, file)
    parameters = all_parameters(walk["setup"])
    axes = [
        read_axis(doc, name, form, parameters[name], grid=False) for name, form in file.vary.items()
    ]
    if not axes:
        doc.fail(
            ("vary",),
            "is missing or empty: expected bounds such as {spine.phase: {uniform: [-3.14, 3.14]}}.",
        )
    for axis in axes:
        path: FieldPath = ("vary", axis.name)
        if axis.form == "values":
            wanted = "a search moves between bounds; give {uniform: [low, high]} or {loguniform: [low, high]}."
            doc.fail(path, f"is {describe(list(axis.numbers))}: {wanted}", axis.name)
    drawn = file.randomize.model_extra or {}
    sweep = Sweep(
        **walk,
        structures=(Structure(**walk),),
        axes=tuple(axes),
        sampler="sobol",
        samples=1,
        draws=tuple(read_draw(doc, name, form, parameters[name]) for name, form in drawn.items()),
        repeats=file.randomize.repeats,
        bodies=file.randomize.bodies,
        seed=file.seed,
    )
    varied, draws = [axis.name for axis in axes], [draw.name for draw in sweep.draws]
    check_sources(doc, sweep, {"vary": varied, "randomize": draws}, bodies=sweep.body_parameters)
    tried = {
        "vary": {axis.name: axis.tried(grid=False) for axis in axes},
        "randomize": {draw.name: draw.tried() for draw in sweep.draws},
    }
    check_reach(doc, sweep.setup, sweep.fixed, tried)
    if sweep.repeats > 1:
        sweep = dataclasses.replace(sweep, draws=(*sweep.draws, *start_draws(sweep)))
    if math.prod(each.cells for each in aim.measures) > MOST_CELLS:
        doc.fail(("atlas",), f"has more than {MOST_CELLS:,} cells: take fewer of each measure.")
    allowed = [each for each in SEARCH_METHODS.values() if aim.kind in each.aims]
    method = allowed[0]() if file.method is None else file.method
    if type(method) not in allowed:
        asked = {"objective": "one objective", "pareto": "several objectives", "atlas": "an atlas"}[
            aim.kind
        ]
        names = ", ".join(each.name for each in allowed)
        doc.fail(("method",), f"is {method.name}, which is not for {asked}: allowed are {names}.")
    if file.keep.elites is not None and not aim.measures:
        doc.fail(("keep", "elites"), "is for an atlas: take {best: N}.")
    if wrong := too_many((file.batch or 0) * sweep.repeats):
        doc.fail(("batch",), f"is {file.batch:,}: {wrong}")
    budget, amount = file.budget.chosen
    return Search(
        sweep,
        aim,
        method,
        evaluations=amount if budget == "evaluations" else None,
        simulated_seconds=amount if budget == "simulated_seconds" else None,
        batch=file.batch,
        keep=(file.keep.elites if aim.measures else None) or file.keep.best or 0,
        plots=file.plots,
    )
