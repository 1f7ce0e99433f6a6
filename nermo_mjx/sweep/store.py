"""A sweep's directory: chunks of the result table, what they belong to, and who may write them.

DIR/sweep.yaml                    the resolved sweep
DIR/controller.py, DIR/metrics.py copies of the files of another controller, and of metrics, if the sweep names them
DIR/run.json                      which codes made the rows; each session's versions, machine and command
DIR/results/chunk-00000.parquet   rows of one chunk, written atomically
DIR/series/chunk-00000.parquet    time series of the same rows, if the sweep saves any; a chunk is both files
DIR/recordings/row-000123.npz     rows that are kept (`keeping.py`)
DIR/manifest.sha256               a digest of each chunk, as `sha256sum` writes it; each shard has a file of its own
DIR/results.before-1/             results and sweep.yaml from before the sweep was extended; rows are taken from there
DIR/results.aside/, series.aside/ chunks that were damaged, or that other defaults made, when they are run again
DIR/summary.json, DIR/plots/      made from the table when it is complete
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nermo_mjx.rollout.run import START_SPREAD
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import RunDirectory, remove_leftovers
from nermo_mjx.runs.files import DirectoryError, append_line, clear_errors, create_file, parquet_bytes, sync_folder
from nermo_mjx.specs.controllers import with_code_copied
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.specs.walk import WalkSpec
from nermo_mjx.sweep.results import chunk_files, digests_of
from nermo_mjx.sweep.sampling import Rows, Sample
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.structures import STRUCTURES

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
    names = _apart(there, here)
    return _sentence(there, here, [name for name in names if not _of_rows(name, free)])


def differences(there: Sweep, here: Sweep) -> str:
    """How two sweeps differ: the first fields, each with both values: `seed is 0 there and 5 here`."""
    # The same values, but another row 0.
    return _sentence(there, here, _apart(there, here)) or (
        "the parameters under vary or randomize stand in another order"
    )


def refusal(there: Sweep, here: Sweep) -> str:
    """Why a directory's sweep cannot be extended to another one, in words; empty if it can."""
    fixed = fixed_differences(there, here)
    if fixed:
        return f"{fixed}: what is not varied stays as it is"
    if there.sampler == here.sampler == "latin_hypercube" and there.samples != here.samples:
        return (
            f"a Latin hypercube of {there.samples} points is not part of one of {here.samples}: use a Sobol sample, "
            "which can be extended, or repeats"
        )
    return ""


def _of_rows(name: str, free: set[str]) -> bool:
    return name in free or name.split(".")[0] in free & set(STRUCTURES) or any(
        name == field or name.startswith(f"{field}.") for field in _ROWS
    )  # fmt: skip


def _apart(there: Sweep, here: Sweep) -> list[str]:
    first, second = _fields(there.decisive()), _fields(here.decisive())
    return [name for name in {**first, **second} if first.get(name) != second.get(name)]


def _sentence(there: Sweep, here: Sweep, names: list[str]) -> str:
    first, second = _fields(there.decisive()), _fields(here.decisive())
    shown = [f"{name} is {_text(first.get(name))} there and {_text(second.get(name))} here" for name in names[:_NAMED]]
    return "; ".join(shown) + (f"; and {len(names) - _NAMED} more fields" if len(names) > _NAMED else "")


def _fields(data: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Dotted names and values of all fields; lists are values."""
    fields: dict[str, Any] = {}
    for key, value in data.items():
        fields |= _fields(value, f"{above}{key}.") if isinstance(value, Mapping) else {f"{above}{key}": value}
    return fields


def _text(value: Any) -> str:
    text = "absent" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


# ---
# Which rows a chunk contains, and the batch that a simulator gets for it.


_NAMED_BATCH = 4


def simulated_seconds(sweep: Sweep, rows: Sample) -> np.ndarray:
    """How long each row is simulated, (n,) [s]."""
    changed = {*sweep.varied, *(draw.name for draw in sweep.draws)}
    structure, seconds = rows.structures(), np.empty(len(rows))
    columns = {name: rows.column(name) for name in changed if any(name in at.setup.timing for at in sweep.structures)}
    for at, walk in enumerate(sweep.structures):
        here = structure == at
        values: dict[str, Any] = {name: value for name, value in walk.constants.items() if name in walk.setup.timing}
        values |= known({name: column[here] for name, column in columns.items() if name in walk.setup.timing})
        _, end = walk.run.seconds(walk.setup.cycle_rate(values))
        seconds[here] = np.asarray(end, dtype=float)
    return seconds


def layout_of(seconds: np.ndarray, size: int, structure: np.ndarray | None = None) -> list[np.ndarray]:
    """Rows of each chunk: rows of one chunk share structure and duration; chunks are of equal size (to one row).

    Args:
        seconds: how long each row is simulated, (n,) [s].
        size: of a chunk, at most.
        structure: of each row, (n,) int; one for all by default.
    """
    order = np.argsort(seconds, kind="stable")
    if structure is None:
        return np.array_split(order, math.ceil(len(order) / size))
    each = (order[structure[order] == at] for at in np.unique(structure))
    return [chunk for rows in each for chunk in np.array_split(rows, math.ceil(len(rows) / size))]


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


def rows_digest(index: np.ndarray) -> str:
    """A hash of which rows a chunk contains, and in which order."""
    return hashlib.blake2b(np.asarray(index, dtype="<i8").tobytes(), digest_size=12).hexdigest()


def listed(numbers: np.ndarray) -> str:
    """The first few of some numbers, for a sentence: 3, 7, 11, 15 and 60 more."""
    shown, more = sorted(np.asarray(numbers).tolist())[:_NAMED_BATCH], len(numbers) - _NAMED_BATCH
    return ", ".join(map(str, shown)) + (f" and {more:,} more" if more > 0 else "")


#: Folder of the rows that are kept.
RECORDINGS: Final = "recordings"
#: What is made of the results, and belongs to them.
_MADE = ("summary.json", "plots", RECORDINGS, "series")
#: How folders with the results before a sweep was extended begin; a number follows.
BEFORE: Final = "results.before-"


class ChunkNote(NamedTuple):
    """What a finished chunk says about itself: its engine, physics steps, and the time they took [s]."""

    engine: str
    steps: float
    seconds: float


class ChunkState(NamedTuple):
    """A chunk's note if it is finished; else what is wrong with its file, empty if there is none."""

    note: ChunkNote | None
    flaw: str = ""


class Store:
    """A directory held by this process for one sweep; use it in a `with` statement.

    Args:
        out: the directory; made if it does not exist.
        sweep: what the directory is for.
        shard: (i, n) if this process works on every n-th chunk, alongside others; otherwise no other process may write.
        extend: whether a directory that contains a sweep differing only in its rows may be extended to this one.

    Raises:
        DirectoryError: the directory holds another sweep, is in use, or cannot be written.
    """

    def __init__(
        self,
        out: str | os.PathLike[str],
        sweep: Sweep,
        shard: tuple[int, int] | None = None,
        *,
        extend: bool = False,
    ) -> None:
        self.out, self.sweep, self.shard, self.extend = Path(out), sweep, shard, extend
        self.directory = RunDirectory(out, "sweep", shard)
        self.results, self.plots = self.out / "results", self.out / "plots"
        self._manifest = "manifest{}.sha256".format("" if shard is None else "-{}-of-{}".format(*shard))
        self._digest = sweep.digest().encode()

    def __enter__(self) -> Store:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self.directory)
            with clear_errors(self.out):
                self.results.mkdir(exist_ok=True)
                self._claim()
                made = self.results, self.plots, self.out / "series", self.out / RECORDINGS
                for folder in made if self.shard is None else ():
                    remove_leftovers(folder)
            stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.directory.__exit__()

    def chunk_path(self, chunk: int) -> Path:
        """Where a chunk's rows are kept."""
        return self.results / _name(chunk)

    def present(self) -> set[int]:
        """The chunks that have a file, whatever is in it."""
        with clear_errors(self.out):
            return set(chunk_files(self.out))

    def former(self) -> list[Path]:
        """Folders with the results of this directory's sweep before it was extended, the last one first."""
        found = (path for path in self.out.glob(f"{BEFORE}*") if (path / "results").exists())
        return sorted(found, key=_number, reverse=True)

    def states(self, layout: Sequence[np.ndarray]) -> Iterator[tuple[int, ChunkState]]:
        """The state of each chunk that has a file, in order, for the rows that it is to hold."""
        with clear_errors(self.out):
            digests = digests_of(self.out)
        for k in sorted(self.present()):
            if k < len(layout):
                yield k, self.inspect(k, layout[k], digests)

    def inspect(self, chunk: int, rows: np.ndarray, digests: Mapping[str, str]) -> ChunkState:
        """Whether a chunk is there, undamaged to the last bit, and holds exactly these rows of this sweep.

        One that no manifest names is none of the program's, and counts as damaged.
        """
        try:
            content = self.chunk_path(chunk).read_bytes()
        except FileNotFoundError:
            return ChunkState(None)
        except OSError as error:
            return ChunkState(None, f"cannot be read ({error.strerror})")
        if _digest(content) not in digests:
            return ChunkState(None, "is damaged")
        about = pq.read_metadata(pa.BufferReader(content)).metadata
        if about.get(b"sweep") != self._digest:
            return ChunkState(None, "was made by another sweep, or with other defaults")
        if about[b"rows"].decode() != rows_digest(rows):
            return ChunkState(None, "holds other rows")
        if self.sweep.save is not None and not self._has_series(chunk, digests):
            return ChunkState(None, "has no time series, or damaged ones")
        return ChunkState(ChunkNote(about[b"engine"].decode(), float(about[b"steps"]), float(about[b"wall_seconds"])))

    def write_chunk(self, chunk: int, table: pa.Table, series: pa.Table | None = None) -> None:
        """Store a chunk atomically: readers see all of it or nothing. A file already in its place is moved aside.

        Its time series are there before it, so that a chunk that is there has them.
        """
        for folder, part in (("series", series), ("results", table)):
            if part is None:
                continue
            content, name = parquet_bytes(part), f"{folder}/{_name(chunk)}"
            with clear_errors(self.out):  # first its digest: a chunk without one counts as damaged
                append_line(self.out / self._manifest, f"{_digest(content)}  {name}")
            self.directory.move_aside(name, f"{folder}.aside")
            self.directory.write(name, content)

    def _has_series(self, chunk: int, digests: Mapping[str, str]) -> bool:
        """Whether a chunk's time series are there, undamaged."""
        name = f"series/{_name(chunk)}"
        try:
            return digests.get(_digest((self.out / name).read_bytes())) == name
        except OSError:
            return False

    def take_codes(self, stamps: Sequence[CodeStamp], *, accept: bool) -> None:
        """See `RunDirectory.take_code`; the stamps are those of several models of one code."""
        former = bool(self.former())
        holds, several = former or bool(self.present()), former or len(self.sweep.structures) > 1
        for stamp in stamps:
            self.directory.take_code(stamp, holds_rows=holds, accept=accept, any_model=several)
            holds = True

    def _claim(self) -> None:
        """Make the directory this sweep's, or refuse. A directory keeps the chunks it was started with."""
        path = self.out / "sweep.yaml"
        if not path.exists():
            if any(self.results.glob("*.parquet")):
                raise self._foreign("results of an unknown sweep (it has no sweep.yaml); choose another directory")
            folder = self.out.resolve()
            self.sweep = dataclasses.replace(
                self.sweep, setup=with_code_copied(self.sweep.setup, folder, self.directory.write)
            )
            self._keep_rows()
            create_file(path, self.sweep.to_yaml(folder).encode())
        # Even if it was just written: another shard may have been faster, and have chosen other chunks.
        try:
            begun = Sweep.from_directory(self.out)
        except SpecError as error:
            raise self._foreign(f"a sweep that cannot be read ({error}); choose another directory") from None
        self._digest = self.sweep.digest().encode()
        if begun.digest() != self.sweep.digest():
            why = refusal(begun, self.sweep)
            if self.extend and not why:
                self._extend(begun)
                return
            apart, resume = differences(begun, self.sweep), f"resume with {path}"
            if self.extend:
                raise self._foreign(f"a sweep that cannot be extended to this one: {why}; choose another directory")
            also = ", or add these rows to it with --extend" if not why else ""
            raise self._foreign(f"the results of another sweep: {apart}; choose another directory, or {resume}{also}")
        self.sweep = dataclasses.replace(self.sweep, chunk=begun.chunk or self.sweep.chunk)
        if self.shard is None and begun.comparison != self.sweep.comparison:  # no row depends on it
            again = dataclasses.replace(begun, comparison=self.sweep.comparison)
            self.directory.write(path, again.to_yaml(self.out.resolve()).encode())

    def _extend(self, begun: Sweep) -> None:
        """Make the directory that of this sweep. Its results go into a folder, where their rows are found again.

        If interrupted at any moment, each result is in one of the two places, with the sweep that it belongs to.
        """
        path, folder = self.out / "sweep.yaml", self.out.resolve()
        if chunk_files(self.out):
            taken = [_number(each) for each in self.former()]
            before = self.out / f"{BEFORE}{max(taken, default=0) + 1}"
            before.mkdir(exist_ok=True)
            for pattern in ("sweep.yaml", "rows-*.parquet", "controller*.py", "metrics*.py", "manifest*.sha256"):
                for each in self.out.glob(pattern):
                    self.directory.write(before / each.name, each.read_bytes())
            for name in _MADE:
                if (before / name).exists():
                    self.directory.move_aside(name, before.name)
                elif (self.out / name).exists():
                    (self.out / name).rename(before / name)
            self.results.rename(before / "results")
            sync_folder(before)
            sync_folder(self.out)
            self.results.mkdir()
        kept = with_code_copied(self.sweep.setup, folder, self.directory.write)
        self.sweep = dataclasses.replace(self.sweep, setup=kept, chunk=begun.chunk or self.sweep.chunk)
        self._keep_rows()
        self.directory.write(path.name, self.sweep.to_yaml(folder).encode())

    def _keep_rows(self) -> None:
        """Put the rows that are given one by one into the directory."""
        if self.sweep.rows is not None:
            self.directory.write(*self.sweep.kept_rows())

    def _foreign(self, content: str) -> DirectoryError:
        return DirectoryError(f"{self.out} holds {content}.")


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _number(folder: Path) -> int:
    number = folder.name.removeprefix(BEFORE)
    return int(number) if number.isdecimal() else 0


def _name(chunk: int) -> str:
    return f"chunk-{chunk:05d}.parquet"


# ---
# How much of a sweep is done, counted in simulated time.


@dataclasses.dataclass(frozen=True)
class SweepProgress:
    """How far a sweep is.

    Attributes:
        fraction: share of the work that is done, by simulated time, 0 to 1; resumed chunks count as done; of a shard
            it is that shard's share.
        rows_done, rows: finished rows and all rows of the same work.
        resumed: rows that an earlier session had finished.
    """

    fraction: float
    rows_done: int
    rows: int
    resumed: int


class Tally:
    """Counts finished chunks, and tells.

    Args:
        layout: rows of each chunk.
        seconds: simulated time of each row, (rows,) [s].
        counted: the chunks that count.
        listener: is told.
    """

    def __init__(
        self,
        layout: Sequence[np.ndarray],
        seconds: np.ndarray,
        counted: Iterable[int],
        listener: Callable[[SweepProgress], None] | None,
    ) -> None:
        # A chunk costs as long as its longest row, all its rows.
        self._cost = {k: len(layout[k]) * float(seconds[layout[k][-1]]) for k in counted}
        self._rows = {k: len(layout[k]) for k in self._cost}
        self._all, self._all_rows = sum(self._cost.values()), sum(self._rows.values())
        self._listener = listener
        self._finished: set[int] = set()
        self._done, self._rows_done, self._resumed = 0.0, 0, 0

    def finish(self, chunks: Iterable[int], *, resumed: bool = False) -> None:
        """Chunks are done; those that do not count, or are counted already, are passed over."""
        for k in chunks:
            if k in self._cost and k not in self._finished:
                self._finished.add(k)
                self._done += self._cost[k]
                self._rows_done += self._rows[k]
                self._resumed += self._rows[k] if resumed else 0

    def tell(self, chunk: int | None = None, share: float = 0.0) -> None:
        """Report the overall progress, including the fraction of the current chunk."""
        if self._listener is None:
            return
        current = 0.0 if chunk is None else self._cost[chunk] * min(max(float(share), 0.0), 1.0)
        complete = len(self._finished) == len(self._cost)
        fraction = 1.0 if complete else (self._done + current) / self._all
        self._listener(SweepProgress(fraction, self._rows_done, self._all_rows, self._resumed))
