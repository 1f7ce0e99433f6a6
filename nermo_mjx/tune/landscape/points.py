"""The points of a landscape: evaluated in batches of one size, and stored as a table."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa

from nermo_mjx.runs.files import DirectoryError, WrongDirectory, content_of, parquet_table
from nermo_mjx.specs.reading import changes
from nermo_mjx.sweep.table import Columns
from nermo_mjx.tune.estimators import Estimator
from nermo_mjx.tune.landscape.batches import Batches
from nermo_mjx.tune.landscape.plan import CENTRES, WIDTHS, Plan
from nermo_mjx.tune.objective import Problem
from nermo_mjx.tune.optimizer import Optimizer
from nermo_mjx.tune.spec import Tuning

#: Files of a directory: all points, and the resolved tuning whose objective they are of.
TABLE: Final = "landscape.parquet"
TUNING: Final = "landscape.yaml"
#: Worlds of a batch at most: a minute of gradients on two cores, and what a device holds.
CPU_BATCH, DEVICE_BATCH = 64, 1024
#: In the metadata of the table: its key, and what that is of.
KEY: Final = "landscape"
IDENTITY: Final = "identity"


def batch_size(count: int) -> int:
    """Worlds of each batch: as even as they can be."""
    most = CPU_BATCH if jax.default_backend() == "cpu" else DEVICE_BATCH
    return math.ceil(count / math.ceil(count / most))


def evaluate(
    tuning: Tuning,
    problem: Problem,
    plan: Plan,
    progress: Callable[[int, int], None],
    about: dict[str, str],
    batches: Batches,
) -> tuple[pa.Table, int]:
    """Value and gradient at all points, one row per point; and how many of them were evaluated now.

    All batches have one size, the last one is filled up with its last point: one program is compiled.

    Args:
        progress: called with the points done, and all of them.
        about: what to note in the schema's metadata.
        batches: where each batch is kept as soon as it is evaluated, and found again.
    """
    began, evaluated, size = time.perf_counter(), 0, batches.size
    progress(0, len(plan))
    found = []
    for first in range(0, len(plan), size):
        count = min(size, len(plan) - first)
        rows = batches.read(first)
        if rows is None:
            wanted = np.minimum(np.arange(first, first + size), len(plan) - 1)
            rows = {name: column[:count] for name, column in _batch(tuning, problem, plan.points[wanted]).items()}
            rows = batches.write(first, rows)
            evaluated += count
        found.append(rows)
        progress(first + count, len(plan))
    columns = {name: np.concatenate([part[name] for part in found]) for name in found[0]}
    about = about | {"wall_seconds": f"{time.perf_counter() - began:.3f}", "batch": str(size),
                     "batches": str(len(found)), "precision": str(columns["value"].dtype)}  # fmt: skip
    return _table(tuning, plan, columns.pop("point"), columns, about), evaluated


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


def read(path: Path, wanted: Mapping[str, Any] | None = None) -> pa.Table | None:
    """The table of a file; None if there is none.

    Args:
        wanted: the expected identity, see `identity`; any if it is None.

    Raises:
        DirectoryError: it is another one's, damaged, or cannot be read now.
    """
    content = content_of(path)
    if content is None:
        return None
    table = parquet_table(content)
    if table is None:
        raise DirectoryError(f"{path} is damaged: remove it, or choose another directory.")
    notes = {name.decode(): text.decode() for name, text in (table.schema.metadata or {}).items()}
    if wanted is not None and notes.get(KEY) != key(wanted):
        known = json.loads(notes[IDENTITY]) if IDENTITY in notes else wanted
        apart = changes(*({name: each[name] for name in each if name != "digest"} for each in (known, wanted)))
        which = f", with another {', '.join(apart)}" if apart else ""
        raise WrongDirectory(f"{path.parent} holds another landscape{which}; choose another directory.")
    return table


def identity(tuning: Tuning, points: int, span: float) -> dict[str, Any]:
    """All that determines the table: not a tuner's path, so not optimizer, estimator, starts and seed."""
    walk = dataclasses.replace(tuning, optimizer=Optimizer("adam"), estimator=Estimator(), starts=1, seed=0)
    about = walk.identity()
    lines = {"points": points, "span": span, "centres": CENTRES, "widths": list(WIDTHS)}
    return {
        **about["fields"],
        **about["defaults"],
        "recording": about["recording"][:8],
        "digest": walk.digest(),
        **lines,
    }


def key(identity: Mapping[str, Any]) -> str:
    """A hash of an identity."""
    decisive = [identity[name] for name in ("digest", "points", "span", "centres", "widths")]
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
        metric = (tuning.metrics | tuning.objective_metrics)[name]
        table.add(name, found[f"metric.{name}"], "metric", metric.unit, metric.doc)
    table.add("ok", ok, "status", "1", "whether the robot walked to the end, with a finite gradient")
    made_by = "which code made the row, by its name in run.json; empty: not known"
    table.add("code", found["code"], "code", "1", made_by)
    return table.table(about)
