"""Which rows a chunk contains, and the batch that a simulator gets for it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from nermo_mjx.specs.walk import WalkSpec
from nermo_mjx.sweep.sampling import Rows, Sample
from nermo_mjx.sweep.spec import Sweep

_NAMED = 4


def simulated_seconds(sweep: Sweep, rows: Sample) -> np.ndarray:
    """How long each row is simulated, (n,) [s]."""
    changed = {*sweep.varied, *(draw.name for draw in sweep.draws)}
    structure, seconds = rows.structures(), np.empty(len(rows))
    columns = {name: rows.column(name) for name in changed if any(name in at.setup.timing for at in sweep.structures)}
    for at, walk in enumerate(sweep.structures):
        here = structure == at
        values: dict[str, Any] = {name: value for name, value in walk.constants.items() if name in walk.setup.timing}
        values |= known({name: column[here] for name, column in columns.items() if name in walk.setup.timing})
        _, end = walk.run.seconds(walk.setup.cycle_rate(values))
        seconds[here] = np.asarray(end, dtype=float)
    return seconds


def layout_of(seconds: np.ndarray, size: int, structure: np.ndarray | None = None) -> list[np.ndarray]:
    """Rows of each chunk: rows of one chunk share structure and duration; chunks are of equal size (to one row).

    Args:
        seconds: how long each row is simulated, (n,) [s].
        size: of a chunk, at most.
        structure: of each row, (n,) int; one for all by default.
    """
    order = np.argsort(seconds, kind="stable")
    if structure is None:
        return np.array_split(order, math.ceil(len(order) / size))
    each = (order[structure[order] == at] for at in np.unique(structure))
    return [chunk for rows in each for chunk in np.array_split(rows, math.ceil(len(rows) / size))]


def batch_values(walk: WalkSpec, rows: Rows, worlds: int) -> dict[str, np.ndarray]:
    """Values of every parameter that the sweep names, for a simulator: name -> (worlds,).

    Args:
        walk: of the rows' structure.
        rows: those of the chunk, n; the last one is repeated until the batch is full.
        worlds: size of the batch, n or more.
    """
    padded = rows.take(np.pad(np.arange(len(rows)), (0, worlds - len(rows)), mode="edge"))
    constants = {name: np.full(worlds, value) for name, value in walk.constants.items()}
    return {**constants, **known(padded.values)}


def known(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns of one structure's rows without those that nothing reads in it."""
    return {name: column for name, column in values.items() if not np.isnan(column).any()}


def rows_digest(index: np.ndarray) -> str:
    """A hash of which rows a chunk contains, and in which order."""
    return hashlib.blake2b(np.asarray(index, dtype="<i8").tobytes(), digest_size=12).hexdigest()


def listed(numbers: np.ndarray) -> str:
    """The first few of some numbers, for a sentence: 3, 7, 11, 15 and 60 more."""
    shown, more = sorted(np.asarray(numbers).tolist())[:_NAMED], len(numbers) - _NAMED
    return ", ".join(map(str, shown)) + (f" and {more:,} more" if more > 0 else "")
