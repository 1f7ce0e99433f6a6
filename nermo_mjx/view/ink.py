"""Text and plots in strips of pixels, drawn by matplotlib: captions, bars and curves beside the robot's image."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

#: Matplotlib's pixels per inch, and mean width of a character of a caption [pixels].
DPI: Final = 100
CHARACTER: Final = 6.6
#: Colours of text and of the paper.
INK: Final = "#222222"
PAPER: Final = 255


def strip(width: int, height: int) -> Figure:
    """A blank figure of the given size in pixels."""
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def write(figure: Figure, x: float, y: float, text: str, **style: Any) -> None:
    """Write a text whose upper left corner is at the given pixels from that of the figure."""
    width, height = figure.get_size_inches() * DPI
    figure.text(x / width, 1 - y / height, text, **({"va": "top", "color": INK} | style))


def pixels(figure: Figure) -> UInt8[np.ndarray, "height width 3"]:
    """The figure as pixels."""
    canvas: Any = figure.canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
