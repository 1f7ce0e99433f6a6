"""Figures of a tuning over its iterations: objective and metrics, parameters, gradients."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nermo_mjx.plotting.page import page
from nermo_mjx.plotting.shown import ShownValues
from nermo_mjx.plotting.style import BAND, BEST, INK, LINE, MISSING, MUTED, SERIES, horizontal_grid, set_scales
from nermo_mjx.tune.objective import TRAJECTORY_ERROR, Term
from nermo_mjx.tune.sections import Tuned
from nermo_mjx.tune.traces import Traces

#: Colours of single starts; with more starts, only the best one has its own.
START_COLOURS: Final = SERIES
#: Panels of one figure.
MOST_PANELS: Final = 12
_WIDTH, _PANEL, _MARGINS = 7.2, 1.75, 0.85
#: A path shorter than this fraction of its bounds is shown enlarged.
_ZOOM: Final = 0.2


def objective_figure(traces: Traces) -> Figure:
    """The objective of each start with the best so far, and below it each metric that the objective reads."""
    terms = {term.metric: term for term in traces.tuning.objective.terms if term.metric != TRAJECTORY_ERROR}
    iteration, start = traces.best
    best = traces.column("objective")[iteration, start]
    where = f" of start {start}" if traces.starts > 1 else ""
    note = f"{_what(traces)}; dashed: best so far; star: best, {best:.4g} in iteration {iteration}{where}"
    figure = page("Objective over the iterations (lower is better)", _WIDTH, 2.9 + _PANEL * len(terms), note)
    axes = _column(figure, 1 + len(terms))
    value = traces.column("objective")
    _draw_starts(axes[0], traces, value)
    # Where no start has walked to the end yet there is no best.
    lowest = np.minimum.accumulate(np.where(np.isfinite(value), value, np.inf).min(axis=1))
    lowest[np.isinf(lowest)] = np.nan
    axes[0].step(traces.iterations, lowest, where="post", color=INK, lw=1.1, ls=(0, (4, 2)))
    axes[0].set_ylabel("objective [1]")
    _cut(axes[0], value)
    _mark_falls(axes[0], traces)
    for ax, (metric, term) in zip(axes[1:], terms.items(), strict=True):
        quantity = traces.quantity(metric)
        _draw_starts(ax, traces, quantity.values)
        _draw_aim(ax, traces, term)
        ax.set_ylabel(quantity.label)
    _star(axes[0], traces, value)
    for ax, metric in zip(axes[1:], terms, strict=True):
        _star(ax, traces, traces.quantity(metric).values)
    _finish(axes, traces)
    return figure


def parameters_figure(traces: Traces) -> Figure:
    """Each parameter over the iterations, in its unit, with its bounds; a periodic one continues beyond them."""
    tuned = traces.tuning.tuned[:MOST_PANELS]
    left_out = len(traces.tuning.tuned) - len(tuned)
    note = f"{_what(traces)}; dashed: bounds, or where a periodic parameter wraps around; star: best"
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
        _star(ax, traces, values)
        ax.set_ylabel(traces.quantity(each.name).label.replace(" [", "\n["))  # long names are longer than a panel
    for ax in axes[max(0, len(tuned) - columns) : len(tuned)]:
        ax.tick_params(labelbottom=True)
    _finish(axes[: len(tuned)], traces, columns)
    return figure


def gradients_figure(traces: Traces) -> Figure:
    """Norm of the gradient; below it the standard error and the first order's share, where there are such."""
    estimator = traces.tuning.estimator
    norm, error = traces.gradient_norm()
    discarded = int(traces.column("discarded").sum())
    note = f"{_what(traces)}; estimator {estimator.name}"
    note += f" of {estimator.samples} samples" if estimator.samples else ""
    note += ", each of length 1" if estimator.normalized else ""
    note += "; each component counts per whole range of its parameter"
    note += f"; {discarded:,} worlds were left out" if discarded else ""
    count = 1 + (error is not None) + (estimator.name == "mixture")
    figure = page("Gradient over the iterations", _WIDTH, _MARGINS + 2.3 + _PANEL * (count - 1), note)
    axes = _column(figure, count)
    _draw_starts(axes[0], traces, norm)
    axes[0].set_ylabel("norm of the gradient [1]")
    if np.isfinite(norm).any():
        axes[0].set_yscale("log")
        axes[0].set_ylim(0.5 * np.nanmin(norm), 2.0 * np.nanmax(norm))
    if error is not None:
        noise = error / norm
        known = noise[np.isfinite(noise)]
        _draw_starts(axes[1], traces, noise)
        axes[1].axhline(1.0, color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=1)
        highest = float(known.max()) if len(known) else 1.0
        axes[1].set(ylabel="standard error / norm [1]", ylim=(0, min(2.5, max(1.1, 1.05 * highest))))
        axes[1].annotate("above 1: noise alone", (1, 1.01), xycoords="axes fraction", ha="right", va="bottom",
                         fontsize=8, color=MUTED)  # fmt: skip
    if estimator.name == "mixture":
        _draw_shares(axes[-1], traces)
    _finish(axes, traces)
    return figure


def start_styles(traces: Traces) -> Mapping[int, dict[str, Any]]:
    """Line style of each drawn start, by its number; a few have their own colour and legend entry."""
    best, drawn = traces.best[1], traces.drawn()
    if len(drawn) <= len(START_COLOURS):
        names = {start: f"start {start}" + (" (given)" if start == 0 else "") for start in drawn}
        return {start: {"color": colour, "lw": 1.6, "zorder": 4 if start == best else 3,
                        "label": names[start] if len(drawn) > 1 else None}
                for start, colour in zip(drawn, START_COLOURS, strict=False)}  # fmt: skip
    styles = {start: {"color": BAND, "lw": 0.9, "alpha": 0.8, "zorder": 2, "label": None} for start in drawn}
    styles[drawn[-1]]["label"] = "other starts"
    styles[0] |= {"color": START_COLOURS[1], "lw": 1.4, "alpha": 1.0, "zorder": 3, "label": "start 0 (given)"}
    styles[best] |= {"color": LINE, "lw": 1.8, "alpha": 1.0, "zorder": 4, "label": f"start {best} (best)"}
    return styles


def _column(figure: Figure, count: int) -> list[Axes]:
    """Panels below one another, the first one a little higher."""
    return list(figure.subplots(count, 1, sharex=True, squeeze=False, height_ratios=[1.3] + [1] * (count - 1))[:, 0])


def _what(traces: Traces) -> str:
    if not traces.tuning.method.has_gradient:
        return f"{len(traces.iterations)} generations of {traces.tuning.method.population} points, the best of each"
    starts, drawn = traces.starts, len(traces.drawn())
    some = f" ({drawn} of them drawn)" if drawn < starts else ""
    return f"{len(traces.iterations)} evaluations" + (f" of {starts:,} starts{some}" if starts > 1 else "")


def _draw_starts(ax: Axes, traces: Traces, values: np.ndarray) -> None:
    """A line for each start; `values` are (n, starts)."""
    marker: dict[str, Any] = (
        {"marker": "o", "ms": 3.0, "mec": "white", "mew": 0.4} if len(traces.iterations) <= 60 else {}
    )
    for start, style in start_styles(traces).items():
        own = marker if style["lw"] > 1 else {}
        ax.plot(traces.iterations, values[:, start], **style, **own)


def _star(ax: Axes, traces: Traces, values: np.ndarray) -> None:
    """A star at the best evaluation."""
    ax.scatter(traces.best[0], values[traces.best], s=150, marker="*", fc=BEST, ec="white", lw=0.9, zorder=6,
               clip_on=False)  # fmt: skip


def _mark_falls(ax: Axes, traces: Traces) -> None:
    """A cross at the top of the axes for each evaluation that did not walk to the end."""
    label: str | None = "fell"
    for start, style in start_styles(traces).items():
        fell = traces.iterations[~traces.ok[:, start]]
        if len(fell):
            ax.plot(fell, np.full(len(fell), 0.97), "x", transform=ax.get_xaxis_transform(), color=style["color"],
                    ms=5, mew=1.4, clip_on=False, zorder=5, label=label)  # fmt: skip
            label = None


def _cut(ax: Axes, values: np.ndarray) -> None:
    """Cut off values so far above the rest that nothing else would be visible."""
    good = values[np.isfinite(values)]
    low, high = np.min(good), np.quantile(good, 0.9)
    top = max(high + 2.0 * (high - low), low + 1.05 * (np.nan_to_num(values[0, 0], nan=low) - low))
    if high > low and good.max() > top:
        ax.set_ylim(low - 0.05 * (top - low), top)
        ax.annotate(f"{int((good > top).sum())} higher", (1, 1), xycoords="axes fraction", ha="right", va="top",
                    fontsize=8, color=MUTED)  # fmt: skip


def _draw_shares(ax: Axes, traces: Traces) -> None:
    """Share of the first order in a mixture, a line a parameter."""
    styles = [(colour, ls) for ls in ("-", "--") for colour in START_COLOURS]
    for name, (colour, ls) in zip(traces.tuning.names, styles, strict=False):
        share = traces.column(f"first_order.{name}").mean(axis=1)
        ax.plot(traces.iterations, share, label=name, lw=1.4, color=colour, ls=ls)
    ax.set(ylabel="share of the first order [1]", ylim=(-0.04, 1.04))
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, title_fontsize=8,
              title="mean over the starts" if traces.starts > 1 else None)  # fmt: skip


def _draw_aim(ax: Axes, traces: Traces, term: Term) -> None:
    """The target of the term's metric: a line to hold, or a word."""
    target = traces.target(term)
    if target is not None:
        ax.axhline(target, color=MUTED, lw=1.0, ls="--", zorder=1)
    word = {"maximize": "more is better", "minimize": "less is better", "hold": "dashed: to be held"}[term.aim]
    ax.annotate(word, (1, 1.01), xycoords="axes fraction", ha="right", va="bottom", fontsize=8, color=MUTED)


def _draw_bounds(ax: Axes, traces: Traces, tuned: Tuned, values: np.ndarray) -> None:
    """The bounds, and the axis about them, or about the path where it is short."""
    low, high = (float(traces.in_shown_unit(tuned.name, bound)) for bound in (tuned.low, tuned.high))
    least, most, span = float(values.min()), float(values.max()), high - low
    text = f"{low:.4g} to {high:.4g}, {'periodic' if tuned.periodic else 'bounds'}"
    ax.annotate(text, (1, 1.01), xycoords="axes fraction", ha="right", va="bottom", fontsize=8, color=MUTED)
    if most - least < _ZOOM * span:
        room = max(0.6 * (most - least), 0.01 * span)
        ax.set_ylim(least - room, most + room)
    else:
        ax.set_ylim(min(low, least) - 0.06 * span, max(high, most) + 0.06 * span)
    first, last = ax.get_ylim()
    unit = traces.quantity(tuned.name).unit
    set_scales(
        ax, ShownValues("iteration", "", traces.iterations), ShownValues(tuned.name, unit, np.array([first, last]))
    )
    if tuned.periodic:
        turns = range(math.floor((first - low) / span), math.ceil((last - low) / span) + 1)
        bounds: Sequence[float] = [low + turn * span for turn in turns]
    else:
        bounds = (low, high)
        for begin, end in ((first, low), (high, last)):
            if begin < end:
                ax.axhspan(begin, end, color=MISSING, alpha=0.45, lw=0, zorder=0)
    for bound in bounds:
        if first <= bound <= last:
            ax.axhline(bound, color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=1)


def _finish(axes: Sequence[Axes], traces: Traces, columns: int = 1) -> None:
    """Grid, ticks at whole iterations, the label below the lowest panels, the legend beside the first row."""
    for ax in axes:
        horizontal_grid(ax)
        ax.xaxis.set_major_locator(MaxNLocator(8, integer=True, min_n_ticks=1))
        ax.set_xlim(-0.5, len(traces.iterations) - 0.5)
    for ax in axes[len(axes) - columns :]:
        ax.set_xlabel("iteration [1]")
    handles, labels = axes[0].get_legend_handles_labels()
    if handles:
        axes[columns - 1].legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)
