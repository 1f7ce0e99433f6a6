"""Progress on standard error: a bar on a terminal, a line that is overwritten in a notebook, otherwise occasional lines.

A command shows its progress unless it is quiet. Functions in Python show it only on a terminal and in IPython.
"""

from __future__ import annotations

import contextlib
import functools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import IO, TYPE_CHECKING, Any, Final, ParamSpec, TypeVar

import click

if TYPE_CHECKING:
    from nermo_mjx.runs.job import Progress as JobProgress

P = ParamSpec("P")
R = TypeVar("R")
#: Whether a job runs, which shows the progress of its parts itself.
_JOB_RUNS: Final[ContextVar[bool]] = ContextVar("_JOB_RUNS", default=False)
COMPILATION_MESSAGE = "compiling, once per machine"
#: Time without progress after which a first compilation is the likely reason; a cached program starts earlier [s].
STALL_SECONDS = 1.5


class ProgressBar:
    """Shows the progress of a job; a context manager.

    Args:
        name: Name of the work, such as "sweep".
        unit: Unit of the count, such as "runs".
        quiet: Whether nothing is shown; by default the option of the present command.
        compiles: Whether a message mentions compilation if there is no progress at first.
        every: Time between two lines without a terminal [s]; in a notebook, the line changes 20 times in this time.
        stream: Stream for the output; standard error by default.
    """

    def __init__(
        self,
        name: str,
        unit: str = "",
        *,
        quiet: bool | None = None,
        compiles: bool = False,
        every: float = 10.0,
        stream: IO[str] | None = None,
    ) -> None:
        self._what, self._unit, self._every, self._stream = name, unit, every, stream or sys.stderr
        self._quiet = is_given("quiet") if quiet is None else quiet
        self._bar: Any = None
        self._timer = threading.Timer(STALL_SECONDS, self._name_compilation)
        self._timer.daemon = True
        self._waits, self._compiling = compiles and not self._quiet, False
        # Time and fraction at the beginning of the count, and of the rate, which excludes the compilation.
        self._start: tuple[float, float] | None = None
        self._pace_start = (0.0, 0.0)
        self._last_line = time.monotonic()
        self._writes_over, self._width = not self._stream.isatty() and _is_notebook(), 0
        self._every = 0.05 * every if self._writes_over else every

    def __enter__(self) -> ProgressBar:
        if not self._quiet and self._stream.isatty():
            self._bar = _bar(self._stream)
            self._bar.start()
            self._task = self._bar.add_task(self._what, total=1.0, note="")
        if self._waits:
            self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        if self._bar is not None:
            self._bar.stop()
        if self._width:
            self._width = 0
            self._stream.write("\n")

    def count(self, count: int, total: int) -> None:
        """Report how many of all are done."""
        self.share(count / total if total else 1.0, count, total)

    def share(
        self, fraction: float, done: int | None = None, total: int | None = None, detail: str = ""
    ) -> None:
        """Report the fraction of the work that is done, and the count; resumed work starts above 0.

        Args:
            fraction: Fraction of the work that is done.
            done, total: Count of what is done, and of everything; None if nothing is counted.
            detail: Additional information to show.
        """
        now = time.monotonic()
        if self._start is None:
            self._start = self._pace_start = (now, fraction)
        if fraction > self._start[1]:
            self._timer.cancel()
            if self._compiling:
                self._compiling, self._pace_start = False, (now, fraction)
        count_text = (
            "" if done is None or total is None else f", {done:,} of {total:,} {self._unit}"
        )
        # The detail is last: a narrow terminal cuts it off.
        text = f"{fraction:.0%}{count_text}{self._pace(now, fraction, total)}{detail and f', {detail}'}"
        finished = fraction >= 1.0 > self._start[1] and done == total
        if self._bar is not None:
            self._bar.update(self._task, completed=fraction)
        elif now - self._last_line < self._every and not finished:
            return
        self._last_line = now
        self._note(text)

    def _note(self, text: str) -> None:
        """Show a text behind the bar or on a line."""
        if self._bar is not None:
            self._bar.update(self._task, note=text)
        elif not self._quiet:
            line = f"{self._what}: {text}"
            # Spaces overwrite the rest of a longer former line.
            self._stream.write(f"{line:<{self._width}}\r" if self._writes_over else f"{line}\n")
            self._width = len(line) if self._writes_over else 0
            self._stream.flush()

    def _name_compilation(self) -> None:
        self._compiling = True
        self._note(COMPILATION_MESSAGE)

    def _pace(self, now: float, fraction: float, total: int | None) -> str:
        """Rate and remaining time, as text, from the progress of this process."""
        seconds, share = now - self._pace_start[0], fraction - self._pace_start[1]
        if seconds <= 0 or share <= 0:
            return ""
        rate = total * share / seconds if total else 0.0
        pace = (
            f", {rate:.3g} {self._unit}/s"
            if rate >= 0.1
            else f", {duration(1 / rate)} each"
            if rate
            else ""
        )
        return pace + (
            f", {duration((1 - fraction) * seconds / share)} left" if fraction < 1 else ""
        )


class Stages:
    """The display of a job and of its parts, one after another; a context manager.

    Args:
        name: Name of the job.
        unit: Unit of its count, such as "runs".
        compiles: Function that returns whether a part compiles at first; the argument is the name of the part or the job.
        details: Function that returns an additional text about a progress.
    """

    def __init__(
        self,
        name: str,
        unit: str,
        compiles: Callable[[str], bool],
        details: Callable[[JobProgress], str] = lambda _: "",
    ) -> None:
        self._name, self._unit, self._compiles, self._details = name, unit, compiles, details
        self._what, self._progress = "", ProgressBar("")

    def __enter__(self) -> Stages:
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.__exit__()
        self._what = ""

    def show(self, progress: JobProgress) -> None:
        """Show the progress of the job or of its part; a new part gets a new display."""
        name = progress.what or self._name
        if name != self._what:
            self.__exit__()
            self._what = name
            unit = "" if progress.what else self._unit
            self._progress = ProgressBar(name, unit, compiles=self._compiles(name)).__enter__()
        count = (
            progress.done
            if progress.done is None or progress.total is None
            else min(progress.done, progress.total)
        )
        self._progress.share(progress.fraction, count, progress.total, self._details(progress))

    def say(self, sentence: str) -> None:
        """Print a sentence on its own line."""
        self.__exit__()
        if not is_given("quiet"):
            click.echo(f"{self._name}: {sentence}", err=True)


def is_given(option: str) -> bool:
    """Whether the present command was given a flag, such as "quiet" or "as_json"."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.params.get(option))


def _is_watched() -> bool:
    """Whether a person may watch the output, and no command or job shows the progress already."""
    if _JOB_RUNS.get() or click.get_current_context(silent=True) is not None:
        return False
    return sys.stderr.isatty() or _is_notebook()


def _is_notebook() -> bool:
    """Whether this is IPython, which without a terminal runs in a notebook."""
    shell = sys.modules.get("IPython")
    return shell is not None and shell.get_ipython() is not None


@contextlib.contextmanager
def shown_share(
    name: str, progress: Callable[[float], None] | bool | None
) -> Iterator[Callable[[float], None] | None]:
    """Yield the function for the fraction done: the given one, or a display for long work that a person may watch, or None."""
    if progress not in (None, True, False) and not callable(progress):
        raise TypeError(
            f"progress is {progress!r}: expected a function of the share done, or False to be silent."
        )
    if callable(progress) or progress is False or not _is_watched():
        yield progress if callable(progress) else None
        return
    with contextlib.ExitStack() as stack:
        bars, began = list[ProgressBar](), time.monotonic()

        def share(fraction: float) -> None:
            if not bars and time.monotonic() - began > STALL_SECONDS:
                bars.append(stack.enter_context(ProgressBar(name)))
            if bars:
                bars[0].share(fraction)

        yield share


def shows_progress(name: str, unit: str = "") -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator of a job with the options `watch` and `progress`, which adds a display of its progress.

    The display appears if `watch` is not given, `progress` is not False, and a person may watch the output.

    Args:
        name: Name of the job.
        unit: Unit of its count.
    """

    def decorate(job: Callable[P, R]) -> Callable[P, R]:
        from nermo_mjx.runs.job import Watch

        @functools.wraps(job)
        def working(*arguments: P.args, **options: P.kwargs) -> R:
            watch = options.get("watch")
            if "watch" in options and not isinstance(watch, Watch):
                raise TypeError(f"watch is {watch!r}: expected a Watch, such as Watch(warn=print).")
            shows = watch is None and options.get("progress", True) is not False and _is_watched()
            token = _JOB_RUNS.set(True)
            try:
                with Stages(name, unit, lambda _: True) as stages:
                    watch_options: Any = {"watch": Watch(stages.show, stages.say)} if shows else {}
                    return job(*arguments, **options, **watch_options)
            finally:
                _JOB_RUNS.reset(token)

        return working

    return decorate


def duration(seconds: float) -> str:
    """Seconds in words: 8 s, 3 min 20 s, 2 h 5 min."""
    total_seconds = round(seconds)
    if total_seconds < 60:
        return f"{total_seconds} s"
    if total_seconds < 3600:
        return f"{total_seconds // 60} min {total_seconds % 60} s"
    return f"{total_seconds // 3600} h {total_seconds % 3600 // 60} min"


def _bar(stream: IO[str]) -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, SpinnerColumn, TextColumn
    from rich.progress import Progress as RichProgress

    name, note = (
        TextColumn(f"{{task.{field}}}", markup=False) for field in ("description", "fields[note]")
    )
    # The bar moves the cursor, which the stream of a command escapes in texts.
    console = Console(file=getattr(stream, "terminal", stream))
    return RichProgress(
        SpinnerColumn(), name, BarColumn(bar_width=24), note, console=console, transient=True
    )
