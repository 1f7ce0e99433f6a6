"""Parallel coordinates: an axis for each parameter, the metric as the last one, a line for each variant."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator

from nermo_mjx.plotting.page import around, blank
from nermo_mjx.plotting.shown import ShownValues
from nermo_mjx.plotting.style import BEST, COLOURS, INK, MUTED, SMALL, colour_scale

#: Lines that are drawn; of more points, as many are chosen evenly by rank.
MOST_LINES: Final = 800
#: The best points, which are always drawn, and thick.
BEST_LINES: Final = 5
#: Axes of parameters.
MOST_AXES: Final = 9
#: An axis with no more values than this has a tick at each.
_EACH: Final = 9


def chosen_lines(costs: np.ndarray) -> np.ndarray:
    """Places of the points that are drawn, the best one last: the best few, and the rest evenly by rank.

    Args:
        costs: (n,), less is better; a NaN is never drawn.
    """
    known = np.flatnonzero(np.isfinite(costs))
    order = known[np.argsort(-costs[known], kind="stable")]
    if len(order) <= MOST_LINES:
        return order
    rest = order[:-BEST_LINES]
    return np.concatenate([rest[np.linspace(0, len(rest) - 1, MOST_LINES).round().astype(int)], order[-BEST_LINES:]])


def parallel(parameters: Sequence[ShownValues], z: ShownValues, title: str, note: str) -> Figure:
    """The figure.

    Args:
        parameters: (n,) each, of the points in the order drawn, the best one last.
        z: the metric of the same points.
    """
    scale, extend = colour_scale(z.values)
    if extend != "neither":
        end = scale.vmax if extend == "max" else scale.vmin
        assert end is not None
        note += f"; {z.name} {'above' if extend == 'max' else 'below'} {z.shown(float(end))} is drawn there"
    axes = [*parameters, dataclasses.replace(z, values=np.clip(z.values, scale.vmin, scale.vmax))]
    figure = blank(1.5 + 1.35 * len(axes), 4.7)
    ax = figure.subplots()
    ways = np.stack([_share(each, each.values) for each in axes], axis=-1)
    places = np.broadcast_to(np.arange(len(axes)), ways.shape)
    lines = np.stack([places, ways], axis=-1)
    few = min(BEST_LINES, len(lines))
    colours = matplotlib.colormaps[COLOURS](scale(z.values))
    # The more lines there are, the more each lets those below through.
    colours[:, 3] = np.clip(90.0 / len(lines), 0.2, 0.8)
    rest = LineCollection(list(lines[:-few]), colors=colours[:-few], linewidths=0.8, zorder=2)
    rest.set_rasterized(len(lines) > 300)
    ax.add_collection(rest)
    ax.add_collection(LineCollection(list(lines[-few:]), colors="white", linewidths=3.4, zorder=3))
    ax.add_collection(LineCollection(list(lines[-few:]), colors=BEST, linewidths=1.7, zorder=4))
    for place, each in enumerate(axes):
        _draw_axis(ax, place, each)
    strip = np.linspace(0, 1, 256)[:, None]
    right = len(axes) - 1
    ax.imshow(strip, cmap=COLOURS, extent=(right - 0.022, right + 0.022, 0, 1), origin="lower", aspect="auto", zorder=5)
    ax.set(xlim=(-0.35, right + 0.55), ylim=(-0.04, 1.04))
    ax.set_xticks(range(len(axes)), [each.label.replace(".", ".\n").replace(" [", "\n[") for each in axes])
    ax.tick_params(axis="x", length=0, labelcolor=INK)
    ax.yaxis.set_visible(False)
    for spine in ax.spines.values():
        spine.set_visible(False)
    return around(figure, title, note)


def _share(axis: ShownValues, values: np.ndarray) -> np.ndarray:
    """Where values stand on an axis, from 0 at its lowest to 1 at its highest."""
    own, wanted = (np.log(axis.values), np.log(values)) if axis.log else (axis.values, np.asarray(values))
    low, high = float(np.nanmin(own)), float(np.nanmax(own))
    return (wanted - low) / (high - low) if high > low else np.full(np.shape(wanted), 0.5)


def _draw_axis(ax: Axes, place: int, axis: ShownValues) -> None:
    """A line with ticks: each value where there are few, else round ones."""
    ax.plot([place, place], [0, 1], color=MUTED, lw=1.0, zorder=5)
    values = np.unique(axis.values[np.isfinite(axis.values)])
    if not axis.names and len(values) > _EACH:
        low, high = values[0], values[-1]
        ticks = LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(low, high) if axis.log else _round_ticks(low, high)
        values = np.array([tick for tick in ticks if low - 1e-9 <= tick <= high + 1e-9 * abs(high)])
    for value, height in zip(values, _share(axis, values), strict=True):
        ax.plot([place, place + 0.03], [height, height], color=MUTED, lw=1.0, zorder=5)
        text = axis.names[int(value)] if axis.names else f"{value + 0.0:.4g}".replace("-", "−")
        ax.annotate(text, (place, height), (5, 0), textcoords="offset points",
                    fontsize=SMALL, color=INK, va="center", zorder=6,
                    bbox={"boxstyle": "round,pad=0.12", "fc": "white", "alpha": 0.8, "lw": 0})  # fmt: skip


def _round_ticks(low: float, high: float) -> np.ndarray:
    return np.asarray(MaxNLocator(5).tick_values(low, high))
