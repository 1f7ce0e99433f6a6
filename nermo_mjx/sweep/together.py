"""What no field of a sweep file shows alone: what its structures share, what varies, and what does not go together."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.specs.reading import Document
from nermo_mjx.specs.unread import unread
from nermo_mjx.specs.walk import check_sources
from nermo_mjx.specs.workspace import check_workspace
from nermo_mjx.sweep.asked import Value
from nermo_mjx.sweep.beside import check_keep
from nermo_mjx.sweep.file import LARGEST_SWEEP
from nermo_mjx.sweep.listing import RowList
from nermo_mjx.sweep.structures import Structure

if TYPE_CHECKING:
    from nermo_mjx.sweep.spec import Sweep


def narrowest(structures: Sequence[Structure]) -> dict[str, Quantity]:
    """Every parameter, with the range that it has in all structures: the time step is one of its bounds."""
    each = {walk.setup.timestep: walk.parameters for walk in reversed(structures)}
    if len(each) == 1:
        return structures[0].parameters
    return {
        name: dataclasses.replace(about, low=max(other[name].low for other in each.values()),
                                  high=min(other[name].high for other in each.values()))
        for name, about in structures[0].parameters.items()
    }  # fmt: skip


def values_of(sweep: Sweep) -> dict[str, list[Value] | None]:
    """The values of each varied column; None where they are drawn between bounds."""
    values: dict[str, list[Value] | None] = {
        name: list(dict.fromkeys(each.labels[name] for each in sweep.structures)) for name in sweep.labelled
    }
    for axis in sweep.axes:
        values[axis.name] = axis.values().tolist() if sweep.sampler == "grid" or axis.form == "values" else None
    rows = {} if sweep.rows is None else sweep.rows.values
    return values | {name: np.unique(column[~np.isnan(column)]).tolist() for name, column in rows.items()}


def check_together(doc: Document, sweep: Sweep) -> None:
    """What no field shows alone: a parameter with two sources, or with no effect, and a sweep too large or empty."""
    section = "vary" if sweep.rows is None else "rows"
    varied, drawn = list(sweep.varied), [draw.name for draw in sweep.draws]
    setups = [each.setup for each in sweep.structures]
    for walk in sweep.structures:
        check_sources(doc, walk, {section: varied, "randomize": drawn}, bodies=sweep.body_parameters, setups=setups)
    if not (varied or sweep.labelled or sweep.draws or sweep.bodies or sweep.repeats > 1):
        doc.fail(("vary",), "is missing or empty, and nothing is randomized: there is nothing to sweep.")
    if not sweep.axes and sweep.sampler not in ("grid", "rows"):
        doc.fail(("sample",), f"is {sweep.sampler}, but 'vary' names no parameter to sample.")
    check_keep(doc, sweep.keep, sweep.metrics)
    rows = sweep.variants * sweep.repeats
    if rows > LARGEST_SWEEP:
        doc.fail((section,), f"makes {rows:,} runs; allowed are {LARGEST_SWEEP:,}: take fewer values, or a sampler "
                             "such as sample: {sobol: 4096}.")  # fmt: skip
    tried: dict[str, Mapping[str, np.ndarray]] = {"randomize": {draw.name: draw.tried() for draw in sweep.draws}}
    if sweep.rows is None:
        tried["vary"] = {axis.name: axis.tried(grid=sweep.sampler == "grid") for axis in sweep.axes}
    for setup in {(each.gait, each.routing): each for each in setups}.values():
        check_workspace(doc, setup, sweep.fixed, tried)
    if sweep.rows is not None:
        _check_rows(doc, sweep, sweep.rows)


def _check_rows(doc: Document, sweep: Sweep, rows: RowList) -> None:
    """Fail where the values of a row do not go together."""
    for at, walk in enumerate(sweep.structures):
        values = {name: column[rows.structure == at] for name, column in rows.values.items()
                  if unread(walk.setup, name) is None}  # fmt: skip
        try:
            walk.setup.check(walk.setup.world(walk.constants | values))
        except ParameterError as error:
            doc.fail(("rows",), f"has values that do not go together: {error}")
