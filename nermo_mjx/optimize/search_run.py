"""Run a search: request points, simulate the batches that the directory lacks, report the results to the method."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.optimize.search_directory import SEARCH_FILE, Batches, keep_recordings, publish
from nermo_mjx.optimize.search_figures import search_figures_of
from nermo_mjx.optimize.search_methods import (
    Scores,
    Space,
    check_library,
    find_cells,
    score_points,
    searcher,
)
from nermo_mjx.optimize.search_spec import Search
from nermo_mjx.physics import resolve_engine
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.progress import shows_progress
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout import Simulator
from nermo_mjx.runs import RunDirectory, session
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.job import SILENT, Forecast, JobFailed, Progress, Watch, resumable
from nermo_mjx.runs.rows import part_files
from nermo_mjx.runs.workers import LocalWorkers, TaskFailed, Workers
from nermo_mjx.runtime import cpu_count
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.simulating import (
    Simulated,
    SimulatorLike,
    SweepSimulator,
    chunk_rows_here,
    engine_name,
    pace,
)
from nermo_mjx.sweep.spec import Rows, Sample
from nermo_mjx.sweep.store import batch_values
from nermo_mjx.sweep.table import Results, read_table

# ---
# A search evaluates batches until its budget is used up.


#: Worlds for each core with MuJoCo C, half as many as in a sweep: 16 worlds keep two cores busy, and a method is better
#: after 64 points if it receives results after every 16 of them.
CORE_WORLDS: Final = 8
#: Worlds for each core for an atlas, which has several emitters in a batch.
ATLAS_WORLDS: Final = 32
#: Least number of batches within a budget.
BUDGET_GENERATIONS: Final = 10


def batch_points(search: Search, engine: str) -> int:
    """Number of points of a batch on this machine.

    Args:
        engine: Name of the engine, or "auto".
    """
    expected = search.evaluations or 1000
    least = 4 + int(3 * math.log(len(search.names)))
    if resolve_engine(engine) == "c":
        full = (
            cpu_count() * (ATLAS_WORLDS if search.aim.measures else CORE_WORLDS) // search.repeats
        )
    else:
        full = chunk_rows_here(engine, expected * search.repeats) // search.repeats
    return max(least, 4, min(full, expected // BUDGET_GENERATIONS))


#: Seconds between two updates of best.json and the atlas while the search runs.
PUBLISHED_EVERY: Final = 60.0


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """The result of a search.

    Attributes:
        out: Directory of the search.
        search: Search with the size of its batches.
        best: Content of best.json (`nermo_mjx.optimize.search_directory`).
        evaluations_run: Number of points that this call evaluated.
        recordings, plots: Paths of the recordings and figures.
    """

    out: Path
    search: Search
    best: dict[str, Any]
    evaluations_run: int
    recordings: list[Path]
    plots: list[Path]

    @property
    def table(self) -> pa.Table:
        """The table of all runs, which is read from the directory at each use; see `nermo_mjx.sweep.read_table`."""
        return read_table(self.out)


@shows_progress("search", "evaluations")
def run_search(
    spec: Search | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    watch: Watch = SILENT,
    progress: bool = True,
    accept_new_code: bool = False,
    workers: Workers | None = None,
    simulator: SimulatorLike | None = None,
) -> SearchResult:
    """Search into a directory, or resume what it contains.

    >>> import tempfile
    >>> spec = {"vary": {"frequency": {"uniform": [0.6, 0.8]}}, "run": {"duration": 0.2}, "budget": 8, "batch": 4,
    ...         "objective": {"maximize": "speed"}, "plots": False}
    >>> result = run_search(spec, tempfile.mkdtemp(), engine="c")
    >>> sorted(result.best["parameters"]), result.best["evaluations"]
    (['frequency'], 8)

    Each batch is stored before the next one is requested. A resumed search repeats the stored batches, so that a killed
    process loses only the batch in progress, and the results are the same, on the engine `c` bit for bit.

    Args:
        spec: A `Search`, a dict with the fields of a search file, or the path of a search file.
        out: Directory of the search; see `nermo_mjx.optimize.search_directory`.
        engine: Engine of the simulator; "auto" is the engine of the directory's results, if there are any.
        watch: Receiver of the progress, and of messages about parts that are damaged and simulated again.
        progress: Whether to show a progress bar in a terminal or notebook, if there is no watch.
        accept_new_code: Whether to resume a directory that other code or another engine started.
        workers: Workers that simulate, such as `nermo_mjx.runs.ray_workers.RayWorkers`; by default this process.
        simulator: Replaces `Simulator(search.setup, engine)`.

    Raises:
        SpecError, DirectoryError, OtherCode, JobFailed, Interrupted: see "Errors of jobs" in docs/reference/python.md.
    """
    search = Search.of(spec)
    check_library(search.method)
    workers = LocalWorkers() if workers is None else workers
    with (
        RunDirectory(out, "search") as directory,
        resumable(directory.out, f"search {directory.out / SEARCH_FILE}") as interruption,
    ):
        watch = interruption.watched(watch)
        batches = Batches(directory, search, lambda: batch_points(search, engine), watch.warn)
        ran = engine_name(engine, simulator, engine_of(batches.out))
        computer = SweepSimulator(search.sweep.structures, ran, simulator, watch.notify)
        loop = SearchLoop(batches, workers, computer, watch)
        loop.run(accept_new_code)
        search = batches.search
        best = publish(batches, complete=True)
        if not best:
            raise JobFailed(
                f"{batches.out}: no point of this search walked to its end within its constraints: choose other "
                "bounds, or looser constraints."
            )
        recordings = keep_recordings(batches, best, computer)
        results = Results(part_files(batches.out))
        plots = (
            write_figures(search_figures_of(search, results), batches.out / "plots")
            if search.plots
            else []
        )
        return SearchResult(batches.out, search, best, loop.evaluated, recordings, plots)


class SearchLoop:
    """The batches of a search, one after another. `evaluated` is the number of points that this process evaluated."""

    def __init__(
        self, batches: Batches, workers: Workers, computer: SweepSimulator, watch: Watch
    ) -> None:
        self._batches = batches
        self._workers = workers
        self._computer = computer
        self._watch = watch
        self._search, self._size = batches.search, batches.search.batch or 1
        self.evaluated = self._evaluations = self._resumed = 0
        self._seconds = 0.0  # simulated so far
        self._measured = False  # whether some run walked to its end
        self._best: float | None = None
        self._cells = set[int]()

    def run(self, accept: bool) -> None:
        """Run batches until the budget is used up; batches that the directory lacks are simulated."""
        search = self._search
        repeats = self._search.repeats
        stamp = None
        published = time.monotonic()
        method, shares, batch = searcher(search, self._size), np.empty((0, len(search.names))), 0
        while search.budget_share(self._evaluations, self._seconds) < 1.0:
            request = method.ask()
            shares = np.concatenate([shares, request.points])
            # The repeats of a point are consecutive rows; its random values depend on the point and the repeat.
            first = self._evaluations * repeats
            rows = Sample(search.sweep, shares).take(np.arange(first, len(shares) * repeats))
            table = self._batches.read(batch, rows)
            if table is None:
                if stamp is None:  # the first missing batch
                    self._resumed = self._evaluations
                    self._report()
                    stamp = self._workers.begin(self._computer)
                    self._batches.runs.take_codes([stamp], accept=accept)
                    session_text = session(
                        engine=self._computer.engine, code=stamp.id, begun_at=self._evaluations
                    )
                    self._batches.held.note_session(session_text)
                table = self._batches.write(batch, rows, first, self._simulate(batch, rows), stamp)
                self.evaluated += len(request.points)
            self._evaluations, batch = len(shares), batch + 1
            self._seconds += float(np.sum(search.seconds(rows.values, len(rows))))
            method.tell(self._scores(table))
            self._report()
            if stamp is not None and time.monotonic() - published > PUBLISHED_EVERY:
                publish(self._batches, complete=False)
                published = time.monotonic()

    def _report(self, share: float = 0.0) -> None:
        """Report the progress of the search; `share` is the completed share of the next batch."""
        search = self._search
        part = share * (
            search.budget_share(self._size, 0.0) if search.evaluations is not None else 0.0
        )
        fraction = min(1.0, search.budget_share(self._evaluations, self._seconds) + part)
        cells = {"cells": float(len(self._cells))} if search.aim.measures else {}
        done = Progress(
            fraction,
            self._evaluations,
            search.evaluations,
            self._resumed,
            best=self._best,
            numbers=cells,
        )
        self._watch.progress(done)

    def _simulate(self, batch: int, rows: Rows) -> Simulated:
        """Simulate all runs of a batch in tasks of one size, so that a growing population needs no new compilation."""
        size = math.ceil(self._size * self._search.repeats / self._workers.parts)
        parts = [np.arange(len(rows))[begin : begin + size] for begin in range(0, len(rows), size)]

        def tasks() -> Iterator[tuple[int, tuple[int, Mapping[str, np.ndarray]]]]:
            for k, part in enumerate(parts):  # on the engine c, tasks need not have the same size
                filled = len(part) if self._computer.engine == "c" else size
                yield k, (0, batch_values(self._search.sweep, rows.take(part), filled))

        began = time.perf_counter()
        try:
            parts_by_key = dict(
                self._workers.results(
                    tasks(), lambda k, share: self._report((k + share) / len(parts))
                )
            )
        except TaskFailed as failed:
            task_name = f"batch {batch} of {self._batches.out}"
            if isinstance(failed.error, ParameterError):
                raise SpecError(f"{task_name} is refused: {failed.error}") from failed.error
            reason = (str(failed.error).strip().splitlines() or [""])[0].rstrip(".")[:300]
            raise JobFailed(
                f"{task_name} failed: {type(failed.error).__name__}: {reason}. What is finished is kept: run the same "
                "command again when it is fixed."
            ) from failed.error
        part_results = [(parts_by_key[k], slice(len(part))) for k, part in enumerate(parts)]
        names = part_results[0][0].metrics
        metrics = {
            name: np.concatenate(
                [simulated.metrics[name][part_slice] for simulated, part_slice in part_results]
            )
            for name in names
        }
        status = np.concatenate(
            [simulated.status[part_slice] for simulated, part_slice in part_results]
        )
        return Simulated(
            metrics,
            status,
            sum(simulated.steps for simulated, _ in part_results),
            time.perf_counter() - began,
        )

    def _scores(self, table: pa.Table) -> Scores:
        """The scores of a batch's points from its rows."""
        aim = self._search.aim
        metrics = {name: table.column(name).to_numpy() for name in aim.metrics}
        well = np.array(table.column("status").to_pylist()) == "ok"
        for name in aim.metrics if well.any() and not self._measured else ():
            if not np.isfinite(metrics[name][well]).any():
                description = self._search.sweep.metrics[name].doc
                raise JobFailed(
                    f"{name} has no number in all {well.sum()} walks of the first batch ({description}): ask for another "
                    "metric, or change the walk."
                )
        self._measured = self._measured or bool(well.any())
        scores = score_points(aim, self._search.repeats, metrics, well)
        if aim.measures:
            self._cells |= {
                int(cell)
                for cell in find_cells(aim, scores.measures)[scores.is_allowed]
                if cell >= 0
            }
        if not aim.pareto and scores.is_allowed.any():
            lowest_cost = float(scores.cost[scores.is_allowed, 0].min())
            self._best = lowest_cost if self._best is None else min(self._best, lowest_cost)
        return scores


#: Number of points in the estimate of the mean length of a run.
_TIMED_POINTS = 256
#: Bytes of a row of the table.
_ROW_BYTES = 700


def search_forecast(
    search: Search, engine: str = "auto", simulator: SimulatorLike | None = None
) -> Forecast:
    """Estimate the cost of a whole search from the mean length of a run within the bounds.

    The counts are `batches`, the `evaluations` and `runs` in all batches, and `evaluations_per_batch`.

    Args:
        engine: Engine of the simulator.
        simulator: Replaces `Simulator(search.setup, engine)`.

    Raises:
        ParameterError: The engine is unknown, or a library is missing.
    """
    check_library(search.method)
    engine = resolve_engine(engine)
    batch = search.batch or batch_points(search, engine)
    shares = Space(search).initial_shares(_TIMED_POINTS)
    rows = Sample(search.sweep, shares).take(
        np.arange(0, len(shares) * search.repeats, search.repeats)
    )
    point = search.repeats * float(np.mean(search.seconds(rows.values, len(rows))))
    pending = (
        search.evaluations
        if search.evaluations is not None
        else (search.simulated_seconds or 0.0) / point
    )
    batches = math.ceil(pending / batch)
    evaluations = batches * batch
    simulator = simulator or Simulator(search.setup, engine)
    rate, runs = pace(simulator, search.setup, batch * search.repeats), evaluations * search.repeats
    counts = {
        "evaluations": evaluations,
        "batches": batches,
        "evaluations_per_batch": batch,
        "runs": runs,
    }
    pace_note = f"{rate:,.0f} simulated seconds/s, measured now"
    return Forecast(
        engine,
        counts,
        evaluations * point,
        evaluations * point / rate,
        pace_note,
        runs * _ROW_BYTES,
    )
