"""The end of a command: its exit code, and its output as one sentence for an error, one JSON object, or tables.

`command` makes a command of a function that returns an `Output`. `CommandGroup` translates the errors of the package into
exit codes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import inspect
import io
import json
import logging
import os
import re
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import FrameType
from typing import IO, Any, Final, NoReturn

import click

from nermo_mjx.progress import is_given
from nermo_mjx.trust import MESSAGE_HANDLER, FileError, one_line, only_reading, printable

#: Thresholds of Python's garbage collector while a command runs. Tracing creates millions of long-lived objects,
#: which the collector would visit again and again by default: a fifth of the time that tracing takes.
COLLECTIONS: Final = (100_000, 50, 100)


#: Signals other than Ctrl-C that end a process: they come from a batch system, a closing terminal, or a time limit.
ENDING: Final = tuple(
    getattr(signal, f"SIG{end}")
    for end in [
        "TERM",
        "HUP",
        "QUIT",
        "BREAK",
        "USR1",
        "USR2",
        "ALRM",
        "VTALRM",
        "PROF",
        "XCPU",
        "IO",
        "PWR",
        "STKFLT",
    ]
    if hasattr(signal, f"SIG{end}")
)


def _as_ctrl_c(number: int, frame: FrameType | None) -> None:
    """Call the present handler of Ctrl-C."""
    handler = signal.getsignal(signal.SIGINT)
    (handler if callable(handler) else signal.default_int_handler)(signal.SIGINT, frame)


class Failure(click.ClickException):
    """The job failed; the message is one sentence for the user."""

    exit_code = 1

    def show(self, file: IO[Any] | None = None) -> None:
        click.echo(f"nermo-mjx: {one_line(self.format_message())}", file=file or sys.stderr)


class WrongUse(Failure):
    """The command was used wrongly."""

    exit_code = 2


class CommandGroup(click.Group):
    """A group that turns the package's own errors into exit codes, and an interruption into a sentence."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run as click does. A log on a full disk stops no job, but lost output is a failure."""
        out, errors = (_Lossy(stream or io.StringIO()) for stream in (sys.stdout, sys.stderr))
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
            try:
                return super().main(*args, **kwargs)
            except SystemExit as ending:
                out.flush()
                if out.lost is None or ending.code:
                    raise
                click.echo(
                    f"nermo-mjx: done, but standard output cannot be written: {out.lost.strerror}.",
                    err=True,
                )
                raise SystemExit(1) from None
            finally:
                out.flush()
                errors.flush()

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse as click does; arguments must be UTF-8, because files, tables and pages contain them."""
        for arg in args:
            try:
                arg.encode()
            except UnicodeEncodeError:
                raise click.UsageError(
                    f"{arg!a} is not UTF-8: rename the file or folder.", ctx
                ) from None
        return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        MESSAGE_HANDLER.set(lambda sentence: click.echo(f"nermo-mjx: {sentence}", err=True))
        gc.set_threshold(*COLLECTIONS)
        in_main = threading.current_thread() is threading.main_thread()
        handlers = {
            signal_number: signal.getsignal(signal_number) for signal_number in ENDING if in_main
        }
        former_handlers = {
            signal_number: signal.signal(signal_number, _as_ctrl_c)
            for signal_number in handlers
            if handlers[signal_number] is signal.SIG_DFL
        }
        warned = set[str]()

        def warn(message: Warning | str, *_: Any) -> None:
            """Print a warning once, as a sentence without its line of code."""
            if str(message) not in warned:
                warned.add(str(message))
                MESSAGE_HANDLER.get()(one_line(str(message)))

        compiles = logging.getLogger(
            "nermo_mjx.rollout.simulator"
        )  # commands say themselves what compiles
        level = compiles.level
        compiles.setLevel(logging.ERROR)
        try:
            with warnings.catch_warnings():
                warnings.showwarning = warn  # type: ignore[assignment]
                return super().invoke(ctx)
        except KeyboardInterrupt as error:
            # Sweeps and tunings say themselves how to resume; commands without state simply stop.
            raise Failure(
                str(error) or "stopped; nothing was kept, run the same command again."
            ) from None
        except (click.ClickException, click.Abort, click.exceptions.Exit):
            raise
        except MemoryError:
            raise Failure(
                "this does not fit into memory: ask for less at once; what is finished is kept."
            ) from None
        except RecursionError:
            raise Failure(
                "lists or mappings of a file, or calls of code that it names, are nested too deep."
            ) from None
        except Exception as error:
            _translate(error)
        finally:
            compiles.setLevel(level)
            for signal_number, handler in former_handlers.items():
                signal.signal(signal_number, handler)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """Resolve as click does; the message about an unknown command contains the nearest name."""
        import difflib

        name = args[0]
        if not name.startswith("-") and name not in self.commands:
            near = difflib.get_close_matches(name, self.commands, n=1)
            hint = (
                f" Did you mean {near[0]!r}?"
                if near
                else f" There are: {', '.join(self.commands)}."
            )
            raise click.UsageError(f"No such command {name!r}.{hint}", ctx)
        return super().resolve_command(ctx, args)


class _Lossy:
    """A standard stream that escapes control characters, and that continues on a full disk but remembers the error.

    A closed pipe ends the command as usual.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = self.terminal = stream
        self.lost: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> Any:
        return self.styled(printable(text))

    def styled(self, text: str) -> Any:
        """Write a text of the command itself, whose control characters are not escaped."""
        return self._kept(self._stream.write, text)

    def flush(self) -> None:
        self._kept(self._stream.flush)

    def _kept(self, act: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return act(*arguments)
        except BrokenPipeError:
            raise
        except OSError as error:
            self.lost = self.lost or error


def _translate(error: Exception) -> NoReturn:
    """Turn one of the package's errors into a user error; anything else is a bug and keeps its traceback."""
    if isinstance(
        error, RuntimeError
    ) and "invalid value for environment variable MUJOCO_GL" in str(error):
        # MuJoCo raises it on import.
        backend = os.environ.get("MUJOCO_GL")
        sentence = f"MUJOCO_GL is {backend!r}: allowed is egl, osmesa or glfw; unset it for automatic selection."
        raise Failure(sentence) from None
    from nermo_mjx.robot.quantity import ParameterError
    from nermo_mjx.runs.files import WrongDirectory

    if isinstance(error, ParameterError | WrongDirectory):
        raise WrongUse(str(error)) from None
    # The package's errors carry a sentence for the user; those of modules that were never imported cannot occur.
    ours = type(error).__module__.partition(".")[0] == "nermo_mjx"
    if ours and isinstance(error, (ValueError, RuntimeError, OSError, FileError)):
        raise Failure(str(error)) from None
    if isinstance(error, OSError) and error.filename is not None:
        raise Failure(f"{error.filename}: {error.strerror}.") from None
    if "jax" in sys.modules and os.environ.get("JAX_PLATFORMS"):
        from nermo_mjx.runtime import BackendUnavailable, start_jax

        try:
            start_jax()
        except BackendUnavailable as unavailable:
            raise Failure(str(unavailable)) from None
    raise error


@dataclasses.dataclass(frozen=True)
class Output:
    """The result of a command.

    Attributes:
        content: Content of the JSON object of `--json`.
        show: Function that prints the result for people.
        files: Files that the command wrote; their names are printed last.
        failure: Message with which the command fails after this output; empty for success.
        always: Whether the result is also shown with `--quiet`.
    """

    content: Any
    show: Callable[[], object] = lambda: None
    files: Sequence[Path] = ()
    failure: str = ""
    always: bool = False


#: All commands, in the order in which their modules are imported.
ALL_COMMANDS: Final[list[click.Command]] = []


def command(name: str, *, reads: bool = False) -> Callable[[Callable[..., Any]], click.Command]:
    """Decorator that makes a command of a function, and adds `--json` and `--quiet`.

    The docstring of the function is the help; the epilog begins with its first list that has a heading. Output of
    libraries is redirected to standard error.

    Args:
        name: Name of the command.
        reads: Whether the command only reads, so that it runs no Python that files name.
    """

    def make(function: Callable[..., Any]) -> click.Command:
        text, *lists = re.split(r"\n\n(?=(?:Examples|Cases):\n)", inspect.getdoc(function) or "")
        declared = list(getattr(function, "__click_params__", ()))

        @functools.wraps(function)
        def run(as_json: bool, quiet: bool, **options: Any) -> None:
            with contextlib.redirect_stdout(sys.stderr):
                outcome: Output = function(**options)
            if as_json:
                from nermo_mjx.runs.files import plain_json

                click.echo(
                    json.dumps(
                        plain_json(outcome.content), indent=2, allow_nan=False, ensure_ascii=False
                    )
                )
            elif not quiet or outcome.always:
                outcome.show()
                for file in outcome.files:
                    click.echo(f"wrote {file}")
            if outcome.failure:
                raise Failure(outcome.failure)

        decorated: Any = only_reading()(run) if reads else run
        quietly = click.Option(
            ["--quiet", "-q"], is_flag=True, help="Print errors only, no progress or summary."
        )
        json_help = "Print one JSON object on standard output, nothing else."
        decorated.__click_params__ = [
            quietly,
            click.Option(["--json", "as_json"], is_flag=True, help=json_help),
            *declared,
        ]
        ALL_COMMANDS.append(
            click.command(
                name, help=text, epilog="\n\n".join(f"\b\n{section}" for section in lists)
            )(decorated)
        )
        return ALL_COMMANDS[-1]

    return make


def say(sentence: str) -> None:
    """Print a sentence about the present command's work on standard error, unless it is quiet."""
    if not is_given("quiet"):
        click.echo(f"{click.get_current_context().info_name}: {sentence}", err=True)


def print_pairs(pairs: Iterable[tuple[str, Any]]) -> None:
    """Print lines of a name and a text; pairs without a text are omitted."""
    lines = [(name, text) for name, text in pairs if text]
    width = max([8, *(len(name) for name, _ in lines)])
    for name, text in lines:
        click.echo(f"{name:<{width}} {one_line(str(text))}")


def print_places(out: Path, **places: Any) -> None:
    """Print the paths of files by their meaning: names in `out`, or whole paths; empty ones are omitted."""
    print_pairs((name, file and out / file) for name, file in places.items())


def in_unit(name: str, unit: str, *values: float) -> tuple[list[float], str]:
    """Values in SI units converted into their display unit, and this unit, which is empty for pure numbers."""
    from nermo_mjx.plotting.shown import shown

    quantity = shown(name, unit, values)
    return quantity.values.tolist(), quantity.unit


def room() -> int | None:
    """Width of a line in characters, from the terminal or COLUMNS; None if it is unlimited."""
    is_known = sys.stdout.isatty() or os.environ.get("COLUMNS")
    return shutil.get_terminal_size().columns if is_known else None


def print_table(
    title: str,
    headings: str | Iterable[str | tuple[str, str]],
    rows: Iterable[Sequence[Any]],
    spare: Sequence[int] = (),
) -> list[str]:
    """Print a table for people; returns the headings of omitted columns. Without a terminal, lines are never wrapped.

    Args:
        title: Title above the table.
        headings: Headings of the columns, or one text in which ", " separates them. Each is (heading, "left" or "right"),
            or a heading, which ends with > if the texts of its column are aligned to the right.
        rows: Texts of the columns for each row.
        spare: Indices of the columns that may be omitted on a narrow terminal, the least important first.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    columns = [
        (column_heading.removesuffix(">"), "right" if column_heading.endswith(">") else "left")
        if isinstance(column_heading, str)
        else column_heading
        for column_heading in (headings.split(", ") if isinstance(headings, str) else headings)
    ]
    width = room() if spare else None
    texts, shown_columns = (
        [[one_line(str(cell)) for cell in row] for row in rows],
        list(range(len(columns))),
    )
    wide = [
        3 + max([len(heading), *(len(row[i]) for row in texts)])
        for i, (heading, _) in enumerate(columns)
    ]
    for i in spare:
        if width is not None and sum(wide[k] for k in shown_columns) > width + 3:
            shown_columns.remove(i)
    table = Table(
        box=SIMPLE_HEAD,
        pad_edge=False,
        show_edge=False,
        show_header=any(columns[i][0] for i in shown_columns),
    )
    for heading, side in (columns[i] for i in shown_columns):
        table.add_column(Text(one_line(heading)), justify="right" if side == "right" else "left")
    for row in texts:
        table.add_row(*(Text(row[i]) for i in shown_columns))
    console = Console(
        file=sys.stdout, width=width or (None if sys.stdout.isatty() else 200), highlight=False
    )
    with console.capture() as capture:
        console.print(Text(one_line(title), style="bold"))
        console.print(table)
    lines = (line.rstrip() for line in capture.get().splitlines())
    getattr(sys.stdout, "styled", sys.stdout.write)("\n".join(lines) + "\n\n")
    return [heading for i, (heading, _) in enumerate(columns) if i not in shown_columns]
