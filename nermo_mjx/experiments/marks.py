"""Elements that the experiments' figures share: colours by meaning, marks and legends, and grouped bars.

One colour has one meaning throughout. The profile that is judged, `as_published`, is drawn in full colour, the others
lighter, and published values in black outline.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from nermo_mjx.control.parameters import SIMULATED
from nermo_mjx.experiments.cases import Outcome
from nermo_mjx.experiments.lines import Line
from nermo_mjx.kinematics.body import attitude
from nermo_mjx.plotting.shown import shown as in_shown_unit
from nermo_mjx.plotting.style import INK, MUTED, OKABE_ITO, SHADE, horizontal_grid, light
from nermo_mjx.recording import Recording

SPINE: Final = {False: OKABE_ITO["blue"], True: OKABE_ITO["vermilion"]}
WITH: Final = {False: "without spine", True: "with spine"}
COMPENSATED: Final = OKABE_ITO["purple"]
STRATEGY: Final = {"leg": OKABE_ITO["green"], "spine": OKABE_ITO["purple"], "mix": OKABE_ITO["orange"]}
PASS, FAIL = "#c6dff0", "#f6cfb5"
GAIT: Final = {"trt": "trot", "trt1": "walking trot", "lat": "lateral walk"}
CLOCK: Final = "times and speeds are those of the controller's clock"
ANGLES: Final = ("roll", "pitch", "yaw")
#: Share of a group's width that its bars fill.
_FILLED: Final = 0.82
_HATCH: Final = "/////"
_THEORY: Final[dict[str, Any]] = {"color": INK, "lw": 1.6, "ls": (0, (1, 0.6))}
_FAILED: Final[dict[str, Any]] = {"color": INK, "ls": "none", "marker": "x", "ms": 5, "mew": 1.6}
Published = float | tuple[float, float] | None


def published(lines: Iterable[Line], figure: str) -> Published:
    """The publication's number or interval for a figure of the report; None if the lines do not have it."""
    for line in lines:
        if line.figure == figure and line.published is not None and not isinstance(line.published, bool | str):
            return tuple(line.published) if isinstance(line.published, list) else line.published
    return None


def profiles(outcome: Outcome) -> list[str]:
    """The simulated profiles of an outcome, `as_published` first; the few cases of `as_built` stand in the report."""
    found = set(map(str, outcome.columns["profile"]))
    return [name for name in reversed(SIMULATED) if name in found] or sorted(found)


def tone(colour: str, profile: str) -> str:
    """The colour in a profile."""
    return light(colour) if profile == "exact" else colour


def shown(profile: str) -> str:
    """A profile's display name."""
    return profile.replace("_", " ")


def swatch(name: str, colour: str, **patch: Any) -> Patch:
    """A legend's entry for a filled area."""
    return Patch(facecolor=colour, label=name, **patch)


def stroke(name: str, colour: str, **line: Any) -> Line2D:
    """A legend's entry for a line."""
    return Line2D([], [], color=colour, label=name, **line)


def spine_strokes(**line: Any) -> list[Artist]:
    """Legend entries for lines without and with the spine."""
    return [stroke(WITH[on], SPINE[on], **({"lw": 1.7} | line)) for on in (False, True)]


def spine_swatches() -> list[Artist]:
    """Legend entries for bars without and with the spine."""
    return [swatch(WITH[on], SPINE[on]) for on in (False, True)]


def profile_swatches(names: Sequence[str]) -> list[Artist]:
    """Legend entries for the profiles, if there are several."""
    return [swatch(shown(name), tone("#444444", name)) for name in names] if len(names) > 1 else []


def mark_published(ax: Axes, x: float, value: Published) -> None:
    """The publication's number as a white diamond in black outline; an interval as a bracket around it."""
    if value is None:
        return
    low, high = value if isinstance(value, tuple) else (value, value)
    if high > low:
        ax.errorbar(
            x, (low + high) / 2, (high - low) / 2, fmt="none", ecolor="black", elinewidth=1.1, capsize=3, zorder=6
        )
    ax.scatter(x, (low + high) / 2, s=34, marker="D", fc="white", ec="black", lw=1.2, zorder=7, gid="published")


def published_entry() -> Line2D:
    """The legend's entry of `mark_published`."""
    return Line2D([], [], ls="none", marker="D", ms=5.5, mfc="white", mec="black", mew=1.2, label="published")


def shade_phases(ax: Axes, phases: Mapping[str, Sequence[float]], *, named: bool = True) -> None:
    """Phases on alternating grey backgrounds, each with its name above the axes."""
    for i, (name, (begin, end)) in enumerate(phases.items()):
        if i % 2 == 0:
            ax.axvspan(begin, end, color=SHADE, lw=0, zorder=-5)
        if named:
            ax.text((begin + end) / 2, 1.01, name, transform=ax.get_xaxis_transform(), ha="center", va="bottom",
                    fontsize=7.5, color=MUTED)  # fmt: skip
    ends = [time for phase in phases.values() for time in phase]
    ax.set_xlim(min(ends), max(ends))


def angles(recording: Recording) -> np.ndarray:
    """Roll, pitch and yaw of the torso over time, (T, 3) [deg]; with unwrapped yaw."""
    found = np.array(attitude(jnp.asarray(recording.sensors["orientation"])), float)
    found[:, 2] = np.unwrap(found[:, 2])
    return np.degrees(found)


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
    colour: str
    hatched: bool = False
    theory: float = math.nan
    published: Published = None

    @property
    def mean(self) -> float:
        """Mean of the repeats with a value; NaN if there are none."""
        good = self.values[np.isfinite(self.values)]
        return float(good.mean()) if len(good) else math.nan

    @property
    def failed(self) -> bool:
        """Whether a repeat has no value."""
        return not np.isfinite(self.values).all()


def repeats(outcome: Outcome, column: str, **wanted: object) -> np.ndarray:
    """Values of the repeats of one case in shown units (deg, mm, mm/s); NaN for a run that did not end well.

    Empty if the table has no such case.
    """
    rows = outcome.where(**wanted)
    values = in_shown_unit(column, outcome.about[column].unit, outcome.columns[column][rows]).values
    well = outcome.columns["status"][rows] == "ok" if "status" in outcome.columns else np.full(len(values), True)
    return np.where(well & np.isfinite(values), values, np.nan)


def only(values: np.ndarray) -> float:
    """The value that all repeats share; NaN without one."""
    good = values[np.isfinite(values)]
    return float(good[0]) if len(good) else math.nan


def axis_label(outcome: Outcome, column: str, name: str) -> str:
    """Name and shown unit of a column."""
    return in_shown_unit(name, outcome.about[column].unit, np.zeros(0)).label


def draw_bars(ax: Axes, groups: Mapping[str, Sequence[Bar]], *, slots: int | None = None) -> list[Bar]:
    """Draw groups of bars side by side, and return all bars; without a group, nothing.

    A bar is the mean of the repeats, with an error bar of one standard deviation if there are several. A cross at the
    foot of a bar, or in its place, marks a repeat without a value.

    Args:
        groups: name on the axis -> its bars.
        slots: number of bars that fit in a group; by default that of the longest group.
    """
    if not groups:
        return []
    width = _FILLED / (slots or max(len(bars) for bars in groups.values()))
    for i, bars in enumerate(groups.values()):
        for j, bar in enumerate(bars):
            if len(bar.values):
                _draw(ax, i + (j - (len(bars) - 1) / 2) * width, width, bar)
    if not any(np.isfinite(bar.mean) for bars in groups.values() for bar in bars):
        ax.bar(0, 0, alpha=0)  # the axis still begins at 0
    ax.set_xticks(range(len(groups)), list(groups))
    ax.tick_params(axis="x", length=0)
    ax.set_xlim(-0.55, len(groups) - 0.45)
    ax.margins(y=0.08)
    horizontal_grid(ax)
    return [bar for bars in groups.values() for bar in bars]


def _draw(ax: Axes, x: float, width: float, bar: Bar) -> None:
    if np.isfinite(bar.mean):
        hatch = _HATCH if bar.hatched else None
        ax.bar(x, bar.mean, 0.9 * width, color=bar.colour, hatch=hatch, ec="white", lw=0, zorder=2)
    good = bar.values[np.isfinite(bar.values)]
    if len(good) > 1:
        ax.errorbar(x, good.mean(), good.std(), fmt="none", ecolor=INK, elinewidth=0.9, capsize=1.8, zorder=5)
    if np.isfinite(bar.theory):
        ax.plot([x - 0.45 * width, x + 0.45 * width], [bar.theory] * 2, zorder=4, gid="theory", **_THEORY)
    if bar.failed:
        foot = ax.get_xaxis_transform()
        ax.plot(x, 0.025, transform=foot, zorder=8, gid="failed", clip_on=False, **_FAILED)
    mark_published(ax, x, bar.published)


def bar_entries(bars: Sequence[Bar], *, hatched: str = "") -> list[Artist]:
    """Legend entries for what these bars show in addition to their height."""
    entries: list[Artist] = []
    if any(np.isfinite(bar.theory) for bar in bars):
        entries.append(Line2D([], [], label="theory, no slip", **_THEORY))
    if any(bar.published is not None for bar in bars):
        entries.append(published_entry())
    if any(bar.hatched for bar in bars):
        entries.append(swatch(hatched, MUTED, hatch=_HATCH, ec="white", lw=0))
    if any(bar.failed for bar in bars):
        entries.append(Line2D([], [], label="a repeat without result", **_FAILED))
    return entries


def spread_note(bars: Sequence[Bar]) -> str:
    """A note on the number of repeats and the meaning of the error bars."""
    most = max((len(bar.values) for bar in bars), default=0)
    return f"mean of {most} repeats; error bars: one standard deviation" if most > 1 else "one run a case"
