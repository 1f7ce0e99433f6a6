"""Figures of a landscape: the objective along each parameter with its exact tangents, and its slope beside secants."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.page import page
from nermo_mjx.plotting.shown import ShownValues, shown
from nermo_mjx.plotting.style import BAND, BEST, INK, LINE, MUTED, horizontal_grid, set_scales
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.tune.landscape.lines import Slice, lines_of
from nermo_mjx.tune.landscape.points import TABLE, TUNING, read
from nermo_mjx.tune.spec import Tuned, Tuning

#: From narrow secants to wide ones.
_SECANTS: Final = ("#fcae12", "#e55c30", "#ba3655", "#781c6d", "#230c4c")  # of the even colour map inferno
#: Length of a tangent, in distances of two points.
_TANGENT: Final = 0.8
#: Slopes further from the middle than this multiple of the exact ones' spread are cut off.
_CUT: Final = 2.5


def figures_of(tuning: Tuning, lines: Sequence[Slice]) -> Iterator[tuple[str, Figure]]:
    """A figure for each line; one on which the robot nowhere walks has none."""
    for line in lines:
        if line.ok.any():
            yield f"line-{line.tuned.name}", line_figure(tuning, line)


def figures(out: Path) -> Figures:
    """The figures of a landscape's directory, from its table.

    Raises:
        SpecError: its landscape.yaml cannot be read.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    tuning, table = Tuning.from_file(out / TUNING, recorded=False), read(out / TABLE)
    if table is None or not set(tuning.names) <= set(table.column_names):
        raise DirectoryError(f"{out / TABLE} is missing, or another landscape's: run nermo-mjx landscape again.")
    return figures_of(tuning, lines_of(tuning, table))


def line_figure(tuning: Tuning, line: Slice) -> Figure:
    """One line: the objective with a tangent at each point; below it the slope, and each secant over its width."""
    others = [f"{each.name} {_text(tuning, each)}" for each in tuning.tuned if each is not line.tuned]
    note = "above: objective with its exact tangents, star: lowest; below: exact slope, and secants over their width"
    note += "; dashed: the given start" + (f"; there, and here, {', '.join(others)}" if others else "")
    x = _about(tuning, line.tuned.name, line.x)
    figure = page(f"Objective and slope along {line.tuned.name}", 7.4, 5.6, note)
    above, below = figure.subplots(2, 1, sharex=True)
    _draw_objective(above, line, x)
    _draw_slopes(below, line, x)
    for ax in (above, below):
        horizontal_grid(ax)
        ax.axvline(_about(tuning, line.tuned.name, np.array([line.tuned.start])).values[0], color=MUTED, lw=0.9,
                   ls=(0, (4, 3)), zorder=1)  # fmt: skip
    set_scales(below, x)
    above.set_ylabel("objective [1]")
    below.set(xlabel=x.label, ylabel=f"slope [1/{x.unit}]" if x.unit else "slope [1]")
    return figure


def _text(tuning: Tuning, tuned: Tuned) -> str:
    quantity = _about(tuning, tuned.name, np.array(tuned.start))
    return quantity.shown(float(quantity.values))


def _about(tuning: Tuning, name: str, values: np.ndarray) -> ShownValues:
    return shown(name, tuning.parameters[name].unit, values)


def _draw_objective(ax: Axes, line: Slice, x: ShownValues) -> None:
    """Points with tangents, their lowest a star, and a cross where the robot fell."""
    per_shown = np.ptp(line.x) / np.ptp(x.values)
    half = 0.5 * _TANGENT * np.ptp(x.values) / (len(line.x) - 1)
    rise = half * line.slope * per_shown
    ax.plot(x.values, line.value, color=BAND, lw=1.0, zorder=2)
    ax.plot(np.stack([x.values - half, x.values + half]), np.stack([line.value - rise, line.value + rise]),
            color=LINE, lw=1.5, zorder=3, solid_capstyle="butt")  # fmt: skip
    ax.plot(x.values, line.value, "o", ms=2.8, color=LINE, mec="white", mew=0.4, zorder=4)
    at = int(np.nanargmin(line.value))
    ax.scatter(x.values[at], line.value[at], s=130, marker="*", fc=BEST, ec="white", zorder=5, clip_on=False)
    # The axis is the values', however steep a tangent is.
    low, high = float(np.nanmin(line.value)), float(np.nanmax(line.value))
    room = 0.08 * (high - low) or 0.01 * max(abs(low), 1e-6)
    ax.set_ylim(low - room, high + room)
    fell = x.values[~line.ok]
    if len(fell):
        ax.plot(fell, np.full(len(fell), 0.97), "x", transform=ax.get_xaxis_transform(), color=INK, ms=5,
                mew=1.3, label="fell")  # fmt: skip
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)


def _draw_slopes(ax: Axes, line: Slice, x: ShownValues) -> None:
    """Exact slopes as a line, each secant as a bar over its width."""
    per_shown = np.ptp(line.x) / np.ptp(x.values)
    slope = line.slope * per_shown
    ax.plot(x.values, slope, "-o", color=LINE, lw=1.4, ms=2.8, mec="white", mew=0.4, zorder=2, label="exact slope")
    drawn = []
    for i, (secants, colour) in enumerate(zip(line.secants, _SECANTS, strict=True)):
        centre, value, half = secants.centre / per_shown, secants.secant * per_shown, 0.5 * secants.width / per_shown
        # The narrow ones lie on top, smaller, so that those that agree are all seen.
        ax.hlines(value, centre - half, centre + half, color=colour, lw=2.0, zorder=4 - 0.1 * i)
        ax.plot(centre, value, "D", ms=3.0 + 1.1 * i, color=colour, mec="white", mew=0.4, zorder=5 - 0.1 * i,
                label=f"secants of {100 * secants.share:g} %")  # fmt: skip
        drawn.append(value)
    ax.axhline(0.0, color=MUTED, lw=0.8, zorder=1)
    _cut(ax, slope[np.isfinite(slope)], np.concatenate(drawn))
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)


def _cut(ax: Axes, slope: np.ndarray, secants: np.ndarray) -> None:
    """Leave out what lies so far off that the slope could not be seen, and say how much that is."""
    low, high = np.quantile(slope, [0.02, 0.98])
    room = _CUT * max(high - low, 1e-9 + 1e-3 * abs(low))
    everything = np.concatenate([slope, secants])
    inside = everything[(everything >= low - room) & (everything <= high + room)]
    margin = 0.06 * (np.ptp(inside) or 1.0)
    ax.set_ylim(min(inside.min(), 0.0) - margin, max(inside.max(), 0.0) + margin)
    outside = len(everything) - len(inside)
    if outside:
        ax.annotate(f"{outside} outside", (1, 1.0), xycoords="axes fraction", ha="right", va="bottom", fontsize=8,
                    color=MUTED)  # fmt: skip
