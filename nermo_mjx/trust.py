"""What a stranger's file may do here: which text of it is shown, and whether Python that it names is run."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Final


class FileError(Exception):
    """A file that is not what it should be; the message is one sentence that names the file."""


# ---
# What is shown of a file: a terminal would obey its control characters.


#: Control characters but the line's end and the tab, and those that turn the direction of writing.
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
    """The same for a text that has one line."""
    return printable(text).replace("\n", "\\n").replace("\t", "\\t")


def shortened(text: str, limit: int = 60) -> str:
    """A text, or its beginning if it has more letters."""
    return text if len(text) <= limit else f"{text[: limit - 3]}..."


# ---
# Whose Python is run.


#: Whether the Python that files name may be run, and what is told before.
CODE_EXECUTION: ContextVar[bool] = ContextVar("CODE_EXECUTION", default=True)
MESSAGE_HANDLER: ContextVar[Callable[[str], None]] = ContextVar(
    "MESSAGE_HANDLER", default=lambda sentence: None
)
#: Suffixes of files that hold a controller as data instead of code, and MODULE:NAME of the function that reads them.
#: The top of the package fills it in, as these modules are built on those that take a controller's name.
DATA_CONTROLLERS: Final[dict[str, str]] = {}


@contextlib.contextmanager
def only_reading() -> Iterator[None]:
    """Inside of it, or of a function that it decorates, no Python that a file names is run."""
    token = CODE_EXECUTION.set(False)
    try:
        yield
    finally:
        CODE_EXECUTION.reset(token)
