"""The default number of points per batch: enough to fill the machine, few enough for many generations."""

from __future__ import annotations

import math
from typing import Final

from nermo_mjx.physics import resolve_engine
from nermo_mjx.runtime import cpu_count
from nermo_mjx.search.spec import Search
from nermo_mjx.sweep.chunk_size import chunk_rows_here

#: Worlds for each core with MuJoCo C. Half as many as in a sweep: two cores are busy with 16 worlds, and a method that
#: is told of each of 16 has gone further after 64.
CORE_WORLDS: Final = 8
#: An atlas has several emitters in a batch.
ATLAS_WORLDS: Final = 32
#: Generations that a budget is to last for.
GENERATIONS: Final = 10


def batch_points(search: Search, engine: str) -> int:
    """Points of a batch on this machine.

    Args:
        engine: name of the engine, or "auto".
    """
    expected = search.evaluations or 1000
    least = 4 + int(3 * math.log(len(search.names)))
    if resolve_engine(engine) == "c":
        full = cpu_count() * (ATLAS_WORLDS if search.aim.measures else CORE_WORLDS) // search.repeats
    else:
        full = chunk_rows_here(engine, expected * search.repeats) // search.repeats
    return max(least, 4, min(full, expected // GENERATIONS))
