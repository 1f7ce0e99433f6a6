"""The figures of an experiment, in the form of the published ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from nermo_mjx.experiments.catalogue import EXPERIMENTS
from nermo_mjx.experiments.directory import Directory
from nermo_mjx.experiments.line import Line, compare
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots import agreement, balance, maze, stands, straight_line, turning
from nermo_mjx.experiments.published import REASONS
from nermo_mjx.plotting.files import Figures
from nermo_mjx.runs.files import DirectoryError

Drawer = Callable[[Outcome, Sequence[Line]], Iterator[tuple[str, Figure | None]]]
DRAWERS: Final[dict[str, Drawer]] = {
    "straight-line": straight_line.figures,
    "turning": turning.figures,
    "balance": balance.figures,
    "maze": maze.figures,
    "body": lambda outcome, lines: iter(()),
    "leg-stand": stands.leg_figures,
    "spine-stand": stands.spine_figures,
}


def figures_of(outcome: Outcome, lines: Sequence[Line]) -> Iterator[tuple[str, Figure]]:
    """(EXPERIMENT-PICTURE, figure) of each picture for which the outcome has data.

    Missing parts (a profile, a case, a recording) are left out of the figures.

    Args:
        outcome: of the experiment.
        lines: of its report, with the published values, which are drawn next to the simulated ones.
    """
    lines = [line for line in lines if line.experiment == outcome.experiment]
    for drawer in (DRAWERS[outcome.experiment], agreement.figures):
        for name, figure in drawer(outcome, lines):
            if figure is not None:
                yield f"{outcome.experiment}-{name}", figure


def figures(out: Path) -> Figures:
    """The images of all experiments that a directory holds.

    Raises:
        DirectoryError: it contains no readable experiment.
    """
    directory = Directory(out)
    found = [stored.outcome for name in EXPERIMENTS if (stored := directory.load(name)) is not None]
    if not found:
        raise DirectoryError(f"{out} holds no experiment whose table and recordings can be read: run it again.")
    return (named for outcome in found for named in figures_of(outcome, _lines(outcome)))


def _lines(outcome: Outcome) -> list[Line]:
    name = outcome.experiment
    return compare(outcome, EXPERIMENTS[name].figures, REASONS.get(name, {}))
