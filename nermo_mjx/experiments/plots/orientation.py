"""Figures of the straight line: the sway of the torso, without and with the spine, and with compensation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from nermo_mjx.experiments.line import Line
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots.bars import Bar, axis_label, bar_entries, draw_bars, repeats, spread_note
from nermo_mjx.experiments.plots.marks import (
    ANGLES,
    COMPENSATED,
    GAIT,
    SPINE,
    angles,
    profile_swatches,
    profiles,
    published,
    shown,
    spine_strokes,
    spine_swatches,
    stroke,
    swatch,
    tone,
)
from nermo_mjx.experiments.published.measure import clock
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import MISSING, horizontal_grid
from nermo_mjx.recording import Recording

#: Published numbers in these pictures: their figures in the report.
LARGEST_ROLL: Final = "largest roll of trt, 0.8 Hz, spine"
COMPENSATION: Final = {
    "std": "roll std of trt, 0.67 Hz, spine, compensated over not",
    "amplitude": "roll amplitude of trt, 0.67 Hz, spine, compensated over not",
}


def figures(outcome: Outcome, lines: Sequence[Line]) -> Iterator[tuple[str, Figure | None]]:
    """(name, figure) of each picture; None if the outcome has no data for it."""
    yield "orientation", _orientation(outcome, lines)
    yield "orientation-spread", _spread(outcome)
    yield "offset-compensation", _compensation(outcome, lines)


def walked_gaits(outcome: Outcome) -> dict[str, list[float]]:
    """The frequencies walked with each gait at full stride, without compensation."""
    found = {}
    for gait in GAIT:
        rows = outcome.where(gait=gait, stride=1.0, compensated=False)
        if rows.any():
            found[gait] = sorted(set(outcome.columns["frequency"][rows].tolist()))
    return found


def gait_page(title: str, gaits: dict[str, list[float]], rows: int, height: float) -> Page:
    """A column of axes for each gait, with a width proportional to its number of bars."""
    # The lateral walk is run only without the spine, so its groups have half the bars.
    widths = [max(1.2, len(fs) * (0.62 if gait == "lat" else 1.0) + 0.3) for gait, fs in gaits.items()]
    size = (max(7.4, 2.1 + 0.92 * sum(widths)), height)
    return Page(title, size, rows, len(gaits), sharey="row", sharex="col", gridspec_kw={"width_ratios": widths})


def _orientation(outcome: Outcome, lines: Sequence[Line]) -> Figure | None:
    """Roll, pitch and yaw over the last two whole gait cycles of the recordings."""
    runs = [recording for recording in outcome.recordings.values() if "spine" in recording.metadata.get("labels", {})]
    if not runs:
        return None
    labels = runs[0].metadata["labels"]
    title = f"Orientation over two gait cycles: {GAIT[labels['gait']]} at {labels['frequency']:g} Hz"
    page = Page(title, (7.4, 6.6), 3, 1, sharex=True)
    for recording in runs:
        cycles, turned = _last_cycles(recording, 2)
        for ax, angle in zip(page.axes[:, 0], turned.T, strict=True):
            ax.plot(cycles, angle, color=SPINE[bool(recording.metadata["labels"]["spine"])], lw=1.7)
    largest = published(lines, LARGEST_ROLL)
    handles = spine_strokes()
    if isinstance(largest, float):
        for bound in (-largest, largest):
            page.axes[0, 0].axhline(bound, color="black", lw=1.1, ls=(0, (5, 3)), gid="published")
        handles.append(stroke("published range of roll", "black", lw=1.1, ls=(0, (5, 3))))
    for ax, name in zip(page.axes[:, 0], ANGLES, strict=True):
        ax.set_ylabel(f"{name} [deg]")
        ax.set(xlim=(0, 2), xticks=np.arange(0, 2.1, 0.5))
        ax.margins(y=0.08)
        horizontal_grid(ax)
        ax.axvline(1, color=MISSING, lw=0.8, zorder=0)
    page.axes[-1, 0].set_xlabel("gait cycles [1]")
    note = f"{shown(labels['profile'])}; positive: leaning left, nose down, turned left"
    return page.finish(handles, note)  # fmt: skip


def _last_cycles(recording: Recording, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Time in gait cycles, from 0, over the last whole cycles, and the angles (T, 3) [deg]."""
    labels = recording.metadata["labels"]
    cycles = recording.time * labels["frequency"] / clock(labels["profile"])
    begin = max(0.0, np.floor(cycles[-1] + 0.01) - count)
    inside = (cycles >= begin - 1e-9) & (cycles <= begin + count + 1e-9)
    return cycles[inside] - begin, angles(recording)[inside]


def _spread(outcome: Outcome) -> Figure | None:
    gaits, names = walked_gaits(outcome), profiles(outcome.columns["profile"])
    if not gaits:
        return None
    page = gait_page("How far the torso sways: standard deviation of its orientation", gaits, 3, 7.2)
    drawn: list[Bar] = []
    for row, angle in zip(page.axes, ANGLES, strict=True):
        for ax, (gait, frequencies) in zip(row, gaits.items(), strict=True):
            groups = {}
            for f in frequencies:
                case = {"gait": gait, "frequency": f, "stride": 1.0, "compensated": False}
                bars = [
                    Bar(repeats(outcome, f"{angle}_std", profile=profile, spine=on, **case), tone(SPINE[on], profile))
                    for on in (False, True)
                    for profile in names
                ]
                groups[f"{f:g}"] = [bar for bar in bars if bar.ran]
            drawn += draw_bars(ax, groups, slots=2 * len(names))
        row[0].set_ylabel(axis_label(outcome, f"{angle}_std", f"{angle}, std"))
    for ax, gait in zip(page.axes[0], gaits, strict=True):
        ax.set_title(GAIT[gait])
    for ax in page.axes[-1]:
        ax.set_xlabel("gait frequency [Hz]")
    return page.finish([*spine_swatches(), *profile_swatches(names), *bar_entries(drawn)], spread_note(drawn))


def _compensation(outcome: Outcome, lines: Sequence[Line]) -> Figure | None:
    """Roll with the spine, without and with compensation; the published change is applied to the value measured
    here."""
    if not outcome.where(compensated=True).any():
        return None
    names = profiles(outcome.columns["profile"])
    page = Page("Offset compensation: trot at 0.67 Hz with the spine", (6.4, 3.9), 1, 2)
    drawn: list[Bar] = []
    for ax, (measure, figure) in zip(page.axes[0], COMPENSATION.items(), strict=True):
        change = published(lines, figure)
        groups = {}
        for profile in names:
            off, on = (_roll(outcome, measure, profile, compensated) for compensated in (False, True))
            reported = change * Bar(off, "").mean if isinstance(change, float) and len(off) else None
            reported = reported if reported and np.isfinite(reported) else None
            groups[shown(profile)] = [
                Bar(off, tone(SPINE[True], profile)), Bar(on, tone(COMPENSATED, profile), published=reported),
            ]  # fmt: skip
        drawn += draw_bars(ax, groups)
        ax.set_ylabel(axis_label(outcome, "roll_std", f"roll, {measure}"))
    swatches = [swatch("not compensated", SPINE[True]), swatch("compensated", COMPENSATED)]
    note = f"published: its relative change, applied to the bar on the left; {spread_note(drawn)}"
    return page.finish([*swatches, *bar_entries(drawn)], note)


def _roll(outcome: Outcome, measure: str, profile: str, compensated: bool) -> np.ndarray:
    case = {"profile": profile, "gait": "trt", "frequency": 0.67, "spine": True, "compensated": compensated,
            "stride": 1.0}  # fmt: skip
    if measure == "std":
        return repeats(outcome, "roll_std", **case)
    return 0.5 * (repeats(outcome, "roll_max", **case) - repeats(outcome, "roll_min", **case))
