"""What an experiment leaves: one row a world, and the recordings that plots and videos show."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from nermo_mjx.view.recording import Recording


@dataclasses.dataclass(frozen=True)
class Column:
    """Unit and meaning of a column of the result table."""

    unit: str
    doc: str


@dataclasses.dataclass(frozen=True)
class Outcome:
    """All worlds of one experiment, both profiles in one table.

    Attributes:
        experiment: its name, as on the command line.
        columns: name -> (n,) values; the cases' columns (`profile`, `gait`, ..., `repeat`) first, then what was
            measured.
        about: name -> unit and meaning, for every column.
        recordings: runs by name, for plots and videos.
    """

    experiment: str
    columns: Mapping[str, np.ndarray]
    about: Mapping[str, Column]
    recordings: Mapping[str, Recording]

    def where(self, **wanted: object) -> np.ndarray:
        """Mask (n,) of the rows whose columns have these values."""
        mask = np.ones(len(next(iter(self.columns.values()))), bool)
        for name, value in wanted.items():
            column = self.columns[name]
            mask &= np.isclose(column, value) if isinstance(value, float) else column == value
        return mask

    def mean(self, column: str, **wanted: object) -> float:
        """Mean over the rows chosen by `where`; NaN where there is none."""
        values = np.asarray(self.columns[column], float)[self.where(**wanted)]
        return float(values.mean()) if len(values) else float("nan")
