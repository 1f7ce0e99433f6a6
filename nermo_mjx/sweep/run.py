"""Run a sweep: cut its rows into chunks, simulate what the directory does not hold yet, then sum up."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import pyarrow as pa

from nermo_mjx.sweep.chunks import Progress, SimulatorLike, Work, layout_of, simulated_seconds
from nermo_mjx.sweep.interruption import interruptible
from nermo_mjx.sweep.plots import draw_plots
from nermo_mjx.sweep.reading import SpecError
from nermo_mjx.sweep.sampling import sample
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import Store, join
from nermo_mjx.sweep.summary import summarize, to_json

#: Rows of a chunk, unless the sweep or the caller says otherwise: a minute on two cores, and what fills a device.
CPU_CHUNK, DEVICE_CHUNK = 64, 4096


class SweepInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM; the message says how to go on."""


@dataclasses.dataclass(frozen=True)
class SweepResult:
    """A sweep's outcome.

    Attributes:
        out: its directory.
        table: the result table, in the order of its rows (`read_table`).
        summary: content of summary.json; empty while other shards are missing.
        plots: files of the figures.
        complete: whether the table holds every row of the sweep.
        chunks_run: chunks that this call simulated.
    """

    out: Path
    table: pa.Table
    summary: dict[str, Any]
    plots: list[Path]
    complete: bool
    chunks_run: int


def run_sweep(
    spec: Sweep | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    progress: Callable[[Progress], None] | None = None,
    notify: Callable[[str], None] | None = None,
    chunk: int | None = None,
    shard: tuple[int, int] | None = None,
    simulator: SimulatorLike | None = None,
) -> SweepResult:
    """Run every variant of a sweep into a directory, or go on with what it holds.

    Args:
        spec: a `Sweep`, a dict with the fields of a sweep file, or the path of one.
        out: the directory; see `nermo_mjx.sweep.store`.
        engine: engine of the simulator. A directory keeps the engine it was begun with.
        progress: called now and then with a `Progress`.
        notify: called with a sentence when something takes long (compilation).
        chunk: rows simulated and stored together; a directory keeps the size it was begun with.
        shard: (i, n) runs only every n-th chunk, from i in 0..n-1; the table is the same however it was split.
        simulator: stands in for `Simulator(spec.setup, engine)`.

    Raises:
        SpecError: the sweep is wrong; nothing has been written.
        StoreError: the directory holds something else, is in use, or cannot be written.
        SweepInterrupted: Ctrl-C or SIGTERM; the same call goes on.
    """
    sweep = spec if isinstance(spec, Sweep) else _as_sweep(spec)
    if chunk is not None and chunk < 1:
        raise SpecError(f"chunk is {chunk}: allowed is 1 or more.")
    if shard is not None and not 0 <= shard[0] < shard[1]:
        raise SpecError(f"shard is {shard[0]}/{shard[1]}: allowed is I/N with I from 0 to N - 1.")
    rows = sample(sweep)
    seconds = simulated_seconds(sweep, rows)
    size = chunk or sweep.chunk or default_chunk(engine)
    with Store(out, dataclasses.replace(sweep, chunk=size), shard) as store, _interruptible(store):
        layout = layout_of(seconds, store.sweep.chunk or size)
        work = Work(store, rows, seconds, layout, progress, notify)
        work.simulate(engine, simulator)
        complete = work.complete()
        tables = [table for table in work.tables if table is not None]
        table = join(tables) if tables else pa.table({})
        if not complete:  # other shards are missing
            return SweepResult(store.out, table, {}, [], complete=False, chunks_run=work.chunks_run)
        summary = summarize(table, tables)
        store.write(store.out / "summary.json", to_json(summary))
        plots = draw_plots(table, store.plots, write=store.write) if sweep.plots else []
        return SweepResult(store.out, table, summary, plots, complete=True, chunks_run=work.chunks_run)


def _as_sweep(spec: Mapping[str, Any] | str | os.PathLike[str]) -> Sweep:
    return Sweep.from_dict(spec) if isinstance(spec, Mapping) else Sweep.from_file(spec)


def default_chunk(engine: str) -> int:
    """Rows of a chunk where neither the sweep nor the caller says."""
    return CPU_CHUNK if engine == "c" or jax.default_backend() == "cpu" else DEVICE_CHUNK


@contextlib.contextmanager
def _interruptible(store: Store) -> Iterator[None]:
    """Turn Ctrl-C and SIGTERM into a `SweepInterrupted` that says how to go on."""
    try:
        with interruptible():
            yield
    except KeyboardInterrupt:
        raise SweepInterrupted(
            f"stopped; what is finished is kept in {store.out}. To go on, run the same command again, or: "
            f"nermo-mjx sweep {store.out / 'sweep.yaml'} --out {store.out}"
        ) from None
