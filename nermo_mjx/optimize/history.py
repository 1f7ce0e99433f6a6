"""The history of a tuning: one row per iteration and start; in each column's metadata its unit, meaning and role.

Roles: `index` (iteration, start), `objective`, `parameter`, `gradient`, `error` (of the gradient), `weight` (of the
first order in a mixture), `metric`, `status` (ok, discarded), `effort` (simulated_seconds, wall_seconds), `code`. A
resumed tuning has the same history as an uninterrupted one, except for `wall_seconds`.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa

from nermo_mjx.optimize.estimators import Mixture, Smoothed
from nermo_mjx.optimize.methods import Iterate
from nermo_mjx.optimize.tuning import Tuning
from nermo_mjx.runs.files import stored_table
from nermo_mjx.sweep.table import Columns

#: The file in a tuning's directory.
FILE: Final = "history.parquet"
#: The column that differs from run to run.
WALL: Final = "wall_seconds"


class HistoryColumn(NamedTuple):
    """One column of the history."""

    name: str
    role: str
    unit: str
    description: str


@dataclasses.dataclass(frozen=True)
class Log:
    """The history as it is kept while tuning.

    Attributes:
        metrics: names of the metrics in it.
        rows: float64 (iterations, starts, columns), the columns as `columns` lists them, but for the index.
        codes: which code made the iterations, by first iteration; "" is unknown code.
    """

    metrics: tuple[str, ...]
    rows: np.ndarray
    codes: tuple[tuple[int, str], ...] = ((0, ""),)

    def __len__(self) -> int:
        return len(self.rows)

    def values(self, tuning: Tuning) -> np.ndarray:
        """The objectives (iterations, starts)."""
        return self.rows[:, :, [column.name for column in columns(tuning, self.metrics)].index("objective")]

    def row(self, tuning: Tuning, iteration: int, start: int) -> dict[str, float]:
        """The numbers of one start in one iteration, by column."""
        names = (column.name for column in columns(tuning, self.metrics))
        return dict(zip(names, self.rows[iteration, start].tolist(), strict=True))

    def code(self) -> np.ndarray:
        """Which code made each iteration (iterations,)."""
        begun = [first for first, _ in self.codes]
        return np.repeat(np.array([code for _, code in self.codes], object), np.diff([*begun, len(self)]))

    def extended(self, tuning: Tuning, found: Iterate, wall_seconds: float, code: str) -> Log:
        """The history with one more iteration, its duration and its code."""
        simulated, wall = found.simulated_seconds, wall_seconds
        if len(self):
            last = self.row(tuning, -1, 0)
            simulated, wall = simulated + last["simulated_seconds"], wall + last[WALL]
        starts = len(found.value)
        numbers = {
            "objective": found.value,
            "ok": found.ok,
            "discarded": found.discarded,
            "simulated_seconds": np.full(starts, simulated),
            WALL: np.full(starts, wall),
            **found.metrics,
        }
        for i, name in enumerate(tuning.names):
            numbers |= {
                name: found.points[:, i],
                f"gradient.{name}": found.gradient[:, i],
                f"gradient_error.{name}": found.error[:, i],
                f"first_order.{name}": found.first_order[:, i],
            }
        row = np.stack([np.asarray(numbers[c.name], float) for c in columns(tuning, self.metrics)], axis=-1)
        before = tuple(each for each in self.codes if each[0] < len(self))
        codes = before if before and before[-1][1] == code else (*before, (len(self), code))
        return dataclasses.replace(self, rows=np.concatenate([self.rows, row[None]]), codes=codes)


def empty_log(tuning: Tuning, metrics: tuple[str, ...]) -> Log:
    """A history without iterations, for a problem that gives these metrics."""
    known = sorted(metrics, key=[*(tuning.metrics | tuning.objective_metrics)].index)
    return Log(tuple(known), np.empty((0, tuning.starts, len(columns(tuning, known)))))


def columns(tuning: Tuning, metrics: Sequence[str]) -> list[HistoryColumn]:
    """The columns of a tuning's history, but for the index."""
    parameters, estimator = tuning.parameters, tuning.estimator
    value = "value that is minimized; NaN where the robot did not walk to the end"
    found = [HistoryColumn("objective", "objective", "1", value)]
    found += [HistoryColumn(name, "parameter", parameters[name].unit, parameters[name].doc) for name in tuning.names]
    normalized = isinstance(estimator, Smoothed) and estimator.normalized
    mean = ", the mean over worlds whose gradients count with length 1" if normalized else ""
    for name in tuning.names if tuning.method.has_gradient else ():
        unit = "1" if parameters[name].unit == "1" else f"1/({parameters[name].unit})"
        slope, error, share = f"gradient.{name}", f"gradient_error.{name}", f"first_order.{name}"
        found.append(HistoryColumn(slope, "gradient", unit, f"estimated d objective / d {name}{mean}"))
        if estimator.samples:
            found.append(HistoryColumn(error, "error", unit, f"standard error of gradient.{name}"))
        if isinstance(estimator, Mixture):
            found.append(HistoryColumn(share, "weight", "1", f"share of the first order in gradient.{name}"))
    known = tuning.metrics | tuning.objective_metrics
    found += [HistoryColumn(name, "metric", known[name].unit, known[name].doc) for name in metrics]
    return [
        *found,
        HistoryColumn("ok", "status", "1", "whether the robot walked to the end"),
        HistoryColumn("discarded", "status", "1", "worlds of the start that are not in the gradient"),
        HistoryColumn("simulated_seconds", "effort", "s", "simulated by all starts so far, gradients at their cost"),
        HistoryColumn(WALL, "effort", "s", "wall time so far, over all sessions; never twice the same"),
    ]


def history_table(tuning: Tuning, log: Log) -> pa.Table:
    """The history as a table: iterations in order, the starts of each side by side."""
    iterations, starts, _ = log.rows.shape
    table = Columns()
    table.add("iteration", np.repeat(np.arange(iterations), starts), "index", "1", "steps taken before")
    table.add("start", np.tile(np.arange(starts), iterations), "index", "1", "which start; 0 is the given one")
    flat = log.rows.reshape(-1, log.rows.shape[-1])
    for i, column in enumerate(columns(tuning, log.metrics)):
        values = flat[:, i]
        if column.name in ("ok", "discarded"):
            values = values.astype(bool if column.name == "ok" else int)
        table.add(column.name, values, column.role, column.unit, column.description)
    made_by = "which code made the row, by its name in run.json; empty: not known"
    table.add("code", np.repeat(log.code(), starts), "code", "1", made_by)
    return table.table({"tuning": tuning.digest(), "estimator": tuning.estimator.name})


def read_history(out: str | os.PathLike[str]) -> pa.Table:
    """The history of a tuning's directory so far.

    Raises:
        DirectoryError: there is none, it is damaged, or cannot be read now.
    """
    return stored_table(Path(out) / FILE, "history of a tuning")


# ---
# When a tuning ends: its iterations are done, or the last of them gained almost nothing.


#: Fraction of the total gain that counts as nothing.
NOTHING: Final = 0.01


def is_done(tuning: Tuning, log: Log | None) -> bool:
    """Whether there is nothing left to do."""
    return log is not None and (len(log) > tuning.iterations or stalled(tuning, log))


def why_done(tuning: Tuning, log: Log) -> str | None:
    """Why the tuning ended before its iterations were done, as a sentence; None if it did not."""
    if len(log) > tuning.iterations or not stalled(tuning, log):
        return None
    return (
        f"It stopped after {len(log) - 1} of {tuning.iterations} iterations: the last {tuning.patience} gained less "
        f"than {NOTHING:.0%} of the total gain; a longer patience continues."
    )


def stalled(tuning: Tuning, log: Log) -> bool:
    """Whether the last `patience` iterations gained almost nothing, at each start.

    What counts is the lowest objective so far: of each start, or of all points together where they are a generation.
    The total gain is from the first iteration with a completed walk to the best of all.
    """
    if len(log) <= tuning.patience:
        return False
    value = log.values(tuning)
    value = np.where(np.isfinite(value), value, np.inf)
    value = value if tuning.method.has_gradient else value.min(axis=1, keepdims=True)
    lowest = np.minimum.accumulate(value)
    walked = np.asarray(np.isfinite(lowest).any(axis=1))
    if not walked[-1 - tuning.patience]:
        return False
    gained = lowest[int(walked.argmax())].min() - lowest[-1].min()
    before, now = lowest[-1 - tuning.patience], lowest[-1]
    lately = np.where(np.isfinite(now), before - np.where(np.isfinite(now), now, 0.0), 0.0)
    return bool((lately <= NOTHING * gained).all())
