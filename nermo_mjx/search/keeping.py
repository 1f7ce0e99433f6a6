"""Recordings of what a search found: rows of its table run once more."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from nermo_mjx.runs.files import clear_errors
from nermo_mjx.search.batches import Batches
from nermo_mjx.search.outcome import Evaluations
from nermo_mjx.search.scoring import elites_of
from nermo_mjx.sweep.keeping import recording_file
from nermo_mjx.sweep.results import Results, chunk_files
from nermo_mjx.sweep.simulating import BatchSimulator, SimulatorLike
from nermo_mjx.sweep.store import RECORDINGS
from nermo_mjx.sweep.table import columns_of

#: Worlds recorded at once: a walk of ten seconds is 1.5 MB.
_TOGETHER: Final = 32


def kept_rows(found: Evaluations, best: int) -> list[int]:
    """First rows of the points to record: the best ones, or evenly along the front or over the cells of an atlas.

    Args:
        best: the best point, which is always among them.
    """
    search, count = found.search, found.search.keep
    if not count:
        return []
    if search.aim.kind == "objective":
        order = np.argsort(np.where(found.scores.allowed, found.scores.cost[:, 0], np.inf), kind="stable")
        points = order[: min(count, int(found.scores.allowed.sum()))]
    else:
        points = elites_of(search.aim, found.scores)[1] if search.aim.measures else found.front()
        points = points[np.unique(np.linspace(0, len(points) - 1, count).round().astype(int))]
        if best not in points:
            points[np.abs(found.scores.cost[points, 0] - found.scores.cost[best, 0]).argmin()] = best
    return (np.sort(points) * search.repeats).tolist()


def keep_recordings(batches: Batches, best: dict[str, Any], computer: BatchSimulator) -> list[Path]:
    """Record what `keep` asks for, as DIR/recordings/row-000123.npz; what is there already stays.

    Raises:
        RecordingError, DirectoryError: one cannot be written.
    """
    found = Evaluations.of(batches.search, Results([*chunk_files(batches.out).values()]))
    rows = kept_rows(found, best["row"] // batches.search.repeats)
    files = {row: recording_file(batches.out, row) for row in rows}
    missing = [row for row, path in files.items() if not path.exists()]
    if missing:
        with clear_errors(batches.out):
            (batches.out / RECORDINGS).mkdir(exist_ok=True)
        for first in range(0, len(missing), _TOGETHER):
            _record(found, {row: files[row] for row in missing[first : first + _TOGETHER]}, computer.simulator)
    return list(files.values())


def _record(found: Evaluations, files: dict[int, Path], simulator: SimulatorLike) -> None:
    """Run some rows of the table, and record each until its own end."""
    search, rows = found.search, list(files)
    drawn = columns_of(found.results, "varied", "randomized")
    values = {name: np.full(len(rows), value) for name, value in search.sweep.constants.items()}
    values |= {name: column[rows] for name, column in found.results.columns(drawn)}
    result = simulator.run(values, search.run, record=True)
    rate = search.setup.cycle_rate({name: values[name] for name in search.setup.timing if name in values})
    ends = np.broadcast_to(search.run.seconds(rate)[1], len(rows))
    for world, (path, end) in enumerate(zip(files.values(), ends.tolist(), strict=True)):
        result.recording(world).between(0.0, end).save(path)
