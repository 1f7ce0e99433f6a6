"""Workers that compute the tasks of a run: one interface for this process and for a cluster (`ray_workers`).

The process that drives a run submits tasks and receives results as they finish, in any order; only it writes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol

from nermo_mjx.runs.code import CodeStamp

#: Callback for the progress of a task: its key, and the fraction done, 0 to 1.
Tell = Callable[[int, float], None]


class Computer(Protocol):
    """Computes tasks, one after another, warm after the first.

    It is sent to other machines in its state before the first task, and warmed up there.
    """

    def warm(self) -> None:
        """Warm up; an error says why it cannot compute here."""
        ...

    def stamp(self) -> CodeStamp:
        """Stamp of the code that computes on the calling machine."""
        ...

    def __call__(self, task: Any, /, progress: Callable[[float], None] | None = None) -> Any:
        """The result of a task."""
        ...


class Workers(Protocol):
    """Compute the tasks of one run: `begin`, then `results`, as often as there are tasks."""

    @property
    def parts(self) -> int:
        """How many tasks are computed at once, as far as is known before they begin."""
        ...

    def begin(self, computer: Computer) -> CodeStamp:
        """Warm up; returns the stamp of the code that computes.

        Raises:
            WorkersLost: there is no worker.
        """
        ...

    def results(self, tasks: Iterable[tuple[int, Any]], tell: Tell) -> Iterator[tuple[int, Any]]:
        """Results by the keys of their tasks, in any order; tasks are requested when a worker is free.

        Args:
            tasks: each with a key of its own.
            tell: is told the progress of a task, where that is known.

        Raises:
            TaskFailed: a task cannot be computed.
            WorkersLost: no worker is left.
        """
        ...


class TaskFailed(RuntimeError):
    """A task that raised an error, on whatever machine it ran: `error`, which is also the cause."""

    def __init__(self, key: int, error: BaseException) -> None:
        super().__init__(f"task {key} failed: {error}")
        self.key, self.error = key, error
        self.__cause__ = error


class WorkersLost(RuntimeError):
    """No worker is left; the message says why."""


class LocalWorkers:
    """This process computes, one task after another."""

    parts = 1

    def begin(self, computer: Computer) -> CodeStamp:
        """See `Workers`; raises what the computer raises."""
        computer.warm()
        self._computer = computer
        return computer.stamp()

    def results(self, tasks: Iterable[tuple[int, Any]], tell: Tell) -> Iterator[tuple[int, Any]]:
        """See `Workers`."""
        for key, task in tasks:
            try:
                result = self._computer(task, functools.partial(tell, key))
            except Exception as error:
                raise TaskFailed(key, error) from error
            yield key, result
