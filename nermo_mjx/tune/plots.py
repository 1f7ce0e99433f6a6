"""Which figures a tuning gives: objective, parameters and gradients over the iterations, and its paths."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.figure import Figure

from nermo_mjx.plotting.files import Figures
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.tune import figures as behind
from nermo_mjx.tune.directory import load_tuning
from nermo_mjx.tune.figures import (
    LANDSCAPE,
    Background,
    Traces,
    gradients_figure,
    objective_figure,
    parameters_figure,
    path_figure,
)
from nermo_mjx.tune.history import read_history
from nermo_mjx.tune.spec import Tuning


def figures_of(tuning: Tuning, history: pa.Table, background: Background | None = None) -> Iterator[tuple[str, Figure]]:
    """The figures of a tuning: `objective`, `parameters`, `gradients` where it has some, and `path`.

    Args:
        tuning: that was run.
        history: its table, as `read_history` returns it; in some iteration the robot walked to the end.
        background: the objective's landscape behind the paths.
    """
    traces = Traces.of(tuning, history)
    yield "objective", objective_figure(traces)
    yield "parameters", parameters_figure(traces)
    if tuning.method.has_gradient:
        yield "gradients", gradients_figure(traces)
    yield "path", path_figure(traces, background)


def figures(out: Path) -> Figures:
    """The figures of a tuning's directory, as far as it is complete.

    Raises:
        SpecError: its tuning.yaml cannot be read.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    tuning, history = load_tuning(out), read_history(out)
    if not pc.any(pc.is_finite(history.column("objective"))).as_py():
        raise DirectoryError(
            f"there is nothing to draw of {out}: the robot walked to the end at no point of this tuning."
        )
    return figures_of(tuning, history, _kept(out, tuning, Traces.of(tuning, history)))


def _kept(out: Path, tuning: Tuning, traces: Traces) -> Background | None:
    """The landscape behind the paths, if the directory has the right one."""
    if not behind.has_background(tuning):
        return None
    best = {name: float(np.asarray(traces.column(name))[traces.best]) for name in tuning.names}
    others = {name: best[name] for name in tuning.names if name not in behind.grid_axes(tuning)}
    table = behind.read(out / LANDSCAPE, tuning, others)
    return None if table is None else behind.background_of(tuning, table)
