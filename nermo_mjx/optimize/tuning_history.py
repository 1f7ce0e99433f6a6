"""The history of a tuning: one row per iteration and start, with the objective, gradients and metrics."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa

from nermo_mjx.optimize.tuner import Iterate
from nermo_mjx.optimize.tuning_spec import Tuning
from nermo_mjx.robot.quantity import of_type
from nermo_mjx.runs.files import stored_table
from nermo_mjx.sweep.table import Columns

HISTORY: Final = "history.parquet"


# ---
# The history of a tuning has one row per iteration and start. The metadata of each column contains its unit, meaning and
# role.
#
# Roles: `index` (iteration, start), `objective`, `parameter`, `gradient`, `metric`, `status` (ok), `effort`
# (simulated_seconds, wall_seconds), `code`. A resumed tuning has the same history as an uninterrupted one, except for
# `wall_seconds`.


#: Fraction of the total gain below which a gain is negligible.
NOTHING: Final = 0.01


class HistoryColumn(NamedTuple):
    """One column of the history."""

    name: str
    role: str
    unit: str
    description: str


@dataclasses.dataclass(frozen=True)
class TuningHistory:
    """The history of a tuning so far.

    Attributes:
        tuning: Tuning of the history.
        metrics: Names of the metrics in the history.
        rows: Values, float64 (iterations, starts, columns), with the columns of `history_columns`.
        codes: Codes that made the iterations, by first iteration; "" is unknown code.
    """

    tuning: Tuning
    metrics: tuple[str, ...] = ()
    rows: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 0, 0)))
    codes: tuple[tuple[int, str], ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    def column(self, name: str) -> np.ndarray:
        """Values of a column (iterations, starts)."""
        names = [column.name for column in history_columns(self.tuning, self.metrics)]
        return self.rows[:, :, names.index(name)]

    def extend(self, iterate: Iterate, wall_seconds: float, code: str) -> TuningHistory:
        """The history with one more iteration, its duration and its code."""
        tuning, metric_names = self.tuning, [*(self.tuning.metrics | self.tuning.objective_metrics)]
        metrics = self.metrics or tuple(sorted(iterate.metrics, key=metric_names.index))
        effort = {"simulated_seconds": iterate.simulated_seconds, "wall_seconds": wall_seconds}
        numbers: dict[str, np.ndarray] = {"objective": iterate.value, "ok": iterate.ok}
        for name, spent in effort.items():
            previous = self.column(name)[-1, 0] if len(self) else 0.0
            numbers[name] = np.full(len(iterate.value), previous + spent)
        for i, name in enumerate(tuning.names):
            numbers[name], numbers[f"gradient.{name}"] = (
                iterate.points[:, i],
                iterate.gradient[:, i],
            )
        numbers |= iterate.metrics
        row = np.stack(
            [np.asarray(numbers[c.name], float) for c in history_columns(tuning, metrics)], axis=-1
        )[None]
        codes = (
            self.codes
            if self.codes and self.codes[-1][1] == code
            else (*self.codes, (len(self), code))
        )
        rows = np.concatenate([self.rows, row]) if len(self) else row
        return TuningHistory(tuning, metrics, rows, codes)

    def table(self) -> pa.Table:
        """The history as a table, with the starts of an iteration in consecutive rows."""
        iterations, starts, _ = self.rows.shape
        table = Columns()
        table.add(
            "iteration",
            np.repeat(np.arange(iterations), starts),
            "index",
            "1",
            "steps taken before",
        )
        table.add(
            "start",
            np.tile(np.arange(starts), iterations),
            "index",
            "1",
            "which start; 0 is the given one",
        )
        types = {"ok": bool, "discarded": int}
        for i, (name, *column_fields) in enumerate(history_columns(self.tuning, self.metrics)):
            table.add(
                name, self.rows[:, :, i].ravel().astype(types.get(name, float)), *column_fields
            )
        lasted = np.diff([*(first for first, _ in self.codes), iterations])
        codes = np.repeat(np.array([code for _, code in self.codes], object), lasted * starts)
        table.add(
            "code",
            codes,
            "code",
            "1",
            "which code made the row, by its name in run.json; empty: not known",
        )
        return table.table({"tuning": self.tuning.digest()})

    def point(self, iteration: int, start: int) -> dict[str, Any]:
        """An evaluated point: `parameters`, `objective` and `metrics`, which are not finite for a failed walk."""
        values = {
            name: float(self.column(name)[iteration, start])
            for name in (*self.tuning.names, *self.metrics)
        }
        return {
            "parameters": {name: values[name] for name in self.tuning.names},
            "objective": float(self.column("objective")[iteration, start]),
            "metrics": {name: values[name] for name in self.metrics},
        }

    def start(self) -> dict[str, Any]:
        """The first evaluation of the first start: see `point`, and whether it is `ok`."""
        return self.point(0, 0) | {"ok": bool(self.column("ok")[0, 0])}

    def best(self) -> dict[str, Any] | None:
        """The content of best.json, the evaluated point with the lowest objective; None without a completed walk.

        It contains `parameters` and `metrics` by name in SI units and radians, `objective`, the `iteration` and `start` of
        the point, `simulated_seconds` of the whole tuning and `simulated_seconds_to_best`, where a gradient counts as its
        cost in forward runs, the number of completed `iterations`, whether the tuning is `complete`, and the reason why
        it `stopped` early, or null.
        """
        value = self.column("objective")
        if not np.isfinite(value).any():
            return None
        iteration, start = (int(i) for i in np.unravel_index(np.nanargmin(value), value.shape))
        simulated = self.column("simulated_seconds")[:, start].tolist()
        stopped = None
        if len(self) <= self.tuning.iterations and self.is_stalled:
            stopped = (
                f"It stopped after {len(self) - 1} of {self.tuning.iterations} iterations: the last "
                f"{self.tuning.patience} gained less than {NOTHING:.0%} of the total gain; a longer patience continues."
            )
        return self.point(iteration, start) | {
            "iteration": iteration,
            "start": start,
            "simulated_seconds": simulated[-1],
            "simulated_seconds_to_best": simulated[iteration],
            "iterations": len(self) - 1,
            "complete": self.is_done,
            "stopped": stopped,
        }

    @property
    def is_done(self) -> bool:
        """Whether the iterations are complete, or the last iterations gained almost nothing."""
        return len(self) > self.tuning.iterations or self.is_stalled

    @property
    def is_stalled(self) -> bool:
        """Whether the last `patience` iterations gained almost nothing, at each start.

        The criterion is the lowest objective of each start so far. The total gain is the difference between the first
        iteration with a completed walk and the best one.
        """
        patience = self.tuning.patience
        if len(self) <= patience:
            return False
        value = self.column("objective")
        value = np.where(np.isfinite(value), value, np.inf)
        lowest = np.minimum.accumulate(value)
        walked = np.asarray(np.isfinite(lowest).any(axis=1))
        if not walked[-1 - patience]:
            return False
        gained = lowest[int(walked.argmax())].min() - lowest[-1].min()
        before, now = lowest[-1 - patience], lowest[-1]
        lately = np.where(np.isfinite(now), before - np.where(np.isfinite(now), now, 0.0), 0.0)
        return bool((lately <= NOTHING * gained).all())


def history_columns(tuning: Tuning, metrics: Sequence[str]) -> list[HistoryColumn]:
    """The columns of a tuning's history, without the index."""
    parameters = tuning.parameters
    value = "value that is minimized; NaN where the robot did not walk to the end"
    columns = [HistoryColumn("objective", "objective", "1", value)]
    columns += [
        HistoryColumn(name, "parameter", parameters[name].unit, parameters[name].doc)
        for name in tuning.names
    ]
    for name in tuning.names:
        unit = "1" if parameters[name].unit == "1" else f"1/({parameters[name].unit})"
        columns.append(
            HistoryColumn(f"gradient.{name}", "gradient", unit, f"d objective / d {name}")
        )
    declarations = tuning.metrics | tuning.objective_metrics
    columns += [
        HistoryColumn(name, "metric", declarations[name].unit, declarations[name].doc)
        for name in metrics
    ]
    return [
        *columns,
        HistoryColumn("ok", "status", "1", "whether the robot walked to the end"),
        HistoryColumn(
            "simulated_seconds",
            "effort",
            "s",
            "simulated by all starts so far, gradients at their cost",
        ),
        HistoryColumn(
            "wall_seconds",
            "effort",
            "s",
            "wall time so far, over all sessions; never twice the same",
        ),
    ]


def read_history(out: str | os.PathLike[str]) -> pa.Table:
    """The history of a tuning's directory so far, one row per iteration and start.

    Raises:
        DirectoryError: The history is missing, damaged, or cannot be read now.
    """
    folder = of_type("out", out, (str, os.PathLike), "the path of a directory")
    return stored_table(Path(folder) / HISTORY, "history of a tuning")
