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

FORMATS: Final = ("png", "svg")
_DPI: Final = 200


def encode(figure: Figure, form: str) -> bytes:
    """The figure as PNG or SVG; the same figure gives the same bytes."""
    stream = io.BytesIO()
    figure.savefig(stream, format=form, dpi=_DPI, metadata={"Date": None} if form == "svg" else {"Software": None})
    return stream.getvalue()


def lay_out(figure: Figure) -> None:
    """Fix the places of a figure's axes, once for all its files."""
    for _ in range(2):  # axes of equal scales take a second time
        figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for ax in figure.axes:  # the layout's last digits differ from run to run, and with them the files' bytes
        ax.set_position(np.round(ax.get_position(original=True).bounds, 6).tolist())


def write_figures(
    figures: Iterable[tuple[str, Figure]],
    folder: Path,
    write: Callable[[Path, bytes], None] | None = None,
    formats: Sequence[str] = FORMATS,
) -> list[Path]:
    """Write figures in the house's style, each as soon as it is made, and return the files in the order drawn.

    Args:
        figures: name -> figure, such as a generator that makes one after the other.
        folder: where the files go; made if it is missing.
        write, formats: see `write_figure`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    with rc_context(STYLE):
        for name, figure in figures:
            lay_out(figure)
            files += write_figure(figure, folder, name, write, formats)
    return files


def write_figure(
    figure: Figure,
    folder: Path,
    name: str,
    write: Callable[[Path, bytes], None] | None = None,
    formats: Sequence[str] = FORMATS,
) -> list[Path]:
    """Write a figure that is laid out as FOLDER/NAME.png and .svg, and return the files.

    Args:
        write: how a file is written; `Path.write_bytes` if it is None.
        formats: of `FORMATS`.
    """
    files = [folder / f"{name}.{form}" for form in formats]
    for file in files:
        (write or Path.write_bytes)(file, encode(figure, file.suffix[1:]))
    return files
