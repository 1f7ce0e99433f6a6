"""A tuning's state on disk: Orbax checkpoints, each with the history up to it, and checked when read."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from nermo_mjx.runs import DirectoryError, OtherCode, RunDirectory
from nermo_mjx.runs.files import WrongDirectory, replace_file
from nermo_mjx.tune.history import Log
from nermo_mjx.tune.spec import Tuning, changes
from nermo_mjx.tune.state import TuneState

#: Bytes that must be free for a checkpoint to be begun.
ROOM: Final = 1 << 18
#: Checkpoints that are kept; all but the newest are there for the case that it is damaged.
KEPT: Final = 3


class Checkpoints:
    """The checkpoints of one directory, one an iteration; use it in a `with` statement.

    A checkpoint holds the state and the history so far (item `tuning`), and what they are (`about`: the tuning they
    belong to, precision, names of the metrics, shape of the history, which code made it, checksums). The history has no
    other source: whatever else is in the directory is made from the checkpoint, so that nothing can disagree with it.

    Args:
        held: the directory; checkpoints are in its folder `checkpoints`, which is made if it does not exist.
        tuning: that they belong to.
    """

    def __init__(self, held: RunDirectory, tuning: Tuning) -> None:
        self.folder, self._held = held.out / "checkpoints", held
        self.digest, self._identity = tuning.digest(), tuning.identity()

    def __enter__(self) -> Checkpoints:
        options = ocp.CheckpointManagerOptions(
            max_to_keep=KEPT, enable_async_checkpointing=False, cleanup_tmp_directories=True
        )
        with _quiet():
            self._manager = ocp.CheckpointManager(self.folder.absolute(), options=options)
        return self

    def __exit__(self, *_: object) -> None:
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
            "codes": log.codes,
            "checksum": _checksum(state, log.rows),
            "identity": self._identity,
        }
        about["seal"] = _seal(about)
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

    def restore(
        self, like: TuneState, *, accept: bool = False, warn: Callable[[str], None] = lambda _: None
    ) -> tuple[TuneState, Log] | None:
        """The newest whole checkpoint, None if there is none. Newer ones that are damaged are moved aside.

        Args:
            like: a state of the same tuning; its values do not matter.
            accept: take checkpoints that were computed with other defaults.
            warn: called with a sentence on each checkpoint that is moved aside.

        Raises:
            DirectoryError: one cannot be read now, or was computed in another precision, for another tuning, or with
                other defaults; nothing has been changed.
        """
        damaged, found = [], None
        with _quiet():
            for step in sorted(self._manager.all_steps(), reverse=True):
                self._check_readable(step)
                found = self._read(step, like, accept)
                if found is not None:
                    break
                damaged.append(step)
            for step in damaged:
                aside = self._held.move_aside(self.folder.relative_to(self._held.out) / str(step))
                if aside is not None:
                    warn(f"checkpoint {step} in {self.folder} is damaged; it is kept as {aside.name}.")
            if damaged:
                self._manager.reload()
        return found

    def _check_readable(self, step: int) -> None:
        """Tell a disk that does not answer from a damaged file, which Orbax does not."""
        try:
            for path in (self.folder / str(step)).rglob("*"):
                if path.is_file():
                    path.read_bytes()
        except OSError as error:
            raise self._unreadable(step, error) from error

    def _unreadable(self, step: int, error: OSError) -> DirectoryError:
        return DirectoryError(f"checkpoint {step} in {self.folder} cannot be read: {error.strerror or error}; nothing "
                              "was changed, run the same command again.")  # fmt: skip

    def _read(self, step: int, like: TuneState, accept: bool) -> tuple[TuneState, Log] | None:
        """A checkpoint; None if it is damaged."""
        try:
            items = ocp.args.Composite(about=ocp.args.JsonRestore())
            about: dict[str, Any] = self._manager.restore(step, args=items)["about"]
            if about.get("seal", "") != ("" if "identity" not in about else _seal(about)):
                return None
            self._check_ours(about, accept)
            if about["precision"] != str(like.u.dtype):
                raise DirectoryError(
                    f"{self.folder} was begun in {about['precision']}, and JAX computes in {like.u.dtype} now: go on "
                    "with that precision, or choose another directory."
                )
            shapes = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
            wanted = {"state": shapes, "history": np.empty(about["rows"])}
            items = ocp.args.Composite(tuning=ocp.args.StandardRestore(wanted))
            found = self._manager.restore(step, args=items)["tuning"]
            # As plain arrays: Orbax ties them to a device, and the simulation would be compiled anew for such points.
            state = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), found["state"])
            codes = tuple((int(first), str(code)) for first, code in about.get("codes", [(0, "")]))
            log = Log(tuple(about["metrics"]), found["history"], codes)
        except (DirectoryError, MemoryError):
            raise
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise self._unreadable(step, error) from error
        except Exception:  # a damaged file shows as whatever its reader stumbles over
            return None
        return (state, log) if about["checksum"] == _checksum(state, log.rows) else None

    def _check_ours(self, about: Mapping[str, Any], accept: bool) -> None:
        """Refuse a checkpoint of another tuning, or of one with other defaults that are not accepted."""
        if about["digest"] == self.digest:
            return
        here, there = self._identity, about.get("identity")
        difference = "its checkpoints do not say which, as those of earlier releases, or whether of another recording"
        if there is not None:
            # A field that only one of the two knows has a default there.
            both = there["fields"].keys() & here["fields"].keys()
            apart = changes(*({name: each["fields"][name] for name in here["fields"] if name in both}
                              for each in (there, here)))  # fmt: skip
            apart += ["recording"] if there["recording"] != here["recording"] else []
            if apart:
                raise WrongDirectory(f"{self._held.out} holds checkpoints of another tuning, with another "
                                     f"{', '.join(apart)}; choose another directory.")  # fmt: skip
            difference = ", ".join(changes(there["fields"] | there["defaults"], here["fields"] | here["defaults"]))
        if not accept:
            raise OtherCode(
                f"{self._held.out} was made with other defaults: {difference}; choose another directory, or go on with "
                "--accept-new-code, and tell the rows apart by their column code."
            )


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


def _seal(about: Mapping[str, Any]) -> str:
    """A hash of what a checkpoint says of itself, as JSON gives it back."""
    content = json.dumps({key: about[key] for key in about if key != "seal"}, sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()
