"""Servo angles over time: commanded and measured."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import INK, SERIES, horizontal_grid
from nermo_mjx.robot import LIMBS
from nermo_mjx.robot.interface import servos_by_count
from nermo_mjx.view.plots.walk import Walk, name_of

_HIP, _KNEE, _OTHER = SERIES[0], SERIES[1], SERIES[2]
#: A servo that moves less than this is left out, unless it is a leg's [deg].
_STILL = 0.5


def servo_angles(walk: Walk) -> Figure | None:
    """Hip and knee of each leg, and the other servos that move."""
    measured = walk.recording.sensors.get("servo_angle")
    if measured is None:
        return None
    part, what = walk.shown
    time, aim, angle = (np.asarray(each)[part] for each in (walk.recording.time, walk.recording.ctrl, measured))
    aim, angle = np.degrees(aim), np.degrees(angle)
    names = servos_by_count(angle.shape[1])
    others = [
        i for i in range(2 * len(LIMBS), len(names)) if np.ptp(aim[:, i]) > _STILL or np.ptp(angle[:, i]) > _STILL
    ]
    rows = [(f"{name_of(limb)} leg", [(i, _HIP), (i + len(LIMBS), _KNEE)]) for i, limb in enumerate(LIMBS)]
    rows += [(names[i].replace("_", " "), [(i, _OTHER)]) for i in others]
    page = Page(f"Servo angles{walk.title}", (7.4, 1.3 + 1.3 * len(rows)), len(rows), 1, sharex=True)
    for ax, (name, lines) in zip(page.axes[:, 0], rows, strict=True):
        for i, colour in lines:
            ax.plot(time, angle[:, i], color=colour, lw=1.5, zorder=3)
            ax.plot(time, aim[:, i], color=INK, lw=0.9, ls=(0, (4, 2)), zorder=4)
        ax.annotate(name, (0, 1.0), xycoords="axes fraction", va="bottom", color=INK)
        ax.margins(y=0.1)
        horizontal_grid(ax)
    page.axes[-1, 0].set(xlabel="time [s]", xlim=(time[0], time[-1]))
    page.figure.supylabel("servo angle [deg]", fontsize=9.5)
    handles: list[Artist] = [
        Line2D([], [], color=_HIP, lw=1.5, label="hip or shoulder, measured"),
        Line2D([], [], color=_KNEE, lw=1.5, label="knee, measured"),
    ]
    if others:
        moved = ", ".join(names[i].replace("_", " ") for i in others)
        handles.append(Line2D([], [], color=_OTHER, lw=1.5, label=f"{moved}, measured"))
    handles.append(Line2D([], [], color=INK, lw=0.9, ls=(0, (4, 2)), label="commanded"))
    return page.finish(handles, f"{what}; hip 0: leg straight down, positive: backward; spine positive: to the left")
