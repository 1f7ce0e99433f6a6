"""Run a search: ask for a batch, simulate what the directory lacks, tell the results, until the budget is
used up.
"""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.optimize.methods import Asked, Gradients, WalkGradients, check_library, make_optimizer
from nermo_mjx.optimize.search import Scores, Search, Space, cells_of, scores_of
from nermo_mjx.optimize.search_directory import SEARCH, Batches, keep_recordings, publish
from nermo_mjx.optimize.search_figures import figures_of
from nermo_mjx.physics import resolve_engine
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Simulator
from nermo_mjx.runs import session
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.interruption import resumable
from nermo_mjx.runs.workers import LocalWorkers, TaskFailed, Workers
from nermo_mjx.runtime import cpu_count
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.results import Results, chunk_files, read_table
from nermo_mjx.sweep.sampling import Rows, Sample
from nermo_mjx.sweep.simulating import Simulated, SimulatorLike, SweepSimulator, chunk_rows_here, engine_name, pace
from nermo_mjx.sweep.store import batch_values

# ---
# The default number of points per batch: enough to fill the machine, few enough for many generations.


#: Worlds for each core with MuJoCo C. Half as many as in a sweep: two cores are busy with 16 worlds, and a method that
#: is told of each of 16 has gone further after 64.
CORE_WORLDS: Final = 8
#: An atlas has several emitters in a batch.
ATLAS_WORLDS: Final = 32
#: Generations that a budget is to last for.
GENERATIONS: Final = 10


def batch_points(search: Search, engine: str) -> int:
    """Points of a batch on this machine.

    Args:
        engine: name of the engine, or "auto".
    """
    expected = search.evaluations or 1000
    least = 4 + int(3 * math.log(len(search.names)))
    if resolve_engine(engine) == "c":
        full = cpu_count() * (ATLAS_WORLDS if search.aim.measures else CORE_WORLDS) // search.repeats
    else:
        full = chunk_rows_here(engine, expected * search.repeats) // search.repeats
    return max(least, 4, min(full, expected // GENERATIONS))


#: Seconds between two updates of best.json and the atlas while the search runs.
PUBLISHED_EVERY: Final = 60.0


class SearchInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM; the message says how to resume."""


class SearchFailed(RuntimeError):
    """A search that cannot continue; the message is one sentence that says why, and what to do."""


@dataclasses.dataclass(frozen=True)
class SearchProgress:
    """Progress of a search.

    Attributes:
        fraction: share of the budget that is used up, 0 to 1.
        evaluations: evaluated points.
        resumed: of these, how many an earlier session evaluated.
        best: objective of the best point so far, less is better; None without one, and of a front.
        filled: filled cells of an atlas, or points of the front.
    """

    fraction: float
    evaluations: int
    resumed: int
    best: float | None = None
    filled: int | None = None


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """A search's outcome.

    Attributes:
        out: its directory.
        search: what was searched, with the size of its batches.
        best: content of best.json (`nermo_mjx.optimize.search_directory`).
        evaluations_run: points that this call evaluated.
        recordings, plots: files that were made.
    """

    out: Path
    search: Search
    best: dict[str, Any]
    evaluations_run: int
    recordings: list[Path]
    plots: list[Path]

    @property
    def table(self) -> pa.Table:
        """The table of all runs, read from the directory at each use; see `nermo_mjx.sweep.read_table`."""
        return read_table(self.out)


def run_search(
    spec: Search | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    progress: Callable[[SearchProgress], None] | None = None,
    notify: Callable[[str], None] | None = None,
    warn: Callable[[str], None] | None = None,
    accept_new_code: bool = False,
    workers: Workers | None = None,
    simulator: SimulatorLike | None = None,
    gradients: Gradients | None = None,
) -> SearchResult:
    """Search into a directory, or resume what it contains.

    >>> import tempfile
    >>> spec = {"vary": {"frequency": {"uniform": [0.6, 0.8]}}, "run": {"duration": 0.2}, "budget": 8, "batch": 4,
    ...         "objective": {"maximize": "speed"}, "plots": False}
    >>> result = run_search(spec, tempfile.mkdtemp(), engine="c")
    >>> sorted(result.best["parameters"]), result.best["evaluations"]
    (['frequency'], 8)

    Each batch is stored before the next one is asked for. Resuming replays what is stored,
    so that killing the process loses only the batch in flight, and the same numbers come out: bit for bit on the
    engine `c`.

    Args:
        spec: a `Search`, a dict with the fields of a search file, or the path of one.
        out: the directory; see `nermo_mjx.optimize.search_directory`.
        engine: engine of the simulator; "auto" is the one that the directory was started with, if it was.
        progress: called from time to time with a `SearchProgress`.
        notify: called with a message if something takes long (compilation).
        warn: called with a message about what is damaged, and is run again.
        accept_new_code: resume a directory that other code or another engine started.
        workers: what simulates; by default this process, else `nermo_mjx.runs.ray_workers.RayWorkers`.
        simulator: replaces `Simulator(search.setup, engine)`.
        gradients: replaces those of MJX, which `cma_mega` asks for.

    Raises:
        SpecError: the search is wrong; nothing has been written.
        DirectoryError: the directory holds something else, is in use, or cannot be written; `OtherCode` if other code
            made what it holds.
        SearchFailed: a simulation failed, all workers are lost, or nothing walked; what is finished is kept.
        SearchInterrupted: Ctrl-C or SIGTERM; the same call resumes.
    """
    search = Search.of(spec)
    check_library(search.method)
    workers = LocalWorkers() if workers is None else workers
    with (
        Batches(out, search) as batches,
        resumable("search", batches.out / SEARCH, SearchInterrupted, SearchFailed) as interruption,
    ):
        batch = search.batch or batches.begun_batch() or batch_points(search, engine)
        batches.claim(dataclasses.replace(search, batch=batch))
        going = Going(batches, workers, progress or (lambda _: None), warn or (lambda _: None), interruption.check)
        ran = engine_name(engine, simulator, engine_of(batches.out))
        computer = SweepSimulator(search.sweep.structures, ran, simulator, notify)
        going.go_on(computer, gradients, accept_new_code)
        search = batches.search
        best = publish(batches, complete=True)
        if not best:
            raise SearchFailed(f"{batches.out}: no point of this search walked to its end within its constraints: "
                               "choose other bounds, or looser constraints.")  # fmt: skip
        recordings = keep_recordings(batches, best, computer)
        results = Results([*chunk_files(batches.out).values()])
        plots = write_figures(figures_of(search, results), batches.out / "plots") if search.plots else []
        return SearchResult(batches.out, search, best, going.run, recordings, plots)


class Going:
    """The batches of a search, one after the other.

    Attributes:
        run: points that were evaluated here, and not read.
        evaluations, seconds: points so far, and the simulated time of their runs [s].
    """

    def __init__(
        self,
        batches: Batches,
        workers: Workers,
        progress: Callable[[SearchProgress], None],
        warn: Callable[[str], None],
        check: Callable[[], None],
    ) -> None:
        self._batches, self._workers, self._progress, self._warn, self._check = batches, workers, progress, warn, check
        self.run = self.evaluations = 0
        self.seconds = 0.0
        self._resumed = 0
        self._stamp: CodeStamp | None = None
        self._slopes_of: Gradients | None = None
        self._lead = _Lead(batches.search)

    def go_on(self, computer: SweepSimulator, gradients: Gradients | None, accept: bool) -> None:
        """Until the budget is used up."""
        search, batches = self._batches.search, self._batches
        assert search.batch is not None
        optimizer, shares, batch, published = make_optimizer(search, search.batch), [], 0, time.monotonic()
        while search.reached(self.evaluations, self.seconds) < 1.0:
            asked = optimizer.ask()
            shares.append(asked.shares)
            rows = _rows(search, np.concatenate(shares), len(asked.shares))
            stored = batches.read(batch, rows)
            if stored.flaw:
                self._warn(f"batch {batch} of {batches.out} {stored.flaw}; it is kept in results.aside, and run again.")
            table = stored.table
            if table is None:
                self._begin(computer, accept)
                found = self._simulate(batch, rows, computer.engine)
                slopes = self._slopes(asked, rows, gradients)
                first = self.evaluations * search.repeats
                table = batches.write(batch, rows, first, found, self._stamp, slopes)
                self.run += len(asked.shares)
            self.evaluations += len(asked.shares)
            seconds = _seconds(search, rows)
            self.seconds += float(np.sum(seconds))
            differentiated = seconds[: asked.gradients * search.repeats]
            self.seconds += WalkGradients.cost_of(search) * float(np.sum(differentiated))
            scores = _scores(batches, table, asked)
            self._lead.take(scores)
            optimizer.tell(scores)
            batch += 1
            self._tell()
            if self._stamp is not None and time.monotonic() - published > PUBLISHED_EVERY:
                publish(batches, complete=False)
                published = time.monotonic()

    def _begin(self, computer: SweepSimulator, accept: bool) -> None:
        """Make ready what simulates, before the first batch that is missing."""
        if self._stamp is not None:
            return
        self._resumed = self.evaluations
        self._tell()
        self._stamp = self._workers.begin(computer)
        held = self._batches.directory
        held.take_code(self._stamp, holds_rows=self._batches.holds_rows, accept=accept)
        held.note_session(session(engine=computer.engine, code=self._stamp.id, begun_at=self.evaluations))

    def _tell(self, share: float = 0.0) -> None:
        """Report how far all is; `share` of the next batch is done."""
        self._check()
        search = self._batches.search
        assert search.batch is not None
        part = share * (search.reached(search.batch, 0.0) if search.evaluations is not None else 0.0)
        fraction = min(1.0, search.reached(self.evaluations, self.seconds) + part)
        self._progress(SearchProgress(fraction, self.evaluations, self._resumed, self._lead.best, self._lead.filled))

    def _simulate(self, batch: int, rows: Rows, engine: str) -> Simulated:
        """All runs of a batch, in tasks of one size: nothing compiles twice, also where a population grows."""
        search = self._batches.search
        assert search.batch is not None
        size = math.ceil(search.batch * search.repeats / self._workers.parts)
        parts = [np.arange(len(rows))[begin : begin + size] for begin in range(0, len(rows), size)]

        def tasks() -> Iterator[tuple[int, tuple[int, Mapping[str, np.ndarray]]]]:
            for k, part in enumerate(parts):  # the engine c has lanes of its own; there nothing need be filled up
                yield k, (0, batch_values(search.sweep, rows.take(part), len(part) if engine == "c" else size))

        began = time.perf_counter()
        try:
            done = dict(self._workers.results(tasks(), lambda k, share: self._tell((k + share) / len(parts))))
        except TaskFailed as failed:
            named = f"batch {batch} of {self._batches.out}"
            if isinstance(failed.error, ParameterError):
                raise SpecError(f"{named} is refused: {failed.error}") from failed.error
            reason = (str(failed.error).strip().splitlines() or [""])[0].rstrip(".")[:300]
            raise SearchFailed(
                f"{named} failed: {type(failed.error).__name__}: {reason}. What is finished is kept: run the same "
                "command again when it is fixed."
            ) from failed.error
        found = [done[k] for k in range(len(parts))]
        own = [slice(len(part)) for part in parts]
        metrics = {name: np.concatenate([each.metrics[name][mine] for each, mine in zip(found, own, strict=True)])
                   for name in found[0].metrics}  # fmt: skip
        status = np.concatenate([each.status[mine] for each, mine in zip(found, own, strict=True)])
        seconds = time.perf_counter() - began
        return Simulated(metrics, status, sum(each.steps for each in found), seconds)

    def _slopes(self, asked: Asked, rows: Rows, gradients: Gradients | None) -> np.ndarray | None:
        """Gradients of the requested points, means over repeats: (g, 1 + m, p) per fraction of the bounds."""
        if not asked.gradients:
            return None
        search = self._batches.search
        self._slopes_of = self._slopes_of or gradients or WalkGradients(search)
        runs = np.arange(asked.gradients * search.repeats)
        slopes = self._slopes_of(batch_values(search.sweep, rows.take(runs), len(runs)), asked.shares)
        return slopes.reshape(asked.gradients, search.repeats, *slopes.shape[1:]).mean(axis=1)


class _Lead:
    """The best so far, for the display: of an atlas how many cells are filled."""

    def __init__(self, search: Search) -> None:
        self._aim, self._cells = search.aim, set[int]()
        self.best: float | None = None

    @property
    def filled(self) -> int | None:
        return len(self._cells) if self._aim.measures else None

    def take(self, scores: Scores) -> None:
        if self._aim.measures:
            self._cells |= {int(cell) for cell in cells_of(self._aim, scores.measures)[scores.allowed] if cell >= 0}
        if not self._aim.pareto and scores.allowed.any():
            least = float(scores.cost[scores.allowed, 0].min())
            self.best = least if self.best is None else min(self.best, least)


def _rows(search: Search, shares: np.ndarray, count: int) -> Rows:
    """The runs of the last `count` points, repeats side by side; draws follow from a point and the repeat."""
    first = len(shares) - count
    index = np.arange(first * search.repeats, len(shares) * search.repeats)
    return Sample(search.sweep, shares).take(index)


def _seconds(search: Search, rows: Rows) -> np.ndarray:
    """How long each run is simulated, (n,) [s]."""
    known = search.sweep.constants | rows.values
    rate = search.setup.cycle_rate({name: known[name] for name in search.setup.timing if name in known})
    return np.broadcast_to(np.asarray(search.run.seconds(rate)[1], float), len(rows))


def _scores(batches: Batches, table: pa.Table, asked: Asked) -> Scores:
    """What a batch's rows say of its points."""
    search = batches.search
    metrics = {name: table.column(name).to_numpy() for name in search.aim.metrics}
    well = np.array(table.column("status").to_pylist()) == "ok"
    scores = scores_of(search.aim, search.repeats, metrics, well)
    jacobian = batches.gradients(table, asked.gradients) if asked.gradients else None
    return dataclasses.replace(scores, jacobian=jacobian)


# ---
# The cost of a search on this machine, before it starts.


#: Points whose mean length of a run stands for all.
_TRIED = 256
#: Bytes of a row of the table.
_ROW_BYTES = 700


@dataclasses.dataclass(frozen=True)
class Cost:
    """The cost of a search.

    Attributes:
        engine: that it will run on.
        batch: points of a batch.
        batches, evaluations, runs: whole batches, and what is in them.
        simulated_seconds: of all runs [s], by the mean over the bounds.
        wall_seconds: at this machine's current speed, measured now [s].
        disk_bytes: of the table.
        gradient_runs: what gradients cost, in forward runs; their time is not in the others.
    """

    engine: str
    batch: int
    batches: int
    evaluations: int
    runs: int
    simulated_seconds: float
    wall_seconds: float
    disk_bytes: int
    gradient_runs: int = 0


def cost_of(search: Search, engine: str = "auto", simulator: SimulatorLike | None = None) -> Cost:
    """The cost of a search from the start.

    Args:
        engine: of the simulator.
        simulator: replaces `Simulator(search.setup, engine)`.

    Raises:
        ParameterError: an unknown engine, or a library that is missing.
    """
    check_library(search.method)
    engine = resolve_engine(engine)
    batch = search.batch or batch_points(search, engine)
    shares = Space(search).spread(_TRIED)
    rows = Sample(search.sweep, shares).take(np.arange(0, len(shares) * search.repeats, search.repeats))
    known = search.sweep.constants | rows.values
    rate = search.setup.cycle_rate({name: known[name] for name in search.setup.timing if name in known})
    point = search.repeats * float(np.mean(search.run.seconds(rate)[1]))
    wanted = search.evaluations if search.evaluations is not None else (search.simulated_seconds or 0.0) / point
    batches = math.ceil(wanted / batch)
    evaluations = batches * batch
    simulator = simulator or Simulator(search.setup, engine)
    simulated = evaluations * point
    wall = simulated / pace(simulator, search.setup, batch * search.repeats)
    gradients = 0
    if search.method == "cma_mega":
        centres = int(search.options.get("emitters", 4)) * (batches // 2)
        gradients = round(centres * search.repeats * WalkGradients.cost_of(search))
    return Cost(engine, batch, batches, evaluations, evaluations * search.repeats, simulated, wall,
                evaluations * search.repeats * _ROW_BYTES, gradients)  # fmt: skip
