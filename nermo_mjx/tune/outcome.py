"""What a tuning found: best.json for programs, and tuned.yaml, the tuned gait as a sweep file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from nermo_mjx.specs.reading import dump
from nermo_mjx.tune.history import Log, columns
from nermo_mjx.tune.spec import Tuning
from nermo_mjx.tune.stopping import is_done, why_done

#: Runs of tuned.yaml: from slightly different starts, so that the sweep shows whether the best point is fragile.
REPEATS: Final = 3


def best_of(tuning: Tuning, log: Log) -> dict[str, Any] | None:
    """The content of best.json: the evaluated point of the lowest objective; None if no robot walked to the end.

    `parameters` and `metrics` by name in SI units and radians; `objective`; `iteration` and `start` that it is from;
    `simulated_seconds` of the whole tuning and `simulated_seconds_to_best`, gradients at their cost in forward runs;
    `iterations` done, whether the tuning is `complete`, and why it `stopped` before its iterations were done, or null.
    """
    names = [column.name for column in columns(tuning, log.metrics)]
    value = log.rows[:, :, names.index("objective")]
    if not np.isfinite(value).any():
        return None
    iteration, start = (int(i) for i in np.unravel_index(np.nanargmin(value), value.shape))
    row = dict(zip(names, log.rows[iteration, start].tolist(), strict=True))
    return {
        "parameters": {name: row[name] for name in tuning.names},
        "objective": row["objective"],
        "metrics": {name: row[name] for name in log.metrics},
        "iteration": iteration,
        "start": start,
        "simulated_seconds": float(log.rows[-1, 0, names.index("simulated_seconds")]),
        "simulated_seconds_to_best": row["simulated_seconds"],
        "iterations": len(log) - 1,
        "complete": is_done(tuning, log),
        "stopped": why_done(tuning, log),
    }


def start_of(tuning: Tuning, log: Log) -> dict[str, Any]:
    """The given start, as its first evaluation found it: `parameters`, `objective`, `metrics`, and whether `ok`.

    Numbers are not finite where the robot did not walk to the end.
    """
    names = [column.name for column in columns(tuning, log.metrics)]
    row = dict(zip(names, log.rows[0, 0].tolist(), strict=True))
    return {
        "parameters": {name: row[name] for name in tuning.names},
        "objective": row["objective"],
        "metrics": {name: row[name] for name in log.metrics},
        "ok": bool(row["ok"]),
    }


def tuned_sweep(tuning: Tuning, best: dict[str, Any], folder: Path | None = None) -> str:
    """The text of tuned.yaml: setup, run and `set` of the best point, run a few times from slightly different starts.

    Args:
        tuning: what was tuned.
        best: the content of best.json.
        folder: where the file is to stand, see `walk_fields`.
    """
    known = tuning.parameters
    # float32 may lie a rounding error outside the allowed range: seven digits are significant.
    values = {name: float(np.clip(value, known[name].low, known[name].high))
              for name, value in best["parameters"].items()}  # fmt: skip
    numbers = {name: float(f"{value:.7g}") if math.isfinite(value) else value for name, value in values.items()}
    data = tuning.walk_fields(folder) | {"set": {**tuning.fixed, **numbers}, "randomize": {"repeats": REPEATS}}
    head = f"# Iteration {best['iteration']} of start {best['start']}: objective {best['objective']:.6g}.\n"
    return head + dump({**data, "seed": tuning.seed, "plots": False})
