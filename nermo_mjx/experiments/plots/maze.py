"""Figures of the maze: the paths walked seen from above, the torso's sway along them, and time and speed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator

from nermo_mjx.experiments.line import Line
from nermo_mjx.experiments.maze import FREQUENCY, box_outlines
from nermo_mjx.experiments.maze_course import maze_course
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots.bars import Bar, axis_label, bar_entries, draw_bars, repeats, spread_note
from nermo_mjx.experiments.plots.marks import (
    CLOCK,
    SPINE,
    angles,
    profile_swatches,
    profiles,
    published,
    seen_from_above,
    shown,
    spine_strokes,
    stroke,
    swatch,
    tone,
)
from nermo_mjx.experiments.published.measure import clock
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import INK, MISSING, MUTED, horizontal_grid
from nermo_mjx.recording import Recording
from nermo_mjx.robot import load_robot

#: Published numbers in these pictures: their figures in the report, by column and spine.
NUMBERS: Final = {
    (column, on): f"{name} {'with' if on else 'without'} spine"
    for column, name in (
        (column, column.replace("_", " ")) for column in ("time", "mean_speed", "roll_std", "pitch_std")
    )
    for on in (False, True)
}
_TITLES: Final = {"time": "time", "mean_speed": "mean speed", "roll_std": "roll, std", "pitch_std": "pitch, std"}
#: The part of the walk whose sway is shown, starting at this share of it [s of the controller's clock].
_FROM, _SECONDS = 0.3, 12.0
#: Seconds of the controller's clock between two dots on a path, and samples between two of its points.
_DOTS: Final = 10.0
_THINNED: Final = 4


def figures(outcome: Outcome, lines: Sequence[Line]) -> Iterator[tuple[str, Figure | None]]:
    """(name, figure) of each picture; None if the outcome has no data for it."""
    yield "ways", _ways(outcome)
    yield "sway", _sway(outcome)
    yield "walk", _walk(outcome, lines)


def _runs(outcome: Outcome) -> dict[str, dict[bool, Recording]]:
    """The recordings by profile and spine."""
    found: dict[str, dict[bool, Recording]] = {}
    for run in outcome.recordings.values():
        labels = run.metadata.get("labels", {})
        if {"profile", "spine"} <= set(labels):
            found.setdefault(str(labels["profile"]), {})[bool(labels["spine"])] = run
    return {name: found[name] for name in profiles(found)}


def _ways(outcome: Outcome) -> Figure | None:
    runs = _runs(outcome)
    if not runs:
        return None
    page = Page("Through the maze, seen from above", (0.9 + 6.0 * len(runs), 6.1), 1, len(runs), sharey=True)
    course = maze_course()
    drawn = np.stack([course.x, course.y], axis=-1)
    boxes = box_outlines(load_robot(scene="maze"))
    for ax, (profile, ways) in zip(page.axes[0], runs.items(), strict=True):
        corners = np.stack(seen_from_above(ax, boxes), axis=-1)
        ax.add_collection(PolyCollection(list(corners), fc=MISSING, ec="white", lw=0.8, zorder=1))
        ax.plot(*seen_from_above(ax, drawn), color=INK, ls="--", lw=1.1, zorder=5)
        for on, run in sorted(ways.items()):
            _way(ax, outcome, profile, on, run)
        for name, place in (("start", drawn[0]), ("end", drawn[-1])):
            right, ahead = seen_from_above(ax, place)
            ax.scatter(right, ahead, s=60, marker="o", fc="white", ec=INK, lw=1.6, zorder=6)
            ax.annotate(name, (float(right), float(ahead)), (9, 0), textcoords="offset points", va="center",
                        fontsize=9, fontweight="bold", color=INK)  # fmt: skip
        ax.autoscale_view()
        ax.margins(0.03)
        ax.xaxis.set_major_locator(MultipleLocator(500))
        ax.yaxis.set_major_locator(MultipleLocator(500))
        if len(runs) > 1:
            ax.set_title(shown(profile))
    page.axes[0, 0].set_ylabel("ahead of the start [mm]")
    for ax in page.axes[0][1:]:
        ax.set_ylabel("")
    handles = spine_strokes()
    handles += [
        stroke("course", INK, ls="--", lw=1.1), swatch("boxes", MISSING),
        Line2D([], [], ls="none", marker="o", ms=4.5, color=MUTED, label=f"every {_DOTS:g} s"),
    ]  # fmt: skip
    if not all(np.isfinite(_arrival(outcome, profile, on)) for profile, ways in runs.items() for on in ways):
        handles.append(Line2D([], [], ls="none", marker="X", ms=8, color=MUTED, label="end not reached"))
    return page.finish(handles, "the torso's IMU, first repeat; the robot starts upwards")


def _way(ax: Axes, outcome: Outcome, profile: str, on: bool, run: Recording) -> None:
    time, end = run.time / clock(profile), _arrival(outcome, profile, on)
    walked = time <= end if np.isfinite(end) else np.full(len(time), True)
    right, ahead = seen_from_above(ax, np.asarray(run.sensors["position"])[walked, :2])
    ax.plot(right[::_THINNED], ahead[::_THINNED], color=SPINE[on], lw=1.5, zorder=3 + on)
    dots = np.searchsorted(time[walked], np.arange(_DOTS, time[walked][-1], _DOTS))
    ax.scatter(right[dots], ahead[dots], s=20, color=SPINE[on], ec="white", lw=0.6, zorder=5)
    if not np.isfinite(end):
        ax.scatter(right[-1], ahead[-1], s=80, marker="X", color=SPINE[on], ec="white", lw=0.8, zorder=7, gid="failed")


def _arrival(outcome: Outcome, profile: str, on: bool) -> float:
    """Time at which the recorded run reached the end [s of the controller's clock]; NaN if it did not."""
    return outcome.mean("time", profile=profile, spine=on, repeat=0) / clock(profile)


def _sway(outcome: Outcome) -> Figure | None:
    """Roll and pitch over a part of the walk, starting at the same point of the course."""
    runs = _runs(outcome)
    if not runs:
        return None
    title = f"Sway on the way through the maze: trot at {FREQUENCY:g} Hz"
    page = Page(title, (8.6, 1.5 + 3.6 * len(runs)), 2 * len(runs), 1, sharex=True)
    for i, (profile, ways) in enumerate(runs.items()):
        for on, run in sorted(ways.items()):
            time, end = run.time / clock(profile), _arrival(outcome, profile, on)
            begin = _FROM * (end if np.isfinite(end) else time[-1])
            part = (time >= begin) & (time <= begin + _SECONDS)
            turned = angles(run)[part]
            for ax, angle in zip(page.axes[2 * i : 2 * i + 2, 0], turned.T, strict=False):
                ax.plot(time[part] - begin, angle, color=SPINE[on], lw=1.2)
        for ax, name in zip(page.axes[2 * i : 2 * i + 2, 0], ("roll", "pitch"), strict=True):
            ax.set_ylabel(f"{name} [deg]")
            ax.margins(x=0, y=0.08)
            horizontal_grid(ax)
        if len(runs) > 1:
            page.axes[2 * i, 0].set_title(shown(profile))
    page.axes[-1, 0].set_xlabel("time [s]")
    begins = f"each run from {_FROM:.0%} of its time on".replace("%", " %")
    note = f"first repeat; {begins}; times are those of the controller's clock; positive: leaning left, nose down"
    return page.finish(spine_strokes(), note)


def _walk(outcome: Outcome, lines: Sequence[Line]) -> Figure | None:
    names = profiles(outcome.columns["profile"])
    page = Page("The walk through the maze", (9.6, 4.0), 1, len(_TITLES))
    drawn: list[Bar] = []
    for ax, (column, title) in zip(page.axes[0], _TITLES.items(), strict=True):
        groups = {}
        for on in (False, True):
            groups["with" if on else "without"] = [
                Bar(
                    _clocked(column, profile) * repeats(outcome, column, profile=profile, spine=on),
                    tone(SPINE[on], profile),
                    published=published(lines, NUMBERS[column, on]) if profile == names[0] else None,
                )
                for profile in names
            ]
        drawn += draw_bars(ax, groups)
        ax.set(xlabel="spine", ylabel=axis_label(outcome, column, title))
    note = f"{spread_note(drawn)}; {CLOCK}; the published path is another one of about 5 m"
    return page.finish([*profile_swatches(names), *bar_entries(drawn)], note)


def _clocked(column: str, profile: str) -> float:
    """Factor from simulated time to the controller's clock."""
    return {"time": 1 / clock(profile), "mean_speed": clock(profile)}.get(column, 1.0)
