"""What a search is: the checked content of a search file. All errors in it are reported here, before work begins."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

from pydantic import ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import core_schema
from pydantic_core.core_schema import CoreSchema

from nermo_mjx.rollout import all_parameters
from nermo_mjx.rollout.length import Run
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.search import sections
from nermo_mjx.search.sections import Aim
from nermo_mjx.specs.controllers import code_identity, known_names
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import JsonSchema, optional, read
from nermo_mjx.specs.patterns import written_out
from nermo_mjx.specs.reading import Document
from nermo_mjx.specs.values import ByParameter, Checked, Whole
from nermo_mjx.specs.walk import check_sources, read_walk
from nermo_mjx.specs.walk_fields import WalkFields
from nermo_mjx.specs.workspace import check_workspace
from nermo_mjx.sweep.axes import AxisForm, read_axis, read_draw
from nermo_mjx.sweep.file import Randomized
from nermo_mjx.sweep.spec import Sweep, start_draws
from nermo_mjx.sweep.structures import Structure
from nermo_mjx.tune.sections import TermFields

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
    atlas: dict[str, sections.MeasureForm] = Field({}, description="measures by metric: [low, high, cells] of each")
    subject_to: dict[str, sections.LimitFields] = Field({}, description="constraints by metric: {max: x}, {min: x}")
    method: sections.MethodFields = optional("search method; the default depends on the objectives")
    budget: sections.BudgetFields = Field(
        sections.BudgetFields.model_validate(_BUDGET), description="how long it runs, 1000 evaluations by default"
    )
    batch: Annotated[int, Whole(4, 100_000)] = optional("points that are evaluated together, a generation")
    randomize: Randomized = Field(Randomized.model_validate({}), description="what is drawn at random in each run")
    seed: Annotated[int, Whole(0, 2**32 - 1)] = Field(0, description="the same seed makes the same search")
    keep: sections.KeepFields = Field(sections.KeepFields(), description="recordings that are kept")
    plots: bool = Field(True, description="whether figures are drawn in the end")

    @classmethod
    def refuse(cls, key: str) -> None:
        sections.refuse_foreign(key)
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
        aim = sections.read_aim(doc, file.objective, file.pareto, file.atlas, file.subject_to)
    walk = read_walk(doc, file)
    parameters = all_parameters(walk["setup"])
    axes = [read_axis(doc, name, form, parameters[name], grid=False) for name, form in file.vary.items()]
    sections.read_bounds(doc, axes)
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
    if math.prod(each.cells for each in aim.measures) > sections.MOST_CELLS:
        doc.fail(("atlas",), f"has more than {sections.MOST_CELLS:,} cells: take fewer of each measure.")
    method, options = sections.read_method(doc, file.method, aim)
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
