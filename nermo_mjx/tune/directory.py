"""A tuning's directory: what it is for, who may write it, and the files that are made from its checkpoints.

DIR/tuning.yaml       the resolved tuning
DIR/run.json          versions, machine and command of each session that worked on it
DIR/checkpoints/      Orbax checkpoints, the newest few
DIR/history.parquet   one row an iteration and start
DIR/best.json         the best point and what it cost to find
DIR/tuned.yaml        a sweep file with the best point's values
DIR/plots/            figures, and the landscape behind the paths
DIR/video.mp4         start and best side by side
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from types import TracebackType
from typing import Any

from nermo_mjx.runs.directory import remove_leftovers
from nermo_mjx.runs.files import DirectoryError, clear_errors, make_writable, parquet_bytes, replace_file
from nermo_mjx.runs.lock import hold
from nermo_mjx.runs.provenance import with_session
from nermo_mjx.sweep.reading import SpecError
from nermo_mjx.sweep.summary import to_json
from nermo_mjx.tune.checkpoints import Checkpoints
from nermo_mjx.tune.history import FILE, Log, history_table
from nermo_mjx.tune.outcome import best_of, tuned_sweep
from nermo_mjx.tune.spec import FREE, Tuning
from nermo_mjx.tune.state import TuneState


class Directory:
    """A directory held by this process for one tuning; use it in a `with` statement.

    Args:
        out: the directory; made if it does not exist.
        tuning: what the directory is for.

    Raises:
        DirectoryError: the directory holds another tuning, is in use, or cannot be written.
        ParameterError: it is a file.
    """

    def __init__(self, out: str | os.PathLike[str], tuning: Tuning) -> None:
        self.out, self.tuning = Path(out), tuning
        self.checkpoints = Checkpoints(self.out / "checkpoints", tuning.digest())
        self._held = contextlib.ExitStack()

    def __enter__(self) -> Directory:
        with contextlib.ExitStack() as stack, clear_errors(self.out):
            make_writable(self.out)
            stack.callback(os.close, hold(self.out))
            self._claim()
            remove_leftovers(self.out)
            stack.enter_context(self.checkpoints)
            self._held = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._held.close()

    def keep(self, state: TuneState, log: Log) -> dict[str, Any] | None:
        """Store a state and its history, and make the other files from it; the content of best.json, if any."""
        with clear_errors(self.out):
            self.checkpoints.save(state, log)
        return self.publish(log)

    def publish(self, log: Log) -> dict[str, Any] | None:
        """Make history.parquet, best.json and tuned.yaml from the history; the content of best.json, if any."""
        best = best_of(self.tuning, log)
        self.write(FILE, parquet_bytes(history_table(self.tuning, log)))
        if best is not None:
            self.write("best.json", to_json(best))
            self.write("tuned.yaml", tuned_sweep(self.tuning, best).encode())
        return best

    def discard(self, name: str) -> None:
        """Remove a file that is made of what is about to change."""
        with clear_errors(self.out):
            (self.out / name).unlink(missing_ok=True)

    def write(self, name: str, content: bytes) -> None:
        """Replace a file of the directory, atomically and durably."""
        with clear_errors(self.out):
            replace_file(self.out / name, content)

    def note_session(self, session: dict[str, Any]) -> None:
        """Add what ran here, and where, to run.json."""
        self.write("run.json", with_session(self.out / "run.json", session))

    def _claim(self) -> None:
        """Make the directory this tuning's, or refuse."""
        path = self.out / "tuning.yaml"
        if path.exists():
            try:
                begun = Tuning.from_file(path)
            except SpecError as error:
                raise self._foreign(f"a tuning that cannot be read ({error})") from None
            if begun.digest() != self.tuning.digest() and self._begun():
                raise self._foreign(f"another tuning, {self._differences(begun)} (see {path})")
        elif self._begun():
            raise self._foreign("checkpoints of an unknown tuning (it has no tuning.yaml)")
        self.write(path.name, self.tuning.to_yaml().encode())

    def _begun(self) -> bool:
        """Whether any iteration is stored; until then, another tuning may take the directory over."""
        return any(path.name.isdecimal() for path in self.checkpoints.folder.glob("*"))

    def _differences(self, begun: Tuning) -> str:
        before, now = begun.resolved(), self.tuning.resolved()
        fields = [field for field in {**before, **now} if before.get(field) != now.get(field) and field not in FREE]
        return f"with another {', '.join(fields)}" if fields else "made with other defaults"

    def _foreign(self, content: str) -> DirectoryError:
        return DirectoryError(f"{self.out} holds {content}; choose another directory.")
