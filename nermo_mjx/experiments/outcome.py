"""The outcome of an experiment: one row per world, and the recordings used by plots and videos."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from nermo_mjx.recording import Recording

#: Column that identifies the body, if an outcome has several: 1, 2, ...
BODY: Final = "body"


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
        columns: name -> (n,) values; the cases' columns (`profile`, `gait`, ..., `repeat`) first, then the measured
            ones.
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
        """Mean over the rows selected by `where`; NaN if there are none, or no such column."""
        if column not in self.columns:
            return float("nan")
        values = np.asarray(self.columns[column], float)[self.where(**wanted)]
        return float(values.mean()) if len(values) else float("nan")

    def of_body(self, body: int) -> Outcome:
        """The rows of one body in an outcome of several, without the column of the body."""
        rows = self.where(**{BODY: body})
        columns = {name: values[rows] for name, values in self.columns.items() if name != BODY}
        return dataclasses.replace(self, columns=columns)


def joined(parts: Sequence[Outcome]) -> Outcome:
    """Outcomes of one experiment with the same columns, concatenated; of recordings with the same name the first is
    kept."""
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns}
    recordings = {name: run for part in reversed(parts) for name, run in part.recordings.items()}
    return dataclasses.replace(parts[0], columns=columns, recordings=recordings)
