"""What a sweep is: the checked content of a sweep file. Everything wrong with it is said here, before work begins."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Mapping
from typing import Any

from nermo_mjx.robot import identified
from nermo_mjx.rollout import all_parameters
from nermo_mjx.sweep import sections
from nermo_mjx.sweep.axes import Axis, Draw
from nermo_mjx.sweep.reading import Document, describe, dump, nearest, read_file, read_mapping, read_text
from nermo_mjx.sweep.sections import SETUP_FIELDS
from nermo_mjx.sweep.walk_spec import WalkSpec, check_sources
from nermo_mjx.sweep.workspace import check_workspace

#: Half-widths of the start's perturbation that makes repeats differ: a millimetre, a degree, a fiftieth of a cycle.
START_SPREAD = {"start.x": 1e-3, "start.y": 1e-3, "start.yaw": math.radians(1.0), "start.phase": 0.02}
LARGEST_SWEEP = 10_000_000

_FIELDS = (*SETUP_FIELDS, "pilot", "run", "set", "vary", "sample", "randomize", "seed", "chunk", "plots")


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

    def resolved(self) -> dict[str, Any]:
        """The sweep with all defaults written out; it reads back as the same sweep."""
        data = self.walk_fields()
        data["vary"] = {axis.name: axis.written() for axis in self.axes}
        data["sample"] = self.sampler if self.sampler == "grid" else {self.sampler: self.samples}
        bodies = {"from": self.bodies} if self.bodies else {}
        data["randomize"] = {"repeats": self.repeats} | bodies | {draw.name: draw.written() for draw in self.draws}
        data["seed"] = self.seed
        if self.chunk is not None:
            data["chunk"] = self.chunk
        data["plots"] = self.plots
        return data

    def to_yaml(self) -> str:
        """The resolved sweep as a sweep file."""
        return dump(self.resolved())

    def digest(self) -> str:
        """A hash of all that decides the rows of the table: the sweep, defaults of what it does not name, and bodies.

        How rows are cut into chunks, and whether figures are drawn, does not count.
        """
        rows = {key: value for key, value in self.resolved().items() if key not in ("chunk", "plots")}
        defaults = {name: about.default for name, about in self.parameters.items()}
        bodies = [identified.bodies().fingerprint] if self.bodies else []
        return hashlib.sha256(json.dumps([rows, defaults, *bodies]).encode()).hexdigest()[:16]


def _read(doc: Document) -> Sweep:
    data = doc.data
    setup, pilot = sections.read_setup(doc)
    parameters = all_parameters(setup)
    for key in data:
        if key in parameters and key not in _FIELDS:
            doc.fail((key,), "is a parameter, not a field of a sweep: put it under 'vary', 'set' or 'randomize'.")
        if key not in _FIELDS:
            doc.fail((key,), f"is not a field of a sweep; allowed are {', '.join(_FIELDS)}{nearest(key, _FIELDS)}")
    sampler, samples = sections.read_sampler(doc)
    repeats, bodies, draws = sections.read_draws(doc, parameters)
    if not isinstance(data.get("plots", True), bool):
        doc.fail(("plots",), f"is {describe(data['plots'])}: expected true or false.")
    sweep = Sweep(
        setup=setup,
        run=sections.read_run(doc, pilot),
        fixed=sections.read_fixed(doc, parameters),
        pilot=pilot,
        axes=sections.read_axes(doc, parameters, grid=sampler == "grid"),
        sampler=sampler,
        samples=samples,
        draws=draws,
        repeats=repeats,
        bodies=bodies,
        seed=sections.read_whole(doc, ("seed",), 0, 2**53) if "seed" in data else 0,
        chunk=sections.read_whole(doc, ("chunk",), 1, LARGEST_SWEEP) if "chunk" in data else None,
        plots=data.get("plots", True),
    )
    _check_together(doc, sweep)
    return sweep if repeats == 1 else dataclasses.replace(sweep, draws=(*draws, *_start_draws(sweep)))


def _check_together(doc: Document, sweep: Sweep) -> None:
    """What no field shows alone: a parameter with two sources, or with no effect, and a sweep too large or empty."""
    varied, drawn = [axis.name for axis in sweep.axes], [draw.name for draw in sweep.draws]
    check_sources(doc, sweep, {"vary": varied, "randomize": drawn}, bodies=sweep.body_parameters)
    if not sweep.axes and not sweep.draws and not sweep.bodies and sweep.repeats == 1:
        doc.fail(("vary",), "is missing or empty, and nothing is randomized: there is nothing to sweep.")
    if not sweep.axes and sweep.sampler != "grid":
        doc.fail(("sample",), f"is {sweep.sampler}, but 'vary' names no parameter to sample.")
    rows = sweep.variants * sweep.repeats
    if rows > LARGEST_SWEEP:
        doc.fail(("vary",), f"makes {rows:,} runs; allowed are {LARGEST_SWEEP:,}: take fewer values, or a sampler such "
                            "as sample: {sobol: 4096}.")  # fmt: skip
    entries: dict[str, tuple[Axis | Draw, ...]] = {"vary": sweep.axes, "randomize": sweep.draws}
    check_workspace(doc, sweep.setup, sweep.fixed, entries, grid=sweep.sampler == "grid")


def _start_draws(sweep: Sweep) -> tuple[Draw, ...]:
    """The perturbation of the start that makes repeats differ, for what the file does not place itself."""
    named = {*sweep.constants, *(axis.name for axis in sweep.axes), *(draw.name for draw in sweep.draws)}
    return tuple(
        Draw(name, "uniform", (-spread, spread), sweep.parameters[name].low, sweep.parameters[name].high)
        for name, spread in START_SPREAD.items()
        if name not in named
    )
