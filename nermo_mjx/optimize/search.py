"""What a search is: the checked content of a search file. All errors in it are reported here, before work begins."""

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
from scipy.stats import qmc

from nermo_mjx.optimize.objective import TRAJECTORY_ERROR, Objective, objective_metrics
from nermo_mjx.optimize.tuning import TermFields, period_of, read_objective
from nermo_mjx.robot.quantity import did_you_mean
from nermo_mjx.rollout import all_parameters
from nermo_mjx.rollout.run import Run
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.specs.controllers import code_identity, known_names
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import Fields, JsonSchema, OneOf, Refused, optional, read
from nermo_mjx.specs.reading import Document, FieldPath, describe
from nermo_mjx.specs.values import MEASURED, ByParameter, Checked, Choice, Finite, Numbers, Positive, Whole
from nermo_mjx.specs.walk import WalkFields, check_sources, check_workspace, read_walk, written_out
from nermo_mjx.sweep.axes import Axis, AxisForm, read_axis, read_draw
from nermo_mjx.sweep.spec import Randomized, Sweep, start_draws
from nermo_mjx.sweep.structures import Structure

# ---
# The sections of a search file that a sweep file does not have: what is wanted, by which method, and for how long.


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


#: Fields that do not change which points are evaluated: a search may be resumed with others.
FREE: Final = ("budget", "keep", "plots")
_BUDGET: Final = 1000.0


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

    model_config = ConfigDict(json_schema_extra={"required": ["vary"]})
    what: ClassVar = "a field of a search"
    sources: ClassVar = "'vary', 'set' or 'randomize'"
    vary: Annotated[dict[str, AxisForm], ByParameter()] = Field({}, description="searched parameters with their bounds")
    objective: Annotated[list[TermFields], OneOrMore()] = optional("a term, or several whose sum is minimized")
    pareto: list[TermFields] = optional("several objectives, each a term")
    atlas: dict[str, MeasureForm] = Field({}, description="measures by metric: [low, high, cells] of each")
    subject_to: dict[str, LimitFields] = Field({}, description="constraints by metric: {max: x}, {min: x}")
    method: MethodFields = optional("search method; the default depends on the objectives")
    budget: BudgetFields = Field(
        BudgetFields.model_validate(_BUDGET), description="how long it runs, 1000 evaluations by default"
    )
    batch: Annotated[int, Whole(4, 100_000)] = optional("points that are evaluated together, a generation")
    randomize: Randomized = Field(Randomized.model_validate({}), description="what is drawn at random in each run")
    seed: Annotated[int, Whole(0, 2**32 - 1)] = Field(0, description="the same seed makes the same search")
    keep: KeepFields = Field(KeepFields(), description="recordings that are kept")
    plots: bool = Field(True, description="whether figures are drawn in the end")

    @classmethod
    def refuse(cls, key: str) -> None:
        refuse_foreign(key)
        super().refuse(key)


@dataclasses.dataclass(frozen=True)
class Search(Described):
    """A checked search over p parameters. Build it with `from_file`, `from_text` or `from_dict`.

    Attributes:
        sweep: what is run: the walk, the bounds (`axes`), what is drawn, and the repeats of each point.
        aim: what is wanted.
        method, options: how it is searched.
        evaluations, simulated_seconds: the budget; the batch that reaches it is the last.
        batch: points that are evaluated together; None lets the runner choose.
        keep: recordings that are kept.
        plots: whether figures are drawn in the end.
    """

    kind: ClassVar = "search"
    sweep: Sweep
    aim: Aim
    method: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    evaluations: int | None = None
    simulated_seconds: float | None = None
    batch: int | None = None
    keep: int = 0
    plots: bool = True

    @classmethod
    def of_document(cls, doc: Document) -> Search:
        return _read(doc)

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

    def reached(self, evaluations: int, simulated_seconds: float) -> float:
        """The share of the budget that is used up; 1 or more where it is."""
        if self.evaluations is not None:
            return evaluations / self.evaluations
        assert self.simulated_seconds is not None
        return simulated_seconds / self.simulated_seconds

    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        data = {key: value for key, value in self.sweep.resolved(folder).items() if key not in ("sample", "plots")}
        data |= self.aim.written() | {"method": {self.method: dict(self.options)} if self.options else self.method}
        data["budget"] = (
            self.evaluations if self.evaluations is not None else {"simulated_seconds": self.simulated_seconds}
        )
        if self.batch is not None:
            data["batch"] = self.batch
        data["keep"] = {"elites" if self.aim.measures else "best": self.keep}
        return data | {"plots": self.plots}

    def decisive(self) -> dict[str, Any]:
        """The fields that decide which points are evaluated; a controller counts by what it is."""
        data = {key: value for key, value in self.resolved().items() if key not in FREE}
        return data | code_identity(self.setup)

    def digest(self) -> str:
        """A hash of all that decides the rows of the table, defaults of what the file does not name included."""
        # The number of points of the sweep inside is no decision: which points there are, is the method's.
        return digest_of(self.decisive(), dataclasses.replace(self.sweep, samples=1).digest())


def _read(doc: Document) -> Search:
    with known_names(doc):
        doc = written_out(doc)
        file = read(doc, SearchFile)
        aim = read_aim(doc, file.objective, file.pareto, file.atlas, file.subject_to)
    walk = read_walk(doc, file)
    parameters = all_parameters(walk["setup"])
    axes = [read_axis(doc, name, form, parameters[name], grid=False) for name, form in file.vary.items()]
    read_bounds(doc, axes)
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
    tried = {"vary": {axis.name: axis.tried(grid=False) for axis in axes},
             "randomize": {draw.name: draw.tried() for draw in sweep.draws}}  # fmt: skip
    check_workspace(doc, sweep.setup, sweep.fixed, tried)
    if sweep.repeats > 1:
        sweep = dataclasses.replace(sweep, draws=(*sweep.draws, *start_draws(sweep)))
    if math.prod(each.cells for each in aim.measures) > MOST_CELLS:
        doc.fail(("atlas",), f"has more than {MOST_CELLS:,} cells: take fewer of each measure.")
    method, options = read_method(doc, file.method, aim)
    if method == "cma_mega" and walk["run"].distance is not None:
        doc.fail(("pilot", "straight", "distance"), "ends each run at a distance, which has no derivative: method "
                                                    "cma_mega needs run: {cycles: 8}.")  # fmt: skip
    if file.keep.elites is not None and not aim.measures:
        doc.fail(("keep", "elites"), "is for an atlas: take {best: N}.")
    budget, amount = file.budget.chosen
    return Search(
        sweep, aim, method, options,
        evaluations=amount if budget == "evaluations" else None,
        simulated_seconds=amount if budget == "simulated_seconds" else None,
        batch=file.batch, keep=(file.keep.elites if aim.measures else None) or file.keep.best or 0, plots=file.plots,
    )  # fmt: skip


# ---
# Coordinates in which a search moves: fractions of the bounds, without ends, so that no step leaves them.
#
# A bounded parameter is reflected at its bounds: a coordinate of 1.1 is the share 0.9. A periodic one, whose bounds are
# a whole turn apart, comes back at the other side: 1.1 is 0.1.


#: Share of a period by which written bounds may miss it: 3.14 is meant as pi.
_ROUNDING = 1e-3


class Space:
    """The p coordinates of a search.

    Attributes:
        periodic: which parameters come back to the same place, (p,).
        first: shares of the published gait, as far as the bounds have it, (p,).
    """

    def __init__(self, search: Search) -> None:
        axes, defaults = search.sweep.axes, search.sweep.parameters
        self.dimensions = len(axes)
        self.periodic = np.array([_is_turn(axis) for axis in axes])
        self.first = np.array([_share(axis, float(np.asarray(defaults[axis.name].default))) for axis in axes])
        self._seed = search.sweep.seed

    def shares(self, coordinates: np.ndarray) -> np.ndarray:
        """Shares of the bounds (n, p), in [0, 1], of any coordinates."""
        turned = coordinates - np.floor(coordinates)
        reflected = 1.0 - np.abs(1.0 - np.mod(coordinates, 2.0))
        return np.clip(np.where(self.periodic, turned, reflected), 0.0, 1.0)

    def slope(self, coordinates: np.ndarray) -> np.ndarray:
        """d share / d coordinate (n, p): -1 where a coordinate is reflected an odd number of times, else 1."""
        return np.where(self.periodic | (np.mod(coordinates, 2.0) < 1.0), 1.0, -1.0)

    def spread(self, count: int) -> np.ndarray:
        """Shares to begin with (count, p): the published gait, then points of a scrambled Sobol sequence."""
        points = qmc.Sobol(self.dimensions, rng=np.random.default_rng(self._seed))
        return np.concatenate([self.first[None], points.random_base2(max(count - 1, 1).bit_length())])[:count]


def _is_turn(axis: Axis) -> bool:
    """Whether the bounds of an angle or of a phase are one whole period apart."""
    period = period_of(axis.name)
    low, high = axis.numbers[:2]
    return period is not None and abs(high - low - period) <= _ROUNDING * period


def _share(axis: Axis, value: float) -> float:
    """Where a value stands between the bounds; the nearer bound, if it is beyond."""
    low, high = axis.numbers[:2]
    value = min(max(value, low), high)
    if axis.form.startswith("log"):
        return float(np.log(value / low) / np.log(high / low))
    return (value - low) / (high - low)


# ---
# What the runs of a batch say about its points: costs, measures, and whether constraints hold.


@dataclasses.dataclass(frozen=True)
class Scores:
    """Results of n points.

    Attributes:
        cost: (n, k), less is better: one column for one objective, of a front one for each; NaN where a run failed.
        measures: (n, m) of an atlas; NaN where a run failed.
        violation: how far the constraints are from holding, (n,), each in units of its bound; 0 where they hold.
        ok: whether all runs walked to the end with finite numbers, (n,).
        jacobian: of the first g points, d (quality, *measures) / d fractions of the bounds, (g, 1 + m, p), where the
            quality is minus the cost; None if not requested.
    """

    cost: np.ndarray
    measures: np.ndarray
    violation: np.ndarray
    ok: np.ndarray
    jacobian: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.ok)

    @property
    def allowed(self) -> np.ndarray:
        """Points (n,) that walked to the end and keep to the constraints."""
        return self.ok & (self.violation == 0.0)

    @property
    def quality(self) -> np.ndarray:
        """Of one objective, more is better (n,)."""
        return -self.cost[:, 0]

    def joined(self, other: Scores) -> Scores:
        """These points, then the others; without gradients."""
        both = {name: np.concatenate([getattr(self, name), getattr(other, name)])
                for name in ("cost", "measures", "violation", "ok")}  # fmt: skip
        return Scores(**both)


def scores_of(aim: Aim, repeats: int, metrics: Mapping[str, np.ndarray], well: np.ndarray) -> Scores:
    """The scores of points, each with all of its repeats side by side.

    A metric counts by its mean over the repeats. A point of which one run failed counts as the worst.

    Args:
        metrics: name -> (n * repeats,), at least those of the aim.
        well: which runs succeeded (n * repeats,).
    """
    means = {name: np.asarray(metrics[name], float).reshape(-1, repeats).mean(axis=1) for name in aim.metrics}
    ok: np.ndarray = np.logical_and.reduce(np.asarray(well, bool).reshape(-1, repeats), axis=1)
    terms = [np.asarray(term.value(means[term.metric]), float) for term in aim.objective.terms]
    cost = np.stack(terms, axis=1) if aim.pareto else np.sum(terms, axis=0)[:, None]
    measures = np.empty((len(ok), len(aim.measures)))
    for i, measure in enumerate(aim.measures):
        measures[:, i] = means[measure.metric]
    violation = np.zeros(len(ok))
    for limit in aim.limits:
        value, unit = means[limit.metric], max(abs(b) for b in (limit.low, limit.high) if np.isfinite(b)) or 1.0
        violation += np.maximum(value - limit.high, 0.0) / unit + np.maximum(limit.low - value, 0.0) / unit
    ok &= np.isfinite(cost).all(axis=1) & np.isfinite(measures).all(axis=1) & np.isfinite(violation)
    lost = ~ok
    cost[lost], measures[lost], violation[lost] = np.nan, np.nan, np.nan
    return Scores(cost, measures, violation, ok)


def ranked_cost(scores: Scores, worst: float) -> np.ndarray:
    """One finite cost a point (n,), by which any method can rank: allowed points, then the least violation, then falls.

    Args:
        worst: highest cost of an allowed point so far; it only has to be finite.
    """
    cost = np.where(scores.allowed, scores.cost[:, 0], worst + 1.0 + np.nan_to_num(scores.violation))
    fallen = worst + 2.0 + np.nanmax(np.append(scores.violation, 0.0))
    return np.where(scores.ok, cost, fallen)


def cells_of(aim: Aim, measures: np.ndarray) -> np.ndarray:
    """The cell of each point of an atlas, (n,): the last measure runs fastest; -1 outside of the ranges, or lost.

    Args:
        measures: (n, m).
    """
    cell, inside = np.zeros(len(measures), int), np.isfinite(measures).all(axis=1)
    for values, measure in zip(np.where(inside[:, None], measures, 0.0).T, aim.measures, strict=True):
        inside &= (values >= measure.low) & (values <= measure.high)
        place = np.floor((values - measure.low) / (measure.high - measure.low) * measure.cells)
        cell = cell * measure.cells + np.clip(place, 0, measure.cells - 1).astype(int)
    return np.where(inside, cell, -1)


def elites_of(aim: Aim, scores: Scores) -> tuple[np.ndarray, np.ndarray]:
    """Filled cells in order, (k,), and the best allowed point of each, (k,); of equal points the first."""
    cell = np.where(scores.allowed, cells_of(aim, scores.measures), -1)
    order = np.lexsort((np.arange(len(cell)), -scores.quality, cell))
    order = order[cell[order] >= 0]
    cells, first = np.unique(cell[order], return_index=True)
    return cells, order[first]
