"""Time series beside a sweep's table: one file per chunk, a row per sample, a column per signal; and their size."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Series, Setup, Simulator
from nermo_mjx.rollout.saving import Signal, chosen_signals
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.runs.files import WrongDirectory
from nermo_mjx.runs.text import plain
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.replay import engine_for, find_row, replay_row, report_of
from nermo_mjx.sweep.results import RECORDINGS, Results
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.spec import Keep, Sweep, cost, sides_in
from nermo_mjx.sweep.store import simulated_seconds

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
    kept = np.arange(len(chunk.time)) < chunk.count[:, None]
    arrays = {
        "row": pa.array(np.repeat(index.astype(np.int64), chunk.count)),
        "time": pa.array(np.broadcast_to(chunk.time, kept.shape)[kept]),
    }
    fields = [
        _field("row", pa.int64(), "1", "position of the run in the sweep", "index"),
        _field("time", pa.float64(), "s", "since the start, warm-up included", "index"),
    ]
    for signal in signals_of(sweep):
        arrays[signal.name] = pa.array(chunk.values[signal.name][kept])
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


def chunk_with_series(sweep: Sweep, wanted: int | None, usual: Callable[[], int]) -> int:
    """Rows of a chunk whose series fit into memory.

    Args:
        wanted: by the user, if at all.
        usual: gives what is taken otherwise.

    Raises:
        SpecError: as many as are wanted do not fit.
    """
    if sweep.save is None:
        return wanted or usual()
    seconds = simulated_seconds(sweep, Sample(sweep))
    most = max(1, int(LARGEST_CHUNK / max(series_bytes(sweep, seconds.max(keepdims=True)), 1.0)))
    if wanted is not None and wanted > most:
        raise SpecError(
            f"save takes {size(series_bytes(sweep, np.sort(seconds)[-wanted:]))} of memory for a chunk of {wanted:,} "
            f"runs: allowed is {size(LARGEST_CHUNK)}; take chunk: {most}, fewer sensors or a lower rate."
        )
    return wanted or min(usual(), most)


def check_room(sweep: Sweep, out: Path, seconds: np.ndarray) -> None:
    """Refuse a sweep for which the disk has no room.

    Args:
        out: the directory.
        seconds: how long each run lasts that is missing (n,) [s].

    Raises:
        WrongDirectory: the series of these runs need more than is free.
    """
    needed, free = series_bytes(sweep, seconds), shutil.disk_usage(out).free
    if needed > free:
        raise WrongDirectory(
            f"{out} has room for {size(free)}, and the time series would take up to {size(needed)}: choose another "
            "disk, fewer sensors or a lower rate."
        )


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


# ---
# Rows of a complete sweep that are kept as recordings: each is replayed and recorded once.


#: Kinds of rows that are kept by their outcome.
_STATUSES: Final = ("fell", "diverged", "unsolved")


def recording_file(out: Path, row: int) -> Path:
    """Where a row of a directory is recorded, if it is kept."""
    return out / RECORDINGS / f"row-{row:06d}.npz"


def kept_rows(results: Results, keep: Keep) -> dict[int, str]:
    """The rows of a complete table that are kept, and why.

    The best come first, each of a different variant; then those with another outcome, the first ones in the table.
    """
    kept: dict[int, str] = {}
    if keep.best:
        price = cost(sides_in(results.schema)[keep.metric], results.column(keep.metric))
        price = np.where(results.well & np.isfinite(price), price, np.inf)
        order = np.argsort(price, kind="stable")
        order = order[np.isfinite(price[order])]
        _, first = np.unique(results.column("variant")[order], return_index=True)
        best = order[np.sort(first)[: keep.best]]
        kept |= {int(row): f"number {i} by {keep.metric}" for i, row in enumerate(best, 1)}
    status = results.column("status")
    for word in _STATUSES:
        for row in np.flatnonzero(status == word)[: getattr(keep, word)]:
            kept.setdefault(int(row), word)
    return kept


def record_rows(
    held: RunDirectory,
    digest: str,
    results: Results,
    keep: Keep,
    used: Any = None,
    check: Callable[[], None] = lambda: None,
    warn: Callable[[str], None] = lambda _: None,
) -> list[Path]:
    """Record the rows to keep that are not recorded yet; returns the files of all of them, in the order of the rows.

    Args:
        held: the directory of the complete table.
        digest: of its sweep.
        results: the table.
        keep: which rows.
        used: what simulated the table in this process, if anything; a `Simulator` has its programs compiled.
        check: called often; may raise an interruption. What is recorded until then stays.
        warn: called with a message if a replay does not give the table's numbers, or nothing can be recorded.

    Raises:
        DirectoryError: a file cannot be written.
    """
    files = []

    @functools.lru_cache
    def simulator(setup: Setup, engine: str) -> Simulator:
        if (getattr(used, "setup", None), getattr(getattr(used, "engine", None), "name", "")) == (setup, engine):
            return used
        try:
            return Simulator(setup, engine)
        except ParameterError:
            warn(f"the engine {engine} cannot run here: rows that are kept are replayed on the engine c.")
            return Simulator(setup, "c")

    for row, why in sorted(kept_rows(results, keep).items()):
        path = recording_file(held.out, row)
        with contextlib.suppress(RecordingError):  # absent, or damaged
            there = Recording.load(path).metadata
            if (there.get("row"), there.get("sweep")) == (row, digest):
                files.append(path)
                continue
        check()
        found = find_row(held.out, row)
        walker = simulator(found.walk.setup, engine_for(found))
        replay = replay_row(found, progress=lambda _: check(), simulator=walker)
        if not len(replay.history.time):
            warn(f"row {row} diverged in its first tick: there is nothing to record.")
            continue
        report = report_of(found, replay)
        if replay.comparison is not None and not replay.comparison.equal:
            warn(f"row {row} as it is recorded: {report['compared']}")
        about = {**report, "kept": why, "sweep": digest}
        content = dataclasses.replace(replay.recording(), metadata=plain(about)).content()
        held.move_aside(path.relative_to(held.out))
        held.write(path.relative_to(held.out), content)
        files.append(path)
    return files
