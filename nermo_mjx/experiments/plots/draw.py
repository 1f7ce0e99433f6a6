"""The pictures of an experiment, in the form of the published figures: which there are, and how they are written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from nermo_mjx.experiments.line import Line
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots import balance, maze, report, straight_line, turning
from nermo_mjx.sweep.figures import STYLE, encode
from nermo_mjx.sweep.files import replace_file

Drawer = Callable[[Outcome, Sequence[Line]], Iterator[tuple[str, Figure | None]]]
DRAWERS: Final[dict[str, Drawer]] = {
    "straight-line": straight_line.figures,
    "turning": turning.figures,
    "balance": balance.figures,
    "maze": maze.figures,
}
FORMS: Final = ("png", "svg")


def draw(outcome: Outcome, lines: Sequence[Line], out: Path) -> list[Path]:
    """Draw the pictures of one experiment, each as PNG and SVG.

    What the outcome does not have (a profile, a case, a recording) is left out of the pictures, and a picture of
    nothing is not written.

    Args:
        outcome: of the experiment.
        lines: of its report; they hold what the publication says, which is drawn beside what was simulated.
        out: folder of the files, which are called EXPERIMENT-PICTURE.png and .svg.

    Returns:
        The files, in the order drawn. Each is written whole or not at all, and the same outcome gives the same bytes.
    """
    out.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for name, figure in pictures(outcome, lines):
        for form in FORMS:
            files.append(out / f"{outcome.experiment}-{name}.{form}")
            with matplotlib.rc_context(STYLE):
                replace_file(files[-1], encode(figure, form))
    return files


def pictures(outcome: Outcome, lines: Sequence[Line]) -> list[tuple[str, Figure]]:
    """(name, figure) of each picture of which the outcome has something to show, laid out."""
    lines = [line for line in lines if line.experiment == outcome.experiment]
    with matplotlib.rc_context(STYLE):
        drawn = [*DRAWERS[outcome.experiment](outcome, lines), *report.figures(outcome, lines)]
        kept = [(name, figure) for name, figure in drawn if figure is not None]
        for _, figure in kept:
            for _ in range(2):  # lays the axes out; those of equal scales take a second time
                figure.draw_without_rendering()
            figure.set_layout_engine("none")
            for ax in figure.axes:  # the layout's last digits differ from run to run, and with them the files' bytes
                ax.set_position(np.round(ax.get_position(original=True).bounds, 6).tolist())
    return kept
