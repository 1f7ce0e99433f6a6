"""The ensemble in one figure: the distribution of each parameter within its bounds, and correlations of pairs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullLocator

from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import BAND, BEST, COLOURS, INK, LINE, MUTED, SMALL
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import quantities

_BINS: Final = 12
_PANEL: Final = 1.42
#: Labels of parameters that share a value.
_SHORT: Final = {"damping.knee": "damping of\nknee, ankle"}


def ensemble_figure(content: Mapping[str, Any]) -> Figure:
    """Marginals on the diagonal, pairs below it; axes are the bounds, logarithmic.

    Args:
        content: `ensemble` of identification.json, with bodies.
    """
    names, bodies = list(content["parameters"]), content["bodies"]
    values = [np.asarray(bodies[name], float) for name in names]
    bounds = [(content["parameters"][name]["low"], content["parameters"][name]["high"]) for name in names]
    objective, weights = np.asarray(bodies["objective"], float), np.asarray(bodies["weight"], float)
    n, shades = len(names), Normalize(objective.min(), content["tolerance"])
    page = Page("Bodies that walk as published within the tolerance", (_PANEL * n + 0.9, _PANEL * n + 0.9), n, n)
    for i, name in enumerate(names):
        for j in range(n):
            ax: Axes = page.axes[i, j]
            if j > i:
                ax.set_axis_off()
            elif j == i:
                _marginal(ax, values[i], weights, bounds[i], content["parameters"][name]["quantiles"])
            else:
                order = np.argsort(-objective, kind="stable")  # the best on top
                ax.scatter(values[j][order], values[i][order], c=objective[order], s=7, lw=0, cmap=COLOURS, norm=shades)
                ax.plot(values[j][0], values[i][0], marker="+", ms=9, mew=1.6, color=BEST)
                _scale(ax, bounds[i], "y")
            _scale(ax, bounds[j], "x")
            _label(ax, names, i, j)
    page.figure.align_labels()
    place = page.axes[0, -1].inset_axes((-2.2, 0.6, 3.0, 0.13))  # in the empty corner, and ignored by the layout
    place.set_in_layout(False)
    bar = page.figure.colorbar(ScalarMappable(shades, COLOURS), cax=place, orientation="horizontal")
    bar.set_label("objective [1]", fontsize=SMALL)
    bar.outline.set_visible(False)
    handles = [
        Patch(color=BAND, label="share of the bodies"), Line2D([], [], color=LINE, ls="--", lw=1, label="5 and 95 %"),
        Line2D([], [], color=MUTED, lw=1, label="share in the prior"),
        Line2D([], [], color=BEST, marker="+", ms=9, mew=1.6, lw=1.6, label="default body"),
    ]  # fmt: skip
    return page.finish(handles, f"{content['size']} bodies; an axis spans a parameter's bounds.")


def _marginal(
    ax: Axes, values: np.ndarray, weights: np.ndarray, bounds: tuple[float, float], quantiles: list[float]
) -> None:
    edges = np.geomspace(*bounds, _BINS + 1)
    shares, _ = np.histogram(np.clip(values, *bounds), edges, weights=weights)
    ax.stairs(shares, edges, fill=True, color=BAND)
    ax.axhline(1 / _BINS, color=MUTED, lw=0.9)
    for each in (quantiles[0], quantiles[-1]):
        ax.axvline(each, color=LINE, ls="--", lw=1)
    ax.axvline(values[0], color=BEST, lw=1.6)
    ax.set_ylim(0, 1.12 * max(shares.max(), 1 / _BINS))
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)


def _scale(ax: Axes, bounds: tuple[float, float], axis: str) -> None:
    """A logarithmic axis over the bounds, with ticks at the bounds and a round value in between."""
    low, high = bounds
    middle = float(f"{np.sqrt(low * high):.{1 if high > 2 * low else 2}g}")
    along = ax.xaxis if axis == "x" else ax.yaxis
    (ax.set_xscale if axis == "x" else ax.set_yscale)("log")
    (ax.set_xlim if axis == "x" else ax.set_ylim)(low, high)
    along.set_major_locator(FixedLocator([low, middle, high]))
    along.set_major_formatter(FormatStrFormatter("%g"))
    along.set_minor_locator(NullLocator())


def _label(ax: Axes, names: list[str], i: int, j: int) -> None:
    """Names at the left and at the bottom only."""
    units = {name: about.unit for name, about in quantities(ModelParameters)}

    def text(name: str) -> str:
        return "\n".join((_SHORT.get(name, name.replace(".", "\n", 1)), f"[{units.get(name, '1')}]"))

    ax.tick_params(labelsize=SMALL - 1, labelbottom=i == len(names) - 1, labelleft=j == 0 and i > 0)
    if i == len(names) - 1:
        ax.set_xlabel(text(names[j]), fontsize=SMALL, color=INK)
        ax.tick_params(axis="x", rotation=45)
    if j == 0 and i > 0:
        ax.set_ylabel(text(names[i]), fontsize=SMALL, color=INK)
