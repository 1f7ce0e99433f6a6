"""A sweep's directory: what it is for, how two sweeps differ, and which of its rows are simulated together.

DIR/sweep.yaml                    the resolved sweep
DIR/sweep.json                    what is to be known of it without running code that it names
DIR/controller.py, DIR/metrics.py copies of the files of another controller, and of metrics, if the sweep names them
DIR/run.json                      which codes made the rows; each session's versions, machine and command
DIR/results/, series/, former/    the rows, their time series, and those of the sweep before it was extended, see
                                  `nermo_mjx.runs.rows`; with them, in former/, what was made of these
DIR/results.aside/                parts that were damaged when they were made again
DIR/recordings/row-000123.npz     rows that are kept (`replay.py`)
DIR/summary.json, DIR/plots/      made from the table when it is complete
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.files import MAX_JSON_BYTES, read_bytes
from nermo_mjx.rollout import Series
from nermo_mjx.rollout.run import START_SPREAD
from nermo_mjx.rollout.saving import Signal, chosen_signals
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.runs.files import (
    DirectoryError,
    WrongDirectory,
    clear_errors,
    content_of,
    create_file,
    to_json,
)
from nermo_mjx.runs.rows import FORMER, keys_of, retire
from nermo_mjx.specs.controllers import code_identity, with_code_copied
from nermo_mjx.specs.reading import SpecError, differing
from nermo_mjx.specs.walk import WalkSpec, unread
from nermo_mjx.sweep.spec import Rows, Sample, Sweep
from nermo_mjx.sweep.structures import STRUCTURES
from nermo_mjx.sweep.table import RECORD, RECORDINGS, SweepRecord
from nermo_mjx.trust import shortened

# ---
# Whether the sweep of a directory can be extended to another one, and how two sweeps differ.


#: Fields that determine the rows; all others are fixed.
_ROWS: Final = ("vary", "rows", "sample", "randomize.repeats")
#: Number of fields that a message names when two sweeps differ.
_NAMED: Final = 3


def fixed_differences(there: Sweep, here: Sweep) -> str:
    """How two sweeps differ apart from their rows, as `seed is 0 there and 5 here`; empty if they do not.

    What one of them fixes may be varied by the other.
    """
    free = {*there.labelled, *here.labelled}
    free |= {f"set.{name}" for name in (*there.varied, *here.varied)}
    free |= {f"randomize.{name}" for name in START_SPREAD}  # come with repeats
    if "physics" in free:
        free.add("timestep")
    apart = _apart(there, here)
    for name in list(apart):
        varied = name.split(".")[0] in free & set(STRUCTURES)
        if varied or name in free or any(f"{name}.".startswith(f"{field}.") for field in _ROWS):
            del apart[name]
    return _sentence(apart)


def sweep_differences(there: Sweep, here: Sweep) -> str:
    """How two sweeps differ: the first fields, each with both values: `seed is 0 there and 5 here`."""
    # The same values, but another row 0.
    return _sentence(_apart(there, here)) or (
        "the parameters under vary or randomize stand in another order"
    )


def refusal(there: Sweep, here: Sweep) -> str:
    """Why a directory's sweep cannot be extended to another one, in words; empty if it can."""
    if fixed := fixed_differences(there, here):
        return f"{fixed}: what is not varied stays as it is"
    if there.sampler == here.sampler == "latin_hypercube" and there.samples != here.samples:
        return (
            f"a Latin hypercube of {there.samples} points is not part of one of {here.samples}: use a Sobol sample, "
            "which can be extended, or repeats"
        )
    return ""


def _apart(there: Sweep, here: Sweep) -> dict[str, tuple[Any, Any]]:
    """The fields in which they differ; what stands in an empty section has a name of its own."""
    apart = differing(there.decisive(), here.decisive())
    return {name: values for name, values in apart.items() if {} not in values}


def _sentence(apart: Mapping[str, tuple[Any, Any]]) -> str:
    some = [
        f"{name} is {_text(a)} there and {_text(b)} here"
        for name, (a, b) in list(apart.items())[:_NAMED]
    ]
    return "; ".join(some) + (
        f"; and {len(apart) - _NAMED} more fields" if len(apart) > _NAMED else ""
    )


def _text(value: Any) -> str:
    return shortened(f"{value:g}" if isinstance(value, float) else str(value))


# ---
# Which rows a chunk contains, and the batch that a simulator gets for it.


_NAMED_BATCH = 4
#: Simulated time of all runs of a sweep, at most [s].
MOST_SECONDS: Final = 1e9


def simulated_seconds(sweep: Sweep, rows: Sample, further: np.ndarray | None = None) -> np.ndarray:
    """How long each row is simulated, (n,) [s]; of `further` rows by their numbers (n,), instead of the sweep's own."""
    changed = {*sweep.varied, *(draw.name for draw in sweep.draws)}
    names = [name for name in changed if any(name in at.setup.timing for at in sweep.structures)]
    if further is None:
        structure, columns = rows.structures(), {name: rows.column(name) for name in names}
    else:
        taken = rows.take(further)
        structure, columns = taken.structure, {name: taken.values[name] for name in names}
    seconds = np.empty(len(structure))
    for at, walk in enumerate(sweep.structures):
        here = structure == at
        values: dict[str, Any] = {
            name: value for name, value in walk.constants.items() if name in walk.setup.timing
        }
        values |= known(
            {name: column[here] for name, column in columns.items() if name in walk.setup.timing}
        )
        _, end = walk.run.seconds(walk.setup.cycle_rate(values))
        seconds[here] = np.asarray(end, dtype=float)
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
    shown, more = sorted(np.asarray(numbers).tolist())[:_NAMED_BATCH], len(numbers) - _NAMED_BATCH
    return ", ".join(map(str, shown)) + (f" and {more:,} more" if more > 0 else "")


def keys_of_rows(sweep: Sweep, rows: Rows) -> np.ndarray:
    """The keys of runs, (n,): of their structures, values, draws and lengths, but not of their numbers or seeds."""
    keys = np.empty(len(rows), "S32")
    for at in np.unique(rows.structure):
        walk, here = sweep.structures[at], np.flatnonzero(rows.structure == at)
        values = {name: np.full(len(here), value, float) for name, value in walk.fixed.items()}
        values |= known({name: column[here] for name, column in rows.values.items()})
        for name in (name for name in values if name.startswith("start.")):
            # A start in its place is that of a walk that does not name it.
            values[name] = np.where(values[name] == 0, np.nan, values[name])
        keys[here] = keys_of(walk.identity, values, len(here))
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
# What a directory is for: its sweep, which is written first, and extended where that is asked for.


#: What is made of the results, and belongs to them.
_TABLES: Final = (
    "comparison.parquet",
    "sensitivity.parquet",
    "optimum.parquet",
    "optimum.csv",
    "optimum.tex",
)
_MADE: Final = ("summary.json", *_TABLES, "plots", RECORDINGS)


def claim(held: RunDirectory, sweep: Sweep, *, extend: bool = False) -> Sweep:
    """Make a directory this sweep's, or refuse.

    Args:
        held: the directory.
        sweep: what it is to be for.
        extend: whether a sweep there that differs only in its rows may become this one.

    Returns:
        The sweep, with the directory's copies of code and its size of batches.

    Raises:
        DirectoryError: the directory holds another sweep, or cannot be written.
    """
    out, path, folder = held.out, held.out / "sweep.yaml", held.out.resolve()
    with clear_errors(out):
        if not path.exists():
            if any(out.glob("results/*.parquet")):
                raise DirectoryError(
                    f"{out} holds results of an unknown sweep (it has no sweep.yaml); choose another directory."
                )
            sweep = _with_files(held, sweep)
            create_file(path, sweep.to_yaml(folder).encode())
        # Even if it was just written: another shard may have been faster, and have chosen another size.
        try:
            same = read_bytes(path, MAX_JSON_BYTES) == sweep.to_yaml(folder).encode()
            begun = sweep if same else Sweep.from_directory(out)
        except SpecError as error:
            raise DirectoryError(
                f"{out} holds a sweep that cannot be read ({error}); choose another directory."
            ) from None
        sweep = dataclasses.replace(sweep, chunk=begun.chunk or sweep.chunk)
        if begun.digest() != sweep.digest():
            why = refusal(begun, sweep)
            if extend and why:
                raise DirectoryError(
                    f"{out} holds a sweep that cannot be extended to this one: {why}; choose another directory."
                )
            if not extend:
                also = "" if why else ", or add these rows to it with --extend"
                raise DirectoryError(
                    f"{out} holds the results of another sweep: {sweep_differences(begun, sweep)}; choose another "
                    f"directory, or resume with {path}{also}."
                )
            # Killed at any moment, the results are in one of two folders, and both sweeps find them there.
            (out / FORMER).mkdir(exist_ok=True)
            held.write(f"{FORMER}/sweep-{begun.digest()}.yaml", read_bytes(path, MAX_JSON_BYTES))
            retire(held, sweep.digest())
            for name in _MADE:
                held.move_aside(name, FORMER)
            sweep = _with_files(held, sweep)
            held.write(path.name, sweep.to_yaml(folder).encode())
        elif held.shard is None and (begun.compare, begun.optimum) != (
            sweep.compare,
            sweep.optimum,
        ):
            again = dataclasses.replace(
                begun, compare=sweep.compare, optimum=sweep.optimum
            )  # no row depends on them
            held.write(path.name, again.to_yaml(folder).encode())
        values = dict[str, set[float]]()
        for walk in sweep.structures:
            own = walk.setup.defaults() | walk.constants
            for name in sweep.parameters:
                values.setdefault(name, set()).update(
                    [own[name]] if unread(walk.setup, name) is None else []
                )
        asked: Any = None if sweep.compare is None else sweep.compare.written()
        read = SweepRecord(
            rows=sweep.variants * sweep.repeats,
            fields=sweep.walk_fields() | code_identity(sweep.setup),
            labelled=sweep.labelled,
            parameters={
                name: each.pop() if len(each) == 1 else None for name, each in values.items()
            },
            comparison=asked,
            optimum=None if sweep.optimum is None else sweep.optimum.written(),
            variants=sweep.variants,
            repeats=sweep.repeats,
        )
        record = to_json(dataclasses.asdict(read))
        if held.shard is not None:
            create_file(out / RECORD, record)
        elif content_of(out / RECORD) != record:
            held.write(RECORD, record)
    return sweep


def _with_files(held: RunDirectory, sweep: Sweep) -> Sweep:
    """The sweep with the files that it names copied into the directory."""
    if sweep.rows is not None:
        held.write(*sweep.kept_rows())
    return dataclasses.replace(
        sweep, setup=with_code_copied(sweep.setup, held.out.resolve(), held.write)
    )


def sweep_in(source: Path) -> Sweep:
    """The sweep of a directory that rows are taken from.

    Raises:
        DirectoryError: it is none of a sweep, or its sweep cannot be read.
    """
    if not (source / "sweep.yaml").exists():
        there = "not the directory of a sweep" if source.is_dir() else "no such directory"
        raise DirectoryError(f"{source}: {there}; allowed is one with a file sweep.yaml.")
    try:
        return Sweep.from_directory(source)
    except SpecError as error:
        raise DirectoryError(f"{source} holds a sweep that cannot be read ({error}).") from None


def check_source(source: Path, sweep: Sweep) -> None:
    """Refuse a directory whose sweep differs from another one in more than its rows.

    Raises:
        DirectoryError: it does, or it is none of a sweep.
    """
    apart = fixed_differences(sweep_in(source), sweep)
    if apart:
        raise DirectoryError(f"rows of {source} cannot be used: {apart}.")
