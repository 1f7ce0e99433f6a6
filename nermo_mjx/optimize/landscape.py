"""The landscape behind a tuning's paths: its objective on a grid of one or two parameters, as the rows of a sweep."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from nermo_mjx.optimize.objective import FURTHEST, TRAJECTORY_ERROR
from nermo_mjx.optimize.tuning_spec import Tuning
from nermo_mjx.runs.job import Progress, Watch
from nermo_mjx.runs.rows import Runs
from nermo_mjx.sweep.run import run_sweep
from nermo_mjx.sweep.simulating import SimulatorLike
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.table import Results

# ---
# The landscape behind a tuning's paths: its objective on a grid of one or two parameters, the rows of a sweep.


#: Points along each parameter, by the number of parameters. The ends of a periodic parameter coincide, and are simulated
#: once.
POINTS: Final = {1: 37, 2: 17}


@dataclasses.dataclass(frozen=True)
class Landscape:
    """The objective on a grid.

    Attributes:
        axes: Values (n,) of one or two parameters from bound to bound, by name.
        value: Objective (n,) or (n, m); NaN at points whose walk did not end normally.
        walks: Number of walks, and the engine that simulated them.
    """

    axes: dict[str, np.ndarray]
    value: np.ndarray
    walks: str


def grid_axes(tuning: Tuning) -> dict[str, np.ndarray]:
    """The first one or two tuned parameters, and their values on the grid, both ends included."""
    axes, tuned = {}, tuning.tuned[:2]
    for parameter in tuned:
        # The points of a bounded parameter do not reach the bounds, like the points of the tuner.
        share = np.linspace(0.0, 1.0, POINTS[len(tuned)])
        share = share if parameter.periodic else FURTHEST + (1.0 - 2.0 * FURTHEST) * share
        axes[parameter.name] = parameter.low + (parameter.high - parameter.low) * share
    return axes


def landscape_sweep(tuning: Tuning, best: Mapping[str, float]) -> Sweep:
    """The sweep over the grid.

    Args:
        tuning: Tuning with the walk and the bounds.
        best: Best point, whose values the tuned parameters outside of the grid have.

    Raises:
        SpecError: A point of the grid cannot be simulated.
    """
    axes = grid_axes(tuning)
    periodic = {parameter.name for parameter in tuning.tuned if parameter.periodic}
    others = {name: best[name] for name in tuning.names if name not in axes}
    vary = {
        name: (nodes[:-1] if name in periodic else nodes).tolist() for name, nodes in axes.items()
    }
    changes = {"set": {**tuning.fixed, **others}, "vary": vary, "plots": False}
    return Sweep.from_dict(tuning.walk_fields() | changes)


def landscape_folder(out: Path, sweep: Sweep) -> Path:
    """The directory of a landscape's sweep in the directory of its tuning."""
    return out / "landscape" / sweep.digest()


def read_landscape(tuning: Tuning, sweep: Sweep, out: Path) -> Landscape | None:
    """The landscape, if the directory of the tuning contains all rows of its sweep."""
    parts = Runs(landscape_folder(out, sweep), sweep.digest()).parts
    if sum(part.rows for part in parts) < sweep.variants:
        return None
    results = Results([part.path for part in parts])
    value = tuning.objective.value(dict(results.columns(tuning.objective.metrics)))
    grid = np.where(results.well, np.asarray(value, float), np.nan)
    grid = grid.reshape([len(axis.listed()) for axis in sweep.axes])
    # The last point of a periodic parameter is its first one.
    wraps = [(0, int(parameter.periodic)) for parameter in tuning.tuned[:2]]
    walks = f"{results.rows} walks, engine {parts[0].engine}"
    return Landscape(grid_axes(tuning), np.pad(grid, wraps, mode="wrap"), walks)


def simulate_landscape(
    tuning: Tuning,
    best: Mapping[str, float],
    out: Path,
    simulator: Callable[[], SimulatorLike],
    watch: Watch,
) -> Landscape | None:
    """The landscape of a tuning, whose sweep is simulated if the directory lacks rows of it.

    Args:
        tuning: Tuning with the walk and the bounds.
        best: Best point, see `landscape_sweep`.
        out: Directory of the tuning.
        simulator: Creates the simulator on first use.
        watch: Receives the progress.

    Raises:
        SpecError: A point of the grid cannot be simulated.
    """
    sweep = landscape_sweep(tuning, best)
    landscape = read_landscape(tuning, sweep, out)
    if landscape is not None:
        return landscape

    def progress(done: Progress) -> None:
        watch.progress(Progress(done.fraction, what="landscape"))

    run_sweep(
        sweep,
        landscape_folder(out, sweep),
        watch=dataclasses.replace(watch, progress=progress),
        accept_new_code=True,
        simulator=simulator(),
    )
    return read_landscape(tuning, sweep, out)


def has_landscape(tuning: Tuning) -> bool:
    """Whether the objective needs only metrics of a walk; the comparison with a recording needs MJX."""
    return TRAJECTORY_ERROR not in tuning.objective.metrics
