"""Which figures a tuning's history gives: objective, parameters and gradients over the iterations, and its paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib
import pyarrow as pa

from nermo_mjx.plotting.files import FORMATS, lay_out, write_figure
from nermo_mjx.plotting.style import STYLE
from nermo_mjx.tune.background import Background
from nermo_mjx.tune.figures import gradients_figure, objective_figure, parameters_figure
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
