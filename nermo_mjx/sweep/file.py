"""The declared fields of a sweep file, also the source of its JSON Schema."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final

from pydantic import ConfigDict, Field

from nermo_mjx.specs.fields import Fields, OneOf, optional
from nermo_mjx.specs.values import Choice, Whole, by_parameter, refuse_parameter
from nermo_mjx.specs.walk_fields import WalkFields
from nermo_mjx.sweep.asked import CompareFields
from nermo_mjx.sweep.axes import DrawForm
from nermo_mjx.sweep.beside import KeepFields, SaveFields
from nermo_mjx.sweep.listing import RowsForm
from nermo_mjx.sweep.saltelli import Saltelli
from nermo_mjx.sweep.structures import Vary

LARGEST_SWEEP: Final = 10_000_000


class Sampler(OneOf):
    """Where the variants lie between the values of the axes."""

    expected: ClassVar = "grid, {sobol: N}, {latin_hypercube: N} or {saltelli: N}"
    other: ClassVar = "is not a sampler"
    alone: ClassVar = ("grid",)
    grid: None = optional("every combination of the listed values")
    sobol: Annotated[int, Whole(1, LARGEST_SWEEP)] = optional("number of points of a Sobol sequence")
    latin_hypercube: Annotated[int, Whole(1, LARGEST_SWEEP)] = optional("number of points of the hypercube")
    saltelli: Saltelli = optional("the design for Sobol indices, with this number of points, a power of two")


def _list_parameters(schema: dict[str, Any]) -> None:
    """Tell an editor the names of what is randomized, beside the fields."""
    listed = by_parameter(schema.pop("additionalProperties"))
    schema |= {**listed, "properties": schema["properties"] | listed["properties"]}


class Randomized(Fields):
    """Repeats, where bodies are drawn from, and the randomized parameters by name."""

    __pydantic_extra__: dict[str, DrawForm]
    model_config = ConfigDict(extra="allow", json_schema_extra=_list_parameters)
    repeats: Annotated[int, Whole(1, 100_000)] = Field(1, description="how often each variant is drawn and run")
    bodies: Annotated[str, Choice(("identified",))] = optional("draw whole bodies", alias="from")

    @classmethod
    def refuse(cls, key: str) -> None:
        refuse_parameter(key)


class SweepFile(WalkFields):
    """A file for `nermo-mjx sweep`."""

    what: ClassVar = "a field of a sweep"
    sources: ClassVar = "'vary', 'set' or 'randomize'"
    vary: Vary = Field(Vary.model_validate({}), description="varied structures and parameters")
    rows: Annotated[Any, RowsForm()] = optional("exactly these variants, instead of vary: a table, or a list")
    sample: Sampler = Field(Sampler(grid=None), description="grid, or a sampler and its number of variants")
    randomize: Randomized = Field(Randomized.model_validate({}), description="what is drawn at random in each run")
    seed: Annotated[int, Whole(0, 2**53)] = Field(0, description="makes samples and draws repeatable")
    chunk: Annotated[int, Whole(1, LARGEST_SWEEP)] = optional("runs simulated and stored together")
    plots: bool = Field(True, description="whether figures are drawn when the table is complete")
    compare: CompareFields = optional("structures or values to compare when the table is complete")
    save: SaveFields = optional("time series of some sensors beside the table")
    keep: KeepFields = optional("rows that are recorded when the table is complete")
