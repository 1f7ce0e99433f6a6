"""The figures of a tuning: its history over the iterations, and its paths over the parameters."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
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
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from nermo_mjx.optimize.landscape import (
    Landscape,
    has_landscape,
    landscape_sweep,
    read_landscape,
    simulate_landscape,
)
from nermo_mjx.optimize.objective import TRAJECTORY_ERROR
from nermo_mjx.optimize.tuning_directory import TuningDirectory, load_tuning
from nermo_mjx.optimize.tuning_history import read_history
from nermo_mjx.optimize.tuning_spec import Tuned, Tuning
from nermo_mjx.plotting.charts import (
    PAGE_WIDTH_INCHES,
    blank_page,
    colour_bar,
    draw_horizontal_grid,
    draw_star,
    hatch_axes,
    set_scales,
)
from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.plotting.shown import ShownValues, shown, spoken
from nermo_mjx.plotting.style import (
    BAND_COLOUR,
    COLOUR_MAP,
    GRID,
    INK,
    LINE_COLOUR,
    MISSING_COLOUR,
    MUTED_INK,
    SERIES,
)
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.runs.job import Progress, Watch
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.simulating import SimulatorLike
from nermo_mjx.sweep.table import meta, profile_text

# ---
# The history of a tuning as arrays over iterations and starts, for figures and summaries.


#: Maximum number of starts in a figure, including the best and the given one.
MOST_STARTS: Final = 32


@dataclasses.dataclass(frozen=True)
class Traces:
    """The history of each start.

    Attributes:
        tuning: Tuning that was run.
        table: History of the tuning, see `nermo_mjx.optimize.tuning_directory`.
    """

    tuning: Tuning
    table: pa.Table

    @property
    def starts(self) -> int:
        """Number of starts."""
        return self.tuning.starts

    @property
    def iterations(self) -> np.ndarray:
        """Number of each evaluation (n,); 0 is the evaluation of the initial points."""
        return np.arange(self.table.num_rows // self.starts)

    @cached_property
    def ok(self) -> np.ndarray:
        """Whether the robot walked to the end (n, starts)."""
        return self.column("ok").astype(bool)

    @cached_property
    def best(self) -> tuple[int, int]:
        """Iteration and start of the lowest objective, which exists if `best.json` exists."""
        value = self.column("objective")
        iteration, start = np.unravel_index(np.nanargmin(value), value.shape)
        return int(iteration), int(start)

    def column(self, name: str) -> np.ndarray:
        """Values of a column (n, starts), in its unit."""
        return self.table.column(name).to_numpy(zero_copy_only=False).reshape(-1, self.starts)

    def quantity(self, name: str) -> ShownValues:
        """Values of a column (n, starts) in the unit of figures; metrics of walks that did not end normally are NaN."""
        metadata = meta(self.table.schema.field(name))
        values = self.column(name)
        if metadata["role"] == "metric":
            values = np.where(self.ok, values, np.nan)
        return shown(name, metadata["unit"], values)

    def unwrapped_values(self, tuned: Tuned) -> np.ndarray:
        """Values of a parameter (n, starts) in its unit; a periodic parameter continues beyond its bounds."""
        values = self.column(tuned.name)
        return (
            np.unwrap(values, axis=0, period=tuned.high - tuned.low) if tuned.periodic else values
        )

    def in_shown_unit(self, name: str, value: float | np.ndarray) -> np.ndarray:
        """Values of a parameter or metric in the unit of figures."""
        return shown(name, meta(self.table.schema.field(name))["unit"], np.asarray(value)).values

    def gradient_norm(self) -> np.ndarray:
        """Norm of each gradient (n, starts); NaN if there is no gradient.

        Each component counts per whole range of its parameter, so that units do not matter.
        """
        tuned = self.tuning.tuned
        ranges = np.array([parameter.high - parameter.low for parameter in tuned])
        gradient = (
            np.stack([self.column(f"gradient.{parameter.name}") for parameter in tuned], axis=-1)
            * ranges
        )
        norm = np.linalg.norm(gradient, axis=-1)
        return np.where(norm > 0, norm, np.nan)

    def drawn_starts(self) -> list[int]:
        """The starts in figures: all of them, or the first one, the best one, and some in between."""
        if self.starts <= MOST_STARTS:
            return list(range(self.starts))
        some = np.linspace(0, self.starts - 1, MOST_STARTS - 1).round().astype(int)
        return sorted({*some.tolist(), self.best[1]})


def draw_note(
    ax: Axes, text: str, y: float = 1.01, va: Literal["bottom", "top"] = "bottom"
) -> None:
    """Draw a small note at the top right of a panel."""
    ax.annotate(
        text, (1, y), xycoords="axes fraction", ha="right", va=va, fontsize=8, color=MUTED_INK
    )


def draw_legend(ax: Axes, handles: Any = None, labels: Any = None, **more: Any) -> None:
    """Draw the legend beside a panel, unless it is empty."""
    if handles is None:
        handles, labels = ax.get_legend_handles_labels()
    if handles:
        ax.legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, **more)


#: Colours of single starts; with more starts, only the best one has its own colour.
START_COLOURS: Final = SERIES
#: Panels of one figure.
MAX_PARAMETER_PANELS: Final = 12
_PANEL, _MARGINS = 1.75, 0.85
#: A path shorter than this fraction of its bounds is shown enlarged.
_ZOOM: Final = 0.2
_AIM_TEXTS: Final = {
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
    start_note = f" of start {start}" if traces.starts > 1 else ""
    note = f"{_subtitle(traces)}; dashed: best so far; star: best, {best:.4g} in iteration {iteration}{start_note}"
    figure = blank_page(
        "Objective over the iterations (lower is better)",
        PAGE_WIDTH_INCHES,
        2.9 + _PANEL * len(terms),
        note,
    )
    axes = _make_panels(figure, 1 + len(terms))
    value = traces.column("objective")
    _draw_starts(axes[0], traces, value)
    # There is no best point before the first completed walk.
    lowest = np.minimum.accumulate(np.where(np.isfinite(value), value, np.inf).min(axis=1))
    lowest[np.isinf(lowest)] = np.nan
    axes[0].step(traces.iterations, lowest, where="post", color=INK, lw=1.1, ls=(0, (4, 2)))
    axes[0].set_ylabel("objective [1]")
    _limit_axis(axes[0], value)
    label: str | None = "fell"
    for start_index, style in start_styles(traces).items():
        fell = traces.iterations[~traces.ok[:, start_index]]
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
        draw_note(ax, _AIM_TEXTS[term.aim])
        ax.set_ylabel(quantity.label)
    draw_star(axes[0], iteration, best, lw=0.9, zorder=6)
    for ax, metric in zip(axes[1:], terms, strict=True):
        draw_star(ax, iteration, traces.quantity(metric).values[traces.best], lw=0.9, zorder=6)
    _finish(axes, traces)
    return figure


def parameters_figure(traces: Traces) -> Figure:
    """Each parameter over the iterations with its bounds, in its unit; a periodic one continues beyond its bounds."""
    tuned = traces.tuning.tuned[:MAX_PARAMETER_PANELS]
    left_out = len(traces.tuning.tuned) - len(tuned)
    note = f"{_subtitle(traces)}; dashed: bounds, or where a periodic parameter wraps around; star: best"
    note += f"; {left_out} more parameters are not shown" if left_out else ""
    columns = 1 if len(tuned) <= 3 else 2
    rows = math.ceil(len(tuned) / columns)
    figure = blank_page(
        "Parameters over the iterations", PAGE_WIDTH_INCHES, _MARGINS + (_PANEL + 0.25) * rows, note
    )
    axes = list(figure.subplots(rows, columns, sharex=True, squeeze=False).ravel())
    for ax in axes[len(tuned) :]:
        ax.remove()
    for ax, parameter in zip(axes, tuned, strict=False):
        values = traces.in_shown_unit(parameter.name, traces.unwrapped_values(parameter))
        _draw_starts(ax, traces, values)
        _draw_bounds(ax, traces, parameter, values)
        draw_star(ax, traces.best[0], values[traces.best], lw=0.9, zorder=6)
        ax.set_ylabel(
            traces.quantity(parameter.name).label.replace(" [", "\n[")
        )  # long names are longer than a panel
    for ax in axes[max(0, len(tuned) - columns) : len(tuned)]:
        ax.tick_params(labelbottom=True)
    _finish(axes[: len(tuned)], traces, columns)
    return figure


def gradients_figure(traces: Traces) -> Figure:
    """The norm of the gradient over the iterations."""
    norm = traces.gradient_norm()
    note = f"{_subtitle(traces)}; each component counts per whole range of its parameter"
    figure = blank_page("Gradient over the iterations", PAGE_WIDTH_INCHES, _MARGINS + 2.3, note)
    axes = _make_panels(figure, 1)
    _draw_starts(axes[0], traces, norm)
    axes[0].set_ylabel("norm of the gradient [1]")
    if np.isfinite(norm).any():
        axes[0].set_yscale("log")
        axes[0].set_ylim(0.5 * np.nanmin(norm), 2.0 * np.nanmax(norm))
    _finish(axes, traces)
    return figure


def start_styles(traces: Traces) -> Mapping[int, dict[str, Any]]:
    """Line style of each drawn start, by its number; some starts have their own colour and legend entry."""
    best, drawn_starts = traces.best[1], traces.drawn_starts()
    if len(drawn_starts) <= len(START_COLOURS):
        names = {
            start: f"start {start}" + (" (given)" if start == 0 else "") for start in drawn_starts
        }
        coloured = zip(drawn_starts, START_COLOURS, strict=False)
        styles = {
            start: {"color": colour, "lw": 1.6, "zorder": 3, "label": names[start]}
            for start, colour in coloured
        }
        styles[best]["zorder"] = 4
        return styles if len(drawn_starts) > 1 else {best: styles[best] | {"label": None}}
    styles = {
        start: {"color": BAND_COLOUR, "lw": 0.9, "alpha": 0.8, "zorder": 2, "label": None}
        for start in drawn_starts
    }
    styles[drawn_starts[-1]]["label"] = "other starts"
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


def _make_panels(figure: Figure, count: int) -> list[Axes]:
    """Make panels one below another, where the first one is a little higher."""
    return list(
        figure.subplots(
            count, 1, sharex=True, squeeze=False, height_ratios=[1.3] + [1] * (count - 1)
        )[:, 0]
    )


def _subtitle(traces: Traces) -> str:
    profile = profile_text([traces.tuning.setup.profile])
    starts, drawn_count = traces.starts, len(traces.drawn_starts())
    drawn_note = f" ({drawn_count} of them drawn)" if drawn_count < starts else ""
    return f"{profile}; {len(traces.iterations)} evaluations" + (
        f" of {starts:,} starts{drawn_note}" if starts > 1 else ""
    )


def _draw_starts(ax: Axes, traces: Traces, values: np.ndarray) -> None:
    """Draw a line for each start; `values` are (n, starts)."""
    marker: dict[str, Any] = (
        {"marker": "o", "ms": 3.0, "mec": "white", "mew": 0.4}
        if len(traces.iterations) <= 60
        else {}
    )
    for start, style in start_styles(traces).items():
        marker_options = marker if style["lw"] > 1 else {}
        ax.plot(traces.iterations, values[:, start], **style, **marker_options)


def _limit_axis(ax: Axes, values: np.ndarray) -> None:
    """Limit the axis so that a few much larger values do not hide the differences between the other values."""
    good = values[np.isfinite(values)]
    low, high = np.min(good), np.quantile(good, 0.9)
    top = max(high + 2.0 * (high - low), low + 1.05 * (np.nan_to_num(values[0, 0], nan=low) - low))
    if high > low and good.max() > top:
        ax.set_ylim(low - 0.05 * (top - low), top)
        draw_note(ax, f"{int((good > top).sum())} higher", 1, "top")


def _draw_bounds(ax: Axes, traces: Traces, tuned: Tuned, values: np.ndarray) -> None:
    """Draw the bounds, and limit the axis to them, or to the path if the path is short."""
    low, high = (
        float(traces.in_shown_unit(tuned.name, bound)) for bound in (tuned.low, tuned.high)
    )
    lowest, highest, span = float(values.min()), float(values.max()), high - low
    text = f"{low:.4g} to {high:.4g}, {'periodic' if tuned.periodic else 'bounds'}"
    draw_note(ax, text)
    if highest - lowest < _ZOOM * span:
        room = max(0.6 * (highest - lowest), 0.01 * span)
        ax.set_ylim(lowest - room, highest + room)
    else:
        ax.set_ylim(min(low, lowest) - 0.06 * span, max(high, highest) + 0.06 * span)
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
    """Draw the grid, ticks at whole iterations, the label below the lowest panels, and the legend of the first row."""
    for ax in axes:
        draw_horizontal_grid(ax)
        ax.xaxis.set_major_locator(MaxNLocator(8, integer=True, min_n_ticks=1))
        ax.set_xlim(-0.5, len(traces.iterations) - 0.5)
    for ax in axes[len(axes) - columns :]:
        ax.set_xlabel("iteration [1]")
    draw_legend(axes[columns - 1], *axes[0].get_legend_handles_labels())


# ---
# The path of each start over one or two parameters, drawn on the objective's landscape if available.


#: Colours of the landscape; a lower objective, which is better, is brighter.
_LANDSCAPE_COLOURS: Final = f"{COLOUR_MAP}_r"
_LEVELS: Final = 18
_LABEL: Final = "objective, lower is better [1]"
#: Share of the landscape's points within the range of colours; the highest points would reduce the contrast.
_COVERED: Final = 0.97


def path_figure(traces: Traces, landscape: Landscape | None = None) -> Figure:
    """The paths over the first two tuned parameters, or the objective over a single one."""
    beneath = profile_text([traces.tuning.setup.profile])
    if landscape is not None:
        other_count = len(traces.tuning.tuned) - len(landscape.axes)
        beneath += f"; landscape: {landscape.walks}" + (
            ", the other parameters as in the best point" if other_count else ""
        )
    if len(traces.tuning.tuned) == 1:
        return _line_figure(traces, landscape, beneath)
    pair = traces.tuning.tuned[:2]
    note = f"ring: start; dot: end; star: best; {beneath}" + "; colour: objective" * (
        landscape is None
    )
    figure = blank_page(
        f"Path over {spoken(pair[0].name)} and {spoken(pair[1].name)}", 6.9, 5.4, note
    )
    ax = figure.subplots()
    ax.set_facecolor("white" if landscape is None else MISSING_COLOUR)
    ends = [traces.in_shown_unit(parameter.name, np.array(parameter.bounds)) for parameter in pair]
    if landscape is not None:
        _draw_landscape(figure, ax, traces, landscape)
    else:
        _draw_values(figure, ax, traces)
    paths = [
        traces.in_shown_unit(parameter.name, traces.unwrapped_values(parameter))
        for parameter in pair
    ]
    for start in traces.drawn_starts():
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
        float(traces.in_shown_unit(parameter.name, traces.column(parameter.name)[traces.best]))
        for parameter in pair
    ]
    draw_star(ax, best[0], best[1], 230, 1.2)
    quantities = [
        ShownValues(t.name, traces.quantity(t.name).unit, end)
        for t, end in zip(pair, ends, strict=True)
    ]
    set_scales(ax, *quantities)
    ax.set(xlabel=quantities[0].label, ylabel=quantities[1].label, xlim=ends[0], ylim=ends[1])
    return figure


def _line_figure(traces: Traces, landscape: Landscape | None, beneath: str) -> Figure:
    """The objective over a single parameter: the landscape as a line, and the points that each start visited."""
    (parameter,) = traces.tuning.tuned
    note = f"dots: evaluations, larger towards the end; star: best; {beneath}"
    figure = blank_page(
        f"Objective over {spoken(parameter.name)} (lower is better)", PAGE_WIDTH_INCHES, 4.0, note
    )
    ax = figure.subplots()
    if landscape is not None:
        nodes = traces.in_shown_unit(parameter.name, landscape.axes[parameter.name])
        ax.plot(nodes, landscape.value, color=MUTED_INK, lw=1.4, zorder=1)
    positions = traces.in_shown_unit(parameter.name, traces.column(parameter.name))
    value = traces.column("objective")
    for start, style in start_styles(traces).items():
        dots = {name: style[name] for name in ("color", "zorder", "label")}
        sizes = np.linspace(8, 40, len(positions))
        ax.scatter(positions[:, start], value[:, start], s=sizes, ec="white", lw=0.4, **dots)
    draw_star(ax, positions[traces.best], value[traces.best])
    ends = traces.in_shown_unit(parameter.name, np.array([parameter.low, parameter.high]))
    quantity = ShownValues(parameter.name, traces.quantity(parameter.name).unit, ends)
    set_scales(ax, quantity)
    ax.set(xlabel=quantity.label, ylabel="objective [1]", xlim=quantity.values)
    draw_horizontal_grid(ax)
    draw_legend(ax)
    return figure


def _draw_landscape(figure: Figure, ax: Axes, traces: Traces, landscape: Landscape) -> None:
    """Draw filled contours, and grey hatching at points whose walk did not end normally."""
    hatch_axes(ax)
    good = landscape.value[np.isfinite(landscape.value)]
    if not len(good):
        return
    low, high = float(good.min()), float(np.quantile(good, _COVERED))
    high = high if high > low else low + max(1e-9, 1e-6 * abs(low))
    x, y = (traces.in_shown_unit(name, nodes) for name, nodes in landscape.axes.items())
    cut = "max" if good.max() > high else "neither"
    # The outermost points are a little inside of the bounds, and their colours extend to the bounds.
    x[[0, -1]], y[[0, -1]] = (
        traces.in_shown_unit(t.name, np.array(t.bounds)) for t in traces.tuning.tuned[:2]
    )
    masked = np.ma.masked_invalid(landscape.value.T)
    # The lines are denser towards the best point, so that they are evenly spaced if the objective is a parabola.
    levels = low + (high - low) * np.linspace(0.0, 1.0, _LEVELS + 1) ** 2
    scale = PowerNorm(0.5, low, high)
    ax.contourf(x, y, masked, levels, cmap=_LANDSCAPE_COLOURS, norm=scale, extend=cut, zorder=1)
    ax.contour(
        x,
        y,
        masked,
        levels[::2],
        colors="white",
        linewidths=0.5,
        linestyles="solid",
        alpha=0.45,
        zorder=2,
    )
    colour_bar(figure, ax, ScalarMappable(scale, _LANDSCAPE_COLOURS), _LABEL, aspect=28, extend=cut)


def _draw_values(figure: Figure, ax: Axes, traces: Traces) -> None:
    """Draw each visited point in the colour of its objective, if there is no landscape."""
    x, y = (
        traces.in_shown_unit(parameter.name, traces.column(parameter.name))
        for parameter in traces.tuning.tuned[:2]
    )
    value = traces.column("objective")
    drawn_starts, good = traces.drawn_starts(), value[np.isfinite(value)]
    low, high = float(good.min()), float(np.quantile(good, _COVERED))
    scale = Normalize(low, high if high > low else low + 1e-9)
    points = ax.scatter(
        x[:, drawn_starts],
        y[:, drawn_starts],
        c=value[:, drawn_starts],
        s=22,
        cmap=_LANDSCAPE_COLOURS,
        lw=0,
        zorder=5,
        norm=scale,
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
    """Draw the path of one start, from a ring to a dot; across a periodic bound it continues on the other side.

    The path of the best start is wider. Without a landscape, a path is a thin line, and its points are coloured.
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
        tuning: Tuning that was run.
        history: Table of `read_history` with at least one completed walk.
        landscape: Landscape of the objective behind the paths.
    """
    traces = Traces(tuning, history)
    yield "objective", objective_figure(traces)
    yield "parameters", parameters_figure(traces)
    yield "gradients", gradients_figure(traces)
    yield "path", path_figure(traces, landscape)


def tuning_figures(out: Path) -> Figures:
    """The figures of the iterations in a tuning's directory.

    Raises:
        SpecError: tuning.yaml cannot be read.
        DirectoryError: The history is empty, or cannot be read.
    """
    tuning, history = load_tuning(out), read_history(out)
    if not pc.any(pc.is_finite(history.column("objective"))).as_py():
        raise DirectoryError(
            f"there is nothing to draw of {out}: the robot walked to the end at no point of this tuning."
        )
    traces = Traces(tuning, history)
    best = {name: float(traces.column(name)[traces.best]) for name in tuning.names}
    landscape = None
    if has_landscape(tuning):
        with contextlib.suppress(SpecError):  # a point of the grid cannot be simulated
            landscape = read_landscape(tuning, landscape_sweep(tuning, best), out)
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
        directory: Directory of the figures.
        simulator: Function that creates the simulator of the landscape on first use; None for no simulation.
        watch: Receiver of the progress.
        history: Table of the tuning's history.
        best: Best point, see `nermo_mjx.optimize.tuning_directory`.

    Returns:
        Paths of the figures, and a sentence if there is no landscape.
    """
    tuning, out = directory.tuning, directory.out
    if not tuning.plots:
        return (), ()
    landscape, notes = None, tuple[str, ...]()
    if simulator is not None and has_landscape(tuning):
        try:
            landscape = simulate_landscape(tuning, best["parameters"], out, simulator, watch)
        except SpecError as error:
            notes = (
                f"There is no landscape behind the paths, because some of it cannot be walked: {error}",
            )
    watch.progress(Progress(0.0, what="plots"))
    return tuple(write_figures(tuning_figures_of(tuning, history, landscape), out / "plots")), notes
