"""Figures and video of a finished tuning: plots, the landscape behind its paths, a video of start and best."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.files import parquet_bytes
from nermo_mjx.sweep.simulating import SimulatorLike
from nermo_mjx.tune import background
from nermo_mjx.tune.background import LANDSCAPE, Background
from nermo_mjx.tune.directory import VIDEO, Directory
from nermo_mjx.view import RecordingError, VideoError


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
            start, best: the point it began with and the best one, see `nermo_mjx.tune.outcome`.
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
        if self.simulator is None or not background.has_background(tuning):
            return None, []
        others = {name: best[name] for name in tuning.names if name not in background.grid_axes(tuning)}
        table = background.read(self.directory.out / LANDSCAPE, tuning, others)
        if table is None:
            self.drawing("landscape", 0.0)
            try:
                table = background.simulate(
                    tuning, others, self.simulator(), lambda share: self.drawing("landscape", share)
                )
            except ParameterError as error:
                return None, [f"There is no landscape behind the paths, because some of it cannot be walked: {error}"]
            self.directory.set_aside("of another best point, or damaged", LANDSCAPE)
            self.directory.write(LANDSCAPE, parquet_bytes(table))
        return background.background_of(tuning, table), []

    def _video(self, start: Mapping[str, Any], best: Mapping[str, Any]) -> tuple[Path | None, list[str]]:
        """The video, as kept or newly made."""
        from nermo_mjx.tune.video import check, shoot

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
