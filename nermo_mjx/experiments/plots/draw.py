"""The pictures of an experiment, in the form of the published figures: which there are, and how they are written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import matplotlib
from matplotlib.figure import Figure

from nermo_mjx.experiments.line import Line
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots import balance, maze, report, straight_line, turning
from nermo_mjx.plotting.files import FORMATS, lay_out, write_figure
from nermo_mjx.plotting.style import STYLE
from nermo_mjx.runs.files import replace_file

Drawer = Callable[[Outcome, Sequence[Line]], Iterator[tuple[str, Figure | None]]]
DRAWERS: Final[dict[str, Drawer]] = {
    "straight-line": straight_line.figures,
    "turning": turning.figures,
    "balance": balance.figures,
    "maze": maze.figures,
    "body": lambda outcome, lines: iter(()),
}


def draw(
    outcome: Outcome,
    lines: Sequence[Line],
    out: Path,
    formats: Sequence[str] = FORMATS,
    *,
    write: Callable[[Path, bytes], None] = replace_file,
) -> list[Path]:
    """Draw the pictures of one experiment, each as PNG and SVG.

    What the outcome does not have (a profile, a case, a recording) is left out of the pictures, and a picture of
    nothing is not written.

    Args:
        outcome: of the experiment.
        lines: of its report; they hold what the publication says, which is drawn beside what was simulated.
        out: folder of the files, which are called EXPERIMENT-PICTURE.png and .svg.
        formats: of `png` and `svg`.
        write: how a file is written.

    Returns:
        The files, in the order drawn. Each is written whole or not at all, and the same outcome gives the same bytes.
    """
    out.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for name, figure in pictures(outcome, lines):
        with matplotlib.rc_context(STYLE):
            files += write_figure(figure, out, f"{outcome.experiment}-{name}", write, formats)
    return files


def pictures(outcome: Outcome, lines: Sequence[Line]) -> list[tuple[str, Figure]]:
    """(name, figure) of each picture of which the outcome has something to show, laid out."""
    lines = [line for line in lines if line.experiment == outcome.experiment]
    with matplotlib.rc_context(STYLE):
        drawn = [*DRAWERS[outcome.experiment](outcome, lines), *report.figures(outcome, lines)]
        kept = [(name, figure) for name, figure in drawn if figure is not None]
        for _, figure in kept:
            lay_out(figure)
    return kept
