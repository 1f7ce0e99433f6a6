"""The landscape behind a tuning's paths: its objective on a grid of one or two parameters, by MuJoCo C in one batch."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from nermo_mjx.runs import stamp
from nermo_mjx.runs.files import content_of, parquet_table
from nermo_mjx.sweep.simulating import SimulatorLike
from nermo_mjx.sweep.table import Columns
from nermo_mjx.tune.bounds import FURTHEST
from nermo_mjx.tune.objective import TRAJECTORY_ERROR
from nermo_mjx.tune.optimizer import Optimizer
from nermo_mjx.tune.sampling import Estimator
from nermo_mjx.tune.sections import Tuned
from nermo_mjx.tune.spec import Tuning

#: Points along each parameter: for one, and for two. The ends of a periodic one coincide, and are simulated once.
POINTS: Final = {1: 37, 2: 17}
#: File in a tuning's directory, so that it is simulated only once.
LANDSCAPE: Final = "plots/landscape.parquet"
_KEY: Final = b"landscape"


@dataclasses.dataclass(frozen=True)
class Background:
    """The objective on a grid.

    Attributes:
        axes: parameter name -> its values (n,), from bound to bound; one or two of them.
        value: objective (n,) or (n, m); NaN where the robot did not walk to the end.
        walks: how many walks it is from, and the engine that ran them.
    """

    axes: dict[str, np.ndarray]
    value: np.ndarray
    walks: str


def grid_axes(tuning: Tuning) -> dict[str, np.ndarray]:
    """The first one or two tuned parameters, and their values on the grid, both ends included."""
    chosen = tuning.tuned[:2]
    return {each.name: _nodes(each, POINTS[len(chosen)]) for each in chosen}


def simulate(
    tuning: Tuning,
    others: Mapping[str, float],
    simulator: SimulatorLike,
    progress: Callable[[float], None] | None = None,
) -> pa.Table:
    """Simulate the grid; one row per point: its parameters, the objective, the metrics that it uses, and the status.

    Args:
        others: values of the tuned parameters that are not on the grid.

    Raises:
        ParameterError: some point of the grid cannot be simulated; the message says why.
    """
    axes, periodic = grid_axes(tuning), {each.name for each in tuning.tuned if each.periodic}
    walked = [nodes[:-1] if name in periodic else nodes for name, nodes in axes.items()]
    grid = dict(zip(axes, (column.ravel() for column in np.meshgrid(*walked, indexing="ij")), strict=True))
    count = len(next(iter(grid.values())))
    fixed = {name: np.full(count, value) for name, value in {**tuning.constants, **others}.items()}
    result = simulator.run({**fixed, **grid}, tuning.run, progress=progress)
    status = np.asarray(result.status)
    value = np.where(status == "ok", np.asarray(tuning.objective.value(result.metrics), float), np.nan)
    table, parameters = Columns(), tuning.parameters
    for name, column in (grid | {name: fixed[name] for name in others}).items():
        table.add(name, column, "varied" if name in grid else "fixed", parameters[name].unit, parameters[name].doc)
    table.add("objective", value, "objective", "1", "value that is minimized; NaN where the robot fell")
    for name in tuning.objective.metrics:
        metric = tuning.metrics[name]
        table.add(name, np.asarray(result.metrics[name]), "metric", metric.unit, metric.doc)
    table.add("status", status, "status", "1", "ok, or how the run ended")
    made_by = stamp(tuning.setup.load().fingerprint, result.engine)
    about = {"landscape": key(tuning, others), "engine": result.engine, "code": json.dumps(made_by.fields())}
    return table.table(about)


def background_of(tuning: Tuning, table: pa.Table) -> Background:
    """The grid that `simulate` made a table of; the end of a periodic parameter is its beginning."""
    axes = grid_axes(tuning)
    periodic = [each.periodic for each in tuning.tuned[:2]]
    shape = [len(nodes) - wraps for nodes, wraps in zip(axes.values(), periodic, strict=True)]
    value = table.column("objective").to_numpy().reshape(shape)
    for i, wraps in enumerate(periodic):
        value = np.concatenate([value, value.take([0], axis=i)], axis=i) if wraps else value
    engine = (table.schema.metadata or {})[b"engine"].decode()
    return Background(axes, value, f"{table.num_rows} walks, engine {engine}")


def read(path: Path, tuning: Tuning, others: Mapping[str, float]) -> pa.Table | None:
    """The table of a file, if it is one and still the right one; raises `DirectoryError` if it cannot be read now."""
    content = content_of(path)
    table = None if content is None else parquet_table(content)
    if table is None:
        return None
    return table if (table.schema.metadata or {}).get(_KEY) == key(tuning, others).encode() else None


def has_background(tuning: Tuning) -> bool:
    """Whether the metrics of a walk are all that the objective needs: a recording is compared with in MJX only."""
    return TRAJECTORY_ERROR not in tuning.objective.metrics


def key(tuning: Tuning, others: Mapping[str, float]) -> str:
    """A hash of all that determines the grid: not the path over it, so not optimizer, estimator, starts and seed."""
    walk = dataclasses.replace(tuning, optimizer=Optimizer("adam"), estimator=Estimator(), starts=1, seed=0)
    nodes: Sequence[list[float]] = [values.tolist() for values in grid_axes(tuning).values()]
    return hashlib.sha256(json.dumps([walk.digest(), nodes, dict(others)]).encode()).hexdigest()[:16]


def _nodes(tuned: Tuned, count: int) -> np.ndarray:
    """Evenly from bound to bound; like the tuner's points, those of a bounded parameter stop short of the bounds."""
    share = np.linspace(0.0, 1.0, count)
    if not tuned.periodic:
        share = FURTHEST + (1.0 - 2.0 * FURTHEST) * share
    return tuned.low + (tuned.high - tuned.low) * share
