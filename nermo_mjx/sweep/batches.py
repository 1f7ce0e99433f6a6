"""Which batches are simulated: one per chunk, or one for several chunks whose rows are mostly known."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from nermo_mjx.sweep.known import KnownRows
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.simulating import Simulated
from nermo_mjx.sweep.spec import Sweep


@dataclasses.dataclass(frozen=True)
class Batch:
    """Rows that are simulated together: the unknown ones of some chunks of one structure."""

    structure: int
    chunks: list[int]

    def parts(self, plan: BatchPlan, result: Simulated) -> Iterator[tuple[int, Simulated]]:
        """The part of the batch's result that belongs to each chunk; time and steps are split by the number of rows."""
        sizes = [len(plan.unknown(k)) for k in self.chunks]
        first = 0
        for k, size in zip(self.chunks, sizes, strict=True):
            here, share = slice(first, first + size), size / sum(sizes)
            metrics = {name: column[here] for name, column in result.metrics.items()}
            steps, seconds = result.steps * share, result.seconds * share
            series = None if result.series is None else result.series.take(here)
            yield k, Simulated(metrics, result.status[here], steps, seconds, series)
            first += size


@dataclasses.dataclass(frozen=True)
class BatchPlan:
    """What is simulated.

    Attributes:
        layout: rows of each chunk of the sweep.
        known: for chunks with a known row: where each row is, (n,) int, -1 for the others.
        batches: in the order of their first chunks.
        worlds: batch size by structure: one shape, so that no engine compiles twice.
    """

    layout: Sequence[np.ndarray]
    known: Mapping[int, np.ndarray]
    batches: list[Batch]
    worlds: Mapping[int, int]

    def unknown(self, chunk: int) -> np.ndarray:
        """The rows of a chunk that are simulated."""
        return self.layout[chunk][self.known[chunk] < 0] if chunk in self.known else self.layout[chunk]

    def found(self, chunk: int) -> np.ndarray:
        """The rows of a chunk that are known."""
        return self.layout[chunk][self.known[chunk] >= 0] if chunk in self.known else self.layout[chunk][:0]


def plan_batches(
    sweep: Sweep, rows: Sample, layout: Sequence[np.ndarray], chunks: Sequence[int], known: KnownRows | None
) -> BatchPlan:
    """The batches for some chunks of a sweep: each chunk is complete when one batch is done.

    Args:
        rows: of the sweep, and `layout` those of each chunk.
        chunks: to be made, in order.
        known: rows that need not be simulated.
    """
    structures, places = rows.structures(), dict[int, np.ndarray]()
    if known is not None and len(known):
        for k in chunks:
            some = rows.take(layout[k])
            found = known.find(sweep, some.structure, some.values)
            if (found >= 0).any():
                places[k] = found
    plan = BatchPlan(layout, places, [], {})
    most: dict[int, int] = {}
    for chunk in layout:
        at = int(structures[chunk[0]])
        most[at] = max(most.get(at, 0), len(chunk))
    filled, worlds = 0, dict[int, int]()
    for k in chunks:
        count, at = len(plan.unknown(k)), int(structures[layout[k][0]])
        if not count:
            continue
        last = plan.batches[-1] if plan.batches else None
        if last is not None and last.structure == at and filled + count <= most[at] and k in places:
            last.chunks.append(k)
            filled += count
        else:
            plan.batches.append(Batch(at, [k]))
            filled = count
        worlds[at] = max(worlds.get(at, 0), filled) if places else most[at]
    return dataclasses.replace(plan, worlds=worlds)
