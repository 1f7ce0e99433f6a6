"""Content that the directories of tunings and searches share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeVar

from nermo_mjx.optimize.search_spec import Search
from nermo_mjx.optimize.tuning_spec import Tuning
from nermo_mjx.runs.files import WrongDirectory
from nermo_mjx.specs.reading import SpecError, dump
from nermo_mjx.specs.walk import WalkSpec

BEST: Final = "best.json"
S = TypeVar("S", Tuning, Search)


def stored_spec(path: Path, kind: str, holds: str, read: Callable[[Path], S]) -> S | None:
    """What a directory was begun for, as its file says; None if there is no file.

    Args:
        holds: what it holds that belongs to an unknown job where there is no file; empty: nothing.

    Raises:
        WrongDirectory: the file cannot be read, or is missing.
    """
    try:
        if path.exists():
            return read(path)
    except SpecError as error:
        unread = (
            f"{path.parent} holds a {kind} that cannot be read ({error}); choose another directory."
        )
        raise WrongDirectory(unread) from None
    if holds:
        raise WrongDirectory(
            f"{path.parent} holds {holds} of an unknown {kind} (it has no {path.name}); choose another directory."
        )
    return None


def other_spec(path: Path, kind: str, apart: Sequence[str]) -> WrongDirectory:
    """The error about a directory that was begun for another job, and in what that differs."""
    return WrongDirectory(
        f"{path.parent} holds another {kind}, with another {', '.join(apart[:3])}; choose another directory, or "
        f"resume with {path}."
    )


#: Runs of the sweep that starts from a best point: from slightly different starts, to show whether it is fragile.
BEST_POINT_REPEATS: Final = 3


def sweep_of(
    walk: WalkSpec, head: str, values: Mapping[str, float], seed: int, folder: Path | None = None
) -> str:
    """A sweep file of a found point: setup, run and `set`, run a few times from slightly different starts.

    Args:
        walk: what was tuned or searched.
        head: a line about the point.
        values: its parameters.
        seed: of the starts.
        folder: where the file is to stand, see `walk_fields`.
    """
    data = walk.walk_fields(folder) | {
        "set": {**walk.fixed, **values},
        "randomize": {"repeats": BEST_POINT_REPEATS},
    }
    return f"# {head}\n" + dump({**data, "seed": seed, "plots": False})
