"""How every command ends: 0 success, 1 the job failed, 2 usage error, and one sentence instead of a traceback."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any, Final, NoReturn

import click

#: Thresholds of Python's garbage collector while a command runs. Tracing creates millions of long-lived objects,
#: which the collector would visit again and again by default: a fifth of the time that tracing takes.
COLLECTIONS: Final = (100_000, 50, 100)


class Failure(click.ClickException):
    """The job failed; the message is one sentence for the user."""

    exit_code = 1

    def show(self, file: IO[Any] | None = None) -> None:
        click.echo(f"nermo-mjx: {self.format_message()}", file=file or sys.stderr)


class WrongUse(Failure):
    """The command was used wrongly."""

    exit_code = 2


class CommandGroup(click.Group):
    """A group that turns the package's own errors into exit codes, and an interruption into a sentence."""

    def invoke(self, ctx: click.Context) -> Any:
        with _terminate_as_interrupt(), _seldom_collected():
            try:
                return super().invoke(ctx)
            except KeyboardInterrupt as error:
                # Sweeps and tunings say themselves how to resume; commands without state simply stop.
                raise Failure(str(error) or "stopped; nothing was kept, run the same command again.") from None
            except (click.ClickException, click.Abort, click.exceptions.Exit):
                raise
            except Exception as error:
                _translate(error)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """As click does it, with the nearest command's name."""
        import difflib

        name = args[0]
        if not name.startswith("-") and name not in self.commands:
            near = difflib.get_close_matches(name, self.commands, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else f" There are: {', '.join(self.commands)}."
            raise click.UsageError(f"No such command {name!r}.{hint}", ctx)
        return super().resolve_command(ctx, args)


@contextmanager
def _seldom_collected() -> Iterator[None]:
    before = gc.get_threshold()
    gc.set_threshold(*COLLECTIONS)
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _translate(error: Exception) -> NoReturn:
    """Turn one of the package's errors into a user error; anything else is a bug and keeps its traceback."""
    if isinstance(error, RuntimeError) and "invalid value for environment variable MUJOCO_GL" in str(error):
        # MuJoCo raises it on import.
        given = os.environ.get("MUJOCO_GL")
        sentence = f"MUJOCO_GL is {given!r}: allowed is egl, osmesa or glfw; unset it for automatic selection."
        raise Failure(sentence) from None
    from nermo_mjx.robot.quantity import ParameterError
    from nermo_mjx.runs.files import WrongDirectory

    if isinstance(error, ParameterError | WrongDirectory):
        raise WrongUse(str(error)) from None
    # The package's errors carry a sentence for the user; those of modules that were never imported cannot occur.
    ours = type(error).__module__.partition(".")[0] == "nermo_mjx"
    if ours and isinstance(error, (ValueError, RuntimeError, OSError)):
        raise Failure(str(error)) from None
    if isinstance(error, OSError) and error.filename is not None:
        raise Failure(f"{error.filename}: {error.strerror}.") from None
    if "jax" in sys.modules and os.environ.get("JAX_PLATFORMS"):
        _blame_platform()
    raise error


def _blame_platform() -> None:
    """Raise a one-sentence error if JAX cannot use the requested platform."""
    from nermo_mjx.runtime import BackendUnavailable, start_jax

    try:
        start_jax()
    except BackendUnavailable as unavailable:
        raise Failure(str(unavailable)) from None


@contextmanager
def _terminate_as_interrupt() -> Iterator[None]:
    """SIGTERM, as sent by batch systems, ends a command like Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
