"""The history of a training: one row per iteration; in each column's metadata its unit, meaning and role.

Roles: `index` (iteration, steps), `return` (of the episodes that ended), `term` (of the reward), `learning`, `effort`
(CPU and wall time, which differ from run to run), `code`.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from nermo_mjx.runs.files import stored_table
from nermo_mjx.runs.rows import Columns

#: The file in a training's directory.
FILE: Final = "history.parquet"
#: Role, unit and meaning of the columns that every training may have.
_ABOUT: Final[dict[str, tuple[str, str, str]]] = {
    "steps": ("index", "1", "control steps of all worlds so far"),
    "episodes": ("return", "1", "episodes that ended in the iteration, but for the first of each world, cut short"),
    "return": ("return", "1", "mean sum of rewards of these episodes; NaN where none ended"),
    "length": ("return", "1", "mean control steps of these episodes"),
    "lasted": ("return", "1", "share of these episodes that their time limit ended, and no fall"),
    "reward": ("return", "1", "mean reward of a control step"),
    "kl": ("learning", "nat", "change of the policy in the last pass over the iteration's steps"),
    "loss": ("learning", "1", "what the actor descends"),
    "gradient": ("learning", "1", "norm of the actor's gradient"),
    "value_loss": ("learning", "1", "half the mean squared error of the critic"),
    "explained": ("learning", "1", "share of the returns' variance that the critic explains"),
    "rate": ("learning", "1", "learning rate of the actor"),
    "std": ("learning", "1", "mean standard deviation of the actions"),
    "environment_cpu": ("effort", "s", "CPU time of the control steps; NaN where they and the rest are one program"),
    "learner_cpu": ("effort", "s", "CPU time of the rest of the iteration"),
    "wall_seconds": ("effort", "s", "wall time of the iteration"),
}


@dataclasses.dataclass(frozen=True)
class Curves:
    """The history as it is kept while training.

    Attributes:
        names: of the columns.
        rows: float64 (iterations, columns).
        codes: which code made the iterations from which one on.
    """

    names: tuple[str, ...] = ()
    rows: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 0)))
    codes: tuple[tuple[int, str], ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    def extended(self, numbers: Mapping[str, float], code: str) -> Curves:
        """With one more iteration, by this code."""
        names = self.names or tuple(numbers)
        row = np.array([[float(numbers[name]) for name in names]])
        before = tuple(each for each in self.codes if each[0] < len(self))
        codes = before if before and before[-1][1] == code else (*before, (len(self), code))
        return Curves(names, row if not len(self) else np.concatenate([self.rows, row]), codes)

    def column(self, name: str) -> np.ndarray:
        """The numbers of a column (iterations,)."""
        return self.rows[:, self.names.index(name)]

    def last(self, name: str, episodes: int = 100) -> float:
        """Mean of a value over the last episodes, at least this many if available; NaN if none ended."""
        count = self.column("episodes")
        total = np.cumsum(count[::-1])[::-1]
        recent = (count > 0) & (total - count < episodes)
        return float(np.average(self.column(name)[recent], weights=count[recent])) if recent.any() else float("nan")


def history_table(curves: Curves, units: Mapping[str, str], digest: str) -> pa.Table:
    """The history as a table.

    Args:
        curves: what is known.
        units: of the reward's terms, by name.
        digest: of the training.
    """
    table, iterations = Columns(), len(curves)
    table.add("iteration", np.arange(iterations), "index", "1", "iterations done before")
    for i, name in enumerate(curves.names):
        term = name.removeprefix("term.")
        role, unit, doc = _ABOUT.get(name, ("term", units.get(term, "1"), f"mean of the reward's term {term} a step"))
        values = curves.rows[:, i]
        table.add(name, values.astype(int) if name in ("steps", "episodes") else values, role, unit, doc)
    begun = [first for first, _ in curves.codes]
    code = np.repeat(np.array([code for _, code in curves.codes], object), np.diff([*begun, iterations]))
    table.add("code", code, "code", "1", "which code made the row, by its name in run.json")
    return table.table({"training": digest})


def read_history(out: str | os.PathLike[str]) -> pa.Table:
    """The history of a training's directory, as far as it goes.

    Raises:
        DirectoryError: there is none, it is damaged, or cannot be read now.
    """
    return stored_table(Path(out) / FILE, "history of a training")
