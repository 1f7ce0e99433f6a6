"""The figures of a tuning's directory once more, from its history and the landscape that it keeps."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.compute as pc

from nermo_mjx.plotting.files import FORMATS
from nermo_mjx.runs.files import DirectoryError, clear_errors, make_writable, replace_file
from nermo_mjx.tune import background
from nermo_mjx.tune.background import Background
from nermo_mjx.tune.directory import load_tuning
from nermo_mjx.tune.history import read_history
from nermo_mjx.tune.pictures import LANDSCAPE
from nermo_mjx.tune.plots import draw_plots
from nermo_mjx.tune.spec import Tuning
from nermo_mjx.tune.traces import Traces


def redraw(out: str | os.PathLike[str], folder: Path | None = None, *, formats: Sequence[str] = FORMATS) -> list[Path]:
    """Draw the figures of a tuning's directory, as far as it is finished; nothing is simulated.

    Args:
        out: the directory.
        folder: where the files go; by default its `plots/`.
        formats: of `png` and `svg`.

    Raises:
        SpecError: its tuning.yaml cannot be read.
        DirectoryError: there is nothing to draw, or it cannot be read or written.
    """
    out = Path(out)
    tuning, history = load_tuning(out), read_history(out)
    if not pc.any(pc.is_finite(history.column("objective"))).as_py():
        raise DirectoryError(
            f"there is nothing to draw of {out}: the robot walked to the end at no point of this tuning."
        )
    folder = out / "plots" if folder is None else folder
    make_writable(folder)
    with clear_errors(folder):
        return draw_plots(tuning, history, folder, background=_kept(out, tuning, Traces(tuning, history)),
                          write=replace_file, formats=formats)  # fmt: skip


def _kept(out: Path, tuning: Tuning, traces: Traces) -> Background | None:
    """The landscape behind the paths, if the directory has the right one."""
    if not background.has_background(tuning):
        return None
    best = {name: float(np.asarray(traces.column(name))[traces.best]) for name in tuning.names}
    others = {name: best[name] for name in tuning.names if name not in background.grid_axes(tuning)}
    table = background.read(out / LANDSCAPE, tuning, others)
    return None if table is None else background.background_of(tuning, table)
