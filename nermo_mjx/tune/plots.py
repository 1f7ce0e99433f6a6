"""Which figures a tuning gives: objective, parameters and gradients over the iterations, and its paths."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from nermo_mjx.plotting.files import FORMATS, lay_out, write_figure
from nermo_mjx.plotting.style import STYLE
from nermo_mjx.runs.files import DirectoryError, clear_errors, make_writable, replace_file
from nermo_mjx.tune import background as behind
from nermo_mjx.tune.background import LANDSCAPE, Background
from nermo_mjx.tune.directory import load_tuning
from nermo_mjx.tune.figures import gradients_figure, objective_figure, parameters_figure
from nermo_mjx.tune.history import read_history
from nermo_mjx.tune.path_figure import path_figure
from nermo_mjx.tune.spec import Tuning
from nermo_mjx.tune.traces import Traces


def draw_plots(
    tuning: Tuning,
    history: pa.Table,
    folder: Path,
    *,
    background: Background | None = None,
    write: Callable[[Path, bytes], None] | None = None,
    formats: Sequence[str] = FORMATS,
) -> list[Path]:
    """Draw the figures of a tuning as PNG and SVG: `objective`, `parameters`, `gradients` and `path`.

    Args:
        tuning: that was run.
        history: its table, as `read_history` returns it; in some iteration the robot walked to the end.
        folder: where the files go.
        background: the objective's landscape behind the paths.
        write: how a file is written; `Path.write_bytes` if it is None.
        formats: of `png` and `svg`.

    Returns:
        The files, in the order drawn. The same history gives the same bytes.
    """
    traces = Traces(tuning, history)
    files: list[Path] = []
    folder.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(STYLE):
        drawn = {
            "objective": objective_figure(traces),
            "parameters": parameters_figure(traces),
            "gradients": gradients_figure(traces),
            "path": path_figure(traces, background),
        }
        for name, figure in drawn.items():
            lay_out(figure)
            files += write_figure(figure, folder, name, write, formats)
    return files


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
    if not behind.has_background(tuning):
        return None
    best = {name: float(np.asarray(traces.column(name))[traces.best]) for name in tuning.names}
    others = {name: best[name] for name in tuning.names if name not in behind.grid_axes(tuning)}
    table = behind.read(out / LANDSCAPE, tuning, others)
    return None if table is None else behind.background_of(tuning, table)
