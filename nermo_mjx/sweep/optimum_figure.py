"""The figure of an optimum: a map of the gain for each group, the region as a contour, and below it the costs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from nermo_mjx.plotting.charts import (
    around,
    blank,
    cell_edges,
    cell_means,
    colour_bar,
    set_scales,
    signed,
)
from nermo_mjx.plotting.shown import ShownValues, shown, spoken, titled
from nermo_mjx.plotting.style import (
    BEST_COLOUR,
    GAIN_COLOUR_MAP,
    GRID,
    INK,
    MISSING_COLOUR,
    MUTED_INK,
    SERIES,
)
from nermo_mjx.sweep.optimum import FoundOptimum, OptimumAnswer
from nermo_mjx.sweep.table import (
    meta,
    profile_text,
    profiles_of,
)

#: Groups of one figure.
_MOST_DRAWN: Final = 9
_COLUMNS: Final = 3
_STAR: Final[dict[str, Any]] = {
    "marker": "*",
    "ms": 14,
    "color": BEST_COLOUR,
    "mec": "white",
    "lw": 0,
    "zorder": 4,
}


def optimum_figure(found: FoundOptimum) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of what was found; none where nothing was."""
    answers, asked = [each for each in found.answers if each.at][:_MOST_DRAWN], found.asked
    if not answers:
        return
    gains = [100 * (each.mean / each.base_mean - 1) * np.sign(each.base_mean) for each in answers]
    known = np.concatenate(gains)[np.isfinite(np.concatenate(gains))] * (
        1 if asked.side == "max" else -1
    )
    # Symmetric about 0; losses far beyond the best gain are cut off, as they would leave the gains pale.
    far = max(known.max(initial=0.0), 0.3 * np.abs(known).max(initial=1e-9))
    colours = ScalarMappable(
        Normalize(-far, far), GAIN_COLOUR_MAP if asked.side == "max" else f"{GAIN_COLOUR_MAP}_r"
    )
    columns = min(len(answers), _COLUMNS)
    lines = -(-len(answers) // columns)
    figure = blank(2.75 * columns + 1.1, 4.3 * lines + 1.0)
    grid = figure.subplots(
        2 * lines, columns, squeeze=False, gridspec_kw={"height_ratios": [3.0, 0.85] * lines}
    )
    maps, below = (grid[first::2].ravel()[: len(answers)] for first in (0, 1))
    for ax in {*grid.ravel()} - {*maps, *below}:
        ax.remove()
    across = [
        name for name, each in answers[0].points.items() if len(set(each.tolist())) > 1
    ] or list(answers[0].points)
    flat = len(across) > 1
    for i, (ax, answer, gain) in enumerate(zip(maps, answers, gains, strict=True)):
        _draw_group(ax, found, answer, gain, across, colours, first=not i % columns)
    if flat:
        label = f"{spoken(asked.metric)} against {found.base} [%]"
        bar = colour_bar(figure, list(maps), colours, label, extend="both", shrink=0.9, aspect=26)
        bar.ax.yaxis.set_major_formatter(
            FuncFormatter(lambda value, _: signed(value).removesuffix(" %"))
        )
    _draw_costs(found, answers, list(below))
    frame: dict[str, Any] = (
        {"lw": 1.6, "color": INK} if flat else {"marker": "o", "lw": 0, "color": SERIES[0]}
    )
    handles = [
        Line2D([], [], label="best point", **_STAR),
        Line2D([], [], label="points that the data cannot tell from it", **frame),
    ]
    notes = [
        *found.how(),
        f"Map: mean of the runs that chose; {profile_text(profiles_of(found.results))}.",
    ]
    notes += (
        [f"Not shown: {', '.join(map(spoken, across[2:]))}, at their best."] if across[2:] else []
    )
    notes += (
        [f"{len(found.answers) - len(answers)} more are in the table."]
        if len(found.answers) > len(answers)
        else []
    )
    yield "optimum", around(figure, found.title, " ".join(notes), handles)


def _draw_group(
    ax: Axes,
    found: FoundOptimum,
    answer: OptimumAnswer,
    gain: np.ndarray,
    across: Sequence[str],
    colours: ScalarMappable,
    *,
    first: bool,
) -> None:
    """The gain of the points of a group, (k,), over the first two columns `across`, as a map, or over one as a line.

    Args:
        first: whether it stands at the left, where the vertical axis is labelled.
    """
    flat = len(across) > 1
    x, *more = (_axis(found, name, answer.points[name]) for name in across[:2])
    here, inside = answer.judged.best, answer.judged.region
    if flat:
        shown_here = np.logical_and.reduce(
            [
                np.full(len(gain), True),
                *(answer.points[name] == answer.at[name] for name in across[2:]),
            ]
        )
        _draw_map(ax, [x, *more], gain, inside, shown_here, colours)
    else:
        order = np.argsort(x.values)
        ax.plot(x.values[order], gain[order], color=SERIES[0], lw=1.2, zorder=2)
        ax.scatter(
            x.values,
            gain,
            s=30,
            ec=SERIES[0],
            fc=np.where(inside, SERIES[0], "white"),
            zorder=3,
        )
        ax.axhline(0, color=MUTED_INK, lw=0.8)
    ax.plot(x.values[here], (more[0].values if flat else gain)[here], **_STAR, clip_on=False)
    set_scales(ax, x, more[0] if flat else None)
    _, share, ends = found.numbers(answer, found.asked.metric)
    place = ", ".join(found.text(key, value) for key, value in answer.at.items())
    ax.set_title(f"{share} {ends}\nat {place}", color=INK)
    head: dict[str, Any] = {"ha": "center", "fontweight": "bold", "color": INK}
    ax.annotate(found.called(answer), (0.5, 1), (0, 29), "axes fraction", "offset points", **head)
    ax.set(
        xlabel=x.label,
        ylabel="" if not first else more[0].label if flat else f"gain against {found.base} [%]",
    )
    ax.tick_params(labelleft=first or not flat)


def _axis(found: FoundOptimum, name: str, values: np.ndarray) -> ShownValues:
    """A column of points as an axis; names stand at their places."""
    about = meta(found.results.schema.field(name))
    if about.get("scale") == "structure":
        names = tuple(dict.fromkeys(values.tolist()))
        return ShownValues(
            name, "", np.array([names.index(each) for each in values], float), names=names
        )
    return shown(name, about["unit"], values, log=about.get("scale") == "log")


def _draw_map(
    ax: Axes,
    axes: Sequence[ShownValues],
    gain: np.ndarray,
    region: np.ndarray,
    here: np.ndarray,
    look: ScalarMappable,
) -> None:
    """The gain of the points that are `here` (k,) as colours, and a line around the region."""
    x, y = (dataclasses.replace(each, values=each.values[here]) for each in axes)
    xs, ys = np.unique(x.values), np.unique(y.values)
    cells, inside = (
        cell_means(x.values, y.values, each[here] * 1.0, xs, ys) for each in (gain, region)
    )
    columns, rows = cell_edges(xs, x.log), cell_edges(ys, y.log)
    scale: Any = look.norm
    ax.set_facecolor(MISSING_COLOUR)
    ax.pcolormesh(columns, rows, np.ma.masked_invalid(cells.T), norm=scale, cmap=look.cmap)
    framed = np.pad(inside > 0, 1)
    upright, level = (
        zip(*np.nonzero(np.diff(each, axis=axis)), strict=True)
        for axis, each in enumerate((framed[:, 1:-1], framed[1:-1]))
    )
    sides = [(columns[[i, i]], rows[j : j + 2]) for i, j in upright] + [
        (columns[i : i + 2], rows[[j, j]]) for i, j in level
    ]
    for across, up in sides:
        ax.plot(across, up, color=INK, lw=1.8, solid_capstyle="round", clip_on=False)


def _draw_costs(
    found: FoundOptimum, answers: Sequence[OptimumAnswer], axes: Sequence[Axes]
) -> None:
    """Below each map what fresh runs say of the metric and both costs, relative to the base, on one scale."""
    lines = [[each.lines.get(name, {}) for name in found.metrics] for each in answers]
    ends = [
        abs(line.get(end, math.nan))
        for own in lines
        for line in own
        for end in ("relative_low", "relative_high")
    ]
    far = 115 * float(np.nanmax([*ends, 0.01]))
    for i, (ax, own) in enumerate(zip(axes, lines, strict=True)):
        ax.axvline(0, color=MUTED_INK, lw=0.8)
        for place, line in enumerate(own):
            if not math.isfinite(line.get("relative", math.nan)):
                continue
            low, middle, high = (
                100 * line[name] for name in ("relative_low", "relative", "relative_high")
            )
            colour, sure = SERIES[place], low > 0 or high < 0
            ax.plot([low, high], [place] * 2, color=colour, lw=2.2, solid_capstyle="butt")
            ax.plot(middle, place, "o", ms=5.5, color=colour, mfc=colour if sure else "white")
        ax.set_yticks(
            range(len(own)),
            [_SHORT.get(name, titled(name)) for name in found.metrics] if i == 0 else [],
        )
        ax.set(ylim=(len(own) - 0.5, -0.5), xlim=(-far, far), xlabel=f"against {found.base} [%]")
        ax.grid(axis="x", color=GRID, lw=0.8)
        ax.spines["left"].set_visible(False)
        ax.tick_params(axis="y", length=0, labelcolor=INK)


_SHORT: Final = {
    "cost_of_transport": "Mechanical cost",
    "electrical_cost_of_transport": "Electrical cost",
}
