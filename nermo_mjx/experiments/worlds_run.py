"""Runs a batch of worlds: its columns for the result table, and its recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from nermo_mjx.experiments.cases import Worlds
from nermo_mjx.experiments.outcome import Column
from nermo_mjx.rollout import METRICS, Run, RunResult, Simulator
from nermo_mjx.view.recording import Recording, recording_of


def measured(
    simulator: Simulator, batch: Worlds, run: Run, *, progress: Callable[[float], None] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Column]]:
    """Labels, metrics and status of each world, and what the measured columns mean."""
    return table_of(batch, simulator.run(batch.values, run, progress=progress))


def recorded(simulator: Simulator, batch: Worlds, run: Run, names: Sequence[str]) -> dict[str, Recording]:
    """The recording of each world, by the names given."""
    return recordings_of(simulator, batch, simulator.run(batch.values, run, record=True), dict(enumerate(names)))


def table_of(batch: Worlds, result: RunResult) -> tuple[dict[str, np.ndarray], dict[str, Column]]:
    """See `measured`."""
    columns = {**batch.labels, **result.metrics, "status": result.status}
    about = {name: Column(metric.unit, metric.doc) for name, metric in METRICS.items()}
    return columns, about | {"status": Column("1", "ok, or what became of the run")}


def recordings_of(
    simulator: Simulator, batch: Worlds, result: RunResult, names: Mapping[int, str]
) -> dict[str, Recording]:
    """The recordings of the worlds whose name is given."""
    recordings = {}
    for world, name in names.items():
        metadata = {
            "case": name,
            "setup": {"scene": simulator.setup.scene, "spine": simulator.setup.spine},
            "labels": {key: column[world].item() for key, column in batch.labels.items()},
            "parameters": {key: float(column[world]) for key, column in batch.values.items()},
            "metrics": {key: float(column[world]) for key, column in result.metrics.items()}
            | {"status": str(result.status[world])},
            "engine": result.engine,
        }
        recordings[name] = recording_of(result.trace, simulator.robot.model, world=world, metadata=metadata)
    return recordings
