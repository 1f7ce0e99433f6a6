"""How much of a sweep is done, counted in simulated time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np


@dataclasses.dataclass(frozen=True)
class SweepProgress:
    """How far a sweep is.

    Attributes:
        fraction: share of the work that is done, by simulated time, 0 to 1; resumed chunks count as done; of a shard
            it is that shard's share.
        rows_done, rows: finished rows and all rows of the same work.
        resumed: rows that an earlier session had finished.
    """

    fraction: float
    rows_done: int
    rows: int
    resumed: int


class Tally:
    """Counts finished chunks, and tells.

    Args:
        layout: rows of each chunk.
        seconds: simulated time of each row, (rows,) [s].
        counted: the chunks that count.
        listener: is told.
    """

    def __init__(
        self,
        layout: Sequence[np.ndarray],
        seconds: np.ndarray,
        counted: Iterable[int],
        listener: Callable[[SweepProgress], None] | None,
    ) -> None:
        # A chunk costs as long as its longest row, all its rows.
        self._cost = {k: len(layout[k]) * float(seconds[layout[k][-1]]) for k in counted}
        self._rows = {k: len(layout[k]) for k in self._cost}
        self._all, self._all_rows = sum(self._cost.values()), sum(self._rows.values())
        self._listener = listener
        self._finished: set[int] = set()
        self._done, self._rows_done, self._resumed = 0.0, 0, 0

    def finish(self, chunks: Iterable[int], *, resumed: bool = False) -> None:
        """Chunks are done; those that do not count, or are counted already, are passed over."""
        for k in chunks:
            if k in self._cost and k not in self._finished:
                self._finished.add(k)
                self._done += self._cost[k]
                self._rows_done += self._rows[k]
                self._resumed += self._rows[k] if resumed else 0

    def tell(self, chunk: int | None = None, share: float = 0.0) -> None:
        """Report the overall progress, including the fraction of the current chunk."""
        if self._listener is None:
            return
        current = 0.0 if chunk is None else self._cost[chunk] * min(max(float(share), 0.0), 1.0)
        complete = len(self._finished) == len(self._cost)
        fraction = 1.0 if complete else (self._done + current) / self._all
        self._listener(SweepProgress(fraction, self._rows_done, self._all_rows, self._resumed))
