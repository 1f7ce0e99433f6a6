"""The directory of a search: its batches, and the files that are made from them.

DIR/search.yaml       the resolved search, and the size of its batches
DIR/results/          the rows, one part for each batch, see `nermo_mjx.runs.rows`
DIR/results.aside/    parts that were damaged or contained other points, and were simulated again
DIR/best.json, DIR/best.yaml, DIR/atlas.parquet, DIR/recordings/, DIR/plots/   made from the rows
DIR/run.json          the codes and sessions that made the directory

The directory also contains copies of the user's code. Files that do not match are renamed DIR/*.aside-N, not deleted.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.optimize.directory import BEST, other_spec_error, read_spec, sweep_text
from nermo_mjx.optimize.search_methods import find_elites, library_version
from nermo_mjx.optimize.search_results import Evaluations, atlas_progress, atlas_table, hypervolumes
from nermo_mjx.optimize.search_spec import Search
from nermo_mjx.runs import RunDirectory
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.files import DirectoryError, clear_errors, parquet_bytes, stored_json, to_json
from nermo_mjx.runs.rows import RESULTS, Runs, opened_part, part_files
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.specs.controllers import with_code_copied
from nermo_mjx.specs.reading import SpecError, changes
from nermo_mjx.sweep.replay import SweepRow, recording_file
from nermo_mjx.sweep.simulating import Simulated, SweepSimulator
from nermo_mjx.sweep.spec import Rows
from nermo_mjx.sweep.store import keys_of_rows
from nermo_mjx.sweep.table import RECORDINGS, chunk_table, columns_of, read_table

SEARCH_FILE: Final = "search.yaml"
ATLAS: Final = "atlas.parquet"


# ---
# A search's directory: each batch is a part of its rows, which is written before the next batch is requested.


#: Largest difference between the points of a stored batch and the requested points, as a fraction of the bounds. The
#: points can differ because eigenvectors differ between machines in their last digits.
APART: Final = 1e-6


class Batches:
    """The batches of one search in a directory that this process has locked.

    Attributes:
        search: Search with the size of the batches, and with the directory's copies of code.
        runs: Stored rows.
    """

    def __init__(
        self,
        directory: RunDirectory,
        search: Search,
        size: Callable[[], int],
        warn: Callable[[str], None],
    ) -> None:
        """Claim the directory for a search.

        Args:
            size: Function that returns the size of a batch if neither the search nor the directory has one.
            warn: Function that receives a message about parts that are damaged, and simulated again.

        Raises:
            DirectoryError: The directory contains another search, or cannot be written.
        """
        self.held, self.out, self._warn = directory, directory.out, warn
        path, folder = self.out / SEARCH_FILE, self.out.resolve()
        former_spec = read_spec(
            path, "search", "results" if part_files(self.out) else "", Search.from_file
        )
        sweep = dataclasses.replace(
            search.sweep, setup=with_code_copied(search.setup, folder, directory.write)
        )
        batch = search.batch or (former_spec and former_spec.batch) or size()
        self.search = search = dataclasses.replace(search, sweep=sweep, batch=batch)
        if former_spec and former_spec.digest() != search.digest():
            other_order = ["order of the parameters under vary"]
            raise other_spec_error(
                path, "search", changes(former_spec.decisive(), search.decisive()) or other_order
            )
        if former_spec is None or former_spec.to_yaml(folder) != search.to_yaml(
            folder
        ):  # as with more recordings
            directory.write(SEARCH_FILE, search.to_yaml(folder).encode())
        self.runs = Runs(self.out, search.digest(), warn=warn, directory=directory)
        self._parts = {}
        for part in self.runs.parts:
            with opened_part(part.path) as file:
                self._parts[int(file.metadata.metadata[b"chunk"])] = part

    def read(self, batch: int, rows: Rows) -> pa.Table | None:
        """The table of a batch with these rows (see `APART`), or None. A batch with other rows is moved aside.

        Raises:
            DirectoryError: Another version of the library requested the points, or the batch cannot be read any more.
        """
        if (part := self._parts.get(batch)) is None:
            return None
        with opened_part(part.path) as file:
            table = file.read()
        near = table.column("variant").to_pylist() == rows.variant.tolist()
        for axis in self.search.sweep.axes if near else ():
            room = APART * (axis.numbers[1] - axis.numbers[0])
            stored = table.column(axis.name).to_numpy()
            near = near and np.allclose(stored, rows.values[axis.name], rtol=0.0, atol=room)
        if near:
            return table
        before = table.schema.metadata.get(b"optimizer", b"").decode()
        now = library_version(self.search.method)
        if before != now:
            raise DirectoryError(
                f"{part.path} holds points that {before} asked for, and {now} asks for others: install {before}, or "
                "choose another directory."
            )
        self.held.move_aside(part.path.relative_to(self.out), f"{RESULTS}.aside")
        self._warn(
            f"batch {batch} of {self.out} holds other points than those that follow from the batches before it; it is "
            f"kept in {RESULTS}.aside, and run again."
        )
        return None

    def write(
        self, batch: int, rows: Rows, first: int, simulated: Simulated, stamp: CodeStamp
    ) -> pa.Table:
        """Store a batch.

        Args:
            rows: Runs of the batch.
            first: Row of the first run in the table.
            simulated: Results, at least one for each run.
            stamp: Stamp of the code that simulated.
        """
        count = len(rows)
        metadata = {
            "engine": stamp.engine,
            "code": stamp.id,
            "chunk": batch,
            "steps": simulated.steps,
            "wall_seconds": simulated.seconds,
            "search": self.search.digest(),
            "optimizer": library_version(self.search.method),
        }
        metrics = {name: values[:count] for name, values in simulated.metrics.items()}
        index = first + np.arange(count)
        table = chunk_table(
            self.search.sweep, rows, index, metrics, simulated.status[:count], stamp.id, metadata
        )
        about_batch = {
            "unit": "1",
            "description": "batch that the run was part of",
            "role": "index",
        }
        table = table.add_column(
            1, pa.field("batch", pa.int64(), metadata=about_batch), pa.array([batch] * count)
        )
        self._parts[batch] = self.runs.add(keys_of_rows(self.search.sweep, rows), table)
        return table


def publish(batches: Batches, *, complete: bool) -> dict[str, Any]:
    """Write best.json, best.yaml and atlas.parquet from the table, and return best.json, empty without a best point.

    best.json contains `parameters`, `objective`, `metrics` (SI units and radians, means over the repeats) and the first
    `row` of the best point; the numbers of `evaluations` and of `failed` ones (a run fell or diverged),
    `simulated_seconds`, and whether the search is `complete`. For a front, it also contains `front`, with the same values
    for each point, and `hypervolume`; for an atlas `cells`, `filled` and `qd_score`.
    """
    evaluations = Evaluations.of(batches.search, batches.out)
    best_index = evaluations.best()
    if best_index is None:
        return {}
    best: dict[str, Any] = evaluations.describe(np.array([best_index]))[0]
    best |= {"evaluations": len(evaluations.scores), "failed": int((~evaluations.scores.ok).sum())}
    best |= {"simulated_seconds": evaluations.simulated_seconds, "complete": complete}
    if batches.search.aim.pareto:
        best |= {
            "front": evaluations.describe(evaluations.front()),
            "hypervolume": float(hypervolumes(evaluations)[0][-1]),
        }
    if batches.search.aim.measures:
        filled, total = atlas_progress(evaluations)
        cells = int(np.prod([measure.cells for measure in batches.search.aim.measures]))
        best |= {"cells": cells, "filled": int(filled[-1]), "qd_score": float(total[-1])}
        batches.held.write(ATLAS, parquet_bytes(atlas_table(evaluations)))
    batches.held.write(BEST, to_json(best))
    head = f"Row {best['row']} of a search: objective {best['objective']}."
    sweep = batches.search.sweep
    best_sweep = sweep_text(sweep, head, best["parameters"], sweep.seed, batches.out.resolve())
    batches.held.write("best.yaml", best_sweep.encode())
    return best


# ---
# Results of a search are run again for its recordings, and `replay` repeats a row of its table.


#: Number of worlds that are recorded at once; a recording of ten seconds needs 1.5 MB.
_RECORDED_BATCH: Final = 32


def rows_to_record(evaluations: Evaluations, best: int) -> list[int]:
    """First rows of the points to record: the best ones, or evenly along the front or over the cells of an atlas.

    Args:
        best: Best point, which is always recorded.
    """
    search, count = evaluations.search, evaluations.search.keep
    if not count:
        return []
    if search.aim.kind == "objective":
        order = np.argsort(
            np.where(evaluations.scores.is_allowed, evaluations.scores.cost[:, 0], np.inf),
            kind="stable",
        )
        points = order[: min(count, int(evaluations.scores.is_allowed.sum()))]
    else:
        points = (
            find_elites(search.aim, evaluations.scores)[1]
            if search.aim.measures
            else evaluations.front()
        )
        points = points[np.unique(np.linspace(0, len(points) - 1, count).round().astype(int))]
        if best not in points:
            points[
                np.abs(
                    evaluations.scores.cost[points, 0] - evaluations.scores.cost[best, 0]
                ).argmin()
            ] = best
    return (np.sort(points) * search.repeats).tolist()


def keep_recordings(batches: Batches, best: dict[str, Any], computer: SweepSimulator) -> list[Path]:
    """Record as many points as `keep` requires, as DIR/recordings/row-000123.npz; existing recordings stay.

    Raises:
        RecordingError, DirectoryError: A recording cannot be written.
    """
    search, evaluations = batches.search, Evaluations.of(batches.search, batches.out)
    rows = rows_to_record(evaluations, best["row"] // search.repeats)
    files = {row: recording_file(batches.out, row) for row in rows}
    missing_rows = [row for row, path in files.items() if not path.exists()]
    if missing_rows:
        with clear_errors(batches.out):
            (batches.out / RECORDINGS).mkdir(exist_ok=True)
    sampled_columns = columns_of(evaluations.results, "varied", "randomized")
    for first in range(0, len(missing_rows), _RECORDED_BATCH):
        part = missing_rows[first : first + _RECORDED_BATCH]
        values = {name: np.full(len(part), value) for name, value in search.sweep.constants.items()}
        values |= {
            name: column[part] for name, column in evaluations.results.columns(sampled_columns)
        }
        result = computer.simulator().run(values, search.run, record=True)
        for world, (row, end) in enumerate(
            zip(part, search.seconds(values, len(part)).tolist(), strict=True)
        ):
            result.recording(world).between(0.0, end).save(files[row])
    return list(files.values())


def find_evaluation(out: str | os.PathLike[str], row: int) -> SweepRow:
    """A row of a search's table, for `replay_row`. The directory is only read, so that the search may be running.

    Raises:
        SpecError: The directory contains no readable search, or the row does not exist.
        DirectoryError: The search has no results yet.
    """
    out = Path(out)
    search = Search.from_file(out / SEARCH_FILE)
    table = read_table(out)
    if not 0 <= row < table.num_rows:
        raise SpecError(
            f"row is {row}: allowed is 0 to {table.num_rows - 1}, as far as the search has come."
        )
    stored = table.slice(row, 1).to_pylist()[0]
    values = {name: np.array([stored[name]]) for name in columns_of(table, "varied", "randomized")}
    index = {name: np.array([stored[name]]) for name in ("variant", "repeat", "seed")}
    line = Rows(**index, values=values, structure=np.zeros(1, int))
    with opened_part(part_files(out)[0]) as file:
        engine = file.schema_arrow.metadata[b"engine"].decode()
    return SweepRow(out, search.sweep, row, line, engine, stored)


# ---
# The progress of a search.


def search_status(out: Path) -> Status:
    """Status of a search's directory: the number of its evaluated points."""
    notes, search, runs = list[str](), None, 0
    try:
        search = Search.from_file(out / SEARCH_FILE)
    except (SpecError, OSError) as error:
        notes.append(f"Its search cannot be read: {error}")
    for path in part_files(out):
        if metadata := metadata_of(path, notes, "it will be run again."):
            runs += metadata.num_rows
    point_count = runs // (1 if search is None else search.repeats)
    budget = None if search is None else search.evaluations
    reached = False
    try:
        best = stored_json(out / BEST) or {}
        spent = (
            0.0
            if search is None
            else search.budget_share(best["evaluations"], best["simulated_seconds"])
        )
        reached = bool(best["complete"]) and spent >= 1.0 and best["evaluations"] == point_count
    except (TypeError, KeyError):
        pass
    return status_of(
        "evaluations",
        out,
        point_count,
        budget,
        reached,
        command="search",
        spec=SEARCH_FILE,
        engine=engine_of(out),
        notes=notes,
    )
