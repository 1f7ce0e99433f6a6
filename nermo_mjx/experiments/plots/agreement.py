"""The numbers of the report as a figure: each as a fraction of the published one, with the numbers next to it.

For an effect, a ratio that expresses how much something changes, the fraction is that of its size, the ratio minus 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from nermo_mjx.experiments.judgement import AGREES, Value
from nermo_mjx.experiments.line import Line
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots.marks import published_entry, swatch, tone
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import BEST, GRID, INK, LINE, MUTED

#: Range of the axis, in shares of the published number; values beyond are arrows at its end.
LEAST, MOST = -0.5, 2.5
_COLOUR, _NEAR, _WRONG = LINE, "#e6f1f8", BEST
_PROFILES: Final = ("exact", "as_published")
#: Right ends of the columns of numbers, in widths of the table.
_COLUMNS: Final = {"published": 0.36, "exact": 0.66, "as_published": 0.98}


def figures(outcome: Outcome, lines: Sequence[Line]) -> Iterator[tuple[str, Figure | None]]:
    """The figure of all numbers that were published and measured."""
    yield "report", _report(outcome, [line for line in lines if _reference(line) is not None and _measured(line)])


def _measured(line: Line) -> bool:
    return any(_number(getattr(line, profile)) is not None for profile in _PROFILES)


def _number(value: Value) -> float | None:
    return None if value is None or isinstance(value, (bool, str)) else float(value)


def _neutral(line: Line) -> float:
    """The value that counts as 0."""
    return 1.0 if line.judged == "effect" else 0.0


def _reference(line: Line) -> float | None:
    """The value that counts as 1, relative to `_neutral`: the published number, an interval's middle, or its end if it
    starts at 0."""
    if isinstance(line.published, tuple):
        low, high = line.published
        return high if low == 0 else 0.5 * (low + high)
    number = _number(line.published)
    return None if number is None else (number - _neutral(line)) or None


def _report(outcome: Outcome, lines: Sequence[Line]) -> Figure | None:
    if not lines:
        return None
    title = f"What was published, and what was measured: {outcome.experiment.replace('-', ' ')}"
    size = (10.6, 1.5 + 0.255 * len(lines))
    page = Page(title, size, 1, 2, sharey=True, gridspec_kw={"width_ratios": [1.35, 1]})
    ax, table = page.axes[0]
    ax.axvspan(1 - AGREES, 1 + AGREES, color=_NEAR, lw=0, zorder=-5)
    ax.axvline(1, color=MUTED, lw=0.8, zorder=0)
    for y, line in enumerate(lines):
        ax.axhline(y, color=GRID, lw=0.8, zorder=-1)
        _row(ax, table, y, line)
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
        table.text(
            x, -0.75, name.replace("_", " "), ha="right", va="center", fontsize=8, fontweight="bold", color=MUTED
        )
    handles: list[Artist] = [published_entry("published")]
    handles += [
        Line2D([], [], ls="none", marker="o", ms=6.5, color=tone(_COLOUR, p), label=p.replace("_", " "))
        for p in _PROFILES
    ]
    handles += [swatch(f"within {AGREES:.0%}".replace("%", " %"), _NEAR)]
    note = (
        "of an effect, a ratio, the share is of the ratio less 1; arrow: beyond the axis; bracket: published as an "
        "interval, of which the diamond is the middle (the end, if it begins at 0); orange: does not agree"
    )
    return page.finish(handles, note)  # fmt: skip


def _row(ax: Axes, table: Axes, y: int, line: Line) -> None:
    reference = _reference(line)
    assert reference is not None
    if isinstance(line.published, tuple):
        low, high = (end / reference for end in line.published)
        ax.plot([low, min(high, MOST)], [y, y], color="black", lw=1.2, marker="|", ms=7, mew=1.2, zorder=3)
    ax.scatter(1, y, s=34, marker="D", fc="white", ec="black", lw=1.2, zorder=4, gid="published")
    for profile in reversed(_PROFILES):
        value = _number(getattr(line, profile))
        if value is None or not np.isfinite(value):
            continue
        share = (value - _neutral(line)) / reference
        place = min(max(share, LEAST), MOST)
        marker = "o" if share == place else (">" if share > place else "<")
        ax.scatter(place, y, s=46, marker=marker, color=tone(_COLOUR, profile), ec="white", lw=0.6, zorder=5,
                   gid=profile)  # fmt: skip
    cells = {"published": line.published} | {profile: getattr(line, profile) for profile in _PROFILES}
    for name, x in _COLUMNS.items():
        wrong = name == "exact" and line.holds is False
        table.text(
            x, y, _text(cells[name], line.unit), ha="right", va="center", fontsize=8, color=_WRONG if wrong else INK
        )


def _text(value: Value | tuple[float, float], unit: str) -> str:
    if isinstance(value, tuple):
        return f"{value[0]:.3g} to {value[1]:.3g} {unit}".rstrip()
    number = _number(value)
    return "–" if number is None else f"{number:.3g} {unit}".rstrip().replace("-", "−")
