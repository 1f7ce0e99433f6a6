"""The figures of tunings and of searches, and the landscape behind a tuning's paths."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from nermo_mjx.optimize.directory import (
    SEARCH,
    Evaluations,
    TuningDirectory,
    atlas_progress,
    hypervolumes,
    load_tuning,
    read_history,
)
from nermo_mjx.optimize.methods import cells_of, elites_of
from nermo_mjx.optimize.objective import FURTHEST, TRAJECTORY_ERROR, ObjectiveTerm
from nermo_mjx.optimize.spec import Measure, Search, Tuned, Tuning
from nermo_mjx.plotting.charts import (
    around,
    blank,
    colour_bar,
    colour_scale,
    horizontal_grid,
    named_points,
    page,
    set_scales,
    trade_off,
)
from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.plotting.shown import ShownValues, shown, spoken
from nermo_mjx.plotting.style import (
    BAND_COLOUR,
    BEST_COLOUR,
    COLOUR_MAP,
    GRID,
    INK,
    LINE_COLOUR,
    MISSING_COLOUR,
    MUTED_INK,
    SERIES,
)
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs import RunDirectory, stamp
from nermo_mjx.runs.files import DirectoryError, parquet_table
from nermo_mjx.runs.job import Progress, Watch
from nermo_mjx.runs.rows import Runs, Warn, keys_of, part_files, retire
from nermo_mjx.specs.described import digest_of
from nermo_mjx.sweep.plots import chosen_figure, survey_figures
from nermo_mjx.sweep.simulating import SimulatorLike
from nermo_mjx.sweep.table import Columns, Results, meta, profile_text, profiles_of

_WIDTH: Final = 7.2

# ---
# A tuning's history as arrays over iterations and starts, for figures and summaries.


#: Maximum number of starts in a figure, including the best and the given one.
MOST_STARTS: Final = 32


@dataclasses.dataclass(frozen=True)
class Traces:
    """The history of each start.

    Attributes:
        tuning: that was run.
        table: its history, see `nermo_mjx.optimize.directory`.
    """

    tuning: Tuning
    table: pa.Table

    @property
    def starts(self) -> int:
        """Number of starts."""
        return self.tuning.starts

    @property
    def iterations(self) -> np.ndarray:
        """Number of each evaluation (n,); 0 is that of the first points."""
        return np.arange(self.table.num_rows // self.starts)

    @cached_property
    def ok(self) -> np.ndarray:
        """Whether the robot walked to the end (n, starts)."""
        return self.column("ok").astype(bool)

    @cached_property
    def best(self) -> tuple[int, int]:
        """Iteration and start of the lowest objective; there is one where `best.json` exists."""
        value = self.column("objective")
        iteration, start = np.unravel_index(np.nanargmin(value), value.shape)
        return int(iteration), int(start)

    def column(self, name: str) -> np.ndarray:
        """Values of a column (n, starts), in its own unit."""
        return self.table.column(name).to_numpy(zero_copy_only=False).reshape(-1, self.starts)

    def quantity(self, name: str) -> ShownValues:
        """Values of a column (n, starts) as figures show them; of a metric, only where the robot walked to the end."""
        about = meta(self.table.schema.field(name))
        values = self.column(name)
        if about["role"] == "metric":
            values = np.where(self.ok, values, np.nan)
        return shown(name, about["unit"], values)

    def unwrapped(self, tuned: Tuned) -> np.ndarray:
        """Values of a parameter (n, starts) in its own unit; a periodic one continues beyond its bounds."""
        values = self.column(tuned.name)
        return (
            np.unwrap(values, axis=0, period=tuned.high - tuned.low) if tuned.periodic else values
        )

    def in_shown_unit(self, name: str, value: float | np.ndarray) -> np.ndarray:
        """Values of a parameter or metric as figures show them."""
        return shown(name, meta(self.table.schema.field(name))["unit"], np.asarray(value)).values

    def gradient_norm(self) -> np.ndarray:
        """Norm of each gradient (n, starts); NaN without one.

        Each component counts per whole range of its parameter, so that units do not matter.
        """
        tuned = self.tuning.tuned
        ranges = np.array([each.high - each.low for each in tuned])
        gradient = (
            np.stack([self.column(f"gradient.{each.name}") for each in tuned], axis=-1) * ranges
        )
        norm = np.linalg.norm(gradient, axis=-1)
        return np.where(norm > 0, norm, np.nan)

    def drawn(self) -> list[int]:
        """The starts that are drawn: all, or the given one, the best, and some between."""
        if self.starts <= MOST_STARTS:
            return list(range(self.starts))
        some = np.linspace(0, self.starts - 1, MOST_STARTS - 1).round().astype(int)
        return sorted({*some.tolist(), self.best[1]})


def corner(ax: Axes, text: str, y: float = 1.01, va: Literal["bottom", "top"] = "bottom") -> None:
    """A small note at the top right of a panel."""
    ax.annotate(
        text, (1, y), xycoords="axes fraction", ha="right", va=va, fontsize=8, color=MUTED_INK
    )


def star(
    ax: Axes, x: Any, y: Any, size: float = 150, lw: float | None = None, zorder: float = 8
) -> None:
    """A star at the best point."""
    ax.scatter(
        x, y, s=size, marker="*", fc=BEST_COLOUR, ec="white", lw=lw, zorder=zorder, clip_on=False
    )


def legend(ax: Axes, handles: Any = None, labels: Any = None, **more: Any) -> None:
    """The legend beside a panel, if there is something in it."""
    if handles is None:
        handles, labels = ax.get_legend_handles_labels()
    if handles:
        ax.legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, **more)


#: Colours of single starts; with more starts, only the best one has its own.
START_COLOURS: Final = SERIES
#: Panels of one figure.
MOST_PANELS: Final = 12
_PANEL, _MARGINS = 1.75, 0.85
#: A path shorter than this fraction of its bounds is shown enlarged.
_ZOOM: Final = 0.2
_AIMS: Final = {
    "maximize": "more is better",
    "minimize": "less is better",
    "hold": "dashed: to be held",
}


def objective_figure(traces: Traces) -> Figure:
    """The objective of each start with the best so far, and below it each metric that the objective reads."""
    terms = {
        term.metric: term
        for term in traces.tuning.objective.terms
        if term.metric != TRAJECTORY_ERROR
    }
    iteration, start = traces.best
    best = traces.column("objective")[iteration, start]
    where = f" of start {start}" if traces.starts > 1 else ""
    note = f"{_what(traces)}; dashed: best so far; star: best, {best:.4g} in iteration {iteration}{where}"
    figure = page(
        "Objective over the iterations (lower is better)", _WIDTH, 2.9 + _PANEL * len(terms), note
    )
    axes = _column(figure, 1 + len(terms))
    value = traces.column("objective")
    _draw_starts(axes[0], traces, value)
    # Where no start has walked to the end yet there is no best.
    lowest = np.minimum.accumulate(np.where(np.isfinite(value), value, np.inf).min(axis=1))
    lowest[np.isinf(lowest)] = np.nan
    axes[0].step(traces.iterations, lowest, where="post", color=INK, lw=1.1, ls=(0, (4, 2)))
    axes[0].set_ylabel("objective [1]")
    _cut(axes[0], value)
    label: str | None = "fell"
    for each, style in start_styles(traces).items():
        fell = traces.iterations[~traces.ok[:, each]]
        if len(fell):
            cross: dict[str, Any] = {
                "color": style["color"],
                "ms": 5,
                "mew": 1.4,
                "clip_on": False,
                "zorder": 5,
            }
            top = np.full(len(fell), 0.97)
            axes[0].plot(
                fell, top, "x", transform=axes[0].get_xaxis_transform(), label=label, **cross
            )
            label = None
    for ax, (metric, term) in zip(axes[1:], terms.items(), strict=True):
        quantity = traces.quantity(metric)
        _draw_starts(ax, traces, quantity.values)
        if term.aim == "hold":
            target = float(traces.in_shown_unit(metric, np.asarray(term.at)))
            ax.axhline(target, color=MUTED_INK, lw=1.0, ls="--", zorder=1)
        corner(ax, _AIMS[term.aim])
        ax.set_ylabel(quantity.label)
    star(axes[0], iteration, best, lw=0.9, zorder=6)
    for ax, metric in zip(axes[1:], terms, strict=True):
        star(ax, iteration, traces.quantity(metric).values[traces.best], lw=0.9, zorder=6)
    _finish(axes, traces)
    return figure


def parameters_figure(traces: Traces) -> Figure:
    """Each parameter over the iterations, in its unit, with its bounds; a periodic one continues beyond them."""
    tuned = traces.tuning.tuned[:MOST_PANELS]
    left_out = len(traces.tuning.tuned) - len(tuned)
    note = (
        f"{_what(traces)}; dashed: bounds, or where a periodic parameter wraps around; star: best"
    )
    note += f"; {left_out} more parameters are not shown" if left_out else ""
    columns = 1 if len(tuned) <= 3 else 2
    rows = math.ceil(len(tuned) / columns)
    figure = page("Parameters over the iterations", _WIDTH, _MARGINS + (_PANEL + 0.25) * rows, note)
    axes = list(figure.subplots(rows, columns, sharex=True, squeeze=False).ravel())
    for ax in axes[len(tuned) :]:
        ax.remove()
    for ax, each in zip(axes, tuned, strict=False):
        values = traces.in_shown_unit(each.name, traces.unwrapped(each))
        _draw_starts(ax, traces, values)
        _draw_bounds(ax, traces, each, values)
        star(ax, traces.best[0], values[traces.best], lw=0.9, zorder=6)
        ax.set_ylabel(
            traces.quantity(each.name).label.replace(" [", "\n[")
        )  # long names are longer than a panel
    for ax in axes[max(0, len(tuned) - columns) : len(tuned)]:
        ax.tick_params(labelbottom=True)
    _finish(axes[: len(tuned)], traces, columns)
    return figure


def gradients_figure(traces: Traces) -> Figure:
    """Norm of the gradient."""
    norm = traces.gradient_norm()
    note = f"{_what(traces)}; each component counts per whole range of its parameter"
    figure = page("Gradient over the iterations", _WIDTH, _MARGINS + 2.3, note)
    axes = _column(figure, 1)
    _draw_starts(axes[0], traces, norm)
    axes[0].set_ylabel("norm of the gradient [1]")
    if np.isfinite(norm).any():
        axes[0].set_yscale("log")
        axes[0].set_ylim(0.5 * np.nanmin(norm), 2.0 * np.nanmax(norm))
    _finish(axes, traces)
    return figure


def start_styles(traces: Traces) -> Mapping[int, dict[str, Any]]:
    """Line style of each drawn start, by its number; a few have their own colour and legend entry."""
    best, drawn = traces.best[1], traces.drawn()
    if len(drawn) <= len(START_COLOURS):
        names = {start: f"start {start}" + (" (given)" if start == 0 else "") for start in drawn}
        few = zip(drawn, START_COLOURS, strict=False)
        styles = {
            start: {"color": colour, "lw": 1.6, "zorder": 3, "label": names[start]}
            for start, colour in few
        }
        styles[best]["zorder"] = 4
        return styles if len(drawn) > 1 else {best: styles[best] | {"label": None}}
    styles = {
        start: {"color": BAND_COLOUR, "lw": 0.9, "alpha": 0.8, "zorder": 2, "label": None}
        for start in drawn
    }
    styles[drawn[-1]]["label"] = "other starts"
    styles[0] |= {
        "color": START_COLOURS[1],
        "lw": 1.4,
        "alpha": 1.0,
        "zorder": 3,
        "label": "start 0 (given)",
    }
    styles[best] |= {
        "color": LINE_COLOUR,
        "lw": 1.8,
        "alpha": 1.0,
        "zorder": 4,
        "label": f"start {best} (best)",
    }
    return styles


def _column(figure: Figure, count: int) -> list[Axes]:
    """Panels below one another, the first one a little higher."""
    return list(
        figure.subplots(
            count, 1, sharex=True, squeeze=False, height_ratios=[1.3] + [1] * (count - 1)
        )[:, 0]
    )


def _what(traces: Traces) -> str:
    profile = profile_text([traces.tuning.setup.profile])
    starts, drawn = traces.starts, len(traces.drawn())
    some = f" ({drawn} of them drawn)" if drawn < starts else ""
    return f"{profile}; {len(traces.iterations)} evaluations" + (
        f" of {starts:,} starts{some}" if starts > 1 else ""
    )


def _draw_starts(ax: Axes, traces: Traces, values: np.ndarray) -> None:
    """A line for each start; `values` are (n, starts)."""
    marker: dict[str, Any] = (
        {"marker": "o", "ms": 3.0, "mec": "white", "mew": 0.4}
        if len(traces.iterations) <= 60
        else {}
    )
    for start, style in start_styles(traces).items():
        own = marker if style["lw"] > 1 else {}
        ax.plot(traces.iterations, values[:, start], **style, **own)


def _cut(ax: Axes, values: np.ndarray) -> None:
    """Cut off values so far above the rest that nothing else would be visible."""
    good = values[np.isfinite(values)]
    low, high = np.min(good), np.quantile(good, 0.9)
    top = max(high + 2.0 * (high - low), low + 1.05 * (np.nan_to_num(values[0, 0], nan=low) - low))
    if high > low and good.max() > top:
        ax.set_ylim(low - 0.05 * (top - low), top)
        corner(ax, f"{int((good > top).sum())} higher", 1, "top")


def _draw_bounds(ax: Axes, traces: Traces, tuned: Tuned, values: np.ndarray) -> None:
    """The bounds, and the axis about them, or about the path where it is short."""
    low, high = (
        float(traces.in_shown_unit(tuned.name, bound)) for bound in (tuned.low, tuned.high)
    )
    least, most, span = float(values.min()), float(values.max()), high - low
    text = f"{low:.4g} to {high:.4g}, {'periodic' if tuned.periodic else 'bounds'}"
    corner(ax, text)
    if most - least < _ZOOM * span:
        room = max(0.6 * (most - least), 0.01 * span)
        ax.set_ylim(least - room, most + room)
    else:
        ax.set_ylim(min(low, least) - 0.06 * span, max(high, most) + 0.06 * span)
    first, last = ax.get_ylim()
    unit = traces.quantity(tuned.name).unit
    set_scales(
        ax,
        ShownValues("iteration", "", traces.iterations),
        ShownValues(tuned.name, unit, np.array([first, last])),
    )
    if tuned.periodic:
        turns = range(math.floor((first - low) / span), math.ceil((last - low) / span) + 1)
        bounds: Sequence[float] = [low + turn * span for turn in turns]
    else:
        bounds = (low, high)
        for begin, end in ((first, low), (high, last)):
            if begin < end:
                ax.axhspan(begin, end, color=MISSING_COLOUR, alpha=0.45, lw=0, zorder=0)
    for bound in bounds:
        if first <= bound <= last:
            ax.axhline(bound, color=MUTED_INK, lw=0.9, ls=(0, (4, 3)), zorder=1)


def _finish(axes: Sequence[Axes], traces: Traces, columns: int = 1) -> None:
    """Grid, ticks at whole iterations, the label below the lowest panels, the legend beside the first row."""
    for ax in axes:
        horizontal_grid(ax)
        ax.xaxis.set_major_locator(MaxNLocator(8, integer=True, min_n_ticks=1))
        ax.set_xlim(-0.5, len(traces.iterations) - 0.5)
    for ax in axes[len(axes) - columns :]:
        ax.set_xlabel("iteration [1]")
    legend(axes[columns - 1], *axes[0].get_legend_handles_labels())


# ---
# The landscape behind a tuning's paths: its objective on a grid of one or two parameters, by MuJoCo C in one batch.


#: Points along each parameter: for one, and for two. The ends of a periodic one coincide, and are simulated once.
POINTS: Final = {1: 37, 2: 17}


@dataclasses.dataclass(frozen=True)
class Landscape:
    """The objective on a grid.

    Attributes:
        axes: parameter name -> its values (n,), from bound to bound; one or two of them.
        value: objective (n,) or (n, m); NaN where the robot did not walk to the end.
        walks: how many walks it is from, and the engine that ran them.
    """

    axes: dict[str, np.ndarray]
    value: np.ndarray
    walks: str


def landscape_runs(
    out: Path,
    tuning: Tuning,
    best: Mapping[str, float],
    warn: Warn | None = None,
    held: RunDirectory | None = None,
) -> Runs:
    """The store of a tuning's directory, where the grid's points are one part, simulated only once.

    Its group is a hash of all that determines them: not the path over the grid, so not optimizer, starts and seed.

    Args:
        best: the best point, whose values the tuned parameters have that are not on the grid.
        warn, held: see `nermo_mjx.runs.rows.Runs`.
    """
    axes = grid_axes(tuning)
    others = {name: best[name] for name in tuning.names if name not in axes}
    group = digest_of(
        tuning.without_path().digest(), [nodes.tolist() for nodes in axes.values()], others
    )
    return Runs(out, group, warn=warn, held=held)


def grid_axes(tuning: Tuning) -> dict[str, np.ndarray]:
    """The first one or two tuned parameters, and their values on the grid, both ends included."""
    axes, chosen = {}, tuning.tuned[:2]
    for each in chosen:
        # Like the tuner's points, those of a bounded parameter stop short of the bounds.
        share = np.linspace(0.0, 1.0, POINTS[len(chosen)])
        share = share if each.periodic else FURTHEST + (1.0 - 2.0 * FURTHEST) * share
        axes[each.name] = each.low + (each.high - each.low) * share
    return axes


def simulate(
    tuning: Tuning,
    best: Mapping[str, float],
    simulator: SimulatorLike,
    progress: Callable[[float], None] | None = None,
) -> pa.Table:
    """Simulate the grid; one row per point: its parameters, the objective, the metrics that it uses, and the status.

    Args:
        best: the best point, whose values the tuned parameters have that are not on the grid.

    Raises:
        ParameterError: some point of the grid cannot be simulated; the message says why.
    """
    axes, periodic = grid_axes(tuning), {each.name for each in tuning.tuned if each.periodic}
    walked = [nodes[:-1] if name in periodic else nodes for name, nodes in axes.items()]
    grid = dict(
        zip(axes, (column.ravel() for column in np.meshgrid(*walked, indexing="ij")), strict=True)
    )
    others = {name: best[name] for name in tuning.names if name not in axes}
    count = len(next(iter(grid.values())))
    fixed = {name: np.full(count, value) for name, value in {**tuning.constants, **others}.items()}
    result = simulator.run({**fixed, **grid}, tuning.run, progress=progress)
    status = np.asarray(result.status)
    value = np.where(
        status == "ok", np.asarray(tuning.objective.value(result.metrics), float), np.nan
    )
    table, parameters = Columns(), tuning.parameters
    table.add(
        "row",
        np.arange(count),
        "index",
        "1",
        "position on the grid, the last parameter running fastest",
    )
    for name, column in (grid | {name: fixed[name] for name in others}).items():
        table.add(
            name,
            column,
            "varied" if name in grid else "fixed",
            parameters[name].unit,
            parameters[name].doc,
        )
    table.add(
        "objective", value, "objective", "1", "value that is minimized; NaN where the robot fell"
    )
    for name in tuning.objective.metrics:
        table.add(
            name,
            np.asarray(result.metrics[name]),
            "metric",
            tuning.metrics[name].unit,
            tuning.metrics[name].doc,
        )
    table.add("status", status, "status", "1", "ok, or how the run ended")
    made_by = stamp(tuning.setup.load().fingerprint, result.engine)
    about = {"engine": result.engine, "code": json.dumps(made_by.fields())}
    return table.table(about)


def landscape_of(tuning: Tuning, table: pa.Table) -> Landscape:
    """The grid that `simulate` made a table of; the end of a periodic parameter is its beginning."""
    axes = grid_axes(tuning)
    periodic = [each.periodic for each in tuning.tuned[:2]]
    shape = [len(nodes) - wraps for nodes, wraps in zip(axes.values(), periodic, strict=True)]
    value = table.column("objective").to_numpy().reshape(shape)
    value = np.pad(value, [(0, int(wraps)) for wraps in periodic], mode="wrap")
    return Landscape(
        axes, value, f"{table.num_rows} walks, engine {table.schema.metadata[b'engine'].decode()}"
    )


def stored_landscape(tuning: Tuning, runs: Runs) -> Landscape | None:
    """The grid in a directory's store, if it is there."""
    table = parquet_table(runs.parts[0].path) if runs.parts else None
    return None if table is None else landscape_of(tuning, table)


def has_landscape(tuning: Tuning) -> bool:
    """Whether the metrics of a walk are all that the objective needs: a recording is compared with in MJX only."""
    return TRAJECTORY_ERROR not in tuning.objective.metrics


# ---
# The path of each start over one or two parameters, drawn on the objective's landscape if available.


#: Lower is better, and brighter.
_COLOURS: Final = f"{COLOUR_MAP}_r"
_LEVELS: Final = 18
_LABEL: Final = "objective, lower is better [1]"
#: Share of the landscape's points covered by the colours; including the highest would reduce the contrast.
_COVERED: Final = 0.97


def path_figure(traces: Traces, landscape: Landscape | None = None) -> Figure:
    """The paths over the first two tuned parameters, or of a single one its objective."""
    beneath = profile_text([traces.tuning.setup.profile])
    if landscape is not None:
        rest = len(traces.tuning.tuned) - len(landscape.axes)
        beneath += f"; landscape: {landscape.walks}" + (
            ", the other parameters as in the best point" if rest else ""
        )
    if len(traces.tuning.tuned) == 1:
        return _line(traces, landscape, beneath)
    pair = traces.tuning.tuned[:2]
    note = f"ring: start; dot: end; star: best; {beneath}" + "; colour: objective" * (
        landscape is None
    )
    figure = page(f"Path over {spoken(pair[0].name)} and {spoken(pair[1].name)}", 6.9, 5.4, note)
    ax = figure.subplots()
    ax.set_facecolor("white" if landscape is None else MISSING_COLOUR)
    ends = [traces.in_shown_unit(each.name, np.array(each.bounds)) for each in pair]
    if landscape is not None:
        _draw_landscape(figure, ax, traces, landscape)
    else:
        _draw_values(figure, ax, traces)
    paths = [traces.in_shown_unit(each.name, traces.unwrapped(each)) for each in pair]
    for start in traces.drawn():
        path, turns = [path[:, start] for path in paths], []
        for tuned, values, (low, high) in zip(pair, path, ends, strict=True):
            first, last = (
                math.floor((end - low) / (high - low)) * tuned.periodic
                for end in (values.min(), values.max())
            )
            turns.append(range(first, last + 1))
        copies = list(
            itertools.product(*turns)
        )  # so that all pieces of the path lie within the bounds
        look: Literal["best", "", "thin"] = "best" if start == traces.best[1] else ""
        _draw_path(
            ax,
            path,
            copies,
            [float(np.ptp(end)) for end in ends],
            "thin" if landscape is None else look,
        )
    best = [
        float(traces.in_shown_unit(each.name, traces.column(each.name)[traces.best]))
        for each in pair
    ]
    star(ax, best[0], best[1], 230, 1.2)
    quantities = [
        ShownValues(t.name, traces.quantity(t.name).unit, end)
        for t, end in zip(pair, ends, strict=True)
    ]
    set_scales(ax, *quantities)
    ax.set(xlabel=quantities[0].label, ylabel=quantities[1].label, xlim=ends[0], ylim=ends[1])
    return figure


def _line(traces: Traces, landscape: Landscape | None, beneath: str) -> Figure:
    """The objective over the only parameter: the landscape as a line, and the points that each start visited."""
    (each,) = traces.tuning.tuned
    note = f"dots: evaluations, larger towards the end; star: best; {beneath}"
    figure = page(f"Objective over {spoken(each.name)} (lower is better)", 7.2, 4.0, note)
    ax = figure.subplots()
    if landscape is not None:
        nodes = traces.in_shown_unit(each.name, landscape.axes[each.name])
        ax.plot(nodes, landscape.value, color=MUTED_INK, lw=1.4, zorder=1)
    place, value = (
        traces.in_shown_unit(each.name, traces.column(each.name)),
        traces.column("objective"),
    )
    for start, style in start_styles(traces).items():
        dots = {name: style[name] for name in ("color", "zorder", "label")}
        sizes = np.linspace(8, 40, len(place))
        ax.scatter(place[:, start], value[:, start], s=sizes, ec="white", lw=0.4, **dots)
    star(ax, place[traces.best], value[traces.best])
    ends = traces.in_shown_unit(each.name, np.array([each.low, each.high]))
    quantity = ShownValues(each.name, traces.quantity(each.name).unit, ends)
    set_scales(ax, quantity)
    ax.set(xlabel=quantity.label, ylabel="objective [1]", xlim=quantity.values)
    horizontal_grid(ax)
    legend(ax)
    return figure


def _draw_landscape(figure: Figure, ax: Axes, traces: Traces, landscape: Landscape) -> None:
    """Filled contours; where the robot did not walk to the end, grey hatching shows through."""
    ax.add_patch(
        Rectangle(
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
    good = landscape.value[np.isfinite(landscape.value)]
    if not len(good):
        return
    low, high = float(good.min()), float(np.quantile(good, _COVERED))
    high = high if high > low else low + max(1e-9, 1e-6 * abs(low))
    x, y = (traces.in_shown_unit(name, nodes) for name, nodes in landscape.axes.items())
    cut = "max" if good.max() > high else "neither"
    # The outermost points stand a little inside of the bounds, and their colours reach there.
    x[[0, -1]], y[[0, -1]] = (
        traces.in_shown_unit(t.name, np.array(t.bounds)) for t in traces.tuning.tuned[:2]
    )
    shown = np.ma.masked_invalid(landscape.value.T)
    # The lines are denser towards the best point, and evenly spaced if the objective is a parabola.
    levels = low + (high - low) * np.linspace(0.0, 1.0, _LEVELS + 1) ** 2
    scale = PowerNorm(0.5, low, high)
    ax.contourf(x, y, shown, levels, cmap=_COLOURS, norm=scale, extend=cut, zorder=1)
    ax.contour(
        x,
        y,
        shown,
        levels[::2],
        colors="white",
        linewidths=0.5,
        linestyles="solid",
        alpha=0.45,
        zorder=2,
    )
    colour_bar(figure, ax, ScalarMappable(scale, _COLOURS), _LABEL, aspect=28, extend=cut)


def _draw_values(figure: Figure, ax: Axes, traces: Traces) -> None:
    """Without a landscape, each visited point has the colour of its objective."""
    x, y = (
        traces.in_shown_unit(each.name, traces.column(each.name))
        for each in traces.tuning.tuned[:2]
    )
    value = traces.column("objective")
    drawn, good = traces.drawn(), value[np.isfinite(value)]
    low, high = float(good.min()), float(np.quantile(good, _COVERED))
    scale = Normalize(low, high if high > low else low + 1e-9)
    points = ax.scatter(
        x[:, drawn], y[:, drawn], c=value[:, drawn], s=22, cmap=_COLOURS, lw=0, zorder=5, norm=scale
    )
    colour_bar(figure, ax, points, _LABEL, aspect=28)
    ax.grid(color=GRID, lw=0.8)
    ax.set_axisbelow(True)


def _draw_path(
    ax: Axes,
    path: list[np.ndarray],
    copies: list[tuple[int, ...]],
    spans: list[float],
    look: Literal["best", "", "thin"],
) -> None:
    """One start's path, from a ring to a dot; a path across a periodic bound continues at the other side.

    The best one is wider; without a landscape a path is a thin line, so that its points carry the colour.
    """
    width, layer, thin = 1.6 if look == "best" else 0.9, 5 if look == "best" else 4, look == "thin"
    mark: dict[str, Any] = {"ls": "none", "marker": "o", "zorder": 6}
    halo: list[Any] = [withStroke(linewidth=width + 1.5, foreground=INK)]
    for turn in copies:
        x, y = (values - k * span for values, k, span in zip(path, turn, spans, strict=True))
        if thin:
            ax.plot(x, y, color=MUTED_INK, lw=0.8, zorder=4)
            ax.plot(x[:1], y[:1], ms=8, mfc="none", mec=INK, mew=1.2, **mark)
        else:
            ax.plot(
                x,
                y,
                color="white",
                lw=width,
                path_effects=halo,
                zorder=layer,
                solid_capstyle="round",
            )
            if look == "best":
                ax.plot(x[1:-1], y[1:-1], ls="none", marker="o", ms=2.2, color=INK, zorder=layer)
            ax.plot(x[:1], y[:1], ms=7, mfc="none", mec=INK, mew=3.2, **mark)
            ax.plot(x[:1], y[:1], ms=7, mfc="none", mec="white", mew=1.5, **mark)
        ax.plot(x[-1:], y[-1:], ms=5 if thin else 6, mfc="white", mec=INK, mew=1.1, **mark)


# ---
# The figures of a tuning.


def tuning_figures_of(
    tuning: Tuning, history: pa.Table, landscape: Landscape | None = None
) -> Figures:
    """The figures of a tuning: `objective`, `parameters`, `gradients` and `path`.

    Args:
        tuning: that was run.
        history: its table, as `read_history` returns it; in some iteration the robot walked to the end.
        landscape: the objective's landscape behind the paths.
    """
    traces = Traces(tuning, history)
    yield "objective", objective_figure(traces)
    yield "parameters", parameters_figure(traces)
    yield "gradients", gradients_figure(traces)
    yield "path", path_figure(traces, landscape)


def tuning_figures(out: Path) -> Figures:
    """The figures of a tuning's directory, as far as it is complete.

    Raises:
        SpecError: its tuning.yaml cannot be read.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    tuning, history = load_tuning(out), read_history(out)
    if not pc.any(pc.is_finite(history.column("objective"))).as_py():
        raise DirectoryError(
            f"there is nothing to draw of {out}: the robot walked to the end at no point of this tuning."
        )
    traces = Traces(tuning, history)
    best = {name: float(traces.column(name)[traces.best]) for name in tuning.names}
    landscape = (
        stored_landscape(tuning, landscape_runs(out, tuning, best))
        if has_landscape(tuning)
        else None
    )
    return tuning_figures_of(tuning, history, landscape)


def make_figures(
    directory: TuningDirectory,
    simulator: Callable[[], SimulatorLike] | None,
    watch: Watch,
    history: pa.Table,
    best: Mapping[str, Any],
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Make the figures of a tuning.

    Args:
        directory: where they go.
        simulator: creates the simulator for the landscape on first use; None: nothing is simulated.
        watch: is told what is being made, and the share of it.
        history: the tuning's table.
        best: the best point, see `nermo_mjx.optimize.directory`.

    Returns:
        The files, and a sentence if there is no landscape.
    """
    tuning, out, notes = directory.tuning, directory.out, list[str]()

    def drawing(what: str, share: float = 0.0) -> None:
        watch.progress(Progress(share, what=what))

    plots: list[Path] = []
    if tuning.plots:
        landscape = None
        if simulator is not None and has_landscape(tuning):
            runs = landscape_runs(out, tuning, best["parameters"], watch.warn, directory.held)
            if not runs.parts:
                drawing("landscape")
                try:
                    table = simulate(
                        tuning,
                        best["parameters"],
                        simulator(),
                        lambda share: drawing("landscape", share),
                    )
                    retire(directory.held, runs.group)
                    values = {name: table[name].to_numpy() for name in grid_axes(tuning)}
                    runs.add(keys_of(runs.group, values, table.num_rows), table)
                except ParameterError as error:
                    notes.append(
                        f"There is no landscape behind the paths, because some of it cannot be walked: {error}"
                    )
            landscape = stored_landscape(tuning, runs)
        drawing("plots")
        plots = write_figures(tuning_figures_of(tuning, history, landscape), out / "plots")
    return tuple(plots), tuple(notes)


# ---
# The figures of a search: how it converged, its front or its atlas; and any columns of its table.


#: Pairs of measures that an atlas of three or more shows.
_MOST_PAIRS: Final = 6


def search_figures_of(search: Search, results: Results) -> Figures:
    """(file name, figure) of a search's table; nothing where no point is allowed."""
    found = Evaluations.of(search, results)
    if found.best() is None:
        return
    if search.aim.measures:
        yield "atlas", atlas(found)
        yield "coverage", coverage(found)
    elif search.aim.pareto:
        yield "front", front_figure(found)
        yield "hypervolume", hypervolume(found)
    else:
        yield "convergence", convergence(found)
    metric = search.aim.objective.terms[0].metric
    yield from (
        (name, figure)
        for name, figure in survey_figures(results, metric)
        if name.endswith("-parallel")
    )


def search_figures(
    out: Path, *, x: str | None = None, y: str | None = None, color: str | None = None
) -> Figures:
    """The figures of a search's directory, as far as it goes.

    Args:
        out: the directory.
        x, y, color: columns of one figure, see `nermo_mjx.sweep.plots.chosen_figure`.

    Raises:
        ParameterError: there is no such column.
        SpecError: its search.yaml cannot be read.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    search, files = Search.from_file(out / SEARCH), part_files(out)
    if not files:
        command = f"nermo-mjx search {out / SEARCH} --out {out}"
        raise DirectoryError(f"{out} holds no results of its search yet: run {command}.")
    results = Results(files)
    if x is not None:
        return chosen_figure(results, x, y, color)
    if y is not None or color is not None:
        raise ParameterError("x is not given, beside y or color: name it, too.")
    if Evaluations.of(search, results).best() is None:
        raise DirectoryError(
            f"there is nothing to draw of {out}: no point is within the constraints."
        )
    return search_figures_of(search, results)


def convergence(found: Evaluations) -> Figure:
    """Every evaluated point, in the order in which they were asked for, and the best so far."""
    quantity = _objective(found)
    values, allowed = quantity.values, found.scores.allowed
    number = np.arange(1, len(values) + 1)
    cost = np.where(allowed, found.scores.cost[:, 0], np.inf)
    best = int(np.argmin(cost))
    first = np.concatenate(
        [[True], cost[1:] < np.minimum.accumulate(cost)[:-1]]
    )  # better than all before it
    leading = np.maximum.accumulate(np.where(first, np.arange(len(cost)), 0))
    note = f"{_counted(found)}; line: best so far; star: best, {quantity.shown(values[best])} at {_at(found, best)}"
    figure = page(f"{_title(quantity)} over the evaluations", _WIDTH, 4.4, note)
    ax = figure.subplots()
    ax.scatter(
        number[allowed],
        values[allowed],
        s=9,
        color=BAND_COLOUR,
        lw=0,
        rasterized=len(values) > 2000,
    )
    reached = np.isfinite(cost[leading])
    ax.step(number[reached], values[leading][reached], where="post", color=LINE_COLOUR)
    star(ax, number[best], values[best], 170, zorder=5)
    if not allowed.all():  # short lines at the bottom where a point fell or broke a constraint
        height = np.full(int((~allowed).sum()), 0.01)
        ax.plot(
            number[~allowed], height, "|", color=MUTED_INK, ms=5, transform=ax.get_xaxis_transform()
        )
    terms = found.search.aim.objective.terms
    higher = len(terms) == 1 and terms[0].aim == "maximize"
    low, high = np.nanquantile(values[allowed], [0.01, 1.0] if higher else [0.0, 0.99])
    room = 0.06 * max(high - low, 1e-9)
    ax.set(ylim=(low - room, high + room), xlim=(0, len(values) + 1))
    horizontal_grid(ax)
    ax.set(xlabel="evaluations [1]", ylabel=quantity.label)
    return figure


def front_figure(found: Evaluations) -> Figure:
    """The first two objectives against each other, with the front of these two or of all."""
    terms, best = found.search.aim.objective.terms, found.front()
    allowed = np.flatnonzero(found.scores.allowed)
    x, y = (_term_values(found, i) for i in (0, 1))
    place = {int(point): i for i, point in enumerate(allowed)}
    lines = []
    for point in (int(best[i]) for i in named_points(x.values[best], y.values[best])):
        both = f"{x.name} {x.shown(x.values[point])}, {y.name} {y.shown(y.values[point])}"
        lines.append((place[point], f"{both}:  {_at(found, point)}"))
    more = f"front of all {len(terms)} objectives; " if len(terms) > 2 else ""
    across, up = (ShownValues(each.name, each.unit, each.values[allowed]) for each in (x, y))
    first, second = ("max" if term.aim == "maximize" else "min" for term in terms[:2])
    # A line along a front of more objectives would cross itself.
    sides = (first, second) if len(terms) == 2 else ("nearest zero", "nearest zero")
    title = f"{x.name} against {y.name}".replace("_", " ").capitalize()
    places = np.array([place[int(point)] for point in best])
    return trade_off(across, up, places, sides, lines, title, f"{_counted(found)}; {more}")


def hypervolume(found: Evaluations) -> Figure:
    """How much of the box between first batch and best values the front beats, over the evaluations."""
    shares, worst = hypervolumes(found)
    corner = []
    for term, value in zip(found.search.aim.objective.terms, worst.tolist(), strict=True):
        quantity = _quantity(found, term.metric, _as_metric(term, value))
        corner.append(f"{term.metric} {quantity.shown(float(quantity.values))}")
    note = (
        f"{_counted(found)}; box: from the best of each objective to the worst of the first batch,"
        f" {', '.join(corner)}"
    )
    figure = page("Hypervolume of the front over the evaluations", _WIDTH, 3.6, note)
    ax = figure.subplots()
    ax.step(_ends(found), 100 * shares, where="post", color=LINE_COLOUR)
    ax.set(xlabel="evaluations [1]", ylabel="hypervolume [%]", xlim=(0, len(found.scores) + 1))
    horizontal_grid(ax)
    return figure


def coverage(found: Evaluations) -> Figure:
    """Filled cells and QD score over the evaluations."""
    filled, total = atlas_progress(found)
    cells, terms = (
        int(np.prod([each.cells for each in found.search.aim.measures])),
        found.search.aim.objective.terms,
    )
    note = f"{_counted(found)}; {filled[-1]:,} of {cells:,} cells are filled; QD score: sum over the filled cells of "
    note += "what their best is better than the worst of the first batch"
    figure = page("Filled cells and QD score over the evaluations", _WIDTH, 4.8, note)
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.step(_ends(found), filled, where="post", color=LINE_COLOUR)
    top.set_ylabel("filled cells [1]")
    scale = ShownValues("", "", total)
    if len(terms) == 1 and terms[0].aim != "hold":
        scale = _quantity(found, terms[0].metric, total * terms[0].scale / terms[0].weight)
    bottom.step(_ends(found), scale.values, where="post", color=LINE_COLOUR)
    bottom.set_ylabel(f"QD score [{scale.unit or 1}]")
    for ax in (top, bottom):
        ax.set_ylim(bottom=0)
        horizontal_grid(ax)
    bottom.set(xlabel="evaluations [1]", xlim=(0, len(found.scores) + 1))
    return figure


def atlas(found: Evaluations) -> Figure:
    """The best in each cell: bars over one measure, a map over two, maps over the pairs of more."""
    measures, quantity = found.search.aim.measures, _objective(found)
    cells, points = elites_of(found.search.aim, found.scores)
    best = int(points[np.argmax(found.scores.quality[points])])
    total = int(np.prod([each.cells for each in measures]))
    note = f"{_counted(found)}; {len(cells):,} of {total:,} cells are filled; star: best, "
    note += f"{quantity.shown(quantity.values[best])} at {_at(found, best)}"
    title = f"{_title(quantity)}: the best in each cell"
    if len(measures) == 1:
        return _bars(found, points, quantity, best, title, note)
    pairs = list(itertools.combinations(range(len(measures)), 2))[:_MOST_PAIRS]
    if len(pairs) > 1:
        note += "; each map shows the best over all other measures"
    columns = min(len(pairs), 2)
    rows = -(-len(pairs) // columns)
    figure = blank(_WIDTH, 1.1 + 4.2 * rows / (1 if columns == 1 else 1.3))
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel().tolist()
    scale, extend = colour_scale(quantity.values[points])
    for ax in axes[len(pairs) :]:
        ax.remove()
    for ax, pair in zip(axes, pairs, strict=False):
        _map(ax, found, points, quantity, scale, pair, best)
    bar = ScalarMappable(scale, COLOUR_MAP)
    colour_bar(figure, axes[: len(pairs)], bar, quantity.label, shrink=0.9, extend=extend)
    return around(figure, title, note)


def _map(
    ax: Axes,
    found: Evaluations,
    points: np.ndarray,
    z: ShownValues,
    scale: Normalize,
    pair: tuple[int, int],
    best: int,
) -> None:
    """Cells of two measures, coloured by the best point in each."""
    measures = [found.search.aim.measures[i] for i in pair]
    places, edges, at = [], [], []
    for i, each in zip(pair, measures, strict=True):
        share = (found.scores.measures[points, i] - each.low) / (each.high - each.low)
        places.append(np.clip((share * each.cells).astype(int), 0, each.cells - 1))
        edges.append(_edges(found, each))
        at.append(_quantity(found, each.metric, found.scores.measures[best, i]).values)
    grid = np.full([each.cells for each in measures], np.nan)
    order = np.argsort(
        found.scores.quality[points], kind="stable"
    )  # the best of several comes last
    grid[places[0][order], places[1][order]] = z.values[points[order]]
    ax.set_facecolor("#fafafa")
    ax.pcolormesh(
        edges[0].values, edges[1].values, np.ma.masked_invalid(grid.T), norm=scale, cmap=COLOUR_MAP
    )
    star(ax, at[0], at[1], 190, 1.3, zorder=5)
    set_scales(ax, *edges)
    ax.set(xlabel=edges[0].label, ylabel=edges[1].label)


def _bars(
    found: Evaluations, points: np.ndarray, z: ShownValues, best: int, title: str, note: str
) -> Figure:
    """The best point over one measure."""
    (measure,) = found.search.aim.measures
    figure = page(title, _WIDTH, 3.9, note)
    ax = figure.subplots()
    edges = _edges(found, measure)
    cell = cells_of(found.search.aim, found.scores.measures[points])
    values = z.values[points]
    floor = (
        min(float(values.min()), 0.0)
        if np.ptp(values) == 0
        else float(values.min() - 0.1 * np.ptp(values))
    )
    ax.bar(
        edges.values[cell],
        values - floor,
        np.diff(edges.values)[cell],
        floor,
        align="edge",
        color=BAND_COLOUR,
        ec="white",
    )
    at = _quantity(found, measure.metric, found.scores.measures[best, 0])
    star(ax, at.values, z.values[best], 170, zorder=5)
    ax.set(xlabel=edges.label, ylabel=z.label, xlim=(edges.values[0], edges.values[-1]))
    horizontal_grid(ax)
    return figure


def _objective(found: Evaluations) -> ShownValues:
    """The objective of all points, in the metric's unit where it is one metric, NaN where a run failed."""
    terms = found.search.aim.objective.terms
    if len(terms) == 1 and terms[0].aim != "hold":
        return _term_values(found, 0)
    return ShownValues("objective", "", found.scores.cost[:, 0])


def _term_values(found: Evaluations, place: int) -> ShownValues:
    """The metric of a term, or what it adds where it holds the metric at a value."""
    term, cost = found.search.aim.objective.terms[place], found.scores.cost[:, place]
    if term.aim == "hold":
        return ShownValues(f"{term.metric} off {term.at:g}", "", cost)
    return _quantity(found, term.metric, _as_metric(term, cost))


def _as_metric(term: ObjectiveTerm, cost: np.ndarray | float) -> np.ndarray | float:
    """The metric of a cost, of a term that maximizes or minimizes it."""
    return (
        cost
        if term.aim == "hold"
        else cost * term.scale / term.weight * (-1.0 if term.aim == "maximize" else 1.0)
    )


def _quantity(found: Evaluations, metric: str, values: np.ndarray | float) -> ShownValues:
    return shown(metric, found.search.sweep.metrics[metric].unit, values)


def _edges(found: Evaluations, measure: Measure) -> ShownValues:
    """The edges of a measure's cells."""
    return _quantity(
        found, measure.metric, np.linspace(measure.low, measure.high, measure.cells + 1)
    )


def _title(quantity: ShownValues) -> str:
    return quantity.name.replace("_", " ").capitalize()


def _at(found: Evaluations, point: int) -> str:
    """The first parameters of a point, as people read them."""
    known, names = found.search.sweep.parameters, list(found.search.names[:6])
    values = found.means(names, np.array([point]))
    quantities = [shown(name, known[name].unit, values[name][0]) for name in names]
    return ", ".join(f"{each.name} {each.shown(float(each.values))}" for each in quantities)


def _counted(found: Evaluations) -> str:
    lost, broken = (
        int((~found.scores.ok).sum()),
        int((found.scores.ok & ~found.scores.allowed).sum()),
    )
    text = profile_text(profiles_of(found.results))
    text += f"; {len(found.scores):,} evaluations by {found.search.method.name.replace('_', '-').upper()}"
    text += f", each the mean of {found.search.repeats} runs" if found.search.repeats > 1 else ""
    text += f"; {lost:,} fell" if lost else ""
    return text + (f"; {broken:,} broke a constraint" if broken else "")


def _ends(found: Evaluations) -> np.ndarray:
    """Evaluations at the end of each batch."""
    return np.cumsum(np.bincount(found.batch))
