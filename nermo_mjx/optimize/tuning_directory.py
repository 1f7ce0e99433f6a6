"""The directory of a tuning: its checkpoints, and the files that are made from them.

DIR/tuning.yaml       the resolved tuning
DIR/recording.npz     a copy of the reference recording, if any, so that the directory can be moved
DIR/checkpoints/      Orbax checkpoints, the latest few, with state and history
DIR/history.parquet   one row per iteration and start
DIR/landscape/        the sweep of the landscape behind the paths; `DIR/landscape/DIGEST` is its directory
DIR/best.json, DIR/tuned.yaml, DIR/plots/   made from the history
DIR/run.json          the codes and sessions that made the directory

The directory also contains copies of the user's code. Files that do not match are renamed DIR/*.aside-N, not deleted.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from nermo_mjx.files import MAX_FILE_BYTES, read_bytes
from nermo_mjx.optimize.directory import BEST, other_spec_error, read_spec, sweep_text
from nermo_mjx.optimize.tuner import TuneState, initial_state
from nermo_mjx.optimize.tuning_history import HISTORY, TuningHistory
from nermo_mjx.optimize.tuning_spec import Tuning
from nermo_mjx.runs import OtherCode, RunDirectory
from nermo_mjx.runs.checkpoints import Checkpoints
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.files import (
    DirectoryError,
    WrongDirectory,
    clear_errors,
    content_of,
    parquet_bytes,
    parquet_table,
    stored_json,
    to_json,
)
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.specs.controllers import with_code_copied
from nermo_mjx.specs.described import write_described
from nermo_mjx.specs.reading import SpecError, changes

TUNING: Final = "tuning.yaml"
TUNING_RECORDING_FILE: Final = "recording.npz"


# ---
# A tuning's directory. The history is stored in the checkpoints only, and all other files are made from the history.


class TuningDirectory:
    """A directory that this process has locked for one tuning; use it in a `with` statement.

    A checkpoint of each iteration contains the state and the history so far (item `tuning`), and their description
    (`about`: identity of the tuning, precision, names of the metrics, shape of the history, its codes, checksums).

    Args:
        out: Path of the directory, which is created if it does not exist.
        tuning: Tuning that the directory contains.
        warn: Function that receives a message about each file that is moved aside.

    Raises:
        DirectoryError: On entry, if the directory contains another tuning, is in use, or cannot be written.
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
            # Another tuning may take over the directory until an iteration is stored.
            if any(path.name.isdecimal() for path in (self.out / "checkpoints").glob("*")):
                begun = read_spec(self.out / TUNING, "tuning", "checkpoints", read_stored)
                if begun and (apart := changes(begun.decisive(), self.tuning.decisive())):
                    raise other_spec_error(self.out / TUNING, "tuning", apart)
            stack.enter_context(self._checkpoints)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def restore(self, *, accept: bool = False) -> tuple[TuneState, TuningHistory]:
        """The latest state of the tuning, and its history so far; damaged checkpoints are moved aside.

        Args:
            accept: Whether to continue checkpoints that were computed with other defaults.

        Raises:
            DirectoryError: A checkpoint cannot be read now, or was computed in another precision, for another tuning, or
                with other defaults; the directory is unchanged.
        """
        like = initial_state(self.tuning)

        def make_template(metadata: Mapping[str, Any]) -> dict[str, Any]:
            if metadata["digest"] != self._digest:
                self._check_identity(metadata["identity"], accept)
            if metadata["precision"] != str(like.u.dtype):
                raise DirectoryError(
                    f"{self._checkpoints.folder} was started in {metadata['precision']}, and JAX now computes in "
                    f"{like.u.dtype}: resume with that precision, or choose another directory."
                )
            return {"state": like, "history": np.empty(metadata["rows"])}

        checkpoint = self._checkpoints.restore(make_template, self.warn)
        if checkpoint is None:
            return like, TuningHistory(self.tuning)
        parts, metadata = checkpoint
        codes = tuple((int(first), str(code)) for first, code in metadata["codes"])
        return parts["state"], TuningHistory(
            self.tuning, tuple(metadata["metrics"]), parts["history"], codes
        )

    def _check_identity(self, former: Mapping[str, Any], accept: bool) -> None:
        """Raise an error about a checkpoint of another tuning, or with other defaults that are not accepted."""
        current = self._identity
        # A field that only one of the two identities contains has its default in the other one.
        shared = [name for name in current["fields"] if name in former["fields"]]
        differences = changes(
            *({name: identity["fields"][name] for name in shared} for identity in (former, current))
        )
        differences += ["recording"] if former["recording"] != current["recording"] else []
        if differences:
            raise WrongDirectory(
                f"{self.out} holds checkpoints of another tuning, with another {', '.join(differences)}; choose another "
                "directory."
            )
        difference = ", ".join(
            changes(former["fields"] | former["defaults"], current["fields"] | current["defaults"])
        )
        if not accept:
            raise OtherCode(
                f"{self.out} was made with other defaults: {difference}; choose another directory, or resume with "
                "--accept-new-code, and distinguish the rows by their column code."
            )

    def claim(self, history: TuningHistory) -> None:
        """Claim the directory for this tuning; files that do not match this history are moved aside."""
        file_names = (HISTORY, BEST, "tuned.yaml")
        content = content_of(self.out / HISTORY)
        table = None if content is None else parquet_table(content)
        if not len(history):
            follows = not any((self.out / name).exists() for name in file_names)
        else:
            follows = content is None or (
                table is not None and table.num_rows <= history.rows[:, :, 0].size
            )
        if not follows:
            self.held.set_aside("of another history", (*file_names, TUNING), self.warn)
        setup = with_code_copied(self.tuning.setup, self.out.resolve(), self.held.write)
        self.tuning = keep_recording(
            self.held, dataclasses.replace(self.tuning, setup=setup), self.warn
        )
        write_described(self.held, TUNING, self.tuning, read_stored, self.warn)

    def keep(self, state: TuneState, history: TuningHistory) -> dict[str, Any] | None:
        """Store a state and its history, write the files of `publish`, and return the content of best.json, if any."""
        metadata = {
            "digest": self._digest,
            "precision": str(state.u.dtype),
            "metrics": list(history.metrics),
            "rows": list(history.rows.shape),
            "codes": history.codes,
            "identity": self._identity,
        }
        with clear_errors(self.out):
            self._checkpoints.save(
                int(state.iteration), {"state": state, "history": history.rows}, metadata
            )
        return self.publish(history)

    def publish(self, history: TuningHistory) -> dict[str, Any] | None:
        """Write history.parquet, best.json and tuned.yaml, and return the content of best.json, if any."""
        best = history.best()
        self.held.write(HISTORY, parquet_bytes(history.table()))
        if best is not None:
            self.held.write(BEST, to_json(best))
            declarations, values = self.tuning.parameters, dict[str, float]()
            for name, value in best["parameters"].items():
                # A float32 may be outside of the allowed range by a rounding error; seven digits are significant.
                inside = float(np.clip(value, declarations[name].low, declarations[name].high))
                values[name] = float(f"{inside:.7g}") if math.isfinite(inside) else inside
            head = f"Iteration {best['iteration']} of start {best['start']}: objective {best['objective']:.6g}."
            sweep = sweep_text(self.tuning, head, values, self.tuning.seed, self.out.resolve())
            self.held.write("tuned.yaml", sweep.encode())
        return best


def read_stored(path: Path) -> Tuning:
    """The tuning of a file in a directory, whose recording may be missing; raises `SpecError`."""
    return Tuning.from_file(path, recorded=False)


def load_tuning(out: str | os.PathLike[str]) -> Tuning:
    """The tuning of a directory; see `read_stored`."""
    return read_stored(Path(out) / TUNING)


def keep_recording(
    directory: RunDirectory, tuning: Tuning, warn: Callable[[str], None] = lambda _: None
) -> Tuning:
    """Copy the recording of a tuning into the directory; another recording is moved aside.

    Returns:
        The tuning with this copy.
    """
    folder = directory.out.resolve()
    if tuning.recording is None or tuning.recording.parent == folder:
        return tuning
    content = read_bytes(tuning.recording, MAX_FILE_BYTES)
    if content_of(folder / TUNING_RECORDING_FILE, MAX_FILE_BYTES) != content:
        directory.set_aside("another recording", [TUNING_RECORDING_FILE], warn)
        directory.write(TUNING_RECORDING_FILE, content)
    return dataclasses.replace(tuning, recording=folder / TUNING_RECORDING_FILE)


def tuning_status(out: Path) -> Status:
    """Status of a tuning's directory: the number of evaluations of its starts."""
    notes, rows, step_count = list[str](), None, 0
    try:
        tuning = Tuning.from_file(out / TUNING)
        rows = (tuning.iterations + 1) * tuning.starts
    except (SpecError, OSError) as error:
        notes.append(f"Its tuning cannot be read: {error}")
    if metadata := metadata_of(out / HISTORY, notes, "it is made again of the checkpoints."):
        step_count = metadata.num_rows
    best = stored_json(out / BEST)
    if best and best.get("stopped"):
        rows, notes = step_count, [*notes, str(best["stopped"])]
    complete = rows is not None and step_count >= rows and best is not None
    return status_of(
        "evaluations",
        out,
        step_count,
        rows,
        complete,
        command="tune",
        spec=TUNING,
        engine=engine_of(out),
        notes=notes,
    )
