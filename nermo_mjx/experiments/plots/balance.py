"""Figures of balance: verdicts, pitch and stability over time, and the forces on the feet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from nermo_mjx.experiments.line import Line
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots.bars import Bar, bar_entries, draw_bars, repeats, spread_note
from nermo_mjx.experiments.plots.marks import FAIL, PASS, SPINE, profiles, shade_phases, shown, stroke, swatch
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import FOOT, GRID, INK, SHADE, horizontal_grid
from nermo_mjx.recording import Recording
from nermo_mjx.robot import LIMBS

PHASES: Final = ("stand", "shift", "lift", "swing")
_WITH: Final = {False: "without compensation", True: "with compensation"}
_VERDICT: Final = {"pass": PASS, "fail": FAIL}


def verdict_figure(limb: str, sbc: bool, *, hardware: bool = False) -> str:
    """Name of the report's figure for a verdict."""
    with_it = "with" if sbc else "without"
    if hardware:
        return f"hardware: {_name(limb)} lifted, {with_it} compensation"
    return f"{_name(limb)} lifted, {with_it} balance compensation"


def figures(outcome: Outcome, lines: Sequence[Line]) -> Iterator[tuple[str, Figure | None]]:
    """(name, figure) of each picture; None if the outcome has no data for it."""
    yield "verdicts", _verdicts(outcome, lines)
    yield "pitch", _over_time(outcome, "pitch", "Pitch while a leg is lifted and swung", "pitch [deg]", 180 / np.pi)
    title = "Centre of mass inside of the support diagonal"
    yield "stability", _over_time(outcome, "com_margin", title, "distance inside [mm]", 1e3)
    yield "forces", _forces(outcome)
    yield "forces-by-phase", _forces_by_phase(outcome)


def _name(limb: str) -> str:
    return limb.replace("_", " ")


def _runs(outcome: Outcome) -> dict[tuple[str, bool], Recording]:
    """The recordings by lifted leg and compensation."""
    found = {}
    for run in outcome.recordings.values():
        case = run.metadata.get("metrics", {})
        if {"leg", "sbc"} <= set(case):
            found[str(case["leg"]), bool(case["sbc"])] = run
    return found


def _profile(runs: Mapping[tuple[str, bool], Recording]) -> str:
    return shown(str(next(iter(runs.values())).metadata["metrics"].get("profile", "")))


def _verdicts(outcome: Outcome, lines: Sequence[Line]) -> Figure:
    """One tile per leg and source; a tile that differs from the published simulation has a thick frame."""
    said = {line.figure: line.published for line in lines}
    names = profiles(outcome.columns["profile"])
    page = Page("Which legs the robot can lift and swing", (9.4, 3.9), 1, 2, sharey=True)
    for ax, sbc in zip(page.axes[0], (False, True), strict=True):
        columns = ["published\nsimulation", *(shown(name).replace(" ", "\n") for name in names), "published\nhardware"]
        for row, limb in enumerate(LIMBS):
            wanted = said.get(verdict_figure(limb, sbc))
            tiles = [wanted, *(_verdict(outcome, profile, limb, sbc) for profile in names)]
            tiles.append(said.get(verdict_figure(limb, sbc, hardware=True)))
            for column, tile in enumerate(tiles):
                ours = 0 < column <= len(names)
                _tile(ax, column, row, str(tile or "–"), framed=bool(ours and wanted and tile and tile != wanted))
        ax.set_xticks(range(len(columns)), columns, fontsize=8.5)
        ax.set_yticks(range(len(LIMBS)), [f"{_name(limb)} leg" for limb in LIMBS])
        ax.tick_params(length=0, labelcolor=INK)
        ax.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(LIMBS) - 0.5, -0.5), title=_WITH[sbc])
        for spine in ax.spines.values():
            spine.set_visible(False)
    handles: list[Artist] = [swatch(name, colour) for name, colour in _VERDICT.items()]
    handles.append(swatch("not as in the published simulation", "white", ec="black", lw=1.8))
    return page.finish(handles, "pass: upright, and the lifted foot off the ground; all repeats of a case count")


def _tile(ax: Axes, column: int, row: int, text: str, *, framed: bool) -> None:
    colour = _VERDICT.get(text, SHADE)
    ax.add_patch(Rectangle((column - 0.46, row - 0.44), 0.92, 0.88, fc=colour, lw=0))
    if framed:
        frame = Rectangle(
            (column - 0.45, row - 0.43), 0.90, 0.86, fc="none", ec="black", lw=1.8, zorder=4, gid="differs"
        )
        ax.add_patch(frame)
    ax.text(column, row, text, ha="center", va="center", fontsize=9, color=INK)


def _verdict(outcome: Outcome, profile: str, limb: str, sbc: bool) -> str | None:
    passed = outcome.columns["passed"][outcome.where(profile=profile, leg=limb, sbc=sbc)]
    if not len(passed):
        return None
    return {len(passed): "pass", 0: "fail"}.get(int(passed.sum()), f"{int(passed.sum())} of {len(passed)}")


def _over_time(outcome: Outcome, sensor: str, title: str, label: str, factor: float) -> Figure | None:
    """One reading over time, with axes per lifted leg, and lines without and with compensation."""
    runs = {case: run for case, run in _runs(outcome).items() if sensor in run.sensors}
    if not runs:
        return None
    page = Page(title, (9.4, 5.9), 2, 2, sharex=True, sharey="row")
    for ax, limb in zip(page.axes.ravel(), LIMBS, strict=True):
        for sbc in (False, True):
            if (limb, sbc) in runs:
                run = runs[limb, sbc]
                ax.plot(run.time, factor * np.asarray(run.sensors[sensor]), color=SPINE[sbc], lw=1.7, zorder=3 + sbc)
                shade_phases(ax, run.metadata["phases"], named=not sbc or (limb, False) not in runs)
        ax.set_title(f"{_name(limb)} leg", pad=16)
        ax.margins(y=0.08)
    handles: list[Artist] = [stroke(_WITH[sbc], SPINE[sbc], lw=1.7) for sbc in (False, True)]
    for ax in page.axes.ravel():
        horizontal_grid(ax)
    if sensor == "com_margin":
        for ax in page.axes.ravel():
            low = min(ax.get_ylim()[0], -2.0)
            ax.axhspan(low, 0, color=FAIL, alpha=0.45, lw=0, zorder=-4)
            ax.axhline(0, color=INK, lw=1.1)
            ax.set_ylim(bottom=low)
        handles += [stroke("support diagonal", INK, lw=1.1), swatch("beyond it the robot tips", FAIL, alpha=0.45)]
    for ax in page.axes[:, 0]:
        ax.set_ylabel(label)
    for ax in page.axes[-1]:
        ax.set_xlabel("time [s]")
    sign = "positive: nose down; " if sensor == "pitch" else ""
    return page.finish(handles, f"{_profile(runs)}, first repeat; {sign}compensation bends the spine during the shift")


def _forces(outcome: Outcome) -> Figure | None:
    runs = {case: run for case, run in _runs(outcome).items() if "foot_force" in run.sensors}
    if not runs:
        return None
    page = Page("Forces on the feet over time", (9.4, 9.2), len(LIMBS), 2, sharex=True, sharey=True)
    highest = 0.0
    for row, limb in zip(page.axes, LIMBS, strict=True):
        for ax, sbc in zip(row, (False, True), strict=True):
            ax.set_title(f"{_name(limb)} leg, {_WITH[sbc]}", pad=16)
            if (limb, sbc) not in runs:
                continue
            run = runs[limb, sbc]
            force = np.asarray(run.sensors["foot_force"])
            for i, foot in enumerate(LIMBS):
                ax.plot(run.time, force[:, i], color=FOOT[foot], lw=2.0 if foot == limb else 1.2, zorder=3)
            highest = max(highest, float(np.nanpercentile(force, 99.5)))
            shade_phases(ax, run.metadata["phases"])
        row[0].set_ylabel("force [N]")
    for ax in page.axes.ravel():
        ax.set_ylim(-0.03 * highest, 1.12 * highest)
        ax.grid(axis="y", color=GRID, lw=0.8)
    for ax in page.axes[-1]:
        ax.set_xlabel("time [s]")
    handles: list[Artist] = [stroke(f"{_name(foot)} foot", FOOT[foot], lw=1.8) for foot in LIMBS]
    note = f"{_profile(runs)}, first repeat; thick: the lifted foot; impacts above the axes are cut off"
    return page.finish(handles, note)


def _forces_by_phase(outcome: Outcome) -> Figure | None:
    profile = profiles(outcome.columns["profile"])[0]
    phases = [phase for phase in PHASES if f"force_{phase}_{LIMBS[0]}" in outcome.columns]
    if not phases:
        return None
    page = Page("Mean forces on the feet in each phase", (10.4, 5.9), 2, len(LIMBS), sharex=True, sharey=True)
    drawn: list[Bar] = []
    for row, sbc in zip(page.axes, (False, True), strict=True):
        for ax, limb in zip(row, LIMBS, strict=True):
            groups = {
                phase: [
                    Bar(repeats(outcome, f"force_{phase}_{foot}", profile=profile, leg=limb, sbc=sbc), FOOT[foot])
                    for foot in LIMBS
                ]
                for phase in phases
            }
            drawn += draw_bars(ax, groups)
            ax.set_title(f"{_name(limb)} leg,\n{_WITH[sbc]}")
        row[0].set_ylabel("force [N]")
    handles: list[Artist] = [*(swatch(f"{_name(foot)} foot", FOOT[foot]) for foot in LIMBS), *bar_entries(drawn)]
    return page.finish(handles, f"{shown(profile)}; {spread_note(drawn)}")
