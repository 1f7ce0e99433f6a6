"""Strips below a video's picture that scroll with time: footfall, and servo angles.

A strip is drawn once for the whole run; each frame shows the part of it around its own time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nermo_mjx.plotting.style import FOOT, OKABE_ITO, TAIL
from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot.parameters import LIMBS
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.view.recorded import STANDING, spans

#: Matplotlib's pixels per inch, and mean width of a character of a caption [pixels].
DPI: Final = 100
CHARACTER: Final = 6.6
#: Colours of text and of the paper.
INK: Final = "#222222"
PAPER: Final = 255


def blank_strip(width: int, height: int) -> Figure:
    """A blank figure of the given size in pixels."""
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def write_text(figure: Figure, x: float, y: float, text: str, **style: Any) -> None:
    """Write a text whose upper left corner is at the given pixels from that of the figure."""
    width, height = figure.get_size_inches() * DPI
    figure.text(x / width, 1 - y / height, text, **({"va": "top", "color": INK} | style))


def pixels(figure: Figure) -> UInt8[np.ndarray, "height width 3"]:
    """The figure as pixels."""
    canvas: Any = figure.canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


#: Time range shown in a frame [s]: the past, and, paler, the future.
PAST: Final = 2.0
AHEAD: Final = 0.75
#: Width of the column with names and scales, and height of the time's scale [pixels].
MARGIN, SCALE = 44, 15
COLOURS: Final = FOOT | {"spine": OKABE_ITO["green"]}
#: Names of the limbs in a narrow column.
SHORT: Final = {limb: "".join(word[0] for word in limb.split("_")).upper() for limb in LIMBS}
#: Gap above each row [pixels].
GAP: Final = 5
#: Half a label of the time's scale [pixels].
_HALF_LABEL: Final = 12
#: Widest picture that is drawn at once [pixels].
_WIDEST: Final = 4000


@dataclasses.dataclass(frozen=True)
class Panel:
    """One row of a strip.

    Attributes:
        height: in pixels, without the gap above it.
        low, high: ends of the vertical axis.
        draw: draws onto matplotlib's axes over time [s].
        notes: (value, text, colour) in the column next to it.
    """

    height: int
    low: float
    high: float
    draw: Callable[[Any], None]
    notes: tuple[tuple[float, str, str], ...]


class Strip:
    """A strip of one recording, `width` pixels wide, for times of the recording [s]."""

    def __init__(self, recording: Recording, panels: list[Panel], width: int) -> None:
        self.begin, self.end = float(recording.time[0]), float(recording.time[-1])
        self._panels, self._width = panels, width
        shown = min(PAST + AHEAD, max(self.end - self.begin, 1e-3))
        self._rate = (width - MARGIN) / shown  # pixels per second
        self.height = sum(panel.height + GAP for panel in panels) + SCALE
        self.height += self.height % 2
        self._column = self._draw_column()
        self._run = np.concatenate(list(self._draw_run()), axis=1)

    def at(self, seconds: float) -> UInt8[np.ndarray, "height width 3"]:
        """The strip around a time since the recording began [s]."""
        room = self._width - MARGIN
        at = round(self._rate * seconds)
        first = int(np.clip(at - round(self._rate * PAST), 0, self._run.shape[1] - room))
        window, now = self._run[:, first : first + room].copy(), min(at - first, room - 1)
        window[:, now:] = PAPER - (PAPER - window[:, now:].astype(int)) * 2 // 5
        window[: -SCALE + 3, now : now + 1] = 0x22
        return np.concatenate([self._column, window], axis=1)

    def _draw_run(self) -> Iterator[UInt8[np.ndarray, "height part 3"]]:
        """The whole run, in parts."""
        total = max(round(self._rate * (self.end - self.begin)), self._width - MARGIN)
        for first in range(0, total, _WIDEST):
            width = min(_WIDEST, total - first)
            since = self.begin + first / self._rate
            until = since + width / self._rate
            figure = blank_strip(width, self.height)
            for top, panel in self._rows():
                axes = self._axes(figure, top, panel)
                axes.set(xlim=(since, until), ylim=(panel.low, panel.high))
                axes.axvspan(since, until, color="#f3f3f3", zorder=0, linewidth=0)
                panel.draw(axes)
            for half in range(int(np.floor(2 * since)), int(np.ceil(2 * until)) + 1):
                place = (half / 2 - since) * self._rate
                if not _HALF_LABEL < first + place < total - _HALF_LABEL:
                    continue  # it would be clipped
                write_text(figure, place, self.height - SCALE + 1, f"{half / 2:g} s", fontsize=7.5, ha="center")
            yield pixels(figure)

    def _draw_column(self) -> UInt8[np.ndarray, "height margin 3"]:
        figure = blank_strip(MARGIN, self.height)
        for top, panel in self._rows():
            for value, text, colour in panel.notes:
                share = (panel.high - value) / (panel.high - panel.low)
                style = {"fontsize": 7.5, "ha": "right", "va": "center", "color": colour}
                write_text(figure, MARGIN - 4, top + share * panel.height, text, **style)
        return pixels(figure)

    def _rows(self) -> Iterator[tuple[int, Panel]]:
        top = GAP
        for panel in self._panels:
            yield top, panel
            top += panel.height + GAP

    def _axes(self, figure: Figure, top: int, panel: Panel) -> Any:
        axes = figure.add_axes((0.0, 1 - (top + panel.height) / self.height, 1.0, panel.height / self.height))
        axes.axis("off")
        return axes


def gait_panels(recording: Recording) -> list[Panel]:
    """A bar for each foot in stance (a Hildebrand diagram), and for the tail while it is loaded."""
    force = np.asarray(recording.sensors["foot_force"])
    rows = {SHORT[limb]: COLOURS[limb] for limb in LIMBS}
    if "tail_force" in recording.sensors:
        force = np.column_stack([force, recording.sensors["tail_force"]])
        rows["tail"] = TAIL
    standing, top = force > STANDING, len(rows) - 1

    def draw(axes: Any) -> None:
        for row, colour in enumerate(rows.values()):
            axes.broken_barh(spans(standing[:, row], recording.time), (top - row + 0.12, 0.76), color=colour)

    notes = tuple((top + 0.5 - row, name, colour) for row, (name, colour) in enumerate(rows.items()))
    return [Panel(13 * len(rows), 0.0, float(len(rows)), draw, notes)]


def servo_panels(recording: Recording) -> list[Panel]:
    """Angles of hips, knees and spine [degrees]: measured, and, paler, commanded."""
    measured = np.degrees(np.asarray(recording.sensors["servo_angle"]))
    commanded = np.degrees(np.asarray(recording.ctrl))
    groups = {"hip": range(4), "knee": range(4, 8), "spine": range(8, 9)}
    return [_curves(recording.time, name, measured, commanded, columns) for name, columns in groups.items()]


def _curves(
    time: Float[np.ndarray, " T"], name: str, measured: np.ndarray, commanded: np.ndarray, columns: range
) -> Panel:
    shown = np.concatenate([measured[:, columns], commanded[:, columns]])
    low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
    middle, half = (low + high) / 2, max((high - low) / 2, 1.0)

    def draw(axes: Any) -> None:
        for column in columns:
            colour = COLOURS["spine" if name == "spine" else LIMBS[column % 4]]
            axes.plot(time, commanded[:, column], color=colour, linewidth=2.2, alpha=0.3)
            axes.plot(time, measured[:, column], color=colour, linewidth=1.1)

    notes = (
        (middle + half, f"{middle + half:.0f}°", INK),
        (middle, name, INK if name != "spine" else COLOURS["spine"]),
        (middle - half, f"{middle - half:.0f}°", INK),
    )
    return Panel(46, middle - 1.15 * half, middle + 1.15 * half, draw, notes)


#: Sensors that an overlay needs, and what makes its rows of the strip below the image; None: drawn into the scene.
#: `gait`: a bar for each standing foot; `servos`: their angles; `support`: polygon and centre of mass on the ground.
OVERLAYS: Final[dict[str, tuple[tuple[str, ...], Callable[[Recording], list[Panel]] | None]]] = {
    "gait": (("foot_force",), gait_panels),
    "servos": (("servo_angle",), servo_panels),
    "support": (("foot_force", "foot_position"), None),
}


def check_overlays(names: Sequence[str], recording: Recording | None = None) -> None:
    """Reject unknown overlays, and those for which a recording lacks the sensors.

    Raises:
        ParameterError: an unknown name, or one that is given twice.
        RecordingError: a sensor is missing.
    """
    for name in names:
        if name not in OVERLAYS:
            raise ParameterError(f"overlay is {name!r}: allowed is one of {', '.join(OVERLAYS)}.")
        missing = [sensor for sensor in OVERLAYS[name][0] if recording and sensor not in recording.sensors]
        if missing:
            raise RecordingError(f"The overlay {name!r} needs the sensor {missing[0]!r}, which the recording lacks.")
    if len(set(names)) < len(names):
        raise ParameterError(f"overlay is {', '.join(names)}: allowed is each name once.")


def strips_of(recording: Recording, names: Sequence[str], width: int) -> list[Strip]:
    """The strips below the image, from top to bottom."""
    kinds = [OVERLAYS[name][1] for name in names]
    return [Strip(recording, panels(recording), width) for panels in kinds if panels is not None]
