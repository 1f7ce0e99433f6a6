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
import pyarrow.parquet as pq

from nermo_mjx.physics import resolve_engine
from nermo_mjx.rollout import METRICS, Run, Simulator
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.files import WrongDirectory, parquet_bytes
from nermo_mjx.sweep.results import HELD, chunk_files
from nermo_mjx.sweep.row_cache import BatchPlan, KnownRows, check_source, plan_batches, with_former
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.simulating import WORLD_BYTES, chunk_rows_here
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import batch_values, differences, layout_of, refusal, simulated_seconds
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
        rows, chunks: of the sweep.
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

    The rate is that of the directory's chunks, if it has any; otherwise 64 worlds of the engine `c` are simulated for
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
    rows = Sample(sweep)
    seconds = simulated_seconds(sweep, rows)
    layout = layout_of(seconds, size, rows.structures())
    mine = range(len(layout)) if shard is None else range(shard[0], len(layout), shard[1])
    places = [*([] if begun is None or folder is None else with_former(folder)),
              *(place for source in sources for place in with_former(source))]  # fmt: skip
    known = KnownRows(places, notes.append) if places else None
    plan = plan_batches(sweep, rows, layout, list(mine), known)
    steps = _steps(sweep, plan, rows, seconds)
    rate, rate_from = _rate(folder, sweep, runs, steps, measure or measured_rate)
    left = sum(len(plan.unknown(k)) for k in mine)
    disk = _disk_bytes(sweep, rows, layout, left, folder)
    free = shutil.disk_usage(_nearest(folder or Path.cwd())).free
    if disk > free:
        notes.append(f"There is no room for it: {free / 1e9:.1f} GB are free.")
    worlds = max(plan.worlds.values(), default=0)
    of_worlds = worlds * C_WORLD_BYTES if runs == "c" else 0
    points = 0 if sweep.sampler in ("grid", "rows") else sweep.variants * len(sweep.axes) * 8
    summary = min(len(rows) * 8 * (len(METRICS) + len(sweep.axes)), HELD * 8) * 2
    if runs != "c" and worlds:
        notes.append(f"The batch of {worlds:,} worlds takes about {worlds * WORLD_BYTES[runs] / 1e9:.2g} GB of the "
                     "devices' memory, besides.")  # fmt: skip
    return Forecast(
        rows=len(rows), chunks=len(layout), rows_left=left, batches=len(plan.batches),
        structures=len({batch.structure for batch in plan.batches}), engine=runs, steps=steps, steps_per_second=rate,
        rate_from=rate_from, seconds=steps / rate if rate > 0 else 0.0 if not steps else math.nan, disk_bytes=disk,
        disk_free=free, memory_bytes=PROCESS_BYTES + of_worlds + len(rows) * 24 + points + summary, notes=tuple(notes),
    )  # fmt: skip


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


def _steps(sweep: Sweep, plan: BatchPlan, rows: Sample, seconds: np.ndarray) -> float:
    """Physics steps of the batches: each lasts as long as its longest row, in all of its worlds."""
    total = 0.0
    for batch in plan.batches:
        index = np.concatenate([plan.unknown(k) for k in batch.chunks])
        timestep = sweep.structures[batch.structure].setup.timestep
        total += plan.worlds[batch.structure] * float(seconds[index].max()) / float(timestep)
    return total


def _rate(
    folder: Path | None, sweep: Sweep, engine: str, steps: float, measure: Callable[[Sweep, str], float]
) -> tuple[float, str]:
    done = [_noted(path) for path in (chunk_files(folder).values() if folder is not None else ())]
    same = [(each[1], each[2]) for each in done if each is not None and each[0] == engine and each[2] > 0]
    if same:
        total = np.sum(same, axis=0)
        return float(total[0] / total[1]), f"measured: {len(same):,} chunks of the directory"
    if not steps:
        return math.nan, "not needed: nothing is left to be simulated"
    if engine != "c":
        return math.nan, f"not known: no chunk of the engine {engine} has been measured in the directory"
    return measure(sweep, engine), f"measured now: {_MEASURED_WORLDS} worlds for {_MEASURED_SECONDS:g} simulated s"


def _noted(path: Path) -> tuple[str, float, float] | None:
    """Engine, steps and seconds of a chunk, as its file says."""
    try:
        about = pq.read_metadata(path).metadata or {}
        return about[b"engine"].decode(), float(about[b"steps"]), float(about[b"wall_seconds"])
    except (OSError, KeyError, ValueError):
        return None


def _disk_bytes(sweep: Sweep, rows: Sample, layout: list[np.ndarray], left: int, folder: Path | None) -> int:
    """The space for the remaining rows: as much per row as existing ones, or as in a chunk of noise."""
    files = list(chunk_files(folder).values()) if folder is not None else []
    whole = sum(_rows_in(path) for path in files)
    if whole:
        return math.ceil(left * sum(path.stat().st_size for path in files) / whole)
    index, rng = layout[0], np.random.default_rng(0)
    metrics = {name: rng.random(len(index)) for name in METRICS}
    table = chunk_table(sweep, rows.take(index), index, metrics, np.full(len(index), "ok"), "00000000", {"engine": "c"})
    return math.ceil(left * len(parquet_bytes(table)) / len(index))


def _rows_in(path: Path) -> int:
    try:
        return int(pq.read_metadata(path).num_rows)
    except (OSError, ValueError):
        return 0


def _nearest(folder: Path) -> Path:
    """The folder, or the nearest one above it that is there."""
    return next(each for each in (folder.absolute(), *folder.absolute().parents) if each.is_dir())
