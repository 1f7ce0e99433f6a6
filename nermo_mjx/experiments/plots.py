"""The figures of an experiment, in the form of the published ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import FuncFormatter, MultipleLocator

from nermo_mjx.control.parameters import PROFILES, SIMULATED
from nermo_mjx.experiments import stands, walks
from nermo_mjx.experiments.cases import Outcome
from nermo_mjx.experiments.catalogue import EXPERIMENTS
from nermo_mjx.experiments.directory import Directory
from nermo_mjx.experiments.lines import AGREES, Line, compare
from nermo_mjx.experiments.marks import (
    ANGLES,
    CLOCK,
    COMPENSATED,
    FAIL,
    GAIT,
    PASS,
    SPINE,
    STRATEGY,
    WITH,
    Bar,
    angles,
    axis_label,
    bar_entries,
    draw_bars,
    mark_published,
    only,
    profile_swatches,
    profiles,
    published,
    published_entry,
    repeats,
    seen_from_above,
    shade_phases,
    shown,
    spine_strokes,
    spine_swatches,
    spread_note,
    stroke,
    swatch,
    tone,
)
from nermo_mjx.experiments.measures import clock
from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import BEST, FOOT, GRID, INK, LINE, MISSING, MUTED, SERIES, SHADE, horizontal_grid
from nermo_mjx.recording import Recording
from nermo_mjx.robot import LIMBS, load_robot
from nermo_mjx.robot.parameters import ROUTINGS
from nermo_mjx.runs.files import DirectoryError

Drawn = Iterator[tuple[str, Figure | None]]
Lines = Sequence[Line]


def figures_of(outcome: Outcome, lines: Lines) -> Iterator[tuple[str, Figure]]:
    """(EXPERIMENT-PICTURE, figure) of each picture for which the outcome has data.

    Missing parts (a profile, a case, a recording) are left out of the figures.

    Args:
        outcome: of the experiment.
        lines: of its report, with the published values, which are drawn next to the simulated ones.
    """
    lines = [line for line in lines if line.experiment == outcome.experiment]
    drawers: tuple[Callable[[Outcome, Lines], Drawn], ...] = (_DRAWERS[outcome.experiment], _agreement)
    for drawer in drawers:
        for name, figure in drawer(outcome, lines):
            if figure is not None:
                yield f"{outcome.experiment}-{name}", figure


def figures(out: Path) -> Figures:
    """The images of all experiments that a directory holds.

    Raises:
        DirectoryError: it contains no readable experiment.
    """
    directory = Directory(out)
    found = [stored.outcome for name in EXPERIMENTS if (stored := directory.load(name)) is not None]
    if not found:
        raise DirectoryError(f"{out} holds no experiment whose table and recordings can be read: run it again.")
    return (
        named
        for outcome in found
        for named in figures_of(outcome, compare(outcome, None, EXPERIMENTS[outcome.experiment].figures))
    )


# --- agreement: each number as a fraction of the published one; of an effect, of its size, the ratio minus 1

#: Range of the axis, in shares of the published number; values beyond are arrows at its end.
LEAST, MOST = -0.5, 2.5
_NEAR: Final = "#e6f1f8"
_TONES: Final = {"as_published": LINE, "exact": "#b9cbd8", "as_built": "#8a6fb0", "author": "#444444"}
#: Right ends of the columns of numbers, in widths of the table.
_COLUMNS: Final = {"published": 0.2, "author": 0.4, "as_published": 0.62, "exact": 0.8, "as_built": 1.0}


def _agreement(outcome: Outcome, lines: Lines) -> Drawn:
    """All numbers that were published and measured."""
    lines = [
        line for line in lines
        if _reference(line) is not None and any(_number(getattr(line, name)) is not None for name in PROFILES)
    ]  # fmt: skip
    if not lines:
        return
    title = f"What was published, and what was measured: {outcome.experiment.replace('-', ' ')}"
    page = Page(title, (11.4, 1.5 + 0.255 * len(lines)), 1, 2, sharey=True, gridspec_kw={"width_ratios": [1.2, 1]})
    ax, table = page.axes[0]
    ax.axvspan(1 - AGREES, 1 + AGREES, color=_NEAR, lw=0, zorder=-5)
    ax.axvline(1, color=MUTED, lw=0.8, zorder=0)
    for y, line in enumerate(lines):
        ax.axhline(y, color=GRID, lw=0.8, zorder=-1)
        _agreement_row(ax, table, y, line)
    ax.set_yticks(range(len(lines)), [line.figure for line in lines], fontsize=8.5)
    ax.set_ylim(len(lines) - 0.4, -0.9)
    ax.set_xlim(min(ax.get_xlim()[0], -0.08), MOST + 0.08)
    ax.set_xlabel("measured over published [1]")
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("-", "−")))
    ax.tick_params(axis="y", length=0, labelcolor=INK)
    ax.spines["left"].set_visible(False)
    table.axis("off")
    table.set_xlim(0, 1)
    for name, x in _COLUMNS.items():
        table.text(x, -0.75, shown(name), ha="right", va="center", fontsize=7.5, fontweight="bold", color=MUTED)
    handles: list[Artist] = [published_entry()]
    handles += [stroke(shown(name), colour, ls="none", marker="o", ms=6.5) for name, colour in _TONES.items()]
    handles += [swatch(f"within {AGREES:.0%}".replace("%", " %"), _NEAR)]
    note = (
        "of an effect, a ratio, the share is of the ratio less 1; arrow: beyond the axis; bracket: published as an "
        "interval, of which the diamond is the middle; author: his own model and code; orange: does not hold"
    )
    yield "report", page.finish(handles, note)


def _number(value: Any) -> float | None:
    return None if value is None or isinstance(value, bool | str | list | tuple) else float(value)


def _neutral(line: Line) -> float:
    """The value that counts as 0."""
    return 1.0 if line.rule == "effect" else 0.0


def _reference(line: Line) -> float | None:
    """The value that counts as 1, relative to `_neutral`: the published number, or an interval's middle."""
    if isinstance(line.published, list):
        return float(np.mean(line.published))
    number = _number(line.published)
    return None if number is None else (number - _neutral(line)) or None


def _agreement_row(ax: Axes, table: Axes, y: int, line: Line) -> None:
    reference = _reference(line)
    assert reference is not None
    if isinstance(line.published, list):
        low, high = (end / reference for end in line.published)
        ax.plot([low, min(high, MOST)], [y, y], color="black", lw=1.2, marker="|", ms=7, mew=1.2, zorder=3)
    ax.scatter(1, y, s=34, marker="D", fc="white", ec="black", lw=1.2, zorder=4, gid="published")
    for profile in reversed(_TONES):
        value = _number(getattr(line, profile))
        if value is None or (line.judged_in == "as_built" and profile in SIMULATED):
            continue
        share = (value - _neutral(line)) / reference
        place = min(max(share, LEAST), MOST)
        marker = "o" if share == place else (">" if share > place else "<")
        ax.scatter(place, y, s=46, marker=marker, color=_TONES[profile], ec="white", lw=0.6, zorder=5, gid=profile)
    for name, x in _COLUMNS.items():
        value = getattr(line, name)
        if isinstance(value, list):
            text = f"{min(value):.3g} to {max(value):.3g} {line.unit}".rstrip()
        else:
            number = _number(value)
            text = "–" if number is None else f"{number:.3g} {line.unit}".rstrip().replace("-", "−")
        wrong = name == line.judged_in and line.holds is False
        table.text(x, y, text, ha="right", va="center", fontsize=7, color=BEST if wrong else INK)


# --- straight line

#: Figures of the report whose published numbers are drawn.
SPEED: Final = "speed of trt, 0.8 Hz, no spine"
GAIN: Final = "speed of trt, 0.8 Hz, spine over none"
OVER_LATERAL: Final = "speed of trt over lat, 0.8 Hz, no spine"
LARGEST_ROLL: Final = "largest roll of trt, 0.8 Hz, spine"
COMPENSATION: Final = {
    "std": "roll std of trt, 0.67 Hz, spine, compensated over not",
    "amplitude": "roll amplitude of trt, 0.67 Hz, spine, compensated over not",
}


def _straight_line(outcome: Outcome, lines: Lines) -> Drawn:
    yield "speed", _speed(outcome, lines)
    yield "speed-over-stride", _speed_over_stride(outcome, lines)
    yield "orientation", _orientation(outcome, lines)
    yield "orientation-spread", _spread(outcome)
    yield "offset-compensation", _compensation(outcome, lines)


def _speeds_published(lines: Lines) -> dict[tuple[str, float, bool], float]:
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


def _speeds(outcome: Outcome, column: str, profile: str, **case: object) -> np.ndarray:
    return clock(profile) * repeats(outcome, column, profile=profile, **case)


def _by_gait(
    outcome: Outcome, title: str, rows: int, height: float, bars: Callable[[int, str, str, float, bool], Bar]
) -> tuple[Page, list[Bar]] | None:
    """A column of axes for each gait, with groups of bars for each frequency, profile and spine."""
    names, gaits = profiles(outcome), {}
    for gait in GAIT:
        walked = outcome.where(gait=gait, stride=1.0, compensated=False)
        if walked.any():
            gaits[gait] = sorted(set(outcome.columns["frequency"][walked].tolist()))
    if not gaits:
        return None
    # The lateral walk is run only without the spine, so its groups have half the bars.
    widths = [max(1.2, len(fs) * (0.62 if gait == "lat" else 1.0) + 0.3) for gait, fs in gaits.items()]
    size = (max(7.4, 2.1 + 0.92 * sum(widths)), height)
    page = Page(title, size, rows, len(gaits), sharey="row", sharex="col", gridspec_kw={"width_ratios": widths})
    drawn: list[Bar] = []
    for i, row in enumerate(page.axes):
        for ax, (gait, frequencies) in zip(row, gaits.items(), strict=True):
            made = {
                f"{f:g}": [bars(i, profile, gait, f, on) for on in (False, True) for profile in names]
                for f in frequencies
            }
            groups = {name: [bar for bar in group if len(bar.values)] for name, group in made.items()}
            drawn += draw_bars(ax, groups, slots=2 * len(names))
    for ax, gait in zip(page.axes[0], gaits, strict=True):
        ax.set_title(GAIT[gait])
    for ax in page.axes[-1]:
        ax.set_xlabel("gait frequency [Hz]")
    return page, drawn


def _speed(outcome: Outcome, lines: Lines) -> Figure | None:
    reported, names = _speeds_published(lines), profiles(outcome)

    def bar(_: int, profile: str, gait: str, f: float, on: bool) -> Bar:
        case = {"gait": gait, "frequency": f, "stride": 1.0, "compensated": False, "spine": on}
        theory = only(_speeds(outcome, "theory_speed", profile, **case))
        mark = reported.get((gait, f, on)) if profile == names[0] else None
        return Bar(_speeds(outcome, "speed", profile, **case), tone(SPINE[on], profile), theory=theory, published=mark)

    if (made := _by_gait(outcome, "Speed over the gait frequency", 1, 4.2, bar)) is None:
        return None
    page, drawn = made
    page.axes[0][0].set_ylabel(axis_label(outcome, "speed", "speed"))
    handles: list[Artist] = [*spine_swatches(), *profile_swatches(names), *bar_entries(drawn)]
    note = f"{spread_note(drawn)}; {CLOCK}; published with spine and of the lateral walk: by its ratios to the trot"
    return page.finish(handles, note)


def _speed_over_stride(outcome: Outcome, lines: Lines) -> Figure | None:
    names = profiles(outcome)
    walked = outcome.only(gait="trt", frequency=0.8, compensated=False, profile=names[0])
    strides = sorted(set(walked.columns["stride"].tolist()))
    if len(strides) < 2:
        return None
    page = Page("Speed over the length of the stride: trot at 0.8 Hz", (6.4, 4.6))
    ax = page.axes[0, 0]
    for profile in names:
        for on in (False, True):
            case = {"gait": "trt", "frequency": 0.8, "spine": on, "compensated": False}
            runs = [Bar(_speeds(outcome, "speed", profile, stride=s, **case), "") for s in strides]
            colour = tone(SPINE[on], profile)
            ax.plot(strides, [run.mean for run in runs], "-o", color=colour, ms=5, lw=1.8, zorder=4)
            if profile == names[0]:
                theory = [only(_speeds(outcome, "theory_speed", profile, stride=s, **case)) for s in strides]
                ax.plot(strides, theory, ":", color=SPINE[on], lw=1.3, zorder=2)
            lost = [s for s, run in zip(strides, runs, strict=True) if len(run.values) and run.failed]
            ax.plot(lost, [0.02] * len(lost), "x", ms=6, mew=1.6, color=colour, transform=ax.get_xaxis_transform(),
                    gid="failed")  # fmt: skip
    reported = [value for (gait, _, _), value in _speeds_published(lines).items() if gait == "trt"]
    for value in reported:
        mark_published(ax, 1.0, value)
    ax.set(xlabel="normalised stride [1]", ylabel=axis_label(outcome, "speed", "speed"))
    ax.margins(y=0.07)
    horizontal_grid(ax)
    handles = [*spine_strokes(marker="o", ms=5), *profile_swatches(names), stroke("theory, no slip", INK, ls=":")]
    handles += [published_entry()] if reported else []
    note = "published with spine: by its ratio to the speed without; a cross at the foot: a repeat without result; "
    return page.finish(handles, note + CLOCK)


def _orientation(outcome: Outcome, lines: Lines) -> Figure | None:
    """Roll, pitch and yaw over the last two whole gait cycles of the recordings."""
    runs = [recording for recording in outcome.recordings.values() if "spine" in recording.metadata.get("labels", {})]
    if not runs:
        return None
    labels = runs[0].metadata["labels"]
    title = f"Orientation over two gait cycles: {GAIT[labels['gait']]} at {labels['frequency']:g} Hz"
    page = Page(title, (7.4, 6.6), 3, 1, sharex=True)
    for run in runs:
        cycles = run.time * labels["frequency"] / clock(labels["profile"])
        begin = max(0.0, np.floor(cycles[-1] + 0.01) - 2)
        inside = (cycles >= begin - 1e-9) & (cycles <= begin + 2 + 1e-9)
        for ax, angle in zip(page.axes[:, 0], angles(run)[inside].T, strict=True):
            ax.plot(cycles[inside] - begin, angle, color=SPINE[bool(run.metadata["labels"]["spine"])], lw=1.7)
    largest, handles = published(lines, LARGEST_ROLL), spine_strokes()
    if isinstance(largest, float):
        for edge in (-largest, largest):
            page.axes[0, 0].axhline(edge, color="black", lw=1.1, ls=(0, (5, 3)), gid="published")
        handles.append(stroke("published range of roll", "black", lw=1.1, ls=(0, (5, 3))))
    for ax, name in zip(page.axes[:, 0], ANGLES, strict=True):
        ax.set(ylabel=f"{name} [deg]", xlim=(0, 2), xticks=np.arange(0, 2.1, 0.5))
        ax.margins(y=0.08)
        horizontal_grid(ax)
        ax.axvline(1, color=MISSING, lw=0.8, zorder=0)
    page.axes[-1, 0].set_xlabel("gait cycles [1]")
    return page.finish(handles, f"{shown(labels['profile'])}; positive: leaning left, nose down, turned left")


def _spread(outcome: Outcome) -> Figure | None:
    def bar(i: int, profile: str, gait: str, f: float, on: bool) -> Bar:
        case = {"gait": gait, "frequency": f, "stride": 1.0, "compensated": False, "spine": on}
        return Bar(repeats(outcome, f"{ANGLES[i]}_std", profile=profile, **case), tone(SPINE[on], profile))

    title = "How far the torso sways: standard deviation of its orientation"
    if (made := _by_gait(outcome, title, 3, 7.2, bar)) is None:
        return None
    page, drawn = made
    for row, angle in zip(page.axes, ANGLES, strict=True):
        row[0].set_ylabel(axis_label(outcome, f"{angle}_std", f"{angle}, std"))
    return page.finish(
        [*spine_swatches(), *profile_swatches(profiles(outcome)), *bar_entries(drawn)], spread_note(drawn)
    )


def _compensation(outcome: Outcome, lines: Lines) -> Figure | None:
    """Roll with the spine, without and with compensation; the published change is applied to the value measured
    here."""
    if not outcome.where(compensated=True).any():
        return None
    page = Page("Offset compensation: trot at 0.67 Hz with the spine", (6.4, 3.9), 1, 2)
    drawn: list[Bar] = []
    for ax, (measure, figure) in zip(page.axes[0], COMPENSATION.items(), strict=True):
        change, groups = published(lines, figure), {}
        for profile in profiles(outcome):
            case = {"profile": profile, "gait": "trt", "frequency": 0.67, "spine": True, "stride": 1.0}
            off, on = (
                repeats(outcome, "roll_std", compensated=each, **case) if measure == "std" else
                0.5 * (repeats(outcome, "roll_max", compensated=each, **case)
                       - repeats(outcome, "roll_min", compensated=each, **case))
                for each in (False, True)
            )  # fmt: skip
            mean = Bar(off, "").mean
            mark = change * mean if isinstance(change, float) and np.isfinite(mean) else None
            bars = [Bar(off, tone(SPINE[True], profile)), Bar(on, tone(COMPENSATED, profile), published=mark)]
            groups[shown(profile)] = bars
        drawn += draw_bars(ax, groups)
        ax.set_ylabel(axis_label(outcome, "roll_std", f"roll, {measure}"))
    swatches = [swatch("not compensated", SPINE[True]), swatch("compensated", COMPENSATED)]
    note = f"published: its relative change, applied to the bar on the left; {spread_note(drawn)}"
    return page.finish([*swatches, *bar_entries(drawn)], note)


# --- turning

TIME: Final = {name: f"time for 0.5 m, trt, 0.67 Hz, {name}-based" for name in walks.STRATEGIES}
RADIUS: Final = {name: f"smallest radius of trt, {name}-based" for name in ("leg", "mix")}
#: End of the axis of smallest radii [mm].
_WIDEST: Final = 700.0
_BASED: Final = {name: f"{name}-based" for name in walks.STRATEGIES}
_NOT_FOLLOWED: Final = "a repeat did not follow the path"


def _turning(outcome: Outcome, lines: Lines) -> Drawn:
    yield "speed", _turn_speed(outcome, lines)
    yield "time", _turn_time(outcome, lines)
    yield "smallest-radius", _smallest_radius(outcome, lines)
    yield "paths", _paths(outcome)


def _turn_bars(
    outcome: Outcome, title: str, radii: Sequence[float], height: float, bar: Callable[..., Bar]
) -> tuple[Page, list[Bar]] | None:
    """A row of axes for each radius, a column for each gait, with groups of bars for each frequency."""
    names = profiles(outcome)
    radii = [radius for radius in radii if outcome.where(radius=radius, side="left").any()]
    gaits = [gait for gait in GAIT if gait in outcome.columns["gait"]]
    if not radii:
        return None
    page = Page(title, (max(6.4, 1.2 + 3.2 * len(gaits)), height * len(radii) + 1.3), len(radii), len(gaits),
                sharey=True, sharex="col")  # fmt: skip
    drawn: list[Bar] = []
    for row, radius in zip(page.axes, radii, strict=True):
        for ax, gait in zip(row, gaits, strict=True):
            case = {"gait": gait, "radius": radius, "side": "left"}
            walked = sorted(set(outcome.columns["frequency"][outcome.where(**case)].tolist()))
            drawn += draw_bars(ax, {
                f"{f:g}": [bar({**case, "frequency": f, "strategy": strategy, "profile": profile})
                           for strategy in walks.STRATEGIES for profile in names]
                for f in walked
            })  # fmt: skip
            ax.set_title(GAIT[gait] + (f", R = {1e3 * radius:g} mm" if radius else ""))
    for ax in page.axes[-1]:
        ax.set_xlabel("gait frequency [Hz]")
    return page, drawn


def _legend(outcome: Outcome, drawn: Sequence[Bar]) -> list[Artist]:
    strategies = [swatch(_BASED[name], STRATEGY[name]) for name in walks.STRATEGIES]
    return [*strategies, *profile_swatches(profiles(outcome)), *bar_entries(drawn, hatched=_NOT_FOLLOWED)]


def _strayed(outcome: Outcome, wanted: dict[str, Any]) -> bool:
    """Whether a repeat did not follow the path."""
    return not outcome.columns["followed"][outcome.where(**wanted)].all()


def _turn_speed(outcome: Outcome, lines: Lines) -> Figure | None:
    def bar(wanted: dict[str, Any]) -> Bar:
        profile, mark = wanted["profile"], None
        at = (wanted["gait"], wanted["frequency"], wanted["radius"], profile)
        if at == ("trt", 0.67, 0.5, "as_published") and isinstance(
            time := published(lines, TIME[wanted["strategy"]]), float
        ):
            mark = 1e3 * 0.5 * np.pi / 2 / time
        values = clock(profile) * repeats(outcome, "speed", **wanted)
        return Bar(values, tone(STRATEGY[wanted["strategy"]], profile), _strayed(outcome, wanted), published=mark)

    if (made := _turn_bars(outcome, "Speed on quarter circles to the left", walks.RADII, 2.5, bar)) is None:
        return None
    page, drawn = made
    for row in page.axes:
        row[0].set_ylabel(axis_label(outcome, "speed", "speed"))
    note = f"{spread_note(drawn)}; {CLOCK}; published: length of the path over the published time"
    return page.finish(_legend(outcome, drawn), note)


def _turn_time(outcome: Outcome, lines: Lines) -> Figure | None:
    case = {"gait": "trt", "frequency": 0.67, "radius": 0.5}
    if not outcome.where(**case).any():
        return None
    names = profiles(outcome)
    page = Page("Time for the quarter circle of 500 mm: trot at 0.67 Hz", (6.4, 4.1), 1, 2, sharey=True)
    drawn: list[Bar] = []
    for ax, side in zip(page.axes[0], walks.SIDES, strict=True):
        groups: dict[str, list[Bar]] = {}
        for strategy in walks.STRATEGIES:
            for profile in names:
                wanted = {"profile": profile, "strategy": strategy, "side": side, **case}
                mark = published(lines, TIME[strategy]) if profile == names[0] else None
                values = repeats(outcome, "time", **wanted) / clock(profile)
                bar = Bar(values, tone(STRATEGY[strategy], profile), _strayed(outcome, wanted), published=mark)
                groups.setdefault(_BASED[strategy], []).append(bar)
        drawn += draw_bars(ax, groups)
        ax.set_title(f"to the {side}")
    page.axes[0, 0].set_ylabel(axis_label(outcome, "time", "time"))
    handles: list[Artist] = [*profile_swatches(names), *bar_entries(drawn, hatched=_NOT_FOLLOWED)]
    return page.finish(handles, f"{spread_note(drawn)}; {CLOCK}")


def _smallest_radius(outcome: Outcome, lines: Lines) -> Figure | None:
    names = profiles(outcome)

    def bar(wanted: dict[str, Any]) -> Bar:
        profile, strategy = wanted["profile"], wanted["strategy"]
        value = published(lines, RADIUS.get(strategy, "")) if (wanted["gait"], profile) == ("trt", names[0]) else None
        mark = 1e3 * value if isinstance(value, float) else None
        theory = only(repeats(outcome, "theory_radius", **wanted))
        colour = tone(STRATEGY[strategy], profile)
        return Bar(repeats(outcome, "turning_radius", **wanted), colour, theory=theory, published=mark)

    if (made := _turn_bars(outcome, "Smallest radius: full lock to the left", [walks.FULL_LOCK], 2.8, bar)) is None:
        return None
    page, drawn = made
    page.axes[0, 0].set_ylabel(axis_label(outcome, "turning_radius", "radius"))
    # A robot with a radius of metres must not flatten the others.
    low, high = page.axes[0, 0].get_ylim()
    page.axes[0, 0].set_ylim(low, min(high, _WIDEST))
    note = (
        f"{spread_note(drawn)}; the publication gives no frequency, so that its mark stands at each; "
        f"the axis ends at {_WIDEST:g} mm"
    )
    return page.finish(_legend(outcome, drawn), note)


def _paths(outcome: Outcome) -> Figure | None:
    """The recorded paths from above: the torso's, and its mean over each gait cycle."""
    runs = [run for run in outcome.recordings.values() if "strategy" in run.metadata.get("labels", {})]
    if not runs:
        return None
    labels = runs[0].metadata["labels"]
    radius, side = float(labels["radius"]), walks.SIDES[str(labels["side"])]
    bound = float(walks.bound(np.asarray(radius)))
    title = f"Paths on the quarter circle of {1e3 * radius:g} mm: {GAIT[labels['gait']]} at {labels['frequency']:g} Hz"
    page = Page(title, (6.8, 6.9))
    ax, angle = page.axes[0, 0], np.linspace(0, np.pi / 2, 200)

    def arc(r: float) -> np.ndarray:
        return np.stack([side * (radius - r * np.cos(angle)), -r * np.sin(angle)], axis=-1)

    edge = np.concatenate([arc(radius - bound), arc(radius + bound)[::-1]])
    ax.add_patch(Polygon(np.stack(seen_from_above(ax, edge), axis=-1), fc=MISSING, lw=0, zorder=1))
    ax.plot(*seen_from_above(ax, arc(radius)), color=INK, ls="--", lw=1.2, zorder=5)
    for run in runs:
        colour = STRATEGY[str(run.metadata["labels"]["strategy"])]
        walked, mean = _walked(run, radius)
        ax.plot(*seen_from_above(ax, walked), color=colour, lw=0.8, alpha=0.55, zorder=3)
        ax.plot(*seen_from_above(ax, mean), color=colour, lw=2.2, zorder=4)
    ax.grid(color=GRID, lw=0.8)
    ax.margins(0.04)
    handles: list[Artist] = [
        *(stroke(_BASED[name], STRATEGY[name], lw=2.2) for name in walks.STRATEGIES),
        stroke("course", INK, ls="--", lw=1.2), swatch(f"followed: within {1e3 * bound:g} mm", MISSING),
    ]  # fmt: skip
    note = "thick: mean over a gait cycle; thin: the torso's IMU, by which a path is judged"
    return page.finish(handles, f"{shown(labels['profile'])}; {note}")


def _walked(run: Recording, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """The torso's path until it passes the quarter circle's end, and its running mean over a gait cycle, (T, 2) [m]."""
    labels = run.metadata["labels"]
    place = np.asarray(run.sensors["position"])[:, :2]
    past = np.flatnonzero(walks.SIDES[str(labels["side"])] * place[:, 0] >= radius)
    place = place[: past[0] + 1] if len(past) else place
    ticks = round(clock(labels["profile"]) / labels["frequency"] / float(np.median(np.diff(run.time))))
    sums = np.cumsum(np.concatenate([np.zeros((1, 2)), place]), axis=0)
    return place, (sums[ticks:] - sums[:-ticks]) / ticks if len(place) > ticks else place[:0]


# --- balance

_SBC: Final = {False: "without compensation", True: "with compensation"}
_VERDICT: Final = {"pass": PASS, "fail": FAIL}


def _balance(outcome: Outcome, lines: Lines) -> Drawn:
    yield "verdicts", _verdicts(outcome, lines)
    yield "pitch", _over_time(outcome, "pitch", "Pitch while a leg is lifted and swung", "pitch [deg]", 180 / np.pi)
    title = "Centre of mass inside of the support diagonal"
    yield "stability", _over_time(outcome, "com_margin", title, "distance inside [mm]", 1e3)
    yield "forces", _forces(outcome)
    yield "forces-by-phase", _forces_by_phase(outcome)


def _leg(limb: str) -> str:
    return limb.replace("_", " ")


def _lifts(outcome: Outcome, sensor: str) -> dict[tuple[str, bool], Recording]:
    """The recordings with a sensor, by lifted leg and compensation."""
    found = {}
    for run in outcome.recordings.values():
        case = run.metadata.get("metrics", {})
        if {"leg", "sbc"} <= set(case) and sensor in run.sensors:
            found[str(case["leg"]), bool(case["sbc"])] = run
    return found


def _profile_of(runs: Mapping[Any, Recording]) -> str:
    return shown(str(next(iter(runs.values())).metadata["metrics"].get("profile", "")))


def _verdicts(outcome: Outcome, lines: Lines) -> Figure:
    """One tile per leg and source; a tile that differs from the publication's in its set-up has a thick frame."""
    told = {line.figure: line.published for line in lines}
    names = [name for name in PROFILES if name in outcome.columns["profile"]]
    page = Page("Which legs the robot can lift and swing", (10.4, 3.9), 1, 2, sharey=True)
    for ax, sbc in zip(page.axes[0], (False, True), strict=True):
        columns = ["published\nsimulation", *(shown(name).replace(" ", "\n") for name in names), "published\nhardware"]
        for row, limb in enumerate(LIMBS):
            simulated = told.get(f"{_leg(limb)} lifted, {'with' if sbc else 'without'} balance compensation")
            hardware = told.get(f"hardware: {_leg(limb)} lifted, {'with' if sbc else 'without'} compensation")
            tiles = [(simulated, simulated)]
            for profile in names:
                passed = outcome.columns["passed"][outcome.where(profile=profile, leg=limb, sbc=sbc)]
                n = int(passed.sum())
                verdict = {len(passed): "pass", 0: "fail"}.get(n, f"{n} of {len(passed)}") if len(passed) else None
                tiles.append((verdict, hardware if profile == "as_built" else simulated))
            for column, (tile, wanted) in enumerate([*tiles, (hardware, hardware)]):
                _tile(ax, column, row, str(tile or "–"), framed=bool(wanted and tile and tile != wanted))
        ax.set_xticks(range(len(columns)), columns, fontsize=8.5)
        ax.set_yticks(range(len(LIMBS)), [f"{_leg(limb)} leg" for limb in LIMBS])
        ax.tick_params(length=0, labelcolor=INK)
        ax.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(LIMBS) - 0.5, -0.5), title=_SBC[sbc])
        for spine in ax.spines.values():
            spine.set_visible(False)
    handles: list[Artist] = [swatch(name, colour) for name, colour in _VERDICT.items()]
    handles.append(swatch("not as published (as built: the hardware)", "white", ec="black", lw=1.8))
    return page.finish(handles, "pass: upright, and the lifted foot off the ground; all repeats of a case count")


def _tile(ax: Axes, column: int, row: int, text: str, *, framed: bool) -> None:
    ax.add_patch(Rectangle((column - 0.46, row - 0.44), 0.92, 0.88, fc=_VERDICT.get(text, SHADE), lw=0))
    if framed:
        frame = Rectangle(
            (column - 0.45, row - 0.43), 0.9, 0.86, fc="none", ec="black", lw=1.8, zorder=4, gid="differs"
        )
        ax.add_patch(frame)
    ax.text(column, row, text, ha="center", va="center", fontsize=9, color=INK)


def _over_time(outcome: Outcome, sensor: str, title: str, label: str, factor: float) -> Figure | None:
    """One reading over time, with axes per lifted leg, and lines without and with compensation."""
    runs = _lifts(outcome, sensor)
    if not runs:
        return None
    page = Page(title, (9.4, 5.9), 2, 2, sharex=True, sharey="row")
    handles: list[Artist] = [stroke(_SBC[sbc], SPINE[sbc], lw=1.7) for sbc in (False, True)]
    for ax, limb in zip(page.axes.ravel(), LIMBS, strict=True):
        for sbc in (False, True):
            if (limb, sbc) in runs:
                run = runs[limb, sbc]
                ax.plot(run.time, factor * np.asarray(run.sensors[sensor]), color=SPINE[sbc], lw=1.7, zorder=3 + sbc)
                shade_phases(ax, run.metadata["phases"], named=not sbc or (limb, False) not in runs)
        ax.set_title(f"{_leg(limb)} leg", pad=16)
        ax.margins(y=0.08)
        horizontal_grid(ax)
        if sensor == "com_margin":
            low = min(ax.get_ylim()[0], -2.0)
            ax.axhspan(low, 0, color=FAIL, alpha=0.45, lw=0, zorder=-4)
            ax.axhline(0, color=INK, lw=1.1)
            ax.set_ylim(bottom=low)
    if sensor == "com_margin":
        handles += [stroke("support diagonal", INK, lw=1.1), swatch("beyond it the robot tips", FAIL, alpha=0.45)]
    for ax in page.axes[:, 0]:
        ax.set_ylabel(label)
    for ax in page.axes[-1]:
        ax.set_xlabel("time [s]")
    sign = "positive: nose down; " if sensor == "pitch" else ""
    return page.finish(handles, f"{_profile_of(runs)}, first repeat; {sign}compensation bends the spine in the shift")


def _forces(outcome: Outcome) -> Figure | None:
    runs = _lifts(outcome, "foot_force")
    if not runs:
        return None
    page = Page("Forces on the feet over time", (9.4, 9.2), len(LIMBS), 2, sharex=True, sharey=True)
    highest = max(float(np.nanpercentile(run.sensors["foot_force"], 99.5)) for run in runs.values())
    for row, limb in zip(page.axes, LIMBS, strict=True):
        for ax, sbc in zip(row, (False, True), strict=True):
            ax.set_title(f"{_leg(limb)} leg, {_SBC[sbc]}", pad=16)
            ax.set_ylim(-0.03 * highest, 1.12 * highest)
            ax.grid(axis="y", color=GRID, lw=0.8)
            if (limb, sbc) in runs:
                run = runs[limb, sbc]
                for foot, force in zip(LIMBS, np.asarray(run.sensors["foot_force"]).T, strict=True):
                    ax.plot(run.time, force, color=FOOT[foot], lw=2.0 if foot == limb else 1.2, zorder=3)
                shade_phases(ax, run.metadata["phases"])
        row[0].set_ylabel("force [N]")
    for ax in page.axes[-1]:
        ax.set_xlabel("time [s]")
    handles: list[Artist] = [stroke(f"{_leg(foot)} foot", FOOT[foot], lw=1.8) for foot in LIMBS]
    note = f"{_profile_of(runs)}, first repeat; thick: the lifted foot; impacts above the axes are cut off"
    return page.finish(handles, note)


def _forces_by_phase(outcome: Outcome) -> Figure | None:
    profile = profiles(outcome)[0]
    phases = [phase for phase in ("stand", "shift", "lift", "swing") if f"force_{phase}_{LIMBS[0]}" in outcome.columns]
    if not phases:
        return None
    page = Page("Mean forces on the feet in each phase", (10.4, 5.9), 2, len(LIMBS), sharex=True, sharey=True)
    drawn: list[Bar] = []
    for row, sbc in zip(page.axes, (False, True), strict=True):
        for ax, limb in zip(row, LIMBS, strict=True):
            drawn += draw_bars(ax, {
                phase: [Bar(repeats(outcome, f"force_{phase}_{foot}", profile=profile, leg=limb, sbc=sbc), FOOT[foot])
                        for foot in LIMBS]
                for phase in phases
            })  # fmt: skip
            ax.set_title(f"{_leg(limb)} leg,\n{_SBC[sbc]}")
        row[0].set_ylabel("force [N]")
    handles: list[Artist] = [*(swatch(f"{_leg(foot)} foot", FOOT[foot]) for foot in LIMBS), *bar_entries(drawn)]
    return page.finish(handles, f"{shown(profile)}; {spread_note(drawn)}")


# --- maze

_TITLES: Final = {"time": "time", "mean_speed": "mean speed", "roll_std": "roll, std", "pitch_std": "pitch, std"}
#: The part of the walk whose sway is shown, starting at this share of it [s of the controller's clock].
_FROM, _SECONDS = 0.3, 12.0
#: Seconds of the controller's clock between two dots on a path, and samples between two of its points.
_DOTS, _THINNED = 10.0, 4


def _maze(outcome: Outcome, lines: Lines) -> Drawn:
    runs: dict[str, dict[bool, Recording]] = {}
    for run in outcome.recordings.values():
        labels = run.metadata.get("labels", {})
        if {"profile", "spine"} <= set(labels):
            runs.setdefault(str(labels["profile"]), {})[bool(labels["spine"])] = run
    ordered = {name: runs[name] for name in (*reversed(SIMULATED), "as_built") if name in runs}
    yield "ways", _ways(outcome, ordered) if ordered else None
    yield "sway", _sway(outcome, ordered) if ordered else None
    yield "walk", _maze_walk(outcome, lines)


def _arrival(outcome: Outcome, profile: str, on: bool) -> float:
    """Time at which the recorded run reached the end [s of the controller's clock]; NaN if it did not."""
    return outcome.mean("time", profile=profile, spine=on, repeat=0) / clock(profile)


def _ways(outcome: Outcome, runs: Mapping[str, Mapping[bool, Recording]]) -> Figure:
    page = Page("Through the maze, seen from above", (0.9 + 5.2 * len(runs), 5.6), 1, len(runs), sharey=True)
    course = walks.maze_course()
    drawn = np.stack([course.x, course.y], axis=-1)
    boxes = walks.box_outlines(load_robot(scene="maze"))
    for ax, (profile, ways) in zip(page.axes[0], runs.items(), strict=True):
        corners = np.stack(seen_from_above(ax, boxes), axis=-1)
        ax.add_collection(PolyCollection(list(corners), fc=MISSING, ec="white", lw=0.8, zorder=1))
        ax.plot(*seen_from_above(ax, drawn), color=INK, ls="--", lw=1.1, zorder=5)
        for on, run in sorted(ways.items()):
            _way(ax, _arrival(outcome, profile, on), profile, on, run)
        for name, place in (("start", drawn[0]), ("end", drawn[-1])):
            right, ahead = seen_from_above(ax, place)
            ax.scatter(right, ahead, s=60, marker="o", fc="white", ec=INK, lw=1.6, zorder=6)
            ax.annotate(name, (float(right), float(ahead)), (9, 0), textcoords="offset points", va="center",
                        fontsize=9, fontweight="bold", color=INK)  # fmt: skip
        ax.autoscale_view()
        ax.margins(0.03)
        ax.xaxis.set_major_locator(MultipleLocator(500))
        ax.yaxis.set_major_locator(MultipleLocator(500))
        ax.set_title(shown(profile))
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


def _way(ax: Axes, end: float, profile: str, on: bool, run: Recording) -> None:
    time = run.time / clock(profile)
    walked = time <= end if np.isfinite(end) else np.full(len(time), True)
    right, ahead = seen_from_above(ax, np.asarray(run.sensors["position"])[walked, :2])
    ax.plot(right[::_THINNED], ahead[::_THINNED], color=SPINE[on], lw=1.5, zorder=3 + on)
    dots = np.searchsorted(time[walked], np.arange(_DOTS, time[walked][-1], _DOTS))
    ax.scatter(right[dots], ahead[dots], s=20, color=SPINE[on], ec="white", lw=0.6, zorder=5)
    if not np.isfinite(end):
        ax.scatter(right[-1], ahead[-1], s=80, marker="X", color=SPINE[on], ec="white", lw=0.8, zorder=7, gid="failed")


def _sway(outcome: Outcome, runs: Mapping[str, Mapping[bool, Recording]]) -> Figure:
    """Roll and pitch over a part of the walk, starting at the same point of the course."""
    page = Page("How the torso sways in the maze", (9.4, 1.2 + 2.6 * len(runs)), 2 * len(runs), 1, sharex=True)
    for i, (profile, ways) in enumerate(runs.items()):
        pair = page.axes[2 * i : 2 * i + 2, 0]
        for on, run in sorted(ways.items()):
            time, end = run.time / clock(profile), _arrival(outcome, profile, on)
            begin = _FROM * (end if np.isfinite(end) else time[-1])
            part = (time >= begin) & (time <= begin + _SECONDS)
            for ax, angle in zip(pair, angles(run)[part].T, strict=False):
                ax.plot(time[part] - begin, angle, color=SPINE[on], lw=1.2)
        for ax, name in zip(pair, ("roll", "pitch"), strict=True):
            ax.set_ylabel(f"{name} [deg]")
            ax.margins(x=0, y=0.08)
            horizontal_grid(ax)
        pair[0].set_title(shown(profile))
    page.axes[-1, 0].set_xlabel("time [s]")
    begins = f"each run from {_FROM:.0%} of its time on".replace("%", " %")
    note = f"first repeat; {begins}; times are those of the controller's clock; positive: leaning left, nose down"
    return page.finish(spine_strokes(), note)


def _maze_walk(outcome: Outcome, lines: Lines) -> Figure | None:
    names = profiles(outcome)
    page = Page("The walk through the maze", (9.6, 4.0), 1, len(_TITLES))
    drawn: list[Bar] = []
    for ax, (column, title) in zip(page.axes[0], _TITLES.items(), strict=True):
        groups: dict[str, list[Bar]] = {}
        for on in (False, True):
            for profile in names:
                factor = {"time": 1 / clock(profile), "mean_speed": clock(profile)}.get(column, 1.0)
                mark = published(lines, f"{column.replace('_', ' ')} {WITH[on]}") if profile == names[0] else None
                values = factor * repeats(outcome, column, profile=profile, spine=on)
                groups.setdefault("with" if on else "without", []).append(
                    Bar(values, tone(SPINE[on], profile), published=mark)
                )
        drawn += draw_bars(ax, groups)
        ax.set(xlabel="spine", ylabel=axis_label(outcome, column, title))
    note = f"{spread_note(drawn)}; {CLOCK}; the published path is another one of about 5 m"
    return page.finish([*profile_swatches(names), *bar_entries(drawn)], note)


# --- test stands


def _leg_stand(outcome: Outcome, lines: Lines) -> Drawn:
    names = {"force": "pull withstood by the foot", "speed": "speed of the rising foot", "work": "work of a swing",
             "coupling": "knee's bend per hip's swing"}  # fmt: skip
    groups = {
        f"{pair} leg": [{"pair": pair, "routing": routing, "hinges": 1} for routing in ROUTINGS]
        for pair in ("front", "rear")
    }
    yield "routings", _stand_bars(outcome, "Routings of the knee's tendon", names, groups, ROUTINGS)


def _spine_stand(outcome: Outcome, lines: Lines) -> Drawn:
    names = {"force": "force withstood by the hip", "speed": "speed of the hip", "work": "work of a bend",
             "range": "range of the hip"}  # fmt: skip
    groups = {"Nermo 4.1": [{"robot": "nermo_41", "plane": plane} for plane in stands.PLANES]}
    yield "planes", _stand_bars(outcome, "Lateral, vertical and combined bends", names, groups, tuple(stands.PLANES))


def _stand_bars(
    outcome: Outcome, title: str, names: Mapping[str, str], groups: Mapping[str, Sequence[Mapping[str, Any]]],
    series: Sequence[str],
) -> Figure:  # fmt: skip
    """A panel for each column, with a bar for each case of each group."""
    page, profile = Page(title, (7.2, 5.2), 2, 2), outcome.columns["profile"][0]
    for ax, (column, name) in zip(page.axes.ravel(), names.items(), strict=True):
        draw_bars(ax, {
            group: [Bar(repeats(outcome, column, profile=profile, **case), SERIES[i]) for i, case in enumerate(cases)]
            for group, cases in groups.items()
        })  # fmt: skip
        ax.set_ylabel(axis_label(outcome, column, name))
    note = "on the test stand, without gravity; no such numbers are published"
    return page.finish([swatch(name, SERIES[i]) for i, name in enumerate(series)], note)


def _nothing(outcome: Outcome, lines: Lines) -> Drawn:
    return iter(())


_DRAWERS: Final[dict[str, Callable[[Outcome, Lines], Drawn]]] = {
    "straight-line": _straight_line, "turning": _turning, "balance": _balance, "maze": _maze, "body": _nothing,
    "leg-stand": _leg_stand, "spine-stand": _spine_stand,
}  # fmt: skip
