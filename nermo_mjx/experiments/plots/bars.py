"""Grouped bars: mean and spread of the repeats, next to theory and publication."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots.marks import Published, mark_published, published_entry, swatch
from nermo_mjx.plotting.shown import shown as in_shown_unit
from nermo_mjx.plotting.style import INK, MUTED, horizontal_grid

#: Share of a group's width that its bars fill.
_FILLED: Final = 0.82
_HATCH: Final = "/////"
_THEORY: Final[dict[str, Any]] = {"color": INK, "lw": 1.6, "ls": (0, (1, 0.6))}
_FAILED: Final[dict[str, Any]] = {"color": INK, "ls": "none", "marker": "x", "ms": 5, "mew": 1.6}


@dataclasses.dataclass(frozen=True)
class Bar:
    """One case.

    Attributes:
        values: of the repeats, (n,), as shown; NaN for a repeat without one. Empty if the case was not run.
        colour: of the bar.
        hatched: whether the bar is hatched.
        theory: theoretical value.
        published: published value.
    """

    values: np.ndarray
    colour: str
    hatched: bool = False
    theory: float = math.nan
    published: Published = None

    @property
    def ran(self) -> bool:
        """Whether the case was run."""
        return len(self.values) > 0

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
    slots = slots or max(len(bars) for bars in groups.values())
    width = _FILLED / slots
    for i, bars in enumerate(groups.values()):
        for j, bar in enumerate(bars):
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
    if not bar.ran:
        return
    if np.isfinite(bar.mean):
        hatch = _HATCH if bar.hatched else None
        ax.bar(x, bar.mean, 0.9 * width, color=bar.colour, hatch=hatch, ec="white", lw=0, zorder=2)
    good = bar.values[np.isfinite(bar.values)]
    if len(good) > 1:
        ax.errorbar(x, good.mean(), good.std(), fmt="none", ecolor=INK, elinewidth=0.9, capsize=1.8, zorder=5)
    if np.isfinite(bar.theory):
        ends = [x - 0.45 * width, x + 0.45 * width]
        ax.plot(ends, [bar.theory] * 2, zorder=4, gid="theory", **_THEORY)
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
