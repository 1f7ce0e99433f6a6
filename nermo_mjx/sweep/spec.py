"""What a sweep is: the checked content of a sweep file. Everything wrong with it is said here, before work begins."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import ConfigDict, Field

from nermo_mjx.robot import identified
from nermo_mjx.rollout import Saving, all_parameters
from nermo_mjx.rollout.start import START_SPREAD
from nermo_mjx.specs.controllers import controller_identity, parameters_of
from nermo_mjx.specs.fields import Fields, OneOf, optional, read
from nermo_mjx.specs.reading import Document, dump, read_file, read_mapping, read_text
from nermo_mjx.specs.values import ByParameter, Choice, Whole, by_parameter, refuse_parameter
from nermo_mjx.specs.walk import WalkFields, WalkSpec, check_sources, read_walk
from nermo_mjx.specs.workspace import check_workspace
from nermo_mjx.sweep.axes import Axis, AxisForm, Draw, DrawForm, read_axis, read_draw
from nermo_mjx.sweep.beside import Keep, KeepFields, SaveFields, check_keep, read_saving

LARGEST_SWEEP = 10_000_000


class Sampler(OneOf):
    """Where the variants lie between the values of the axes."""

    expected: ClassVar = "grid, {sobol: N} or {latin_hypercube: N}"
    other: ClassVar = "is not a sampler"
    alone: ClassVar = ("grid",)
    short: ClassVar = ({"enum": [*alone]},)
    grid: None = optional("every combination of the listed values")
    sobol: Annotated[int, Whole(1, LARGEST_SWEEP)] = optional("so many points of a Sobol sequence")
    latin_hypercube: Annotated[int, Whole(1, LARGEST_SWEEP)] = optional("so many points of one")


def _list_parameters(schema: dict[str, Any]) -> None:
    """Tell an editor the names of what is randomized, beside the fields."""
    listed = by_parameter(schema.pop("additionalProperties"))
    schema["properties"] |= listed["properties"]
    schema["additionalProperties"] = False


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
    vary: Annotated[dict[str, AxisForm], ByParameter()] = Field({}, description="varied parameters")
    sample: Sampler = Field(Sampler(grid=None), description="grid, or a sampler and its number of variants")
    randomize: Randomized = Field(Randomized.model_validate({}), description="what is left to chance in each run")
    seed: Annotated[int, Whole(0, 2**53)] = Field(0, description="makes samples and draws repeatable")
    chunk: Annotated[int, Whole(1, LARGEST_SWEEP)] = optional("runs simulated and stored together")
    plots: bool = Field(True, description="whether figures are drawn when the table is complete")
    save: SaveFields = optional("time series of some sensors beside the table")
    keep: KeepFields = optional("rows that are recorded when the table is complete")


@dataclasses.dataclass(frozen=True)
class Sweep(WalkSpec):
    """A checked sweep. Build it with `from_file`, `from_text` or `from_dict`.

    Attributes:
        setup, run, fixed, pilot: see `WalkSpec`.
        axes: varied parameters in the order of the file.
        sampler, samples: "grid", or a sampler and its number of variants.
        draws, repeats: randomized parameters; each variant is drawn and run `repeats` times.
        bodies: "identified", if each run has a body of that ensemble; else None.
        seed: makes samples and draws repeatable.
        chunk: rows run and stored together; None lets the runner choose.
        plots: whether figures are drawn when the table is complete.
        save: which time series are kept beside the table, if any are.
        keep: which rows are recorded when the table is complete, if any are.
    """

    axes: tuple[Axis, ...]
    sampler: str
    samples: int
    draws: tuple[Draw, ...]
    repeats: int
    bodies: str | None = None
    seed: int = 0
    chunk: int | None = None
    plots: bool = True
    save: Saving | None = None
    keep: Keep | None = None

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Sweep:
        """Read a YAML sweep file; raises `SpecError`."""
        return _read(read_file(path))

    @classmethod
    def from_text(cls, text: str, source: str = "sweep") -> Sweep:
        """Read YAML text; `source` is what messages call it. Raises `SpecError`."""
        return _read(read_text(text, source))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Sweep:
        """Read a dict with the fields of a sweep file; raises `SpecError`."""
        return _read(read_mapping(data))

    @property
    def variants(self) -> int:
        """The number of variants, before repeats."""
        return math.prod(len(axis.values()) for axis in self.axes) if self.sampler == "grid" else self.samples

    @property
    def body_parameters(self) -> tuple[str, ...]:
        """Parameters that a run's body decides."""
        return tuple(identified.bodies().values) if self.bodies else ()

    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        """The sweep with all defaults written out; it reads back as the same sweep.

        Args:
            folder: see `walk_fields`.
        """
        data = self.walk_fields(folder)
        data["vary"] = {axis.name: axis.written() for axis in self.axes}
        data["sample"] = self.sampler if self.sampler == "grid" else {self.sampler: self.samples}
        bodies = {"from": self.bodies} if self.bodies else {}
        data["randomize"] = {"repeats": self.repeats} | bodies | {draw.name: draw.written() for draw in self.draws}
        data["seed"] = self.seed
        if self.chunk is not None:
            data["chunk"] = self.chunk
        data["plots"] = self.plots
        if self.save is not None:
            data["save"] = {"sensors": list(self.save.sensors), "rate": float(self.save.rate)}
        if self.keep is not None:
            data["keep"] = dataclasses.asdict(self.keep)
        return data

    def to_yaml(self, folder: Path | None = None) -> str:
        """The resolved sweep as a sweep file, see `resolved`."""
        return dump(self.resolved(folder))

    def decisive(self) -> dict[str, Any]:
        """The fields that decide the rows; a controller counts by what it is, and not by where it is."""
        data = {key: value for key, value in self.resolved().items() if key not in ("chunk", "plots", "keep")}
        return data | controller_identity(self.setup)

    def digest(self) -> str:
        """A hash of all that decides the rows of the table: the sweep, defaults of what it does not name, and bodies.

        How rows are cut into chunks, and whether figures are drawn, does not count.
        """
        defaults = {name: about.default for name, about in self.parameters.items()}
        bodies = [identified.bodies().fingerprint] if self.bodies else []
        return hashlib.sha256(json.dumps([self.decisive(), defaults, *bodies]).encode()).hexdigest()[:16]


def _read(doc: Document) -> Sweep:
    with parameters_of(doc):
        file = read(doc, SweepFile)
    walk = read_walk(doc, file)
    parameters = all_parameters(walk["setup"])
    sampler, samples = file.sample.chosen
    axes = [read_axis(doc, name, form, parameters[name], grid=sampler == "grid") for name, form in file.vary.items()]
    drawn = file.randomize.model_extra or {}
    sweep = Sweep(
        **walk,
        axes=tuple(axes),
        sampler=sampler,
        samples=samples or 0,
        draws=tuple(read_draw(doc, name, form, parameters[name]) for name, form in drawn.items()),
        repeats=file.randomize.repeats,
        bodies=file.randomize.bodies,
        seed=file.seed,
        chunk=file.chunk,
        plots=file.plots,
        save=read_saving(doc, file.save, walk["setup"]),
        keep=None if file.keep is None else Keep(**file.keep.model_dump()),
    )
    _check_together(doc, sweep)
    return sweep if sweep.repeats == 1 else dataclasses.replace(sweep, draws=(*sweep.draws, *_start_draws(sweep)))


def _check_together(doc: Document, sweep: Sweep) -> None:
    """What no field shows alone: a parameter with two sources, or with no effect, and a sweep too large or empty."""
    varied, drawn = [axis.name for axis in sweep.axes], [draw.name for draw in sweep.draws]
    check_sources(doc, sweep, {"vary": varied, "randomize": drawn}, bodies=sweep.body_parameters)
    if not sweep.axes and not sweep.draws and not sweep.bodies and sweep.repeats == 1:
        doc.fail(("vary",), "is missing or empty, and nothing is randomized: there is nothing to sweep.")
    if not sweep.axes and sweep.sampler != "grid":
        doc.fail(("sample",), f"is {sweep.sampler}, but 'vary' names no parameter to sample.")
    check_keep(doc, sweep.keep, sweep.metrics)
    rows = sweep.variants * sweep.repeats
    if rows > LARGEST_SWEEP:
        doc.fail(("vary",), f"makes {rows:,} runs; allowed are {LARGEST_SWEEP:,}: take fewer values, or a sampler such "
                            "as sample: {sobol: 4096}.")  # fmt: skip
    tried = {"vary": {axis.name: axis.tried(grid=sweep.sampler == "grid") for axis in sweep.axes},
             "randomize": {draw.name: draw.tried() for draw in sweep.draws}}  # fmt: skip
    check_workspace(doc, sweep.setup, sweep.fixed, tried)


def _start_draws(sweep: Sweep) -> tuple[Draw, ...]:
    """The perturbation of the start that makes repeats differ, for what the file does not place itself."""
    named = {*sweep.constants, *(axis.name for axis in sweep.axes), *(draw.name for draw in sweep.draws)}
    return tuple(
        Draw(name, "uniform", (-spread, spread), sweep.parameters[name].low, sweep.parameters[name].high)
        for name, spread in START_SPREAD.items()
        if name not in named
    )
