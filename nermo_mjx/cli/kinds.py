"""The kinds of directories, and which functions draw their figures and report their progress."""

from __future__ import annotations

import dataclasses
import html
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from nermo_mjx.cli.output import WrongUse

if TYPE_CHECKING:
    from nermo_mjx.view.page import Page


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of directory, or of file.

    Attributes:
        name: as run.json has it.
        figures: module and name of the function that names its figures: `figures(path, **options)` reads and checks,
            and returns `plotting.files.Figures`, of which each is made when it is written.
        status: the same of the function that says how far such a directory is.
        tracked: whether run.json records which files the program wrote, so that no others are replaced.
        options: keywords that `figures` takes, of those that the command `plot` has.
        page: the same of the function that makes its page, `page(path, **options)`; empty: the page shows the figures.
        follows: whether the page can follow a job that is at work.
    """

    name: str
    figures: str
    status: str = ""
    tracked: bool = False
    options: tuple[str, ...] = ()
    page: str = ""
    follows: bool = False

    @property
    def called(self) -> str:
        """The kind in a sentence."""
        from nermo_mjx.runs.directory import with_article

        return with_article(self.name)

    def load(self, location: str) -> Callable[..., Any]:
        """The function of a place, imported now."""
        module, _, name = location.partition(":")
        function: Callable[..., Any] = getattr(importlib.import_module(f"nermo_mjx.{module}"), name)
        return function


_PLOT_COLUMNS: Final = ("x", "y", "color")
_RUNS: Final = "view.explore:explore"
_DIRECTORY_KINDS: Final = (
    Kind(
        "sweep",
        "sweep.plots:sweep_figures",
        "sweep.table:sweep_status",
        False,
        (*_PLOT_COLUMNS, "notify"),
        _RUNS,
    ),
    Kind(
        "search",
        "optimize.search_figures:search_figures",
        "optimize.search_directory:search_status",
        False,
        _PLOT_COLUMNS,
        _RUNS,
    ),
    Kind(
        "tuning",
        "optimize.tuning_figures:tuning_figures",
        "optimize.tuning_directory:tuning_status",
    ),
    Kind(
        "training",
        "learn.plots:training_figures",
        "learn.directory:training_status",
        page="view.trained:trained",
        follows=True,
    ),
    Kind(
        "experiments",
        "experiments.run:images",
        "experiments.run:experiments_status",
        True,
        page=_RUNS,
    ),
    Kind(
        "experiment",
        "sweep.plots:sweep_figures",
        "experiments.run:experiment_status",
        False,
        (*_PLOT_COLUMNS, "notify"),
        _RUNS,
    ),
    *(
        Kind(
            name,
            "identify.report:reject_figures",
            "identify.run:identification_status",
            page="identify.report:identification_page",
        )
        for name in ("identification", "identification from a log")
    ),
    Kind(
        "comparison",
        "sweep.comparing:comparison_figures",
        "sweep.table:report_status",
        True,
    ),
    Kind(
        "sensitivity",
        "sweep.sensitivity:sensitivity_figures",
        "sweep.table:report_status",
        True,
    ),
)
#: Kinds of directories, by name.
KINDS: Final = {kind.name: kind for kind in _DIRECTORY_KINDS}
RECORDING: Final = Kind("recording", "cli.view:figures_of_file", options=("notify",))


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
        *first_names, last_name = (kind.called for kind in KINDS.values())
        raise WrongUse(
            f"{path} is not a results directory: it contains neither {', '.join(first_names)} nor {last_name}."
        )
    if name not in KINDS:
        raise WrongUse(
            f"{path} holds a {name}, which this release does not open: use the release that made it, named in run.json."
        )
    return KINDS[name]


def directory_page(path: Path, **options: Any) -> Page:
    """The page of a directory: its runs, to which the options apply, its training, or its figures.

    Raises:
        DirectoryError: it has nothing to show.
    """
    from nermo_mjx.runs import kind_of
    from nermo_mjx.view.page import Page
    from nermo_mjx.view.trained import offline_page

    kind = KINDS.get(kind_of(path) or "", KINDS["sweep"])
    if kind.page:
        return cast("Page", kind.load(kind.page)(path, **options if kind.page == _RUNS else {}))
    name, figures = html.escape(path.resolve().name), kind.load(kind.figures)(path)
    return Page(offline_page(name, kind.called, [], figures), 680)
