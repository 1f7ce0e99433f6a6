"""How the figures of a sweep look: heat maps, lines and scatters of one metric. What to draw is `plots.py`'s."""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullLocator

#: One look for all figures; viridis and blue on white read well for the colour-blind and in print.
STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.5,
    "figure.titlesize": 11.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.labelcolor": "#222222",
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "axes.grid": False,
    "legend.frameon": False,
    "svg.hashsalt": "nermo",
    "svg.fonttype": "none",
}
COLOURS = "viridis"
LINE, BAND, MISSING, BEST = "#23648f", "#9dc3de", "#d9d9d9", "#e4572e"
_SHOWN_UNITS = {
    "rad": ("deg", 180 / math.pi),
    "m/s": ("mm/s", 1e3),
    "m": ("mm", 1e3),
    "rad/s": ("deg/s", 180 / math.pi),
}


@dataclasses.dataclass(frozen=True)
class Quantity:
    """Values of one column as a figure shows them: angles in degrees, lengths in mm, speeds in mm/s.

    Attributes:
        name, unit: what the axis is called; the unit is empty for a pure number.
        values: (n,), in that unit.
        log: whether the axis is logarithmic.
    """

    name: str
    unit: str
    values: np.ndarray
    log: bool = False

    @property
    def label(self) -> str:
        """Name and unit for an axis."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def shown(self, value: float) -> str:
        """One value with its unit, for a title."""
        return f"{value + 0.0:.4g} {self.unit}".rstrip()


def shown(name: str, unit: str, values: np.ndarray, *, log: bool = False) -> Quantity:
    """A column in SI units as a `Quantity`."""
    unit, factor = _SHOWN_UNITS.get(unit, ("" if unit == "1" else unit, 1.0))
    return Quantity(name, unit, np.asarray(values, dtype=float) * factor, log)


def heat_maps(
    x: Quantity, y: Quantity, z: Quantity, panels: Sequence[tuple[str, np.ndarray]], title: str, note: str
) -> Figure:
    """One heat map a panel (its title, and a mask of the points in it) on a shared colour scale.

    Points that share a cell are averaged. The best cell of all is a star, that of each panel a ring; a cell without
    a run that went well is hatched grey.
    """
    xs, ys = np.unique(x.values), np.unique(y.values)
    grids = [_cell_means(x.values[mask], y.values[mask], z.values[mask], xs, ys) for _, mask in panels]
    scale = Normalize(*_limits(np.concatenate([grid.ravel() for grid in grids])))
    figure, axes = _panels(len(panels), 2.5 if len(panels) > 1 else 4.4, title)
    best = max((float(np.nanmax(grid)) for grid in grids if np.isfinite(grid).any()), default=math.nan)
    for ax, (name, _), grid in zip(axes, panels, grids, strict=False):
        ax.add_patch(matplotlib.patches.Rectangle((0, 0), 1, 1, transform=ax.transAxes, fc=MISSING, ec="white",
                                                  hatch="////", lw=0, zorder=0))  # fmt: skip
        ax.pcolormesh(_edges(xs, x.log), _edges(ys, y.log), np.ma.masked_invalid(grid.T), norm=scale, cmap=COLOURS)
        _scales(ax, x, y)
        ax.set_title(name)
        if np.isfinite(grid).any():
            i, j = np.unravel_index(int(np.nanargmax(grid)), grid.shape)
            marker, size = ("*", 190) if grid[i, j] == best else ("o", 34)
            ax.scatter(xs[i], ys[j], s=size, marker=marker, fc=BEST if marker == "*" else "none", ec="white", lw=1.3,
                       zorder=5, clip_on=False)  # fmt: skip
    _outer_labels(figure, axes, len(panels), x.label, y.label)
    _colour_bar(figure, axes, scale, z.label)
    ring = "; ring: best of its panel" if len(panels) > 1 else ""
    _note(figure, f"{note}star: best, {z.shown(best)}{ring}")
    return figure


def line(x: Quantity, z: Quantity, title: str, note: str) -> Figure:
    """Mean over x, with a band of one standard deviation where points share an x, and the best point as a star."""
    figure, (ax,) = _panels(1, 4.4, title)
    xs, mean, std = _binned(x.values, z.values, np.unique(x.values))
    ax.fill_between(xs, mean - std, mean + std, color=BAND, alpha=0.6, lw=0)
    ax.plot(xs, mean, "-o", color=LINE, ms=4, mec="white", mew=0.6)
    if np.isfinite(mean).any():
        at = int(np.nanargmax(mean))
        ax.scatter(xs[at], mean[at], s=170, marker="*", fc=BEST, ec="white", zorder=5, clip_on=False)
        note += f"star: best, {z.shown(mean[at])} at {x.shown(xs[at])}"
    _scales(ax, x)
    _horizontal_grid(ax)
    ax.set(xlabel=x.label, ylabel=z.label)
    _note(figure, note)
    return figure


def scatters(xs: Sequence[Quantity], z: Quantity, titles: Sequence[str], title: str, note: str) -> Figure:
    """The metric against each parameter: every run a point, the line a running mean over runs of alike value."""
    figure, axes = _panels(len(xs), 2.5, title)
    for ax, x, name in zip(axes, xs, titles, strict=False):
        ax.scatter(x.values, z.values, s=7, color=BAND, alpha=0.55, lw=0, rasterized=len(z.values) > 2000)
        centres, mean, _ = _binned(x.values, z.values, np.quantile(x.values, np.linspace(0, 1, 9)))
        ax.plot(centres, mean, color=LINE, lw=2)
        _scales(ax, x)
        _horizontal_grid(ax)
        ax.set_title(name)
        ax.set_xlabel(x.label)
    figure.supylabel(z.label, fontsize=9.5)
    _note(figure, note)
    return figure


def pair_scatters(pairs: Sequence[tuple[Quantity, Quantity]], z: Quantity, title: str, note: str) -> Figure:
    """Every run a point over two parameters, coloured by the metric; good runs lie on top, the best is a star."""
    figure, axes = _panels(len(pairs), 2.7, title)
    scale, order = Normalize(*_limits(z.values)), np.argsort(z.values)
    for ax, (x, y) in zip(axes, pairs, strict=False):
        ax.scatter(x.values[order], y.values[order], c=z.values[order], s=14, norm=scale, cmap=COLOURS, lw=0,
                   rasterized=len(z.values) > 2000)  # fmt: skip
        ax.scatter(x.values[order[-1]], y.values[order[-1]], s=170, marker="*", fc=BEST, ec="white", zorder=5)
        _scales(ax, x, y)
        ax.set(xlabel=x.label, ylabel=y.label)
    _colour_bar(figure, axes, scale, z.label)
    _note(figure, f"{note}star: best, {z.shown(float(np.max(z.values)))}")
    return figure


def encode(figure: Figure, form: str) -> bytes:
    """The figure as PNG or SVG; the same figure gives the same bytes."""
    stream = io.BytesIO()
    figure.savefig(stream, format=form, dpi=160, metadata={"Date": None} if form == "svg" else {"Software": None})
    return stream.getvalue()


def _panels(count: int, size: float, title: str) -> tuple[Figure, list[Axes]]:
    """A figure with `count` panels of about `size` inches, and its axes, row by row."""
    columns = min(count, 4 if count > 6 else 3)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(columns * size * 1.12 + 1.3, rows * size + 0.9), layout="constrained")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(rect=(0, 0.05 if rows == 1 else 0.03, 1, 0.95))  # type: ignore[union-attr, call-arg]
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for ax in axes[count:]:
        ax.remove()
    return figure, axes[:count]


def _colour_bar(figure: Figure, axes: Sequence[Axes], scale: Normalize, label: str) -> None:
    bar = figure.colorbar(ScalarMappable(scale, COLOURS), ax=list(axes), shrink=0.9, aspect=28, pad=0.02)
    bar.set_label(label)
    bar.outline.set_visible(False)


def _note(figure: Figure, text: str) -> None:
    """A small line below the panels."""
    figure.text(0.01, 0.005, text, fontsize=8, color="#555555", va="bottom")


def _outer_labels(figure: Figure, axes: Sequence[Axes], count: int, x: str, y: str) -> None:
    """Axis labels once for all panels; tick labels only at the outside."""
    if count == 1:
        axes[0].set(xlabel=x, ylabel=y)
        return
    columns = min(count, 4 if count > 6 else 3)
    for i, ax in enumerate(axes):
        ax.tick_params(labelbottom=i + columns >= count, labelleft=i % columns == 0)
    figure.supxlabel(x, fontsize=9.5)
    figure.supylabel(y, fontsize=9.5)


def _scales(ax: Axes, x: Quantity, y: Quantity | None = None) -> None:
    for quantity, axis, scale in ((x, ax.xaxis, ax.set_xscale), (y, ax.yaxis, ax.set_yscale)):
        if quantity is None:
            continue
        if quantity.log:
            scale("log")
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FormatStrFormatter("%g"))
            axis.set_minor_locator(NullLocator())
        elif quantity.unit == "deg" and np.ptp(quantity.values) >= 180:
            axis.set_major_locator(MaxNLocator(6, steps=[1, 3, 4.5, 6, 9, 10]))
        else:
            axis.set_major_locator(MaxNLocator(5))


def _horizontal_grid(ax: Axes) -> None:
    ax.grid(axis="y", color="#e6e6e6", lw=0.8)
    ax.set_axisbelow(True)


def _cell_means(x: np.ndarray, y: np.ndarray, z: np.ndarray, xs: np.ndarray, ys: np.ndarray) -> np.ndarray:
    cell = np.searchsorted(xs, x) * len(ys) + np.searchsorted(ys, y)
    good = np.isfinite(z)
    count = np.bincount(cell[good], minlength=len(xs) * len(ys))
    total = np.bincount(cell[good], z[good], minlength=len(xs) * len(ys))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(len(xs), len(ys))


def _binned(x: np.ndarray, z: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean x, mean z and standard deviation of z in the bin of each node that holds anything."""
    nodes = np.unique(nodes)
    bins = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 1)
    bins = bins if len(nodes) < 3 or np.isin(x, nodes).all() else np.minimum(bins, len(nodes) - 2)
    groups: list[Any] = [bins == b for b in np.unique(bins) if np.isfinite(z[bins == b]).any()]
    stat = [(x[g].mean(), np.nanmean(z[g]), np.nanstd(z[g])) for g in groups]
    return tuple(np.array(stat).reshape(-1, 3).T)  # type: ignore[return-value]


def _edges(centres: np.ndarray, log: bool) -> np.ndarray:
    """Cell edges half-way between the centres."""
    c = np.log(centres) if log else centres
    if len(c) == 1:
        half = np.array([max(abs(c[0]) * 0.05, 1e-6)])
        edges = np.concatenate([c - half, c + half])
    else:
        middle = (c[1:] + c[:-1]) / 2
        edges = np.concatenate([[2 * c[0] - middle[0]], middle, [2 * c[-1] - middle[-1]]])
    return np.exp(edges) if log else edges


def _limits(values: np.ndarray) -> tuple[float, float]:
    good = values[np.isfinite(values)]
    if not len(good):
        return 0.0, 1.0
    low, high = float(good.min()), float(good.max())
    return (low, high) if high > low else (low - abs(low) * 0.01 - 1e-9, high + abs(high) * 0.01 + 1e-9)
