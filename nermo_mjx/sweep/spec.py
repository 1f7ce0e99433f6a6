"""What a sweep is: the checked content of a sweep file, and the rows that it stands for.

All errors in a file are reported here, before work begins.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field, create_model
from scipy.stats import qmc

from nermo_mjx.robot import identified
from nermo_mjx.robot.quantity import ParameterError, Quantity, did_you_mean
from nermo_mjx.rollout import Saving, Setup
from nermo_mjx.rollout.run import START_SPREAD
from nermo_mjx.rollout.saving import Keeper
from nermo_mjx.specs.controllers import code_identity, known_names
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import Fields, OneOf, Refused, documented, optional, read
from nermo_mjx.specs.reading import (
    Document,
    FieldPath,
    describe,
    read_file,
    read_mapping,
    read_text,
)
from nermo_mjx.specs.values import FILE_PARAMETERS, BodiesField, Positive, Whole, refuse_parameter
from nermo_mjx.specs.walk import (
    WalkFields,
    WalkSpec,
    check_reach,
    check_sources,
    unread,
    with_body,
    written_out,
)
from nermo_mjx.sweep.sampling import (
    Axis,
    Draw,
    Saltelli,
    read_axis,
    read_draw,
    saltelli_points,
    saltelli_size,
)
from nermo_mjx.sweep.structures import (
    RowList,
    RowsForm,
    Structure,
    Vary,
    also_parameters,
    check_repeats,
    combinations_of,
    listed_rows,
    read_row_table,
    read_structures,
)

# ---
# The comparison that a sweep file may request of the finished table.


LARGEST_SWEEP: Final = 10_000_000
#: A value of a varied column.
Value = float | str


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _names(value: Any) -> Any:
    value = _listed(value)
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise Refused(f"is {describe(value)}: expected a list of varied parameters.")
    return list(dict.fromkeys(value))


#: Of a list that may be a single name.
_LABEL_NAMES: Final[dict[str, Any]] = {"type": ["array", "string"]}


class ComparedColumns(Fields):
    """The section `compare` of a sweep file: what is compared when the sweep is complete; see `nermo_mjx.compare`."""

    what: ClassVar = "a field of a comparison"
    example: ClassVar = "by: NAME, of a varied column"
    by: str = Field(description="the varied column whose values are compared")
    base: Value = optional("the baseline value; by default none, or the first")
    groups: Annotated[list[str], BeforeValidator(_names)] = Field(
        [],
        alias="for",
        description="varied columns: an interval for each combination of their values",
        json_schema_extra=_LABEL_NAMES,
    )

    def written(self) -> dict[str, Any]:
        """As written in a sweep file."""
        return self.model_dump(by_alias=True, exclude_none=True)


def _one_value(value: Any) -> Any:
    if not isinstance(value, dict) or len(value) != 1:
        raise Refused(
            f"is {describe(value)}: expected one column and its value, such as {{spine: none}}."
        )
    return value


class SoughtOptimum(Fields):
    """The section `optimum` of a sweep file: where a metric is best, for which, and against what.

    Runs of a point are spent in blocks of `randomize.repeats`: the first choose, with those of the second stage; those
    of `fresh` choose nothing, and only measure the gain. See `nermo_mjx.sweep.optimum`.
    """

    what: ClassVar = "a field of an optimum"
    example: ClassVar = "over: [spine.amplitude, spine.phase] and base: {spine: none}"
    maximize: str = optional(
        "the metric whose highest mean is sought; without this and minimize, the speed"
    )
    minimize: str = optional("instead: the metric whose lowest mean is sought")
    over: Annotated[list[str], BeforeValidator(_names)] = Field(
        description="varied columns whose best values are sought", json_schema_extra=_LABEL_NAMES
    )
    groups: Annotated[list[str], BeforeValidator(_names)] = optional(
        "varied columns: an answer for each combination of their values; by default all others",
        alias="for",
        **_LABEL_NAMES,
    )
    base: Annotated[dict[str, Value], BeforeValidator(_one_value)] = Field(
        description="a varied column and its value, over which something is gained, such as {spine: none}"
    )
    fresh: Annotated[int, Whole(2, 100_000)] = Field(
        16, description="runs of the best point and its base that chose nothing"
    )
    budget: Annotated[int, Whole(0, LARGEST_SWEEP)] = Field(
        0, description="further runs where the best may be, for each"
    )
    until: Annotated[int, Whole(1, LARGEST_SWEEP)] = Field(
        3, description="no further runs for so few points left"
    )
    explain: str = optional(
        "a randomized parameter: the line of the gains of the fresh pairs over it, and its r²"
    )

    @property
    def metric(self) -> str:
        """What is best."""
        return self.maximize or self.minimize or "speed"

    @property
    def side(self) -> str:
        """Which values of it are better, as `plotting.shown.cost` has it."""
        return "min" if self.minimize else "max"

    def grouped(self, varied: Iterable[str]) -> list[str]:
        """The columns that make groups, of those that vary."""
        return (
            [name for name in varied if name not in (*self.over, *self.base)]
            if self.groups is None
            else self.groups
        )

    def written(self) -> dict[str, Any]:
        """As written in a sweep file."""
        return self.model_dump(by_alias=True, exclude_none=True)


# ---
# What a sweep stores beside its table, as written in a file: time series (`save`) and recordings (`keep`).


#: Maximum number of recorded rows of one kind; each takes about half a megabyte.
MAX_STORED_RUNS: Final = 10_000


class SaveFields(Fields):
    """What is kept of each run over time."""

    what: ClassVar = "a field of what is saved"
    expected: ClassVar = "{sensors: [gyro, foot_force], rate: 50}"
    example: ClassVar = expected
    sensors: Annotated[list[str], BeforeValidator(_listed)] = Field(
        description="signals, sensors or groups of them; qpos, qvel, ctrl, attitude, speed",
        json_schema_extra={"type": ["array", "string"], "minItems": 1},
    )
    rate: Positive = Field(
        Saving.rate,
        description="samples per simulated second [Hz]: the control rate, or that divided by a whole number",
    )


class Keep(Fields):
    """Which rows are recorded when the table is complete: the number of each kind, the best by a metric."""

    what: ClassVar = "a field of what is kept"
    expected: ClassVar = "{best: 3, fell: 3, diverged: 3}"
    best: Annotated[int, Whole(0, MAX_STORED_RUNS)] = Field(
        0, description="number of the best, at most one per variant"
    )
    metric: str = Field(
        "speed", description="by which the best are chosen: one that has a better direction"
    )
    fell: Annotated[int, Whole(0, MAX_STORED_RUNS)] = Field(
        0, description="number that fell, the first in the table"
    )
    diverged: Annotated[int, Whole(0, MAX_STORED_RUNS)] = Field(
        0, description="number that diverged"
    )
    unsolved: Annotated[int, Whole(0, MAX_STORED_RUNS)] = Field(
        0, description="number for which the solver did not converge"
    )
    optimum: bool = Field(
        False, description="a typical fresh run of each best point of the optimum, and its base's"
    )


def read_saving(doc: Document, fields: SaveFields, setup: Setup) -> Saving:
    """What is saved, of signals that the robot has, at a rate that its controller has."""
    if not fields.sensors:
        doc.fail(("save", "sensors"), "is an empty list: name sensors, such as [gyro, foot_force].")
    saving = Saving(tuple(fields.sensors), float(fields.rate))
    try:
        Keeper(saving, setup.load(), setup.make_controller().dt)
    except ParameterError as error:
        field, _, message = str(error).partition(" ")
        doc.fail(("save", field), message)
    return saving


# ---
# The declared fields of a sweep file, also the source of its JSON Schema.


class Sampler(OneOf):
    """Where the variants lie between the values of the axes."""

    expected: ClassVar = "grid, {sobol: N}, {latin_hypercube: N} or {saltelli: N}"
    other: ClassVar = "is not a sampler"
    alone: ClassVar = ("grid",)
    grid: None = optional("every combination of the listed values")
    sobol: Annotated[int, Whole(1, LARGEST_SWEEP)] = optional(
        "number of points of a Sobol sequence"
    )
    latin_hypercube: Annotated[int, Whole(1, LARGEST_SWEEP)] = optional(
        "number of points of the hypercube"
    )
    saltelli: Saltelli = optional(
        "the design for Sobol indices, with this number of points, a power of two"
    )


class Randomized(Fields):
    """Repeats, where bodies are drawn from, and the randomized parameters by name."""

    __pydantic_extra__: dict[str, Draw]
    model_config = ConfigDict(extra="allow", json_schema_extra=also_parameters)
    repeats: Annotated[int, Whole(1, 100_000)] = Field(
        1, description="how often each variant is drawn and run"
    )
    bodies: Annotated[str, BodiesField()] = optional(
        "draw whole bodies: identified, or DIR of an identification", alias="from"
    )
    paired: Annotated[list[str], BeforeValidator(_names)] = Field(
        [],
        description="varied parameters whose values have the same draws in each repeat, so that their runs are pairs",
        json_schema_extra=_LABEL_NAMES,
    )

    @classmethod
    def refuse(cls, key: str) -> None:
        refuse_parameter(key)


# ---
# What no field of a sweep file shows alone: what its structures share, what varies, and what does not go together.


def narrowest(structures: Sequence[Structure]) -> dict[str, Quantity]:
    """Every parameter, with the range that it has in all structures: the time step is one of its bounds."""
    by_timestep = {walk.setup.timestep: walk.parameters for walk in reversed(structures)}
    if len(by_timestep) == 1:
        return structures[0].parameters
    return {
        name: dataclasses.replace(
            declaration,
            low=max(parameters[name].low for parameters in by_timestep.values()),
            high=min(parameters[name].high for parameters in by_timestep.values()),
        )
        for name, declaration in structures[0].parameters.items()
    }


# Long because each pair of fields is checked in its order.
def check_together(doc: Document, sweep: Sweep) -> None:
    """What no field shows alone: a parameter with two sources, or with no effect, and a sweep too large or empty."""
    section = "vary" if sweep.rows is None else "rows"
    varied, randomized = list(sweep.varied), [draw.name for draw in sweep.draws]
    setups = [structure.setup for structure in sweep.structures]
    for walk in sweep.structures:
        check_sources(
            doc,
            walk,
            {section: varied, "randomize": randomized},
            bodies=sweep.body_parameters,
            setups=setups,
        )
    if not (varied or sweep.labelled or sweep.draws or sweep.bodies or sweep.repeats > 1):
        doc.fail(
            ("vary",), "is missing or empty, and nothing is randomized: there is nothing to sweep."
        )
    if not sweep.axes and sweep.sampler not in ("grid", "rows"):
        doc.fail(("sample",), f"is {sweep.sampler}, but 'vary' names no parameter to sample.")
    sides = [name for name, metric in sweep.metrics.items() if metric.better]
    if sweep.keep is not None and sweep.keep.metric not in sides:
        doc.fail(
            ("keep", "metric"),
            f"is '{sweep.keep.metric}': allowed is a metric with a better direction, "
            f"{', '.join(sides)}{did_you_mean(sweep.keep.metric, sides)}",
        )
    if sweep.keep is not None and sweep.keep.optimum and sweep.optimum is None:
        doc.fail(
            ("keep", "optimum"),
            "is true, but the file seeks no optimum: add the section 'optimum'.",
        )
    runs = sweep.variants * sweep.repeats
    if runs > LARGEST_SWEEP:
        doc.fail(
            (section,),
            f"makes {runs:,} runs; allowed are {LARGEST_SWEEP:,}: take fewer values, or a sampler "
            "such as sample: {sobol: 4096}.",
        )
    tried: dict[str, Mapping[str, np.ndarray]] = {
        "randomize": {draw.name: draw.tried() for draw in sweep.draws}
    }
    if sweep.rows is None:
        tried["vary"] = {axis.name: axis.tried(grid=sweep.sampler == "grid") for axis in sweep.axes}
    for setup in {(structure.gait, structure.routing): structure for structure in setups}.values():
        check_reach(doc, setup, sweep.fixed, tried)
    for name in sweep.paired:
        if name not in varied:
            doc.fail(
                ("randomize", "paired"),
                f"names {name!r}, which is no varied parameter{did_you_mean(name, varied)}",
            )
    if sweep.compare is not None:
        check_comparison(doc, sweep, sweep.compare)
    if sweep.optimum is not None:
        check_optimum(doc, sweep, sweep.optimum)
    if (rows := sweep.rows) is None:
        return
    for structure_index, walk in enumerate(sweep.structures):
        structure_values = {
            name: column[rows.structure == structure_index] for name, column in rows.values.items()
        }
        structure_values = {
            name: column
            for name, column in structure_values.items()
            if unread(walk.setup, name) is None
        }
        try:
            walk.setup.check(walk.setup.world(walk.constants | structure_values))
        except ParameterError as error:
            doc.fail(("rows",), f"has values that do not go together: {error}")


def varied_values(sweep: Sweep) -> dict[str, list[Value] | None]:
    """The values of each varied column; None where they are drawn between bounds."""
    values: dict[str, list[Value] | None] = {
        name: list(dict.fromkeys(structure.labels[name] for structure in sweep.structures))
        for name in sweep.labelled
    }
    for axis in sweep.axes:
        values[axis.name] = (
            axis.listed().tolist() if sweep.sampler == "grid" or axis.form == "values" else None
        )
    for name, column in ({} if sweep.rows is None else sweep.rows.values).items():
        values[name] = np.unique(column[~np.isnan(column)]).tolist()
    return values


def not_varied(name: str, allowed: Collection[str]) -> str:
    """What a message says of a column that is not varied."""
    return f"which is not varied{did_you_mean(name, allowed)} Varied: {', '.join(allowed) or 'nothing'}."


def check_comparison(doc: Document, sweep: Sweep, compare: ComparedColumns) -> None:
    """Fail where the section `compare` names what cannot be compared."""
    values = varied_values(sweep)
    for field, name in (("by", compare.by), *(("for", name) for name in compare.groups)):
        if name not in values:
            why = not_varied(name, values)
        elif (allowed_values := values[name]) is None:
            why = "which is drawn between bounds, so that no two variants share a value: list its values."
        elif field == "by" and len(allowed_values) < 2:
            why = "which has one value: there is nothing to compare."
        elif field == "for" and name == compare.by:
            why = "whose values are compared: name other columns."
        else:
            continue
        doc.fail(("compare", field), f"names {name!r}, {why}")
    if compare.base is not None:
        check_base(doc, ("compare", "base"), compare.by, compare.base, values[compare.by] or [])


def check_base(
    doc: Document, path: FieldPath, name: str, base: Value, bases: Sequence[Value]
) -> None:
    """Fail where a base is no value of its column."""
    declaration = FILE_PARAMETERS.get().get(name)
    number = None if declaration is None else declaration.number(str(base))
    close = number is not None and np.isclose(number, np.array(bases, float), 1e-9, 1e-12).any()
    if base not in bases and not close:
        listed = [value if isinstance(value, str) else f"{value:g}" for value in bases]
        allowed = f"{', '.join(listed)}{did_you_mean(str(base), listed)}"
        doc.fail(path, f"is {describe(base)}, no value of {name}; allowed are {allowed}")


def check_optimum(doc: Document, sweep: Sweep, question: SoughtOptimum) -> None:
    """Fail where the section `optimum` asks for what the sweep cannot tell."""
    values, ((by, base),) = varied_values(sweep), question.base.items()
    if question.maximize and question.minimize:
        doc.fail(
            ("optimum", "minimize"), "is given beside 'maximize': one metric is best at a time."
        )
    if question.metric not in sweep.metrics:
        near = did_you_mean(question.metric, sweep.metrics)
        doc.fail(
            ("optimum", "minimize" if question.minimize else "maximize"),
            f"is {question.metric!r}, no metric{near or '.'}",
        )
    for field, name in (
        *(("over", name) for name in question.over),
        *(("for", name) for name in question.groups or ()),
        ("base", by),
    ):
        if name not in values:
            doc.fail(("optimum", field), f"names {name!r}, {not_varied(name, values)}")
        if values[name] is None:
            doc.fail(
                ("optimum", field),
                f"names {name!r}, which is drawn between bounds: points have runs where it is a list.",
            )
        if field == "for" and name in (*question.over, by):
            doc.fail(
                ("optimum", field),
                f"names {name!r}, of which the best value is sought: name other columns.",
            )
    check_base(doc, ("optimum", "base"), by, base, values[by] or [])
    remaining = [
        name for name in values if name not in (*question.over, by, *question.grouped(values))
    ]
    if remaining:
        doc.fail(
            ("optimum", "for"),
            f"leaves out {', '.join(remaining)}, which varies, too: name it under over or for.",
        )
    names = [draw.name for draw in sweep.draws]
    if question.explain is not None and question.explain not in names:
        doc.fail(
            ("optimum", "explain"),
            f"names {question.explain!r}, which is not randomized{did_you_mean(question.explain, names)}",
        )
    unpaired = [name for name in question.over if name not in (*sweep.paired, *sweep.labelled)]
    if question.explain is not None and unpaired:
        doc.fail(
            ("optimum", "explain"),
            f"needs pairs of runs: name {', '.join(unpaired)} under randomize.paired, too.",
        )
    if sweep.repeats < 2:
        doc.fail(
            ("optimum",),
            "needs repeats, because a single run tells no noise: give randomize: {repeats: 4}.",
        )


#: The value of a field that is not given: none cannot be written in a file.
_ABSENT: Any = None
#: Fields that no row depends on.
_NOT_DECISIVE = ("chunk", "plots", "compare", "optimum", "keep")


@dataclasses.dataclass(frozen=True)
class Sweep(WalkSpec, Described):
    """A checked sweep. Build it with `from_file`, `from_text` or `from_dict`.

    The fields from `seed` on are a file's, too: `SweepFile` has them from here.

    Attributes:
        setup, run, fixed, pilot: see `WalkSpec`; where structures vary, those of the first one.
        axes: varied parameters in the order of the file.
        sampler, samples: "grid" or "rows", or a sampler and its number of points.
        draws, repeats: randomized parameters; each variant is drawn and run `repeats` times.
        structures: each combination of the varied structures, at least one; see `Structure`.
        rows: the variants, where they are given one by one.
        bodies: "identified" or the directory of an identification, if each run has a body of its ensemble; else None.
        second_order: whether a design of Saltelli's has the variants for indices of pairs.
        save: which time series are kept, and how often.
        paired: varied parameters that the draws of a repeat do not depend on.
    """

    kind: ClassVar = "sweep"
    axes: tuple[Axis, ...]
    sampler: str
    samples: int
    draws: tuple[Draw, ...]
    repeats: int
    structures: tuple[Structure, ...]
    rows: RowList | None = None
    bodies: str | None = None
    second_order: bool = False
    save: Saving | None = None
    paired: tuple[str, ...] = ()
    seed: Annotated[
        int, Whole(0, 2**53), Field(description="makes samples and draws repeatable")
    ] = 0
    chunk: Annotated[
        int, Whole(1, LARGEST_SWEEP), Field(description="runs simulated and stored together")
    ] = _ABSENT
    plots: Annotated[
        bool, Field(description="whether figures are drawn when the table is complete")
    ] = True
    compare: Annotated[
        ComparedColumns,
        Field(description="structures or values to compare when the table is complete"),
    ] = _ABSENT
    optimum: Annotated[
        SoughtOptimum,
        Field(description="where a metric is best, for which, and against what; with further runs"),
    ] = _ABSENT
    keep: Annotated[
        Keep, Field(description="rows that are recorded when the table is complete")
    ] = _ABSENT

    @classmethod
    def from_rows(
        cls,
        rows: str | os.PathLike[str],
        path: str | os.PathLike[str] | None = None,
        body: str | None = None,
    ) -> Sweep:
        """The variants of a table (see `rows` of a sweep file), with everything else from a sweep file, if given.

        What the file varies is ignored; `body` is that of `from_file`. Raises `SpecError`.
        """
        doc = read_mapping({}) if path is None else read_file(path)
        data = {
            key: value for key, value in doc.data.items() if key not in ("vary", "sample", "rows")
        }
        data |= {"rows": str(Path(rows).resolve())}
        return cls.of_document(with_body(Document(doc.source, data, doc.lines), body))

    @classmethod
    def from_directory(cls, out: str | os.PathLike[str]) -> Sweep:
        """The sweep of a directory; raises `SpecError`."""
        return cls.from_file(Path(out) / "sweep.yaml")

    @classmethod
    def of_document(cls, doc: Document) -> Sweep:
        with known_names(doc):
            doc = written_out(doc)
            file = read(doc, SweepFile)
            for other_section in ("vary", "sample") if file.rows is not None else ():
                if doc.data.get(other_section) not in (None, {}):
                    doc.fail(
                        (other_section,),
                        "is given beside 'rows', which are all variants: leave out one of them.",
                    )
            table = None if file.rows is None else read_row_table(doc, file.rows)
            combinations, structure_of_row = (
                table.combinations()
                if table is not None
                else (combinations_of(doc, file.vary), None)
            )
            walks = read_structures(doc, SweepFile, combinations)
        if table is None:
            check_repeats(doc, combinations, walks)
        different = {tuple(walk.labels.items()): walk for walk in walks}
        structures, parameters = tuple(different.values()), narrowest(walks)
        rows = None
        if table is not None:
            index_of_labels = {labels: label_index for label_index, labels in enumerate(different)}
            label_index = np.array([index_of_labels[tuple(walk.labels.items())] for walk in walks])[
                structure_of_row
            ]
            rows = listed_rows(table, structures, label_index, parameters)
        sampler, samples = file.sample.chosen if rows is None else ("rows", len(rows))
        design = samples if isinstance(samples, Saltelli) else None
        varied, randomized = file.vary.model_extra or {}, file.randomize.model_extra or {}
        axes = [
            read_axis(doc, name, form, parameters[name], grid=sampler == "grid")
            for name, form in varied.items()
        ]
        first = structures[0]
        sweep = cls(
            **{name: getattr(first, name) for name in ("setup", "run", "fixed", "pilot")},
            **{name: getattr(file, name) for name in documented(cls)},
            axes=tuple(axes),
            sampler=sampler,
            samples=(samples if design is None else design.points) or 0,
            second_order=design is not None and design.second_order,
            draws=tuple(
                read_draw(doc, name, form, parameters[name]) for name, form in randomized.items()
            ),
            repeats=file.randomize.repeats,
            structures=structures,
            rows=rows,
            bodies=file.randomize.bodies,
            save=None if file.save is None else read_saving(doc, file.save, first.setup),
            paired=tuple(file.randomize.paired),
        )
        check_together(doc, sweep)
        return (
            sweep
            if sweep.repeats == 1
            else dataclasses.replace(sweep, draws=(*sweep.draws, *start_draws(sweep)))
        )

    def seeking(self, text: str) -> Sweep:
        """The sweep with another section `optimum`, as a file has it, in YAML. Raises `SpecError`."""
        question = read_text(f"optimum: {text}", "--optimum").data["optimum"]
        return Sweep.of_document(read_mapping(self.resolved() | {"optimum": question}, "--optimum"))

    @functools.cached_property
    def counts(self) -> tuple[int, ...]:
        """The number of variants of each structure, before repeats.

        A parameter that a structure does not use is not varied there, so a grid has fewer variants of it.
        """
        if self.rows is not None:
            return tuple(np.bincount(self.rows.structure, minlength=len(self.structures)).tolist())
        if self.sampler == "grid":
            return tuple(
                math.prod(len(axis.listed()) for axis in self.read_axes(structure))
                for structure in self.structures
            )
        points = self.samples * (
            saltelli_size(len(self.axes), self.second_order) if self.sampler == "saltelli" else 1
        )
        return tuple(
            points if self.read_axes(structure) or not self.axes else 1
            for structure in self.structures
        )

    @property
    def variants(self) -> int:
        """The number of variants, before repeats."""
        return sum(self.counts)

    @property
    def varied(self) -> tuple[str, ...]:
        """Names of the varied parameters."""
        return (
            tuple(axis.name for axis in self.axes) if self.rows is None else tuple(self.rows.values)
        )

    @property
    def labelled(self) -> tuple[str, ...]:
        """Names of the varied structures."""
        return tuple(self.structures[0].labels)

    @functools.cached_property
    def is_grid(self) -> bool:
        """Whether the variants are every combination of their values."""
        if self.rows is None:
            return self.sampler == "grid"
        columns = [self.rows.structure, *self.rows.values.values()]
        return math.prod(len(np.unique(column)) for column in columns) == len(self.rows)

    def partly_read(self) -> dict[str, list[Structure]]:
        """The varied parameters that only some of the structures read, and which ones do."""
        readers = {
            name: [
                structure for structure in self.structures if unread(structure.setup, name) is None
            ]
            for name in self.varied
        }
        return {
            name: places for name, places in readers.items() if len(places) < len(self.structures)
        }

    def read_axes(self, structure: Structure) -> list[Axis]:
        """The axes whose parameters a structure reads."""
        return [axis for axis in self.axes if unread(structure.setup, axis.name) is None]

    @property
    def body_parameters(self) -> tuple[str, ...]:
        """Parameters that a run's body decides."""
        return tuple(identified.bodies(self.bodies).values) if self.bodies else ()

    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        data = {
            name: value
            for name, value in self.walk_fields(folder).items()
            if name not in self.labelled
        }
        if len({structure.setup.timestep for structure in self.structures}) > 1:
            del data["timestep"]  # each has that of its physics
        if self.rows is not None:
            data["rows"] = (
                self.rows.written(self.structures) if folder is None else self.kept_rows()[0]
            )
        else:
            data["vary"] = {}
            for name in self.labelled:
                values = {
                    structure.labels[name]: structure.written(name) for structure in self.structures
                }
                data["vary"][name] = {"values": list(values.values())}
            data["vary"] |= {axis.name: axis.written() for axis in self.axes}
            size: Any = (
                {"points": self.samples, "second_order": True}
                if self.second_order
                else self.samples
            )
            data["sample"] = self.sampler if self.sampler == "grid" else {self.sampler: size}
        bodies: dict[str, Any] = {"from": self.bodies} if self.bodies else {}
        explicit = [draw for draw in self.draws if not draw.implied]
        bodies |= {"paired": list(self.paired)} if self.paired else {}
        data["randomize"] = (
            {"repeats": self.repeats} | bodies | {draw.name: draw.written() for draw in explicit}
        )
        data |= {
            name: getattr(self, name)
            for name in ("seed", "chunk", "plots")
            if getattr(self, name) is not None
        }
        if self.compare is not None:
            data["compare"] = self.compare.written()
        if self.optimum is not None:
            data["optimum"] = self.optimum.written()
        if self.save is not None:
            data["save"] = {"sensors": list(self.save.sensors), "rate": float(self.save.rate)}
        return data | ({} if self.keep is None else {"keep": self.keep.model_dump()})

    def kept_rows(self) -> tuple[str, bytes]:
        """Name and content of the file that a directory has of the rows; only where they are given one by one."""
        assert self.rows is not None
        return self.rows.file(self.structures)

    def decisive(self) -> dict[str, Any]:
        """The fields that decide the rows; a controller counts by what it is, and not by where it is."""
        few, listed = self, dict[str, str]()
        if self.rows is not None:  # which may be many
            none = RowList(
                {name: column[:0] for name, column in self.rows.values.items()},
                self.rows.structure[:0],
            )
            few, listed = dataclasses.replace(self, rows=none), {"rows": self.rows.fingerprint}
        data = {key: value for key, value in few.resolved().items() if key not in _NOT_DECISIVE}
        return data | code_identity(self.setup) | listed

    def digest(self) -> str:
        """A hash of all that decides the rows of the table: the sweep, defaults of what it does not name, and bodies.

        Chunking and figures are not included.
        """
        defaults: Any = {name: declaration.default for name, declaration in self.parameters.items()}
        if self.labelled:
            defaults = [
                [structure.setup.defaults(), structure.walk_fields()]
                for structure in self.structures
            ]
        bodies = [identified.bodies(self.bodies).fingerprint] if self.bodies else []
        implied = [{draw.name: draw.numbers for draw in self.draws if draw.implied}]
        return digest_of(self.decisive(), defaults, *bodies, *filter(None, implied))


class SweptFields(WalkFields):
    """What a sweep file has beside the fields that are declared by `Sweep`."""

    what: ClassVar = "a field of a sweep"
    sources: ClassVar = "'vary', 'set' or 'randomize'"
    vary: Vary = Field(Vary.model_validate({}), description="varied structures and parameters")
    rows: Annotated[Any, RowsForm()] = optional(
        "exactly these variants, instead of vary: a table, or a list"
    )
    sample: Sampler = Field(
        Sampler(grid=None), description="grid, or a sampler and its number of variants"
    )
    randomize: Randomized = Field(
        Randomized.model_validate({}), description="what is drawn at random in each run"
    )
    save: SaveFields = optional("time series of some sensors beside the table")


#: A file for `nermo-mjx sweep`.
SweepFile: Final = create_model(
    "SweepFile", __base__=SweptFields, __doc__="A file for `nermo-mjx sweep`.", **documented(Sweep)
)


def start_draws(sweep: Sweep) -> tuple[Draw, ...]:
    """The perturbation of the start that makes repeats differ, for what the file does not place itself.

    The first repeat starts as a single one does, so that more can follow it.
    """
    named = {*sweep.constants, *sweep.varied, *(draw.name for draw in sweep.draws)}
    return tuple(
        Draw.model_validate({"uniform": [-spread, spread]}).of(
            name, sweep.parameters[name], implied=True
        )
        for name, spread in START_SPREAD.items()
        if name not in named
    )


# ---
# The rows of a sweep. They depend on it alone, never on chunks, order or engine.


#: Resolution of the samples of repeats.
_SOBOL_BITS: Final = 52
#: Rows made at once where a column of all rows is wanted.
_COLUMN_BLOCK_ROWS = 65_536


@dataclasses.dataclass(frozen=True)
class Rows:
    """Columns of equal length n, one entry per run.

    Attributes:
        variant: index of the variant, (n,) int.
        repeat: index of the repeat within its variant, (n,) int.
        seed: seed of the row's random draws, (n,) int below 2^53 (exact in JSON).
        values: varied and randomized parameters, name -> (n,) float; NaN where the row's structure does not read one.
        structure: place of the row's structure in the sweep's, (n,) int.
        body: index in the identified ensemble, (n,) int; None if bodies are not drawn.
    """

    variant: np.ndarray
    repeat: np.ndarray
    seed: np.ndarray
    values: dict[str, np.ndarray]
    structure: np.ndarray
    body: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.variant)

    def take(self, index: np.ndarray) -> Rows:
        """The rows at `index`, in that order; a mask will do, too."""
        return Rows(
            variant=self.variant[index],
            repeat=self.repeat[index],
            seed=self.seed[index],
            values={name: column[index] for name, column in self.values.items()},
            structure=self.structure[index],
            body=None if self.body is None else self.body[index],
        )


class Sample:
    """All rows of a sweep, each made on demand; repeats of a variant are adjacent.

    Rows beyond the sweep's own are further repeats of its variants, one repeat of all of them after the other: each has
    its number, whichever are run.

    Structures run slowest. For each of them a grid runs through the product of its axes, the last one fastest. Sobol
    and Latin hypercube points come from `scipy.stats.qmc`, scrambled with the sweep's seed, and are the same for all
    structures. A grid of millions of rows takes no memory; of a sampler, its points do: one number per variant and axis.

    The random parameters of the repeats of a variant, and its body, come from a Sobol sequence: point `i` belongs to
    repeat `i`. Repeats 0 to n - 1 are a Latin hypercube if n is a power of two, as are n repeats that begin at a multiple
    of n, and more repeats do not change the earlier ones. The sequence is scrambled with the sweep's seed, and shifted
    (by bits) at random for each combination of the varied parameters that are not `paired`. The structure does not
    matter: runs of two structures have the same samples and can be compared one by one.
    """

    def __init__(self, sweep: Sweep, shares: np.ndarray | None = None) -> None:
        """
        Args:
            shares: points in the unit cube (variants, axes) instead of the sampler's, as a search asks for them.
        """
        self.sweep = sweep
        self._axes: dict[str, Axis] = {axis.name: axis for axis in sweep.axes}
        self._listed = (
            {axis.name: axis.listed() for axis in sweep.axes} if sweep.sampler == "grid" else {}
        )
        self._ends = np.cumsum(sweep.counts) if shares is None else np.array([len(shares)])
        dimensions, rng = len(sweep.axes), np.random.default_rng(sweep.seed)
        if shares is None and sweep.sampler == "saltelli":
            shares = saltelli_points(dimensions, sweep.samples, sweep.second_order, sweep.seed)
        elif shares is None and sweep.sampler == "latin_hypercube":
            shares = qmc.LatinHypercube(dimensions, rng=rng).random(sweep.samples)
        elif shares is None and sweep.sampler == "sobol":
            # A power of two keeps the sequence balanced; its first points are the sample, and only they are kept.
            exponent = max(sweep.samples - 1, 0).bit_length()
            shares = qmc.Sobol(dimensions, rng=rng).random_base2(exponent)[: sweep.samples].copy()
        self._shares = shares
        self._points = np.empty((0, 0), np.int64)
        self._read = [
            [axis.name for axis in sweep.read_axes(structure)] for structure in sweep.structures
        ]
        self._unread = [
            {
                name
                for name in (*sweep.varied, *(draw.name for draw in sweep.draws))
                if unread(structure.setup, name)
            }
            for structure in sweep.structures
        ]

    def __len__(self) -> int:
        return self.sweep.variants * self.sweep.repeats

    def take(self, index: np.ndarray) -> Rows:
        """The rows at `index`, (n,) int, in that order."""
        sweep, index = self.sweep, np.asarray(index, dtype=np.int64)
        variant, repeat = np.divmod(index, sweep.repeats)
        is_further = index >= int(self._ends[-1]) * sweep.repeats
        repeat[is_further], variant[is_further] = np.divmod(index[is_further], sweep.variants)
        structure = self._structure_of(variant)
        points = {name: self._point(name, variant, structure) for name in sweep.varied}
        names = sorted(name for name in points if name not in sweep.paired)
        table = (
            np.column_stack([points[name] + 0.0 for name in names])
            if names
            else np.empty((len(variant), 0))
        )
        is_set, seed = ~np.isnan(table), np.empty(len(variant), np.int64)
        sample_seed = np.empty(len(variant), np.int64)
        for i, repeat_number in enumerate(repeat.tolist()):
            content = zip(names, table[i].tolist(), is_set[i], strict=True)
            texts = [f"{name} {value!r}" for name, value, is_there in content if is_there]
            seed[i] = _seed_of([f"{sweep.seed} {repeat_number}", *texts])
            sample_seed[i] = _seed_of([f"{sweep.seed}", *texts])
        values = {name: self._masked(name, points[name], structure) for name in sweep.varied}
        body = None
        draw_count = len(sweep.draws) + bool(sweep.bodies)
        if draw_count:
            distinct, stream = np.unique(sample_seed, return_inverse=True)
            shifts = [
                np.random.default_rng(number).integers(1 << _SOBOL_BITS, size=draw_count)
                for number in distinct.tolist()
            ]
            shift = np.reshape(shifts, (len(distinct), draw_count))[stream]
            sobol_points = self._sobol_points(int(repeat.max(initial=0)) + 1)[repeat, :draw_count]
            columns = ((sobol_points ^ shift) / (1 << _SOBOL_BITS)).T
            for draw, column in zip(sweep.draws, columns, strict=False):
                value = (
                    np.where(repeat == 0, 0.0, draw.at(column)) if draw.implied else draw.at(column)
                )
                values[draw.name] = self._masked(draw.name, value, structure)
            if sweep.bodies:  # after the others, which are the same with and without it
                ensemble = identified.bodies(sweep.bodies)
                body = ensemble.at(columns[-1])
                values |= ensemble.take(body)
        return Rows(variant, repeat, seed, values, structure, body)

    def _sobol_points(self, count: int) -> np.ndarray:
        """At least `count` points for repeats, (points, draws and body) int: shares times 2^`_SOBOL_BITS`."""
        if len(self._points) < count:
            sweep = self.sweep
            # With or without a body, the other samples are the same.
            sequence = qmc.Sobol(
                len(sweep.draws) + 1, bits=_SOBOL_BITS, rng=np.random.default_rng(sweep.seed)
            )
            shares = sequence.random_base2((count - 1).bit_length())
            self._points = np.round(shares * (1 << _SOBOL_BITS)).astype(np.int64)
        return self._points

    def column(self, name: str) -> np.ndarray:
        """One varied or randomized parameter of all rows, (rows,)."""
        result = np.empty(len(self))
        for start in range(0, len(self), _COLUMN_BLOCK_ROWS):
            index = np.arange(start, min(start + _COLUMN_BLOCK_ROWS, len(self)))
            if name in self.sweep.varied:  # the others cost a random generator a row
                variant = index // self.sweep.repeats
                structure = self._structure_of(variant)
                result[index] = self._masked(name, self._point(name, variant, structure), structure)
            else:
                result[index] = self.take(index).values[name]
        return result

    def structures(self) -> np.ndarray:
        """Place of the structure of each row in the sweep's, (rows,) int."""
        if len(self._ends) == 1:
            return np.zeros(len(self), int)
        return self._structure_of(np.arange(len(self)) // self.sweep.repeats)

    def _structure_of(self, variant: np.ndarray) -> np.ndarray:
        if self.sweep.rows is not None:
            return self.sweep.rows.structure[variant]
        return np.searchsorted(self._ends, variant, side="right")

    def _point(self, name: str, variant: np.ndarray, structure: np.ndarray) -> np.ndarray:
        """A varied parameter where the variants are, NaN where the grid has no such axis for a structure."""
        if self.sweep.rows is not None:
            return self.sweep.rows.values[name][variant]
        local = variant - np.concatenate([[0], self._ends])[structure]
        if self._shares is not None:
            return self._axes[name].at(self._shares[local, list(self._axes).index(name)])
        result = np.full(len(variant), np.nan)
        for structure_index in np.unique(structure):
            names, in_structure = self._read[structure_index], structure == structure_index
            if name in names:
                places = np.unravel_index(
                    local[in_structure], [len(self._listed[axis_name]) for axis_name in names]
                )
                result[in_structure] = self._listed[name][places[names.index(name)]]
        return result

    def _masked(self, name: str, values: np.ndarray, structure: np.ndarray) -> np.ndarray:
        """Values, NaN where nothing reads them."""
        blind = [
            structure_index for structure_index, names in enumerate(self._unread) if name in names
        ]
        return np.where(np.isin(structure, blind), np.nan, values) if blind else values


def _seed_of(texts: Sequence[str]) -> int:
    """A seed below 2^53 that depends on all texts."""
    digest = hashlib.blake2b(" ".join(texts).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 11


def sample(sweep: Sweep) -> Rows:
    """All rows of a sweep at once; see `Sample`."""
    rows = Sample(sweep)
    return rows.take(np.arange(len(rows)))
