"""What a sweep would cost: rows, time, disk and memory, before anything runs. Nothing is written."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from nermo_mjx.physics import resolve_engine
from nermo_mjx.rollout import METRICS, Simulator
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.files import (
    WrongDirectory,
    parquet_bytes,
)
from nermo_mjx.runs.job import Forecast, Watch
from nermo_mjx.runs.rows import PartFile
from nermo_mjx.runs.work import RowBatch, Work
from nermo_mjx.sweep.directory import check_source_sweeps, refusal, sweep_differences
from nermo_mjx.sweep.simulating import (
    ENGINE_WORLD_BYTES,
    PROBE,
    chunk_rows_here,
    pace,
)
from nermo_mjx.sweep.spec import Sweep, varied_values
from nermo_mjx.sweep.store import SweepRows
from nermo_mjx.sweep.table import (
    MAX_HELD_NUMBERS,
    chunk_table,
)

#: Memory of a process apart from its batch: Python, JAX, MuJoCo, the compiled controller, matplotlib [bytes].
PROCESS_BYTES: Final = 600_000_000
#: A world of the engine c: MuJoCo's data, the controller's state and what the metrics sum up [bytes]. Both as measured.
C_WORLD_BYTES: Final = 100_000
#: Worlds of the measurement.
_MEASURED_WORLDS: Final = 64


# Many parameters because each is an option of the job, most by keyword only.
def sweep_forecast(
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
    minutes. The counts are `rows` and `chunks` of the sweep in one go, the `rows_left` to be simulated (the others are
    in the directory, or known from other directories), their `batches`, the `structures` that are compiled, one after
    the other, and physics `steps`.

    Args:
        out: the directory, which need not be there.
        parts: processes that share the chunks.
        measure: replaces the measurement: steps per second of a sweep on an engine.

    Raises:
        DirectoryError, SpecError: the directory holds another sweep, or one named under `use` no rows of such a sweep.
    """
    sources = [Path(source) for source in use]
    check_source_sweeps(sources, sweep)
    folder = None if out is None else Path(out)
    former_directory = None if folder is None else _begun(folder, sweep, extend)
    engine = (engine_of(folder) if folder is not None and engine == "auto" else None) or engine
    name = resolve_engine(engine)
    size = (
        (former_directory.chunk if former_directory is not None else None) or chunk or sweep.chunk
    )
    size = size or chunk_rows_here(
        name, sweep.variants * sweep.repeats, parts * (1 if shard is None else shard[1])
    )
    notes: list[str] = []
    rows = SweepRows(sweep)
    work = Work(rows, folder or Path(), size, sources, shard, Watch(warn=notes.append))
    unfinished = work.unfinished
    remaining = np.setdiff1d(
        unfinished, np.concatenate([np.empty(0, int), *(index for index, _ in work.known())])
    )
    remaining = unfinished[np.isin(unfinished, remaining)]
    batches = work.batches(remaining, len(unfinished) - len(remaining))
    # Each batch lasts as long as its longest row, in all of its worlds.
    seconds = np.array([batch.worlds * float(work.seconds[batch.rows].max()) for batch in batches])
    timesteps = [float(sweep.structures[batch.structure].setup.timestep) for batch in batches]
    steps = float(sum(seconds / timesteps))
    if sweep.optimum is not None:  # rows beyond the sweep's own last as long as those do on average
        further_text = _further(sweep, work)
        steps += further_text * float(work.seconds.mean()) / float(sweep.setup.timestep)
        notes.append(
            f"The optimum takes up to {further_text:,} further runs, which the time contains."
        )
    existing = [
        part
        for part in (*work.runs.parts, *work.runs.other_parts)
        if folder is not None and part.directory == folder
    ]
    rate, rate_from = _rate(sweep, name, existing, steps, measure)
    disk = _disk_bytes(sweep, rows, existing, len(remaining), size)
    notes += _room(sweep, rows, batches, name, disk, (folder or Path.cwd()).absolute())
    counts = {
        "rows": len(rows.sample),
        "rows_left": len(remaining),
        "chunks": len(work.layout),
        "batches": len(batches),
        "structures": len({batch.structure for batch in batches}),
        "steps": round(steps),
    }
    wall = steps / rate if rate > 0 else math.nan if steps else 0.0
    return Forecast(name, counts, float(seconds.sum()), wall, rate_from, disk, notes=tuple(notes))


def _begun(folder: Path, sweep: Sweep, extend: bool) -> Sweep | None:
    """The sweep that a directory holds; None if it holds none."""
    if not (folder / "sweep.yaml").exists():
        return None
    begun = Sweep.from_directory(folder)
    if begun.digest() != sweep.digest() and ((reason := refusal(begun, sweep)) or not extend):
        hint = reason or f"{sweep_differences(begun, sweep)}; --extend would extend it"
        raise WrongDirectory(f"{folder} holds the results of another sweep: {hint}.")
    return begun


def _further(sweep: Sweep, work: Work) -> int:
    """How many further rows an optimum takes, at most."""
    values = varied_values(sweep)
    assert sweep.optimum is not None
    groups = math.prod(len(values[name] or ()) for name in sweep.optimum.grouped(values))
    further_runs = groups * (sweep.optimum.budget + 2 * sweep.optimum.fresh)
    return max(further_runs - int((work.runs.row_numbers >= len(work.seconds)).sum()), 0)


def _rate(
    sweep: Sweep,
    engine: str,
    parts: Sequence[PartFile],
    steps: float,
    measure: Callable[[Sweep, str], float] | None,
) -> tuple[float, str]:
    """Physics steps per second, NaN if it is not known or not needed, and its source in words."""
    done = np.array(
        [(part.steps, part.seconds) for part in parts if part.engine == engine and part.seconds > 0]
    )
    if len(done):
        rate = float(done[:, 0].sum() / done[:, 1].sum())
        return rate, f"{rate:,.0f} steps/s, measured: {len(done):,} chunks of the directory"
    if not steps:
        return math.nan, "not needed: nothing is left to be simulated"
    if engine != "c":
        return (
            math.nan,
            f"not known: no chunk of the engine {engine} has been measured in the directory",
        )
    setup = sweep.setup
    rate = (
        measure(sweep, engine)
        if measure
        else pace(Simulator(setup, engine), setup, _MEASURED_WORLDS) / setup.timestep
    )
    return (
        rate,
        f"{rate:,.0f} steps/s, measured now: {_MEASURED_WORLDS} worlds for {PROBE:g} simulated s",
    )


def _disk_bytes(
    sweep: Sweep, rows: SweepRows, parts: Sequence[PartFile], left: int, size: int
) -> int:
    """What the rows that are left will take on the disk [bytes]."""
    if parts:  # as much per row as those take
        taken = sum(part.path.stat().st_size for part in parts)
        return math.ceil(left * taken / sum(part.rows for part in parts))
    # As in a batch of noise.
    index, rng = np.arange(min(size, len(rows.sample))), np.random.default_rng(0)
    metrics = {name: rng.random(len(index)) for name in METRICS}
    table = chunk_table(
        sweep,
        rows.sample.take(index),
        index,
        metrics,
        np.full(len(index), "ok"),
        "00000000",
        {"engine": "c"},
    )
    key = pa.array(rows.keys(index).astype(str))
    return math.ceil(left * len(parquet_bytes(table.append_column("key", key))) / len(index))


def _room(
    sweep: Sweep,
    rows: SweepRows,
    batches: Sequence[RowBatch],
    engine: str,
    disk: int,
    folder: Path,
) -> Iterator[str]:
    """What is free on the disk, and the memory that the sweep takes, in sentences."""
    free = shutil.disk_usage(
        next(parent for parent in (folder, *folder.parents) if parent.is_dir())
    ).free
    yield f"{'There is no room for it: ' if disk > free else ''}{free / 1e9:,.1f} GB are free."
    worlds, count = max((batch.worlds for batch in batches), default=0), len(rows.sample)
    points = 0 if sweep.sampler in ("grid", "rows") else sweep.variants * len(sweep.axes) * 8
    summary = min(count * 8 * (len(METRICS) + len(sweep.axes)), MAX_HELD_NUMBERS * 8) * 2
    memory = (
        PROCESS_BYTES + worlds * C_WORLD_BYTES * (engine == "c") + count * 24 + points + summary
    )
    yield f"The process takes about {memory / 1e9:.1f} GB of memory."
    if engine != "c" and worlds:
        yield (
            f"The batch of {worlds:,} worlds takes about {worlds * ENGINE_WORLD_BYTES[engine] / 1e9:.2g} GB of the devices' "
            "memory, besides."
        )
