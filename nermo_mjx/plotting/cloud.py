"""Many points in one panel: dots as long as they can be distinguished, their density beyond."""

from __future__ import annotations

from typing import Final

from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap

from nermo_mjx.plotting.shown import ShownValues
from nermo_mjx.plotting.style import BAND, light

#: Number of points in a panel above which dots would overlap.
CROWD: Final = 5000
_CELLS: Final = 44
#: Lighter than lines drawn over it.
_DENSITY: Final = LinearSegmentedColormap.from_list("density", [light(BAND), BAND, "#5aa5d6"])


def remark(count: int) -> str:
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
