"""The data of a directory's page: the columns of its table with their metadata, complete or thinned evenly."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.runs import DirectoryError, kind_of
from nermo_mjx.sweep.points import thinned
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.sides import sides_in
from nermo_mjx.sweep.summary import LEADING
from nermo_mjx.sweep.table import meta

#: Roles of the columns that are shown, in this order; seeds and codes are not informative.
ROLES: Final = ("varied", "randomized", "metric", "status", "index")
#: Maximum number of rows in a page: 3 MB with 50 columns.
MOST_ROWS: Final = 20_000
#: Number of best rows that are always kept.
_BEST_KEPT: Final = 500
#: Maximum number of values of a parameter that forms an axis of cells.
MOST_CELLS: Final = 64
_SIDES: Final = {"max": "high", "min": "low", "nearest zero": "zero"}


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of the table.

    Attributes:
        name, unit, description, role: from its metadata, SI units.
        better: `high`, `low` or `zero`, the side that is better; empty if there is none.
        log: whether it was spread logarithmically.
        values: (n,) numbers, or texts.
    """

    name: str
    unit: str
    description: str
    role: str
    better: str
    log: bool
    values: np.ndarray

    @property
    def is_text(self) -> bool:
        """Whether it holds names, such as those of structures."""
        return self.values.dtype == object

    @property
    def distinct(self) -> np.ndarray:
        """Its distinct values, sorted, without NaN."""
        return np.unique(self.values if self.is_text else self.values[np.isfinite(self.values)])

    def cost(self) -> np.ndarray:
        """Its values, signed so that lower is better; without a better direction, higher values count as better."""
        signed = {"low": self.values, "zero": np.abs(self.values)}.get(self.better, -self.values)
        return np.where(np.isfinite(signed), signed, np.inf)


@dataclasses.dataclass(frozen=True)
class Runs:
    """The runs of a directory.

    Attributes:
        kind: `sweep`, `search` or `atlas`.
        columns: by name, in the order in which they are shown; of (n,) values each.
        rows: number of each run in its table, (n,).
        total: number of rows in the table.
        leading: the first requested metric.
        grid: whether the varied parameters form a grid.
        atlas: an atlas' objective and measures; None for other directories.
    """

    kind: str
    columns: Mapping[str, Column]
    rows: np.ndarray
    total: int
    leading: str
    grid: bool = False
    atlas: Mapping[str, Any] | None = None

    def of(self, *roles: str) -> list[Column]:
        """Columns of these roles that differ between the runs."""
        return [each for each in self.columns.values() if each.role in roles and len(each.distinct) > 1]


def runs_of(path: Path, kept: Collection[int] = (), most: int = MOST_ROWS) -> Runs:
    """The runs of a directory.

    Args:
        path: of a sweep or a search; if it has `atlas.parquet`, the cells are shown.
        kept: rows that are always included.
        most: maximum number of rows; of more, the best and an even selection of the others.

    Raises:
        DirectoryError: it has no runs yet, or they cannot be read.
    """
    table, about = _table(path)
    fields = {field.name: meta(field) for field in table.schema}
    shown = [name for role in ROLES for name, each in fields.items() if each.get("role") == role and name != "seed"]
    metrics = [name for name in shown if fields[name]["role"] == "metric"]
    atlas = json.loads(about[b"atlas"]) if b"atlas" in about else None
    sides = sides_in(table.schema)
    leading = _leading(metrics, sides, atlas)
    number = table.column("row")
    price = _column(leading, fields[leading], sides, table.column(leading)).cost()
    places = np.arange(len(number))
    if len(number) > most:
        best = np.argsort(price, kind="stable")[: min(_BEST_KEPT, most // 2)]
        places = np.union1d(thinned(places, most - len(best)), best)
        places = np.union1d(places, np.flatnonzero(np.isin(number, list(kept))))
    columns = {name: _column(name, fields[name], sides, table.column(name)[places]) for name in shown if name != "row"}
    for objective in [] if atlas is None else [atlas["objective"]]:
        side = "low" if objective["direction"] == "minimize" else "high"
        columns[leading] = dataclasses.replace(columns[leading], better=side)
    kind = "atlas" if atlas is not None else kind_of(path) or "sweep"
    grid = about.get(b"sampler") == b"grid"
    return Runs(kind, columns, number[places].astype(np.int64), len(number), leading, grid, atlas)


class _Read:
    """A table in memory with columns as NumPy arrays; `Results` offers the same for chunks."""

    def __init__(self, table: pa.Table) -> None:
        self.schema, self._table = table.schema, table

    def column(self, name: str) -> np.ndarray:
        return np.asarray(self._table.column(name).to_numpy())


def _table(path: Path) -> tuple[Results | _Read, Mapping[bytes, bytes]]:
    """The table of a directory, and its schema's metadata."""
    atlas = path / "atlas.parquet"
    if atlas.exists():
        try:
            table = pq.read_table(atlas)
        except (OSError, pa.ArrowException) as error:
            raise DirectoryError(f"{atlas} cannot be read ({error}): run the same search again.") from None
        if not len(table):
            raise DirectoryError(f"{atlas} has no filled cell yet.")
        return _Read(table), table.schema.metadata or {}
    files = sorted((path / "results").glob("*.parquet"))
    if not files:
        raise DirectoryError(f"{path} holds no results yet: nermo-mjx status {path} says how to resume.")
    results = Results(files)
    return results, results.schema.metadata or {}


def _leading(metrics: Sequence[str], sides: Mapping[str, str], atlas: Mapping[str, Any] | None) -> str:
    if atlas is not None:
        return str(atlas["objective"]["metric"])
    if not metrics:
        raise DirectoryError("The table has no metric: no column's role is 'metric'.")
    directed = [name for name in metrics if name in sides]
    return LEADING if LEADING in metrics else (directed or list(metrics))[0]


def _column(name: str, about: Mapping[str, str], sides: Mapping[str, str], values: np.ndarray) -> Column:
    role = about["role"]
    better = _SIDES[sides[name]] if role == "metric" and name in sides else ""
    if values.dtype.kind in "OUS" and any(isinstance(value, str) for value in values):
        values = np.array(["–" if value is None else str(value) for value in values], object)
    else:
        values = values.astype(float)  # None of a nullable column becomes NaN
    unit, log = about.get("unit", "1"), about.get("scale") == "log"
    return Column(name, unit, about.get("description", ""), role, better, log, values)
