"""The path of each start over one or two parameters, drawn on the objective's landscape if available."""

from __future__ import annotations

import itertools
import math
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from nermo_mjx.plotting.page import page
from nermo_mjx.plotting.shown import ShownValues
from nermo_mjx.plotting.style import BEST, COLOURS, GRID, INK, MISSING, MUTED, horizontal_grid, set_scales
from nermo_mjx.tune.background import Background
from nermo_mjx.tune.figures import start_styles
from nermo_mjx.tune.traces import Traces

#: Lower is better, and brighter.
_COLOURS: Final = f"{COLOURS}_r"
_LEVELS: Final = 18
#: Share of the landscape's points covered by the colours; including the highest would reduce the contrast.
_COVERED: Final = 0.97
_LABEL: Final = "objective, lower is better [1]"


def path_figure(traces: Traces, background: Background | None = None) -> Figure:
    """The paths over the first two tuned parameters, or of a single one its objective."""
    return _plane(traces, background) if len(traces.tuning.tuned) > 1 else _line(traces, background)


def _plane(traces: Traces, background: Background | None) -> Figure:
    x, y = traces.tuning.tuned[:2]
    note = f"ring: start; dot: end; star: best; {_beneath(traces, background) or 'colour: objective'}"
    figure = page(f"Path over {x.name} and {y.name}", 6.9, 5.4, note)
    ax = figure.subplots()
    ax.set_facecolor("white" if background is None else MISSING)
    ends = [np.array([traces.in_shown_unit(each.name, end) for end in (each.low, each.high)]) for each in (x, y)]
    if background is not None:
        _draw_background(figure, ax, traces, background)
    else:
        _draw_values(figure, ax, traces)
    spans = [float(np.ptp(pair)) for pair in ends]
    paths = [traces.in_shown_unit(each.name, traces.unwrapped(each)) for each in (x, y)]
    for start in traces.drawn():
        path, copies = [path[:, start] for path in paths], _copies(traces, paths, ends, start)
        if background is None:
            _draw_thin(ax, path, copies, spans)
        else:
            _draw_path(ax, path, copies, spans, leading=start == traces.best[1])
    best = [float(traces.in_shown_unit(each.name, traces.column(each.name)[traces.best])) for each in (x, y)]
    ax.scatter(best[0], best[1], s=230, marker="*", fc=BEST, ec="white", lw=1.2, zorder=8, clip_on=False)
    quantities = [ShownValues(each.name, traces.quantity(each.name).unit, pair)
                  for each, pair in zip((x, y), ends, strict=True)]  # fmt: skip
    set_scales(ax, *quantities)
    ax.set(xlabel=quantities[0].label, ylabel=quantities[1].label, xlim=ends[0], ylim=ends[1])
    return figure


def _line(traces: Traces, background: Background | None) -> Figure:
    """The objective over the only parameter: the landscape as a line, and the points that each start visited."""
    (each,) = traces.tuning.tuned
    parts = ("dots: evaluations, larger towards the end; star: best", _beneath(traces, background))
    note = "; ".join(filter(None, parts))
    figure = page(f"Objective over {each.name} (lower is better)", 7.2, 4.0, note)
    ax = figure.subplots()
    if background is not None:
        nodes = traces.in_shown_unit(each.name, background.axes[each.name])
        ax.plot(nodes, background.value, color=MUTED, lw=1.4, zorder=1)
    place, value = traces.in_shown_unit(each.name, traces.column(each.name)), traces.column("objective")
    for start, style in start_styles(traces).items():
        ax.scatter(place[:, start], value[:, start], s=np.linspace(8, 40, len(place)), color=style["color"],
                   ec="white", lw=0.4, zorder=style["zorder"], label=style["label"])  # fmt: skip
    ax.scatter(place[traces.best], value[traces.best], s=150, marker="*", fc=BEST, ec="white", zorder=8)
    quantity = ShownValues(each.name, traces.quantity(each.name).unit,
                        traces.in_shown_unit(each.name, np.array([each.low, each.high])))  # fmt: skip
    set_scales(ax, quantity)
    ax.set(xlabel=quantity.label, ylabel="objective [1]", xlim=quantity.values)
    horizontal_grid(ax)
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        ax.legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)
    return figure


def _beneath(traces: Traces, background: Background | None) -> str:
    """What the landscape is; nothing without one."""
    if background is None:
        return ""
    text = f"landscape: {background.walks}"
    rest = len(traces.tuning.tuned) - len(background.axes)
    return text + (", the other parameters as in the best point" if rest else "")


def _draw_background(figure: Figure, ax: Axes, traces: Traces, background: Background) -> None:
    """Filled contours; where the robot did not walk to the end, grey hatching shows through."""
    ax.add_patch(Rectangle((0, 0), 1, 1, transform=ax.transAxes, fc=MISSING, ec="white", hatch="////", lw=0, zorder=0))
    good = background.value[np.isfinite(background.value)]
    if not len(good):
        return
    low, high = float(good.min()), float(np.quantile(good, _COVERED))
    high = high if high > low else low + max(1e-9, 1e-6 * abs(low))
    x, y = (traces.in_shown_unit(name, nodes) for name, nodes in background.axes.items())
    cut = "max" if good.max() > high else "neither"
    # The outermost points stand a little inside of the bounds, and their colours reach there.
    x[[0, -1]], y[[0, -1]] = (_ends(traces, name) for name in background.axes)
    shown = np.ma.masked_invalid(background.value.T)
    # The lines are denser towards the best point, and evenly spaced if the objective is a parabola.
    levels = low + (high - low) * np.linspace(0.0, 1.0, _LEVELS + 1) ** 2
    scale = PowerNorm(0.5, low, high)
    ax.contourf(x, y, shown, levels, cmap=_COLOURS, norm=scale, extend=cut, zorder=1)
    ax.contour(x, y, shown, levels[::2], colors="white", linewidths=0.5, linestyles="solid", alpha=0.45, zorder=2)
    bar = figure.colorbar(ScalarMappable(scale, _COLOURS), ax=ax, aspect=28, pad=0.02, extend=cut, extendfrac=0.03)
    bar.set_label(_LABEL)
    bar.outline.set_visible(False)


def _ends(traces: Traces, name: str) -> np.ndarray:
    tuned = next(each for each in traces.tuning.tuned if each.name == name)
    return traces.in_shown_unit(name, np.array([tuned.low, tuned.high]))


def _draw_values(figure: Figure, ax: Axes, traces: Traces) -> None:
    """Without a landscape, each visited point has the colour of its objective."""
    x, y = (traces.in_shown_unit(each.name, traces.column(each.name)) for each in traces.tuning.tuned[:2])
    value = traces.column("objective")
    drawn, good = traces.drawn(), value[np.isfinite(value)]
    low, high = float(good.min()), float(np.quantile(good, _COVERED))
    points = ax.scatter(x[:, drawn], y[:, drawn], c=value[:, drawn], s=22, cmap=_COLOURS, lw=0, zorder=5,
                        norm=Normalize(low, high if high > low else low + 1e-9))  # fmt: skip
    bar = figure.colorbar(points, ax=ax, aspect=28, pad=0.02)
    bar.set_label(_LABEL)
    bar.outline.set_visible(False)
    ax.grid(color=GRID, lw=0.8)
    ax.set_axisbelow(True)


def _copies(traces: Traces, paths: list[np.ndarray], ends: list[np.ndarray], start: int) -> list[tuple[int, ...]]:
    """Whole turns by which a path is shifted so that all its pieces lie within the bounds."""
    turns = []
    for tuned, path, (low, high) in zip(traces.tuning.tuned, paths, ends, strict=False):
        own = path[:, start]
        first, last = ((math.floor((end - low) / (high - low)) for end in (own.min(), own.max()))
                       if tuned.periodic else (0, 0))  # fmt: skip
        turns.append(range(first, last + 1))
    return list(itertools.product(*turns))


def _draw_path(
    ax: Axes, path: list[np.ndarray], copies: list[tuple[int, ...]], spans: list[float], *, leading: bool
) -> None:
    """One start's path, from a ring to a dot; a path across a periodic bound continues at the other side."""
    width, layer = (1.6, 5) if leading else (0.9, 4)
    halo: list[Any] = [withStroke(linewidth=width + 1.5, foreground=INK)]
    for turn in copies:
        x, y = (values - k * span for values, k, span in zip(path, turn, spans, strict=True))
        ax.plot(x, y, color="white", lw=width, path_effects=halo, zorder=layer, solid_capstyle="round")
        if leading:
            ax.plot(x[1:-1], y[1:-1], ls="none", marker="o", ms=2.2, color=INK, zorder=layer)
        ax.plot(x[:1], y[:1], ls="none", marker="o", ms=7, mfc="none", mec=INK, mew=3.2, zorder=6)
        ax.plot(x[:1], y[:1], ls="none", marker="o", ms=7, mfc="none", mec="white", mew=1.5, zorder=6)
        ax.plot(x[-1:], y[-1:], ls="none", marker="o", ms=6, mfc="white", mec=INK, mew=1.1, zorder=6)


def _draw_thin(ax: Axes, path: list[np.ndarray], copies: list[tuple[int, ...]], spans: list[float]) -> None:
    """One start's path as a thin line, so that its points carry the colour."""
    for turn in copies:
        x, y = (values - k * span for values, k, span in zip(path, turn, spans, strict=True))
        ax.plot(x, y, color=MUTED, lw=0.8, zorder=4)
        ax.plot(x[:1], y[:1], ls="none", marker="o", ms=8, mfc="none", mec=INK, mew=1.2, zorder=6)
        ax.plot(x[-1:], y[-1:], ls="none", marker="o", ms=5, mfc="white", mec=INK, mew=1.1, zorder=6)
