"""A tuning's state on disk: Orbax checkpoints, each with the history up to it, and checked when read."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from nermo_mjx.runs.files import DirectoryError, replace_file
from nermo_mjx.tune.history import Log
from nermo_mjx.tune.state import TuneState

#: Bytes that must be free for a checkpoint to be begun.
ROOM: Final = 1 << 18
#: Checkpoints that are kept; all but the newest are there for the case that it is damaged.
KEPT: Final = 3


class Checkpoints:
    """The checkpoints of one directory, one an iteration; use it in a `with` statement.

    A checkpoint holds the state and the history so far (item `tuning`), and what they are (`about`: precision, names of
    the metrics, shape of the history, a checksum). The history has no other source: whatever else is in the directory
    is made from the checkpoint, so that nothing can disagree with it.

    Args:
        folder: of the checkpoints; made if it does not exist.
        digest: of the tuning they belong to.
    """

    def __init__(self, folder: Path, digest: str) -> None:
        self.folder, self.digest = folder, digest

    def __enter__(self) -> Checkpoints:
        options = ocp.CheckpointManagerOptions(
            max_to_keep=KEPT, enable_async_checkpointing=False, cleanup_tmp_directories=True
        )
        with _quiet():
            self._manager = ocp.CheckpointManager(self.folder.absolute(), options=options)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._manager.close()

    def save(self, state: TuneState, log: Log) -> None:
        """Store a state and the history up to it; whole, or not at all.

        Raises:
            OSError: there is no room for it.
            DirectoryError: it cannot be written for another reason.
        """
        # A full disk is found here, in one exception, and not by Orbax's threads one after the other.
        replace_file(self.folder / ".room", bytes(ROOM))
        (self.folder / ".room").unlink()
        about = {
            "digest": self.digest,
            "precision": str(state.u.dtype),
            "metrics": list(log.metrics),
            "rows": list(log.rows.shape),
            "checksum": _checksum(state, log.rows),
        }
        items = ocp.args.Composite(
            tuning=ocp.args.StandardSave({"state": state, "history": log.rows}),
            about=ocp.args.JsonSave(about),
        )
        with _quiet():
            try:
                self._manager.save(int(state.iteration), args=items, force=True)
            except OSError:
                raise
            except Exception as error:  # a failed write shows as whatever its thread stumbled over
                raise DirectoryError(
                    f"cannot write a checkpoint in {self.folder}: {' '.join(str(error).split())}."
                ) from error

    def restore(self, like: TuneState) -> tuple[TuneState, Log] | None:
        """The newest whole checkpoint, None if there is none. Newer ones that are damaged are removed.

        Args:
            like: a state of the same tuning; its values do not matter.

        Raises:
            DirectoryError: they were computed in another precision.
        """
        with _quiet():
            for step in sorted(self._manager.all_steps(), reverse=True):
                found = self._read(step, like)
                if found is not None:
                    return found
                self._manager.delete(step)
        return None

    def _read(self, step: int, like: TuneState) -> tuple[TuneState, Log] | None:
        try:
            items = ocp.args.Composite(about=ocp.args.JsonRestore())
            about: dict[str, Any] = self._manager.restore(step, args=items)["about"]
            if about["precision"] != str(like.u.dtype):
                raise DirectoryError(f"{self.folder} was begun in {about['precision']}, and JAX computes in {like.u.dtype} "
                                 "now: go on with that precision, or choose another directory.")  # fmt: skip
            shapes = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
            wanted = {"state": shapes, "history": np.empty(about["rows"])}
            items = ocp.args.Composite(tuning=ocp.args.StandardRestore(wanted))
            found = self._manager.restore(step, args=items)["tuning"]
            # As plain arrays: Orbax ties them to a device, and the simulation would be compiled anew for such points.
            state = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), found["state"])
            log = Log(tuple(about["metrics"]), found["history"])
        except DirectoryError:
            raise
        except Exception:  # a damaged file shows as whatever its reader stumbles over
            return None
        whole = about["digest"] == self.digest and about["checksum"] == _checksum(state, log.rows)
        return (state, log) if whole else None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without what Orbax's threads print of a damaged or failed checkpoint: here that is expected, and dealt with."""
    logger, hook = logging.getLogger("absl"), sys.unraisablehook
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    sys.unraisablehook = lambda _: None
    try:
        yield
    finally:
        logger.setLevel(level)
        sys.unraisablehook = hook


def _checksum(state: TuneState, rows: np.ndarray) -> str:
    """A hash of every number; the file format alone would not notice each flipped bit."""
    total = hashlib.sha256()
    for leaf in (*jax.tree.leaves(state), rows):
        array = np.asarray(leaf)
        total.update(f"{array.dtype} {array.shape}".encode())
        total.update(array.tobytes())
    return total.hexdigest()
