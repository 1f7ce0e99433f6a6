"""Figures as files: the same figure gives the same bytes, as PNG for the screen and SVG for print."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from nermo_mjx.plotting.style import STYLE
from nermo_mjx.runs.files import clear_errors, make_writable, replace_file

FORMATS: Final = ("png", "svg")
_FILE_DPI: Final = 200
#: Figures by name; a generator makes each in turn, in the common style.
Figures = Iterable[tuple[str, Figure]]


def write_figures(
    figures: Figures,
    folder: Path,
    write: Callable[[Path, bytes], None] = replace_file,
    formats: Sequence[str] = FORMATS,
) -> list[Path]:
    """Write figures as FOLDER/NAME.png and .svg, each as soon as it is made, and return the files in the order drawn.

    Args:
        figures: a generator is run in the common style.
        folder: where the files go; made if it is missing.
        write: how a file is written; by default atomically.
        formats: of `FORMATS`.

    Raises:
        DirectoryError: a file cannot be written.
    """
    make_writable(folder)
    files: list[Path] = []
    with clear_errors(folder), rc_context(STYLE):
        for name, figure in figures:
            lay_out(figure)
            for form in formats:
                files.append(folder / f"{name}.{form}")
                write(files[-1], _encode(figure, form))
    return files


def lay_out(figure: Figure) -> None:
    """Fix the places of a figure's axes, once for all its files."""
    for _ in range(2):  # axes of equal scales take a second time
        figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for ax in (
        figure.axes
    ):  # the layout's last digits differ from run to run, and with them the files' bytes
        ax.set_position(np.round(ax.get_position(original=True).bounds, 6).tolist())


def _encode(figure: Figure, form: str) -> bytes:
    """The figure as PNG or SVG; the same figure gives the same bytes."""
    stream = io.BytesIO()
    figure.savefig(
        stream,
        format=form,
        dpi=_FILE_DPI,
        metadata={"Date": None} if form == "svg" else {"Software": None},
    )
    return stream.getvalue()
