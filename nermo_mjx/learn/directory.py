"""The directory of a training: its specification, its history, and the files that are made from its checkpoints.

DIR/training.yaml      the resolved training
DIR/metrics.py         a copy of the custom metrics, if the evaluation has any
DIR/FILE.py            a copy of the custom code of the task, if it has any
DIR/run.json           code that made the directory; versions, machine and command of each session that worked on it
DIR/checkpoints/       Orbax checkpoints, the latest few: the full learning state, and the history up to it
DIR/policy.npz         the policy of the latest checkpoint, or of the best one (`validation`): a controller
DIR/validation.parquet the success of the policy of each checkpoint, if the best one is chosen
DIR/history.parquet    one row per iteration; in each column's metadata its unit, meaning and role
DIR/evaluation.parquet one row per walk on a body and start that are not part of the training, with and without the policy
DIR/summary.json       success, return and speed
DIR/plots/             figures
DIR/videos/            a walk of the policy at each checkpoint, with `video`
DIR/*.aside-N          files that did not match; they are moved, not deleted

Roles in the history: `index` (iteration, steps), `return` (of the episodes that ended), `term` (of the reward),
`learning`, `effort` (CPU and wall time, which differ from run to run), `code`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.files import FileError, json_of
from nermo_mjx.learn.experience import LearningState
from nermo_mjx.learn.spec import Training
from nermo_mjx.runs import OtherCode, RunDirectory, engine_of, stamp
from nermo_mjx.runs.checkpoints import Checkpoints
from nermo_mjx.runs.files import (
    WrongDirectory,
    clear_errors,
    content_of,
    parquet_bytes,
    stored_table,
)
from nermo_mjx.runs.rows import Columns
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.specs.described import write_described
from nermo_mjx.specs.reading import SpecError, changes

POLICY_FILE: Final = "policy.npz"
EVALUATION_FILE: Final = "evaluation.parquet"
SUMMARY_FILE: Final = "summary.json"
SPEC_FILE: Final = "training.yaml"
HISTORY_FILE: Final = "history.parquet"
#: Role, unit and meaning of the history's columns that every training may have.
_HISTORY_COLUMNS: Final[dict[str, tuple[str, str, str]]] = {
    "steps": ("index", "1", "control steps of all worlds so far"),
    "episodes": (
        "return",
        "1",
        "episodes that ended in the iteration, but for the first of each world, cut short",
    ),
    "return": ("return", "1", "mean sum of rewards of these episodes; NaN where none ended"),
    "length": ("return", "1", "mean control steps of these episodes"),
    "lasted": ("return", "1", "share of these episodes that their time limit ended, and no fall"),
    "reward": ("return", "1", "mean reward of a control step"),
    "kl": ("learning", "nat", "change of the policy in the last pass over the iteration's steps"),
    "value_loss": ("learning", "1", "half the mean squared error of the critic"),
    "explained": ("learning", "1", "share of the returns' variance that the critic explains"),
    "rate": ("learning", "1", "learning rate of the actor"),
    "std": ("learning", "1", "mean standard deviation of the actions"),
    "environment_cpu": (
        "effort",
        "s",
        "CPU time of the control steps; NaN where they and the rest are one program",
    ),
    "learner_cpu": ("effort", "s", "CPU time of the rest of the iteration"),
    "wall_seconds": ("effort", "s", "wall time of the iteration"),
}


@dataclasses.dataclass(frozen=True)
class Curves:
    """The history of a training in memory.

    Attributes:
        names: Names of the columns.
        rows: Values, float64 (iterations, columns).
        codes: Pairs of an iteration and the code that made the iterations from this one on.
    """

    names: tuple[str, ...] = ()
    rows: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 0)))
    codes: tuple[tuple[int, str], ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    def extend(self, numbers: Mapping[str, float], code: str) -> Curves:
        """The history with one more iteration, which this code made."""
        names = self.names or tuple(numbers)
        row = np.array([[float(numbers[name]) for name in names]])
        earlier = tuple(entry for entry in self.codes if entry[0] < len(self))
        codes = earlier if earlier and earlier[-1][1] == code else (*earlier, (len(self), code))
        return Curves(names, row if not len(self) else np.concatenate([self.rows, row]), codes)

    def column(self, name: str) -> np.ndarray:
        """Values of a column (iterations,)."""
        return self.rows[:, self.names.index(name)]

    def last(self, name: str, episodes: int = 100) -> float:
        """Mean of a column over the last episodes, at least this many if available; NaN if no episode ended."""
        count = self.column("episodes")
        total = np.cumsum(count[::-1])[::-1]
        recent = (count > 0) & (total - count < episodes)
        return (
            float(np.average(self.column(name)[recent], weights=count[recent]))
            if recent.any()
            else float("nan")
        )

    def table(self, units: Mapping[str, str], digest: str) -> pa.Table:
        """The history as a table; `units` are the units of the reward's terms by name, `digest` identifies the training."""
        table, iterations = Columns(), len(self)
        table.add("iteration", np.arange(iterations), "index", "1", "iterations done before")
        for name, values in zip(self.names, self.rows.T, strict=True):
            term = name.removeprefix("term.")
            reward_column = (
                "term",
                units.get(term, "1"),
                f"mean of the reward's term {term} a step",
            )
            cells = values.astype(int) if name in ("steps", "episodes") else values
            table.add(name, cells, *_HISTORY_COLUMNS.get(name, reward_column))
        lasted = np.diff([*(first for first, _ in self.codes), iterations])
        code = np.repeat(np.array([code for _, code in self.codes], object), lasted)
        table.add("code", code, "code", "1", "which code made the row, by its name in run.json")
        return table.table({"training": digest})


def read_curves(out: str | os.PathLike[str]) -> pa.Table:
    """The history of a training's directory up to the latest checkpoint, one row per iteration.

    Raises:
        DirectoryError: The history is missing, damaged, or cannot be read now.
    """
    return stored_table(Path(out) / HISTORY_FILE, "history of a training")


class TrainingDirectory:
    """A directory held by this process for one training; use it in a `with` statement.

    Args:
        out: Path of the directory, which is created if it does not exist.
        training: Training that the directory contains.
        engine: Name of the engine that runs.
        warn: Function that receives a message about each file that is moved aside.

    Raises:
        DirectoryError: The directory contains another training, is in use, or cannot be written.
    """

    def __init__(
        self,
        out: str | os.PathLike[str],
        training: Training,
        engine: str,
        warn: Callable[[str], None],
    ) -> None:
        self.out, self.training, self.engine, self._warn = Path(out), training, engine, warn
        self.run_directory = RunDirectory(out, "training")
        self._checkpoints = Checkpoints(self.run_directory, "training")
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> TrainingDirectory:
        with contextlib.ExitStack() as stack, clear_errors(self.out):
            stack.enter_context(self.run_directory)
            stack.enter_context(self._checkpoints)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def restore(self, beginning: LearningState, *, accept: bool) -> tuple[LearningState, Curves]:
        """The latest learning state of the training, and its history so far.

        Args:
            beginning: Learning state of a training without iterations, which is returned if there is no checkpoint.
            accept: Whether to continue results that were computed with other defaults.

        Raises:
            DirectoryError: The checkpoints belong to another training, or cannot be read.
        """

        def make_template(metadata: Mapping[str, Any]) -> dict[str, Any]:
            current, former = json.loads(json.dumps(self.training.identity())), metadata["identity"]
            if differences := changes(former["fields"], current["fields"]):
                raise WrongDirectory(
                    f"{self.out} holds another training, with another {', '.join(differences)} (see "
                    f"{self.out / SPEC_FILE}); choose another directory."
                )
            if (differences := changes(former["defaults"], current["defaults"])) and not accept:
                raise OtherCode(
                    f"{self.out} was made with other defaults: {', '.join(differences)}; choose another directory, or resume "
                    "with --accept-new-code, and distinguish the rows by their column code."
                )
            return {"learned": beginning, "history": np.empty(metadata["rows"])}

        checkpoint = self._checkpoints.restore(make_template, self._warn)
        if checkpoint is None:
            return beginning, Curves()
        parts, metadata = checkpoint
        codes = tuple((int(first), str(code)) for first, code in metadata["codes"])
        return parts["learned"], Curves(tuple(metadata["names"]), parts["history"], codes)

    def take_code(self, curves: Curves, *, accept: bool) -> str:
        """Note the code of this session, and return its short name.

        Raises:
            OtherCode: Other code made the history, and `accept` is false.
        """
        made_by = stamp(self.training.setup.load().fingerprint, self.engine, subpackages=("learn",))
        self.run_directory.take_code(made_by, holds_rows=len(curves) > 0, accept=accept)
        return made_by.id

    def claim(self) -> None:
        """Write the files that identify the training; other files of the same names are moved aside."""
        self.training = self.training.with_code_copied(self.out.resolve(), self.run_directory.write)
        write_described(
            self.run_directory, SPEC_FILE, self.training, Training.from_file, self._warn
        )

    def keep(self, learned: LearningState, curves: Curves) -> None:
        """Store the learning state and the history as a checkpoint."""
        metadata = {
            "names": list(curves.names),
            "rows": list(curves.rows.shape),
            "codes": curves.codes,
            "identity": self.training.identity(),
        }
        with clear_errors(self.out):
            self._checkpoints.save(
                int(learned.iteration), {"learned": learned, "history": curves.rows}, metadata
            )

    def publish(self, curves: Curves, units: Mapping[str, str], policy: bytes | None) -> None:
        """Write history.parquet and policy.npz of the latest checkpoint."""
        self.run_directory.write(
            HISTORY_FILE, parquet_bytes(curves.table(units, self.training.digest()))
        )
        if policy is not None:
            self.run_directory.write(POLICY_FILE, policy)


def training_status(out: Path) -> Status:
    """Status of a training's directory: the number of iterations in its history."""
    notes, rows, step_count, until = list[str](), None, 0, None
    try:
        training = Training.from_file(out / SPEC_FILE)
        rows, until = training.iterations, training.until
    except (SpecError, OSError) as error:
        notes.append(f"Its training cannot be read: {error}")
    if metadata := metadata_of(out / HISTORY_FILE, notes, "it is made again of the checkpoints."):
        step_count = metadata.num_rows
        if until is not None:  # a training that ended early has no further iterations
            with contextlib.suppress(FileError):
                summary = json_of(
                    content_of(out / SUMMARY_FILE) or b"{}", dict[str, Any], out / SUMMARY_FILE
                )
                rows = step_count if summary.get("complete") is True else rows
    complete = rows is not None and step_count >= rows and (out / SUMMARY_FILE).exists()
    return status_of(
        "iterations",
        out,
        step_count,
        rows,
        complete,
        command="train",
        spec=SPEC_FILE,
        engine=engine_of(out),
        notes=notes,
    )
