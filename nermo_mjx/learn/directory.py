"""A training's directory: what it is for, and the files that are made from its checkpoints.

DIR/training.yaml      the resolved training
DIR/metrics.py         custom metrics, if the evaluation has some: a copy
DIR/run.json           which code made it; versions, machine and command of each session that worked on it
DIR/checkpoints/       Orbax checkpoints, the latest few: the full learning state, and the history up to it
DIR/policy.npz         the policy of the latest checkpoint, or of the best one (`validation`): a controller
DIR/validation.parquet the success of the policy of each checkpoint, where the best one is chosen
DIR/history.parquet    one row per iteration
DIR/evaluation.parquet one row per walk on a body and start that the policy has not seen, and the same without it
DIR/summary.json       success, return and speed
DIR/plots/             figures
DIR/*.aside-N          files that did not match: nothing is deleted
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

from nermo_mjx.learn.experience import Learned
from nermo_mjx.learn.history import FILE, Curves, history_table
from nermo_mjx.learn.spec import Training
from nermo_mjx.runs import OtherCode, RunDirectory, stamp
from nermo_mjx.runs.checkpoints import Checkpoints
from nermo_mjx.runs.files import WrongDirectory, clear_errors, parquet_bytes
from nermo_mjx.specs.controllers import with_code_copied
from nermo_mjx.specs.described import write_described
from nermo_mjx.specs.reading import changes

POLICY_FILE: Final = "policy.npz"
EVALUATION: Final = "evaluation.parquet"
SUMMARY: Final = "summary.json"
SPEC: Final = "training.yaml"


class Directory:
    """A directory held by this process for one training; use it in a `with` statement.

    Args:
        out: the directory; made if it does not exist.
        training: what the directory is for.
        engine: name of the engine that runs.
        warn: called with a message about each thing that is moved aside.

    Raises:
        DirectoryError: the directory holds another training, is in use, or cannot be written.
    """

    def __init__(
        self, out: str | os.PathLike[str], training: Training, engine: str, warn: Callable[[str], None]
    ) -> None:
        self.out, self.training, self.engine, self._warn = Path(out), training, engine, warn
        self.held = RunDirectory(out, "training")
        self._checkpoints = Checkpoints(self.held, "training")
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Directory:
        with contextlib.ExitStack() as stack, clear_errors(self.out):
            stack.enter_context(self.held)
            stack.enter_context(self._checkpoints)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def restore(self, beginning: Learned, *, accept: bool) -> tuple[Learned, Curves]:
        """The state of the training, and its history so far.

        Args:
            beginning: of a training that has not begun.
            accept: take what was computed with other defaults.

        Raises:
            DirectoryError: the checkpoints are those of another training, or cannot be read.
        """

        def like(about: Mapping[str, Any]) -> dict[str, Any]:
            self._check_ours(about, accept)
            return {"learned": beginning, "history": np.empty(about["rows"])}

        found = self._checkpoints.restore(like, self._warn)
        if found is None:
            return beginning, Curves()
        parts, about = found
        codes = tuple((int(first), str(code)) for first, code in about["codes"])
        return parts["learned"], Curves(tuple(about["names"]), parts["history"], codes)

    def take_code(self, curves: Curves, *, accept: bool) -> str:
        """Note which code is about to learn; its short name.

        Raises:
            OtherCode: another code made the history, and `accept` is not given.
        """
        made_by = stamp(self.training.setup.load().fingerprint, self.engine, more=("learn",))
        self.held.take_code(made_by, holds_rows=len(curves) > 0, accept=accept)
        return made_by.id

    def claim(self) -> None:
        """Claim the directory for this training; a user's own files in the way are moved aside."""
        folder = self.out.resolve()
        setup = with_code_copied(self.training.setup, folder, self.held.write)
        self.training = dataclasses.replace(self.training, setup=setup)
        write_described(self.held, SPEC, self.training, Training.from_file, self._warn)

    def keep(self, learned: Learned, curves: Curves) -> None:
        """Store what was learned, and its history."""
        about = {
            "names": list(curves.names),
            "rows": list(curves.rows.shape),
            "codes": curves.codes,
            "identity": self.training.identity(),
        }
        with clear_errors(self.out):
            self._checkpoints.save(int(learned.iteration), {"learned": learned, "history": curves.rows}, about)

    def publish(self, curves: Curves, units: Mapping[str, str], policy: bytes | None) -> None:
        """Make history.parquet and policy.npz of the latest checkpoint."""
        self.held.write(FILE, parquet_bytes(history_table(curves, units, self.training.digest())))
        if policy is not None:
            self.held.write(POLICY_FILE, policy)

    def _check_ours(self, about: Mapping[str, Any], accept: bool) -> None:
        here, there = self.training.identity(), about["identity"]
        apart = changes(there["fields"], _plain(here["fields"]))
        if apart:
            raise WrongDirectory(
                f"{self.out} holds another training, with another {', '.join(apart)} (see "
                f"{self.out / SPEC}); choose another directory."
            )
        apart = changes(there["defaults"], _plain(here["defaults"]))
        if apart and not accept:
            raise OtherCode(
                f"{self.out} was made with other defaults: {', '.join(apart)}; choose another directory, or resume "
                "with --accept-new-code, and distinguish the rows by their column code."
            )


def _plain(fields: Any) -> Any:
    """As JSON gives it back."""
    return json.loads(json.dumps(fields))
