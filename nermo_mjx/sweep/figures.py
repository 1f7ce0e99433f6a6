"""The figures of a sweep: heat maps, lines and scatter plots of one metric. `plots.py` decides what to draw."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import FuncFormatter

from nermo_mjx.plotting.cloud import cloud, remark
from nermo_mjx.plotting.page import around, blank, colour_bar
from nermo_mjx.plotting.shown import ShownValues, shown, spoken, titled
from nermo_mjx.plotting.style import (
    BAND,
    BEST,
    COLOURS,
    GAIN_COLOURS,
    GRID,
    INK,
    LINE,
    MISSING,
    SERIES,
    colour_scale,
    horizontal_grid,
    set_scales,
)
from nermo_mjx.sweep.spec import cost, sides_in
from nermo_mjx.sweep.table import Results, Variants, columns_of, labelled, meta

_BAR: Final[dict[str, Any]] = {"shrink": 0.9, "aspect": 28}


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
    """One heat map a panel (its title, and a mask of the points in it) on a shared colour scale.

    Points that share a cell are averaged. The best cell of all (the highest, without a better direction) is a star,
    that of each panel a ring; a cell without a successful run is hatched grey.

    With `gain`, z is a gain in percent: 0 is white, the scale is symmetric (large losses are cut off
    where they would leave the gains pale), marks show their value, and only points where `gain` holds are marked.
    """
    xs, ys = np.unique(x.values), np.unique(y.values)
    grids = [_cell_means(x.values[mask], y.values[mask], z.values[mask], xs, ys) for _, mask in panels]
    values = np.concatenate([grid.ravel() for grid in grids])
    scale, extend = colour_scale(values)
    marked, colours, fill, edge = grids, COLOURS, "none", "white"
    if gain is not None:
        chosen = np.where(gain, z.values, np.nan)
        marked = [_cell_means(x.values[mask], y.values[mask], chosen[mask], xs, ys) for _, mask in panels]
        colours, fill, edge = GAIN_COLOURS, "white", INK
        # Symmetric around 0; losses beyond 25 % and three times the best gain are cut off.
        good = values[np.isfinite(values)]
        low, high = (float(good.min()), float(good.max())) if len(good) else (0.0, 0.0)
        far = max(high, min(-low, max(3 * high, 25.0)), 1e-9)
        scale, extend = Normalize(-far, far), "min" if low < -far else "neither"
    figure, axes = panelled(len(panels), 2.5 if len(panels) > 1 else 4.4)
    prices = [cost(z.side, grid) for grid in marked]
    lowest = min((float(np.nanmin(price)) for price in prices if np.isfinite(price).any()), default=math.nan)
    best = math.nan
    for ax, (name, _), grid, candidates, price in zip(axes, panels, grids, marked, prices, strict=False):
        ax.add_patch(
            matplotlib.patches.Rectangle(
                (0, 0), 1, 1, transform=ax.transAxes, fc=MISSING, ec="white", hatch="////", lw=0, zorder=0
            )
        )
        ax.pcolormesh(_edges(xs, x.log), _edges(ys, y.log), np.ma.masked_invalid(grid.T), norm=scale, cmap=colours)
        set_scales(ax, x, y)
        ax.set_title(name)
        if np.isfinite(candidates).any():
            i, j = np.unravel_index(int(np.nanargmin(price)), grid.shape)
            star = price[i, j] == lowest
            best = float(candidates[i, j]) if star else best
            ax.scatter(
                xs[i],
                ys[j],
                s=190 if star else 34,
                marker="*" if star else "o",
                fc=BEST if star else fill,
                ec="white" if star else edge,
                lw=1.3,
                zorder=5,
                clip_on=False,
            )
            if gain is not None:
                left, apart = bool(i >= len(xs) / 2), 11 if star else 8  # of the mark, in points
                look: dict[str, Any] = {"fontsize": 8.5, "fontweight": "bold", "color": INK, "zorder": 6}
                look |= {"va": "center", "ha": "right" if left else "left", "textcoords": "offset points"}
                look["bbox"] = {"boxstyle": "round,pad=0.2", "fc": "white", "alpha": 0.75, "lw": 0}
                ax.annotate(_signed(candidates[i, j]), (xs[i], ys[j]), (-apart if left else apart, 0), **look)
    columns = _columns(len(axes))
    for place, ax in enumerate(axes):  # labels at the outside of the panels only
        bottom, left = place + columns >= len(axes), place % columns == 0
        ax.tick_params(labelbottom=bottom, labelleft=left)
        ax.set(xlabel=x.label if bottom else "", ylabel=y.label if left else "")
    bar = colour_bar(figure, axes, ScalarMappable(scale, colours), z.label, extend=extend, **_BAR)
    if gain is not None:
        bar.formatter = FuncFormatter(lambda value, _: _signed(value).removesuffix(" %"))
    word = best_word(z) if gain is None else "best"
    ring = f"; ring: {word} of its panel" if len(panels) > 1 else ""
    return around(figure, title, f"{note}star: {word}, {z.shown(best) if gain is None else _signed(best)}{ring}")


def line(x: ShownValues, z: ShownValues, title: str, note: str) -> Figure:
    """Mean over x, with a band of one standard deviation where points share an x, and the best point as a star."""
    figure, (ax,) = panelled(1, 4.4)
    xs, mean, std = binned(x.values, z.values, np.unique(x.values))
    ax.fill_between(xs, mean - std, mean + std, color=BAND, alpha=0.6, lw=0)
    ax.plot(xs, mean, "-o", color=LINE, ms=4, mec="white", mew=0.6)
    if np.isfinite(mean).any():
        at = int(np.nanargmin(cost(z.side, mean)))
        ax.scatter(xs[at], mean[at], s=170, marker="*", fc=BEST, ec="white", zorder=5, clip_on=False)
        note += f"star: {best_word(z)}, {z.shown(mean[at])} at {x.shown(xs[at])}"
    set_scales(ax, x)
    horizontal_grid(ax)
    ax.set(xlabel=x.label, ylabel=z.label)
    return around(figure, title, note)


def scatters(xs: Sequence[ShownValues], z: ShownValues, titles: Sequence[str], title: str, note: str) -> Figure:
    """The metric against each parameter: every run, or their density; a running mean over runs of similar value."""
    figure, axes = panelled(len(xs), 2.5 if len(xs) > 1 else 4.0)
    for ax, x, name in zip(axes, xs, titles, strict=False):
        cloud(ax, x, z, size=7)
        centres, mean, _ = binned(x.values, z.values, np.quantile(x.values, np.linspace(0, 1, 9)))
        ax.plot(centres, mean, color=LINE, lw=2, path_effects=[Stroke(linewidth=4, foreground="white"), Normal()])
        set_scales(ax, x)
        horizontal_grid(ax)
        ax.set_title(name)
        ax.set_xlabel(x.label)
    figure.supylabel(z.label, fontsize=9.5)
    return around(figure, title, note + remark(len(z.values)))


def pair_scatters(
    pairs: Sequence[tuple[ShownValues, ShownValues]], z: ShownValues, title: str, note: str, *, star: bool = True
) -> Figure:
    """Every run a point over two parameters, coloured by the metric; good runs lie on top, the best may be a star."""
    figure, axes = panelled(len(pairs), 2.7 if len(pairs) > 1 else 4.0)
    (scale, extend), order = colour_scale(z.values), np.argsort(-cost(z.side, z.values), kind="stable")
    for ax, (x, y) in zip(axes, pairs, strict=False):
        ax.scatter(
            x.values[order],
            y.values[order],
            c=z.values[order],
            s=14,
            norm=scale,
            cmap=COLOURS,
            lw=0,
            rasterized=len(z.values) > 2000,
        )
        if star:
            ax.scatter(x.values[order[-1]], y.values[order[-1]], s=170, marker="*", fc=BEST, ec="white", zorder=5)
        set_scales(ax, x, y)
        ax.set(xlabel=x.label, ylabel=y.label)
    colour_bar(figure, axes, ScalarMappable(scale, COLOURS), z.label, extend=extend, **_BAR)
    best = f"star: {best_word(z)}, {z.shown(float(z.values[order[-1]]))}"
    return around(figure, title, note + best if star else note.removesuffix("; "))


def panelled(count: int, size: float) -> tuple[Figure, list[Axes]]:
    """A figure with `count` panels of about `size` inches, and its axes, row by row."""
    columns = _columns(count)
    rows = math.ceil(count / columns)
    figure = blank(columns * size * 1.12 + 1.3, rows * size + 0.9)
    axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for ax in axes[count:]:
        ax.remove()
    return figure, axes[:count]


def best_word(metric: ShownValues) -> str:
    """The name of the mark for a metric's best value."""
    return "best" if metric.side else "highest"


def _columns(count: int) -> int:
    """Panels in a row."""
    return min(count, 4 if count > 6 else 3)


def _signed(percent: float) -> str:
    """A gain with its sign: +14.5 %."""
    text = f"{percent:+.3g}" if abs(percent) >= 100 else f"{round(percent, 1) + 0.0:+g}"
    return f"{'0' if text in ('+0', '-0') else text.replace('-', '−')} %"


def _cell_means(x: np.ndarray, y: np.ndarray, z: np.ndarray, xs: np.ndarray, ys: np.ndarray) -> np.ndarray:
    cell = np.searchsorted(xs, x) * len(ys) + np.searchsorted(ys, y)
    good = np.isfinite(z)
    count = np.bincount(cell[good], minlength=len(xs) * len(ys))
    total = np.bincount(cell[good], z[good], minlength=len(xs) * len(ys))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(len(xs), len(ys))


def binned(x: np.ndarray, z: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


# ---
# The points of a figure of variants: the mean of each variant's runs, or single runs if nothing is varied.


@dataclasses.dataclass(frozen=True)
class Points:
    """Points of a table, with some of its metrics.

    Attributes:
        results: the table.
        parameters: names of what tells the points apart: the varied parameters, or else the randomized ones.
        rows: a row of each point, (n,), which has its parameters.
        metrics: name -> (n,), as shown; NaN where no run had the number.
        runs: how many runs succeeded.
    """

    results: Results
    parameters: tuple[str, ...]
    rows: np.ndarray
    metrics: dict[str, ShownValues]
    runs: int

    def of(self, names: Sequence[str], chosen: np.ndarray) -> list[ShownValues]:
        """Columns of the chosen points, as shown; only those columns are read, and only those points kept."""
        rows = self.rows[chosen]
        return [quantity(self.results, name, values[rows]) for name, values in self.results.columns(names)]

    @property
    def differing(self) -> tuple[str, ...]:
        """The parameters that are not the same in all points."""
        values = self.results.columns(self.parameters)
        return tuple(name for name, column in values if len(self.rows) and not alike(column[self.rows]))

    @property
    def what(self) -> str:
        """How many points there are, and what they are."""
        count = len(self.rows)
        if count == self.runs:
            return f"{count:,} runs"
        return f"{count:,} variants, each the mean of its runs"


def points_of(results: Results, metrics: Sequence[str]) -> Points:
    """The points of a table with these metrics; only successful runs count."""
    well, varied = results.well, columns_of(results, "varied")
    columns = results.columns(["variant", *metrics])
    variant = next(columns)[1]
    places = np.flatnonzero(well)
    if not len(places):
        return Points(results, tuple(varied), places, {name: quantity(results, name, []) for name in metrics}, 0)
    if not varied:
        found = {name: quantity(results, name, values[well]) for name, values in columns}
        return Points(results, tuple(columns_of(results, "randomized")), places, found, len(places))
    variants = Variants.of(variant, well)
    found = {name: quantity(results, name, variants.means(values[well])[0]) for name, values in columns}
    return Points(results, tuple(varied), places[variants.first], found, len(places))


def quantity(results: Results, name: str, values: np.ndarray | Sequence[float]) -> ShownValues:
    """Values of a column as shown."""
    about = meta(results.schema.field(name))
    if about.get("scale") == "structure":
        names = results.names(name)
        return ShownValues(name, "", np.array([names.index(each) for each in values], float), names=names)
    side = sides_in(results.schema).get(name, "")
    return shown(name, about["unit"], values, log=about.get("scale") == "log", side=side)


def quantities(results: Results, names: Sequence[str]) -> list[ShownValues]:
    """Columns as shown."""
    return [quantity(results, name, values) for name, values in results.columns(names)]


def alike(values: np.ndarray) -> bool:
    """Whether all values are one; what is not known does not count."""
    return len(np.unique(values[values == values])) < 2


def metric_of(results: Results, metric: str) -> ShownValues:
    """A metric as shown, NaN where a run failed."""
    return quantity(results, metric, np.where(results.well, results.column(metric), np.nan))


def repeats_remark(results: Results) -> str:
    """What the note of a figure says of repeats that share a point."""
    repeats = int(np.max(results.column("repeat"))) + 1
    return f"mean of {repeats} repeats; " if repeats > 1 else ""


def thinned(values: np.ndarray, most: int, kept: np.ndarray | Sequence[int] = ()) -> np.ndarray:
    """A given number of sorted values, evenly spaced, plus those to keep; all of them if there are no more."""
    if len(values) <= most:
        return values
    even = values[np.linspace(0, len(values) - 1, most).round().astype(int)]
    return np.union1d(even, np.asarray(kept, values.dtype))


# ---
# Figures that compare the structures of a sweep: a line, a panel or a dot for each combination of them.


#: Lines or panels of one figure; more structures are told by one of their names alone.
MOST_GROUPS: Final = 12
#: Parameters with a figure of their own, and of which pairs are drawn.
_MOST_ALONE: Final = 6
_MOST_PAIRED: Final = 3
_DASHES: Final = ("-", "--", ":", "-.")
#: Maximum number of lines with bands of spread; more would cover each other.
_MOST_BANDS: Final = 4
_BINS: Final = 9


@dataclasses.dataclass(frozen=True)
class Groups:
    """The structures of a table.

    Attributes:
        names: what each is called.
        of: which one each run has, (rows,) int.
        what: of which columns they are, in words.
        looks: colour and dashes of each, as numbers: structures that differ in their last column alone, as in the spine
            on and off, share a colour.
    """

    names: tuple[str, ...]
    of: np.ndarray
    what: str
    looks: tuple[tuple[int, int], ...]


def groups_of(results: Results, most: int = MOST_GROUPS) -> Groups | None:
    """The combinations of structures, None where there is one alone; of fewer columns where they were too many."""
    columns = {name: results.column(name) for name in labelled(results)}
    columns = {name: column for name, column in columns.items() if len(set(column.tolist())) > 1}
    chosen = list(columns)
    while chosen:
        each = list(zip(*(columns[name].tolist() for name in chosen), strict=True))
        places = {key: place for place, key in enumerate(dict.fromkeys(each))}
        if len(places) <= most or len(chosen) == 1:
            left = [name for name in columns if name not in chosen]
            what = ", ".join(map(spoken, chosen)) + (f"; mean over {', '.join(map(spoken, left))}" if left else "")
            pairs = ((key[:-1], key[-1]) if len(chosen) > 1 else (key, "") for key in places)
            heads, tails = dict[Any, int](), dict[Any, int]()
            looks = tuple((heads.setdefault(a, len(heads)), tails.setdefault(b, len(tails))) for a, b in pairs)
            names = tuple(", ".join(map(spoken, key)) for key in places)
            return Groups(names, np.array([places[key] for key in each]), what, looks)
        chosen.pop()
    return None


def structure_figures(results: Results, groups: Groups, metric: str, remark: str = "") -> Iterator[tuple[str, Figure]]:
    """(file name, figure): a metric of each structure; over each parameter, and on a grid over pairs of them."""
    z = metric_of(results, metric)
    numbers = [name for name in columns_of(results, "varied") if name not in labelled(results)]
    drawn = [x for x in quantities(results, numbers) if not alike(x.values)]
    title = f"{titled(metric)} of each structure"
    yield f"{metric}-over-structures", dots(groups, z, title, remark, spread=not drawn)
    for x in drawn[:_MOST_ALONE]:
        title = f"{titled(metric)} over {x.spoken}, by structure"
        yield (
            f"{metric}-over-{x.name}-by-structure",
            lines(x, z, groups, title, remark, even=not results.is_grid, spread=results.is_grid and len(drawn) == 1),
        )
    for x, y in itertools.combinations(drawn[:_MOST_PAIRED] if results.is_grid else [], 2):
        good = np.isfinite(x.values) & np.isfinite(y.values)
        across, up, value = (dataclasses.replace(each, values=each.values[good]) for each in (x, y, z))
        which = groups.of[good]
        here = np.unique(which)
        note = remark
        if len(drawn) > 2:
            note += f"mean over {', '.join(each.spoken for each in drawn if each.name not in (x.name, y.name))}; "
        if lacking := len(groups.names) - len(here):
            note += f"{lacking} structures without one of them; "
        if len(here) > MOST_GROUPS:
            note += f"{len(here) - MOST_GROUPS} more structures not shown; "
        title = f"{titled(metric)} over {x.spoken} and {y.spoken}, by structure"
        panels = [(groups.names[place], which == place) for place in here[:MOST_GROUPS]]
        yield f"{metric}-over-{x.name}-and-{y.name}-by-structure", heat_maps(across, up, value, panels, title, note)


def dots(groups: Groups, z: ShownValues, title: str, note: str, *, spread: bool) -> Figure:
    """A dot for each structure at the mean of its runs, the best one in orange.

    With `spread`, where runs of a structure are repeats, a bar of one standard deviation.
    """
    count = len(groups.names)
    mean, std = np.full(count, np.nan), np.zeros(count)
    for place in range(count):
        own = z.values[(groups.of == place) & np.isfinite(z.values)]
        if len(own):
            mean[place], std[place] = own.mean(), own.std()
    best = int(np.nanargmin(cost(z.side, mean))) if np.isfinite(mean).any() else -1
    figure = blank(7.2, 1.3 + 0.3 * count)
    ax = figure.subplots()
    for place in range(count):
        colour = BEST if place == best else SERIES[0]
        if spread:
            ax.errorbar(mean[place], place, xerr=std[place], color=colour, elinewidth=2, alpha=0.5)
        ax.plot(mean[place], place, "o", color=colour, ms=7, mec="white")
    ax.set_yticks(range(count), groups.names, color=INK)
    ax.set(xlabel=z.label, ylim=(count - 0.5, -0.5))
    ax.grid(axis="x", color=GRID, lw=0.8)
    ax.set_axisbelow(True)
    told = f"; orange: {best_word(z)}, {z.shown(mean[best])}" if best >= 0 else ""
    what = "mean of its runs, bar: their standard deviation" if spread else "mean of all its runs"
    return around(figure, title, f"{note}{groups.what}: {what}{told}")


def lines(x: ShownValues, z: ShownValues, groups: Groups, title: str, note: str, *, even: bool, spread: bool) -> Figure:
    """A line for each structure: the mean at each value of x, or in bins with as many runs where x is `even`.

    A structure that has no such parameter is a level line at its mean. With `spread`, where runs of a structure at one
    x are repeats, a band of their standard deviation.
    """
    spread = spread and len(groups.names) <= _MOST_BANDS
    figure, (ax,) = panelled(1, 4.6)
    handles, level = [], False
    for place, name in enumerate(groups.names):
        own = (groups.of == place) & np.isfinite(z.values)
        colour, dashes = groups.looks[place]
        dashes += colour // len(SERIES)
        style: dict[str, Any] = {"color": SERIES[colour % len(SERIES)], "ls": _DASHES[dashes % len(_DASHES)]}
        handles.append(Line2D([], [], label=name, **style))
        there = own & np.isfinite(x.values)
        if not there.any():
            if own.any():
                ax.axhline(z.values[own].mean(), lw=1.2, alpha=0.8, **style)
                level = True
            continue
        nodes = np.quantile(x.values[there], np.linspace(0, 1, _BINS)) if even else np.unique(x.values[there])
        xs, mean, std = binned(x.values[there], z.values[there], nodes)
        if spread:
            ax.fill_between(xs, mean - std, mean + std, color=style["color"], alpha=0.15, lw=0)
        ax.plot(xs, mean, marker="o", ms=3.5, mec="white", mew=0.5, **style)
    set_scales(ax, x)
    horizontal_grid(ax)
    ax.set(xlabel=x.label, ylabel=z.label)
    said = [f"{groups.what}: " + ("running mean" if even else "mean over everything else")]
    said += ["band: standard deviation of its runs"] if spread else []
    said += [f"level: without {x.spoken}"] if level else []
    return around(figure, title, note + "; ".join(said), handles)
