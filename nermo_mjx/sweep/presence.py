"""Which processes of a sweep on several hosts are still there, as its directory tells.

Each one writes a file again and again. The others look at whether it changes, by their own clocks, so that neither
clocks nor networks need agree; a process that is killed, or whose host is lost, falls silent.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from pathlib import Path
from types import TracebackType

from nermo_mjx.sweep.hosts import Hosts

#: Seconds between two signs of life, and of silence after which a process counts as lost.
BEAT, PATIENCE = 5.0, 60.0


class Presence:
    """Gives signs of life of this process, and watches those of the others; use it in a `with` statement."""

    def __init__(self, out: Path, hosts: Hosts, patience: float = PATIENCE) -> None:
        self._out, self._hosts, self._patience = out, hosts, patience
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="sweep-presence", daemon=True)
        #: What was last seen of a process, and when that was new.
        self._seen: dict[int, tuple[bytes, float]] = {}

    def __enter__(self) -> Presence:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopped.set()
        self._thread.join()
        with contextlib.suppress(OSError):
            self._file(self._hosts.index).unlink(missing_ok=True)

    def lost(self, index: int) -> bool:
        """Whether a process has been silent for long; to be asked now and then."""
        try:
            sign = self._file(index).read_bytes()
        except OSError:
            sign = b""
        now = time.monotonic()
        before, since = self._seen.get(index, (None, now))
        if sign != before:
            since = now
        self._seen[index] = (sign, since)
        return now - since > self._patience

    def _file(self, index: int) -> Path:
        return self._out / f".process-{index}-of-{self._hosts.count}"

    def _beat(self) -> None:
        beats = 0
        while True:
            # A sign that cannot be written is left out: what matters fails with a sentence of its own.
            with contextlib.suppress(OSError):
                self._file(self._hosts.index).write_text(f"{os.getpid():>10} {beats:>12}")
            beats += 1
            if self._stopped.wait(min(BEAT, self._patience / 4)):
                return
