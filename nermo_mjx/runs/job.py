"""What all jobs have in common: how far they are, who is told, and their end by Ctrl-C or SIGTERM."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Final, Self

from nermo_mjx.runs.workers import WorkersLost


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a job is.

    Attributes:
        fraction: share of the work that is done, 0 to 1; what an earlier session has done counts.
        done, total: runs of a sweep, evaluations of a search or a tuning, which has one more of
            them than steps; None where nothing is counted, or there is no total.
        resumed: of these, how many an earlier session had done, or another directory has.
        what: the part that is at work, such as "plots", or an experiment; empty: the job itself.
        best: lowest objective so far; None without one.
        numbers: what else is known by now: the filled `cells` of an atlas; `objective`, metrics and `simulated_seconds`
            [s] of a tuning, the first two of the best point of its last iteration.
    """

    fraction: float
    done: int | None = None
    total: int | None = None
    resumed: int = 0
    what: str = ""
    best: float | None = None
    numbers: Mapping[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Watch:
    """Functions that a job calls while it works.

    >>> Watch(warn=print).warn("3 parts are damaged.")
    3 parts are damaged.

    Attributes:
        progress: is told from time to time how far the job is.
        warn: gets a sentence about what is unusual, such as a damaged file that is moved aside.
        notify: gets a sentence if something takes long, such as compiling.
    """

    progress: Callable[[Progress], None] = lambda _: None
    warn: Callable[[str], None] = lambda _: None
    notify: Callable[[str], None] = lambda _: None


#: Nobody watches.
SILENT: Final = Watch()


@dataclasses.dataclass(frozen=True)
class Forecast:
    """What a job would cost on this machine, before it starts.

    Attributes:
        engine: that would run.
        counts: how many there are of what it is made of, by name, such as rows or evaluations.
        simulated_seconds: of all worlds, gradients at their cost in forward runs [s].
        wall_seconds: of that, without compiling [s]; NaN if it is not known.
        rate_from: the rate and its source, in words.
        disk_bytes: of what would be written, without figures; None if it is not known.
        method: of a tuning.
        notes: sentences.
    """

    engine: str
    counts: Mapping[str, int]
    simulated_seconds: float
    wall_seconds: float
    rate_from: str
    disk_bytes: int | None = None
    method: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def content(self) -> dict[str, Any]:
        """For programs: the counts beside the other fields, but for those that are not known."""
        others = {
            name: value
            for name, value in vars(self).items()
            if name != "counts" and value is not None
        }
        return {**self.counts, **others}


class JobFailed(RuntimeError):
    """A job that cannot go on; the message is one sentence that says why, and how to resume."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM; the message says how to resume."""


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

    def watched(self, watch: Watch) -> Watch:
        """The same, with a check whenever progress is told."""

        def progress(done: Progress) -> None:
            self.check()
            watch.progress(done)

        return dataclasses.replace(watch, progress=progress)

    def _noted(self, number: int, frame: FrameType | None) -> None:
        self._pending = True
        if not self._shielded:
            raise KeyboardInterrupt


@contextlib.contextmanager
def interruptible() -> Iterator[Interruption]:
    """Handles both signals inside of it, in the main thread; elsewhere no signal arrives."""
    interruption = Interruption()
    numbers = (
        (signal.SIGINT, signal.SIGTERM)
        if threading.current_thread() is threading.main_thread()
        else ()
    )
    before = {number: signal.signal(number, interruption._noted) for number in numbers}
    try:
        yield interruption
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def resumable(out: Path, again: str = "") -> Iterator[Interruption]:
    """`interruptible`, with errors that say how to resume: `Interrupted`, and `JobFailed` if all workers are lost.

    Args:
        out: the directory.
        again: a command that resumes it from the files in it, if there is one.
    """
    try:
        with interruptible() as interruption:
            yield interruption
    except WorkersLost as lost:
        raise JobFailed(
            f"{lost} What is finished is kept in {out}: run the same command again."
        ) from None
    except KeyboardInterrupt:
        how = f", or: nermo-mjx {again} --out {out}" if again else "."
        raise Interrupted(
            f"stopped; what is finished is kept in {out}. To resume, run the same command again{how}"
        ) from None


# ---
# Scalars of a long run in DIR/tensorboard, which `tensorboard --logdir DIR` shows; needs the extra `tensorboard`.


class TensorBoard:
    """Writes scalars; use it in a `with` statement. A resumed session adds a file.

    Args:
        out: the directory.
        part: of several processes that write the directory, which one this is.
    """

    def __init__(self, out: Path, part: str = "") -> None:
        from tensorboardX import SummaryWriter

        # Files are named by the second: of two sessions within one, the later would overwrite the earlier.
        self._writer = SummaryWriter(
            str(out / "tensorboard" / part), filename_suffix=f".{time.time_ns()}"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Write the finite numbers, by name; the others cannot be plotted."""
        for name, value in numbers.items():
            if math.isfinite(value):
                self._writer.add_scalar(name, float(value), step)
        self._writer.flush()
