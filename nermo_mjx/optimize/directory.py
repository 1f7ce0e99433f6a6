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


def read_spec(path: Path, kind: str, holds: str, read: Callable[[Path], S]) -> S | None:
    """The specification in a directory's file; None if there is no file.

    Args:
        holds: Content of the directory that, without the file, belongs to an unknown job; empty if there is none.

    Raises:
        WrongDirectory: The file cannot be read, or is missing although the directory has content.
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


def other_spec_error(path: Path, kind: str, apart: Sequence[str]) -> WrongDirectory:
    """The error about a directory that belongs to another job, with the fields that differ (`apart`)."""
    return WrongDirectory(
        f"{path.parent} holds another {kind}, with another {', '.join(apart[:3])}; choose another directory, or "
        f"resume with {path}."
    )


#: Runs of the best point in its sweep, from slightly different initial states, to show whether the point is fragile.
BEST_POINT_REPEATS: Final = 3


def sweep_text(
    walk: WalkSpec, head: str, values: Mapping[str, float], seed: int, folder: Path | None = None
) -> str:
    """The text of a sweep file that runs one point a few times from slightly different initial states.

    Args:
        walk: Walk of the tuning or search.
        head: Comment line about the point.
        values: Parameters of the point, by name.
        seed: Seed of the initial states.
        folder: Folder of the file, see `walk_fields`.
    """
    data = walk.walk_fields(folder) | {
        "set": {**walk.fixed, **values},
        "randomize": {"repeats": BEST_POINT_REPEATS},
    }
    return f"# {head}\n" + dump({**data, "seed": seed, "plots": False})
