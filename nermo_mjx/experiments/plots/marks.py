"""Elements shared by the experiments' figures: colours by meaning, entries of legends, and marks.

One colour has one meaning throughout.
The profile `exact` is drawn in full colour, `as_published` lighter, and published values in black outline.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import jax.numpy as jnp
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from nermo_mjx.experiments.line import Line
from nermo_mjx.kinematics.attitude import attitude
from nermo_mjx.plotting.style import MUTED, OKABE_ITO, SHADE, light
from nermo_mjx.recording import Recording

SPINE: Final = {False: OKABE_ITO["blue"], True: OKABE_ITO["vermilion"]}
COMPENSATED: Final = OKABE_ITO["purple"]
STRATEGY: Final = {"leg": OKABE_ITO["green"], "spine": OKABE_ITO["purple"], "mix": OKABE_ITO["orange"]}
PASS, FAIL = "#c6dff0", "#f6cfb5"
GAIT: Final = {"trt": "trot", "trt1": "walking trot", "lat": "lateral walk"}
CLOCK: Final = "times and speeds are those of the controller's clock"
ANGLES: Final = ("roll", "pitch", "yaw")
Published = float | tuple[float, float] | None


def published(lines: Iterable[Line], figure: str) -> Published:
    """The publication's number or interval for a figure of the report; None if the lines do not have it."""
    for line in lines:
        if line.figure == figure and not isinstance(line.published, (bool, str)):
            return line.published
    return None


def tone(colour: str, profile: str) -> str:
    """The colour in a profile."""
    return light(colour) if profile == "as_published" else colour


def profiles(values: Iterable[str]) -> list[str]:
    """The profiles among these, `exact` first."""
    return sorted(set(map(str, values)), key=("exact", "as_published").index)


def shown(profile: str) -> str:
    """A profile's display name."""
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
    """Legend entries for the profiles, if there are several."""
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
    """Phases on alternating grey backgrounds, each with its name above the axes."""
    for i, (name, (begin, end)) in enumerate(phases.items()):
        if i % 2 == 0:
            ax.axvspan(begin, end, color=SHADE, lw=0, zorder=-5)
        if named:
            ax.text((begin + end) / 2, 1.01, name, transform=ax.get_xaxis_transform(), ha="center", va="bottom",
                    fontsize=7.5, color=MUTED)  # fmt: skip
    ends = [time for phase in phases.values() for time in phase]
    ax.set_xlim(min(ends), max(ends))


def angles(recording: Recording) -> np.ndarray:
    """Roll, pitch and yaw of the torso over time, (T, 3) [deg]; with unwrapped yaw."""
    found = np.array(attitude(jnp.asarray(recording.sensors["orientation"])), float)
    found[:, 2] = np.unwrap(found[:, 2])
    return np.degrees(found)


def seen_from_above(ax: Axes, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(right, ahead) [mm] of positions (..., 2) [m] in the robot's frame at the start (x left, y back); equal axes."""
    ax.set_aspect("equal")
    ax.set(xlabel="to the right of the start [mm]", ylabel="ahead of the start [mm]")
    return -1e3 * places[..., 0], -1e3 * places[..., 1]
