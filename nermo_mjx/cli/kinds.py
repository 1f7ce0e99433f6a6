"""The kinds of directories that commands recognize by their content, and where their status and figures are defined."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from nermo_mjx.cli.group import WrongUse


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of directory, or of file.

    Attributes:
        name: as run.json has it.
        called: in a sentence.
        figures: module and name of the function that names its figures: `figures(path, **options)` reads and checks,
            and returns `plotting.files.Figures`, of which each is made when it is written.
        status: the same of the function that says how far such a directory is.
        options: keywords that `figures` takes, of those that the command `plot` has.
        tracked: whether run.json records which files the program wrote, so that no others are replaced.
    """

    name: str
    called: str
    figures: str
    status: str = ""
    options: tuple[str, ...] = ()
    tracked: bool = False

    def load(self, place: str) -> Callable[..., Any]:
        """The function of a place, imported now."""
        module, _, name = place.partition(":")
        function: Callable[..., Any] = getattr(importlib.import_module(f"nermo_mjx.{module}"), name)
        return function


#: Kinds of directories, by name.
KINDS: Final = {
    kind.name: kind
    for kind in (
        Kind("sweep", "a sweep", "sweep.redraw:figures", "sweep.status:status", ("x", "y", "color", "notify")),
        Kind("search", "a search", "search.plots:figures", "search.status:status", ("x", "y", "color", "notify")),
        Kind("tuning", "a tuning", "tune.plots:figures", "tune.status:status"),
        Kind("training", "a training", "learn.plots:figures", "learn.status:status"),
        Kind("landscape", "a landscape", "tune.landscape.plots:figures", "tune.status:landscape_status"),
        Kind("experiments", "published experiments", "experiments.plots:figures", "experiments.directory:status",
             tracked=True),
        Kind("identification", "an identification", "experiments.identification:drawn",
             "experiments.identification:status", tracked=True),
        Kind("comparison", "a comparison", "sweep.comparing.figures:figures", "sweep.reports:status", tracked=True),
        Kind("sensitivity", "a sensitivity analysis", "sweep.sensitivity_figure:figures", "sweep.reports:status",
             tracked=True),
        Kind("benchmarks", "benchmarks", "bench.results:figures", "bench.results:status", tracked=True),
    )
}  # fmt: skip
RECORDING: Final = Kind("recording", "a recording", "cli.recordings:figures", options=("notify",))


def kind_of_directory(path: Path) -> Kind:
    """The kind of a directory.

    Raises:
        WrongUse: it does not exist, or is of no known kind.
        DirectoryError: its run.json is damaged.
    """
    from nermo_mjx.runs import kind_of

    if not path.exists():
        raise WrongUse(f"{path}: there is no such file or directory.")
    name = kind_of(path) if path.is_dir() else None
    if name is None:
        *most, last = (kind.called for kind in KINDS.values())
        raise WrongUse(f"{path} is not a results directory: it contains neither {', '.join(most)} nor {last}.")
    if name not in KINDS:
        raise WrongUse(f"{path} holds a {name}, which this version of nermo-mjx does not know.")
    return KINDS[name]
