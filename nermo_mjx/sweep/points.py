"""The points of a figure of variants: the mean of each variant's runs, or single runs if nothing is varied."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from nermo_mjx.plotting.shown import ShownValues, shown
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.sides import sides_in
from nermo_mjx.sweep.summary import Variants
from nermo_mjx.sweep.table import columns_of, meta


@dataclasses.dataclass(frozen=True)
class Points:
    """Points of a table, with some of its metrics.

    Attributes:
        results: the table.
        parameters: names of what tells the points apart: the varied parameters, or else the randomized ones.
        rows: a row of each point, (n,), which has its parameters.
        metrics: name -> (n,), as shown; NaN where no run had the number.
        runs: how many runs succeeded.
    """

    results: Results
    parameters: tuple[str, ...]
    rows: np.ndarray
    metrics: dict[str, ShownValues]
    runs: int

    def of(self, names: Sequence[str], chosen: np.ndarray) -> list[ShownValues]:
        """Columns of the chosen points, as shown; only those columns are read, and only those points kept."""
        rows = self.rows[chosen]
        return [quantity(self.results, name, values[rows]) for name, values in self.results.columns(names)]

    @property
    def differing(self) -> tuple[str, ...]:
        """The parameters that are not the same in all points."""
        values = self.results.columns(self.parameters)
        return tuple(name for name, column in values if len(self.rows) and not alike(column[self.rows]))

    @property
    def what(self) -> str:
        """How many points there are, and what they are."""
        count = len(self.rows)
        if count == self.runs:
            return f"{count:,} runs"
        return f"{count:,} variants, each the mean of its runs"


def points_of(results: Results, metrics: Sequence[str]) -> Points:
    """The points of a table with these metrics; only successful runs count."""
    well, varied = results.well, columns_of(results, "varied")
    columns = results.columns(["variant", *metrics])
    variant = next(columns)[1]
    places = np.flatnonzero(well)
    if not len(places):
        return Points(results, tuple(varied), places, {name: quantity(results, name, []) for name in metrics}, 0)
    if not varied:
        found = {name: quantity(results, name, values[well]) for name, values in columns}
        return Points(results, tuple(columns_of(results, "randomized")), places, found, len(places))
    variants = Variants.of(variant, well)
    found = {name: quantity(results, name, variants.means(values[well])[0]) for name, values in columns}
    return Points(results, tuple(varied), places[variants.first], found, len(places))


def quantity(results: Results, name: str, values: np.ndarray | Sequence[float]) -> ShownValues:
    """Values of a column as shown."""
    about = meta(results.schema.field(name))
    if about.get("scale") == "structure":
        names = results.names(name)
        return ShownValues(name, "", np.array([names.index(each) for each in values], float), names=names)
    side = sides_in(results.schema).get(name, "")
    return shown(name, about["unit"], values, log=about.get("scale") == "log", side=side)


def quantities(results: Results, names: Sequence[str]) -> list[ShownValues]:
    """Columns as shown."""
    return [quantity(results, name, values) for name, values in results.columns(names)]


def alike(values: np.ndarray) -> bool:
    """Whether all values are one; what is not known does not count."""
    return len(np.unique(values[values == values])) < 2


def metric_of(results: Results, metric: str) -> ShownValues:
    """A metric as shown, NaN where a run failed."""
    return quantity(results, metric, np.where(results.well, results.column(metric), np.nan))


def repeats_remark(results: Results) -> str:
    """What the note of a figure says of repeats that share a point."""
    repeats = int(np.max(results.column("repeat"))) + 1
    return f"mean of {repeats} repeats; " if repeats > 1 else ""


def thinned(values: np.ndarray, most: int, kept: np.ndarray | Sequence[int] = ()) -> np.ndarray:
    """A given number of sorted values, evenly spaced, plus those to keep; all of them if there are no more."""
    if len(values) <= most:
        return values
    even = values[np.linspace(0, len(values) - 1, most).round().astype(int)]
    return np.union1d(even, np.asarray(kept, values.dtype))


def titled(metric: str) -> str:
    """A metric's name as a title begins with it."""
    return metric.replace("_", " ").capitalize()
