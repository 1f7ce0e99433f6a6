"""Scalars per chunk for TensorBoard: best and mean of each metric so far, statuses, pace."""

from __future__ import annotations

import collections
import math
from collections.abc import Iterable

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from nermo_mjx.runs.tensorboard import TensorBoard
from nermo_mjx.sweep.comparing.comparison import better
from nermo_mjx.sweep.table import columns_of


class ChunkLog:
    """Sums up chunks as they come.

    Args:
        board: is told after each chunk that is added with `tell`.
        there: chunks of earlier sessions.
    """

    def __init__(self, board: TensorBoard, there: Iterable[pa.Table] = ()) -> None:
        self._board, self._rows = board, 0
        self._statuses: collections.Counter[str] = collections.Counter()
        self._sums: collections.Counter[str] = collections.Counter()
        self._counts: collections.Counter[str] = collections.Counter()
        self._best: dict[str, float] = {}
        for table in there:
            self.add(table)

    def add(self, table: pa.Table) -> None:
        """Add a chunk's rows; only successful runs count in best and mean."""
        self._rows += table.num_rows
        self._statuses.update(table.column("status").to_pylist())
        well = pc.equal(table.column("status"), "ok").to_numpy()
        for name in columns_of(table, "metric"):
            values = np.asarray(table.column(name).to_numpy(), float)[well]
            values = values[np.isfinite(values)]
            if not len(values):
                continue
            self._sums[name] += float(values.sum())  # type: ignore[assignment]
            self._counts[name] += len(values)
            if side := better(table.schema.field(name)):
                price = {"high": -values, "low": values, "zero": np.abs(values)}[side]
                candidates = [self._best[name]] if name in self._best else []
                candidates.append(float(values[np.argmin(price)]))
                self._best[name] = min(candidates, key={"high": lambda x: -x, "low": float, "zero": abs}[side])

    def tell(self, table: pa.Table, steps_per_second: float = math.nan) -> None:
        """Add a chunk's rows, and report the current state to TensorBoard; the step is the number of rows."""
        self.add(table)
        numbers = {
            "rows": float(self._rows),
            "steps_per_second": steps_per_second,
            **{f"status/{name}": float(count) for name, count in self._statuses.items()},
            **{f"mean/{name}": self._sums[name] / count for name, count in self._counts.items()},
            **{f"best/{name}": value for name, value in self._best.items()},
        }
        self._board.log(self._rows, numbers)
