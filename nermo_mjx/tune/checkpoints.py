"""A tuning's checkpoints: the state, and with it the history up to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from nermo_mjx.runs import DirectoryError, OtherCode, RunDirectory
from nermo_mjx.runs import checkpoints as stored
from nermo_mjx.runs.files import WrongDirectory
from nermo_mjx.specs.reading import changes
from nermo_mjx.tune.history import Log
from nermo_mjx.tune.spec import Tuning
from nermo_mjx.tune.tuner import TuneState


class Checkpoints:
    """The checkpoints of one directory, one per iteration; use it in a `with` statement.

    A checkpoint holds the state and the history so far (item `tuning`), and what they are (`about`: the tuning they
    belong to, precision, names of the metrics, shape of the history, which code made it, checksums). The history has no
    other source: everything else in the directory is made from the checkpoint, so that nothing can disagree with it.

    Args:
        held: the directory; checkpoints are in its folder `checkpoints`, which is made if it does not exist.
        tuning: that they belong to.
    """

    def __init__(self, held: RunDirectory, tuning: Tuning) -> None:
        self._held, self._stored = held, stored.Checkpoints(held, "tuning")
        self.folder, self.digest, self._identity = self._stored.folder, tuning.digest(), tuning.identity()

    def __enter__(self) -> Checkpoints:
        self._stored.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._stored.__exit__()

    def save(self, state: TuneState, log: Log) -> None:
        """Store a state and the history up to it; raises as `runs.checkpoints.Checkpoints.save`."""
        about = {
            "digest": self.digest,
            "precision": str(state.u.dtype),
            "metrics": list(log.metrics),
            "rows": list(log.rows.shape),
            "codes": log.codes,
            "identity": self._identity,
        }
        self._stored.save(int(state.iteration), {"state": state, "history": log.rows}, about)

    def restore(
        self, like: TuneState, *, accept: bool = False, warn: Callable[[str], None] = lambda _: None
    ) -> tuple[TuneState, Log] | None:
        """The latest intact checkpoint, None if there is none. Newer ones that are damaged are moved aside.

        Args:
            like: a state of the same tuning; its values do not matter.
            accept: take checkpoints that were computed with other defaults.
            warn: called with a message about each checkpoint that is moved aside.

        Raises:
            DirectoryError: one cannot be read now, or was computed in another precision, for another tuning, or with
                other defaults; nothing has been changed.
        """

        def shapes(about: Mapping[str, Any]) -> dict[str, Any]:
            self._check_ours(about, accept)
            if about["precision"] != str(like.u.dtype):
                raise DirectoryError(
                    f"{self.folder} was started in {about['precision']}, and JAX now computes in {like.u.dtype}: "
                    "resume with that precision, or choose another directory."
                )
            return {"state": like, "history": np.empty(about["rows"])}

        found = self._stored.restore(shapes, warn)
        if found is None:
            return None
        parts, about = found
        codes = tuple((int(first), str(code)) for first, code in about["codes"])
        return parts["state"], Log(tuple(about["metrics"]), parts["history"], codes)

    def _check_ours(self, about: Mapping[str, Any], accept: bool) -> None:
        """Refuse a checkpoint of another tuning, or of one with other defaults that are not accepted."""
        if about["digest"] == self.digest:
            return
        here, there = self._identity, about["identity"]
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
                f"{self._held.out} was made with other defaults: {difference}; choose another directory, or resume "
                "with --accept-new-code, and distinguish the rows by their column code."
            )
