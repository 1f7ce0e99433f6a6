"""Writing beside computing: finished work is stored by a thread while the next is under way."""

from __future__ import annotations

import collections
import threading
from collections.abc import Callable
from types import TracebackType


class Writer:
    """Runs tasks one after the other in a thread of its own; leaving its `with` statement waits until all are done.

    One task runs while the next one is prepared, so that a process that is killed loses no more than these two. After
    an error nothing more is run, and the error is raised where the next task is handed in, or the `with` statement
    left. It also waits when it is left by an exception, such as an interruption: what was handed in is stored.
    """

    def __init__(self) -> None:
        self._tasks: collections.deque[Callable[[], None]] = collections.deque()
        self._changed = threading.Condition()
        self._closed = False
        self._error: BaseException | None = None
        # A second interruption while it is waited for ends the process; half a file is never seen.
        self._thread = threading.Thread(target=self._work, name="sweep-writer", daemon=True)

    def __enter__(self) -> Writer:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()
        if self._error is not None and self._error is not error:
            raise self._error

    def put(self, task: Callable[[], None]) -> None:
        """Hand in a task; returns when it begins, which is when the one before it is done.

        Raises:
            Exception: what an earlier task raised.
        """
        self._tasks.append(task)  # before anything that an interruption could cut off
        with self._changed:
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._tasks or self._error is not None)
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._tasks) or self._closed)
                if not self._tasks:
                    return
                task = self._tasks.popleft()
                self._changed.notify_all()
            try:
                task()
            except BaseException as error:
                with self._changed:
                    self._error = error
                    self._tasks.clear()
                    self._changed.notify_all()
                return
