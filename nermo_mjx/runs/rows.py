"""Runs that were made, each found by what it is: a folder of Parquet parts, of which any process may add one.

A run has a key, the hash of all that decides it (`keys_of`). What asks for runs is of no concern here: a job that is
resumed, extended, sharded or merged asks for keys, and has those that are missing simulated.

DIR/results/part-GROUP-DIGEST.parquet   runs, their keys in the column `key`; the name has the digest of the content
DIR/series/part-GROUP-DIGEST.parquet    their time series, if any are kept; the metadata of the runs' part names it
DIR/former/                             results/ and series/ of other jobs, such as a sweep before it was extended
DIR/results.aside/                      parts that were damaged

GROUP is the digest of the job that wrote a part. Columns such as `row` are numbered by that job: the rows of an equal
job are taken as they are, those of any other are found by their keys, and written again under its own numbers.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import OtherCode, RunDirectory, codes_of, remove_leftovers
from nermo_mjx.runs.files import DirectoryError, clear_errors, parquet_bytes, parquet_table, sync_folder

RESULTS, SERIES, FORMER = "results", "series", "former"
#: Tables of parts that are held at once: the runs that are wanted next lie in a few of them.
_HELD: Final = 32
_NAME: Final = re.compile(r"part-([0-9a-f]+)-([0-9a-f]{16})\.parquet")
Warn = Callable[[str], None]


def keys_of(identity: str, values: Mapping[str, np.ndarray], runs: int) -> np.ndarray:
    """The keys of runs, (runs,) of 32 bytes: equal where the identity and all values are.

    >>> keys_of("c", {"a": np.array([0.0, -0.0, 1.0])}, 3)[:2].tolist() == [keys_of("c", {"a": np.zeros(1)}, 1)[0]] * 2
    True

    Args:
        identity: all that decides them alike, as text: structure, length, code or engine where these count.
        values: what else does, name -> (runs,) floats, in any order; a NaN is a value that the run does not have.
    """
    names, keys = sorted(values), np.empty(runs, "S32")
    base = hashlib.blake2b(identity.encode(), digest_size=16)
    columns = [(np.asarray(values[name], float) + 0.0).tolist() for name in names]
    for i in range(runs):
        total = base.copy()
        total.update("\n".join(f"{name} {column[i]!r}" for name, column in zip(names, columns, strict=True)
                               if column[i] == column[i]).encode())  # fmt: skip
        keys[i] = total.hexdigest().encode()
    return keys


@dataclasses.dataclass(frozen=True)
class Part:
    """A part's file, the runs' time series if it has any, and its metadata: engine, steps, wall_seconds, ..."""

    path: Path
    rows: int
    about: Mapping[str, str]

    @property
    def group(self) -> str:
        return self.path.name.split("-")[1]

    @property
    def directory(self) -> Path:
        """The directory of runs that it is in."""
        above = self.path.parent.parent
        return above.parent if above.name == FORMER else above

    @property
    def series(self) -> Path | None:
        name = self.about.get("series")
        return self.path.parent.parent / SERIES / name if name else None

    @property
    def effort(self) -> tuple[float, float]:
        """Physics steps of its runs, and the time they took [s]."""
        return float(self.about.get("steps", 0.0)), float(self.about.get("wall_seconds", 0.0))


class Runs:
    """The runs of a directory held by this process, and of others that are only read.

    Args:
        held: the directory.
        group: digest of the job, see above; hexadecimal.
        also: other directories; a run that is in several is taken from the first, this one before them.
        warn: called with a message about each part that cannot be used.
        series: whether runs without intact time series count as missing.

    Attributes:
        parts: the intact parts of the job itself, by their names.
        others: the intact parts of other jobs, here and in `also`.

    Raises:
        DirectoryError: a folder cannot be read.
    """

    def __init__(
        self, held: RunDirectory, group: str, also: Sequence[Path] = (), warn: Warn | None = None, series: bool = False
    ) -> None:
        self.held, self.group, self._also = held, group, tuple(also)
        self._warn, self._series = warn or (lambda _: None), series
        with clear_errors(held.out):
            (held.out / RESULTS).mkdir(exist_ok=True)
            for folder in (RESULTS, SERIES) if held.shard is None else ():
                remove_leftovers(held.out / folder)
                self._settle(held.out / folder, held.out / FORMER / folder)
        self.survey()

    def _settle(self, here: Path, former: Path) -> None:
        """Keep the job's own parts in a folder, and those of other jobs in the other one."""
        moves = [(path, former) for path in here.glob("part-*.parquet") if path.name.split("-")[1] != self.group]
        moves += [(path, here) for path in former.glob(f"part-{self.group}-*.parquet")]
        for path, folder in moves:
            folder.mkdir(parents=True, exist_ok=True)
            path.rename(folder / path.name)
        for folder in (here, former) if moves else ():
            sync_folder(folder)

    def survey(self) -> None:
        """Read the folders again, every byte of them. A damaged part is moved aside: its runs are missing."""
        parts: list[Part] = []
        for out in (each for whole in (self.held.out, *self._also) for each in (whole, whole / FORMER)):
            with clear_errors(out):
                for path in part_files(out):
                    part, flaw = _inspected(path, self._series)
                    if part is not None:
                        parts.append(part)
                    elif path.parent != self.held.out / RESULTS:
                        self._warn(f"{path} {flaw}; its runs are not used.")
                    elif self.held.move_aside(path.relative_to(out), f"{RESULTS}.aside") is not None:
                        self._warn(f"{path} {flaw}; it is kept in {RESULTS}.aside, and its runs are made again.")
        here = self.held.out / RESULTS
        self.parts = [part for part in parts if part.path.parent == here and part.group == self.group]
        self.others = [part for part in parts if part.path.parent != here or part.group != self.group]
        self.__dict__.pop("_index", None)
        self._table.cache_clear()

    def column(self, name: str) -> np.ndarray:
        """A column of whole numbers of the job's own parts, (runs,), such as `row`."""
        found = [pq.read_table(part.path, columns=[name])[name].to_numpy() for part in self.parts]
        return np.concatenate(found) if found else np.empty(0, np.int64)

    def find(self, keys: np.ndarray) -> np.ndarray:
        """Where runs are, (n,) int; -1 where they have not been made."""
        known = self._index[0]
        if not len(known):
            return np.full(len(keys), -1)
        at = np.minimum(np.searchsorted(known, keys), len(known) - 1)
        return np.where(known[at] == keys, at, -1)

    def take(self, places: np.ndarray) -> pa.Table:
        """Runs as they are stored, in this order; what one part does not know is null.

        Returns:
            The columns of the parts, `key` included; of the metadata `engine` is that of the first run, `steps` and
            `wall_seconds` are the runs' shares of their parts'.
        """
        files, rows = self._index[1][places].T
        steps = seconds = 0.0
        found, order = [], []
        for file in np.unique(files).tolist():
            here, part = np.flatnonzero(files == file), self._all[file]
            steps += part.effort[0] * len(here) / part.rows
            seconds += part.effort[1] * len(here) / part.rows
            found.append(self._table(part.path).take(rows[here]).replace_schema_metadata(None))
            order.append(here)
        table = pa.concat_tables(found, promote_options="default").take(np.argsort(np.concatenate(order)))
        engine = self._all[int(files[0])].about.get("engine", "")
        return table.replace_schema_metadata({"engine": engine, "steps": str(steps), "wall_seconds": str(seconds)})

    def series(self, places: np.ndarray) -> Iterator[pa.Table]:
        """The time series of runs, one after the other, with the numbers `row` of the job that made them."""
        for file, row in self._index[1][places].tolist():
            part = self._all[file]
            assert part.series is not None
            number = self._table(part.path).column("row")[row].as_py()
            yield self._table(part.series).filter(pc.equal(self._table(part.series).column("row"), number))

    def add(self, keys: np.ndarray, table: pa.Table, series: pa.Table | None = None) -> Part:
        """Store runs, atomically and durably: other processes see all of them, with their time series, or none.

        Args:
            keys: (n,) of 32 bytes.
            table: n rows; its metadata tells the engine, the steps and the time they took.
            series: a row for each sample, with a column `row` as the table has.

        Raises:
            DirectoryError: they cannot be written.
        """
        about = dict(table.schema.metadata or {})
        if series is not None:
            about[b"series"] = self._write(SERIES, series).name.encode()
        table = table.append_column(pa.field("key", pa.string(), metadata={"role": "key"}), pa.array(keys.astype(str)))
        path = self._write(RESULTS, table.replace_schema_metadata(about))
        part = Part(path, table.num_rows, {key.decode(): value.decode() for key, value in about.items()})
        self.parts.append(part)
        self.__dict__.pop("_index", None)
        return part

    def take_codes(self, stamps: Sequence[CodeStamp], *, accept: bool, any_model: bool = False) -> None:
        """Record which codes are about to add runs, or refuse; see `RunDirectory.take_code`."""
        holds = any(part.path.is_relative_to(self.held.out) for part in self._all)
        for stamp in stamps:
            self.held.take_code(stamp, holds_rows=holds, accept=accept, any_model=any_model)
            holds = True

    def codes(self, *, accept: bool) -> list[CodeStamp]:
        """Which codes made the runs of other directories, as far as these say.

        Raises:
            OtherCode: one does not, and `accept` is not given.
        """
        found: dict[str, CodeStamp] = {}
        for out in dict.fromkeys(part.directory for part in self.others):
            codes = codes_of(out)
            if not codes and not accept:
                raise OtherCode(f"{out} does not say which code made it: its runs are used with --accept-new-code; "
                                "distinguish them by their column code.")  # fmt: skip
            found |= codes
        return list(found.values())

    def _write(self, folder: str, table: pa.Table) -> Path:
        content = parquet_bytes(table)
        (self.held.out / folder).mkdir(exist_ok=True)
        path = self.held.out / folder / f"part-{self.group}-{_digest(content)}.parquet"
        self.held.write(path.relative_to(self.held.out), content)
        return path

    @property
    def _all(self) -> list[Part]:
        return [*self.parts, *self.others]

    @functools.cached_property
    def _index(self) -> tuple[np.ndarray, np.ndarray]:
        """All keys in order, and of each the part and the row in it, (n, 2)."""
        keys, places = [np.empty(0, "S32")], [np.empty((0, 2), np.int64)]
        for number, part in enumerate(self._all):
            own = pq.read_table(part.path, columns=["key"])["key"].to_numpy(zero_copy_only=False).astype("S32")
            keys.append(own)
            places.append(np.column_stack([np.full(len(own), number), np.arange(len(own))]))
        unique, first = np.unique(np.concatenate(keys), return_index=True)
        return unique, np.concatenate(places)[first]

    @functools.lru_cache(_HELD)  # noqa: B019 - the store lives as long as the job
    def _table(self, path: Path) -> pa.Table:
        table = parquet_table(path)
        if table is None:
            raise DirectoryError(f"{path} cannot be read any more: run the same command again.")
        return table


def part_files(out: Path, group: str = "*", folder: str = RESULTS) -> list[Path]:
    """The files of a directory's parts, of one job or of all, whatever is in them; in the order of their names."""
    return sorted(path for path in out.glob(f"{folder}/part-{group}-*.parquet") if _NAME.fullmatch(path.name))


@contextlib.contextmanager
def opened(path: Path) -> Iterator[pq.ParquetFile]:
    """A part's file, whose pages are checked as they are read; what is wrong with it is a `DirectoryError`."""
    try:
        with pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True) as file:
            yield file
    except (OSError, pa.ArrowException) as error:
        raise DirectoryError(f"{path} cannot be read ({error}): run the same command again.") from None


def _inspected(path: Path, series: bool) -> tuple[Part | None, str]:
    """A part if it is intact to the last bit, else what is wrong with it."""
    flaw = _flaw(path)
    if flaw:
        return None, flaw
    about: Any = pq.read_metadata(path)
    texts = (about.metadata or {}).items()
    words = {key.decode(): value.decode(errors="replace") for key, value in texts if key != b"ARROW:schema"}
    part = Part(path, about.num_rows, words)
    if series and (part.series is None or _flaw(part.series)):
        return None, "has no time series, or damaged ones"
    return part, ""


def _flaw(path: Path) -> str:
    """What is wrong with a file whose name has the digest of its content; empty if nothing is."""
    try:
        found = _NAME.fullmatch(path.name)
        return "" if found is not None and _digest(path.read_bytes()) == found[2] else "is damaged"
    except OSError as error:
        return f"cannot be read ({error.strerror})"


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=8).hexdigest()
