"""What a sweep writes to TensorBoard."""

from __future__ import annotations

import collections

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from nermo_mjx.plotting.shown import cost
from nermo_mjx.rollout.own_metrics import SIDES
from nermo_mjx.runs.job import TensorBoard
from nermo_mjx.sweep.counting import counts
from nermo_mjx.sweep.table import better, columns_of


class BatchLog:
    """Scalars for TensorBoard, summed up as batches come: best and mean of each metric, statuses, steps per second.

    Args:
        board: where they go.
    """

    def __init__(self, board: TensorBoard) -> None:
        self._board, self._rows = board, 0
        self._statuses: collections.Counter[str] = collections.Counter()
        self._sums: collections.Counter[str] = collections.Counter()
        self._counts: collections.Counter[str] = collections.Counter()
        self._best: dict[str, float] = {}

    def add(self, table: pa.Table, steps_per_second: float | None = None) -> None:
        """Add a batch's rows, and report the state if this session made them; only successful runs count in best and
        mean. The step is the number of rows."""
        self._rows += table.num_rows
        self._statuses.update(table.column("status").to_pylist())
        well = pc.equal(table.column("status"), "ok").to_numpy()
        for name in columns_of(table, "metric"):
            values = np.asarray(table.column(name).to_numpy(), float)
            values = values[counts(name, values, well)]
            if not len(values):
                continue
            self._sums[name] += float(values.sum())  # type: ignore[assignment]
            self._counts[name] += len(values)
            if side := better(table.schema.field(name)):
                candidates = np.append(self._best.get(name, values[0]), values)
                self._best[name] = float(candidates[np.argmin(cost(SIDES[side], candidates))])
        if steps_per_second is None:
            return
        numbers = {
            "rows": float(self._rows),
            "steps_per_second": steps_per_second,
            **{f"status/{name}": float(count) for name, count in self._statuses.items()},
            **{f"mean/{name}": self._sums[name] / count for name, count in self._counts.items()},
            **{f"best/{name}": value for name, value in self._best.items()},
        }
        self._board.log(self._rows, numbers)
