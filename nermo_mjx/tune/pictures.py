"""Figures and video of a finished tuning: plots, the landscape behind its paths, a video of start and best."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.plotting.shown import shown
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout import Run
from nermo_mjx.runs.files import parquet_bytes
from nermo_mjx.sweep.simulating import SimulatorLike
from nermo_mjx.tune import figures
from nermo_mjx.tune.directory import VIDEO, Directory
from nermo_mjx.tune.figures import LANDSCAPE, Background
from nermo_mjx.tune.spec import Tuning
from nermo_mjx.view import RecordingError, VideoError, check_video, recording_of
from nermo_mjx.view.video import Pane, render_side_by_side


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Files made from a tuning's results.

    Attributes:
        plots: figures, as PNG and SVG.
        video: of start and best; None if there is none.
        notes: a sentence about each requested item that could not be made.
    """

    plots: tuple[Path, ...] = ()
    video: Path | None = None
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Painter:
    """Makes the images of one directory; a failure of one does not affect the rest.

    Attributes:
        directory: where they go.
        simulator: creates the simulator for them on first use; None: nothing is simulated.
        drawing: called with what is being made, and the share of it.
    """

    directory: Directory
    simulator: Callable[[], SimulatorLike] | None
    drawing: Callable[[str, float], None]

    def paint(self, history: pa.Table, start: Mapping[str, Any], best: Mapping[str, Any]) -> Pictures:
        """Make the requested figures and video.

        Args:
            history: the tuning's table.
            start, best: the point it began with and the best one, see `nermo_mjx.tune.directory`.
        """
        tuning, notes = self.directory.tuning, []
        plots: list[Path] = []
        if tuning.plots:
            from nermo_mjx.plotting.files import write_figures
            from nermo_mjx.tune.plots import figures_of

            landscape, problem = self._landscape(best["parameters"])
            notes += problem
            self.drawing("plots", 0.0)
            plots = write_figures(figures_of(tuning, history, landscape), self.directory.out / "plots")
        video = None
        if tuning.video and self.simulator is not None:
            video, problem = self._video(start, best)
            notes += problem
        return Pictures(tuple(plots), video, tuple(notes))

    def _landscape(self, best: Mapping[str, float]) -> tuple[Background | None, list[str]]:
        """The objective around the paths, as kept or simulated."""
        tuning = self.directory.tuning
        if self.simulator is None or not figures.has_background(tuning):
            return None, []
        others = {name: best[name] for name in tuning.names if name not in figures.grid_axes(tuning)}
        table = figures.read(self.directory.out / LANDSCAPE, tuning, others)
        if table is None:
            self.drawing("landscape", 0.0)
            try:
                table = figures.simulate(
                    tuning, others, self.simulator(), lambda share: self.drawing("landscape", share)
                )
            except ParameterError as error:
                return None, [f"There is no landscape behind the paths, because some of it cannot be walked: {error}"]
            self.directory.set_aside("of another best point, or damaged", LANDSCAPE)
            self.directory.write(LANDSCAPE, parquet_bytes(table))
        return figures.background_of(tuning, table), []

    def _video(self, start: Mapping[str, Any], best: Mapping[str, Any]) -> tuple[Path | None, list[str]]:
        """The video, as kept or newly made."""

        path = self.directory.out / VIDEO
        if path.exists():
            return path, []
        assert self.simulator is not None
        try:
            check(self.directory.tuning, path)
            self.drawing("video", 0.0)
            return shoot(self.directory.tuning, start, best, self.simulator(), path,
                         lambda share: self.drawing("video", share)), []  # fmt: skip
        except (VideoError, RecordingError) as error:
            return None, [f"There is no video. {error}"]


# ---
# The video of a tuning: its first walk and its best one, side by side.


#: Gait cycles to show, and their maximum duration [s].
CYCLES, LONGEST = 2.0, 4.0
#: Slowed down, so that the spine's timing is visible. A frame takes 0.1 s on one core without a graphics card.
SPEED: Final = 0.5
FPS, WIDTH, HEIGHT = 25, 480, 360
#: From above, the bending of the spine is seen best, and the feet are still visible.
CAMERA: Final = "high"


def check(tuning: Tuning, path: Path) -> None:
    """Raise `VideoError` if this machine cannot make the video, before anything walks for it."""
    check_video(tuning.setup.load().model, path, camera=CAMERA)


def shoot(
    tuning: Tuning,
    start: Mapping[str, Any],
    best: Mapping[str, Any],
    simulator: SimulatorLike,
    path: Path,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Simulate the given start and the best point again, and render both after their warm-up.

    Args:
        start, best: `parameters`, `objective` and `metrics` of each; `iteration` and `start` of the best.
        simulator: that walks them, of the tuning's setup.

    Raises:
        VideoError: this machine cannot draw or encode.
        RecordingError: neither of them has a state that can be shown.
    """
    values = {name: np.full(2, value) for name, value in tuning.constants.items()}
    values |= {name: np.array([start["parameters"][name], best["parameters"][name]]) for name in tuning.names}
    begin, end = _span(tuning, values)
    trace = simulator.run(values, Run(duration=end), record=True).trace
    where = f", start {best['start']}" if tuning.starts > 1 else ""
    titles = ("Start", f"Best, iteration {best['iteration']}{where}")
    model = tuning.setup.load().model
    panes = [
        Pane(recording_of(trace, model, world=i, metadata={}).between(begin, end), title, _caption(tuning, point))
        for i, (title, point) in enumerate(zip(titles, (start, best), strict=True))
    ]
    return render_side_by_side(
        panes, model, path, fps=FPS, width=WIDTH, height=HEIGHT, camera=CAMERA, speed=SPEED,
        progress=None if progress is None else lambda done, frames: progress(done / frames),
    )  # fmt: skip


def _span(tuning: Tuning, values: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """From when to when both walks are shown [s]: some gait cycles after the longer warm-up."""
    rate = tuning.setup.cycle_rate(values)
    begin, end = (float(np.max(each)) for each in tuning.run.seconds(rate))
    shown = min(CYCLES / float(np.min(rate)), LONGEST)
    # A run of a cycle or two is shown from its beginning on.
    begin = max(0.0, min(begin, end - shown))
    return begin, begin + min(shown, end)


def _caption(tuning: Tuning, point: Mapping[str, Any]) -> list[str]:
    """What the objective reads, and below it the parameters, as figures show them."""
    known = tuning.parameters
    known_metrics = tuning.objective_metrics
    metrics = [_text(name, known_metrics[name].unit, point["metrics"][name]) for name in tuning.objective.metrics]
    parameters = [_text(name, known[name].unit, value) for name, value in point["parameters"].items()]
    return [", ".join(metrics), ", ".join(parameters)]


def _text(name: str, unit: str, value: float) -> str:
    quantity = shown(name, unit, np.asarray(value))
    number = f"{float(quantity.values):.3g}" if np.isfinite(value) else "–"
    return f"{name} {number} {quantity.unit}".rstrip()
