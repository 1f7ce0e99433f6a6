"""The figures of an experiment, in the form of the published figures.

A colour has the same meaning in all figures. The profile `as_published`, which is judged, has full colours, other profiles
have lighter ones, and published values have black outlines.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.ticker import FuncFormatter, MultipleLocator

from nermo_mjx.experiments import walks
from nermo_mjx.experiments.cases import PROFILES, SIMULATED, CaseRuns, clock, texts
from nermo_mjx.experiments.published import AGREES, Line
from nermo_mjx.plotting.charts import FigurePage, draw_horizontal_grid, lighten
from nermo_mjx.plotting.shown import shown as in_shown_unit
from nermo_mjx.plotting.shown import spoken
from nermo_mjx.plotting.style import (
    BEST_COLOUR,
    FOOT,
    GRID,
    INK,
    LINE_COLOUR,
    MISSING_COLOUR,
    MUTED_INK,
    OKABE_ITO,
    SERIES,
    SHADE,
)
from nermo_mjx.recording import Recording
from nermo_mjx.robot import LIMBS, load_robot
from nermo_mjx.view.recorded import attitude_of

Drawn = Iterator[tuple[str, Figure | None]]
Lines = Sequence[Line]
Case = Mapping[str, Any]
Published = float | tuple[float, float] | None


def figures_of_experiment(outcome: CaseRuns, lines: Lines) -> Iterator[tuple[str, Figure]]:
    """(EXPERIMENT-PICTURE, figure) of each picture for which the outcome has data.

    Figures omit missing parts (a profile, a case, a recording).

    Args:
        outcome: Outcome of the experiment.
        lines: Lines of the report, with the published values, which are drawn next to the simulated values.
    """
    lines = [line for line in lines if line.experiment == outcome.experiment]
    draw = _DRAWERS.get(outcome.experiment, lambda outcome, lines: iter(()))
    for name, figure in itertools.chain(draw(outcome, lines), _agreement(outcome, lines)):
        if figure is not None:
            yield f"{outcome.experiment}-{name}", figure


# --- common parts of figures: colours by meaning, marks and entries of legends, and grouped bars

SPINE: Final = {False: OKABE_ITO["blue"], True: OKABE_ITO["vermilion"]}
WITH: Final = {False: "without spine", True: "with spine"}
COMPENSATED: Final = OKABE_ITO["purple"]
STRATEGY: Final = {
    "leg": OKABE_ITO["green"],
    "spine": OKABE_ITO["purple"],
    "mix": OKABE_ITO["orange"],
}
PASS, FAIL = "#c6dff0", "#f6cfb5"
CLOCK: Final = "times and speeds are those of the controller's clock"
ANGLES: Final = ("roll", "pitch", "yaw")
#: Share of a group's width that its bars fill.
_FILLED: Final = 0.82
_HATCH: Final = "/////"
_THEORY: Final[dict[str, Any]] = {"color": INK, "lw": 1.6, "ls": (0, (1, 0.6))}
_FAILED: Final[dict[str, Any]] = {"color": INK, "ls": "none", "marker": "x", "ms": 5, "mew": 1.6}


def published(lines: Iterable[Line], figure: str) -> Published:
    """The published number or interval of a figure of the report; None if the lines do not contain it."""
    for line in lines:
        if (
            line.figure == figure
            and line.published is not None
            and not isinstance(line.published, bool | str)
        ):
            return tuple(line.published) if isinstance(line.published, list) else line.published
    return None


def times(factor: float, value: Published) -> float | None:
    """A published number in another unit; None for an interval."""
    return factor * value if isinstance(value, float) else None


def profiles(outcome: CaseRuns) -> list[str]:
    """The simulated profiles of an outcome, `as_published` first; the report lists the few cases of `as_built`."""
    present = set(map(str, outcome.columns["profile"]))
    return [name for name in reversed(SIMULATED) if name in present] or sorted(present)


def tone(colour: str, profile: str) -> str:
    """The colour in a profile."""
    return lighten(colour) if profile == "exact" else colour


def plain(name: str) -> str:
    """A name's display form."""
    return name.replace("_", " ")


def swatch(name: str, colour: str, **patch: Any) -> Patch:
    """A legend's entry for a filled area."""
    return Patch(facecolor=colour, label=name, **patch)


def stroke(name: str, colour: str, **line: Any) -> Line2D:
    """A legend's entry for a line."""
    return Line2D([], [], color=colour, label=name, **line)


def spine_strokes(names: Mapping[bool, str] = WITH, **line: Any) -> list[Artist]:
    """Legend entries for lines without and with the spine."""
    return [stroke(names[on], SPINE[on], **({"lw": 1.7} | line)) for on in (False, True)]


def foot_entries(entry: Callable[..., Artist], **look: Any) -> list[Artist]:
    """Legend entries for the feet."""
    return [entry(f"{plain(foot)} foot", FOOT[foot], **look) for foot in LIMBS]


def profile_swatches(names: Sequence[str]) -> list[Artist]:
    """Legend entries for the profiles, if there are several."""
    return [swatch(plain(name), tone("#444444", name)) for name in names] if len(names) > 1 else []


def diamond(ax: Axes, x: float, y: float, zorder: float) -> None:
    """A published number: a white diamond in black outline."""
    ax.scatter(
        x, y, s=34, marker="D", fc="white", ec="black", lw=1.2, zorder=zorder, gid="published"
    )


def mark_published(ax: Axes, x: float, value: Published) -> None:
    """Draw a published number as a diamond, and an interval as a bracket around it."""
    if value is None:
        return
    low, high = value if isinstance(value, tuple) else (value, value)
    if high > low:
        ax.errorbar(
            x,
            (low + high) / 2,
            (high - low) / 2,
            fmt="none",
            ecolor="black",
            elinewidth=1.1,
            capsize=3,
            zorder=6,
        )
    diamond(ax, x, (low + high) / 2, 7)


def published_entry() -> Line2D:
    """The legend's entry of `mark_published`."""
    return Line2D(
        [], [], ls="none", marker="D", ms=5.5, mfc="white", mec="black", mew=1.2, label="published"
    )


def shade_phases(ax: Axes, phases: Mapping[str, Sequence[float]], *, named: bool = True) -> None:
    """Phases on alternating grey backgrounds, each with its name above the axes."""
    above: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 7.5, "color": MUTED_INK}
    for i, (name, (begin, end)) in enumerate(phases.items()):
        if i % 2 == 0:
            ax.axvspan(begin, end, color=SHADE, lw=0, zorder=-5)
        if named:
            ax.text((begin + end) / 2, 1.01, name, transform=ax.get_xaxis_transform(), **above)
    ends = [time for phase in phases.values() for time in phase]
    ax.set_xlim(min(ends), max(ends))


def seen_from_above(ax: Axes, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(right, ahead) [mm] of positions (..., 2) [m] in the robot's frame at the start (x left, y back); equal axes."""
    ax.set_aspect("equal")
    ax.set(xlabel="to the right of the start [mm]", ylabel="ahead of the start [mm]")
    return -1e3 * places[..., 0], -1e3 * places[..., 1]


@dataclasses.dataclass(frozen=True)
class Bar:
    """One case: the values of its repeats as shown (n,), NaN for a repeat without one, empty if it was not run; its
    colour, whether it is hatched, and its theoretical and published values."""

    values: np.ndarray
    colour: str = ""
    hatched: bool = False
    theory: float = math.nan
    published: Published = None

    @property
    def good(self) -> np.ndarray:
        """The repeats with a value."""
        return self.values[np.isfinite(self.values)]

    @property
    def mean(self) -> float:
        """Mean of the repeats with a value; NaN if there are none."""
        return float(self.good.mean()) if len(self.good) else math.nan

    @property
    def failed(self) -> bool:
        """Whether a repeat has no value."""
        return len(self.good) < len(self.values)


def repeats(outcome: CaseRuns, column: str, profile: str, **case: object) -> np.ndarray:
    """Values of the repeats of one case in shown units (deg, mm, mm/s); times and speeds on the controller's clock.

    NaN for a run that did not end well; empty if the table has no such case.
    """
    rows, unit = outcome.where(profile=profile, **case), outcome.about[column].unit
    values = in_shown_unit(column, unit, outcome.columns[column][rows]).values
    well = (
        outcome.columns["status"][rows] == "ok"
        if "status" in outcome.columns
        else np.full(len(values), True)
    )
    ratio = {"s": 1 / clock(profile), "m/s": clock(profile)}.get(unit, 1.0)
    return ratio * np.where(well & np.isfinite(values), values, np.nan)


def only(values: np.ndarray) -> float:
    """The value that all repeats share; NaN if there is none."""
    good = values[np.isfinite(values)]
    return float(good[0]) if len(good) else math.nan


def axis_label(outcome: CaseRuns, column: str, name: str) -> str:
    """Name and shown unit of a column."""
    return in_shown_unit(name, outcome.about[column].unit, np.zeros(0)).label


@dataclasses.dataclass(frozen=True)
class Panel:
    """Axes with groups of bars: name on the axis -> bars; title and labels; the number of bars that fit in a group, by
    default that of the longest."""

    groups: Mapping[str, Sequence[Bar]]
    title: str = ""
    xlabel: str = ""
    ylabel: str = ""
    slots: int | None = None

    def draw(self, ax: Axes) -> list[Bar]:
        """Draw groups of bars side by side, and return all bars; without a group, nothing.

        A bar is the mean of the repeats, with an error bar of one standard deviation if there are several. A cross at
        the foot of a bar, or in its place, marks a repeat without a value.
        """
        ax.set(title=self.title, xlabel=self.xlabel, ylabel=self.ylabel)
        if not self.groups:
            return []
        width = _FILLED / (self.slots or max(len(bars) for bars in self.groups.values()))
        for i, bars in enumerate(self.groups.values()):
            for j, bar in enumerate(bars):
                if not len(bar.values):
                    continue
                x = i + (j - (len(bars) - 1) / 2) * width
                if np.isfinite(bar.mean):
                    hatch = _HATCH if bar.hatched else None
                    ax.bar(
                        x,
                        bar.mean,
                        0.9 * width,
                        color=bar.colour,
                        hatch=hatch,
                        ec="white",
                        lw=0,
                        zorder=2,
                    )
                if len(bar.good) > 1:
                    whisker: dict[str, Any] = {
                        "ecolor": INK,
                        "elinewidth": 0.9,
                        "capsize": 1.8,
                        "zorder": 5,
                    }
                    ax.errorbar(x, bar.mean, bar.good.std(), fmt="none", **whisker)
                if np.isfinite(bar.theory):
                    ends = [x - 0.45 * width, x + 0.45 * width]
                    ax.plot(ends, [bar.theory] * 2, zorder=4, gid="theory", **_THEORY)
                if bar.failed:
                    foot = ax.get_xaxis_transform()
                    ax.plot(
                        x, 0.025, transform=foot, zorder=8, gid="failed", clip_on=False, **_FAILED
                    )
                mark_published(ax, x, bar.published)
        everything = [bar for bars in self.groups.values() for bar in bars]
        if not any(np.isfinite(bar.mean) for bar in everything):
            ax.bar(0, 0, alpha=0)  # the axis still begins at 0
        ax.set_xticks(range(len(self.groups)), list(self.groups))
        ax.tick_params(axis="x", length=0)
        ax.set_xlim(-0.55, len(self.groups) - 0.45)
        ax.margins(y=0.08)
        draw_horizontal_grid(ax)
        return everything


def bar_page(
    title: str,
    size: tuple[float, float],
    panels: Sequence[Sequence[Panel]],
    handles: Sequence[Artist],
    note: str,
    hatched: str = "",
    **subplots: Any,
) -> Figure:
    """A page of bars, whose legend explains what they show in addition to their height.

    Args:
        title, size: Title and size of the page.
        panels: Rows of panels.
        handles: First entries of the legend.
        note: Note below; `{spread}` becomes the number of repeats and the meaning of the error bars.
        hatched: Meaning of hatched bars.
    """
    page = FigurePage(title, size, len(panels), len(panels[0]), **subplots)
    bars: list[Bar] = []
    for ax, panel in zip(page.axes.ravel(), itertools.chain(*panels), strict=True):
        bars += panel.draw(ax)
    entries = [
        *handles,
        *(
            [Line2D([], [], label="theory, no slip", **_THEORY)]
            if any(np.isfinite(bar.theory) for bar in bars)
            else []
        ),
        *([published_entry()] if any(bar.published is not None for bar in bars) else []),
        *(
            [swatch(hatched, MUTED_INK, hatch=_HATCH, ec="white", lw=0)]
            if any(bar.hatched for bar in bars)
            else []
        ),
        *(
            [Line2D([], [], label="a repeat without result", **_FAILED)]
            if any(bar.failed for bar in bars)
            else []
        ),
    ]
    largest_count = max((len(bar.values) for bar in bars), default=0)
    spread = (
        f"mean of {largest_count} repeats; error bars: one standard deviation"
        if largest_count > 1
        else "one run a case"
    )
    return page.finish(entries, note.format(spread=spread))


def by_gait(
    outcome: CaseRuns,
    kinds: Sequence[Case],
    rows: Sequence[tuple[str | None, str, Case, Callable[[Case], Bar]]],
) -> list[list[Panel]]:
    """Rows of panels, with a column for each gait that was walked, and groups of bars for each frequency.

    Args:
        outcome: Outcome of the experiment.
        kinds: Labels of each bar of a group.
        rows: For each row, the text after the gait in its titles (None for rows without titles), the label of its axis,
            the labels of its cases, and a function that makes the bar of a case.
    """
    walked = {
        (gait, i): sorted(
            set(outcome.columns["frequency"][outcome.where(gait=gait, **case)].tolist())
        )
        for gait, (i, (_, _, case, _)) in itertools.product(walks.WALK_GAITS, enumerate(rows))
    }
    gaits = [gait for gait in walks.WALK_GAITS if any(walked[gait, i] for i in range(len(rows)))]
    panels: list[list[Panel]] = []
    for i, (suffix, label, case, bar) in enumerate(rows):
        panels.append([])
        for gait in gaits:
            groups = {}
            for f in walked[gait, i]:
                bars = [bar({"gait": gait, "frequency": f, **case, **kind}) for kind in kinds]
                groups[f"{f:g}"] = [bar_of_gait for bar_of_gait in bars if len(bar_of_gait.values)]
            head = "" if suffix is None else spoken(gait) + suffix
            foot = "gait frequency [Hz]" if i == len(rows) - 1 else ""
            panels[-1].append(Panel(groups, head, foot, "" if panels[-1] else label, len(kinds)))
    return panels if gaits else []


# --- agreement: each number as a fraction of the published one; of an effect, of its size, the ratio minus 1

#: Range of the axis, in shares of the published number; values beyond are arrows at its end.
LEAST, MOST = -0.5, 2.5
_NEAR: Final = "#e6f1f8"
_TONES: Final = {
    "as_published": LINE_COLOUR,
    "exact": "#b9cbd8",
    "as_built": "#8a6fb0",
    "author": "#444444",
}
#: Right ends of the columns of numbers, in widths of the table.
_COLUMN_ENDS: Final = {
    "published": 0.17,
    "author": 0.39,
    "as_published": 0.62,
    "exact": 0.81,
    "as_built": 1.0,
}


def _number(value: Any) -> float | None:
    return None if value is None or isinstance(value, bool | str | list | tuple) else float(value)


# Long because one figure is laid out from top to bottom.
def _agreement(outcome: CaseRuns, lines: Lines) -> Drawn:
    """Draw all numbers that were published and measured."""
    rows = []
    for line in lines:
        # The value that counts as 0, and how far the published one, or an interval's middle, which counts as 1, is off.
        neutral = 1.0 if line.rule == "effect" else 0.0
        value = (
            float(np.mean(line.published))
            if isinstance(line.published, list)
            else _number(line.published)
        )
        if value not in (None, neutral) and any(
            _number(getattr(line, name)) is not None for name in PROFILES
        ):
            rows.append((line, neutral, value - neutral))
    if not rows:
        return
    title = f"What was published, and what was measured: {outcome.experiment.replace('-', ' ')}"
    page = FigurePage(
        title,
        (12.6, 1.5 + 0.255 * len(rows)),
        1,
        2,
        sharey=True,
        gridspec_kw={"width_ratios": [1, 1]},
    )
    ax, table = page.axes[0]
    ax.axvspan(1 - AGREES, 1 + AGREES, color=_NEAR, lw=0, zorder=-5)
    ax.axvline(1, color=MUTED_INK, lw=0.8, zorder=0)
    for y, (line, neutral, reference) in enumerate(rows):
        ax.axhline(y, color=GRID, lw=0.8, zorder=-1)
        if isinstance(line.published, list):
            low, high = (end / reference for end in line.published)
            ax.plot(
                [low, min(high, MOST)],
                [y, y],
                color="black",
                lw=1.2,
                marker="|",
                ms=7,
                mew=1.2,
                zorder=3,
            )
        diamond(ax, 1, y, 4)
        for profile in reversed(_TONES):
            value = _number(getattr(line, profile))
            if value is None or (line.judged_in == "as_built" and profile in SIMULATED):
                continue
            share = (value - neutral) / reference
            position = min(max(share, LEAST), MOST)
            marker = "o" if share == position else (">" if share > position else "<")
            ax.scatter(
                position,
                y,
                s=46,
                marker=marker,
                color=_TONES[profile],
                ec="white",
                lw=0.6,
                zorder=5,
                gid=profile,
            )
        for name, x in _COLUMN_ENDS.items():
            value = getattr(line, name)
            if isinstance(value, list):
                text = f"{min(value):.3g} to {max(value):.3g} {line.unit}".rstrip()
            else:
                number = _number(value)
                text = (
                    "–"
                    if number is None
                    else f"{number:.3g} {line.unit}".rstrip().replace("-", "−")
                )
            wrong = name == line.judged_in and line.holds is False
            table.text(
                x, y, text, ha="right", va="center", fontsize=7, color=BEST_COLOUR if wrong else INK
            )
    ax.set_yticks(range(len(rows)), [line.figure for line, _, _ in rows], fontsize=8.5)
    ax.set_ylim(len(rows) - 0.4, -0.9)
    ax.set_xlim(min(ax.get_xlim()[0], -0.08), MOST + 0.08)
    ax.set_xlabel("measured over published [1]")
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("-", "−")))
    ax.tick_params(axis="y", length=0, labelcolor=INK)
    ax.spines["left"].set_visible(False)
    table.axis("off")
    table.set_xlim(0, 1)
    for name, x in _COLUMN_ENDS.items():
        table.text(
            x,
            -0.75,
            plain(name),
            ha="right",
            va="center",
            fontsize=7.5,
            fontweight="bold",
            color=MUTED_INK,
        )
    handles: list[Artist] = [published_entry()]
    handles += [
        stroke(plain(name), colour, ls="none", marker="o", ms=6.5)
        for name, colour in _TONES.items()
    ]
    handles += [swatch(f"within {AGREES:.0%}".replace("%", " %"), _NEAR)]
    note = (
        "of an effect, a ratio, the share is of the ratio less 1; arrow: beyond the axis; bracket: published as an "
        "interval, of which the diamond is the middle; author: his model and code in MuJoCo 3.17; orange: does not hold"
    )
    yield "report", page.finish(handles, note)


# --- straight line

#: Figures of the report whose published numbers are drawn.
SPEED: Final = "speed of trot, 0.8 Hz, no spine"
GAIN: Final = "speed of trot, 0.8 Hz, spine over none"
OVER_LATERAL: Final = "speed of trot over lateral walk, 0.8 Hz, no spine"
LARGEST_ROLL: Final = "largest roll of trot, 0.8 Hz, spine"
COMPENSATION: Final = {
    "std": "roll std of trot, 0.67 Hz, spine, compensated over not",
    "amplitude": "roll amplitude of trot, 0.67 Hz, spine, compensated over not",
}


def _straight_line(outcome: CaseRuns, lines: Lines) -> Drawn:
    # Published speeds by gait, frequency and spine [mm/s]: one is reported, the others follow from reported ratios.
    speed, gain, over = (published(lines, figure) for figure in (SPEED, GAIN, OVER_LATERAL))
    reported = {}
    if isinstance(speed, float):
        reported["trot", 0.8, False] = speed
        if isinstance(gain, float):
            reported["trot", 0.8, True] = speed * gain
        if isinstance(over, float):
            reported["lateral_walk", 0.8, False] = speed / over
    names = profiles(outcome)

    def speed_of(case: Case) -> Bar:
        theory = only(repeats(outcome, "theory_speed", **case))
        mark = (
            reported.get((case["gait"], case["frequency"], case["spine"]))
            if case["profile"] == names[0]
            else None
        )
        values = repeats(outcome, "speed", **case)
        return Bar(
            values, tone(SPINE[case["spine"]], case["profile"]), theory=theory, published=mark
        )

    def sway_of(angle: str) -> Callable[[Case], Bar]:
        return lambda case: Bar(
            repeats(outcome, f"{angle}_std", **case), tone(SPINE[case["spine"]], case["profile"])
        )

    usual = {"stride": 1.0, "compensated": False}
    kinds = [{"spine": on, "profile": name} for on in (False, True) for name in names]

    def page(
        title: str, height: float, note: str, rows: Sequence[tuple[str, Callable[[Case], Bar]]]
    ) -> Figure | None:
        suffixes = ["", *[None] * (len(rows) - 1)]
        described = [
            (suffix, label, usual, bar) for suffix, (label, bar) in zip(suffixes, rows, strict=True)
        ]
        panels = by_gait(outcome, kinds, described)
        if not panels:
            return None
        # The lateral walk is run only without the spine, so its groups have half the bars.
        shares = [0.62 if panel.title == spoken("lateral_walk") else 1.0 for panel in panels[0]]
        widths = [
            max(1.2, len(each.groups) * share + 0.3)
            for each, share in zip(panels[0], shares, strict=True)
        ]
        handles = [*(swatch(WITH[on], SPINE[on]) for on in (False, True)), *profile_swatches(names)]
        size, ratios = (max(7.4, 2.1 + 0.92 * sum(widths)), height), {"width_ratios": widths}
        return bar_page(
            title, size, panels, handles, note, sharey="row", sharex="col", gridspec_kw=ratios
        )

    note = f"{{spread}}; {CLOCK}; published with spine and of the lateral walk: by its ratios to the trot"
    label = axis_label(outcome, "speed", "speed")
    yield "speed", page("Speed over the gait frequency", 4.2, note, [(label, speed_of)])
    yield "speed-over-stride", _speed_over_stride(outcome, reported)
    yield "orientation", _orientation(outcome, lines)
    title = "How far the torso sways: standard deviation of its orientation"
    rows = [
        (axis_label(outcome, f"{angle}_std", f"{angle}, std"), sway_of(angle)) for angle in ANGLES
    ]
    yield "orientation-spread", page(title, 7.2, "{spread}", rows)
    yield "offset-compensation", _compensation(outcome, lines)


def _speed_over_stride(outcome: CaseRuns, reported: Mapping[Any, float]) -> Figure | None:
    names = profiles(outcome)
    walked = outcome.only(gait="trot", frequency=0.8, compensated=False, profile=names[0])
    strides = sorted(set(walked.columns["stride"].tolist()))
    if len(strides) < 2:
        return None
    page = FigurePage("Speed over the length of the stride: trot at 0.8 Hz", (6.4, 4.6))
    ax = page.axes[0, 0]
    foot = {"transform": ax.get_xaxis_transform(), "gid": "failed"}
    for profile, on in itertools.product(names, (False, True)):
        case: Case = {
            "profile": profile,
            "gait": "trot",
            "frequency": 0.8,
            "spine": on,
            "compensated": False,
        }
        runs = [Bar(repeats(outcome, "speed", stride=s, **case)) for s in strides]
        colour = tone(SPINE[on], profile)
        ax.plot(strides, [run.mean for run in runs], "-o", color=colour, ms=5, lw=1.8, zorder=4)
        if profile == names[0]:
            theory = [only(repeats(outcome, "theory_speed", stride=s, **case)) for s in strides]
            ax.plot(strides, theory, ":", color=SPINE[on], lw=1.3, zorder=2)
        lost = [s for s, run in zip(strides, runs, strict=True) if run.failed]
        ax.plot(lost, [0.02] * len(lost), "x", ms=6, mew=1.6, color=colour, **foot)
    marks = [value for (gait, _, _), value in reported.items() if gait == "trot"]
    for value in marks:
        mark_published(ax, 1.0, value)
    ax.set(xlabel="normalised stride [1]", ylabel=axis_label(outcome, "speed", "speed"))
    ax.margins(y=0.07)
    draw_horizontal_grid(ax)
    handles = [
        *spine_strokes(marker="o", ms=5),
        *profile_swatches(names),
        stroke("theory, no slip", INK, ls=":"),
    ]
    handles += [published_entry()] if marks else []
    note = "published with spine: by its ratio to the speed without; a cross at the foot: a repeat without result; "
    return page.finish(handles, note + CLOCK)


def _orientation(outcome: CaseRuns, lines: Lines) -> Figure | None:
    """Roll, pitch and yaw over the last two whole gait cycles of the recordings."""
    runs = [
        recording
        for recording in outcome.recordings.values()
        if "spine" in recording.metadata.get("labels", {})
    ]
    if not runs:
        return None
    labels = runs[0].metadata["labels"]
    title = (
        f"Orientation over two gait cycles: {spoken(labels['gait'])} at {labels['frequency']:g} Hz"
    )
    page = FigurePage(title, (7.4, 6.6), 3, 1, sharex=True)
    for run in runs:
        cycles = run.time * labels["frequency"] / clock(labels["profile"])
        begin = max(0.0, np.floor(cycles[-1] + 0.01) - 2)
        inside = (cycles >= begin - 1e-9) & (cycles <= begin + 2 + 1e-9)
        for ax, angle in zip(
            page.axes[:, 0], attitude_of(run.sensors["orientation"])[inside].T, strict=True
        ):
            ax.plot(
                cycles[inside] - begin,
                angle,
                color=SPINE[bool(run.metadata["labels"]["spine"])],
                lw=1.7,
            )
    largest, handles = published(lines, LARGEST_ROLL), spine_strokes()
    if isinstance(largest, float):
        for edge in (-largest, largest):
            page.axes[0, 0].axhline(edge, color="black", lw=1.1, ls=(0, (5, 3)), gid="published")
        handles.append(stroke("published range of roll", "black", lw=1.1, ls=(0, (5, 3))))
    for ax, name in zip(page.axes[:, 0], ANGLES, strict=True):
        ax.set(ylabel=f"{name} [deg]", xlim=(0, 2), xticks=np.arange(0, 2.1, 0.5))
        ax.margins(y=0.08)
        draw_horizontal_grid(ax)
        ax.axvline(1, color=MISSING_COLOUR, lw=0.8, zorder=0)
    page.axes[-1, 0].set_xlabel("gait cycles [1]")
    return page.finish(
        handles, f"{plain(labels['profile'])}; positive: leaning left, nose down, turned left"
    )


def _compensation(outcome: CaseRuns, lines: Lines) -> Figure | None:
    """Roll with the spine, without and with compensation; the published change is applied to the value measured
    here."""
    if not outcome.where(compensated=True).any():
        return None
    panels = []
    for measure, figure in COMPENSATION.items():
        groups = {}
        for profile in profiles(outcome):
            case: Case = {
                "profile": profile,
                "gait": "trot",
                "frequency": 0.67,
                "spine": True,
                "stride": 1.0,
            }
            names = ("roll_std",) if measure == "std" else ("roll_min", "roll_max")
            ends = [
                [repeats(outcome, name, compensated=on, **case) for name in names]
                for on in (False, True)
            ]
            off, on = (
                end_values[0] if measure == "std" else 0.5 * (end_values[1] - end_values[0])
                for end_values in ends
            )
            mean = Bar(off).mean
            mark = times(mean, published(lines, figure)) if np.isfinite(mean) else None
            bars = [
                Bar(off, tone(SPINE[True], profile)),
                Bar(on, tone(COMPENSATED, profile), published=mark),
            ]
            groups[plain(profile)] = bars
        panels.append(Panel(groups, ylabel=axis_label(outcome, "roll_std", f"roll, {measure}")))
    handles = [swatch("not compensated", SPINE[True]), swatch("compensated", COMPENSATED)]
    note = "published: its relative change, applied to the bar on the left; {spread}"
    return bar_page(
        "Offset compensation: trot at 0.67 Hz with the spine", (6.4, 3.9), [panels], handles, note
    )


# --- turning

TIME: Final = {name: f"time for 0.5 m, trot, 0.67 Hz, {name}-based" for name in walks.STRATEGIES}
RADIUS: Final = {name: f"smallest radius of trot, {name}-based" for name in ("leg", "mix")}
#: End of the axis of smallest radii [mm].
_WIDEST: Final = 700.0
_BASED: Final = {name: f"{name}-based" for name in walks.STRATEGIES}
_NOT_FOLLOWED: Final = "a repeat did not follow the path"


# Long because one figure is laid out from top to bottom.
def _turning(outcome: CaseRuns, lines: Lines) -> Drawn:
    names = profiles(outcome)
    kinds = [
        {"strategy": name, "profile": profile} for name in walks.STRATEGIES for profile in names
    ]

    def bar(column: str, case: Case, mark: Published = None, **options: Any) -> Bar:
        values = repeats(outcome, column, **case)
        return Bar(
            values, tone(STRATEGY[case["strategy"]], case["profile"]), published=mark, **options
        )

    def strayed(case: Case) -> bool:
        return not outcome.columns["followed"][outcome.where(**case)].all()

    def speed(case: Case) -> Bar:
        case_key = (case["gait"], case["frequency"], case["radius"], case["profile"])
        time = published(lines, TIME[case["strategy"]])
        timed = case_key == ("trot", 0.67, 0.5, "as_published")
        mark = 1e3 * 0.5 * np.pi / 2 / time if timed and isinstance(time, float) else None
        return bar("speed", case, mark, hatched=strayed(case))

    def lock(case: Case) -> Bar:
        value = published(lines, RADIUS.get(case["strategy"], ""))
        mark = times(1e3, value) if (case["gait"], case["profile"]) == ("trot", names[0]) else None
        return bar(
            "turning_radius", case, mark, theory=only(repeats(outcome, "theory_radius", **case))
        )

    def page(
        title: str, radii: Sequence[float], height: float, label: str, note: str, bar: Any
    ) -> Figure | None:
        """A row of axes for each radius."""
        rows = [
            (
                f", R = {1e3 * radius:g} mm" if radius else "",
                label,
                {"radius": radius, "side": "left"},
                bar,
            )
            for radius in radii
            if outcome.where(radius=radius, side="left").any()
        ]
        panels = by_gait(outcome, kinds, rows)
        if not panels:
            return None
        handles = [
            *(swatch(_BASED[name], STRATEGY[name]) for name in walks.STRATEGIES),
            *profile_swatches(names),
        ]
        size = (max(6.4, 1.2 + 3.2 * len(panels[0])), height * len(rows) + 1.3)
        return bar_page(
            title, size, panels, handles, note, _NOT_FOLLOWED, sharey=True, sharex="col"
        )

    title, label = "Speed on quarter circles to the left", axis_label(outcome, "speed", "speed")
    note = f"{{spread}}; {CLOCK}; published: length of the path over the published time"
    yield "speed", page(title, walks.RADII, 2.5, label, note, speed)

    circle = {"gait": "trot", "frequency": 0.67, "radius": 0.5}
    if outcome.where(**circle).any():
        panels: list[Panel] = []
        for side in walks.TURN_SIGNS:
            groups: dict[str, list[Bar]] = {_BASED[strategy]: [] for strategy in walks.STRATEGIES}
            for kind in kinds:
                case = {**kind, "side": side, **circle}
                mark = (
                    published(lines, TIME[kind["strategy"]])
                    if kind["profile"] == names[0]
                    else None
                )
                groups[_BASED[kind["strategy"]]].append(
                    bar("time", case, mark, hatched=strayed(case))
                )
            label = "" if panels else axis_label(outcome, "time", "time")
            panels.append(Panel(groups, f"to the {side}", ylabel=label))
        title, note = (
            "Time for the quarter circle of 500 mm: trot at 0.67 Hz",
            f"{{spread}}; {CLOCK}",
        )
        yield (
            "time",
            bar_page(
                title,
                (6.4, 4.1),
                [panels],
                profile_swatches(names),
                note,
                _NOT_FOLLOWED,
                sharey=True,
            ),
        )

    title, label = (
        "Smallest radius: full lock to the left",
        axis_label(outcome, "turning_radius", "radius"),
    )
    note = "the publication gives no frequency, so that its mark stands at each; the axis ends at"
    figure = page(title, [walks.FULL_LOCK], 2.8, label, f"{{spread}}; {note} {_WIDEST:g} mm", lock)
    if figure is not None:
        # A robot with a radius of metres must not flatten the others.
        low, high = figure.axes[0].get_ylim()
        figure.axes[0].set_ylim(low, min(high, _WIDEST))
    yield "smallest-radius", figure
    yield "paths", _paths(outcome)


def _paths(outcome: CaseRuns) -> Figure | None:
    """The recorded paths from above: the torso's, and its mean over each gait cycle."""
    runs = [
        run for run in outcome.recordings.values() if "strategy" in run.metadata.get("labels", {})
    ]
    if not runs:
        return None
    labels = runs[0].metadata["labels"]
    radius, side = float(labels["radius"]), walks.TURN_SIGNS[str(labels["side"])]
    bound = float(walks.bound(np.asarray(radius)))
    title = (
        f"Paths on the quarter circle of {1e3 * radius:g} mm:"
        f" {spoken(labels['gait'])} at {labels['frequency']:g} Hz"
    )
    page = FigurePage(title, (6.8, 6.9))
    ax, angle = page.axes[0, 0], np.linspace(0, np.pi / 2, 200)

    def arc(r: float) -> np.ndarray:
        return np.stack([side * (radius - r * np.cos(angle)), -r * np.sin(angle)], axis=-1)

    edge = np.concatenate([arc(radius - bound), arc(radius + bound)[::-1]])
    ax.add_patch(
        Polygon(np.stack(seen_from_above(ax, edge), axis=-1), fc=MISSING_COLOUR, lw=0, zorder=1)
    )
    ax.plot(*seen_from_above(ax, arc(radius)), color=INK, ls="--", lw=1.2, zorder=5)
    for run in runs:
        # Until the torso passes the end of the quarter circle, and the running mean over a gait cycle.
        labels = run.metadata["labels"]
        colour, points = (
            STRATEGY[str(labels["strategy"])],
            np.asarray(run.sensors["position"])[:, :2],
        )
        past_radius = np.flatnonzero(walks.TURN_SIGNS[str(labels["side"])] * points[:, 0] >= radius)
        points = points[: past_radius[0] + 1] if len(past_radius) else points
        ticks = round(
            clock(labels["profile"]) / labels["frequency"] / float(np.median(np.diff(run.time)))
        )
        sums = np.cumsum(np.concatenate([np.zeros((1, 2)), points]), axis=0)
        mean = (sums[ticks:] - sums[:-ticks]) / ticks if len(points) > ticks else points[:0]
        ax.plot(*seen_from_above(ax, points), color=colour, lw=0.8, alpha=0.55, zorder=3)
        ax.plot(*seen_from_above(ax, mean), color=colour, lw=2.2, zorder=4)
    ax.grid(color=GRID, lw=0.8)
    ax.margins(0.04)
    handles: list[Artist] = [
        stroke(_BASED[name], STRATEGY[name], lw=2.2) for name in walks.STRATEGIES
    ]
    handles += [
        stroke("course", INK, ls="--", lw=1.2),
        swatch(f"followed: within {1e3 * bound:g} mm", MISSING_COLOUR),
    ]
    note = "thick: mean over a gait cycle; thin: the torso's IMU, by which a path is judged"
    return page.finish(handles, f"{plain(runs[0].metadata['labels']['profile'])}; {note}")


# --- balance

_SBC: Final = {False: "without compensation", True: "with compensation"}
_VERDICT: Final = {"pass": PASS, "fail": FAIL}


def _balance(outcome: CaseRuns, lines: Lines) -> Drawn:
    yield "verdicts", _verdicts(outcome, lines)
    runs = {
        (str(lift["leg"]), bool(lift["sbc"])): run
        for run in outcome.recordings.values()
        if {"leg", "sbc"} <= set(lift := run.metadata.get("metrics", {}))
        and {"pitch", "com_margin", "foot_force"} <= set(run.sensors)
    }
    if runs:
        recorded = plain(str(next(iter(runs.values())).metadata["metrics"].get("profile", "")))
        for name, sensor, title, label, factor in (
            ("pitch", "pitch", "Pitch while a leg is lifted and swung", "pitch [deg]", 180 / np.pi),
            (
                "stability",
                "com_margin",
                "Centre of mass inside of the support diagonal",
                "distance inside [mm]",
                1e3,
            ),
        ):
            yield name, _over_time(runs, recorded, sensor, title, label, factor)
        yield "forces", _forces(runs, recorded)
    profile = profiles(outcome)[0]
    phases = [
        phase
        for phase in ("stand", "shift", "lift", "swing")
        if f"force_{phase}_{LIMBS[0]}" in outcome.columns
    ]
    panels: list[list[Panel]] = []
    for sbc in (False, True):
        panels.append([])
        for limb in LIMBS:
            case: Case = {"profile": profile, "leg": limb, "sbc": sbc}
            groups = {
                phase: [
                    Bar(repeats(outcome, f"force_{phase}_{foot}", **case), FOOT[foot])
                    for foot in LIMBS
                ]
                for phase in phases
            }
            title = f"{plain(limb)} leg,\n{_SBC[sbc]}"
            panels[-1].append(Panel(groups, title, ylabel="" if panels[-1] else "force [N]"))
    title, note = "Mean forces on the feet in each phase", f"{plain(profile)}; {{spread}}"
    figure = bar_page(
        title, (10.4, 5.9), panels, foot_entries(swatch), note, sharex=True, sharey=True
    )
    yield "forces-by-phase", figure if phases else None


def _verdicts(outcome: CaseRuns, lines: Lines) -> Figure:
    """One tile per leg and source; a tile that differs from the publication's in its set-up has a thick frame."""
    values = {line.figure: line.published for line in lines}
    names = [name for name in PROFILES if name in outcome.columns["profile"]]
    page = FigurePage("Which legs the robot can lift and swing", (10.4, 3.9), 1, 2, sharey=True)
    frame: dict[str, Any] = {"fc": "none", "ec": "black", "lw": 1.8, "zorder": 4, "gid": "differs"}
    for ax, sbc in zip(page.axes[0], (False, True), strict=True):
        columns = [
            "published\nsimulation",
            *(plain(name).replace(" ", "\n") for name in names),
            "published\nhardware",
        ]
        for row, limb in enumerate(LIMBS):
            simulated = values.get(
                f"{plain(limb)} lifted, {'with' if sbc else 'without'} balance compensation"
            )
            hardware = values.get(
                f"hardware: {plain(limb)} lifted, {'with' if sbc else 'without'} compensation"
            )
            tiles = [(simulated, simulated)]
            for profile in names:
                passed = outcome.columns["passed"][
                    outcome.where(profile=profile, leg=limb, sbc=sbc)
                ]
                n = int(passed.sum())
                verdict = (
                    {len(passed): "pass", 0: "fail"}.get(n, f"{n} of {len(passed)}")
                    if len(passed)
                    else None
                )
                tiles.append((verdict, hardware if profile == "as_built" else simulated))
            for column, (tile, outcome_wanted) in enumerate([*tiles, (hardware, hardware)]):
                text = str(tile or "–")
                ax.add_patch(
                    Rectangle(
                        (column - 0.46, row - 0.44), 0.92, 0.88, fc=_VERDICT.get(text, SHADE), lw=0
                    )
                )
                if outcome_wanted and tile and tile != outcome_wanted:
                    ax.add_patch(Rectangle((column - 0.45, row - 0.43), 0.9, 0.86, **frame))
                ax.text(column, row, text, ha="center", va="center", fontsize=9, color=INK)
        ax.set_xticks(range(len(columns)), columns, fontsize=8.5)
        ax.set_yticks(range(len(LIMBS)), [f"{plain(limb)} leg" for limb in LIMBS])
        ax.tick_params(length=0, labelcolor=INK)
        ax.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(LIMBS) - 0.5, -0.5), title=_SBC[sbc])
        for spine in ax.spines.values():
            spine.set_visible(False)
    handles: list[Artist] = [swatch(name, colour) for name, colour in _VERDICT.items()]
    handles.append(swatch("not as published (as built: the hardware)", "white", ec="black", lw=1.8))
    return page.finish(
        handles, "pass: upright, and the lifted foot off the ground; all repeats of a case count"
    )


Lifts = Mapping[tuple[str, bool], Recording]


def _over_time(
    runs: Lifts, profile: str, sensor: str, title: str, label: str, factor: float
) -> Figure:
    """One reading over time, with axes per lifted leg, and lines without and with compensation."""
    page = FigurePage(title, (9.4, 5.9), 2, 2, sharex=True, sharey="row")
    handles, note = spine_strokes(_SBC), ""
    for ax, limb in zip(page.axes.ravel(), LIMBS, strict=True):
        for sbc in (False, True):
            if (limb, sbc) in runs:
                run = runs[limb, sbc]
                ax.plot(
                    run.time,
                    factor * np.asarray(run.sensors[sensor]),
                    color=SPINE[sbc],
                    lw=1.7,
                    zorder=3 + sbc,
                )
                shade_phases(ax, run.metadata["phases"], named=not sbc or (limb, False) not in runs)
        ax.set_title(f"{plain(limb)} leg", pad=16)
        ax.margins(y=0.08)
        draw_horizontal_grid(ax)
        if sensor == "com_margin":
            low = min(ax.get_ylim()[0], -2.0)
            ax.axhspan(low, 0, color=FAIL, alpha=0.45, lw=0, zorder=-4)
            ax.axhline(0, color=INK, lw=1.1)
            ax.set_ylim(bottom=low)
    if sensor == "com_margin":
        handles += [
            stroke("support diagonal", INK, lw=1.1),
            swatch("beyond it the robot tips", FAIL, alpha=0.45),
        ]
    else:
        note = "positive: nose down; "
    for ax in page.axes[:, 0]:
        ax.set_ylabel(label)
    for ax in page.axes[-1]:
        ax.set_xlabel("time [s]")
    return page.finish(
        handles, f"{profile}, first repeat; {note}compensation bends the spine in the shift"
    )


def _forces(runs: Lifts, profile: str) -> Figure:
    page = FigurePage(
        "Forces on the feet over time", (9.4, 9.2), len(LIMBS), 2, sharex=True, sharey=True
    )
    highest = max(float(np.nanpercentile(run.sensors["foot_force"], 99.5)) for run in runs.values())
    for ax, (limb, sbc) in zip(
        page.axes.ravel(), itertools.product(LIMBS, (False, True)), strict=True
    ):
        ax.set_title(f"{plain(limb)} leg, {_SBC[sbc]}", pad=16)
        ax.set_ylim(-0.03 * highest, 1.12 * highest)
        ax.grid(axis="y", color=GRID, lw=0.8)
        if (limb, sbc) in runs:
            run = runs[limb, sbc]
            for foot, force in zip(LIMBS, np.asarray(run.sensors["foot_force"]).T, strict=True):
                ax.plot(
                    run.time, force, color=FOOT[foot], lw=2.0 if foot == limb else 1.2, zorder=3
                )
            shade_phases(ax, run.metadata["phases"])
        ax.set(ylabel="" if sbc else "force [N]", xlabel="time [s]" if limb == LIMBS[-1] else "")
    note = f"{profile}, first repeat; thick: the lifted foot; impacts above the axes are cut off"
    return page.finish(foot_entries(stroke, lw=1.8), note)


# --- maze

_TITLES: Final = {
    "time": "time",
    "mean_speed": "mean speed",
    "roll_std": "roll, std",
    "pitch_std": "pitch, std",
}
#: The part of the walk whose sway is shown, starting at this share of it [s of the controller's clock].
_FROM, _SECONDS = 0.3, 12.0
#: Seconds of the controller's clock between two dots on a path, and samples between two of its points.
_DOTS, _THINNED = 10.0, 4


def _maze(outcome: CaseRuns, lines: Lines) -> Drawn:
    recordings: dict[str, dict[bool, Recording]] = {}
    for run in outcome.recordings.values():
        labels = run.metadata.get("labels", {})
        if {"profile", "spine"} <= set(labels):
            recordings.setdefault(str(labels["profile"]), {})[bool(labels["spine"])] = run
    runs = {
        name: dict(sorted(recordings[name].items()))
        for name in (*reversed(SIMULATED), "as_built")
        if name in recordings
    }
    yield "ways", _ways(outcome, runs) if runs else None
    yield "sway", _sway(outcome, runs) if runs else None

    names, panels = profiles(outcome), []
    for column, title in _TITLES.items():
        groups: dict[str, list[Bar]] = {"without": [], "with": []}
        for on, profile in itertools.product((False, True), names):
            mark = published(lines, f"{plain(column)} {WITH[on]}") if profile == names[0] else None
            values = repeats(outcome, column, profile=profile, spine=on)
            groups["with" if on else "without"].append(
                Bar(values, tone(SPINE[on], profile), published=mark)
            )
        panels.append(Panel(groups, xlabel="spine", ylabel=axis_label(outcome, column, title)))
    note = f"{{spread}}; {CLOCK}; the published path is another one of about 5 m"
    yield (
        "walk",
        bar_page("The walk through the maze", (9.6, 4.0), [panels], profile_swatches(names), note),
    )


def _arrival(outcome: CaseRuns, profile: str, on: bool) -> float:
    """Time at which the recorded run reached the end [s of the controller's clock]; NaN if it did not."""
    return outcome.mean("time", profile=profile, spine=on, repeat=0) / clock(profile)


def _ways(outcome: CaseRuns, runs: Mapping[str, Mapping[bool, Recording]]) -> Figure:
    page = FigurePage(
        "Through the maze, seen from above", (0.9 + 5.2 * len(runs), 5.6), 1, len(runs), sharey=True
    )
    course = walks.maze_course()
    course_line = np.stack([course.x, course.y], axis=-1)
    boxes = walks.box_outlines(load_robot(scene="maze"))
    name_at = {
        "textcoords": "offset points",
        "va": "center",
        "fontsize": 9,
        "fontweight": "bold",
        "color": INK,
    }
    arrived = True
    for ax, (profile, paths) in zip(page.axes[0], runs.items(), strict=True):
        corners = np.stack(seen_from_above(ax, boxes), axis=-1)
        ax.add_collection(
            PolyCollection(list(corners), fc=MISSING_COLOUR, ec="white", lw=0.8, zorder=1)
        )
        ax.plot(*seen_from_above(ax, course_line), color=INK, ls="--", lw=1.1, zorder=5)
        for on, run in paths.items():
            end, time, colour = _arrival(outcome, profile, on), run.time / clock(profile), SPINE[on]
            walked = time <= end if np.isfinite(end) else np.full(len(time), True)
            right, ahead = seen_from_above(ax, np.asarray(run.sensors["position"])[walked, :2])
            ax.plot(right[::_THINNED], ahead[::_THINNED], color=colour, lw=1.5, zorder=3 + on)
            dots = np.searchsorted(time[walked], np.arange(_DOTS, time[walked][-1], _DOTS))
            ax.scatter(right[dots], ahead[dots], s=20, color=colour, ec="white", lw=0.6, zorder=5)
            if not np.isfinite(end):
                last = {"color": colour, "ec": "white", "lw": 0.8, "zorder": 7, "gid": "failed"}
                ax.scatter(right[-1], ahead[-1], s=80, marker="X", **last)
                arrived = False
        for name, point in (("start", course_line[0]), ("end", course_line[-1])):
            right, ahead = seen_from_above(ax, point)
            ax.scatter(right, ahead, s=60, marker="o", fc="white", ec=INK, lw=1.6, zorder=6)
            ax.annotate(name, (float(right), float(ahead)), (9, 0), **name_at)
        ax.autoscale_view()
        ax.margins(0.03)
        ax.xaxis.set_major_locator(MultipleLocator(500))
        ax.yaxis.set_major_locator(MultipleLocator(500))
        ax.set_title(plain(profile))
    for ax in page.axes[0][1:]:
        ax.set_ylabel("")
    handles = [
        *spine_strokes(),
        stroke("course", INK, ls="--", lw=1.1),
        swatch("boxes", MISSING_COLOUR),
    ]
    handles.append(stroke(f"every {_DOTS:g} s", MUTED_INK, ls="none", marker="o", ms=4.5))
    if not arrived:
        handles.append(stroke("end not reached", MUTED_INK, ls="none", marker="X", ms=8))
    return page.finish(handles, "the torso's IMU, first repeat; the robot starts upwards")


def _sway(outcome: CaseRuns, runs: Mapping[str, Mapping[bool, Recording]]) -> Figure:
    """Roll and pitch over a part of the walk, starting at the same point of the course."""
    page = FigurePage(
        "How the torso sways in the maze",
        (9.4, 1.2 + 2.6 * len(runs)),
        2 * len(runs),
        1,
        sharex=True,
    )
    for i, (profile, ways) in enumerate(runs.items()):
        pair = page.axes[2 * i : 2 * i + 2, 0]
        for on, run in ways.items():
            time, end = run.time / clock(profile), _arrival(outcome, profile, on)
            begin = _FROM * (end if np.isfinite(end) else time[-1])
            part = (time >= begin) & (time <= begin + _SECONDS)
            for ax, angle in zip(
                pair, attitude_of(run.sensors["orientation"])[part].T, strict=False
            ):
                ax.plot(time[part] - begin, angle, color=SPINE[on], lw=1.2)
        for ax, name in zip(pair, ("roll", "pitch"), strict=True):
            ax.set_ylabel(f"{name} [deg]")
            ax.margins(x=0, y=0.08)
            draw_horizontal_grid(ax)
        pair[0].set_title(plain(profile))
    page.axes[-1, 0].set_xlabel("time [s]")
    begins = f"each run from {_FROM:.0%} of its time on".replace("%", " %")
    note = f"first repeat; {begins}; times are those of the controller's clock; positive: leaning left, nose down"
    return page.finish(spine_strokes(), note)


# --- test stands


def _stand(outcome: CaseRuns, lines: Lines) -> Drawn:
    """A panel for each column, with a bar for each case of each group, as described in `experiments.yaml`."""
    figure_text, profile = texts("stand_figures")[outcome.experiment], outcome.columns["profile"][0]
    panels = []
    for column, measure in figure_text["columns"].items():
        groups, shown_columns = (
            {},
            in_shown_unit(column, outcome.about[column].unit, outcome.columns[column]).values,
        )
        for group, common in figure_text["groups"].items():
            selected = [
                outcome.where(profile=profile, **common, **{figure_text["over"]: name})
                for name in figure_text["names"]
            ]
            groups[group] = [
                Bar(shown_columns[rows], colour)
                for rows, colour in zip(selected, SERIES, strict=False)
            ]
        panels.append(Panel(groups, ylabel=axis_label(outcome, column, measure)))
    handles = [
        swatch(name, colour) for name, colour in zip(figure_text["names"], SERIES, strict=False)
    ]
    note = "on the test stand, without gravity; no such numbers are published"
    yield (
        figure_text["name"],
        bar_page(figure_text["title"], (7.2, 5.2), [panels[:2], panels[2:]], handles, note),
    )


_DRAWERS: Final[dict[str, Callable[[CaseRuns, Lines], Drawn]]] = {
    "straight-line": _straight_line,
    "turning": _turning,
    "balance": _balance,
    "maze": _maze,
    "leg-stand": _stand,
    "spine-stand": _stand,
}
