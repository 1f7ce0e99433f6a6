"""What a sweep would cost: rows, chunks, time, disk and memory, before anything runs. Nothing is written."""

from __future__ import annotations

import dataclasses
import math
import os
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from nermo_mjx.physics import resolve_engine
from nermo_mjx.rollout import METRICS, Run, Simulator
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.files import WrongDirectory, parquet_bytes
from nermo_mjx.sweep.results import HELD
from nermo_mjx.sweep.run import Work
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.simulating import WORLD_BYTES, chunk_rows_here
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import batch_values, check_source, differences, keys_of_rows, refusal
from nermo_mjx.sweep.table import chunk_table

#: Memory of a process apart from its batch: Python, JAX, MuJoCo, the compiled controller, matplotlib [bytes].
PROCESS_BYTES: Final = 600_000_000
#: A world of the engine c: MuJoCo's data, the controller's state and what the metrics sum up [bytes]. Both as measured.
C_WORLD_BYTES: Final = 100_000
#: Simulated seconds of the measurement, and worlds of it.
_MEASURED_SECONDS: Final = 0.5
_MEASURED_WORLDS: Final = 64


@dataclasses.dataclass(frozen=True)
class Forecast:
    """What a sweep would cost.

    Attributes:
        rows, chunks: of the sweep, and the batches in which it would be simulated in one go.
        rows_left: to be simulated; the others are in the directory, or known from other directories.
        batches: that would be simulated.
        structures: setups that are compiled and simulated, one after the other.
        engine: that would run.
        steps: physics steps that would be simulated, all worlds together.
        steps_per_second: at that rate; NaN if it is not known.
        rate_from: source of the rate, in words.
        seconds: time for the steps [s]; NaN if the rate is unknown. Compilation comes in addition.
        disk_bytes: that the missing part of the table will take, without figures.
        disk_free: free space at the directory's location [bytes].
        memory_bytes: of this process; on a GPU, that of the batch is the device's.
        notes: sentences.
    """

    rows: int
    chunks: int
    rows_left: int
    batches: int
    structures: int
    engine: str
    steps: float
    steps_per_second: float
    rate_from: str
    seconds: float
    disk_bytes: int
    disk_free: int
    memory_bytes: int
    notes: tuple[str, ...]


def forecast(
    sweep: Sweep,
    out: str | os.PathLike[str] | None = None,
    *,
    engine: str = "auto",
    chunk: int | None = None,
    shard: tuple[int, int] | None = None,
    extend: bool = False,
    use: Sequence[str | os.PathLike[str]] = (),
    parts: int = 1,
    measure: Callable[[Sweep, str], float] | None = None,
) -> Forecast:
    """What it would cost to run a sweep, or to resume it; see `run_sweep` for the arguments.

    The rate is that of the directory's rows, if it has any; otherwise 64 worlds of the engine `c` are simulated for
    half a second, which takes some seconds in all. For other engines it is then not known, since they compile for
    minutes.

    Args:
        out: the directory, which need not be there.
        parts: processes that share the chunks.
        measure: replaces the measurement: steps per second of a sweep on an engine.

    Raises:
        DirectoryError, SpecError: the directory holds another sweep, or one named under `use` no rows of such a sweep.
    """
    sources = [Path(each) for each in use]
    for source in sources:
        check_source(source, sweep)
    notes: list[str] = []
    folder = None if out is None else Path(out)
    begun = _begun(folder, sweep, extend)
    wanted = engine if engine != "auto" else (engine_of(folder) if folder is not None else None) or "auto"
    runs = resolve_engine(wanted)
    size = (begun.chunk if begun is not None else None) or chunk or sweep.chunk
    size = size or chunk_rows_here(runs, sweep.variants * sweep.repeats, parts * (1 if shard is None else shard[1]))
    work = Work(sweep, folder or Path(), size, sources, shard, notes.append)
    unfinished = work.unfinished
    left = np.setdiff1d(unfinished, np.concatenate([np.empty(0, int), *(index for index, _ in work.known())]))
    left = unfinished[np.isin(unfinished, left)]
    batches = work.batches(left, len(unfinished) - len(left))
    # Each batch lasts as long as its longest row, in all of its worlds.
    steps = sum(
        batch.worlds * float(work.seconds[batch.rows].max()) / float(sweep.structures[batch.structure].setup.timestep)
        for batch in batches
    )
    rate, rate_from = math.nan, "not needed: nothing is left to be simulated"
    there = [part for part in (*work.runs.parts, *work.runs.others) if folder is not None and part.directory == folder]
    done = np.array([part.effort for part in there if part.about["engine"] == runs and part.effort[1] > 0])
    if len(done):
        rate, rate_from = (
            float(done[:, 0].sum() / done[:, 1].sum()),
            f"measured: {len(done):,} chunks of the directory",
        )
    elif steps and runs == "c":
        rate = (measure or measured_rate)(sweep, runs)
        rate_from = f"measured now: {_MEASURED_WORLDS} worlds for {_MEASURED_SECONDS:g} simulated s"
    elif steps:
        rate_from = f"not known: no chunk of the engine {runs} has been measured in the directory"
    if there:  # as much per row as those take
        disk = math.ceil(len(left) * sum(part.path.stat().st_size for part in there) / sum(part.rows for part in there))
    else:  # as in a batch of noise
        index, rng = np.arange(min(size, len(work.rows))), np.random.default_rng(0)
        metrics = {name: rng.random(len(index)) for name in METRICS}
        some = work.rows.take(index)
        table = chunk_table(sweep, some, index, metrics, np.full(len(index), "ok"), "00000000", {"engine": "c"})
        key = pa.array(keys_of_rows(sweep, some).astype(str))
        disk = math.ceil(len(left) * len(parquet_bytes(table.append_column("key", key))) / len(index))
    above = (folder or Path.cwd()).absolute()
    free = shutil.disk_usage(next(each for each in (above, *above.parents) if each.is_dir())).free
    if disk > free:
        notes.append(f"There is no room for it: {free / 1e9:.1f} GB are free.")
    worlds = max((batch.worlds for batch in batches), default=0)
    points = 0 if sweep.sampler in ("grid", "rows") else sweep.variants * len(sweep.axes) * 8
    summary = min(len(work.rows) * 8 * (len(METRICS) + len(sweep.axes)), HELD * 8) * 2
    if runs != "c" and worlds:
        notes.append(
            f"The batch of {worlds:,} worlds takes about {worlds * WORLD_BYTES[runs] / 1e9:.2g} GB of the devices' "
            "memory, besides."
        )
    return Forecast(
        rows=len(work.rows),
        chunks=work.batches_in_all,
        rows_left=len(left),
        batches=len(batches),
        structures=len({batch.structure for batch in batches}),
        engine=runs,
        steps=steps,
        steps_per_second=rate,
        rate_from=rate_from,
        seconds=steps / rate if rate > 0 else 0.0 if not steps else math.nan,
        disk_bytes=disk,
        disk_free=free,
        memory_bytes=PROCESS_BYTES + worlds * C_WORLD_BYTES * (runs == "c") + len(work.rows) * 24 + points + summary,
        notes=tuple(notes),
    )


def measured_rate(sweep: Sweep, engine: str) -> float:
    """Physics steps per second, all worlds together, of 64 worlds that run for half a second."""
    walk = sweep.structures[0]
    run = Run(duration=_MEASURED_SECONDS, warmup=0.0)
    some = Sample(sweep)
    rows = some.take(np.flatnonzero(some.structures() == 0)[:_MEASURED_WORLDS])
    values, simulator = batch_values(walk, rows, _MEASURED_WORLDS), Simulator(walk.setup, engine)
    simulator.run(values, run)  # compiles
    began = time.perf_counter()
    result = simulator.run(values, run)
    return float(result.steps * _MEASURED_WORLDS / (time.perf_counter() - began))


def _begun(folder: Path | None, sweep: Sweep, extend: bool) -> Sweep | None:
    """The sweep that a directory contains, if it can be extended to this one."""
    if folder is None or not (folder / "sweep.yaml").exists():
        return None
    begun = Sweep.from_directory(folder)
    if begun.digest() != sweep.digest():
        why = refusal(begun, sweep)
        if why or not extend:
            hint = why or f"{differences(begun, sweep)}; --extend would extend it"
            raise WrongDirectory(f"{folder} holds the results of another sweep: {hint}.")
    return begun
