"""Ctrl-C and SIGTERM while a directory is being written: work in progress is finished first."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

from nermo_mjx.runs.workers import WorkersLost


class Interruption:
    """Raises `KeyboardInterrupt` on Ctrl-C or SIGTERM, but not inside of `shielded`: there at its end."""

    def __init__(self) -> None:
        self._shielded = self._pending = False

    @contextlib.contextmanager
    def shielded(self) -> Iterator[None]:
        """The enclosed block is finished before an interruption is raised."""
        self._shielded = True
        try:
            yield
        finally:
            self._shielded = False
        if self._pending:
            raise KeyboardInterrupt

    def check(self) -> None:
        """Raise an interruption that was lost where nothing can be raised, as in a destructor; call it often."""
        if self._pending and not self._shielded:
            raise KeyboardInterrupt

    def _noted(self, number: int, frame: FrameType | None) -> None:
        self._pending = True
        if not self._shielded:
            raise KeyboardInterrupt


@contextlib.contextmanager
def interruptible() -> Iterator[Interruption]:
    """Handles both signals inside of it, in the main thread; elsewhere no signal arrives."""
    interruption = Interruption()
    numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    before = {number: signal.signal(number, interruption._noted) for number in numbers}
    try:
        yield interruption
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def resumable(
    command: str, spec: Path, interrupted: type[KeyboardInterrupt], failed: type[Exception] = WorkersLost
) -> Iterator[Interruption]:
    """`interruptible`, with errors that say how to resume.

    Args:
        command: of nermo-mjx, by which it was started.
        spec: the file in the directory that is its first argument.
        interrupted: the error after a signal.
        failed: that after the loss of all workers.
    """
    try:
        with interruptible() as interruption:
            yield interruption
    except WorkersLost as lost:
        raise failed(lost.kept_in(spec.parent)) from None
    except KeyboardInterrupt:
        raise interrupted(
            f"stopped; what is finished is kept in {spec.parent}. To resume, run the same command again, or: "
            f"nermo-mjx {command} {spec} --out {spec.parent}"
        ) from None
