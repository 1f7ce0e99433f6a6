"""The gait diagram: planned and measured contact of each foot."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import FOOT, INK, MISSING, MUTED, TAIL
from nermo_mjx.robot import LIMBS
from nermo_mjx.view.plots.walk import Walk, name_of
from nermo_mjx.view.standing import STANDING, spans


def gait_diagram(walk: Walk) -> Figure | None:
    """Hildebrand's bars: the measured contact in the foot's colour, the planned one as a thin black bar above it."""
    if walk.contact is None:
        return None
    part, what = walk.shown
    time, contact = walk.recording.time[part], walk.contact[part]
    planned = None if walk.planned is None else walk.planned[part]
    page = Page(f"Gait diagram{walk.title}", (7.4, 3.9))
    ax = page.axes[0, 0]
    shares, names = [], [name_of(limb) for limb in LIMBS]
    for row, limb in enumerate(LIMBS):
        ax.broken_barh(spans(contact[:, row], time), (row - 0.18, 0.5), color=FOOT[limb], lw=0, zorder=3)
        share = f"{contact[:, row].mean():.2f}"
        if planned is not None:
            ax.broken_barh(spans(planned[:, row], time), (row - 0.36, 0.11), color=INK, lw=0, zorder=3)
            share = f"{share} ({planned[:, row].mean():.2f})"
        shares.append(share)
        ax.axhline(row + 0.5, color="white", lw=0)
    tail = walk.recording.sensors.get("tail_force")
    if tail is not None:
        bears = np.asarray(tail)[part] > STANDING
        ax.broken_barh(spans(bears, time), (len(names) - 0.18, 0.5), color=TAIL, lw=0, zorder=3)
        shares.append(f"{bears.mean():.2f}")
        names.append("tail")
    if walk.cycle is not None:
        first = np.ceil(time[0] / walk.cycle - 1e-6)
        for k in np.arange(first, time[-1] / walk.cycle + 1e-6):
            ax.axvline(k * walk.cycle, color=MISSING, lw=0.9, zorder=1)
        above = ax.secondary_xaxis("top", functions=(lambda t: t / walk.cycle, lambda c: c * walk.cycle))
        above.set_xlabel("gait cycles [1]")
        above.xaxis.get_major_locator().set_params(integer=True)
        above.spines["top"].set_visible(False)
    ax.set_yticks(range(len(names)), names)
    right = ax.secondary_yaxis("right")
    right.set_yticks(range(len(names)), shares)
    right.set_ylabel("duty factor [1]")
    right.spines["right"].set_visible(False)
    for axis in (ax, right):
        axis.tick_params(axis="y", length=0, labelcolor=INK)
    ax.set(xlim=(time[0], time[-1]), ylim=(len(names) - 0.45, -0.6), xlabel="time [s]")
    ax.spines["left"].set_visible(False)
    handles: list[Artist] = [Patch(fc=MUTED, label="measured, in the foot's colour")]
    if planned is not None:
        handles.append(Patch(fc=INK, label="planned"))
    note = f"{what}; measured: bears more than {STANDING:g} N; duty factor: share of the time on the ground"
    return page.finish(handles, note + (", in brackets as planned" if planned is not None else ""))
