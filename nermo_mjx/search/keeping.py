"""Rerunning a search's results: the recordings that it keeps, and a row of its table for `replay`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq

from nermo_mjx.runs.files import clear_errors
from nermo_mjx.search.batches import SEARCH, Batches
from nermo_mjx.search.outcome import Evaluations
from nermo_mjx.search.scoring import elites_of
from nermo_mjx.search.spec import Search
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.keeping import recording_file
from nermo_mjx.sweep.replay import SweepRow
from nermo_mjx.sweep.results import Results, chunk_files, read_table
from nermo_mjx.sweep.sampling import Rows
from nermo_mjx.sweep.simulating import SimulatorLike, SweepSimulator
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


def keep_recordings(batches: Batches, best: dict[str, Any], computer: SweepSimulator) -> list[Path]:
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
            _record(found, {row: files[row] for row in missing[first : first + _TOGETHER]}, computer.simulator())
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


def find_evaluation(out: str | os.PathLike[str], row: int) -> SweepRow:
    """A row of a search's table, for `replay_row`; nothing is written, so the search may be at work there.

    Raises:
        SpecError: no search is there that can be read, or no such row.
        DirectoryError: it has no results yet.
    """
    out = Path(out)
    search = Search.from_file(out / SEARCH)
    table = read_table(out)
    if not 0 <= row < table.num_rows:
        raise SpecError(f"row is {row}: allowed is 0 to {table.num_rows - 1}, as far as the search has come.")
    stored = table.slice(row, 1).to_pylist()[0]
    values = {name: np.array([stored[name]]) for name in columns_of(table, "varied", "randomized")}
    index = {name: np.array([stored[name]]) for name in ("variant", "repeat", "seed")}
    walk = search.sweep.structures[0]
    rate = walk.setup.cycle_rate(walk.constants | {name: column[0] for name, column in values.items()})
    begin, end = walk.run.seconds(rate)
    return SweepRow(
        out=out, sweep=search.sweep, row=row, line=Rows(**index, values=values, structure=np.zeros(1, int)),
        begin=float(begin), end=float(end), engine=_engine_of(out),
        chunk=np.array([row]), stored=stored, outdated=False,
    )  # fmt: skip


def _engine_of(out: Path) -> str:
    """The engine of the first batch, which a directory keeps."""
    return pq.read_schema(next(iter(chunk_files(out).values()))).metadata[b"engine"].decode()
