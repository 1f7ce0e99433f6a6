"""Figures of the straight line: speed over gait, frequency and stride, without and with the spine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from nermo_mjx.experiments.line import Line
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots import orientation
from nermo_mjx.experiments.plots.bars import Bar, axis_label, bar_entries, draw_bars, repeats, spread_note
from nermo_mjx.experiments.plots.marks import (
    CLOCK,
    GAIT,
    SPINE,
    mark_published,
    profile_swatches,
    profiles,
    published,
    published_entry,
    spine_strokes,
    spine_swatches,
    stroke,
    tone,
)
from nermo_mjx.experiments.plots.orientation import gait_page, walked_gaits
from nermo_mjx.experiments.published.measure import clock
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import INK, horizontal_grid

#: Published numbers in these pictures: their figures in the report.
SPEED: Final = "speed of trt, 0.8 Hz, no spine"
GAIN: Final = "speed of trt, 0.8 Hz, spine over none"
OVER_LATERAL: Final = "speed of trt over lat, 0.8 Hz, no spine"


def figures(outcome: Outcome, lines: Sequence[Line]) -> Iterator[tuple[str, Figure | None]]:
    """(name, figure) of each picture; None if the outcome has no data for it."""
    yield "speed", _speed(outcome, lines)
    yield "speed-over-stride", _speed_over_stride(outcome, lines)
    yield from orientation.figures(outcome, lines)


def published_speeds(lines: Sequence[Line]) -> dict[tuple[str, float, bool], float]:
    """Published speed by gait, frequency and spine [mm/s]: one is reported, the others follow from reported ratios."""
    speed, gain, over = (published(lines, figure) for figure in (SPEED, GAIN, OVER_LATERAL))
    found = {}
    if isinstance(speed, float):
        found["trt", 0.8, False] = speed
        if isinstance(gain, float):
            found["trt", 0.8, True] = speed * gain
        if isinstance(over, float):
            found["lat", 0.8, False] = speed / over
    return found


def _speeds(outcome: Outcome, column: str, profile: str, **wanted: object) -> np.ndarray:
    return clock(profile) * repeats(outcome, column, profile=profile, **wanted)


def _speed(outcome: Outcome, lines: Sequence[Line]) -> Figure | None:
    gaits, names, reported = walked_gaits(outcome), profiles(outcome.columns["profile"]), published_speeds(lines)
    if not gaits:
        return None
    page = gait_page("Speed on the straight line", gaits, 1, 3.9)
    drawn: list[Bar] = []
    for ax, (gait, frequencies) in zip(page.axes[0], gaits.items(), strict=True):
        groups = {}
        for f in frequencies:
            case = {"gait": gait, "frequency": f, "stride": 1.0, "compensated": False}
            bars = [
                Bar(
                    _speeds(outcome, "speed", profile, spine=on, **case),
                    tone(SPINE[on], profile),
                    theory=_only(_speeds(outcome, "theory_speed", profile, spine=on, **case)),
                    published=reported.get((gait, f, on)) if profile == names[0] else None,
                )
                for on in (False, True)
                for profile in names
            ]
            groups[f"{f:g}"] = [bar for bar in bars if bar.ran]
        drawn += draw_bars(ax, groups, slots=2 * len(names))
        ax.set(title=GAIT[gait], xlabel="gait frequency [Hz]")
    page.axes[0][0].set_ylabel(axis_label(outcome, "speed", "speed"))
    handles: list[Artist] = [*spine_swatches(), *profile_swatches(names), *bar_entries(drawn)]
    note = f"{spread_note(drawn)}; {CLOCK}; published with spine and of the lateral walk: by its ratios to the trot"
    return page.finish(handles, note)


def _only(values: np.ndarray) -> float:
    """Theory is the same for all repeats."""
    good = values[np.isfinite(values)]
    return float(good[0]) if len(good) else float("nan")


def _speed_over_stride(outcome: Outcome, lines: Sequence[Line]) -> Figure | None:
    rows = outcome.where(gait="trt", frequency=0.8, compensated=False)
    strides = sorted(set(outcome.columns["stride"][rows].tolist()))
    names = profiles(outcome.columns["profile"])
    if len(strides) < 2:
        return None
    page = Page("Speed over the length of the stride: trot at 0.8 Hz", (6.4, 4.6))
    ax = page.axes[0, 0]
    for profile in names:
        for on in (False, True):
            case = {"gait": "trt", "frequency": 0.8, "spine": on, "compensated": False}
            runs = [Bar(_speeds(outcome, "speed", profile, stride=s, **case), "") for s in strides]
            theory = [_only(_speeds(outcome, "theory_speed", profile, stride=s, **case)) for s in strides]
            mean = np.array([run.mean for run in runs])
            colour = tone(SPINE[on], profile)
            ax.plot(strides, mean, "-o", color=colour, ms=5, lw=1.8, zorder=4)
            if max(len(run.values) for run in runs) > 1:
                std = [np.nanstd(run.values) if np.isfinite(run.mean) else np.nan for run in runs]
                ax.errorbar(strides, mean, std, fmt="none", ecolor=INK, elinewidth=0.9, capsize=2, zorder=5)
            if profile == names[0]:
                ax.plot(strides, theory, ":", color=SPINE[on], lw=1.3, zorder=2)
            lost = [s for s, run in zip(strides, runs, strict=True) if run.ran and run.failed]
            ax.plot(lost, [0.02] * len(lost), "x", ms=6, mew=1.6, color=colour, transform=ax.get_xaxis_transform(),
                    gid="failed")  # fmt: skip
    reported = [value for (gait, _, _), value in published_speeds(lines).items() if gait == "trt"]
    for value in reported:
        mark_published(ax, 1.0, value)
    ax.set(xlabel="normalised stride [1]", ylabel=axis_label(outcome, "speed", "speed"))
    ax.margins(y=0.07)
    horizontal_grid(ax)
    handles = [*spine_strokes(marker="o", ms=5), *profile_swatches(names)]
    handles.append(stroke("theory, no slip", INK, ls=":", lw=1.3))
    if reported:
        handles.append(published_entry())
    note = "published with spine: by its ratio to the speed without; a cross at the foot: a repeat without result; "
    return page.finish(handles, note + CLOCK)
