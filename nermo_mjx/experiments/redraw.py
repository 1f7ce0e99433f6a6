"""The pictures of a directory of experiments, or of an identification, once more from what it holds."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

from nermo_mjx.experiments.catalogue import EXPERIMENTS
from nermo_mjx.experiments.directory import Directory
from nermo_mjx.experiments.line import compare
from nermo_mjx.experiments.published import REASONS
from nermo_mjx.experiments.written import Written
from nermo_mjx.plotting.files import FORMATS
from nermo_mjx.runs import RunDirectory
from nermo_mjx.runs.files import DirectoryError, clear_errors, make_writable


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
    own = directory.out / "plots"
    found = {name: stored for name in EXPERIMENTS if (stored := directory.load(name)) is not None}
    # Into its own folder it draws as a run does: it keeps track of the files that are the program's.
    with RunDirectory(out, "experiments") if folder in (None, own) else contextlib.nullcontext() as held:
        for name, stored in found.items():
            lines = compare(stored.outcome, EXPERIMENTS[name].figures, REASONS.get(name, {}))
            if held is None:
                assert folder is not None
                make_writable(folder)
                with clear_errors(folder):
                    drawn += draw(stored.outcome, lines, folder, formats)
            else:
                written = Written(held, directory.written(name))
                drawn += draw(stored.outcome, lines, own, formats, write=written.write)
                directory.note_files(name, written.known)
    if not drawn:
        raise DirectoryError(f"{out} holds no experiment whose table and recordings can be read: run it again.")
    return drawn


def redraw_identification(
    out: str | os.PathLike[str], folder: Path | None = None, *, formats: Sequence[str] = FORMATS
) -> list[Path]:
    """Draw the pictures of an identification's directory; arguments and errors as for `redraw`."""
    from nermo_mjx.experiments.identification.plots import draw
    from nermo_mjx.experiments.identification.report import RESULT

    path = Path(out) / RESULT
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise DirectoryError(f"{path} cannot be read: run the identification again.") from None
    folder = path.parent / "plots" if folder is None else folder
    make_writable(folder)
    with clear_errors(folder):
        return draw(content, folder, formats)
