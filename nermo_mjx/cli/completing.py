"""Shell completion of arguments: names, and files by type. It imports nothing heavy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

Completer = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]


def names(*known: str) -> Completer:
    """Completes one of these names."""

    def complete(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return [CompletionItem(name) for name in known if name.startswith(incomplete)]

    return complete


def assignments(*known: str) -> Completer:
    """Completes the name in NAME=X."""

    def complete(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
        found = [f"{name}=" for name in known if name.startswith(incomplete)]
        # A shell adds a space after a single offer; a second one prevents that before the value.
        return [CompletionItem(each) for each in (found if len(found) != 1 else [*found, f"{found[0]}X"])]

    return complete


class FileKind(click.Path):
    """A path completed with files of certain suffixes, and the folders leading to them."""

    def __init__(self, *endings: str, **settings: Any) -> None:
        super().__init__(path_type=Path, **settings)
        self.endings = endings

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        found = offered(incomplete, self.endings)
        # If nothing matches, the shell offers its own completions.
        return [CompletionItem(each) for each in found] or [CompletionItem(incomplete, type="file")]


def offered(incomplete: str, endings: tuple[str, ...]) -> list[str]:
    """Files with one of the suffixes, and folders with a slash, that begin with the typed text.

    A single folder is entered, because a shell adds a space after a single offer.
    """
    folder, _, begin = incomplete.rpartition("/")
    where = Path(folder or ("/" if incomplete.startswith("/") else ".")).expanduser()
    prefix = incomplete[: len(incomplete) - len(begin)]
    try:
        entries = sorted(where.iterdir())
    except OSError:
        return []
    fitting = [e for e in entries if e.name.startswith(begin) and (begin.startswith(".") or e.name[0] != ".")]
    folders = [f"{prefix}{e.name}/" for e in fitting if e.is_dir()]
    files = [f"{prefix}{e.name}" for e in fitting if not e.is_dir() and e.name.endswith(endings)]
    if len(folders) == 1 and not files:
        return offered(folders[0], endings) or folders
    return sorted(folders + files)
