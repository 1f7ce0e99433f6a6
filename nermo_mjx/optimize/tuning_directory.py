"""A tuning's directory: what it is for, and the files that are made from its checkpoints.

DIR/tuning.yaml       the resolved tuning
DIR/recording.npz     a copy of its reference recording, if any, so that the directory can be moved
DIR/run.json          which code made it; versions, machine and command of each session that worked on it
DIR/checkpoints/      Orbax checkpoints, the latest few
DIR/history.parquet   one row per iteration and start
DIR/best.json         the best point and what it cost to find
DIR/tuned.yaml        a sweep file with the best point's values
DIR/plots/            figures, and the landscape behind the paths
DIR/video.mp4         start and best side by side
DIR/*.aside-N         files that did not match: nothing is deleted
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from nermo_mjx.optimize.history import FILE, Log, history_table, is_done, why_done
from nermo_mjx.optimize.methods import TuneState, initial_state
from nermo_mjx.optimize.tuning import Tuning, sweep_of
from nermo_mjx.runs import DirectoryError, OtherCode, RunDirectory, engine_of, session, stamp
from nermo_mjx.runs.checkpoints import Checkpoints
from nermo_mjx.runs.files import (
    WrongDirectory,
    clear_errors,
    content_of,
    parquet_bytes,
    parquet_table,
    stored_json,
)
from nermo_mjx.runs.rows import part_files
from nermo_mjx.runs.status import Status, last_command, metadata_of, status_of
from nermo_mjx.runs.text import to_json
from nermo_mjx.specs.controllers import with_code_copied
from nermo_mjx.specs.described import write_described
from nermo_mjx.specs.reading import SpecError, changes

# ---
# What a tuning found: best.json for programs, and tuned.yaml, the tuned gait as a sweep file.


def best_of(tuning: Tuning, log: Log) -> dict[str, Any] | None:
    """The content of best.json: the evaluated point of the lowest objective; None if no robot walked to the end.

    `parameters` and `metrics` by name in SI units and radians; `objective`; `iteration` and `start` that it is from;
    `simulated_seconds` of the whole tuning and `simulated_seconds_to_best`, gradients at their cost in forward runs;
    `iterations` done, whether the tuning is `complete`, and why it `stopped` before its iterations were done, or null.
    """
    value = log.values(tuning)
    if not np.isfinite(value).any():
        return None
    iteration, start = (int(i) for i in np.unravel_index(np.nanargmin(value), value.shape))
    row = log.row(tuning, iteration, start)
    return _point(tuning, log, row) | {
        "iteration": iteration,
        "start": start,
        "simulated_seconds": log.row(tuning, -1, 0)["simulated_seconds"],
        "simulated_seconds_to_best": row["simulated_seconds"],
        "iterations": len(log) - 1,
        "complete": is_done(tuning, log),
        "stopped": why_done(tuning, log),
    }


def start_of(tuning: Tuning, log: Log) -> dict[str, Any]:
    """The given start, as its first evaluation found it: `parameters`, `objective`, `metrics`, and whether `ok`.

    Numbers are not finite where the robot did not walk to the end.
    """
    row = log.row(tuning, 0, 0)
    return _point(tuning, log, row) | {"ok": bool(row["ok"])}


def _point(tuning: Tuning, log: Log, row: Mapping[str, float]) -> dict[str, Any]:
    return {
        "parameters": {name: row[name] for name in tuning.names},
        "objective": row["objective"],
        "metrics": {name: row[name] for name in log.metrics},
    }


def tuned_sweep(tuning: Tuning, best: dict[str, Any], folder: Path | None = None) -> str:
    """The text of tuned.yaml, from the content of best.json; see `sweep_of`."""
    known = tuning.parameters
    # float32 may lie a rounding error outside the allowed range: seven digits are significant.
    values = {
        name: float(np.clip(value, known[name].low, known[name].high)) for name, value in best["parameters"].items()
    }
    values = {name: float(f"{value:.7g}") if math.isfinite(value) else value for name, value in values.items()}
    head = f"Iteration {best['iteration']} of start {best['start']}: objective {best['objective']:.6g}."
    return sweep_of(tuning, head, values, tuning.seed, folder)


RECORDING: Final = "recording.npz"
VIDEO: Final = "video.mp4"
TUNING: Final = "tuning.yaml"
#: What is made from the latest checkpoint.
_MADE: Final = (FILE, "best.json", "tuned.yaml")


class Directory:
    """A directory held by this process for one tuning; use it in a `with` statement.

    A checkpoint for each iteration holds the state and the history so far (item `tuning`), and what they are (`about`:
    the tuning they belong to, precision, names of the metrics, shape of the history, which code made it, checksums).
    The history has no other source: everything else in the directory is made from the checkpoint, so that nothing can
    disagree with it.

    Args:
        out: the directory; made if it does not exist.
        tuning: what the directory is for.
        warn: called with a message about each thing that is moved aside.

    Raises:
        DirectoryError: the directory holds another tuning, is in use, or cannot be written.
    """

    def __init__(
        self, out: str | os.PathLike[str], tuning: Tuning, warn: Callable[[str], None] = lambda _: None
    ) -> None:
        self.out, self.tuning, self._warn = Path(out), tuning, warn
        self._run = RunDirectory(out, "tuning")
        self._checkpoints = Checkpoints(self._run, "tuning")
        self._digest, self._identity = tuning.digest(), tuning.identity()
        self._held = contextlib.ExitStack()

    def __enter__(self) -> Directory:
        with contextlib.ExitStack() as stack, clear_errors(self.out):
            stack.enter_context(self._run)
            # Until an iteration is stored, another tuning may take the directory over.
            if any(path.name.isdecimal() for path in (self.out / "checkpoints").glob("*")):
                try:
                    begun = load_tuning(self.out)
                except SpecError as error:
                    unknown = "checkpoints of an unknown tuning (it has no tuning.yaml)"
                    unread = f"a tuning that cannot be read ({error})" if (self.out / TUNING).exists() else unknown
                    raise WrongDirectory(f"{self.out} holds {unread}; choose another directory.") from None
                if apart := ", ".join(changes(begun.decisive(), self.tuning.decisive())):
                    raise WrongDirectory(
                        f"{self.out} holds another tuning, with another {apart} (see {self.out / TUNING}); choose "
                        "another directory."
                    )
            stack.enter_context(self._checkpoints)
            self._held = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def restore(self, *, accept: bool = False) -> tuple[TuneState, Log | None]:
        """Where the tuning is, and its history so far, if there is one; damaged checkpoints are moved aside.

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

        found = self._checkpoints.restore(shapes, self._warn)
        if found is None:
            return like, None
        parts, about = found
        codes = tuple((int(first), str(code)) for first, code in about["codes"])
        return parts["state"], Log(tuple(about["metrics"]), parts["history"], codes)

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
        difference = ", ".join(changes(there["fields"] | there["defaults"], here["fields"] | here["defaults"]))
        if not accept:
            raise OtherCode(
                f"{self.out} was made with other defaults: {difference}; choose another directory, or resume with "
                "--accept-new-code, and distinguish the rows by their column code."
            )

    def take_code(self, log: Log | None, *, accept: bool = False) -> str:
        """Note which code is about to add to a history; its short name.

        Raises:
            OtherCode: another code made the history, and `accept` is not given.
        """
        made_by = stamp(self.tuning.setup.load().fingerprint, self.tuning.method.engine)
        self._run.take_code(made_by, holds_rows=log is not None, accept=accept)
        return made_by.id

    def claim(self, log: Log | None) -> None:
        """Claim the directory for this tuning; existing files that do not follow from this history are moved aside."""
        shown = content_of(self.out / FILE)
        table = None if shown is None else parquet_table(shown)
        if log is None:
            follows = not any((self.out / name).exists() for name in _MADE)
        else:
            follows = shown is None or (table is not None and table.num_rows <= log.rows[:, :, 0].size)
        if not follows:
            self.set_aside("of another history", *_MADE, TUNING)
        setup = with_code_copied(self.tuning.setup, self.out.resolve(), self._run.write)
        self.tuning = keep_recording(self._run, dataclasses.replace(self.tuning, setup=setup), self._warn)
        write_described(self._run, TUNING, self.tuning, read_stored, self._warn)

    def begin_session(self, begun_at: int) -> None:
        """Record what runs here and from which iteration; a video of an earlier best point is moved aside."""
        self._run.note_session(session(begun_at=begun_at))
        self.set_aside("of another best point", VIDEO)

    def keep(self, state: TuneState, log: Log) -> dict[str, Any] | None:
        """Store a state and its history, and make the other files from it; the content of best.json, if any."""
        about = {
            "digest": self._digest,
            "precision": str(state.u.dtype),
            "metrics": list(log.metrics),
            "rows": list(log.rows.shape),
            "codes": log.codes,
            "identity": self._identity,
        }
        with clear_errors(self.out):
            self._checkpoints.save(int(state.iteration), {"state": state, "history": log.rows}, about)
        return self.publish(log)

    def publish(self, log: Log) -> dict[str, Any] | None:
        """Make history.parquet, best.json and tuned.yaml from the history; the content of best.json, if any."""
        best = best_of(self.tuning, log)
        self.write(FILE, parquet_bytes(history_table(self.tuning, log)))
        if best is not None:
            self.write("best.json", to_json(best))
            self.write("tuned.yaml", tuned_sweep(self.tuning, best, self.out.resolve()).encode())
        return best

    def write(self, name: str, content: bytes) -> None:
        """Replace a file of the directory, atomically and durably."""
        self._run.write(name, content)

    def set_aside(self, what: str, *names: str) -> None:
        """See `RunDirectory.set_aside`."""
        self._run.set_aside(what, names, self._warn)


def read_stored(path: Path) -> Tuning:
    """The tuning of a file in a directory, whose recording need not be there; raises `SpecError`."""
    return Tuning.from_file(path, recorded=False)


def load_tuning(out: str | os.PathLike[str]) -> Tuning:
    """The tuning that a directory was made for; see `read_stored`."""
    return read_stored(Path(out) / TUNING)


def keep_recording(held: RunDirectory, tuning: Tuning, warn: Callable[[str], None] = lambda _: None) -> Tuning:
    """The tuning with its recording in the directory, where it is copied to; another one there is moved aside."""
    folder = held.out.resolve()
    if tuning.recording is None or tuning.recording.parent == folder:
        return tuning
    own = folder / RECORDING
    content = tuning.recording.read_bytes()
    if content_of(own) != content:
        held.set_aside("another recording", [RECORDING], warn)
        held.write(RECORDING, content)
    return dataclasses.replace(tuning, recording=own)


# ---
# How far a tuning's directory is, and a landscape's.


def status(out: Path) -> Status:
    """How many evaluations of its starts the history of a tuning's directory has."""
    notes, rows, done = list[str](), None, 0
    try:
        tuning = Tuning.from_file(out / TUNING)
        rows = (tuning.iterations + 1) * tuning.starts
    except (SpecError, OSError) as error:
        notes.append(f"Its tuning cannot be read: {error}")
    if about := metadata_of(out / FILE, notes, "it is made again of the checkpoints."):
        done = about.num_rows
    best = stored_json(out / "best.json")
    if best and best.get("stopped"):
        rows, notes = done, [*notes, str(best["stopped"])]
    complete = rows is not None and done >= rows and best is not None
    return status_of(
        "evaluations", out, done, rows, complete, command="tune", spec=TUNING, engine=engine_of(out), notes=notes
    )


def landscape_status(out: Path) -> Status:
    """How many points of a landscape a directory holds."""
    notes, table = list[str](), out / "landscape.parquet"
    about = metadata_of(table, notes, "it is made again of the points.")
    complete = about is not None and (out / "landscape.json").exists()
    command = f"nermo-mjx plot {shlex.quote(str(out))}" if complete else last_command(out)
    parts = (metadata_of(path, notes, "its points will be evaluated again.") for path in part_files(out))
    done = sum(part.num_rows for part in parts if part)
    return Status("points", done, about and about.num_rows, complete, command, engine_of(out), notes=tuple(notes))
