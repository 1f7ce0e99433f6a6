"""The pictures of a directory of experiments, or of an identification, once more from what it holds."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from nermo_mjx.experiments.catalogue import EXPERIMENTS
from nermo_mjx.experiments.directory import Directory
from nermo_mjx.experiments.line import compare
from nermo_mjx.experiments.published import REASONS
from nermo_mjx.plotting.files import FORMATS
from nermo_mjx.runs.files import DirectoryError, clear_errors, make_writable

IDENTIFICATION: Final = "identification.json"


def redraw(out: str | os.PathLike[str], folder: Path | None = None, *, formats: Sequence[str] = FORMATS) -> list[Path]:
    """Draw the pictures of all experiments that a directory holds; nothing is simulated.

    Args:
        out: the directory.
        folder: where the files go; by default its `plots/`.
        formats: of `png` and `svg`.

    Raises:
        DirectoryError: it holds no experiment that can be read, or the files cannot be written.
    """
    from nermo_mjx.experiments.plots.draw import draw

    directory, drawn = Directory(out), list[Path]()
    folder = directory.out / "plots" if folder is None else folder
    for name, experiment in EXPERIMENTS.items():
        stored = directory.load(name)
        if stored is not None:
            lines = compare(stored.outcome, experiment.figures, REASONS.get(name, {}))
            make_writable(folder)
            with clear_errors(folder):
                drawn += draw(stored.outcome, lines, folder, formats)
    if not drawn:
        raise DirectoryError(f"{out} holds no experiment whose table and recordings can be read: run it again.")
    return drawn


def redraw_identification(
    out: str | os.PathLike[str], folder: Path | None = None, *, formats: Sequence[str] = FORMATS
) -> list[Path]:
    """Draw the pictures of an identification's directory; arguments and errors as for `redraw`."""
    from nermo_mjx.experiments.identification.plots import draw

    path = Path(out) / IDENTIFICATION
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise DirectoryError(f"{path} cannot be read: run the identification again.") from None
    folder = path.parent / "plots" if folder is None else folder
    make_writable(folder)
    with clear_errors(folder):
        return draw(content, folder, formats)
