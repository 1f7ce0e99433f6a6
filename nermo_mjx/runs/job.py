"""Parts that all jobs share: their progress, their callbacks, their forecast, their interruption by Ctrl-C or SIGTERM."""

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
    """The progress of a job.

    Attributes:
        fraction: Fraction of the work that is done, 0 to 1, including earlier sessions.
        done, total: Numbers of runs of a sweep, or of evaluations of a search or a tuning (which has one more evaluation
            than steps); None if nothing is counted, or if the total is unknown.
        resumed: Number of these that an earlier session or another directory has done.
        what: Name of the running part, such as "plots" or an experiment; empty for the job itself.
        best: Lowest objective so far; None without an objective.
        numbers: Other values: the filled `cells` of an atlas; `objective`, metrics and `simulated_seconds` [s] of a
            tuning, of which the first two belong to the best point of its last iteration.
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
        progress: Function that is called with the progress of the job from time to time.
        warn: Function that is called with a message about an unusual event, such as a damaged file.
        notify: Function that is called with a message if something takes long, such as compilation.
    """

    progress: Callable[[Progress], None] = lambda _: None
    warn: Callable[[str], None] = lambda _: None
    notify: Callable[[str], None] = lambda _: None


#: Callbacks that do nothing.
SILENT: Final = Watch()


@dataclasses.dataclass(frozen=True)
class Forecast:
    """The estimated cost of a job on this machine.

    Attributes:
        engine: Name of the engine that would run.
        counts: Numbers of the parts of the job by name, such as rows or evaluations.
        simulated_seconds: Simulated time of all worlds, with gradients at their cost in forward runs [s].
        wall_seconds: Wall time without compilation [s]; NaN if it is unknown.
        rate_from: The rate and its source, in words.
        disk_bytes: Size of the results without figures [bytes]; None if it is unknown.
        method: Method of a tuning.
        notes: Additional sentences.
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
        """Content for programs: the counts, and the other fields that are known."""
        others = {
            name: value
            for name, value in vars(self).items()
            if name != "counts" and value is not None
        }
        return {**self.counts, **others}


class JobFailed(RuntimeError):
    """A job that cannot continue; the message is one sentence with the reason and how to resume."""


class Interrupted(KeyboardInterrupt):
    """An interruption by Ctrl-C or SIGTERM; the message contains how to resume."""


class Interruption:
    """Raises `KeyboardInterrupt` on Ctrl-C or SIGTERM; inside of `shielded`, it is raised at the end of the block."""

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
        """Raise an interruption that was lost, for example in a destructor, which cannot raise; call this often."""
        if self._pending and not self._shielded:
            raise KeyboardInterrupt

    def watched(self, watch: Watch) -> Watch:
        """The callbacks, with a check at every report of progress."""

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
    """Handle both signals inside of the context, in the main thread; other threads receive no signals."""
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
    """`interruptible`, with messages about how to resume: `Interrupted`, and `JobFailed` if all workers are lost.

    Args:
        out: Directory of the job.
        again: Command that resumes the job from the files of the directory; empty if there is none.
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
