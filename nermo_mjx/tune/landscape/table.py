"""The points of a landscape as they were found: evaluated in batches of one size, and kept as a table."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.rollout import METRICS
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.sweep.table import Columns
from nermo_mjx.tune.evaluation import Problem
from nermo_mjx.tune.landscape.batches import Batches
from nermo_mjx.tune.landscape.plan import CENTRES, WIDTHS, Plan
from nermo_mjx.tune.objective import OBJECTIVE_METRICS
from nermo_mjx.tune.optimizer import Optimizer
from nermo_mjx.tune.sampling import Estimator
from nermo_mjx.tune.spec import Tuning

#: Worlds of a batch at most: a minute of gradients on two cores, and what a device holds.
CPU_BATCH, DEVICE_BATCH = 64, 1024
KEY: Final = b"landscape"


@dataclasses.dataclass(frozen=True)
class Evaluated:
    """A landscape's table, how many of its points were evaluated now, and the batches that it was made of."""

    table: pa.Table
    count: int
    batches: Batches


def evaluate(
    tuning: Tuning,
    problem: Problem,
    plan: Plan,
    progress: Callable[[int, int], None],
    about: dict[str, str],
    folder: Path,
) -> Evaluated:
    """Value and gradient at all points; one row a point.

    All batches have one size, the last one is filled up with its last point: one program is compiled.

    Args:
        progress: called with the points done, and all of them.
        about: what to note in the schema's metadata.
        folder: where each batch is kept as soon as it is evaluated, and found again.
    """
    most = CPU_BATCH if jax.default_backend() == "cpu" else DEVICE_BATCH
    batches = math.ceil(len(plan) / most)
    size = math.ceil(len(plan) / batches)
    store = Batches(folder, about[KEY.decode()], size)
    began, evaluated = time.perf_counter(), 0
    progress(0, len(plan))
    found = []
    for first in range(0, len(plan), size):
        count = min(size, len(plan) - first)
        rows = store.read(first)
        if rows is None:
            wanted = np.minimum(np.arange(first, first + size), len(plan) - 1)
            rows = {name: column[:count] for name, column in _batch(tuning, problem, plan.points[wanted]).items()}
            store.write(first, rows)
            evaluated += count
        found.append(rows)
        progress(first + count, len(plan))
    columns = {name: np.concatenate([part[name] for part in found]) for name in found[0]}
    about = about | {"wall_seconds": f"{time.perf_counter() - began:.3f}", "batch": str(size),
                     "batches": str(batches), "precision": str(columns["value"].dtype)}  # fmt: skip
    return Evaluated(_table(tuning, plan, columns.pop("point"), columns, about), evaluated, store)


def _batch(tuning: Tuning, problem: Problem, wanted: np.ndarray) -> dict[str, np.ndarray]:
    """The numbers of a batch of points (n, p), and in `point` those at which they were found."""
    points = jnp.asarray(wanted, float)
    batch = problem.evaluate(points, True)
    assert batch.gradient is not None
    # In double precision, but at the very points that were evaluated: a secant divides by their distance.
    numbers = {"value": batch.value, "ok": batch.ok, **{f"metric.{n}": v for n, v in batch.metrics.items()}}
    rows = {name: np.asarray(column) for name, column in numbers.items()}
    rows |= {f"gradient.{name}": np.asarray(batch.gradient)[:, i] for i, name in enumerate(tuning.names)}
    return rows | {"point": np.asarray(points, float)}


def read(path: Path, wanted: str | None = None) -> pa.Table | None:
    """The table of a file; None if there is none.

    Args:
        wanted: its key; any if it is None.

    Raises:
        DirectoryError: it is another one's, or damaged.
    """
    if not path.exists():
        return None
    try:
        table = pq.read_table(path, page_checksum_verification=True, partitioning=None)
    except (OSError, pa.ArrowException, ValueError):
        raise DirectoryError(f"{path} is damaged: remove it, or choose another directory.") from None
    if wanted is not None and (table.schema.metadata or {}).get(KEY) != wanted.encode():
        raise DirectoryError(f"{path.parent} holds another landscape; choose another directory.")
    return table


def key(tuning: Tuning, points: int, span: float) -> str:
    """A hash of all that decides the table: not how a tuner would go, so not optimizer, estimator, starts and seed."""
    walk = dataclasses.replace(tuning, optimizer=Optimizer(), estimator=Estimator(), starts=1, seed=0)
    decisive = [walk.digest(), points, span, CENTRES, WIDTHS]
    return hashlib.sha256(json.dumps(decisive).encode()).hexdigest()[:16]


def _table(
    tuning: Tuning, plan: Plan, points: np.ndarray, found: dict[str, np.ndarray], about: dict[str, str]
) -> pa.Table:
    table, parameters = Columns(), tuning.parameters
    names = np.array(tuning.names, dtype=object)
    table.add("line", names[plan.line], "index", "1", "parameter that changes along the line")
    table.add("centre", plan.centre, "index", "1", "of a secant's end: position in the line of its middle; else -1")
    table.add("width", plan.width, "index", "1", "of a secant's end: share of the parameter's bounds; else 0")
    table.add("side", plan.side, "index", "1", "of a secant's end: -1 or 1; else 0")
    for i, name in enumerate(tuning.names):
        table.add(name, points[:, i], "parameter", parameters[name].unit, parameters[name].doc)
    ok = found["ok"].astype(bool)
    value = np.where(ok, found["value"], np.nan)
    table.add("objective", value, "objective", "1", "value that is minimized; NaN where the robot fell")
    for name in tuning.names:
        unit = "1" if parameters[name].unit == "1" else f"1/({parameters[name].unit})"
        slope = np.where(ok, found[f"gradient.{name}"], np.nan)
        table.add(f"gradient.{name}", slope, "gradient", unit, f"exact d objective / d {name}")
    for name in (name.removeprefix("metric.") for name in found if name.startswith("metric.")):
        metric = OBJECTIVE_METRICS.get(name) or METRICS[name]
        table.add(name, found[f"metric.{name}"], "metric", metric.unit, metric.doc)
    table.add("ok", ok, "status", "1", "whether the robot walked to the end, with a finite gradient")
    return table.table(about)
