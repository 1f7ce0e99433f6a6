"""Charts that several subpackages share, with their scales, grids, titles, legends and notes.

A chart is a function that returns a figure. It accepts `ShownValues`: each contains a column of a table in the unit of
the display, the name of the column in words (`spoken`), and the better direction of a metric (`side`: `max`, `min`,
`nearest zero`, or empty). The subpackage that owns a table decides which charts the table needs.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import string
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any, Final

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import (
    FormatStrFormatter,
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullLocator,
)

from nermo_mjx.plotting.shown import ShownValues, cost, half_width, spoken, titled
from nermo_mjx.plotting.style import (
    BAND_COLOUR,
    BEST_COLOUR,
    COLOUR_MAP,
    GAIN_COLOUR_MAP,
    GRID,
    INK,
    LINE_COLOUR,
    MISSING_COLOUR,
    MUTED_INK,
    SERIES,
    SMALL_POINTS,
)

#: Width of most figures [in].
PAGE_WIDTH_INCHES: Final = 7.2

# ---
# Scales and grids.

#: Largest share of the values that may be cut off at one end of a colour scale as outliers, and the share of the scale
#: that these values must use so that they are cut off.
_OUTLIER_SHARE: Final = 0.05
_OUTLIER_SPAN: Final = 0.5


def lighten(colour: str) -> str:
    """A paler colour: a mixture with white."""
    red, green, blue = (0.42 * part + 0.58 for part in to_rgb(colour))
    return to_hex((red, green, blue))


def colour_scale(values: np.ndarray) -> tuple[Normalize, str]:
    """The colour scale of values, and the end at which it is cut off, as the argument `extend` of a colour bar.

    The scale goes from the lowest finite value to the highest. If the outer 5 % of the values at one end would use more
    than half of the colours, the scale is cut off before them, and all of them have the colour of this end.

    >>> scale, extend = colour_scale(np.array([*range(100), 900.0]))
    >>> float(scale.vmin), extend
    (0.0, 'max')
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return Normalize(0.0, 1.0), "neither"
    low, high = float(finite.min()), float(finite.max())
    if low == high:
        return Normalize(low - abs(low) * 0.01 - 1e-9, high + abs(high) * 0.01 + 1e-9), "neither"
    inner_low, inner_high = np.quantile(finite, [_OUTLIER_SHARE, 1 - _OUTLIER_SHARE]).tolist()
    # At most one end is cut off, because both cannot have more than half of the span.
    if inner_low - low > _OUTLIER_SPAN * (high - low):
        return Normalize(inner_low, high), "min"
    if high - inner_high > _OUTLIER_SPAN * (high - low):
        return Normalize(low, inner_high), "max"
    return Normalize(low, high), "neither"


def set_scales(ax: Axes, x: ShownValues, y: ShownValues | None = None) -> None:
    """Make axes linear or logarithmic, with ticks at round values, and at round angles for a range of half a turn."""
    for quantity, axis, scale in ((x, ax.xaxis, ax.set_xscale), (y, ax.yaxis, ax.set_yscale)):
        if quantity is None:
            continue
        if quantity.names:
            axis.set_ticks(range(len(quantity.names)), [*map(spoken, quantity.names)])
        elif quantity.log:
            scale("log")
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FormatStrFormatter("%g"))
            axis.set_minor_locator(NullLocator())
        elif quantity.unit == "deg" and np.ptp(quantity.values) >= 180:
            axis.set_major_locator(MaxNLocator(6, steps=[1, 3, 4.5, 6, 9, 10]))
        else:
            axis.set_major_locator(MaxNLocator(5))


def draw_horizontal_grid(ax: Axes) -> None:
    """Draw faint horizontal lines, and a line at zero if the axis contains values of both signs."""
    ax.grid(axis="y", color=GRID, lw=0.8)
    ax.set_axisbelow(True)
    low, high = ax.get_ylim()
    if low < 0 < high:
        ax.axhline(0, color=MUTED_INK, lw=0.8, zorder=1)


def draw_star(
    ax: Axes, x: Any, y: Any, size: float = 150, lw: float | None = None, zorder: float = 8
) -> None:
    """Draw a star at the best point."""
    ax.scatter(
        x, y, s=size, marker="*", fc=BEST_COLOUR, ec="white", lw=lw, zorder=zorder, clip_on=False
    )


# ---
# The page: a title above the axes, and a legend and a note below them, with as much space as they need.

#: Margin of a page (half of it beside labels, which are drawn wider than laid out), gap between texts, and height of a
#: line [inch].
_EDGE_INCHES: Final = 0.1
_GAP_INCHES: Final = 0.08
_LINE_INCHES: Final = 0.15
#: Mean width of a character of the note, and of the title [inch].
_CHARACTER_INCHES: Final = 0.059
_TITLE_CHARACTER_INCHES: Final = 0.098
_TITLE_LINE_INCHES: Final = 0.21


class FigurePage:
    """A figure with a title above its axes, and a legend and a note below.

    Attributes:
        figure: The figure.
        axes: Its axes (rows, columns).
    """

    def __init__(
        self, title: str, size: tuple[float, float], rows: int = 1, columns: int = 1, **subplots
    ) -> None:
        self.figure = blank_figure(*size)
        self.axes: np.ndarray = self.figure.subplots(rows, columns, squeeze=False, **subplots)
        self._title = title
        for ax in self.axes.ravel():
            ax.set_axisbelow(True)

    def finish(self, handles: Sequence[Artist], note: str) -> Figure:
        """Add the title, the note and the legend, which has as few rows as fit; the axes fill the rest of the page."""
        return finish_page(self.figure, self._title, note, handles)


def blank_figure(width: float, height: float) -> Figure:
    """A blank figure of the given size in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def blank_page(title: str, width: float, height: float, note: str = "") -> Figure:
    """A blank figure of the given size in inches with a title above and a note below; axes fill the rest."""
    return finish_page(blank_figure(width, height), title, note)


def finish_page(figure: Figure, title: str, note: str, handles: Sequence[Artist] = ()) -> Figure:
    """Write a title above the axes of a figure, and a legend and a note below; its layout keeps the axes away from them.

    Lines of the title and the note that are too long for the page are broken; see `note_lines`.
    """
    width, height = figure.get_size_inches()
    head = textwrap.wrap(title, int((width - 2 * _EDGE_INCHES) / _TITLE_CHARACTER_INCHES))
    figure.text(
        _EDGE_INCHES / width,
        1 - _EDGE_INCHES / height,
        "\n".join(head),
        va="top",
        fontsize=11.5,
        fontweight="bold",
        linespacing=1.15,
    )
    lines = note_lines(note, width)
    figure.text(
        _EDGE_INCHES / width,
        _EDGE_INCHES / height,
        "\n".join(lines),
        va="bottom",
        fontsize=SMALL_POINTS,
        color=MUTED_INK,
        linespacing=1.2,
    )
    below = _EDGE_INCHES + _LINE_INCHES * len(lines) + _GAP_INCHES * bool(lines)
    if handles:
        below += _legend(figure, handles, below) + _GAP_INCHES
    above = _EDGE_INCHES + _TITLE_LINE_INCHES * len(head) + 0.07
    rect = (
        0.5 * _EDGE_INCHES / width,
        below / height,
        1 - 1.5 * _EDGE_INCHES / width,
        1 - (below + above) / height,
    )
    figure.get_layout_engine().set(rect=rect, hspace=0.05, wspace=0.05)  # type: ignore[union-attr, call-arg]
    return figure


def colour_bar(
    figure: Figure, axes: Any, colours: ScalarMappable, label: str, **look: Any
) -> Colorbar:
    """A colour bar beside axes, with its label and without a frame."""
    bar = figure.colorbar(colours, ax=axes, **{"pad": 0.02, "extendfrac": 0.03} | look)
    bar.set_label(label)
    bar.outline.set_visible(False)
    return bar


def note_lines(note: str, width: float) -> list[str]:
    """The lines of a note on a page of the given width in inches; text after a tab is indented together."""
    wrapped: list[str] = []
    for line in note.splitlines():
        hangs = "\t" in line
        wrapped += textwrap.wrap(
            line.replace("\t", "   "),
            int((width - 2 * _EDGE_INCHES) / _CHARACTER_INCHES),
            subsequent_indent="      " if hangs else "",
            replace_whitespace=False,
        )
    return wrapped


def _legend(figure: Figure, handles: Sequence[Artist], below: float) -> float:
    """Draw the legend in the fewest rows that fit the page; returns its height [inch]."""
    width, height = figure.get_size_inches()
    for rows in range(1, len(handles) + 1):
        columns = -(-len(handles) // rows)
        legend = figure.legend(
            # Matplotlib fills a legend column by column; in this order, it reads row by row.
            handles=[handle for first in range(columns) for handle in handles[first::columns]],
            ncols=columns,
            columnspacing=1.4,
            handlelength=1.7,
            loc="lower left",
            bbox_to_anchor=(_EDGE_INCHES / width, below / height),
            borderaxespad=0,
            borderpad=0.2,
        )
        box = legend.get_window_extent(figure.canvas.get_renderer())  # type: ignore[attr-defined]
        if box.width / figure.dpi <= width - 2 * _EDGE_INCHES or columns == 1:
            return box.height / figure.dpi
        legend.remove()
    raise AssertionError("one column is always accepted")


# ---
# Many points in one panel: dots if they can be distinguished, otherwise their density.

#: Number of points in a panel above which dots would overlap.
CROWD_POINTS: Final = 5000
#: Number of hexagons along the width of a panel.
_HEXAGONS: Final = 44
#: Colours of the density, which are lighter than lines drawn over it.
_DENSITY_COLOUR_MAP: Final = LinearSegmentedColormap.from_list(
    "density", [lighten(BAND_COLOUR), BAND_COLOUR, "#5aa5d6"]
)


def thin_out(
    values: np.ndarray, limit: int, required: np.ndarray | Sequence[int] = ()
) -> np.ndarray:
    """At most `limit` of the sorted values, evenly spaced, and in addition the required ones."""
    if len(values) <= limit:
        return values
    even = values[np.linspace(0, len(values) - 1, limit).round().astype(int)]
    return np.union1d(even, np.asarray(required, values.dtype))


def density_note(count: int) -> str:
    """Note of a figure about this number of points; empty if points are drawn as dots."""
    return "; darker: more runs" if count >= CROWD_POINTS else ""


def draw_points(ax: Axes, x: ShownValues, y: ShownValues, *, size: float) -> None:
    """Draw points as dots of a size [pt^2], or many of them as hexagons, darker (logarithmically) for more points."""
    if len(x.values) < CROWD_POINTS:
        ax.scatter(
            x.values,
            y.values,
            s=size,
            color=BAND_COLOUR,
            lw=0,
            rasterized=len(x.values) > 2000,
            zorder=2,
        )
        return
    ax.hexbin(
        x.values,
        y.values,
        gridsize=_HEXAGONS,
        bins="log",
        mincnt=1,
        cmap=_DENSITY_COLOUR_MAP,
        linewidths=0.2,
        zorder=2,
        xscale="log" if x.log else "linear",
        yscale="log" if y.log else "linear",
    )


# ---
# Heat maps, lines and scatter plots of one metric.

#: Shape of the colour bar beside panels.
_BAR_SHAPE: Final[dict[str, Any]] = {"shrink": 0.9, "aspect": 28}


# Long because the marks of a panel depend on the scale and the best value of all panels.
def heat_maps(
    x: ShownValues,
    y: ShownValues,
    z: ShownValues,
    panels: Sequence[tuple[str, np.ndarray]],
    title: str,
    note: str,
    *,
    gain: np.ndarray | None = None,
) -> Figure:
    """One heat map for each panel (its title, and a mask of its points) on a shared colour scale.

    Points in the same cell are averaged. A star marks the best cell of all panels (the highest cell if the metric has no
    better direction), and a ring marks the best cell of each panel. A cell without a successful run is hatched grey.

    With `gain`, z is a gain in percent: 0 is white, the scale is symmetric (it is cut off at large losses, which would
    make the gains pale), each mark shows its value, and only points for which `gain` is true are marked.
    """
    xs, ys = np.unique(x.values), np.unique(y.values)
    grids = [
        cell_means(x.values[mask], y.values[mask], z.values[mask], xs, ys) for _, mask in panels
    ]
    values = np.concatenate([grid.ravel() for grid in grids])
    scale, extend = colour_scale(values)
    # A star or a ring can mark the cells of `candidate_grids` only.
    candidate_grids, colours, fill, edge = grids, COLOUR_MAP, "none", "white"
    if gain is not None:
        candidate_values = np.where(gain, z.values, np.nan)
        candidate_grids = [
            cell_means(x.values[mask], y.values[mask], candidate_values[mask], xs, ys)
            for _, mask in panels
        ]
        colours, fill, edge = GAIN_COLOUR_MAP, "white", INK
        scale, extend = _gain_scale(values)
    figure, axes = panel_figure(len(panels), 2.5 if len(panels) > 1 else 4.4)
    mesh = cell_edges(xs, x.log), cell_edges(ys, y.log)
    cost_grids = [cost(z.side, candidates) for candidates in candidate_grids]
    lowest_cost = min(
        (float(np.nanmin(costs)) for costs in cost_grids if np.isfinite(costs).any()),
        default=math.nan,
    )
    best_value = math.nan
    for ax, (name, _), grid, candidates, costs in zip(
        axes, panels, grids, candidate_grids, cost_grids, strict=False
    ):
        hatch_axes(ax)
        ax.pcolormesh(*mesh, np.ma.masked_invalid(grid.T), norm=scale, cmap=colours)
        set_scales(ax, x, y)
        ax.set_title(name)
        if np.isfinite(candidates).any():
            i, j = np.unravel_index(int(np.nanargmin(costs)), grid.shape)
            is_best = costs[i, j] == lowest_cost
            if is_best:
                best_value = float(candidates[i, j])
                draw_star(ax, xs[i], ys[j], 190, 1.3, 5)
            else:
                _ring(ax, xs[i], ys[j], fill, edge)
            if gain is not None:
                _annotate_gain(ax, xs[i], ys[j], candidates[i, j], bool(i >= len(xs) / 2), is_best)
    columns = axes[0].get_gridspec().ncols  # type: ignore[union-attr]
    for panel_index, ax in enumerate(axes):  # labels at the outside of the panels only
        is_bottom, is_left = panel_index + columns >= len(axes), panel_index % columns == 0
        ax.tick_params(labelbottom=is_bottom, labelleft=is_left)
        ax.set(xlabel=x.label if is_bottom else "", ylabel=y.label if is_left else "")
    bar = colour_bar(
        figure, axes, ScalarMappable(scale, colours), z.label, extend=extend, **_BAR_SHAPE
    )
    if gain is not None:
        bar.formatter = FuncFormatter(lambda value, _: signed_percentage(value).removesuffix(" %"))
    word = best_word(z) if gain is None else "best"
    ring = f"; ring: {word} of its panel" if len(panels) > 1 else ""
    return finish_page(
        figure,
        title,
        f"{note}star: {word}, "
        f"{z.shown(best_value) if gain is None else signed_percentage(best_value)}{ring}",
    )


def hatch_axes(ax: Axes) -> None:
    """Hatch the axes grey; the hatching remains visible where nothing else is drawn."""
    ax.add_patch(
        matplotlib.patches.Rectangle(
            (0, 0),
            1,
            1,
            transform=ax.transAxes,
            fc=MISSING_COLOUR,
            ec="white",
            hatch="////",
            lw=0,
            zorder=0,
        )
    )


def _gain_scale(values: np.ndarray) -> tuple[Normalize, str]:
    """The colour scale of gains, symmetric around 0; losses beyond 25 % and three times the best gain are cut off."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    limit = max(high, min(-low, max(3 * high, 25.0)), 1e-9)
    return Normalize(-limit, limit), "min" if low < -limit else "neither"


def _ring(ax: Axes, x: float, y: float, fill: str, edge: str) -> None:
    """Draw a ring at the best point of a panel."""
    ax.scatter(x, y, s=34, marker="o", fc=fill, ec=edge, lw=1.3, zorder=5, clip_on=False)


def _annotate_gain(ax: Axes, x: float, y: float, gain: float, left: bool, is_best: bool) -> None:
    """Write the gain of a marked point on its left or right."""
    distance = 11 if is_best else 8  # from the mark, in points
    ax.annotate(
        signed_percentage(gain),
        (x, y),
        (-distance if left else distance, 0),
        fontsize=8.5,
        fontweight="bold",
        color=INK,
        zorder=6,
        va="center",
        ha="right" if left else "left",
        textcoords="offset points",
        bbox={"boxstyle": "round,pad=0.2", "fc": "white", "alpha": 0.75, "lw": 0},
    )


def line(x: ShownValues, z: ShownValues, title: str, note: str) -> Figure:
    """Mean over x, with a band of its 95 % interval if several points have the same x, and a star at the best mean."""
    figure, (ax,) = panel_figure(1, 4.4)
    xs, mean, half = bin_means(x.values, z.values, np.unique(x.values))
    ax.fill_between(xs, mean - half, mean + half, color=BAND_COLOUR, alpha=0.6, lw=0)
    note += "band: 95 % interval of the mean; " if np.isfinite(half).any() else ""
    ax.plot(xs, mean, "-o", color=LINE_COLOUR, ms=4, mec="white", mew=0.6)
    if np.isfinite(mean).any():
        best_index = int(np.nanargmin(cost(z.side, mean)))
        draw_star(ax, xs[best_index], mean[best_index], 170, zorder=5)
        note += f"star: {best_word(z)}, {z.shown(mean[best_index])} at {x.shown(xs[best_index])}"
    set_scales(ax, x)
    draw_horizontal_grid(ax)
    ax.set(xlabel=x.label, ylabel=z.label)
    return finish_page(figure, title, note)


def scatters(
    xs: Sequence[ShownValues], z: ShownValues, titles: Sequence[str], title: str, note: str
) -> Figure:
    """The metric over each parameter: every run, or the density of runs, and a running mean over similar values."""
    figure, axes = panel_figure(len(xs), 2.5 if len(xs) > 1 else 4.0)
    for ax, x, name in zip(axes, xs, titles, strict=False):
        centres, mean, _ = bin_means(
            x.values, z.values, np.quantile(x.values, np.linspace(0, 1, 9))
        )
        draw_points(ax, x, z, size=7)
        ax.plot(
            centres,
            mean,
            color=LINE_COLOUR,
            lw=2,
            path_effects=[Stroke(linewidth=4, foreground="white"), Normal()],
        )
        set_scales(ax, x)
        draw_horizontal_grid(ax)
        ax.set_title(name)
        ax.set_xlabel(x.label)
    figure.supylabel(z.label, fontsize=9.5)
    return finish_page(figure, title, note + density_note(len(z.values)))


def pair_scatters(
    pairs: Sequence[tuple[ShownValues, ShownValues]],
    z: ShownValues,
    title: str,
    note: str,
    *,
    star: bool = True,
) -> Figure:
    """Every run as a point over two parameters, coloured by the metric; good runs are on top, and a star may mark the
    best."""
    figure, axes = panel_figure(len(pairs), 2.7 if len(pairs) > 1 else 4.0)
    (scale, extend), order = (
        colour_scale(z.values),
        np.argsort(-cost(z.side, z.values), kind="stable"),
    )
    for ax, (x, y) in zip(axes, pairs, strict=False):
        ax.scatter(
            x.values[order],
            y.values[order],
            c=z.values[order],
            s=14,
            norm=scale,
            cmap=COLOUR_MAP,
            lw=0,
            rasterized=len(z.values) > 2000,
        )
        if star:
            draw_star(ax, x.values[order[-1]], y.values[order[-1]], 170, zorder=5)
        set_scales(ax, x, y)
        ax.set(xlabel=x.label, ylabel=y.label)
    colour_bar(
        figure, axes, ScalarMappable(scale, COLOUR_MAP), z.label, extend=extend, **_BAR_SHAPE
    )
    best = f"star: {best_word(z)}, {z.shown(float(z.values[order[-1]]))}"
    return finish_page(figure, title, note + best if star else note.removesuffix("; "))


def panel_figure(count: int, size: float) -> tuple[Figure, list[Axes]]:
    """A figure with `count` panels of about `size` inches, and its axes, row by row."""
    columns = min(count, 4 if count > 6 else 3)
    rows = math.ceil(count / columns)
    figure = blank_figure(columns * size * 1.12 + 1.3, rows * size + 0.9)
    axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for ax in axes[count:]:
        ax.remove()
    return figure, axes[:count]


def best_word(metric: ShownValues) -> str:
    """The name of the mark for a metric's best value."""
    return "best" if metric.side else "highest"


def signed_percentage(percent: float) -> str:
    """A gain with its sign: +14.5 %."""
    text = f"{percent:+.3g}" if abs(percent) >= 100 else f"{round(percent, 1) + 0.0:+g}"
    return f"{'0' if text in ('+0', '-0') else text.replace('-', '−')} %"


def cell_means(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, xs: np.ndarray, ys: np.ndarray
) -> np.ndarray:
    """Means of z in the cells of a grid, (len(xs), len(ys)); NaN in cells without a finite z."""
    cell = np.searchsorted(xs, x) * len(ys) + np.searchsorted(ys, y)
    is_finite = np.isfinite(z)
    count = np.bincount(cell[is_finite], minlength=len(xs) * len(ys))
    total = np.bincount(cell[is_finite], z[is_finite], minlength=len(xs) * len(ys))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(len(xs), len(ys))


def bin_means(
    x: np.ndarray, z: np.ndarray, nodes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean of x, mean of z, and half the 95 % interval of the mean of z, in each bin that contains a finite z.

    If every x is one of the nodes, each node has a bin. Otherwise, the nodes are the edges of the bins.
    """
    nodes = np.unique(nodes)
    bins = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 1)
    # The last one of several edges belongs to the bin before it.
    bins = bins if len(nodes) < 3 or np.isin(x, nodes).all() else np.minimum(bins, len(nodes) - 2)
    masks: list[Any] = [bins == b for b in np.unique(bins) if np.isfinite(z[bins == b]).any()]
    statistics = [(x[mask].mean(), *_mean(z[mask])) for mask in masks]
    return tuple(np.array(statistics).reshape(-1, 3).T)  # type: ignore[return-value]


def _mean(values: np.ndarray) -> tuple[float, float]:
    """The mean of the finite values, and half its 95 % interval."""
    finite = values[np.isfinite(values)]
    std = finite.std(ddof=1) if len(finite) > 1 else math.nan
    return float(finite.mean()) if len(finite) else math.nan, float(half_width(std, len(finite)))


def cell_edges(centres: np.ndarray, log: bool) -> np.ndarray:
    """Cell edges half-way between the centres."""
    c = np.log(centres) if log else centres
    if len(c) == 1:
        half = np.array([max(abs(c[0]) * 0.05, 1e-6)])
        edges = np.concatenate([c - half, c + half])
    else:
        middle = (c[1:] + c[:-1]) / 2
        edges = np.concatenate([[2 * c[0] - middle[0]], middle, [2 * c[-1] - middle[-1]]])
    return np.exp(edges) if log else edges


# ---
# Figures that compare the structures of a table. A structure is a combination of choices, such as a gait and a mode of
# the spine. Each structure is a line, a panel or a dot.

#: Maximum number of parameters that have their own figure, and of parameters whose pairs have figures.
_MAX_SINGLE_PARAMETERS: Final = 6
_MAX_PAIRED_PARAMETERS: Final = 3
#: Maximum number of lines or panels of one figure; more structures are grouped by fewer of their columns.
MAX_CHART_GROUPS: Final = 12
_DASHES: Final = ("-", "--", ":", "-.")
#: Maximum number of lines with bands; more bands would cover each other.
_MAX_BANDS: Final = 4
#: Number of quantiles of a parameter that are the edges of bins.
_BIN_EDGES: Final = 9


@dataclasses.dataclass(frozen=True)
class Groups:
    """The structures of a table.

    Attributes:
        names: Name of each structure.
        index: Index of the structure of each run, (rows,) int.
        description: Columns of the structures, in words.
        styles: Indices of colour and dashes of each structure. Structures that differ only in their last column, for
            example in the spine, have the same colour.
    """

    names: tuple[str, ...]
    index: np.ndarray
    description: str
    styles: tuple[tuple[int, int], ...]


def groups_of(structures: Sequence[ShownValues]) -> Groups | None:
    """The combinations of structures, of fewer columns if there are too many; None if no structure varies."""
    columns = {x.spoken: [x.names[int(index)] for index in x.values] for x in structures}
    grouping = list(columns)
    while grouping:
        keys = list(zip(*(columns[name] for name in grouping), strict=True))
        indices = {key: index for index, key in enumerate(dict.fromkeys(keys))}
        if len(indices) <= MAX_CHART_GROUPS or len(grouping) == 1:
            averaged = [name for name in columns if name not in grouping]
            description = ", ".join(grouping)
            description += f"; mean over {', '.join(averaged)}" if averaged else ""
            # The last column determines the dashes, all others the colour.
            pairs = ((key[:-1], key[-1]) if len(grouping) > 1 else (key, "") for key in indices)
            colours, dashes = dict[Any, int](), dict[Any, int]()
            styles = tuple(
                (colours.setdefault(a, len(colours)), dashes.setdefault(b, len(dashes)))
                for a, b in pairs
            )
            names = tuple(", ".join(map(spoken, key)) for key in indices)
            return Groups(names, np.array([indices[key] for key in keys]), description, styles)
        grouping.pop()
    return None


def dots(groups: Groups, z: ShownValues, title: str, note: str, *, spread: bool) -> Figure:
    """A dot for each structure at the mean of its runs; the best one is orange.

    With `spread`, a bar shows the 95 % interval of the mean; the runs of a structure must then be repeats.
    """
    count = len(groups.names)
    mean, half = np.array(
        [_mean(z.values[groups.index == group_index]) for group_index in range(count)]
    ).T
    best = int(np.nanargmin(cost(z.side, mean))) if np.isfinite(mean).any() else -1
    figure = blank_figure(PAGE_WIDTH_INCHES, 1.3 + 0.3 * count)
    ax = figure.subplots()
    for group_index in range(count):
        colour = BEST_COLOUR if group_index == best else SERIES[0]
        if spread:
            ax.errorbar(
                mean[group_index],
                group_index,
                xerr=half[group_index],
                color=colour,
                elinewidth=2,
                alpha=0.5,
            )
        ax.plot(mean[group_index], group_index, "o", color=colour, ms=7, mec="white")
    ax.set_yticks(range(count), groups.names, color=INK)
    ax.set(xlabel=z.label, ylim=(count - 0.5, -0.5))
    ax.grid(axis="x", color=GRID, lw=0.8)
    ax.set_axisbelow(True)
    best_note = f"; orange: {best_word(z)}, {z.shown(mean[best])}" if best >= 0 else ""
    caption = "mean of its runs, bar: its 95 % interval" if spread else "mean of all its runs"
    return finish_page(figure, title, f"{note}{groups.description}: {caption}{best_note}")


def lines(
    x: ShownValues,
    z: ShownValues,
    groups: Groups,
    title: str,
    note: str,
    *,
    even: bool,
    spread: bool,
) -> Figure:
    """A line for each structure: the mean at each value of x, or with `even` in bins of equal numbers of runs.

    A structure without this parameter is a level line at its mean. With `spread`, a band shows the 95 % interval of the
    mean; the runs of a structure at the same x must then be repeats.
    """
    spread = spread and len(groups.names) <= _MAX_BANDS
    figure, (ax,) = panel_figure(1, 4.6)
    handles, has_level_line = [], False
    for group_index, name in enumerate(groups.names):
        in_group = (groups.index == group_index) & np.isfinite(z.values)
        colour, dashes = groups.styles[group_index]
        dashes += colour // len(SERIES)
        style: dict[str, Any] = {
            "color": SERIES[colour % len(SERIES)],
            "ls": _DASHES[dashes % len(_DASHES)],
        }
        handles.append(Line2D([], [], label=name, **style))
        finite = in_group & np.isfinite(x.values)
        if not finite.any():
            if in_group.any():
                ax.axhline(z.values[in_group].mean(), lw=1.2, alpha=0.8, **style)
                has_level_line = True
            continue
        nodes = (
            np.quantile(x.values[finite], np.linspace(0, 1, _BIN_EDGES))
            if even
            else np.unique(x.values[finite])
        )
        xs, mean, half = bin_means(x.values[finite], z.values[finite], nodes)
        if spread:
            ax.fill_between(xs, mean - half, mean + half, color=style["color"], alpha=0.15, lw=0)
        ax.plot(xs, mean, marker="o", ms=3.5, mec="white", mew=0.5, **style)
    set_scales(ax, x)
    draw_horizontal_grid(ax)
    ax.set(xlabel=x.label, ylabel=z.label)
    notes = [f"{groups.description}: " + ("running mean" if even else "mean over everything else")]
    notes += ["band: 95 % interval of the mean"] if spread else []
    notes += [f"level: without {x.spoken}"] if has_level_line else []
    return finish_page(figure, title, note + "; ".join(notes), handles)


def structure_figures(
    groups: Groups, plotted: list[ShownValues], z: ShownValues, remark: str, *, grid: bool
) -> Iterator[tuple[str, Figure]]:
    """File names and figures of a metric by structure: of its means, over each parameter, and on a grid over pairs."""
    metric = z.name
    title = f"{titled(metric)} of each structure"
    yield f"{metric}-over-structures", dots(groups, z, title, remark, spread=not plotted)
    for x in plotted[:_MAX_SINGLE_PARAMETERS]:
        title = f"{titled(metric)} over {x.spoken}, by structure"
        figure = lines(
            x, z, groups, title, remark, even=not grid, spread=grid and len(plotted) == 1
        )
        yield f"{metric}-over-{x.name}-by-structure", figure
    for x, y in itertools.combinations(plotted[:_MAX_PAIRED_PARAMETERS] if grid else [], 2):
        has_both = np.isfinite(x.values) & np.isfinite(y.values)
        x_shown, y_shown, z_shown = (
            dataclasses.replace(column, values=column.values[has_both]) for column in (x, y, z)
        )
        group_indices = groups.index[has_both]
        present = np.unique(group_indices)
        note = remark
        if len(plotted) > 2:
            note += f"mean over {', '.join(shown.spoken for shown in plotted if shown.name not in (x.name, y.name))}; "
        if missing_count := len(groups.names) - len(present):
            note += f"{missing_count} structures without one of them; "
        if len(present) > MAX_CHART_GROUPS:
            note += f"{len(present) - MAX_CHART_GROUPS} more structures not shown; "
        title = f"{titled(metric)} over {x.spoken} and {y.spoken}, by structure"
        panels = [
            (groups.names[group_index], group_indices == group_index)
            for group_index in present[:MAX_CHART_GROUPS]
        ]
        yield (
            f"{metric}-over-{x.name}-and-{y.name}-by-structure",
            heat_maps(x_shown, y_shown, z_shown, panels, title, note),
        )


# ---
# Parallel coordinates: an axis for each parameter, the metric as the last one, a line for each point.

#: Number of best points, whose lines are always drawn, and thicker than the others.
BEST_LINES: Final = 5
#: An axis with no more values than this has a tick at each.
_MAX_TICKS: Final = 9


# Long because one figure is laid out from top to bottom.
def parallel_coordinates(
    parameters: Sequence[ShownValues], z: ShownValues, title: str, note: str
) -> Figure:
    """Parallel coordinates: a line for each point through its parameters to the metric; the last lines, which are the
    best, are orange."""
    scale, extend = colour_scale(z.values)
    if extend != "neither":
        end = scale.vmax if extend == "max" else scale.vmin
        assert end is not None
        note += f"; {z.spoken} {'above' if extend == 'max' else 'below'} {z.shown(float(end))} is drawn there"
    axes = [*parameters, dataclasses.replace(z, values=np.clip(z.values, scale.vmin, scale.vmax))]
    figure = blank_figure(1.5 + 1.35 * len(axes), 4.7)
    ax = figure.subplots()
    heights = np.stack(
        [_axis_fractions(axis_values, axis_values.values) for axis_values in axes], axis=-1
    )
    positions = np.broadcast_to(np.arange(len(axes)), heights.shape)
    lines = np.stack([positions, heights], axis=-1)
    best_count = min(BEST_LINES, len(lines))
    colours = matplotlib.colormaps[COLOUR_MAP](scale(z.values))
    # The more lines there are, the more transparent they are.
    colours[:, 3] = np.clip(90.0 / len(lines), 0.2, 0.8)
    background = LineCollection(
        list(lines[:-best_count]), colors=colours[:-best_count], linewidths=0.8, zorder=2
    )
    background.set_rasterized(len(lines) > 300)
    ax.add_collection(background)
    for colour, width, zorder in (("white", 3.4, 3), (BEST_COLOUR, 1.7, 4)):
        ax.add_collection(
            LineCollection(
                list(lines[-best_count:]), colors=colour, linewidths=width, zorder=zorder
            )
        )
    style: dict[str, Any] = {
        "xytext": (5, 0),
        "textcoords": "offset points",
        "va": "center",
        "bbox": {"boxstyle": "round,pad=0.12", "fc": "white", "alpha": 0.8, "lw": 0},
    }
    # An axis is a line with ticks: at each value if there are few, otherwise at round values.
    for position, axis_values in enumerate(axes):
        ax.plot([position, position], [0, 1], color=MUTED_INK, lw=1.0, zorder=5)
        values = np.unique(axis_values.values[np.isfinite(axis_values.values)])
        if not axis_values.names and len(values) > _MAX_TICKS:
            low, high = values[0], values[-1]
            locator = LogLocator(subs=(1.0, 2.0, 5.0)) if axis_values.log else MaxNLocator(5)
            ticks = locator.tick_values(low, high)
            values = np.array(
                [tick for tick in ticks if low - 1e-9 <= tick <= high + 1e-9 * abs(high)]
            )
        for value, height in zip(values, _axis_fractions(axis_values, values), strict=True):
            ax.plot(
                [position, position + 0.03], [height, height], color=MUTED_INK, lw=1.0, zorder=5
            )
            text = (
                axis_values.shown(value)
                if axis_values.names
                else f"{value + 0.0:.4g}".replace("-", "−")
            )
            ax.annotate(
                text, (position, height), fontsize=SMALL_POINTS, color=INK, zorder=6, **style
            )
    right = len(axes) - 1
    ax.imshow(
        np.linspace(0, 1, 256)[:, None],
        cmap=COLOUR_MAP,
        extent=(right - 0.022, right + 0.022, 0, 1),
        origin="lower",
        aspect="auto",
        zorder=5,
    )
    ax.set(xlim=(-0.35, right + 0.55), ylim=(-0.04, 1.04))
    ax.set_xticks(range(len(axes)), [textwrap.fill(axis_values.label, 14) for axis_values in axes])
    ax.tick_params(axis="x", length=0, labelcolor=INK)
    ax.yaxis.set_visible(False)
    for spine in ax.spines.values():
        spine.set_visible(False)
    return finish_page(figure, title, note)


def _axis_fractions(axis: ShownValues, values: np.ndarray) -> np.ndarray:
    """Positions of values on an axis, from 0 at its lowest value to 1 at its highest."""
    axis_values, values = (
        (np.log(axis.values), np.log(values)) if axis.log else (axis.values, np.asarray(values))
    )
    low, high = float(np.nanmin(axis_values)), float(np.nanmax(axis_values))
    return (values - low) / (high - low) if high > low else np.full(np.shape(values), 0.5)


# ---
# Two metrics over each other: all points, the Pareto front, and labels of some points of the front.

#: Maximum number of points of the front that have a label.
NAMED_POINTS: Final = 5


def pareto_front(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Indices of the points that no other point dominates, in the order of x.

    A point dominates another one if it is at least as good in both costs and better in one. Equal points count once.

    Args:
        x, y: Costs (n,), of which lower values are better; a point with NaN is ignored.
    """
    finite = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    order = finite[np.lexsort((y[finite], x[finite]))]
    lowest_y = np.minimum.accumulate(y[order])
    is_optimal = np.concatenate([[True], y[order][1:] < lowest_y[:-1]])
    return order[is_optimal[: len(order)]]


def named_points(x: np.ndarray, y: np.ndarray, limit: int = NAMED_POINTS) -> np.ndarray:
    """Indices of the points of a front (n,) that get a label: both ends, and others at even distances along the front."""
    if len(x) <= limit:
        return np.arange(len(x))
    steps = np.hypot(np.diff(x) / max(np.ptp(x), 1e-12), np.diff(y) / max(np.ptp(y), 1e-12))
    arc_length = np.concatenate([[0.0], np.cumsum(steps)])
    targets = np.linspace(0.0, arc_length[-1], limit)
    return np.unique(np.abs(arc_length[:, None] - targets).argmin(axis=0))


def trade_off(
    x: ShownValues,
    y: ShownValues,
    best: np.ndarray,
    sides: tuple[str, str],
    labelled: Sequence[tuple[int, str]],
    title: str,
    note: str,
) -> Figure:
    """Figure of two metrics with their Pareto front.

    Args:
        x, y: Metrics of all points.
        best: Indices of the points of the front, in the order along it.
        sides: Better direction of x and of y.
        labelled: Index and description of each point with a label; labels are letters.
        title: Title of the figure.
        note: Beginning of its note.
    """
    letters = string.ascii_uppercase
    lines = [f"{letter}\t{text}" for letter, (_, text) in zip(letters, labelled, strict=False)]
    words = {"max": "more", "min": "less", "nearest zero": "nearer to zero"}
    directions = ", ".join(
        f"{objective.spoken}: {words[side]}" for objective, side in zip((x, y), sides, strict=True)
    )
    lines.append(f"{note}orange: nothing is better in both ({directions})")
    text = "\n".join(lines) + density_note(len(x.values))
    figure = blank_figure(PAGE_WIDTH_INCHES, 4.4 + 0.15 * len(note_lines(text, PAGE_WIDTH_INCHES)))
    ax = figure.subplots()
    draw_points(ax, x, y, size=5 if len(x.values) > 2000 else 12)
    if "nearest zero" not in sides:
        # The boundary of the dominated region: between two points of the front, it follows the worse of both values.
        steps = []
        for values, side in zip((x.values[best], y.values[best]), sides, strict=True):
            corners = (np.minimum if side == "max" else np.maximum)(values[1:], values[:-1])
            steps.append(np.append(np.stack([values[:-1], corners], axis=1).ravel(), values[-1:]))
        ax.plot(*steps, color=BEST_COLOUR, lw=1.4, zorder=3)
    ax.scatter(
        x.values[best], y.values[best], s=26, color=BEST_COLOUR, ec="white", lw=0.6, zorder=4
    )
    set_scales(ax, x, y)
    ax.margins(0.06)
    # A label is on the better side of its point, where no other points are.
    right, up = (1 if side == "max" else -1 for side in sides)
    for letter, (point_index, _) in zip(letters, labelled, strict=False):
        ax.annotate(
            letter,
            (x.values[point_index], y.values[point_index]),
            (7 * right, 7 * up),
            textcoords="offset points",
            ha="center",
            va="center",
            fontweight="bold",
            color=INK,
            zorder=5,
        )
    ax.grid(color=GRID, lw=0.8)
    ax.set_axisbelow(True)
    ax.set(xlabel=x.label, ylabel=y.label)
    return finish_page(figure, title, text)
