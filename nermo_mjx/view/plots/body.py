"""Motion of the torso: its orientation over time, and its path on the ground."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import FOOT, GRID, INK, LINE, MISSING, MUTED, horizontal_grid
from nermo_mjx.robot import LIMBS
from nermo_mjx.view.plots.walk import Walk, name_of

#: With more gait cycles, the grid of cycles would be a grey area.
_MOST_CYCLES = 30


def orientation(walk: Walk) -> Figure | None:
    """Roll, pitch and yaw over the whole recording."""
    if walk.angles is None:
        return None
    page = Page(f"Orientation of the torso{walk.title}", (7.4, 5.6), 3, 1, sharex=True)
    time = walk.recording.time
    for ax, name, values in zip(page.axes[:, 0], ("roll", "pitch", "yaw"), walk.angles.T, strict=True):
        ax.plot(time, values, color=LINE, lw=1.3, zorder=3)
        ax.set_ylabel(f"{name} [deg]")
        ax.margins(y=0.08)
        horizontal_grid(ax)
        ax.annotate(f"{values.mean():.1f} ± {values.std():.1f}".replace("-", "−"), (1, 1.01), xycoords="axes fraction",
                    ha="right", va="bottom", fontsize=8, color=MUTED)  # fmt: skip
        if walk.cycle is not None and time[-1] < _MOST_CYCLES * walk.cycle:
            for cycle in np.arange(walk.cycle, time[-1], walk.cycle):
                ax.axvline(cycle, color=GRID, lw=0.8, zorder=0)
    page.axes[-1, 0].set(xlabel="time [s]", xlim=(time[0], time[-1]))
    page.figure.align_ylabels(page.axes[:, 0])
    return page.finish(
        [], "positive: leaning left, nose down, turned left; above each: mean ± standard deviation; grid: gait cycles"
    )


def ground_path(walk: Walk) -> Figure | None:
    """The torso's path from above, its mean over a gait cycle, and the footfalls."""
    position = walk.recording.sensors.get("position")
    if position is None:
        return None
    start = np.asarray(position)[0, :2]

    def seen(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(ahead, left) [mm]: x is to the robot's left, y behind it."""
        return -1e3 * (places[..., 1] - start[1]), 1e3 * (places[..., 0] - start[0])

    ahead, left = seen(np.asarray(position))
    feet = walk.recording.sensors.get("foot_position")
    tall = (float(np.ptp(left)) + 120) / (float(np.ptp(ahead)) + 120)
    page = Page(f"Way on the ground, seen from above{walk.title}", (7.4, 1.9 + min(max(6.4 * tall, 1.3), 5.6)))
    ax = page.axes[0, 0]
    handles: list[Artist] = [Line2D([], [], color=INK, lw=0.9, label="torso")]
    ax.plot(ahead, left, color=INK, lw=0.8, zorder=4)
    mean = _cycle_mean(walk, np.asarray(position)[:, :2])
    if len(mean) > 1:
        ax.plot(*seen(mean), color=LINE, lw=2.0, zorder=5)
        handles.append(Line2D([], [], color=LINE, lw=2.0, label="mean over a gait cycle"))
    ax.scatter(ahead[0], left[0], s=50, fc="white", ec=INK, lw=1.4, zorder=6)
    if feet is not None and walk.contact is not None:
        put_down = walk.contact[1:] & ~walk.contact[:-1]
        for i, limb in enumerate(LIMBS):
            ax.scatter(*seen(np.asarray(feet)[1:][put_down[:, i], i]), s=12, color=FOOT[limb], lw=0, zorder=3)
            handles.append(
                Line2D([], [], ls="none", marker="o", ms=4.5, color=FOOT[limb], label=f"{name_of(limb)} foot")
            )
    ax.set_aspect("equal", adjustable="datalim")
    ax.grid(color=MISSING, lw=0.6)
    ax.set_axisbelow(True)
    ax.margins(0.06)
    ax.set(xlabel="ahead of the start [mm]", ylabel="to its left [mm]")
    return page.finish(handles, "the robot starts to the right; ring: start; dots: where a foot is put down")


def _cycle_mean(walk: Walk, places: np.ndarray) -> np.ndarray:
    """Running mean (T', 2) over a gait cycle of positions (T, 2); empty if there is no whole cycle."""
    if walk.cycle is None or len(places) < 2:
        return places[:0]
    ticks = round(walk.cycle / float(np.median(np.diff(walk.recording.time))))
    if ticks < 1 or len(places) <= ticks:
        return places[:0]
    sums = np.cumsum(np.concatenate([np.zeros((1, 2)), places]), axis=0)
    return (sums[ticks:] - sums[:-ticks]) / ticks
