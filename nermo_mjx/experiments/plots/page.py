"""What all pictures of the experiments share: colours by meaning, a page with title, legend and note, and marks.

One colour has one meaning throughout; each set of colours differs in lightness too, for the colour-blind and in print.
The profile `exact` is drawn in full colour, `as_published` lighter, and what the publication reports in black outline.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import jax.numpy as jnp
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from nermo_mjx.experiments.line import Line
from nermo_mjx.rollout.attitude import attitude
from nermo_mjx.view.recording import Recording

SPINE: Final = {False: "#23648f", True: "#e4572e"}
COMPENSATED: Final = "#7f2009"
STRATEGY: Final = {"leg": "#2a9d8f", "spine": "#5e3c99", "mix": "#e0a82c"}
FOOT: Final = {"front_left": "#332288", "front_right": "#6bb3d6", "rear_left": "#882255", "rear_right": "#cdb44f"}
INK, MUTED, GRID, SHADE = "#222222", "#555555", "#e6e6e6", "#f1f1f1"
GAIT: Final = {"trt": "trot", "trt1": "walking trot", "lat": "lateral walk"}
CLOCK: Final = "times and speeds are those of the controller's clock"
ANGLES: Final = ("roll", "pitch", "yaw")
#: Inches around a page, between its lines of text, and of a line of text.
_EDGE, _GAP, _LINE = 0.1, 0.08, 0.15
#: Mean width of a character of the note [inch].
_CHARACTER = 0.059
Published = float | tuple[float, float] | None


class Page:
    """A figure with a title above its axes, and a legend and a note below."""

    def __init__(self, title: str, size: tuple[float, float], rows: int = 1, columns: int = 1, **subplots) -> None:
        self.figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(self.figure)
        self.axes: np.ndarray = self.figure.subplots(rows, columns, squeeze=False, **subplots)
        self._width, self._height = size
        self.figure.text(self._across(_EDGE), 1 - self._up(_EDGE), title, va="top", fontsize=11.5, fontweight="bold")
        for ax in self.axes.ravel():
            ax.set_axisbelow(True)

    def finish(self, handles: Sequence[Artist], note: str) -> Figure:
        """Add the legend, in as few rows as fit, and the note; the axes keep the rest of the page."""
        lines = textwrap.wrap(note, int((self._width - 2 * _EDGE) / _CHARACTER))
        left, bottom = self._across(_EDGE), self._up(_EDGE)
        self.figure.text(left, bottom, "\n".join(lines), va="bottom", fontsize=8, color=MUTED, linespacing=1.2)
        below = _EDGE + _LINE * len(lines) + _GAP
        if handles:
            below += self._legend(handles, below) + _GAP
        above = _EDGE + 0.28
        engine = self.figure.get_layout_engine()
        engine.set(rect=(0, self._up(below), 1, 1 - self._up(below + above)), hspace=0.05, wspace=0.05)  # type: ignore[union-attr, call-arg]
        return self.figure

    def _legend(self, handles: Sequence[Artist], below: float) -> float:
        """The legend in the fewest rows that fit the page; its height [inch]."""
        for rows in range(1, len(handles) + 1):
            columns = -(-len(handles) // rows)
            legend = self.figure.legend(
                handles=_by_rows(handles, columns), ncols=columns, fontsize=8.5, columnspacing=1.4, handlelength=1.7,
                loc="lower left", bbox_to_anchor=(self._across(_EDGE), self._up(below)), borderaxespad=0, borderpad=0.2,
            )  # fmt: skip
            box = legend.get_window_extent(self.figure.canvas.get_renderer())  # type: ignore[attr-defined]
            if box.width / self.figure.dpi <= self._width - 2 * _EDGE or columns == 1:
                return box.height / self.figure.dpi
            legend.remove()
        raise AssertionError("one column is always taken")

    def _across(self, inches: float) -> float:
        return inches / self._width

    def _up(self, inches: float) -> float:
        return inches / self._height


def _by_rows(handles: Sequence[Artist], columns: int) -> list[Artist]:
    """Matplotlib fills a legend column by column; in this order, it reads row by row."""
    return [handle for first in range(columns) for handle in handles[first::columns]]


def published(lines: Iterable[Line], figure: str) -> Published:
    """The publication's number or interval for a figure of the report; None where the lines do not have it."""
    for line in lines:
        if line.figure == figure and not isinstance(line.published, (bool, str)):
            return line.published
    return None


def light(colour: str) -> str:
    """The colour as the profile `as_published` has it: on its way to white."""
    red, green, blue = (0.42 * part + 0.58 for part in to_rgb(colour))
    return to_hex((red, green, blue))


def tone(colour: str, profile: str) -> str:
    """The colour in a profile."""
    return light(colour) if profile == "as_published" else colour


def profiles(values: Iterable[str]) -> list[str]:
    """The profiles among these, `exact` first."""
    return sorted(set(map(str, values)), key=("exact", "as_published").index)


def shown(profile: str) -> str:
    """A profile's name for a reader."""
    return profile.replace("_", " ")


def swatch(name: str, colour: str, **patch) -> Patch:
    """A legend's entry for a filled area."""
    return Patch(facecolor=colour, label=name, **patch)


def stroke(name: str, colour: str, **line) -> Line2D:
    """A legend's entry for a line."""
    return Line2D([], [], color=colour, label=name, **line)


def spine_strokes(**line) -> list[Artist]:
    """Legend entries for lines without and with the spine."""
    return [stroke(f"{'with' if on else 'without'} spine", SPINE[on], **({"lw": 1.7} | line)) for on in (False, True)]


def spine_swatches() -> list[Artist]:
    """Legend entries for bars without and with the spine."""
    return [swatch(f"{'with' if on else 'without'} spine", SPINE[on]) for on in (False, True)]


def profile_swatches(names: Sequence[str]) -> list[Artist]:
    """Legend entries that tell the profiles apart, where there are several."""
    return [swatch(shown(name), tone("#444444", name)) for name in names] if len(names) > 1 else []


def mark_published(ax: Axes, x: float, value: Published, *, size: float = 34) -> None:
    """The publication's number as a white diamond in black outline; an interval as a bracket around it."""
    if value is None:
        return
    low, high = value if isinstance(value, tuple) else (value, value)
    if high > low:
        ax.errorbar(
            x, (low + high) / 2, (high - low) / 2, fmt="none", ecolor="black", elinewidth=1.1, capsize=3, zorder=6
        )
    ax.scatter(x, (low + high) / 2, s=size, marker="D", fc="white", ec="black", lw=1.2, zorder=7, gid="published")


def published_entry(name: str = "published") -> Line2D:
    """The legend's entry of `mark_published`."""
    return Line2D([], [], ls="none", marker="D", ms=5.5, mfc="white", mec="black", mew=1.2, label=name)


def shade_phases(ax: Axes, phases: Mapping[str, Sequence[float]], *, named: bool = True) -> None:
    """Every other phase on a shade of grey, each with its name above the axes."""
    for i, (name, (begin, end)) in enumerate(phases.items()):
        if i % 2 == 0:
            ax.axvspan(begin, end, color=SHADE, lw=0, zorder=-5)
        if named:
            ax.text((begin + end) / 2, 1.01, name, transform=ax.get_xaxis_transform(), ha="center", va="bottom",
                    fontsize=7.5, color=MUTED)  # fmt: skip
    ends = [time for phase in phases.values() for time in phase]
    ax.set_xlim(min(ends), max(ends))


def horizontal_grid(ax: Axes) -> None:
    """Faint lines to read values by, and a line at zero where values have both signs."""
    ax.grid(axis="y", color=GRID, lw=0.8)
    low, high = ax.get_ylim()
    if low < 0 < high:
        ax.axhline(0, color=MUTED, lw=0.8, zorder=1)


def angles(recording: Recording) -> np.ndarray:
    """Roll, pitch and yaw of the torso over time, (T, 3) [deg]; the yaw does not jump."""
    found = np.array(attitude(jnp.asarray(recording.sensors["orientation"])), float)
    found[:, 2] = np.unwrap(found[:, 2])
    return np.degrees(found)


def seen_from_above(ax: Axes, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(right, ahead) [mm] of places (..., 2) [m] in the robot's frame at the start (x left, y back); equal axes."""
    ax.set_aspect("equal")
    ax.set(xlabel="to the right of the start [mm]", ylabel="ahead of the start [mm]")
    return -1e3 * places[..., 0], -1e3 * places[..., 1]
