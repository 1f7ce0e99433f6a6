"""The sections of a search file that a sweep file does not have: what is wanted, by which method, and for how long."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final

from nermo_mjx.robot.nearest import did_you_mean
from nermo_mjx.specs.fields import Fields, OneOf, Refused, optional
from nermo_mjx.specs.reading import Document, FieldPath, describe
from nermo_mjx.specs.values import MEASURED, Choice, Finite, Numbers, Positive, Whole
from nermo_mjx.sweep.axes import Axis
from nermo_mjx.tune.objective import TRAJECTORY_ERROR, Objective, objective_metrics
from nermo_mjx.tune.sections import TermFields, read_objective

MOST_EVALUATIONS: Final = 10_000_000
#: Cells of an atlas, all measures together.
MOST_CELLS: Final = 1_000_000


#: Metrics that an objective, a limit or a measure may name.
def searched() -> tuple[str, ...]:
    """What a search may name, custom metrics among them, while its file is read."""
    return tuple(name for name in objective_metrics(MEASURED.get()) if name != TRAJECTORY_ERROR)


#: Methods of each aim, the default first.
METHODS: Final = {"objective": ("cma", "sobol"), "pareto": ("nsga2", "sobol"), "atlas": ("cma_me", "cma_mega", "sobol")}


class LimitFields(Fields):
    """A constraint on a metric, as written in a file."""

    what: ClassVar = "a field of a constraint"
    expected: ClassVar = "{max: x}, {min: x} or both"
    max: Finite = optional("highest value that is allowed, in the metric's unit")
    min: Finite = optional("lowest value that is allowed, in the metric's unit")


class CmaFields(Fields):
    what: ClassVar = "an option of 'cma'"
    sigma: Positive = optional("first standard deviation, as a share of the bounds, by default 0.2")
    restarts: Annotated[str, Choice(("bipop", "ipop", "none"))] = optional(
        "restarts after convergence: by default bipop, alternating large and small populations; ipop: increasing ones"
    )


class CmaMeFields(Fields):
    what: ClassVar = "an option of 'cma_me'"
    sigma: Positive = optional("first standard deviation, as a share of the bounds, by default 0.15")
    emitters: Annotated[int, Whole(1, 1000)] = optional("number of parallel searches, by default 4")


class CmaMegaFields(Fields):
    what: ClassVar = "an option of 'cma_mega'"
    sigma: Positive = optional("first standard deviation of the gradients' coefficients, by default 0.2")
    learning_rate: Positive = optional("of the step along the gradients, by default 0.05")
    emitters: Annotated[int, Whole(1, 1000)] = optional("number of parallel searches, by default 4")


class MethodFields(OneOf):
    """The method of a search, as written in a file."""

    alone: ClassVar = ("cma", "nsga2", "cma_me", "cma_mega", "sobol")
    expected: ClassVar = "cma, nsga2, cma_me, cma_mega or sobol as a name, or {name: {option: value}}"
    other: ClassVar = "is not a method"
    other_name: ClassVar = "is {name!r}"
    cma: CmaFields | None = optional("CMA-ES with restarts, for one objective")
    nsga2: None = optional("NSGA-II, for several objectives")
    cma_me: CmaMeFields | None = optional("CMA-ME, for an atlas")
    cma_mega: CmaMegaFields | None = optional("CMA-MEGA, for an atlas, along gradients from MJX")
    sobol: None = optional("points of a Sobol sequence, for comparison")


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
        return {"evaluations": float(given)} if number else super().written_out(given)


class KeepFields(Fields):
    what: ClassVar = "a field of what is kept"
    expected: ClassVar = "{best: N}, or of an atlas {elites: N}"
    best: Annotated[int, Whole(0, 10_000)] = optional("recordings of the best points, or along a front")
    elites: Annotated[int, Whole(0, 10_000)] = optional("number of an atlas's elites to record, evenly chosen")


#: low, high and the number of cells of each measure.
MeasureForm = Annotated[list[float], Numbers("[low, high, cells]", 3, 3)]


@dataclasses.dataclass(frozen=True)
class Limit:
    """A constraint: a metric's mean over the repeats lies within the bounds."""

    metric: str
    low: float = -math.inf
    high: float = math.inf

    def written(self) -> dict[str, float]:
        """As written in a search file."""
        bounds = {"min": self.low, "max": self.high}
        return {name: value for name, value in bounds.items() if math.isfinite(value)}


@dataclasses.dataclass(frozen=True)
class Measure:
    """One axis of an atlas: a metric, its range, and in how many cells it is divided."""

    metric: str
    low: float
    high: float
    cells: int

    def written(self) -> list[float | int]:
        """As written in a search file."""
        return [self.low, self.high, self.cells]


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
        """A key of `METHODS`."""
        return "atlas" if self.measures else "pareto" if self.pareto else "objective"

    @property
    def metrics(self) -> tuple[str, ...]:
        """Every metric that counts, each once."""
        measured, limited = (each.metric for each in self.measures), (each.metric for each in self.limits)
        return tuple(dict.fromkeys([*self.objective.metrics, *measured, *limited]))

    def written(self) -> dict[str, Any]:
        """As written in a search file."""
        terms = [term.written() for term in self.objective.terms]
        data: dict[str, Any] = {"pareto" if self.pareto else "objective": terms}
        if self.measures:
            data["atlas"] = {each.metric: each.written() for each in self.measures}
        if self.limits:
            data["subject_to"] = {each.metric: each.written() for each in self.limits}
        return data


def read_aim(
    doc: Document,
    objective: list[TermFields] | None,
    pareto: list[TermFields] | None,
    measures: Mapping[str, list[float]],
    limits: Mapping[str, LimitFields],
) -> Aim:
    """What the file wants: `objective` or `pareto`, `atlas` and `subject_to`."""
    if objective is not None and pareto is not None:
        doc.fail(("pareto",), "stands beside 'objective': give the terms of one objective there, or several objectives "
                              "here, not both.")  # fmt: skip
    if pareto is not None and measures:
        doc.fail(("pareto",), "stands beside 'atlas', which takes one objective: put it under 'objective'.")
    if pareto is not None and len(pareto) < 2:
        doc.fail(("pareto",), f"has {len(pareto)} entries: expected two or more; one alone stands under 'objective'.")
    _check_terms(doc, "objective" if pareto is None else "pareto", pareto or objective or [])
    return Aim(
        read_objective(doc, pareto or objective),
        pareto is not None,
        tuple(_read_measure(doc, name, numbers) for name, numbers in _known(doc, "atlas", measures).items()),
        tuple(_read_limit(doc, name, each) for name, each in _known(doc, "subject_to", limits).items()),
    )


def _check_terms(doc: Document, section: str, terms: list[TermFields]) -> None:
    for i, term in enumerate(terms):
        for aim in ("maximize", "minimize", "hold"):
            if getattr(term, aim) == TRAJECTORY_ERROR:
                doc.fail((section, i, aim), f"is {TRAJECTORY_ERROR}, which needs a recording: only a tuning has one.")


def _known(doc: Document, section: str, given: Mapping[str, Any]) -> Mapping[str, Any]:
    for name in given:
        if name not in searched():
            doc.fail((section, name), f"is not a metric that can be aimed at; allowed are {', '.join(searched())}"
                                      f"{did_you_mean(name, searched())}")  # fmt: skip
    return given


def _read_measure(doc: Document, name: str, numbers: list[float]) -> Measure:
    path: FieldPath = ("atlas", name)
    low, high, cells = numbers
    if not (math.isfinite(low) and math.isfinite(high)) or low >= high:
        doc.fail(path, f"has the range {low:g} to {high:g}: expected finite numbers, the lower one first.")
    if cells != int(cells) or not 1 <= cells <= MOST_CELLS:
        doc.fail(path, f"has {cells:g} cells: expected a whole number from 1 to {MOST_CELLS:,}.")
    return Measure(name, low, high, int(cells))


def _read_limit(doc: Document, name: str, given: LimitFields) -> Limit:
    path: FieldPath = ("subject_to", name)
    low = -math.inf if given.min is None else given.min
    high = math.inf if given.max is None else given.max
    if low == -math.inf and high == math.inf:
        doc.fail(path, "is empty: expected {max: x}, {min: x} or both.")
    if low > high:
        doc.fail(path, f"allows {low:g} to {high:g}: the lower one comes first.")
    return Limit(name, low, high)


def read_method(doc: Document, given: MethodFields | None, aim: Aim) -> tuple[str, dict[str, Any]]:
    """The method's name and the options that are given."""
    allowed = METHODS[aim.kind]
    if given is None:
        return allowed[0], {}
    name, options = given.chosen
    if name not in allowed:
        asked = {"objective": "one objective", "pareto": "several objectives", "atlas": "an atlas"}[aim.kind]
        doc.fail(("method",), f"is {name}, which is not for {asked}: allowed are {', '.join(allowed)}.")
    return name, {} if options is None else options.model_dump(exclude_unset=True)


def read_bounds(doc: Document, axes: list[Axis]) -> None:
    """Refuse what is varied otherwise than between bounds."""
    if not axes:
        doc.fail(("vary",), "is missing or empty: expected bounds such as {spine.phase: {uniform: [-3.14, 3.14]}}.")
    for axis in axes:
        if axis.form == "values":
            doc.fail(("vary", axis.name), f"is {describe(list(axis.numbers))}: a search moves between bounds; give "
                     "{uniform: [low, high]} or {loguniform: [low, high]}.", axis.name)  # fmt: skip
        if axis.name in MEASURED.get():
            doc.fail(("vary", axis.name), "cannot be searched: in the table its name is a metric's.", axis.name)


def refuse_foreign(key: str) -> None:
    """Point from fields of sweeps and tunings to their counterparts here."""
    foreign = {"sample": "how points are chosen is the method's: put sobol under 'method' for a sample",
               "tune": "what is to change stands under 'vary'" , "iterations": "how long it runs is its 'budget'",
               "chunk": "how many points are evaluated together is its 'batch'"}  # fmt: skip
    if key in foreign:
        raise Refused(f"is not a field of a search: {foreign[key]}.", key)
