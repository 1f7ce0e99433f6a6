"""The figures of a sweep's table: which ones it gives, and how each is drawn.

Heat maps over pairs of a grid, a line for one parameter, scatters of a sample; where structures vary, these side by
side; and, where two parameters or more tell the variants apart, parallel coordinates and the Pareto front of speed
against roll.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import string
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib
import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator
from scipy import stats

from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.page import around, blank, colour_bar, note_lines
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
    MUTED,
    SERIES,
    SMALL,
    colour_scale,
    horizontal_grid,
    light,
    set_scales,
)
from nermo_mjx.robot.quantity import ParameterError, did_you_mean
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.runs.rows import part_files
from nermo_mjx.sweep.spec import cost, sides_in
from nermo_mjx.sweep.table import (
    LEADING,
    Results,
    SweepRecord,
    Variants,
    columns_of,
    meta,
    rank_correlation,
    spine_ratio,
)

#: A figure has no more panels than this; more values are thinned evenly.
MOST_PANELS = 12
#: A scatter has no more points than this; more are thinned evenly.
MOST_POINTS = 50_000
#: Pairs are drawn among this many parameters: the first of a grid, the most influential of a sample.
MOST_PAIRED = 4


def figures_of(results: Results, metric: str = LEADING, remark: str = "") -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of one metric; only successful runs count. The note of each begins with the remark."""
    if not results.well.any():
        return
    z = metric_of(results, metric)
    varied = [x for x in quantities(results, columns_of(results, "varied")) if not alike(x.values)]
    numbers = [x for x in varied if not x.names]
    groups = groups_of([x for x in varied if x.names])
    if groups is not None:
        yield from structure_figures(groups, numbers, z, remark, grid=results.is_grid)
    if not results.is_grid or not varied:
        drawn = varied or quantities(results, columns_of(results, "randomized"))
        if groups is not None:
            drawn = [x for x in numbers if not np.isnan(x.values).any()]
        yield from _scatter_figures(drawn, z, remark)
    elif len(varied) == 1 and groups is None:
        x, title = varied[0], f"{titled(metric)} over {varied[0].spoken}"
        yield f"{metric}-over-{x.name}", line(x, z, title, remark + repeats_remark(results))
    elif groups is None:
        note = remark + repeats_remark(results)
        for x, y in itertools.combinations(varied[:MOST_PAIRED], 2):
            yield heat_map(x, y, varied, z, note)
        yield from _gain_figures(results, metric, remark)
    yield from survey_figures(results, metric, remark)


def heat_map(
    x: ShownValues, y: ShownValues, varied: Sequence[ShownValues], z: ShownValues, note: str
) -> tuple[str, Figure]:
    """A heat map of z over two parameters; with a third one that varies, one panel for each of its values."""
    good = np.isfinite(x.values) & np.isfinite(y.values)  # what a structure does not have has no place
    if not good.all():
        x, y, z, *varied = (dataclasses.replace(each, values=each.values[good]) for each in (x, y, z, *varied))
    panels, remark = _panels([other for other in varied if other.name not in (x.name, y.name)], len(z.values))
    figure = heat_maps(x, y, z, panels, f"{titled(z.name)} over {x.spoken} and {y.spoken}", note + remark)
    return f"{z.name}-over-{x.name}-and-{y.name}", figure


def _gain_figures(results: Results, metric: str, start: str) -> Iterator[tuple[str, Figure]]:
    """Speed relative to the stiff spine, where a grid varies the spine's phase, and its amplitude from 0."""
    names = columns_of(results, "varied")
    if metric != LEADING or not {"spine.amplitude", "spine.phase"} <= set(names):
        return
    data = spine_ratio(results)
    varied = {name: quantity(results, name, data[name]) for name in names}
    x, y = varied.pop("spine.amplitude"), varied.pop("spine.phase")
    z = ShownValues("speed relative to the stiff spine", "%", 100 * (data["ratio"] - 1))
    bends = x.values > 0
    if not np.isfinite(z.values[bends]).any() or len(np.unique(y.values)) < 2:
        return
    panels, remark = _panels([other for other in varied.values() if len(np.unique(other.values)) > 1], len(z.values))
    title = f"Speed gained by the spine over {x.spoken} and {y.spoken}"
    note = f"{start}{remark}stiff: mean at {x.spoken} 0; "
    yield f"{metric}-gain-over-{x.name}-and-{y.name}", heat_maps(x, y, z, panels, title, note, gain=bends)


def _scatter_figures(drawn: list[ShownValues], z: ShownValues, remark: str) -> Iterator[tuple[str, Figure]]:
    """The metric against each parameter, and over the pairs of those that matter most."""
    good = np.isfinite(z.values)
    drawn = [dataclasses.replace(x, values=x.values[good]) for x in drawn if len(np.unique(x.values[good])) > 1]
    z = dataclasses.replace(z, values=z.values[good])
    if not drawn:
        return
    still = np.ptp(z.values) == 0
    influence = [0.0 if still else float(stats.spearmanr(x.values, z.values).statistic) for x in drawn]
    order = np.argsort(-np.abs(influence), kind="stable")
    first = [drawn[i] for i in order[:MOST_PANELS]]
    titles = [f"rank correlation {influence[i]:+.2f}" for i in order[:MOST_PANELS]]
    places, count = _drawn_of(z.side, z.values)
    z, *first = (dataclasses.replace(each, values=each.values[places]) for each in (z, *first))
    more = f"; the {MOST_PANELS} of {len(drawn)} parameters that matter most" if len(drawn) > MOST_PANELS else ""
    note = f"{remark}{count}; line: running mean{more}"
    yield f"{z.name}-over-each", scatters(first, z, titles, f"{titled(z.name)} over each parameter", note)
    if len(drawn) > 1:
        pairs = list(itertools.combinations(first[:MOST_PAIRED], 2))
        title = f"{titled(z.name)} over pairs of the parameters that matter most"
        yield f"{z.name}-over-pairs", pair_scatters(pairs, z, title, f"{remark}{count}; ")


def _panels(rest: list[ShownValues], count: int) -> tuple[list[tuple[str, np.ndarray]], str]:
    """The panels of a heat map of `count` points for the parameters not on its axes, and a remark about them."""
    if len(rest) == 1:
        third, values = rest[0], np.unique(rest[0].values[np.isfinite(rest[0].values)])
        kept = thinned(values, MOST_PANELS)
        panels = [(f"{third.spoken} = {third.shown(value)}", third.values == value) for value in kept]
        left_out = len(values) - len(kept)
        return panels, f"{left_out} more values of {rest[0].spoken} not shown; " if left_out else ""
    remark = f"mean over {', '.join(other.spoken for other in rest)}; " if rest else ""
    return [("", np.full(count, True))], remark


# ---
# Additional results of a finished sweep: the comparison that it requests, and the sensitivity of its metric.


def findings(
    results: Results,
    comparison: Mapping[str, Any] | None,
    metric: str = LEADING,
    notify: Callable[[str], None] = lambda _: None,
) -> Iterator[tuple[str, pa.Table, dict[str, Any], Figures]]:
    """What a sweep finds besides its figures: name, table, part of the summary, and figures of each.

    Args:
        comparison: what the sweep's file compares, as its section `compare` has it.
        metric: which the figures show.
        notify: called with a message about what cannot be computed, as from a few runs.
    """
    try:
        if comparison is not None:
            from nermo_mjx.sweep import comparing  # few sweeps ask for it

            by, base, groups = comparison["by"], comparison.get("base"), comparison.get("for", ())
            found = comparing.compare(
                results, by=by, base=base, groups=groups, drawn=() if metric == LEADING else (metric,)
            )
            yield "comparison", found.table, found.about(only=found.drawn), comparing.figures_of(found.table)
    except ParameterError as error:
        notify(f"There is no comparison: {error}")
    try:
        if (results.schema.metadata or {}).get(b"sampler") == b"saltelli":
            from nermo_mjx.sweep import sensitivity

            indices = sensitivity.sensitivity(results, metric)
            yield "sensitivity", indices.table, indices.about(), sensitivity.figures_of(indices.table)
    except ParameterError as error:
        notify(f"There is no sensitivity: {error}")


# ---
# The figures of a sweep's directory, from its table alone: the default ones, or one of columns that a user names.


def figures(
    out: Path,
    *,
    x: str | None = None,
    y: str | None = None,
    color: str | None = None,
    notify: Callable[[str], None] | None = None,
) -> Figures:
    """The figures of a sweep's directory, as far as it is complete.

    Args:
        out: the directory.
        x, y, color: columns of one figure, see `chosen_figure`; a metric as color alone gives the default figures of
            that metric; without any of them, those of the speed are drawn.
        notify: called with a message if the table is not complete.

    Raises:
        ParameterError: there is no such column.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    files = part_files(out)
    if not files:
        raise DirectoryError(
            f"{out} holds no results of its sweep yet: run nermo-mjx sweep {out / 'sweep.yaml'} --out {out}."
        )
    results, sweep, remark = Results(files), SweepRecord.of_directory(out), ""
    if sweep is not None and results.rows < sweep.rows:
        remark = f"{results.rows:,} of {sweep.rows:,} runs so far; "
        if notify is not None:
            notify(f"{results.rows:,} of {sweep.rows:,} runs are in {out}; the figures show these.")
    if x is not None:
        return chosen_figure(results, x, y, color, remark)
    if y is not None:
        raise ParameterError("y is given without x: name both, or x alone.")
    if color is not None and color not in columns_of(results, "metric"):
        _check_column(results, color, "color")
        raise ParameterError(f"color is {color!r}, a parameter: name x and y, too.")
    asked = None if sweep is None else sweep.comparison
    found = findings(results, asked, color or LEADING, notify or (lambda _: None))

    def usual() -> Figures:  # each is drawn when it is asked for, in the style that holds then
        some = False
        for named in figures_of(results, color or LEADING, remark):
            some = True
            yield named
        if not some:
            why = "all its parameters have one value" if results.well.any() else "no run succeeded"
            raise DirectoryError(f"there is nothing to draw of {out}: {why}.")

    return itertools.chain(usual(), *(drawn for *_, drawn in found))


def chosen_figure(
    results: Results, x: str, y: str | None = None, color: str | None = None, remark: str = ""
) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of the named columns, made on demand.

    Two parameters of a grid give a heat map, two metrics with a better direction a Pareto front, all else a scatter.

    Args:
        results: the table.
        x, y: parameters or metrics; without y, it is the speed.
        color: a column that colours the points; of two parameters, the speed by default.
        remark: what the figure's note begins with.

    Raises:
        ParameterError: there is no such column, or no successful run.
    """
    for option, name in (("x", x), ("y", y), ("color", color)):
        _check_column(results, name, option)
    if not results.well.any():
        raise ParameterError("no run in the table succeeded, so there is nothing to plot.")
    return (_chosen(results, x, y or LEADING, color, remark) for _ in range(1))  # in the style that holds then


def _check_column(results: Results, name: str | None, option: str) -> None:
    """Refuse a name that is neither a parameter nor a metric of the table; None is accepted."""
    known = columns_of(results, "varied", "randomized", "metric")
    if name is not None and name not in known:
        hint = did_you_mean(name, known)
        raise ParameterError(f"{option} is {name!r}, no column of the table{hint} There are {', '.join(known)}.")


def _chosen(results: Results, x: str, y: str, color: str | None, remark: str) -> tuple[str, Figure]:
    metrics, varied, sides = columns_of(results, "metric"), columns_of(results, "varied"), sides_in(results.schema)
    if color is None and x in sides and y in sides and x != y:
        points = points_of(results, [x, y])
        return f"{x}-against-{y}", trade_off_figure(points, x, y, points.differing, remark)
    if color is None and not {x, y} & set(metrics):
        color = LEADING
    if results.is_grid and color in metrics and {x, y} <= set(varied) and x != y:
        others = {each.name: each for each in quantities(results, varied)}
        differing = [each for each in others.values() if not alike(each.values)]
        return heat_map(others[x], others[y], differing, metric_of(results, color), remark + repeats_remark(results))
    drawn = [quantities(results, [each])[0] for each in (x, y, color) if each]
    places = np.flatnonzero(results.well & np.logical_and.reduce([np.isfinite(each.values) for each in drawn]))
    kept, count = _drawn_of(drawn[-1].side, drawn[-1].values[places])
    across, up, *by = (dataclasses.replace(each, values=each.values[places[kept]]) for each in drawn)
    if by:
        title = f"{titled(str(color))} over {spoken(x)} and {spoken(y)}"
        figure = pair_scatters([(across, up)], by[0], title, f"{remark}{count}; ", star=color in metrics)
        return f"{color}-over-{x}-and-{y}", figure
    note = f"{remark}{count}; line: running mean"
    return f"{y}-over-{x}", scatters([across], up, [""], f"{titled(y)} over {spoken(x)}", note)


def _drawn_of(side: str, values: np.ndarray) -> tuple[np.ndarray, str]:
    """Places of the points (n,) that a scatter draws, the best one among them, and how many these are of all."""
    places, note = np.arange(len(values)), f"{len(values):,} runs"
    if len(values) > MOST_POINTS:
        places = thinned(places, MOST_POINTS, [int(np.argmin(cost(side, values)))])
        note = f"{MOST_POINTS:,} of {note}"
    return places, note


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
# Many points in one panel: dots as long as they can be distinguished, their density beyond.

#: Number of points in a panel above which dots would overlap.
CROWD: Final = 5000
_CELLS: Final = 44
#: Lighter than lines drawn over it.
_DENSITY: Final = LinearSegmentedColormap.from_list("density", [light(BAND), BAND, "#5aa5d6"])


def density_note(count: int) -> str:
    """The figure's note about this number of points."""
    return "; darker: more runs" if count >= CROWD else ""


def cloud(ax: Axes, x: ShownValues, y: ShownValues, *, size: float) -> None:
    """Draw points as dots of a size [pt^2], or many of them as hexagons, darker (logarithmically) for more points."""
    if len(x.values) < CROWD:
        ax.scatter(x.values, y.values, s=size, color=BAND, lw=0, rasterized=len(x.values) > 2000, zorder=2)
        return
    ax.hexbin(
        x.values,
        y.values,
        gridsize=_CELLS,
        bins="log",
        mincnt=1,
        cmap=_DENSITY,
        linewidths=0.2,
        zorder=2,
        xscale="log" if x.log else "linear",
        yscale="log" if y.log else "linear",
    )


# ---
# Heat maps, lines and scatter plots of one metric.


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
        centres, mean, _ = binned(x.values, z.values, np.quantile(x.values, np.linspace(0, 1, 9)))
        cloud(ax, x, z, size=7)
        ax.plot(centres, mean, color=LINE, lw=2, path_effects=[Stroke(linewidth=4, foreground="white"), Normal()])
        set_scales(ax, x)
        horizontal_grid(ax)
        ax.set_title(name)
        ax.set_xlabel(x.label)
    figure.supylabel(z.label, fontsize=9.5)
    return around(figure, title, note + density_note(len(z.values)))


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


def groups_of(structures: Sequence[ShownValues]) -> Groups | None:
    """The combinations of structures, None where none varies; of fewer columns where they were too many."""
    columns = {x.spoken: [x.names[int(place)] for place in x.values] for x in structures}
    chosen = list(columns)
    while chosen:
        each = list(zip(*(columns[name] for name in chosen), strict=True))
        places = {key: place for place, key in enumerate(dict.fromkeys(each))}
        if len(places) <= MOST_GROUPS or len(chosen) == 1:
            left = [name for name in columns if name not in chosen]
            what = ", ".join(chosen) + (f"; mean over {', '.join(left)}" if left else "")
            pairs = ((key[:-1], key[-1]) if len(chosen) > 1 else (key, "") for key in places)
            heads, tails = dict[Any, int](), dict[Any, int]()
            looks = tuple((heads.setdefault(a, len(heads)), tails.setdefault(b, len(tails))) for a, b in pairs)
            names = tuple(", ".join(map(spoken, key)) for key in places)
            return Groups(names, np.array([places[key] for key in each]), what, looks)
        chosen.pop()
    return None


def structure_figures(
    groups: Groups, drawn: list[ShownValues], z: ShownValues, remark: str, *, grid: bool
) -> Iterator[tuple[str, Figure]]:
    """(file name, figure): a metric of each structure; over each parameter, and on a grid over pairs of them."""
    metric = z.name
    title = f"{titled(metric)} of each structure"
    yield f"{metric}-over-structures", dots(groups, z, title, remark, spread=not drawn)
    for x in drawn[:_MOST_ALONE]:
        title = f"{titled(metric)} over {x.spoken}, by structure"
        figure = lines(x, z, groups, title, remark, even=not grid, spread=grid and len(drawn) == 1)
        yield f"{metric}-over-{x.name}-by-structure", figure
    for x, y in itertools.combinations(drawn[:_MOST_PAIRED] if grid else [], 2):
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


# ---
# Parallel coordinates: an axis for each parameter, the metric as the last one, a line for each variant.


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


def parallel_figure(points: Points, names: Sequence[str], metric: str, remark: str) -> Figure:
    """A line for each point through its parameters to the metric; the best lines are orange."""
    every = points.metrics[metric]
    price = cost(every.side, every.values)
    drawn, left_out = chosen_lines(price), ""
    parameters = points.of(names, drawn)
    z = dataclasses.replace(every, values=every.values[drawn])
    if len(parameters) > MOST_AXES:
        influence = [abs(np.nan_to_num(rank_correlation(each.values, z.values))) for each in parameters]
        matter = np.argsort(-np.array(influence), kind="stable")[:MOST_AXES]
        left_out = f"; {len(parameters) - MOST_AXES} parameters that matter less are not shown"
        parameters = [parameters[i] for i in sorted(matter)]
    known = int(np.isfinite(price).sum())
    note = f"{remark}{points.what}{left_out}"
    if known > MOST_LINES:
        note = f"{remark}{MOST_LINES:,} of {points.what}, evenly by rank, and the best {BEST_LINES}{left_out}"
    where = ", ".join(f"{each.spoken} {each.shown(each.values[-1])}" for each in parameters)
    most = f"the {min(BEST_LINES, known)} {best_word(every)}"
    note += f"; orange: {most}, of which the first is {z.shown(z.values[-1])} at {where}"
    scale, extend = colour_scale(z.values)
    if extend != "neither":
        end = scale.vmax if extend == "max" else scale.vmin
        assert end is not None
        note += f"; {z.spoken} {'above' if extend == 'max' else 'below'} {z.shown(float(end))} is drawn there"
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
    for place, each in enumerate(axes):  # a line with ticks: each value where there are few, else round ones
        ax.plot([place, place], [0, 1], color=MUTED, lw=1.0, zorder=5)
        values = np.unique(each.values[np.isfinite(each.values)])
        if not each.names and len(values) > _EACH:
            low, high = values[0], values[-1]
            locator = LogLocator(subs=(1.0, 2.0, 5.0)) if each.log else MaxNLocator(5)
            ticks = locator.tick_values(low, high)
            values = np.array([tick for tick in ticks if low - 1e-9 <= tick <= high + 1e-9 * abs(high)])
        box: dict[str, Any] = {"bbox": {"boxstyle": "round,pad=0.12", "fc": "white", "alpha": 0.8, "lw": 0}}
        for value, height in zip(values, _share(each, values), strict=True):
            ax.plot([place, place + 0.03], [height, height], color=MUTED, lw=1.0, zorder=5)
            text = each.shown(value) if each.names else f"{value + 0.0:.4g}".replace("-", "−")
            at: dict[str, Any] = {"xytext": (5, 0), "textcoords": "offset points", "va": "center"}
            ax.annotate(text, (place, height), fontsize=SMALL, color=INK, zorder=6, **at, **box)
    strip = np.linspace(0, 1, 256)[:, None]
    right = len(axes) - 1
    ax.imshow(strip, cmap=COLOURS, extent=(right - 0.022, right + 0.022, 0, 1), origin="lower", aspect="auto", zorder=5)
    ax.set(xlim=(-0.35, right + 0.55), ylim=(-0.04, 1.04))
    ax.set_xticks(range(len(axes)), [textwrap.fill(each.label, 14) for each in axes])
    ax.tick_params(axis="x", length=0, labelcolor=INK)
    ax.yaxis.set_visible(False)
    for spine in ax.spines.values():
        spine.set_visible(False)
    return around(figure, f"{titled(metric)}: all parameters side by side", note)


def _share(axis: ShownValues, values: np.ndarray) -> np.ndarray:
    """Where values stand on an axis, from 0 at its lowest to 1 at its highest."""
    own, wanted = (np.log(axis.values), np.log(values)) if axis.log else (axis.values, np.asarray(values))
    low, high = float(np.nanmin(own)), float(np.nanmax(own))
    return (wanted - low) / (high - low) if high > low else np.full(np.shape(wanted), 0.5)


# ---
# A figure of two metrics against each other: all points, the Pareto front, and its best points by name.


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
    both = ", ".join(f"{each.spoken}: {words[side]}" for each, side in zip((x, y), sides, strict=True))
    lines.append(f"{note}orange: nothing is better in both ({both})")
    text = "\n".join(lines) + density_note(len(x.values))
    figure = blank(_WIDTH, 4.4 + 0.15 * len(note_lines(text, _WIDTH)))
    ax = figure.subplots()
    cloud(ax, x, y, size=5 if len(x.values) > 2000 else 12)
    if "nearest zero" not in sides:
        # The edge of what the front beats: between two of its points it goes by the worse of both numbers.
        steps = []
        for values, side in zip((x.values[best], y.values[best]), sides, strict=True):
            turns = (np.minimum if side == "max" else np.maximum)(values[1:], values[:-1])
            steps.append(np.append(np.stack([values[:-1], turns], axis=1).ravel(), values[-1:]))
        ax.plot(*steps, color=BEST, lw=1.4, zorder=3)
    ax.scatter(x.values[best], y.values[best], s=26, color=BEST, ec="white", lw=0.6, zorder=4)
    set_scales(ax, x, y)
    ax.margins(0.06)
    # Labels are placed on the better direction of their points, where there is nothing else.
    right, up = (1 if side == "max" else -1 for side in sides)
    for letter, (place, _) in zip(letters, named, strict=False):
        ax.annotate(
            letter,
            (x.values[place], y.values[place]),
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
    return around(figure, title, text)


#: What a faster walk is weighed against.
AGAINST: Final = "roll_std"
#: Points of a trade-off that are drawn, and parameters that are told of a named one.
_MOST_POINTS: Final = 20_000
_MOST_TOLD: Final = 6


def survey_figures(results: Results, metric: str, remark: str = "") -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of the figures over all variants of a table; none where one parameter or none differs."""
    weighed = AGAINST if metric == LEADING and AGAINST in results.schema.names else None
    points = points_of(results, [metric, *([weighed] if weighed else [])])
    names = points.differing
    if len(names) < 2 or len(points.rows) < 4:
        return
    if not results.is_grid:  # whose lines would all cross
        yield f"{metric}-parallel", parallel_figure(points, names, metric, remark)
    if weighed:
        yield f"{metric}-against-{weighed}", trade_off_figure(points, metric, weighed, names, remark)


def trade_off_figure(points: Points, first: str, second: str, names: tuple[str, ...], remark: str) -> Figure:
    """Two metrics with a better direction against each other; the named points have their parameters below."""
    x, y = points.metrics[first], points.metrics[second]
    best = front(cost(x.side, x.values), cost(y.side, y.values))
    named = best[named_points(x.values[best], y.values[best])]
    parameters = points.of(names[:_MOST_TOLD], named)
    lines = []
    for i, place in enumerate(named):
        both = f"{x.spoken} {x.shown(x.values[place])}, {y.spoken} {y.shown(y.values[place])}"
        lines.append(f"{both}:  " + ", ".join(f"{each.spoken} {each.shown(each.values[i])}" for each in parameters))
    if len(names) > _MOST_TOLD:
        remark += f"{len(names) - _MOST_TOLD} more parameters are in the table; "
    drawn = np.flatnonzero(np.isfinite(x.values) & np.isfinite(y.values))
    note = f"{remark}{points.what}; "
    if len(drawn) > _MOST_POINTS:
        drawn = thinned(drawn, _MOST_POINTS, best)
        note = f"{remark}{_MOST_POINTS:,} of {points.what}, and the whole front; "
    x, y = (dataclasses.replace(each, values=each.values[drawn]) for each in (x, y))
    best, named = np.searchsorted(drawn, best), np.searchsorted(drawn, named)
    told = list(zip(named.tolist(), lines, strict=True))
    return trade_off(x, y, best, (x.side, y.side), told, f"{titled(first)} over {y.spoken}", note)
