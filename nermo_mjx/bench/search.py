"""How close `search` comes to the best of a dense sweep, with each of ten seeds, and how long it takes."""

from __future__ import annotations

import tempfile
import time
from typing import Any, Final

import numpy as np

from nermo_mjx.bench.tuning import Trot
from nermo_mjx.search import run_search

SEEDS: Final = 10
#: Evaluations of a search: six batches of 16 worlds.
EVALUATIONS: Final = 96
BATCH: Final = 16


def search_case(frequency: float) -> dict[str, Any]:
    """Spine amplitude and phase for the speed of a trot: a dense sweep, then a search with each seed.

    All run on the engine `c` for 6 gait cycles of which 2 are warm-up. The wall time of a search is that of
    `run_search` into a new directory with a warm simulator, without figures.

    Args:
        frequency: of the gait [Hz].
    """
    trot = Trot(frequency)
    case = trot.dense() | {"budget_runs": EVALUATIONS}
    searches = [_search(trot, seed, case["dense_speed"]) for seed in range(SEEDS)]
    return case | {
        "median_share": float(np.median([each["share"] for each in searches])),
        "median_wall_s": float(np.median([each["wall_s"] for each in searches])),
        "published_share": searches[0].pop("first_share"),
        "searches": [{key: value for key, value in each.items() if key != "first_share"} for each in searches],
    }


def _search(trot: Trot, seed: int, dense: float) -> dict[str, Any]:
    spec = {
        "spine": "stride_extension", "run": {"cycles": 6, "warmup_cycles": 2}, "set": {"frequency": trot.frequency},
        "vary": {"spine.amplitude": {"uniform": [0.0, 0.4]}, "spine.phase": {"uniform": [-np.pi, np.pi]}},
        "objective": {"maximize": "speed"}, "budget": EVALUATIONS, "batch": BATCH, "seed": seed, "plots": False,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        result = run_search(spec, folder, simulator=trot.simulator)
        wall = time.perf_counter() - began
        table = result.table
    well = np.array(table.column("status").to_pylist()) == "ok"
    speed = np.where(well, table.column("speed").to_numpy(), 0.0)
    reached = np.flatnonzero(np.maximum.accumulate(speed) >= 0.99 * dense)
    best = result.best
    return {
        "seed": seed, "amplitude": best["parameters"]["spine.amplitude"], "phase": best["parameters"]["spine.phase"],
        "speed": best["metrics"]["speed"], "share": best["metrics"]["speed"] / dense, "runs": len(speed),
        "runs_to_99": int(reached[0]) + 1 if len(reached) else None, "wall_s": wall, "first_share": speed[0] / dense,
    }  # fmt: skip
