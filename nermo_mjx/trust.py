"""Rules for untrusted files: which text of them is printed, and whether Python code that they name may run."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Final


class FileError(Exception):
    """A file with wrong content; the message is one sentence that names the file."""


# ---
# Text of a file is printed without its control characters, which a terminal would obey.


#: Control characters other than the end of a line and the tab, and characters that change the direction of writing.
_CONTROL_CHARACTERS: Final = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]"
)


def printable(text: str) -> str:
    r"""A text as it can be shown: control characters are escaped, as in JSON.

    >>> print(printable("speed\x1b[2J"))
    speed\u001b[2J
    """
    return _CONTROL_CHARACTERS.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def one_line(text: str) -> str:
    """A text as `printable` returns it, on one line."""
    return printable(text).replace("\n", "\\n").replace("\t", "\\t")


def shortened(text: str, limit: int = 60) -> str:
    """A text, or its beginning if it has more than `limit` characters."""
    return text if len(text) <= limit else f"{text[: limit - 3]}..."


# ---
# Python code that files name.


#: Whether Python code that files name may run, and the function that prints a message before.
CODE_EXECUTION: ContextVar[bool] = ContextVar("CODE_EXECUTION", default=True)
MESSAGE_HANDLER: ContextVar[Callable[[str], None]] = ContextVar(
    "MESSAGE_HANDLER", default=lambda sentence: None
)
#: Suffixes of files that contain a controller as data instead of code, with `MODULE:NAME` of the function that reads
#: them. The top of the package fills this table, because the readers depend on modules that use it.
DATA_CONTROLLERS: Final[dict[str, str]] = {}


@contextlib.contextmanager
def only_reading() -> Iterator[None]:
    """Context manager or decorator: inside, no Python code that a file names runs."""
    token = CODE_EXECUTION.set(False)
    try:
        yield
    finally:
        CODE_EXECUTION.reset(token)
