"""Figures of turning: speed on quarter circles, time on one, the paths walked, and the smallest radius."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from nermo_mjx.experiments import turning
from nermo_mjx.experiments.line import Line
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots.bars import Bar, axis_label, bar_entries, draw_bars, repeats, spread_note
from nermo_mjx.experiments.plots.marks import (
    CLOCK,
    GAIT,
    STRATEGY,
    Published,
    profile_swatches,
    profiles,
    published,
    seen_from_above,
    shown,
    stroke,
    swatch,
    tone,
)
from nermo_mjx.experiments.published.measure import clock
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import GRID, INK, MISSING
from nermo_mjx.recording import Recording

#: Published numbers in these pictures: their figures in the report, by strategy.
TIME: Final = {name: f"time for 0.5 m, trt, 0.67 Hz, {name}-based" for name in turning.STRATEGIES}
RADIUS: Final = {name: f"smallest radius of trt, {name}-based" for name in ("leg", "mix")}
#: End of the axis of smallest radii [mm].
_WIDEST: Final = 700.0
_NAMES: Final = {"leg": "leg-based", "spine": "spine-based", "mix": "mix-based"}
_SWATCHES: Final = tuple(swatch(_NAMES[name], STRATEGY[name]) for name in turning.STRATEGIES)
_NOT_FOLLOWED: Final = "a repeat did not follow the path"


def figures(outcome: Outcome, lines: Sequence[Line]) -> Iterator[tuple[str, Figure | None]]:
    """(name, figure) of each picture; None if the outcome has no data for it."""
    outcome = _at_stride(outcome)
    yield "speed", _speed(outcome, lines)
    yield "time", _time(outcome, lines)
    yield "smallest-radius", _smallest_radius(outcome, lines)
    yield "paths", _paths(outcome)


def _gaits(outcome: Outcome) -> list[str]:
    return [gait for gait in GAIT if gait in outcome.columns["gait"]]


def _page(title: str, outcome: Outcome, rows: int, height: float) -> Page:
    """A column of axes for each gait."""
    count = len(_gaits(outcome))
    return Page(title, (max(6.4, 1.2 + 3.2 * count), height), rows, count, sharey=True, sharex="col")


def _at_stride(outcome: Outcome) -> Outcome:
    """The rows with the stride of the test; those of the other reading of its text are in the report."""
    rows = outcome.where(stride=turning.STRIDE)
    return dataclasses.replace(outcome, columns={name: values[rows] for name, values in outcome.columns.items()})


def _frequencies(outcome: Outcome, **wanted: object) -> list[float]:
    return sorted(set(outcome.columns["frequency"][outcome.where(**wanted)].tolist()))


def _speed(outcome: Outcome, lines: Sequence[Line]) -> Figure | None:
    present = set(outcome.columns["radius"].tolist())
    radii = [radius for radius in turning.RADII if radius in present]
    if not radii:
        return None
    names = profiles(outcome.columns["profile"])
    page = _page("Speed on quarter circles to the left", outcome, len(radii), 1.3 + 2.5 * len(radii))
    drawn: list[Bar] = []
    for row, radius in zip(page.axes, radii, strict=True):
        for ax, gait in zip(row, _gaits(outcome), strict=True):
            groups = {}
            for f in _frequencies(outcome, radius=radius, gait=gait, side="left"):
                case = {"gait": gait, "frequency": f, "radius": radius, "side": "left"}
                groups[f"{f:g}"] = [
                    _speed_bar(outcome, profile, case, strategy, lines if profile == names[0] else [])
                    for strategy in turning.STRATEGIES
                    for profile in names
                ]
            drawn += draw_bars(ax, groups)
            ax.set_title(f"{GAIT[gait]}, R = {1e3 * radius:g} mm")
        row[0].set_ylabel(axis_label(outcome, "speed", "speed"))
    for ax in page.axes[-1]:
        ax.set_xlabel("gait frequency [Hz]")
    handles: list[Artist] = [*_SWATCHES, *profile_swatches(names), *bar_entries(drawn, hatched=_NOT_FOLLOWED)]
    return page.finish(handles, f"{spread_note(drawn)}; {CLOCK}; published: length of the path over the published time")


def _speed_bar(outcome: Outcome, profile: str, case: dict, strategy: str, lines: Sequence[Line]) -> Bar:
    wanted = {"profile": profile, "strategy": strategy, **case}
    reported: Published = None
    if (case["gait"], case["frequency"], case["radius"]) == ("trt", 0.67, 0.5):
        time = published(lines, TIME[strategy])
        reported = 1e3 * 0.5 * np.pi / 2 / time if isinstance(time, float) else None
    values = clock(profile) * repeats(outcome, "speed", **wanted)
    return Bar(values, tone(STRATEGY[strategy], profile), _strayed(outcome, wanted), published=reported)


def _strayed(outcome: Outcome, wanted: dict) -> bool:
    """Whether a repeat did not follow the path."""
    return not outcome.columns["followed"][outcome.where(**wanted)].all()


def _time(outcome: Outcome, lines: Sequence[Line]) -> Figure | None:
    case = {"gait": "trt", "frequency": 0.67, "radius": 0.5}
    if not outcome.where(**case).any():
        return None
    names = profiles(outcome.columns["profile"])
    page = Page("Time for the quarter circle of 500 mm: trot at 0.67 Hz", (6.4, 4.1), 1, 2, sharey=True)
    drawn: list[Bar] = []
    for ax, side in zip(page.axes[0], turning.SIDES, strict=True):
        groups: dict[str, list[Bar]] = {}
        for strategy in turning.STRATEGIES:
            bars = groups.setdefault(_NAMES[strategy], [])
            for profile in names:
                wanted = {"profile": profile, "strategy": strategy, "side": side, **case}
                values = repeats(outcome, "time", **wanted) / clock(profile)
                reported = published(lines, TIME[strategy]) if profile == names[0] else None
                colour = tone(STRATEGY[strategy], profile)
                bars.append(Bar(values, colour, _strayed(outcome, wanted), published=reported))
        drawn += draw_bars(ax, groups)
        ax.set_title(f"to the {side}")
    page.axes[0, 0].set_ylabel(axis_label(outcome, "time", "time"))
    handles: list[Artist] = [*profile_swatches(names), *bar_entries(drawn, hatched=_NOT_FOLLOWED)]
    return page.finish(handles, f"{spread_note(drawn)}; {CLOCK}")


def _smallest_radius(outcome: Outcome, lines: Sequence[Line]) -> Figure | None:
    if not outcome.where(radius=turning.FULL_LOCK).any():
        return None
    names = profiles(outcome.columns["profile"])
    page = _page("Smallest radius: full lock to the left", outcome, 1, 4.1)
    drawn: list[Bar] = []
    for ax, gait in zip(page.axes[0], _gaits(outcome), strict=True):
        groups: dict[str, list[Bar]] = {}
        for f in _frequencies(outcome, radius=turning.FULL_LOCK, gait=gait, side="left"):
            case = {"gait": gait, "frequency": f, "radius": turning.FULL_LOCK, "side": "left"}
            bars = groups.setdefault(f"{f:g}", [])
            for strategy in turning.STRATEGIES:
                for profile in names:
                    wanted = {"profile": profile, "strategy": strategy, **case}
                    theory = repeats(outcome, "theory_radius", **wanted)
                    first = profile == names[0] and gait == "trt"
                    bars.append(
                        Bar(
                            repeats(outcome, "turning_radius", **wanted),
                            tone(STRATEGY[strategy], profile),
                            theory=float(theory[0]) if len(theory) else np.nan,
                            published=_metres(published(lines, RADIUS.get(strategy, "")) if first else None),
                        )
                    )
        drawn += draw_bars(ax, groups)
        ax.set(title=GAIT[gait], xlabel="gait frequency [Hz]")
    page.axes[0, 0].set_ylabel(axis_label(outcome, "turning_radius", "radius"))
    # A robot with a radius of metres must not flatten the others.
    low, high = page.axes[0, 0].get_ylim()
    page.axes[0, 0].set_ylim(low, min(high, _WIDEST))
    note = (
        f"{spread_note(drawn)}; the publication gives no frequency, so that its mark stands at each; "
        f"the axis ends at {_WIDEST:g} mm"
    )
    return page.finish([*_SWATCHES, *profile_swatches(names), *bar_entries(drawn)], note)


def _metres(value: Published) -> Published:
    """A radius of the report [m], converted to [mm]."""
    if isinstance(value, tuple):
        return 1e3 * value[0], 1e3 * value[1]
    return None if value is None else 1e3 * value


def _paths(outcome: Outcome) -> Figure | None:
    """The recorded paths from above: the torso's, and its mean over each gait cycle."""
    runs = [run for run in outcome.recordings.values() if "strategy" in run.metadata.get("labels", {})]
    if not runs:
        return None
    labels = runs[0].metadata["labels"]
    radius, side = float(labels["radius"]), turning.SIDES[str(labels["side"])]
    title = f"Paths on the quarter circle of {1e3 * radius:g} mm: {GAIT[labels['gait']]} at {labels['frequency']:g} Hz"
    page = Page(title, (6.8, 6.9))
    ax = page.axes[0, 0]
    _course(ax, radius, side)
    for run in runs:
        colour = STRATEGY[str(run.metadata["labels"]["strategy"])]
        walked, mean = _walked(run, radius)
        ax.plot(*seen_from_above(ax, walked), color=colour, lw=0.8, alpha=0.55, zorder=3)
        ax.plot(*seen_from_above(ax, mean), color=colour, lw=2.2, zorder=4)
    ax.grid(color=GRID, lw=0.8)
    ax.margins(0.04)
    bound = 1e3 * float(turning.bound(np.asarray(radius)))
    handles: list[Artist] = [
        *(stroke(_NAMES[name], STRATEGY[name], lw=2.2) for name in turning.STRATEGIES),
        stroke("course", INK, ls="--", lw=1.2), swatch(f"followed: within {bound:g} mm", MISSING),
    ]  # fmt: skip
    note = (
        f"{shown(labels['profile'])}; thick: mean over a gait cycle; thin: the torso's IMU, by which a path is judged"
    )
    return page.finish(handles, note)


def _course(ax: Axes, radius: float, side: float) -> None:
    angle = np.linspace(0, np.pi / 2, 200)

    def arc(r: float) -> np.ndarray:
        return np.stack([side * (radius - r * np.cos(angle)), -r * np.sin(angle)], axis=-1)

    bound = float(turning.bound(np.asarray(radius)))
    edge = np.concatenate([arc(radius - bound), arc(radius + bound)[::-1]])
    ax.add_patch(Polygon(np.stack(seen_from_above(ax, edge), axis=-1), fc=MISSING, lw=0, zorder=1))
    ax.plot(*seen_from_above(ax, arc(radius)), color=INK, ls="--", lw=1.2, zorder=5)


def _walked(run: Recording, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """The torso's path until it passes the quarter circle's end, and its running mean over a gait cycle, (T, 2) [m]."""
    labels = run.metadata["labels"]
    place = np.asarray(run.sensors["position"])[:, :2]
    past = np.flatnonzero(turning.SIDES[str(labels["side"])] * place[:, 0] >= radius)
    place = place[: past[0] + 1] if len(past) else place
    ticks = round(clock(labels["profile"]) / labels["frequency"] / float(np.median(np.diff(run.time))))
    sums = np.cumsum(np.concatenate([np.zeros((1, 2)), place]), axis=0)
    mean = (sums[ticks:] - sums[:-ticks]) / ticks if len(place) > ticks else place[:0]
    return place, mean
