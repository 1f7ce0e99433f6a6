"""Time series beside a sweep's table: one file per chunk, a row per sample, a column per signal; and their size."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from nermo_mjx.rollout import Series
from nermo_mjx.rollout.saving import Signal, chosen_signals
from nermo_mjx.runs.files import WrongDirectory
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.layout import simulated_seconds
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.spec import Sweep

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
    fields = [_field("row", pa.int64(), "1", "position of the run in the sweep", "index"),
              _field("time", pa.float64(), "s", "since the start, warm-up included", "index")]  # fmt: skip
    for signal in signals_of(sweep):
        arrays[signal.name] = pa.array(chunk.values[signal.name][kept])
        fields.append(_field(signal.name, pa.float32(), signal.unit, signal.doc, "signal"))
    return pa.table(arrays, schema=pa.schema(fields, metadata={"sweep": sweep.digest()}))


def joined_series(sweep: Sweep, parts: Sequence[pa.Table], index: np.ndarray) -> pa.Table:
    """One table of several, a run after the other, in the order of the chunk's rows (n,)."""
    if len(parts) == 1:
        return parts[0].replace_schema_metadata({"sweep": sweep.digest()})
    table = pa.concat_tables(part.replace_schema_metadata({"sweep": sweep.digest()}) for part in parts)
    place = np.empty(int(index.max()) + 1, int)
    place[index] = np.arange(len(index))
    return table.take(np.argsort(place[table.column("row").to_numpy()], kind="stable"))


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


def check_room(sweep: Sweep, out: Path, seconds: np.ndarray, missing: Sequence[np.ndarray]) -> None:
    """Refuse a sweep for which the disk has no room.

    Args:
        out: the directory.
        seconds: how long each run of the sweep lasts (rows,) [s].
        missing: rows of each chunk to be run.

    Raises:
        WrongDirectory: the series of these chunks need more than is free.
    """
    if sweep.save is None or not missing:
        return
    needed, free = series_bytes(sweep, seconds[np.concatenate(missing)]), shutil.disk_usage(out).free
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
