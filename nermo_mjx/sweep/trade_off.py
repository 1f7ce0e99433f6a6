"""A figure of two metrics against each other: all points, the Pareto front, and its best points by name."""

from __future__ import annotations

import string
from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from nermo_mjx.plotting.cloud import cloud, remark
from nermo_mjx.plotting.page import around, blank, note_lines
from nermo_mjx.plotting.shown import ShownValues
from nermo_mjx.plotting.style import BEST, GRID, INK, set_scales

#: Points of the front that are named.
NAMED: Final = 5
_WIDTH: Final = 7.2


def front(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Places of the points that no other point beats, in the order of x.

    A point is dominated by one that is at least as good in both and better in one. Points equal in both count once.

    Args:
        x, y: (n,) costs, less is better; a point with a NaN is left out.
    """
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    order = known[np.lexsort((y[known], x[known]))]
    lowest = np.minimum.accumulate(y[order])
    better = np.concatenate([[True], y[order][1:] < lowest[:-1]])
    return order[better[: len(order)]]


def named_points(x: np.ndarray, y: np.ndarray, most: int = NAMED) -> np.ndarray:
    """Places on a front (n,) of the points to name: both ends, and others at even distances along it."""
    if len(x) <= most:
        return np.arange(len(x))
    steps = np.hypot(np.diff(x) / max(np.ptp(x), 1e-12), np.diff(y) / max(np.ptp(y), 1e-12))
    way = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = np.linspace(0.0, way[-1], most)
    return np.unique(np.abs(way[:, None] - wanted).argmin(axis=0))


def trade_off(
    x: ShownValues,
    y: ShownValues,
    best: np.ndarray,
    sides: tuple[str, str],
    named: Sequence[tuple[int, str]],
    title: str,
    note: str,
) -> Figure:
    """The figure.

    Args:
        x, y: the metrics of all points.
        best: places of the front, in order along it.
        sides: the better direction of x and of y.
        named: a place and what is said of it, for each point with a name; the names are letters.
    """
    letters = string.ascii_uppercase
    lines = [f"{letter}\t{text}" for letter, (_, text) in zip(letters, named, strict=False)]
    words = {"max": "more", "min": "less", "nearest zero": "nearer to zero"}
    lines.append(f"{note}orange: nothing is better in both ({x.name}: {words[sides[0]]}, {y.name}: {words[sides[1]]})")
    text = "\n".join(lines) + remark(len(x.values))
    figure = blank(_WIDTH, 4.4 + 0.15 * len(note_lines(text, _WIDTH)))
    ax = figure.subplots()
    cloud(ax, x, y, size=5 if len(x.values) > 2000 else 12)
    if "nearest zero" not in sides:
        ax.plot(*_stairs(x.values[best], y.values[best], sides), color=BEST, lw=1.4, zorder=3)
    ax.scatter(x.values[best], y.values[best], s=26, color=BEST, ec="white", lw=0.6, zorder=4)
    set_scales(ax, x, y)
    ax.margins(0.06)
    # Labels are placed on the better direction of their points, where there is nothing else.
    right, up = (1 if side == "max" else -1 for side in sides)
    for letter, (place, _) in zip(letters, named, strict=False):
        ax.annotate(letter, (x.values[place], y.values[place]), (7 * right, 7 * up), textcoords="offset points",
                    ha="center", va="center", fontweight="bold", color=INK, zorder=5)  # fmt: skip
    ax.grid(color=GRID, lw=0.8)
    ax.set_axisbelow(True)
    ax.set(xlabel=x.label, ylabel=y.label)
    return around(figure, title, text)


def _stairs(x: np.ndarray, y: np.ndarray, sides: tuple[str, str]) -> tuple[np.ndarray, np.ndarray]:
    """The edge of what a front beats: between two of its points it goes by the worse of both numbers."""
    worse_x, worse_y = (np.minimum if side == "max" else np.maximum for side in sides)
    corners = worse_x(x[1:], x[:-1]), worse_y(y[1:], y[:-1])
    return tuple(  # type: ignore[return-value]
        np.concatenate([np.stack([points[:-1], turns], axis=1).ravel(), points[-1:]])
        for points, turns in zip((x, y), corners, strict=True)
    )
