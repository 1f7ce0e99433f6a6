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
    blank_figure,
    cell_edges,
    cell_means,
    colour_bar,
    finish_page,
    set_scales,
    signed_percentage,
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


# Long because one figure is laid out from top to bottom.
def optimum_figure(optimum: FoundOptimum) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of what was found; none where nothing was."""
    answers, question = (
        [line_answer for line_answer in optimum.answers if line_answer.at][:_MOST_DRAWN],
        optimum.asked,
    )
    if not answers:
        return
    gains = [
        100 * (line_answer.mean / line_answer.base_mean - 1) * np.sign(line_answer.base_mean)
        for line_answer in answers
    ]
    finite_gains = np.concatenate(gains)[np.isfinite(np.concatenate(gains))] * (
        1 if question.side == "max" else -1
    )
    # Symmetric about 0; losses far beyond the best gain are cut off, as they would leave the gains pale.
    far = max(finite_gains.max(initial=0.0), 0.3 * np.abs(finite_gains).max(initial=1e-9))
    colours = ScalarMappable(
        Normalize(-far, far), GAIN_COLOUR_MAP if question.side == "max" else f"{GAIN_COLOUR_MAP}_r"
    )
    columns = min(len(answers), _COLUMNS)
    lines = -(-len(answers) // columns)
    figure = blank_figure(2.75 * columns + 1.1, 4.3 * lines + 1.0)
    grid = figure.subplots(
        2 * lines, columns, squeeze=False, gridspec_kw={"height_ratios": [3.0, 0.85] * lines}
    )
    maps, below = (grid[first::2].ravel()[: len(answers)] for first in (0, 1))
    for ax in {*grid.ravel()} - {*maps, *below}:
        ax.remove()
    across = [
        name
        for name, line_answer in answers[0].points.items()
        if len(set(line_answer.tolist())) > 1
    ] or list(answers[0].points)
    flat = len(across) > 1
    for i, (ax, answer, gain) in enumerate(zip(maps, answers, gains, strict=True)):
        _draw_group(ax, optimum, answer, gain, across, colours, first=not i % columns)
    if flat:
        label = f"{spoken(question.metric)} against {optimum.base} [%]"
        bar = colour_bar(figure, list(maps), colours, label, extend="both", shrink=0.9, aspect=26)
        bar.ax.yaxis.set_major_formatter(
            FuncFormatter(lambda value, _: signed_percentage(value).removesuffix(" %"))
        )
    _draw_costs(optimum, answers, list(below))
    frame: dict[str, Any] = (
        {"lw": 1.6, "color": INK} if flat else {"marker": "o", "lw": 0, "color": SERIES[0]}
    )
    handles = [
        Line2D([], [], label="best point", **_STAR),
        Line2D([], [], label="points that the data cannot tell from it", **frame),
    ]
    notes = [
        *optimum.how(),
        f"Map: mean of the runs that chose; {profile_text(profiles_of(optimum.results))}.",
    ]
    notes += (
        [f"Not shown: {', '.join(map(spoken, across[2:]))}, at their best."] if across[2:] else []
    )
    notes += (
        [f"{len(optimum.answers) - len(answers)} more are in the table."]
        if len(optimum.answers) > len(answers)
        else []
    )
    yield "optimum", finish_page(figure, optimum.title, " ".join(notes), handles)


def _draw_group(
    ax: Axes,
    optimum: FoundOptimum,
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
    x, *other_axes = (_axis(optimum, name, answer.points[name]) for name in across[:2])
    here, inside = answer.judged.best, answer.judged.region
    if flat:
        shown_here = np.logical_and.reduce(
            [
                np.full(len(gain), True),
                *(answer.points[name] == answer.at[name] for name in across[2:]),
            ]
        )
        _draw_map(ax, [x, *other_axes], gain, inside, shown_here, colours)
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
    ax.plot(x.values[here], (other_axes[0].values if flat else gain)[here], **_STAR, clip_on=False)
    set_scales(ax, x, other_axes[0] if flat else None)
    _, share, ends = optimum.numbers(answer, optimum.asked.metric)
    group_text = ", ".join(optimum.text(key, value) for key, value in answer.at.items())
    ax.set_title(f"{share} {ends}\nat {group_text}", color=INK)
    head: dict[str, Any] = {"ha": "center", "fontweight": "bold", "color": INK}
    ax.annotate(optimum.called(answer), (0.5, 1), (0, 29), "axes fraction", "offset points", **head)
    ax.set(
        xlabel=x.label,
        ylabel=""
        if not first
        else other_axes[0].label
        if flat
        else f"gain against {optimum.base} [%]",
    )
    ax.tick_params(labelleft=first or not flat)


def _axis(optimum: FoundOptimum, name: str, values: np.ndarray) -> ShownValues:
    """A column of points as an axis; names stand at their places."""
    metadata = meta(optimum.results.schema.field(name))
    if metadata.get("scale") == "structure":
        names = tuple(dict.fromkeys(values.tolist()))
        return ShownValues(
            name, "", np.array([names.index(label) for label in values], float), names=names
        )
    return shown(name, metadata["unit"], values, log=metadata.get("scale") == "log")


def _draw_map(
    ax: Axes,
    axes: Sequence[ShownValues],
    gain: np.ndarray,
    region: np.ndarray,
    here: np.ndarray,
    look: ScalarMappable,
) -> None:
    """The gain of the points that are `here` (k,) as colours, and a line around the region."""
    x, y = (
        dataclasses.replace(axis_values, values=axis_values.values[here]) for axis_values in axes
    )
    xs, ys = np.unique(x.values), np.unique(y.values)
    cells, inside = (
        cell_means(x.values, y.values, axis_values[here] * 1.0, xs, ys)
        for axis_values in (gain, region)
    )
    columns, rows = cell_edges(xs, x.log), cell_edges(ys, y.log)
    scale: Any = look.norm
    ax.set_facecolor(MISSING_COLOUR)
    ax.pcolormesh(columns, rows, np.ma.masked_invalid(cells.T), norm=scale, cmap=look.cmap)
    framed = np.pad(inside > 0, 1)
    upright, level = (
        zip(*np.nonzero(np.diff(axis_values, axis=axis)), strict=True)
        for axis, axis_values in enumerate((framed[:, 1:-1], framed[1:-1]))
    )
    sides = [(columns[[i, i]], rows[j : j + 2]) for i, j in upright] + [
        (columns[i : i + 2], rows[[j, j]]) for i, j in level
    ]
    for across, up in sides:
        ax.plot(across, up, color=INK, lw=1.8, solid_capstyle="round", clip_on=False)


def _draw_costs(
    optimum: FoundOptimum, answers: Sequence[OptimumAnswer], axes: Sequence[Axes]
) -> None:
    """Below each map what fresh runs say of the metric and both costs, relative to the base, on one scale."""
    lines = [
        [answer_lines.lines.get(name, {}) for name in optimum.metrics] for answer_lines in answers
    ]
    ends = [
        abs(line.get(end, math.nan))
        for answer_line in lines
        for line in answer_line
        for end in ("relative_low", "relative_high")
    ]
    far = 115 * float(np.nanmax([*ends, 0.01]))
    for i, (ax, answer_line) in enumerate(zip(axes, lines, strict=True)):
        ax.axvline(0, color=MUTED_INK, lw=0.8)
        for bar_index, line in enumerate(answer_line):
            if not math.isfinite(line.get("relative", math.nan)):
                continue
            low, middle, high = (
                100 * line[name] for name in ("relative_low", "relative", "relative_high")
            )
            colour, sure = SERIES[bar_index], low > 0 or high < 0
            ax.plot([low, high], [bar_index] * 2, color=colour, lw=2.2, solid_capstyle="butt")
            ax.plot(middle, bar_index, "o", ms=5.5, color=colour, mfc=colour if sure else "white")
        ax.set_yticks(
            range(len(answer_line)),
            [_SHORT.get(name, titled(name)) for name in optimum.metrics] if i == 0 else [],
        )
        ax.set(
            ylim=(len(answer_line) - 0.5, -0.5),
            xlim=(-far, far),
            xlabel=f"against {optimum.base} [%]",
        )
        ax.grid(axis="x", color=GRID, lw=0.8)
        ax.spines["left"].set_visible(False)
        ax.tick_params(axis="y", length=0, labelcolor=INK)


_SHORT: Final = {
    "cost_of_transport": "Mechanical cost",
    "electrical_cost_of_transport": "Electrical cost",
}
