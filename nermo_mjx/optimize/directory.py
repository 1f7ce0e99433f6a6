"""Directories of tunings and searches: what they are for, what is stored in them, and what is made from it.

A tuning:
DIR/tuning.yaml       the resolved tuning
DIR/recording.npz     a copy of its reference recording, if any, so that the directory can be moved
DIR/checkpoints/      Orbax checkpoints, the latest few, with state and history
DIR/history.parquet   one row per iteration and start
DIR/results/          the landscape behind the paths, see `nermo_mjx.runs.rows`; that of another best in DIR/former/
DIR/best.json, DIR/tuned.yaml, DIR/plots/   made from the history

A search:
DIR/search.yaml       the resolved search, and the size of its batches
DIR/results/          the rows, a part for each batch, see `nermo_mjx.runs.rows`
DIR/results.aside/    parts that were damaged, or hold other points, when they are run again
DIR/best.json, DIR/best.yaml, DIR/atlas.parquet, DIR/recordings/, DIR/plots/   made from the rows

Both have DIR/run.json, with the codes and sessions that made it, copies of the user's code, and DIR/*.aside-N,
files that did not match: nothing is deleted.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
import pyarrow as pa

from nermo_mjx.files import MAX_FILE_BYTES, read_bytes
from nermo_mjx.optimize.methods import (
    Iterate,
    Scores,
    TuneState,
    cells_of,
    elites_of,
    initial_state,
    made_by,
    scores_of,
)
from nermo_mjx.optimize.spec import Search, Tuning, sweep_of
from nermo_mjx.robot.quantity import of_type
from nermo_mjx.runs import OtherCode, RunDirectory
from nermo_mjx.runs.checkpoints import Checkpoints
from nermo_mjx.runs.code import CodeStamp
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.files import (
    DirectoryError,
    WrongDirectory,
    clear_errors,
    content_of,
    parquet_bytes,
    parquet_table,
    stored_json,
    stored_table,
    to_json,
)
from nermo_mjx.runs.rows import RESULTS, Runs, opened_part, part_files
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.specs.controllers import with_code_copied
from nermo_mjx.specs.described import write_described
from nermo_mjx.specs.reading import SpecError, changes
from nermo_mjx.sweep.replay import SweepRow, recording_file
from nermo_mjx.sweep.simulating import Simulated, SweepSimulator
from nermo_mjx.sweep.spec import Rows
from nermo_mjx.sweep.store import keys_of_rows
from nermo_mjx.sweep.table import (
    RECORDINGS,
    Columns,
    Results,
    chunk_table,
    columns_of,
    meta,
    read_table,
)

TUNING: Final = "tuning.yaml"
SEARCH: Final = "search.yaml"
HISTORY: Final = "history.parquet"
RECORDING: Final = "recording.npz"
BEST: Final = "best.json"
ATLAS: Final = "atlas.parquet"
S = TypeVar("S", Tuning, Search)


def _begun(path: Path, kind: str, holds: str, read: Callable[[Path], S]) -> S | None:
    """What a directory was begun for, as its file says; None if there is no file.

    Args:
        holds: what it holds that belongs to an unknown job where there is no file; empty: nothing.

    Raises:
        WrongDirectory: the file cannot be read, or is missing.
    """
    try:
        if path.exists():
            return read(path)
    except SpecError as error:
        unread = (
            f"{path.parent} holds a {kind} that cannot be read ({error}); choose another directory."
        )
        raise WrongDirectory(unread) from None
    if holds:
        raise WrongDirectory(
            f"{path.parent} holds {holds} of an unknown {kind} (it has no {path.name}); choose another directory."
        )
    return None


def _another(path: Path, kind: str, apart: Sequence[str]) -> WrongDirectory:
    """The error about a directory that was begun for another job, and in what that differs."""
    return WrongDirectory(
        f"{path.parent} holds another {kind}, with another {', '.join(apart[:3])}; choose another directory, or "
        f"resume with {path}."
    )


# ---
# The history of a tuning: one row per iteration and start; in each column's metadata its unit, meaning and role.
#
# Roles: `index` (iteration, start), `objective`, `parameter`, `gradient`, `metric`, `status` (ok), `effort`
# (simulated_seconds, wall_seconds), `code`. A resumed tuning has the same history as an uninterrupted one, except for
# `wall_seconds`.


#: Fraction of the total gain that counts as nothing.
NOTHING: Final = 0.01


class HistoryColumn(NamedTuple):
    """One column of the history."""

    name: str
    role: str
    unit: str
    description: str


@dataclasses.dataclass(frozen=True)
class TuningHistory:
    """The history of a tuning so far.

    Attributes:
        tuning: that it is of.
        metrics: names of the metrics in it.
        rows: float64 (iterations, starts, columns), the columns as `history_columns` lists them.
        codes: which code made the iterations, by first iteration; "" is unknown code.
    """

    tuning: Tuning
    metrics: tuple[str, ...] = ()
    rows: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 0, 0)))
    codes: tuple[tuple[int, str], ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    def column(self, name: str) -> np.ndarray:
        """A column (iterations, starts)."""
        names = [column.name for column in history_columns(self.tuning, self.metrics)]
        return self.rows[:, :, names.index(name)]

    def extended(self, found: Iterate, wall_seconds: float, code: str) -> TuningHistory:
        """The history with one more iteration, its duration and its code."""
        tuning, known = self.tuning, [*(self.tuning.metrics | self.tuning.objective_metrics)]
        metrics = self.metrics or tuple(sorted(found.metrics, key=known.index))
        effort = {"simulated_seconds": found.simulated_seconds, "wall_seconds": wall_seconds}
        numbers: dict[str, np.ndarray] = {"objective": found.value, "ok": found.ok}
        for name, spent in effort.items():
            before = self.column(name)[-1, 0] if len(self) else 0.0
            numbers[name] = np.full(len(found.value), before + spent)
        for i, name in enumerate(tuning.names):
            numbers[name], numbers[f"gradient.{name}"] = found.points[:, i], found.gradient[:, i]
        numbers |= found.metrics
        row = np.stack(
            [np.asarray(numbers[c.name], float) for c in history_columns(tuning, metrics)], axis=-1
        )[None]
        codes = (
            self.codes
            if self.codes and self.codes[-1][1] == code
            else (*self.codes, (len(self), code))
        )
        rows = np.concatenate([self.rows, row]) if len(self) else row
        return TuningHistory(tuning, metrics, rows, codes)

    def table(self) -> pa.Table:
        """The history as a table: iterations in order, the starts of each side by side."""
        iterations, starts, _ = self.rows.shape
        table = Columns()
        table.add(
            "iteration",
            np.repeat(np.arange(iterations), starts),
            "index",
            "1",
            "steps taken before",
        )
        table.add(
            "start",
            np.tile(np.arange(starts), iterations),
            "index",
            "1",
            "which start; 0 is the given one",
        )
        types = {"ok": bool, "discarded": int}
        for i, (name, *about) in enumerate(history_columns(self.tuning, self.metrics)):
            table.add(name, self.rows[:, :, i].ravel().astype(types.get(name, float)), *about)
        lasted = np.diff([*(first for first, _ in self.codes), iterations])
        codes = np.repeat(np.array([code for _, code in self.codes], object), lasted * starts)
        table.add(
            "code",
            codes,
            "code",
            "1",
            "which code made the row, by its name in run.json; empty: not known",
        )
        return table.table({"tuning": self.tuning.digest()})

    def point(self, iteration: int, start: int) -> dict[str, Any]:
        """An evaluated point: `parameters`, `objective` and `metrics`; not finite where the robot did not walk."""
        at = {
            name: float(self.column(name)[iteration, start])
            for name in (*self.tuning.names, *self.metrics)
        }
        return {
            "parameters": {name: at[name] for name in self.tuning.names},
            "objective": float(self.column("objective")[iteration, start]),
            "metrics": {name: at[name] for name in self.metrics},
        }

    def start(self) -> dict[str, Any]:
        """The given start, as its first evaluation found it: see `point`, and whether it is `ok`."""
        return self.point(0, 0) | {"ok": bool(self.column("ok")[0, 0])}

    def best(self) -> dict[str, Any] | None:
        """The content of best.json: the evaluated point of the lowest objective; None if no robot walked to the end.

        `parameters` and `metrics` by name in SI units and radians; `objective`; `iteration` and `start` that it is
        from; `simulated_seconds` of the whole tuning and `simulated_seconds_to_best`, gradients at their cost in
        forward runs; `iterations` done, whether the tuning is `complete`, and why it `stopped` before its iterations
        were done, or null.
        """
        value = self.column("objective")
        if not np.isfinite(value).any():
            return None
        iteration, start = (int(i) for i in np.unravel_index(np.nanargmin(value), value.shape))
        simulated = self.column("simulated_seconds")[:, start].tolist()
        stopped = None
        if len(self) <= self.tuning.iterations and self.stalled:
            stopped = (
                f"It stopped after {len(self) - 1} of {self.tuning.iterations} iterations: the last "
                f"{self.tuning.patience} gained less than {NOTHING:.0%} of the total gain; a longer patience continues."
            )
        return self.point(iteration, start) | {
            "iteration": iteration,
            "start": start,
            "simulated_seconds": simulated[-1],
            "simulated_seconds_to_best": simulated[iteration],
            "iterations": len(self) - 1,
            "complete": self.done,
            "stopped": stopped,
        }

    @property
    def done(self) -> bool:
        """Whether the iterations are done, or the last of them gained almost nothing."""
        return len(self) > self.tuning.iterations or self.stalled

    @property
    def stalled(self) -> bool:
        """Whether the last `patience` iterations gained almost nothing, at each start.

        What counts is the lowest objective of each start so far. The total gain is from the first iteration with a
        completed walk to the best of all.
        """
        patience = self.tuning.patience
        if len(self) <= patience:
            return False
        value = self.column("objective")
        value = np.where(np.isfinite(value), value, np.inf)
        lowest = np.minimum.accumulate(value)
        walked = np.asarray(np.isfinite(lowest).any(axis=1))
        if not walked[-1 - patience]:
            return False
        gained = lowest[int(walked.argmax())].min() - lowest[-1].min()
        before, now = lowest[-1 - patience], lowest[-1]
        lately = np.where(np.isfinite(now), before - np.where(np.isfinite(now), now, 0.0), 0.0)
        return bool((lately <= NOTHING * gained).all())


def history_columns(tuning: Tuning, metrics: Sequence[str]) -> list[HistoryColumn]:
    """The columns of a tuning's history, but for the index."""
    parameters = tuning.parameters
    value = "value that is minimized; NaN where the robot did not walk to the end"
    found = [HistoryColumn("objective", "objective", "1", value)]
    found += [
        HistoryColumn(name, "parameter", parameters[name].unit, parameters[name].doc)
        for name in tuning.names
    ]
    for name in tuning.names:
        unit = "1" if parameters[name].unit == "1" else f"1/({parameters[name].unit})"
        found.append(HistoryColumn(f"gradient.{name}", "gradient", unit, f"d objective / d {name}"))
    known = tuning.metrics | tuning.objective_metrics
    found += [HistoryColumn(name, "metric", known[name].unit, known[name].doc) for name in metrics]
    return [
        *found,
        HistoryColumn("ok", "status", "1", "whether the robot walked to the end"),
        HistoryColumn(
            "simulated_seconds",
            "effort",
            "s",
            "simulated by all starts so far, gradients at their cost",
        ),
        HistoryColumn(
            "wall_seconds",
            "effort",
            "s",
            "wall time so far, over all sessions; never twice the same",
        ),
    ]


def read_history(out: str | os.PathLike[str]) -> pa.Table:
    """The history of a tuning's directory so far.

    Raises:
        DirectoryError: there is none, it is damaged, or cannot be read now.
    """
    folder = of_type("out", out, (str, os.PathLike), "the path of a directory")
    return stored_table(Path(folder) / HISTORY, "history of a tuning")


# ---
# A tuning's directory. The history has no other source than the checkpoints, and everything else is made from it.


class TuningDirectory:
    """A directory held by this process for one tuning; use it in a `with` statement.

    A checkpoint for each iteration holds the state and the history so far (item `tuning`), and what they are (`about`:
    the tuning they belong to, precision, names of the metrics, shape of the history, which code made it, checksums).

    Args:
        out: the directory; made if it does not exist.
        tuning: what the directory is for.
        warn: called with a message about each thing that is moved aside.

    Raises:
        DirectoryError: on entry: the directory holds another tuning, is in use, or cannot be written.
    """

    def __init__(
        self,
        out: str | os.PathLike[str],
        tuning: Tuning,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.out, self.tuning, self.warn = Path(out), tuning, warn
        self.held = RunDirectory(out, "tuning")
        self._checkpoints = Checkpoints(self.held, "tuning")
        self._digest, self._identity = tuning.digest(), tuning.identity()
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> TuningDirectory:
        with contextlib.ExitStack() as stack, clear_errors(self.out):
            stack.enter_context(self.held)
            # Until an iteration is stored, another tuning may take the directory over.
            if any(path.name.isdecimal() for path in (self.out / "checkpoints").glob("*")):
                begun = _begun(self.out / TUNING, "tuning", "checkpoints", read_stored)
                if begun and (apart := changes(begun.decisive(), self.tuning.decisive())):
                    raise _another(self.out / TUNING, "tuning", apart)
            stack.enter_context(self._checkpoints)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def restore(self, *, accept: bool = False) -> tuple[TuneState, TuningHistory]:
        """Where the tuning is, and its history so far; damaged checkpoints are moved aside.

        Args:
            accept: take checkpoints that were computed with other defaults.

        Raises:
            DirectoryError: one cannot be read now, or was computed in another precision, for another tuning, or with
                other defaults; nothing has been changed.
        """
        like = initial_state(self.tuning)

        def shapes(about: Mapping[str, Any]) -> dict[str, Any]:
            if about["digest"] != self._digest:
                self._refuse(about["identity"], accept)
            if about["precision"] != str(like.u.dtype):
                raise DirectoryError(
                    f"{self._checkpoints.folder} was started in {about['precision']}, and JAX now computes in "
                    f"{like.u.dtype}: resume with that precision, or choose another directory."
                )
            return {"state": like, "history": np.empty(about["rows"])}

        found = self._checkpoints.restore(shapes, self.warn)
        if found is None:
            return like, TuningHistory(self.tuning)
        parts, about = found
        codes = tuple((int(first), str(code)) for first, code in about["codes"])
        return parts["state"], TuningHistory(
            self.tuning, tuple(about["metrics"]), parts["history"], codes
        )

    def _refuse(self, there: Mapping[str, Any], accept: bool) -> None:
        """Refuse a checkpoint of another tuning, or of one with other defaults that are not accepted."""
        here = self._identity
        # A field that only one of the two knows has a default there.
        both = [name for name in here["fields"] if name in there["fields"]]
        apart = changes(*({name: each["fields"][name] for name in both} for each in (there, here)))
        apart += ["recording"] if there["recording"] != here["recording"] else []
        if apart:
            raise WrongDirectory(
                f"{self.out} holds checkpoints of another tuning, with another {', '.join(apart)}; choose another "
                "directory."
            )
        difference = ", ".join(
            changes(there["fields"] | there["defaults"], here["fields"] | here["defaults"])
        )
        if not accept:
            raise OtherCode(
                f"{self.out} was made with other defaults: {difference}; choose another directory, or resume with "
                "--accept-new-code, and distinguish the rows by their column code."
            )

    def claim(self, history: TuningHistory) -> None:
        """Claim the directory for this tuning; existing files that do not follow from this history are moved aside."""
        made = (HISTORY, BEST, "tuned.yaml")
        content = content_of(self.out / HISTORY)
        table = None if content is None else parquet_table(content)
        if not len(history):
            follows = not any((self.out / name).exists() for name in made)
        else:
            follows = content is None or (
                table is not None and table.num_rows <= history.rows[:, :, 0].size
            )
        if not follows:
            self.held.set_aside("of another history", (*made, TUNING), self.warn)
        setup = with_code_copied(self.tuning.setup, self.out.resolve(), self.held.write)
        self.tuning = keep_recording(
            self.held, dataclasses.replace(self.tuning, setup=setup), self.warn
        )
        write_described(self.held, TUNING, self.tuning, read_stored, self.warn)

    def keep(self, state: TuneState, history: TuningHistory) -> dict[str, Any] | None:
        """Store a state and its history, and make the other files from it; the content of best.json, if any."""
        about = {
            "digest": self._digest,
            "precision": str(state.u.dtype),
            "metrics": list(history.metrics),
            "rows": list(history.rows.shape),
            "codes": history.codes,
            "identity": self._identity,
        }
        with clear_errors(self.out):
            self._checkpoints.save(
                int(state.iteration), {"state": state, "history": history.rows}, about
            )
        return self.publish(history)

    def publish(self, history: TuningHistory) -> dict[str, Any] | None:
        """Make history.parquet, best.json and tuned.yaml from the history; the content of best.json, if any."""
        best = history.best()
        self.held.write(HISTORY, parquet_bytes(history.table()))
        if best is not None:
            self.held.write(BEST, to_json(best))
            known, values = self.tuning.parameters, dict[str, float]()
            for name, value in best["parameters"].items():
                # float32 may lie a rounding error outside the allowed range: seven digits are significant.
                inside = float(np.clip(value, known[name].low, known[name].high))
                values[name] = float(f"{inside:.7g}") if math.isfinite(inside) else inside
            head = f"Iteration {best['iteration']} of start {best['start']}: objective {best['objective']:.6g}."
            sweep = sweep_of(self.tuning, head, values, self.tuning.seed, self.out.resolve())
            self.held.write("tuned.yaml", sweep.encode())
        return best


def read_stored(path: Path) -> Tuning:
    """The tuning of a file in a directory, whose recording need not be there; raises `SpecError`."""
    return Tuning.from_file(path, recorded=False)


def load_tuning(out: str | os.PathLike[str]) -> Tuning:
    """The tuning that a directory was made for; see `read_stored`."""
    return read_stored(Path(out) / TUNING)


def keep_recording(
    held: RunDirectory, tuning: Tuning, warn: Callable[[str], None] = lambda _: None
) -> Tuning:
    """The tuning with its recording in the directory, where it is copied to; another one there is moved aside."""
    folder = held.out.resolve()
    if tuning.recording is None or tuning.recording.parent == folder:
        return tuning
    content = read_bytes(tuning.recording, MAX_FILE_BYTES)
    if content_of(folder / RECORDING, MAX_FILE_BYTES) != content:
        held.set_aside("another recording", [RECORDING], warn)
        held.write(RECORDING, content)
    return dataclasses.replace(tuning, recording=folder / RECORDING)


def tuning_status(out: Path) -> Status:
    """How many evaluations of its starts the history of a tuning's directory has."""
    notes, rows, done = list[str](), None, 0
    try:
        tuning = Tuning.from_file(out / TUNING)
        rows = (tuning.iterations + 1) * tuning.starts
    except (SpecError, OSError) as error:
        notes.append(f"Its tuning cannot be read: {error}")
    if about := metadata_of(out / HISTORY, notes, "it is made again of the checkpoints."):
        done = about.num_rows
    best = stored_json(out / BEST)
    if best and best.get("stopped"):
        rows, notes = done, [*notes, str(best["stopped"])]
    complete = rows is not None and done >= rows and best is not None
    return status_of(
        "evaluations",
        out,
        done,
        rows,
        complete,
        command="tune",
        spec=TUNING,
        engine=engine_of(out),
        notes=notes,
    )


# ---
# A search's directory: one part of its rows for each batch, written before the next batch is requested.


#: How far points of a stored batch may be from those that are asked for, as a fraction of the bounds: another machine's
#: eigenvectors differ in their last digits.
APART: Final = 1e-6


class Batches:
    """The batches of one search in a directory that this process holds.

    Attributes:
        search: that they are of, with their size, and with the directory's copies of code.
        runs: what is stored.
    """

    def __init__(
        self,
        held: RunDirectory,
        search: Search,
        size: Callable[[], int],
        warn: Callable[[str], None],
    ) -> None:
        """Make the directory this search's, or refuse.

        Args:
            size: of a batch, if neither the search nor the directory has one.
            warn: called with a message about what is damaged, and is run again.

        Raises:
            DirectoryError: the directory holds another search, or cannot be written.
        """
        self.held, self.out, self._warn = held, held.out, warn
        path, folder = self.out / SEARCH, self.out.resolve()
        begun = _begun(path, "search", "results" if part_files(self.out) else "", Search.from_file)
        sweep = dataclasses.replace(
            search.sweep, setup=with_code_copied(search.setup, folder, held.write)
        )
        batch = search.batch or (begun and begun.batch) or size()
        self.search = search = dataclasses.replace(search, sweep=sweep, batch=batch)
        if begun and begun.digest() != search.digest():
            other_order = ["order of the parameters under vary"]
            raise _another(
                path, "search", changes(begun.decisive(), search.decisive()) or other_order
            )
        if begun is None or begun.to_yaml(folder) != search.to_yaml(
            folder
        ):  # as with more recordings
            held.write(SEARCH, search.to_yaml(folder).encode())
        self.runs = Runs(self.out, search.digest(), warn=warn, held=held)
        self._parts = {}
        for part in self.runs.parts:
            with opened_part(part.path) as file:
                self._parts[int(file.metadata.metadata[b"chunk"])] = part

    def read(self, batch: int, rows: Rows) -> pa.Table | None:
        """The table of a batch, if it is there with these rows (see `APART`); with others it is moved aside.

        Raises:
            DirectoryError: another version of the library asked for its points, or it cannot be read any more.
        """
        if (part := self._parts.get(batch)) is None:
            return None
        with opened_part(part.path) as file:
            table = file.read()
        near = table.column("variant").to_pylist() == rows.variant.tolist()
        for axis in self.search.sweep.axes if near else ():
            room = APART * (axis.numbers[1] - axis.numbers[0])
            stored = table.column(axis.name).to_numpy()
            near = near and np.allclose(stored, rows.values[axis.name], rtol=0.0, atol=room)
        if near:
            return table
        before, now = (
            table.schema.metadata.get(b"optimizer", b"").decode(),
            made_by(self.search.method),
        )
        if before != now:
            raise DirectoryError(
                f"{part.path} holds points that {before} asked for, and {now} asks for others: install {before}, or "
                "choose another directory."
            )
        self.held.move_aside(part.path.relative_to(self.out), f"{RESULTS}.aside")
        self._warn(
            f"batch {batch} of {self.out} holds other points than those that follow from the batches before it; it is "
            f"kept in {RESULTS}.aside, and run again."
        )
        return None

    def write(
        self, batch: int, rows: Rows, first: int, found: Simulated, stamp: CodeStamp
    ) -> pa.Table:
        """Store a batch.

        Args:
            rows: its runs, of which `first` is the first one's place in the table.
            found: at least one result a run.
            stamp: of the code that simulated.
        """
        count = len(rows)
        about = {
            "engine": stamp.engine,
            "code": stamp.id,
            "chunk": batch,
            "steps": found.steps,
            "wall_seconds": found.seconds,
            "search": self.search.digest(),
            "optimizer": made_by(self.search.method),
        }
        metrics = {name: values[:count] for name, values in found.metrics.items()}
        index = first + np.arange(count)
        table = chunk_table(
            self.search.sweep, rows, index, metrics, found.status[:count], stamp.id, about
        )
        about_batch = {
            "unit": "1",
            "description": "batch that the run was part of",
            "role": "index",
        }
        table = table.add_column(
            1, pa.field("batch", pa.int64(), metadata=about_batch), pa.array([batch] * count)
        )
        self._parts[batch] = self.runs.add(keys_of_rows(self.search.sweep, rows), table)
        return table


# ---
# Results of a search, from its table alone: best.json for programs, best.yaml, a sweep file, and an atlas's elites.


@dataclasses.dataclass(frozen=True)
class Evaluations:
    """All points of a search's table, in the order in which they were asked for.

    Attributes:
        search: that made it.
        results: the table, one row per run.
        scores: of the n points.
        batch: which one each was part of, (n,).
    """

    search: Search
    results: Results
    scores: Scores
    batch: np.ndarray

    @classmethod
    def of(cls, search: Search, results: Results | Path) -> Evaluations:
        """Of a table, or a directory's, as far as it goes."""
        if isinstance(results, Path):
            results = Results(part_files(results))
        columns = dict(results.columns(["batch", *search.aim.metrics]))
        batch = columns.pop("batch")[:: search.repeats].astype(int)
        return cls(
            search, results, scores_of(search.aim, search.repeats, columns, results.well), batch
        )

    def means(self, names: list[str], points: np.ndarray) -> dict[str, np.ndarray]:
        """Columns of some points (k,), means over their repeats."""
        repeats = self.search.repeats
        return {
            name: values.reshape(-1, repeats)[points].mean(axis=1)
            for name, values in self.results.columns(names)
        }

    def described(self, points: np.ndarray) -> list[dict[str, Any]]:
        """Row, parameters, objective and metrics of some points (k,)."""
        metrics, parameters = columns_of(self.results, "metric"), list(self.search.names)
        columns = self.means([*parameters, *metrics], points)
        cost = self.scores.cost[points].tolist()
        return [
            {
                "parameters": {name: float(columns[name][i]) for name in parameters},
                "objective": cost[i] if self.search.aim.pareto else cost[i][0],
                "metrics": {name: float(columns[name][i]) for name in metrics},
                "row": point * self.search.repeats,
            }
            for i, point in enumerate(points.tolist())
        ]

    @property
    def simulated_seconds(self) -> float:
        """Of all runs [s]."""
        timing = [name for name in self.search.setup.timing if name in self.results.schema.names]
        seconds = self.search.seconds(dict(self.results.columns(timing)), self.results.rows)
        return float(np.sum(seconds))

    def front(self) -> np.ndarray:
        """Allowed points that no other one beats, in order of the first objective (k,)."""
        allowed = np.flatnonzero(self.scores.allowed)
        places = allowed[nondominated(self.scores.cost[allowed])]
        return places[np.argsort(self.scores.cost[places, 0], kind="stable")]

    def best(self) -> int | None:
        """The best allowed point: of a front the one in its middle, nearest to where all objectives would be best."""
        allowed = np.flatnonzero(self.scores.allowed)
        if not len(allowed):
            return None
        if self.search.aim.measures:  # of those that have a cell
            allowed = elites_of(self.search.aim, self.scores)[1]
        elif self.search.aim.pareto:
            allowed = self.front()
        if not len(allowed):
            return None
        cost = self.scores.cost[allowed]
        span = np.ptp(cost, axis=0)
        apart = (cost - cost.min(axis=0)) / np.where(span > 0, span, 1.0)
        return int(allowed[np.argmin((apart**2).sum(axis=1))])


def nondominated(cost: np.ndarray) -> np.ndarray:
    """Places (k,) of the points (n, m) that no other one beats: as good in all costs and better in one."""
    if not len(cost):
        return np.empty(0, int)
    import moocore

    return np.flatnonzero(moocore.is_nondominated(cost))


def hypervolumes(found: Evaluations) -> tuple[np.ndarray, np.ndarray]:
    """The share of a box that the front beats after each batch, (batches,), and the box's worst corner, (m,).

    The box reaches from the best of each objective in the whole table to its worst in the first batch.
    """
    import moocore

    cost, allowed = found.scores.cost, found.scores.allowed
    known = np.flatnonzero(allowed)
    first = known[found.batch[known] == found.batch[known[0]]]
    worst, best = cost[first].max(axis=0), cost[known].min(axis=0)
    box = np.prod(np.where(worst > best, worst - best, 1.0))
    shares, front = [], np.empty((0, cost.shape[1]))
    for batch in range(found.batch.max() + 1):
        front = np.concatenate([front, cost[(found.batch == batch) & allowed]])
        front = front[nondominated(front)]
        inside = front[(front < worst).all(axis=1)]
        shares.append(float(moocore.hypervolume(inside, ref=worst) / box) if len(inside) else 0.0)
    return np.array(shares), worst


def atlas_progress(found: Evaluations) -> tuple[np.ndarray, np.ndarray]:
    """Filled cells and QD score after each batch, (batches,) each.

    The QD score is the sum over the filled cells of how much better their elite is than the worst point of the first
    batch that has a cell (Pugh et al. 2016); nothing counts less than zero.
    """
    aim, scores = found.search.aim, found.scores
    cell = np.where(scores.allowed, cells_of(aim, scores.measures), -1)
    known = np.flatnonzero(cell >= 0)
    floor = (
        float(scores.quality[known[found.batch[known] == found.batch[known[0]]]].min())
        if len(known)
        else 0.0
    )
    best: dict[int, float] = {}
    filled, total = [], []
    for batch in range(int(found.batch.max()) + 1):
        for place in np.flatnonzero((found.batch == batch) & (cell >= 0)).tolist():
            gain = max(float(scores.quality[place]) - floor, 0.0)
            best[int(cell[place])] = max(best.get(int(cell[place]), 0.0), gain)
        filled.append(len(best))
        total.append(sum(best.values()))
    return np.array(filled), np.array(total)


def publish(batches: Batches, *, complete: bool) -> dict[str, Any]:
    """Make best.json, best.yaml and atlas.parquet from the table; the content of best.json, empty without a best.

    `parameters`, `objective`, `metrics` (SI units and radians, means over the repeats) and first `row` of the best
    point; `evaluations`, `failed` of them (a run fell or diverged), `simulated_seconds`; whether the search is
    `complete`. Of a front `front`, with the same of each point, and `hypervolume`; of an atlas `cells`, `filled` and
    `qd_score`.
    """
    found = Evaluations.of(batches.search, batches.out)
    place = found.best()
    if place is None:
        return {}
    best: dict[str, Any] = found.described(np.array([place]))[0]
    best |= {"evaluations": len(found.scores), "failed": int((~found.scores.ok).sum())}
    best |= {"simulated_seconds": found.simulated_seconds, "complete": complete}
    if batches.search.aim.pareto:
        best |= {
            "front": found.described(found.front()),
            "hypervolume": float(hypervolumes(found)[0][-1]),
        }
    if batches.search.aim.measures:
        filled, total = atlas_progress(found)
        cells = int(np.prod([each.cells for each in batches.search.aim.measures]))
        best |= {"cells": cells, "filled": int(filled[-1]), "qd_score": float(total[-1])}
        batches.held.write(ATLAS, parquet_bytes(atlas_table(found)))
    batches.held.write(BEST, to_json(best))
    head = f"Row {best['row']} of a search: objective {best['objective']}."
    sweep = batches.search.sweep
    best_sweep = sweep_of(sweep, head, best["parameters"], sweep.seed, batches.out.resolve())
    batches.held.write("best.yaml", best_sweep.encode())
    return best


def atlas_table(found: Evaluations) -> pa.Table:
    """One row per filled cell, in order: row of the table, cell, parameters, metrics (means over the repeats).

    The schema's metadata `atlas` is JSON: `objective` with metric and direction, `measures` with metric, range, cells.
    """
    aim, schema = found.search.aim, found.results.schema
    cells, points = elites_of(aim, found.scores)
    table = Columns()
    table.add(
        "row",
        points * found.search.repeats,
        "index",
        "1",
        "first run of the elite, a row of results",
    )
    table.add("cell", cells, "index", "1", "cell of the atlas; the last measure runs fastest")
    for name, values in found.means(
        [*found.search.names, *columns_of(found.results, "metric")], points
    ).items():
        about: dict[str, Any] = meta(schema.field(name))
        table.add(name, values, **about)
    term = aim.objective.terms[0]
    plain = len(aim.objective.terms) == 1 and term.aim != "hold"
    if not plain:
        about = {"unit": "1", "description": "the sum that is minimized"}
        table.add("objective", found.scores.cost[points, 0], "metric", **about)
    metric, direction = (term.metric, term.aim) if plain else ("objective", "minimize")
    measures = [dataclasses.asdict(each) for each in aim.measures]
    atlas = {"objective": {"metric": metric, "direction": direction}, "measures": measures}
    return table.table({"atlas": json.dumps(atlas), "search": found.search.digest()})


# ---
# Rerunning a search's results: the recordings that it keeps, and a row of its table for `replay`.


#: Worlds recorded at once: a walk of ten seconds is 1.5 MB.
_AT_ONCE: Final = 32


def rows_to_record(found: Evaluations, best: int) -> list[int]:
    """First rows of the points to record: the best ones, or evenly along the front or over the cells of an atlas.

    Args:
        best: the best point, which is always among them.
    """
    search, count = found.search, found.search.keep
    if not count:
        return []
    if search.aim.kind == "objective":
        order = np.argsort(
            np.where(found.scores.allowed, found.scores.cost[:, 0], np.inf), kind="stable"
        )
        points = order[: min(count, int(found.scores.allowed.sum()))]
    else:
        points = elites_of(search.aim, found.scores)[1] if search.aim.measures else found.front()
        points = points[np.unique(np.linspace(0, len(points) - 1, count).round().astype(int))]
        if best not in points:
            points[np.abs(found.scores.cost[points, 0] - found.scores.cost[best, 0]).argmin()] = (
                best
            )
    return (np.sort(points) * search.repeats).tolist()


def keep_recordings(batches: Batches, best: dict[str, Any], computer: SweepSimulator) -> list[Path]:
    """Record what `keep` asks for, as DIR/recordings/row-000123.npz; what is there already stays.

    Raises:
        RecordingError, DirectoryError: one cannot be written.
    """
    search, found = batches.search, Evaluations.of(batches.search, batches.out)
    rows = rows_to_record(found, best["row"] // search.repeats)
    files = {row: recording_file(batches.out, row) for row in rows}
    missing = [row for row, path in files.items() if not path.exists()]
    if missing:
        with clear_errors(batches.out):
            (batches.out / RECORDINGS).mkdir(exist_ok=True)
    drawn = columns_of(found.results, "varied", "randomized")
    for first in range(0, len(missing), _AT_ONCE):
        part = missing[first : first + _AT_ONCE]
        values = {name: np.full(len(part), value) for name, value in search.sweep.constants.items()}
        values |= {name: column[part] for name, column in found.results.columns(drawn)}
        result = computer.simulator().run(values, search.run, record=True)
        for world, (row, end) in enumerate(
            zip(part, search.seconds(values, len(part)).tolist(), strict=True)
        ):
            result.recording(world).between(0.0, end).save(files[row])
    return list(files.values())


def find_evaluation(out: str | os.PathLike[str], row: int) -> SweepRow:
    """A row of a search's table, for `replay_row`; nothing is written, so the search may be at work there.

    Raises:
        SpecError: no search is there that can be read, or no such row.
        DirectoryError: it has no results yet.
    """
    out = Path(out)
    search = Search.from_file(out / SEARCH)
    table = read_table(out)
    if not 0 <= row < table.num_rows:
        raise SpecError(
            f"row is {row}: allowed is 0 to {table.num_rows - 1}, as far as the search has come."
        )
    stored = table.slice(row, 1).to_pylist()[0]
    values = {name: np.array([stored[name]]) for name in columns_of(table, "varied", "randomized")}
    index = {name: np.array([stored[name]]) for name in ("variant", "repeat", "seed")}
    line = Rows(**index, values=values, structure=np.zeros(1, int))
    with opened_part(part_files(out)[0]) as file:
        engine = file.schema_arrow.metadata[b"engine"].decode()
    return SweepRow(out, search.sweep, row, line, engine, stored)


# ---
# How far a search's directory is.


def search_status(out: Path) -> Status:
    """How many points of its search a directory holds."""
    notes, search, runs = list[str](), None, 0
    try:
        search = Search.from_file(out / SEARCH)
    except (SpecError, OSError) as error:
        notes.append(f"Its search cannot be read: {error}")
    for path in part_files(out):
        if about := metadata_of(path, notes, "it will be run again."):
            runs += about.num_rows
    done, budget = (
        runs // (1 if search is None else search.repeats),
        None if search is None else search.evaluations,
    )
    reached = False
    try:
        best = stored_json(out / BEST) or {}
        spent = (
            0.0
            if search is None
            else search.reached(best["evaluations"], best["simulated_seconds"])
        )
        reached = bool(best["complete"]) and spent >= 1.0 and best["evaluations"] == done
    except (TypeError, KeyError):
        pass
    return status_of(
        "evaluations",
        out,
        done,
        budget,
        reached,
        command="search",
        spec=SEARCH,
        engine=engine_of(out),
        notes=notes,
    )
