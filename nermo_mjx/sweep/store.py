"""The rows of a sweep as a job asks for them: their keys, what simulates them, their tables and time series."""

from __future__ import annotations

import dataclasses
import functools
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Series
from nermo_mjx.rollout.metric_table import RUN_COLUMNS
from nermo_mjx.rollout.run import too_many
from nermo_mjx.rollout.saving import Signal, chosen_signals
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.runs.files import WrongDirectory
from nermo_mjx.runs.job import JobFailed
from nermo_mjx.runs.rows import keys_of
from nermo_mjx.runs.work import RowBatch, RowJob
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.specs.walk import WalkSpec
from nermo_mjx.sweep.directory import check_source_sweeps, claim
from nermo_mjx.sweep.simulating import (
    Simulated,
    SimulatorLike,
    SweepSimulator,
    chunk_rows_here,
)
from nermo_mjx.sweep.spec import Rows, Sample, Sweep
from nermo_mjx.sweep.table import chunk_table, columns_of

#: How JAX, CUDA and Warp say that a batch does not fit.
_NO_MEMORY: Final = re.compile("RESOURCE_EXHAUSTED|out of memory|failed to allocate", re.IGNORECASE)


class SweepRows(RowJob):
    """The rows of a sweep; a `nermo_mjx.runs.work.RowJob`.

    Attributes:
        sweep: whose rows.
        sought: the optimum that is sought, if any, and the repeats and variants of the sweep.
    """

    command = "sweep"

    def __init__(self, sweep: Sweep) -> None:
        self.sweep, self.group = sweep, sweep.digest()
        self.with_series, self.several_models = sweep.save is not None, len(sweep.structures) > 1
        self.sought = (
            None if sweep.optimum is None else (sweep.optimum, sweep.repeats, sweep.variants)
        )

    @functools.cached_property
    def sample(self) -> Sample:
        """All rows, each made on demand."""
        return Sample(self.sweep)

    @functools.cached_property
    def structures(self) -> np.ndarray:  # type: ignore[override]  # made on first use
        """See `RowJob`."""
        return self.sample.structures()

    @functools.cached_property
    def seconds(self) -> np.ndarray:  # type: ignore[override]  # made on first use
        """See `RowJob`."""
        return simulated_seconds(self.sweep, self.sample)

    def check_sources(self, sources: Sequence[Path]) -> None:
        """See `nermo_mjx.sweep.directory.check_source_sweeps`."""
        check_source_sweeps(sources, self.sweep)

    def claimed(self, directory: RunDirectory, chunk: int, *, extend: bool) -> SweepRows:
        """The rows of the sweep as a directory has it, see `nermo_mjx.sweep.directory.claim`."""
        sweep = dataclasses.replace(self.sweep, chunk=chunk)
        return SweepRows(claim(directory, sweep, extend=extend))

    def chunk(self, requested: int | None, engine: str, parts: int, simulate: bool = True) -> int:
        """Rows of a chunk: as many as are requested, or fill this machine.

        Raises:
            SpecError: as many do not fit.
        """
        rows = self.sweep.variants * self.sweep.repeats
        size = self._chunk_with_series(
            requested or self.sweep.chunk, lambda: chunk_rows_here(engine, rows, parts)
        )
        if simulate and (reason := too_many(min(size, rows))):
            raise SpecError(f"chunk is {size:,}: {reason}")
        return size

    def _chunk_with_series(self, requested: int | None, usual: Callable[[], int]) -> int:
        """Rows of a chunk whose series fit into memory."""
        if not self.with_series:
            return requested or usual()
        longest = self.seconds.max(keepdims=True)
        limit = max(1, int(LARGEST_CHUNK / max(series_bytes(self.sweep, longest), 1.0)))
        if requested is not None and requested > limit:
            needed_bytes = series_bytes(self.sweep, np.sort(self.seconds)[-requested:])
            raise SpecError(
                f"save takes {size(needed_bytes)} of memory for a chunk of {requested:,} "
                f"runs: allowed is {size(LARGEST_CHUNK)}; take chunk: {limit}, fewer sensors or a lower rate."
            )
        return requested or min(usual(), limit)

    def check_room(self, out: Path, index: np.ndarray) -> None:
        """Refuse missing rows, by their numbers, for whose time series the disk has no room.

        Raises:
            WrongDirectory: the series of these runs need more than is free.
        """
        needed, free = series_bytes(self.sweep, self.seconds[index]), shutil.disk_usage(out).free
        if needed > free:
            raise WrongDirectory(
                f"{out} has room for {size(free)}, and the time series would take up to {size(needed)}: choose another "
                "disk, fewer sensors or a lower rate."
            )

    def computer(
        self, engine: str, simulator: SimulatorLike | None, notify: Callable[[str], None]
    ) -> SweepSimulator:
        """What simulates the rows on an engine, or a simulator that replaces it."""
        sweep = self.sweep
        return SweepSimulator(sweep.structures, engine, simulator, notify, sweep.save)

    def further(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `RowJob`: further repeats of some variants."""
        seconds = simulated_seconds(self.sweep, self.sample, index)
        return self.sample.take(index).structure, seconds

    def keys(self, index: np.ndarray) -> np.ndarray:
        """See `RowJob`."""
        return keys_of_rows(self.sweep, self.sample.take(index))

    def task(self, batch: RowBatch) -> tuple[int, Mapping[str, np.ndarray]]:
        """See `RowJob`: what `SweepSimulator` takes."""
        walk = self.sweep.structures[batch.structure]
        return batch.structure, batch_values(walk, self.sample.take(batch.rows), batch.worlds)

    def tables(
        self, index: np.ndarray, result: Simulated, stamp: CodeStamp
    ) -> tuple[pa.Table, pa.Table | None]:
        """See `RowJob`; the worlds that fill the batch are left out."""
        count = len(index)
        metadata = {
            "engine": stamp.engine,
            "code": stamp.id,
            "steps": result.steps,
            "wall_seconds": result.seconds,
        }
        metrics = {name: column[:count] for name, column in result.metrics.items()}
        table = self._table(index, metrics, result.status[:count], stamp.id, metadata)
        series = None if result.series is None else series_table(self.sweep, index, result.series)
        return table, series

    def adopted(
        self, index: np.ndarray, table: pa.Table, series: Iterable[pa.Table]
    ) -> tuple[pa.Table, pa.Table | None]:
        """See `RowJob`."""
        metrics = {name: table[name].to_numpy() for name in columns_of(table, "metric")}
        status, code = (np.array(table[name].to_pylist(), object) for name in ("status", "code"))
        metadata = {key.decode(): text.decode() for key, text in table.schema.metadata.items()}
        runs = None
        if self.with_series:
            runs = pa.concat_tables(
                run_series.set_column(
                    0, run_series.schema.field("row"), pa.array(np.full(len(run_series), row))
                )
                for run_series, row in zip(series, index.tolist(), strict=True)
            ).replace_schema_metadata({"sweep": self.group})
        return self._table(index, metrics, status, code, metadata | {"code": str(code[0])}), runs

    def failure(self, index: np.ndarray, error: BaseException, out: Path) -> Exception:
        """See `RowJob`: a parameter that is refused, or why a simulation failed, and how to go on."""
        rows = f"rows {first_few(index)}"
        if isinstance(error, ParameterError):
            return SpecError(f"{rows} are refused: {error}")
        reason = (str(error).strip().splitlines() or [""])[0].rstrip(".")[:300]
        remedy = "run the same command again when it is fixed"
        if isinstance(error, MemoryError) or _NO_MEMORY.search(reason):
            remedy = "take a smaller --chunk in another directory"
        return JobFailed(
            f"{rows} failed: {type(error).__name__}{f': {reason}' if reason else ''}. What is finished is kept in "
            f"{out}: {remedy}."
        )

    def _table(
        self,
        index: np.ndarray,
        metrics: Mapping[str, np.ndarray],
        status: np.ndarray,
        code: str | np.ndarray,
        metadata: Mapping[str, Any],
    ) -> pa.Table:
        rows = self.sample.take(index)
        return chunk_table(self.sweep, rows, index, metrics, status, code, metadata)


# ---
# Which rows a chunk contains, and the batch that a simulator gets for it.


_NAMED_BATCH = 4
#: Simulated time of all runs of a sweep, at most [s].
MOST_SECONDS: Final = 1e9


def simulated_seconds(sweep: Sweep, rows: Sample, numbers: np.ndarray | None = None) -> np.ndarray:
    """How long each row is simulated, (n,) [s]; of `further` rows by their numbers (n,), instead of the sweep's own."""
    changed = {*sweep.varied, *(draw.name for draw in sweep.draws)}
    names = [
        name
        for name in changed
        if any(name in structure_walk.setup.timing for structure_walk in sweep.structures)
    ]
    if numbers is None:
        structure, columns = rows.structures(), {name: rows.column(name) for name in names}
    else:
        rows_taken = rows.take(numbers)
        structure, columns = rows_taken.structure, {name: rows_taken.values[name] for name in names}
    seconds = np.empty(len(structure))
    for structure_walk, walk in enumerate(sweep.structures):
        in_structure = structure == structure_walk
        values: dict[str, Any] = {
            name: value for name, value in walk.constants.items() if name in walk.setup.timing
        }
        values |= known(
            {
                name: column[in_structure]
                for name, column in columns.items()
                if name in walk.setup.timing
            }
        )
        _, end = walk.run.seconds(walk.setup.cycle_rate(values))
        seconds[in_structure] = np.asarray(end, dtype=float)
    if (total := seconds.sum()) > MOST_SECONDS:
        raise SpecError(
            f"the sweep simulates {total:.3g} s in {len(seconds):,} runs: allowed are {MOST_SECONDS:g} s; take shorter "
            "runs, or fewer of them."
        )
    return seconds


def batch_values(walk: WalkSpec, rows: Rows, worlds: int) -> dict[str, np.ndarray]:
    """Values of every parameter that the sweep names, for a simulator: name -> (worlds,).

    Args:
        walk: of the rows' structure.
        rows: those of the chunk, n; the last one is repeated until the batch is full.
        worlds: size of the batch, n or more.
    """
    padded = rows.take(np.pad(np.arange(len(rows)), (0, worlds - len(rows)), mode="edge"))
    constants = {name: np.full(worlds, value) for name, value in walk.constants.items()}
    return {**constants, **known(padded.values)}


def known(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns of one structure's rows without those that nothing reads in it."""
    return {name: column for name, column in values.items() if not np.isnan(column).any()}


def first_few(numbers: np.ndarray) -> str:
    """The first few of some numbers, for a sentence: 3, 7, 11, 15 and 60 more."""
    shown_numbers, hidden_count = (
        sorted(np.asarray(numbers).tolist())[:_NAMED_BATCH],
        len(numbers) - _NAMED_BATCH,
    )
    return ", ".join(map(str, shown_numbers)) + (
        f" and {hidden_count:,} more" if hidden_count > 0 else ""
    )


def keys_of_rows(sweep: Sweep, rows: Rows) -> np.ndarray:
    """The keys of runs, (n,): of their structures, values, draws and lengths, but not of their numbers or seeds."""
    keys = np.empty(len(rows), "S32")
    for structure_index in np.unique(rows.structure):
        walk, structure_rows = (
            sweep.structures[structure_index],
            np.flatnonzero(rows.structure == structure_index),
        )
        values = {
            name: np.full(len(structure_rows), value, float) for name, value in walk.fixed.items()
        }
        values |= known({name: column[structure_rows] for name, column in rows.values.items()})
        for name in (name for name in values if name.startswith("start.")):
            # A start in its place is that of a walk that does not name it.
            values[name] = np.where(values[name] == 0, np.nan, values[name])
        keys[structure_rows] = keys_of(walk.identity, values, len(structure_rows))
    return keys


# ---
# Time series beside the table: one file per chunk, a row per sample, a column per signal; and their size.


#: Most that the series of one chunk may take in memory [bytes]; two chunks are held at once.
LARGEST_CHUNK: Final = 512 * 2**20
#: A sample's row and time, and each of its signals [bytes].
_INDEX_BYTES, _SIGNAL_BYTES = 16, 4


def series_table(sweep: Sweep, index: np.ndarray, series: Series) -> pa.Table:
    """The table of one chunk's series: a run after the other, in the order of the chunk.

    Args:
        index: the runs' positions in the sweep, (n,).
        series: of n worlds or more, those of the chunk first.
    """
    chunk = series.first(len(index))
    is_recorded = np.arange(len(chunk.time)) < chunk.count[:, None]
    arrays = {
        "row": pa.array(np.repeat(index.astype(np.int64), chunk.count)),
        "time": pa.array(np.broadcast_to(chunk.time, is_recorded.shape)[is_recorded]),
    }
    fields = [
        _field("row", pa.int64(), "1", RUN_COLUMNS["row"], "index"),
        _field("time", pa.float64(), "s", "since the start, warm-up included", "index"),
    ]
    for signal in signals_of(sweep):
        arrays[signal.name] = pa.array(chunk.values[signal.name][is_recorded])
        fields.append(_field(signal.name, pa.float32(), signal.unit, signal.doc, "signal"))
    return pa.table(arrays, schema=pa.schema(fields, metadata={"sweep": sweep.digest()}))


def signals_of(sweep: Sweep) -> tuple[Signal, ...]:
    """The signals that a sweep saves."""
    return () if sweep.save is None else chosen_signals(sweep.setup.load(), sweep.save)


def series_bytes(sweep: Sweep, seconds: np.ndarray) -> float:
    """What the series of runs take, in memory, and on a disk at most [bytes].

    Args:
        seconds: how long each run lasts (n,) [s].
    """
    if sweep.save is None:
        return 0.0
    sample = _INDEX_BYTES + _SIGNAL_BYTES * len(signals_of(sweep))
    return float(np.sum(seconds)) * sweep.save.rate * sample


def size(amount: float) -> str:
    """Bytes in readable form.

    >>> size(2.5e9)
    '2.5 GB'
    """
    for unit, factor in (("GB", 1e9), ("MB", 1e6)):
        if amount >= factor:
            return f"{amount / factor:.3g} {unit}"
    return f"{amount / 1e3:.3g} kB"


def _field(name: str, kind: pa.DataType, unit: str, description: str, role: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "description": description, "role": role})
