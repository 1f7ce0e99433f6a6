"""What a sweep is: the checked content of a sweep file. All errors in it are reported here, before work begins."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nermo_mjx.robot import identified
from nermo_mjx.rollout import Saving
from nermo_mjx.rollout.start import START_SPREAD
from nermo_mjx.specs.controllers import code_identity, known_names
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import read
from nermo_mjx.specs.patterns import written_out
from nermo_mjx.specs.reading import Document, read_file, read_mapping
from nermo_mjx.specs.unread import unread
from nermo_mjx.specs.walk import WalkSpec
from nermo_mjx.sweep.asked import AskedComparison, read_comparison
from nermo_mjx.sweep.axes import Axis, Draw, read_axis, read_draw
from nermo_mjx.sweep.beside import Keep, read_saving
from nermo_mjx.sweep.file import SweepFile
from nermo_mjx.sweep.listing import RowList, listed_rows
from nermo_mjx.sweep.row_tables import RowTable, read_row_table
from nermo_mjx.sweep.saltelli import Saltelli, saltelli_size
from nermo_mjx.sweep.structures import Structure, check_repeats, combinations_of, read_structures
from nermo_mjx.sweep.together import check_together, narrowest, values_of

#: Fields that no row depends on.
_NOT_DECISIVE = ("chunk", "plots", "compare", "keep")


@dataclasses.dataclass(frozen=True)
class Sweep(WalkSpec, Described):
    """A checked sweep. Build it with `from_file`, `from_text` or `from_dict`.

    Attributes:
        setup, run, fixed, pilot: see `WalkSpec`; where structures vary, those of the first one.
        axes: varied parameters in the order of the file.
        sampler, samples: "grid" or "rows", or a sampler and its number of points.
        second_order: whether a design of Saltelli's has the variants for indices of pairs.
        draws, repeats: randomized parameters; each variant is drawn and run `repeats` times.
        structures: each combination of the varied structures, at least one; see `Structure`.
        rows: the variants, where they are given one by one.
        bodies: "identified", if each run has a body of that ensemble; else None.
        seed: makes samples and draws repeatable.
        chunk: rows run and stored together; None lets the runner choose.
        plots: whether figures are drawn when the table is complete.
        comparison: what is compared when it is; None if nothing is.
        save: which time series are kept beside the table, if any.
        keep: which rows are recorded when the table is complete, if any.
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
    seed: int = 0
    chunk: int | None = None
    second_order: bool = False
    plots: bool = True
    comparison: AskedComparison | None = None
    save: Saving | None = None
    keep: Keep | None = None

    @classmethod
    def from_rows(cls, rows: str | os.PathLike[str], path: str | os.PathLike[str] | None = None) -> Sweep:
        """The variants of a table (see `rows` of a sweep file), with everything else from a sweep file, if given.

        What the file varies is ignored. Raises `SpecError`.
        """
        doc = read_mapping({}) if path is None else read_file(path)
        data = {key: value for key, value in doc.data.items() if key not in ("vary", "sample", "rows")}
        return cls.of_document(Document(doc.source, data | {"rows": str(Path(rows).resolve())}, doc.lines))

    @classmethod
    def from_directory(cls, out: str | os.PathLike[str]) -> Sweep:
        """The sweep of a directory; raises `SpecError`."""
        return cls.from_file(Path(out) / "sweep.yaml")

    @classmethod
    def of_document(cls, doc: Document) -> Sweep:
        return _read(doc)

    @functools.cached_property
    def counts(self) -> tuple[int, ...]:
        """The number of variants of each structure, before repeats.

        A parameter that a structure does not use is not varied there, so a grid has fewer variants of it.
        """
        if self.rows is not None:
            return tuple(np.bincount(self.rows.structure, minlength=len(self.structures)).tolist())
        if self.sampler == "grid":
            return tuple(math.prod(len(axis.values()) for axis in self.read_axes(at)) for at in self.structures)
        points = self.samples * (saltelli_size(len(self.axes), self.second_order) if self.sampler == "saltelli" else 1)
        return tuple(points if self.read_axes(at) or not self.axes else 1 for at in self.structures)

    @property
    def variants(self) -> int:
        """The number of variants, before repeats."""
        return sum(self.counts)

    @property
    def varied(self) -> tuple[str, ...]:
        """Names of the varied parameters."""
        return tuple(axis.name for axis in self.axes) if self.rows is None else tuple(self.rows.values)

    @property
    def labelled(self) -> tuple[str, ...]:
        """Names of the varied structures."""
        return tuple(self.structures[0].labels)

    @functools.cached_property
    def is_grid(self) -> bool:
        """Whether the variants are every combination of their values."""
        return self.sampler == "grid" if self.rows is None else self.rows.is_product()

    def partly_read(self) -> dict[str, list[Structure]]:
        """The varied parameters that only some of the structures read, and which ones do."""
        read = {name: [at for at in self.structures if unread(at.setup, name) is None] for name in self.varied}
        return {name: places for name, places in read.items() if len(places) < len(self.structures)}

    def read_axes(self, structure: Structure) -> list[Axis]:
        """The axes whose parameters a structure reads."""
        return [axis for axis in self.axes if unread(structure.setup, axis.name) is None]

    @property
    def body_parameters(self) -> tuple[str, ...]:
        """Parameters that a run's body decides."""
        return tuple(identified.bodies().values) if self.bodies else ()

    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        data = {name: value for name, value in self.walk_fields(folder).items() if name not in self.labelled}
        if len({each.setup.timestep for each in self.structures}) > 1:
            del data["timestep"]  # each has that of its physics
        if self.rows is not None:
            data["rows"] = self.rows.written(self.structures) if folder is None else self.kept_rows()[0]
        else:
            data["vary"] = {}
            for name in self.labelled:
                values = {each.labels[name]: each.written(name) for each in self.structures}
                data["vary"][name] = {"values": list(values.values())}
            data["vary"] |= {axis.name: axis.written() for axis in self.axes}
            size: Any = {"points": self.samples, "second_order": True} if self.second_order else self.samples
            data["sample"] = self.sampler if self.sampler == "grid" else {self.sampler: size}
        bodies = {"from": self.bodies} if self.bodies else {}
        named = [draw for draw in self.draws if not draw.implied]
        data["randomize"] = {"repeats": self.repeats} | bodies | {draw.name: draw.written() for draw in named}
        data["seed"] = self.seed
        if self.chunk is not None:
            data["chunk"] = self.chunk
        data["plots"] = self.plots
        if self.comparison is not None:
            data["compare"] = self.comparison.written()
        if self.save is not None:
            data["save"] = {"sensors": list(self.save.sensors), "rate": float(self.save.rate)}
        if self.keep is not None:
            data["keep"] = dataclasses.asdict(self.keep)
        return data

    def kept_rows(self) -> tuple[str, bytes]:
        """Name and content of the file that a directory has of the rows; only where they are given one by one."""
        assert self.rows is not None
        return self.rows.file(self.structures)

    def decisive(self) -> dict[str, Any]:
        """The fields that decide the rows; a controller counts by what it is, and not by where it is."""
        first = self.rows.fingerprint if self.rows is not None else None
        data = {key: value for key, value in (self if first is None else _few(self)).resolved().items()
                if key not in _NOT_DECISIVE}  # fmt: skip
        return data | code_identity(self.setup) | ({} if first is None else {"rows": first})

    def digest(self) -> str:
        """A hash of all that decides the rows of the table: the sweep, defaults of what it does not name, and bodies.

        Chunking and figures are not included.
        """
        defaults: Any = {name: about.default for name, about in self.parameters.items()}
        if self.labelled:
            defaults = [[each.setup.defaults(), each.walk_fields()] for each in self.structures]
        bodies = [identified.bodies().fingerprint] if self.bodies else []
        implied = [{draw.name: draw.numbers for draw in self.draws if draw.implied}]
        return digest_of(self.decisive(), defaults, *bodies, *filter(None, implied))


def _few(sweep: Sweep) -> Sweep:
    """The sweep without its rows, which may be many."""
    assert sweep.rows is not None
    none = RowList({name: column[:0] for name, column in sweep.rows.values.items()}, sweep.rows.structure[:0])
    return dataclasses.replace(sweep, rows=none)


def _read(doc: Document) -> Sweep:
    with known_names(doc):
        doc = written_out(doc)
        file = read(doc, SweepFile)
        table = _row_table(doc, file)
        chosen, which = table.combinations() if table is not None else (combinations_of(doc, file.vary), None)
        found = read_structures(doc, SweepFile, chosen)
    if table is None:
        check_repeats(doc, chosen, found)
    different = {tuple(each.labels.items()): each for each in found}
    structures, parameters = tuple(different.values()), narrowest(found)
    rows = None
    if table is not None:
        place = {labels: at for at, labels in enumerate(different)}
        at = np.array([place[tuple(each.labels.items())] for each in found])[which]
        rows = listed_rows(table, structures, at, parameters)
    sampler, samples = file.sample.chosen if rows is None else ("rows", len(rows))
    design = samples if isinstance(samples, Saltelli) else None
    varied = file.vary.model_extra or {}
    axes = [read_axis(doc, name, form, parameters[name], grid=sampler == "grid") for name, form in varied.items()]
    drawn = file.randomize.model_extra or {}
    first = structures[0]
    sweep = Sweep(
        setup=first.setup,
        run=first.run,
        fixed=first.fixed,
        pilot=first.pilot,
        axes=tuple(axes),
        sampler=sampler,
        samples=(samples if design is None else design.points) or 0,
        second_order=design is not None and design.second_order,
        draws=tuple(read_draw(doc, name, form, parameters[name]) for name, form in drawn.items()),
        repeats=file.randomize.repeats,
        structures=structures,
        rows=rows,
        bodies=file.randomize.bodies,
        seed=file.seed,
        chunk=file.chunk,
        plots=file.plots,
        save=read_saving(doc, file.save, first.setup),
        keep=None if file.keep is None else Keep(**file.keep.model_dump()),
    )
    check_together(doc, sweep)
    sweep = dataclasses.replace(sweep, comparison=read_comparison(doc, file.compare, values_of(sweep)))
    return sweep if sweep.repeats == 1 else dataclasses.replace(sweep, draws=(*sweep.draws, *start_draws(sweep)))


def _row_table(doc: Document, file: SweepFile) -> RowTable | None:
    """The table of `rows`, if that is given."""
    if file.rows is None:
        return None
    for other in ("vary", "sample"):
        if doc.data.get(other) not in (None, {}):
            doc.fail((other,), "is given beside 'rows', which are all variants: leave out one of them.")
    return read_row_table(doc, file.rows)


def start_draws(sweep: Sweep) -> tuple[Draw, ...]:
    """The perturbation of the start that makes repeats differ, for what the file does not place itself.

    The first repeat starts as a single one does, so that more can follow it.
    """
    named = {*sweep.constants, *sweep.varied, *(draw.name for draw in sweep.draws)}
    return tuple(
        Draw(name, "uniform", (-spread, spread), sweep.parameters[name].low, sweep.parameters[name].high, True)
        for name, spread in START_SPREAD.items()
        if name not in named
    )
