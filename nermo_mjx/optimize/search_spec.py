"""The checked content of a search file. Errors are reported before the search starts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from pydantic import ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import core_schema
from pydantic_core.core_schema import CoreSchema

from nermo_mjx.optimize.objective import (
    TRAJECTORY_ERROR,
    Objective,
    ObjectiveTerm,
    objective_metrics,
    read_objective,
)
from nermo_mjx.robot.quantity import did_you_mean
from nermo_mjx.rollout import all_parameters
from nermo_mjx.rollout.run import Run, too_many
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.specs.controllers import code_identity, known_names
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import Fields, JsonSchema, OneOf, Refused, optional, read
from nermo_mjx.specs.model import Spec, one_of, written
from nermo_mjx.specs.reading import Document, FieldPath, describe
from nermo_mjx.specs.values import (
    FILE_METRICS,
    ByParameter,
    Checked,
    Choice,
    Finite,
    Numbers,
    Positive,
    Whole,
)
from nermo_mjx.specs.walk import WalkFields, check_reach, check_sources, read_walk, written_out
from nermo_mjx.sweep.sampling import Axis, read_axis, read_draw
from nermo_mjx.sweep.spec import Randomized, Sweep, start_draws
from nermo_mjx.sweep.structures import Structure


class SearchMethod(Spec):
    """How a search chooses its points.

    Attributes:
        name: Name in a file.
        aims: Aims of the method: one `objective`, several (`pareto`), or an `atlas`.
        library: Required library in addition to NumPy and SciPy.
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


SEARCH_METHODS: Final[Mapping[str, type[SearchMethod]]] = {
    m.name: m for m in (Cma, Nsga2, CmaMe, Sobol)
}


# ---
# The fields of a search file: its aim, and its budget.


MOST_EVALUATIONS: Final = 10_000_000
#: Maximum number of cells of an atlas, over all measures.
MOST_CELLS: Final = 1_000_000


def search_metrics() -> tuple[str, ...]:
    """Names of the metrics that a search may use, including custom ones, while its file is read."""
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
    def written_out(cls, value: Any) -> Any:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return {"evaluations": value} if number else super().written_out(value)


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
    """One axis of an atlas, written as [low, high, cells]: a metric, its range, and the number of cells."""

    metric: str
    low: float
    high: float
    cells: int


@dataclasses.dataclass(frozen=True)
class Aim:
    """The aim of a search.

    Attributes:
        objective: Objective of a search or an atlas; for a front, its terms are the objectives.
        pareto: Whether each term is a separate objective.
        measures: Axes of the atlas.
        limits: Constraints of the points.
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
        """Names of the metrics in the objective, measures and limits, each once."""
        measured = (measure.metric for measure in self.measures)
        limited = (measure.metric for measure in self.limits)
        return tuple(dict.fromkeys([*self.objective.metrics, *measured, *limited]))

    def written(self) -> dict[str, Any]:
        """The fields of the aim in a search file."""
        terms = [written(term) for term in self.objective.terms]
        data: dict[str, Any] = {"pareto" if self.pareto else "objective": terms}
        if self.measures:
            data["atlas"] = {
                measure.metric: [measure.low, measure.high, measure.cells]
                for measure in self.measures
            }
        if self.limits:
            data["subject_to"] = {measure.metric: written(measure) for measure in self.limits}
        return data


def _read_aim(doc: Document, file: SearchFile) -> Aim:
    """The aim of the file, from `objective` or `pareto`, `atlas` and `subject_to`."""
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
            if name not in search_metrics():
                allowed = f"{', '.join(search_metrics())}{did_you_mean(name, search_metrics())}"
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


#: Fields that do not change the evaluated points, so that a search can be resumed with other values.
_FREE_OF_SEARCH: Final = ("budget", "keep", "plots")
#: Fields of other files, and the fields that replace them in a search file.
_FOREIGN: Final = {
    "sample": "how points are chosen is the method's: put sobol under 'method' for a sample",
    "tune": "what is to change stands under 'vary'",
    "iterations": "how long it runs is its 'budget'",
    "chunk": "how many points are evaluated together is its 'batch'",
}


class OneOrMore(Checked):
    """A list, of which one entry may stand alone."""

    def inner(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        def as_list(value: Any) -> Any:
            return [value] if isinstance(value, dict) else value

        return core_schema.no_info_before_validator_function(as_list, handler(source))

    def schema(self, base: JsonSchema) -> JsonSchema:
        return {"anyOf": [base, base["items"]]}


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
        sweep: Sweep with the walk, the bounds (`axes`), the randomized parameters, and the repeats of each point.
        aim: Aim of the search.
        evaluations, simulated_seconds: Budget, the number of points or the simulated time [s]; one of them is None.
        batch: Number of points that are evaluated together; None lets the runner choose.
        keep: Number of recordings.
        method, plots: See `SearchFile`.
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
        """Setup of the walks."""
        return self.sweep.setup

    @property
    def run(self) -> Run:
        """Run with the duration of the walks."""
        return self.sweep.run

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the p searched parameters, in the order of the file."""
        return tuple(axis.name for axis in self.sweep.axes)

    @property
    def repeats(self) -> int:
        """Number of runs of each point."""
        return self.sweep.repeats

    def seconds(self, values: Mapping[str, np.ndarray], runs: int) -> np.ndarray:
        """Simulated time of each of some runs (runs,) [s].

        Args:
            values: Parameters that differ between the runs (runs,), by name.
        """
        constants = self.sweep.constants | dict(values)
        rate = self.setup.cycle_rate(
            {name: constants[name] for name in self.setup.timing if name in constants}
        )
        return np.broadcast_to(np.asarray(self.run.seconds(rate)[1], float), runs)

    def budget_share(self, evaluations: int, simulated_seconds: float) -> float:
        """The used share of the budget; 1 or more if the budget is used up."""
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
        """The fields that determine the evaluated points; a controller is identified by its content."""
        data = {key: value for key, value in self.resolved().items() if key not in _FREE_OF_SEARCH}
        return data | code_identity(self.setup)

    def digest(self) -> str:
        """A hash of all inputs of the table's rows, including defaults of fields that the file does not contain."""
        # The number of points of the sweep has no effect, because the method chooses the points.
        return digest_of(self.decisive(), dataclasses.replace(self.sweep, samples=1).digest())


def _read_method(doc: Document, chosen_method: SearchMethod | None, aim: Aim) -> SearchMethod:
    """The method of the file, which must support its aim, or the default method of this aim."""
    allowed = [candidate for candidate in SEARCH_METHODS.values() if aim.kind in candidate.aims]
    method = allowed[0]() if chosen_method is None else chosen_method
    if type(method) not in allowed:
        texts = {"objective": "one objective", "pareto": "several objectives", "atlas": "an atlas"}
        names = ", ".join(candidate.name for candidate in allowed)
        wrong = f"is {method.name}, which is not for {texts[aim.kind]}: allowed are {names}."
        doc.fail(("method",), wrong)
    return method


# Long because the fields of the file are checked in their order.
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
            advice = "a search moves between bounds; give {uniform: [low, high]} or {loguniform: [low, high]}."
            doc.fail(path, f"is {describe(list(axis.numbers))}: {advice}", axis.name)
    if file.randomize.paired:
        doc.fail(
            ("randomize", "paired"),
            "is for a sweep: the draws of a search depend on all of its parameters.",
        )
    randomized = file.randomize.model_extra or {}
    sweep = Sweep(
        **walk,
        structures=(Structure(**walk),),
        axes=tuple(axes),
        sampler="sobol",
        samples=1,
        draws=tuple(
            read_draw(doc, name, form, parameters[name]) for name, form in randomized.items()
        ),
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
    if math.prod(measure.cells for measure in aim.measures) > MOST_CELLS:
        doc.fail(("atlas",), f"has more than {MOST_CELLS:,} cells: take fewer of each measure.")
    method = _read_method(doc, file.method, aim)
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
