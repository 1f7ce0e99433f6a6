"""The kinds of directories that commands open by their content, and where each says what it holds and draws it."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from nermo_mjx.cli.group import WrongUse


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of directory.

    Attributes:
        name: as run.json has it.
        called: in a sentence.
        status: module and name of the function that says how far such a directory is.
        redraw: the same of the function that draws its figures once more.
    """

    name: str
    called: str
    status: str
    redraw: str

    def load(self, place: str) -> Callable[..., Any]:
        """The function of a place, imported now."""
        module, _, name = place.partition(":")
        function: Callable[..., Any] = getattr(importlib.import_module(f"nermo_mjx.{module}"), name)
        return function


KINDS: Final = {
    kind.name: kind
    for kind in (
        Kind("sweep", "a sweep", "sweep.status:status", "sweep.redraw:redraw"),
        Kind("tuning", "a tuning", "tune.status:status", "tune.plots:redraw"),
        Kind("landscape", "a landscape", "tune.landscape.status:status", "tune.landscape.run:redraw"),
        Kind("experiments", "published experiments", "experiments.status:status", "experiments.redraw:redraw"),
        Kind("identification", "an identification", "experiments.status:identification_status",
             "experiments.redraw:redraw_identification"),
        Kind("benchmarks", "benchmarks", "bench.status:status", "bench.page:redraw"),
    )
}  # fmt: skip


def kind_of_directory(path: Path) -> Kind:
    """The kind of a directory.

    Raises:
        WrongUse: there is none, or it is none of ours.
        DirectoryError: its run.json is damaged.
    """
    from nermo_mjx.runs import kind_of

    if not path.exists():
        raise WrongUse(f"{path}: there is no such file or directory.")
    name = kind_of(path) if path.is_dir() else None
    if name is None:
        *most, last = (kind.called for kind in KINDS.values())
        raise WrongUse(f"{path} is no directory of results: it holds neither {', '.join(most)} nor {last}.")
    if name not in KINDS:
        raise WrongUse(f"{path} holds a {name}, which this version of nermo-mjx does not know.")
    return KINDS[name]
