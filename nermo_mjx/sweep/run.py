"""Run a sweep: cut its rows into chunks, simulate what the directory does not hold yet, then sum up."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from nermo_mjx.runs.files import clear_errors
from nermo_mjx.runs.interruption import Interruption, interruptible
from nermo_mjx.sweep.chunk_size import chunk_rows_here
from nermo_mjx.sweep.chunks import SimulatorLike, Work
from nermo_mjx.sweep.hosts import Hosts
from nermo_mjx.sweep.layout import layout_of, simulated_seconds
from nermo_mjx.sweep.plots import draw_plots
from nermo_mjx.sweep.presence import PATIENCE, Presence
from nermo_mjx.sweep.reading import SpecError
from nermo_mjx.sweep.results import Results, read_table
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import DirectoryError, Store
from nermo_mjx.sweep.summary import summarize, to_json
from nermo_mjx.sweep.tally import Progress, Tally
from nermo_mjx.sweep.waiting import lost, missing, wait_for_others

#: How often a chunk is run that is damaged each time it is read again.
ATTEMPTS = 2


class SweepInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM; the message says how to go on."""


@dataclasses.dataclass(frozen=True)
class SweepResult:
    """A sweep's outcome.

    Attributes:
        out: its directory.
        summary: content of summary.json; empty while chunks of other shards are missing, and on hosts but the first.
        plots: files of the figures.
        complete: whether the directory holds every row of the sweep.
        chunks_run: chunks that this call simulated.
        rows_done, rows: finished rows and all rows of the sweep.
        missing: which chunks are missing and how to run them, in words; empty if none is.
    """

    out: Path
    summary: dict[str, Any]
    plots: list[Path]
    complete: bool
    chunks_run: int
    rows_done: int
    rows: int
    missing: str

    @property
    def table(self) -> pa.Table:
        """The result table, read from the directory at each use; see `read_table`."""
        return read_table(self.out)


def run_sweep(
    spec: Sweep | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    progress: Callable[[Progress], None] | None = None,
    notify: Callable[[str], None] | None = None,
    warn: Callable[[str], None] | None = None,
    chunk: int | None = None,
    shard: tuple[int, int] | None = None,
    hosts: Hosts | None = None,
    patience: float = PATIENCE,
    simulator: SimulatorLike | None = None,
) -> SweepResult:
    """Run every variant of a sweep into a directory, or go on with what it holds.

    Memory does not grow with what is done: a chunk is written while the next one is simulated, and the summary and the
    figures read a few columns at a time.

    Args:
        spec: a `Sweep`, a dict with the fields of a sweep file, or the path of one.
        out: the directory; see `nermo_mjx.sweep.store`.
        engine: engine of the simulator. A directory keeps the engine it was begun with.
        progress: called now and then with a `Progress`.
        notify: called with a sentence when something takes long (compilation).
        warn: called with a sentence when something in the directory is damaged, and is run again.
        chunk: rows simulated and stored together; a directory keeps the size it was begun with.
        shard: (i, n) runs only every n-th chunk, from i in 0..n-1; the table is the same however it was split.
        hosts: which of several processes this is, from `nermo_mjx.sweep.hosts.join`; each takes its share as by
            `shard`, then waits for the others. The first one sums up.
        patience: seconds without a sign of life after which another process counts as lost.
        simulator: stands in for `Simulator(spec.setup, engine)`.

    Raises:
        SpecError: the sweep is wrong; nothing has been written.
        DirectoryError: the directory holds something else, is in use, or cannot be written.
        SweepError: a simulation failed, or the other processes are lost; what is finished is kept.
        SweepInterrupted: Ctrl-C or SIGTERM; the same call goes on.
    """
    sweep = spec if isinstance(spec, Sweep) else _as_sweep(spec)
    _check(chunk, shard, hosts)
    hosts = None if hosts is None or hosts.count == 1 else hosts
    part = shard if hosts is None else (hosts.index, hosts.count)
    rows = Sample(sweep)
    seconds = simulated_seconds(sweep, rows)
    size = chunk or sweep.chunk or chunk_rows_here(engine, len(rows), 1 if part is None else part[1])
    with Store(out, dataclasses.replace(sweep, chunk=size), part) as store, _interruptible(store) as interruption:

        def report(share: Progress) -> None:
            interruption.check()
            if progress is not None:
                progress(share)

        layout = layout_of(seconds, store.sweep.chunk or size)
        first = hosts is None or hosts.index == 0
        begin, step = (0, 1) if part is None or (hosts is not None and first) else part  # the first host counts all
        counted = range(begin, len(layout), step)
        work = Work(store, rows, layout, Tally(layout, seconds, counted, report), watches=hosts is not None and first)
        with Presence(store.out, hosts, patience) if hosts is not None else contextlib.nullcontext() as presence:
            _finish(work, engine, simulator, presence, notify, warn)
        complete = bool(work.done.all())
        summary, plots = _sum_up(work) if complete and first else ({}, [])
        return SweepResult(
            out=store.out, summary=summary, plots=plots, complete=complete, chunks_run=work.chunks_run,
            rows_done=work.rows_of(work.done.nonzero()[0]), rows=len(rows), missing=missing(work),
        )  # fmt: skip


def _check(chunk: int | None, shard: tuple[int, int] | None, hosts: Hosts | None) -> None:
    if chunk is not None and chunk < 1:
        raise SpecError(f"chunk is {chunk}: allowed is 1 or more.")
    if shard is not None and not 0 <= shard[0] < shard[1]:
        raise SpecError(f"shard is {shard[0]}/{shard[1]}: allowed is I/N with I from 0 to N - 1.")
    if shard is not None and hosts is not None:
        raise SpecError("shard and hosts both say which part of the sweep is run: give one of them.")


def _finish(
    work: Work,
    engine: str,
    simulator: SimulatorLike | None,
    presence: Presence | None,
    notify: Callable[[str], None] | None,
    warn: Callable[[str], None] | None,
) -> None:
    """Run what is missing of this process's part, and see that it is really there."""
    work.survey(warn)
    for _ in range(ATTEMPTS):
        known = work.done.all()
        work.simulate(engine, simulator, notify)
        if presence is not None:
            wait_for_others(work, presence)
        if known:
            return
        work.survey(warn)
        if work.done[work.mine].all():
            break
    else:
        raise DirectoryError(f"{work.store.out} loses what is written to it: chunks are damaged again and again.")
    if presence is not None and not work.done.all():
        raise lost(work)


def _sum_up(work: Work) -> tuple[dict[str, Any], list[Path]]:
    """Write the summary and the figures of a complete table."""
    store = work.store
    files = [store.chunk_path(k) for k in range(len(work.layout))]
    results = Results.of_files(files, len(work.rows))
    summary = {**summarize(results), **work.effort()}
    store.write(store.out / "summary.json", to_json(summary))
    if not store.sweep.plots:
        return summary, []
    with clear_errors(store.out):
        return summary, draw_plots(results, store.plots, write=store.write)


def _as_sweep(spec: Mapping[str, Any] | str | os.PathLike[str]) -> Sweep:
    return Sweep.from_dict(spec) if isinstance(spec, Mapping) else Sweep.from_file(spec)


@contextlib.contextmanager
def _interruptible(store: Store) -> Iterator[Interruption]:
    """Turn Ctrl-C and SIGTERM into a `SweepInterrupted` that says how to go on."""
    try:
        with interruptible() as interruption:
            yield interruption
    except KeyboardInterrupt:
        raise SweepInterrupted(
            f"stopped; what is finished is kept in {store.out}. To go on, run the same command again, or: "
            f"nermo-mjx sweep {store.out / 'sweep.yaml'} --out {store.out}"
        ) from None
