"""Rows that have been run before, in a directory's former results or in other directories, identified by content.

A row is identified by its structure, its values, drawn ones included, and its duration; not by its number, its
seed, or the sweep for which it was run.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import OtherCode, codes_of
from nermo_mjx.runs.files import DirectoryError, parquet_table
from nermo_mjx.specs.controllers import code_identity
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.results import chunk_files, digests_of
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.simulating import Simulated
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.store import fixed_differences
from nermo_mjx.sweep.structures import Structure
from nermo_mjx.sweep.table import columns_of, labelled

#: Tables of former chunks that are held at once: rows of a new chunk lie in a few of them.
_HELD: Final = 32


class TakenRows(NamedTuple):
    """Results of n rows that are known.

    Attributes:
        metrics: name -> (n,).
        status, code: (n,) texts.
        engine: that made the first one.
        steps, seconds: physics steps of the rows, and the time they took [s].
    """

    metrics: dict[str, np.ndarray]
    status: np.ndarray
    code: np.ndarray
    engine: str
    steps: float
    seconds: float


class KnownRows:
    """An index of the rows of some directories.

    Args:
        sources: the directories, each with a sweep.yaml and results; a row that is in several is taken from the first.
        warn: called with a message if a chunk cannot be used.
        series: whether time series are taken, too; a chunk without undamaged ones is not used.

    Raises:
        DirectoryError: a source is not a sweep directory, or cannot be read.
    """

    def __init__(
        self, sources: Sequence[Path], warn: Callable[[str], None] | None = None, *, series: bool = False
    ) -> None:
        self._paths: list[Path] = []
        self._unnamed: list[Path] = []
        self._codes: dict[str, CodeStamp] = {}
        keys, places = [np.empty(0, "S32")], [np.empty((0, 2), np.int64)]
        for source in sources:
            sweep = sweep_in(source)
            digest, digests = sweep.digest().encode(), digests_of(source)
            codes = codes_of(source if (source / "run.json").exists() else source.parent)
            self._codes |= codes
            if not codes:
                self._unnamed.append(source)
            for path in chunk_files(source).values():
                content = path.read_bytes()
                table = parquet_table(content) if hashlib.sha256(content).hexdigest() in digests else None
                if series and not _sealed(_series_of(path), digests):
                    table = None
                if table is None or (table.schema.metadata or {}).get(b"sweep") != digest:
                    if warn is not None:
                        why = "is damaged" if table is None else "was made by another sweep, or with other defaults"
                        warn(f"{path} {why}; its rows are not used.")
                    continue
                keys.append(_keys_of(sweep, table))
                places.append(np.column_stack([np.full(len(table), len(self._paths)), np.arange(len(table))]))
                self._paths.append(path)
        self._keys, first = np.unique(np.concatenate(keys), return_index=True)
        self._places = np.concatenate(places)[first]

    def __len__(self) -> int:
        return len(self._keys)

    def find(self, sweep: Sweep, structure: np.ndarray, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Where rows of a sweep are here, (n,) int; -1 where they are not."""
        wanted = keys_of(sweep.structures, structure, values)
        if not len(self._keys):
            return np.full(len(wanted), -1)
        at = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        return np.where(self._keys[at] == wanted, at, -1)

    def take(self, places: np.ndarray) -> TakenRows:
        """The results of rows, of which there is one at least."""
        files, rows = self._places[places].T
        parts, order = [], []
        steps = seconds = 0.0
        for file in np.unique(files):
            here = np.flatnonzero(files == file)
            table = self._table(int(file))
            about = table.schema.metadata
            steps += float(about[b"steps"]) * len(here) / len(table)
            seconds += float(about[b"wall_seconds"]) * len(here) / len(table)
            parts.append(table.take(rows[here]).replace_schema_metadata(None))
            order.append(here)
        table = pa.concat_tables(parts, promote_options="default").take(np.argsort(np.concatenate(order)))
        metrics = {name: table.column(name).to_numpy() for name in columns_of(self._table(int(files[0])), "metric")}
        status = np.array(table.column("status").to_pylist(), object)
        code = np.array(table.column("code").to_pylist(), object)
        engine = self._table(int(files[0])).schema.metadata[b"engine"].decode()
        return TakenRows(metrics, status, code, engine, steps, seconds)

    def series(self, places: np.ndarray, index: np.ndarray) -> pa.Table:
        """The time series of rows, a run after the other.

        Args:
            places: of the rows, and `index` their numbers in the sweep that takes them, (n,).
        """
        parts = []
        for (file, row), number in zip(self._places[places].tolist(), index.tolist(), strict=True):
            path = _series_of(self._paths[file])
            table = parquet_table(path)
            if table is None:
                raise DirectoryError(f"{path} cannot be read any more: run the same command again.")
            former = self._table(file).column("row")[row].as_py()
            own = table.filter(pc.equal(table.column("row"), former))
            parts.append(own.set_column(0, own.schema.field("row"), pa.array(np.full(len(own), number))))
        return pa.concat_tables(parts)

    def codes(self, *, accept: bool) -> list[CodeStamp]:
        """Which codes made rows, as far as the directories say.

        Args:
            accept: whether they need not say it.

        Raises:
            OtherCode: one does not, and has to.
        """
        if self._unnamed and not accept:
            raise OtherCode(
                f"{self._unnamed[0]} does not say which code made it: its rows are used with "
                "--accept-new-code; distinguish them by their column code."
            )
        return list(self._codes.values())

    @functools.lru_cache(_HELD)  # noqa: B019 - the index lives as long as the run
    def _table(self, file: int) -> pa.Table:
        table = parquet_table(self._paths[file])
        if table is None:
            raise DirectoryError(f"{self._paths[file]} cannot be read any more: run the same command again.")
        return table


def _series_of(path: Path) -> Path:
    """The time series beside a chunk."""
    return path.parent.parent / "series" / path.name


def _sealed(path: Path, digests: Mapping[str, str]) -> bool:
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() in digests


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


def with_former(source: Path) -> list[Path]:
    """A directory of a sweep, and its folders with results from before it was extended."""
    return [source, *sorted(path for path in source.glob("results.before-*") if (path / "sweep.yaml").exists())]


def keys_of(structures: Sequence[Structure], structure: np.ndarray, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """A key for the content of each row, (n,) of 32 bytes.

    Args:
        structures: of the sweep, and `structure` the place of each row's among them, (n,) int.
        values: varied and randomized parameters, name -> (n,); NaN where a structure does not read one.
    """
    keys = np.empty(len(structure), "S32")
    for at in np.unique(structure):
        walk, here = structures[at], np.flatnonzero(structure == at)
        whole = {name: np.full(len(here), value) for name, value in walk.fixed.items()}
        whole |= {name: column[here] for name, column in values.items() if not np.isnan(column[here]).any()}
        names = sorted(whole)
        base = hashlib.blake2b(_identity(walk).encode(), digest_size=16)
        for i, row in enumerate(here):
            total = base.copy()
            # A start in its place is that of a walk that does not name it.
            parts = [f"{name} {float(whole[name][i])!r}" for name in names
                     if whole[name][i] != 0 or not name.startswith("start.")]  # fmt: skip
            total.update("\n".join(parts).encode())
            keys[row] = total.hexdigest().encode()
    return keys


def _identity(walk: Structure) -> str:
    """What identifies a structure, apart from fixed parameters: fields, defaults, a custom controller's content."""
    fields = {name: value for name, value in walk.walk_fields().items() if name != "set"}
    return json.dumps([fields | code_identity(walk.setup), walk.setup.defaults()], sort_keys=True)


def _keys_of(sweep: Sweep, table: pa.Table) -> np.ndarray:
    names = labelled(table)
    place = {tuple(each.labels[name] for name in names): at for at, each in enumerate(sweep.structures)}
    labels = zip(*(table.column(name).to_pylist() for name in names), strict=True) if names else [()] * len(table)
    structure = np.array([place[tuple(each)] for each in labels], int)
    numbers = [name for name in columns_of(table, "varied", "randomized") if name not in names]
    return keys_of(sweep.structures, structure, {name: table.column(name).to_numpy() for name in numbers})


# ---
# Which batches are simulated: one per chunk, or one for several chunks whose rows are mostly known.


@dataclasses.dataclass(frozen=True)
class Batch:
    """Rows that are simulated together: the unknown ones of some chunks of one structure."""

    structure: int
    chunks: list[int]

    def parts(self, plan: BatchPlan, result: Simulated) -> Iterator[tuple[int, Simulated]]:
        """The part of the batch's result that belongs to each chunk; time and steps are split by the number of rows."""
        sizes = [len(plan.unknown(k)) for k in self.chunks]
        first = 0
        for k, size in zip(self.chunks, sizes, strict=True):
            here, share = slice(first, first + size), size / sum(sizes)
            metrics = {name: column[here] for name, column in result.metrics.items()}
            steps, seconds = result.steps * share, result.seconds * share
            series = None if result.series is None else result.series.take(here)
            yield k, Simulated(metrics, result.status[here], steps, seconds, series)
            first += size


@dataclasses.dataclass(frozen=True)
class BatchPlan:
    """What is simulated.

    Attributes:
        layout: rows of each chunk of the sweep.
        known: for chunks with a known row: where each row is, (n,) int, -1 for the others.
        batches: in the order of their first chunks.
        worlds: batch size by structure: one shape, so that no engine compiles twice.
    """

    layout: Sequence[np.ndarray]
    known: Mapping[int, np.ndarray]
    batches: list[Batch]
    worlds: Mapping[int, int]

    def unknown(self, chunk: int) -> np.ndarray:
        """The rows of a chunk that are simulated."""
        return self.layout[chunk][self.known[chunk] < 0] if chunk in self.known else self.layout[chunk]

    def found(self, chunk: int) -> np.ndarray:
        """The rows of a chunk that are known."""
        return self.layout[chunk][self.known[chunk] >= 0] if chunk in self.known else self.layout[chunk][:0]


def plan_batches(
    sweep: Sweep, rows: Sample, layout: Sequence[np.ndarray], chunks: Sequence[int], known: KnownRows | None
) -> BatchPlan:
    """The batches for some chunks of a sweep: each chunk is complete when one batch is done.

    Args:
        rows: of the sweep, and `layout` those of each chunk.
        chunks: to be made, in order.
        known: rows that need not be simulated.
    """
    structures, places = rows.structures(), dict[int, np.ndarray]()
    if known is not None and len(known):
        for k in chunks:
            some = rows.take(layout[k])
            found = known.find(sweep, some.structure, some.values)
            if (found >= 0).any():
                places[k] = found
    plan = BatchPlan(layout, places, [], {})
    most: dict[int, int] = {}
    for chunk in layout:
        at = int(structures[chunk[0]])
        most[at] = max(most.get(at, 0), len(chunk))
    filled, worlds = 0, dict[int, int]()
    for k in chunks:
        count, at = len(plan.unknown(k)), int(structures[layout[k][0]])
        if not count:
            continue
        last = plan.batches[-1] if plan.batches else None
        if last is not None and last.structure == at and filled + count <= most[at] and k in places:
            last.chunks.append(k)
            filled += count
        else:
            plan.batches.append(Batch(at, [k]))
            filled = count
        worlds[at] = max(worlds.get(at, 0), filled) if places else most[at]
    return dataclasses.replace(plan, worlds=worlds)
