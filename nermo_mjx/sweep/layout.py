"""Which rows a chunk holds, and the batch that a simulator gets for it."""

from __future__ import annotations

import hashlib
import math

import numpy as np

from nermo_mjx.sweep.sampling import Rows, Sample
from nermo_mjx.sweep.spec import Sweep

_NAMED = 4


def simulated_seconds(sweep: Sweep, rows: Sample) -> np.ndarray:
    """How long each row is simulated, (n,) [s]."""
    changed = {axis.name for axis in sweep.axes} | {draw.name for draw in sweep.draws}
    values = {name: rows.column(name) if name in changed else sweep.constants[name]
              for name in sweep.setup.timing if name in changed or name in sweep.constants}  # fmt: skip
    _, end = sweep.run.seconds(sweep.setup.cycle_rate(values))
    return np.broadcast_to(np.asarray(end, dtype=float), len(rows))


def layout_of(seconds: np.ndarray, size: int) -> list[np.ndarray]:
    """Rows of each chunk: chunk-mates last alike long, and chunks are alike large (to one row)."""
    order = np.argsort(seconds, kind="stable")
    return np.array_split(order, math.ceil(len(order) / size))


def batch_size(layout: list[np.ndarray]) -> int:
    """Worlds of every chunk's batch: one shape for all chunks, so that no engine compiles twice."""
    return max(map(len, layout))


def batch_values(sweep: Sweep, rows: Rows, worlds: int) -> dict[str, np.ndarray]:
    """Values of every parameter that the sweep names, for a simulator: name -> (worlds,).

    Args:
        rows: those of the chunk, n; the last one is repeated until the batch is full.
        worlds: size of the batch, n or more.
    """
    padded = rows.take(np.pad(np.arange(len(rows)), (0, worlds - len(rows)), mode="edge"))
    constants = {name: np.full(worlds, value) for name, value in sweep.constants.items()}
    return {**constants, **padded.values}


def rows_digest(index: np.ndarray) -> str:
    """A hash of which rows a chunk holds, and in which order."""
    return hashlib.blake2b(np.asarray(index, dtype="<i8").tobytes(), digest_size=12).hexdigest()


def listed(numbers: np.ndarray) -> str:
    """The first few of some numbers, for a sentence: 3, 7, 11, 15 and 60 more."""
    shown, more = sorted(np.asarray(numbers).tolist())[:_NAMED], len(numbers) - _NAMED
    return ", ".join(map(str, shown)) + (f" and {more:,} more" if more > 0 else "")
