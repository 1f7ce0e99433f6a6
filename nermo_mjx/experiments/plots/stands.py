"""Figures of the test stands: force, speed and work of the routings of a leg, and of the spine's planes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from nermo_mjx.experiments.line import Line
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.plots.bars import Bar, axis_label, draw_bars, repeats
from nermo_mjx.experiments.plots.marks import swatch
from nermo_mjx.experiments.stands import spine
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import SERIES
from nermo_mjx.robot.parameters import ROUTINGS

_NOTE = "on the test stand, without gravity; the published values of these tables are not among the sources"


def leg_figures(outcome: Outcome, lines: Sequence[Line]) -> Iterator[tuple[str, Figure | None]]:
    """(name, figure) of the leg's stand."""
    names = {"force": "pull withstood by the foot", "speed": "speed of the rising foot", "work": "work of a swing",
             "coupling": "knee's bend per hip's swing"}  # fmt: skip
    groups = {
        f"{pair} leg": [{"pair": pair, "routing": routing, "hinges": 1} for routing in ROUTINGS]
        for pair in ("front", "rear")
    }
    yield "routings", _bars(outcome, "Routings of the knee's tendon", names, groups, ROUTINGS)


def spine_figures(outcome: Outcome, lines: Sequence[Line]) -> Iterator[tuple[str, Figure | None]]:
    """(name, figure) of the spine's stand."""
    names = {"force": "force withstood by the hip", "speed": "speed of the hip", "work": "work of a bend",
             "range": "range of the hip"}  # fmt: skip
    groups = {"Nermo 4.1": [{"robot": "nermo_41", "plane": plane} for plane in spine.PLANES]}
    yield "planes", _bars(outcome, "Lateral, vertical and combined bends", names, groups, tuple(spine.PLANES))


def _bars(
    outcome: Outcome,
    title: str,
    names: Mapping[str, str],
    groups: Mapping[str, Sequence[Mapping[str, Any]]],
    series: Sequence[str],
) -> Figure:
    """A panel for each column, with a bar for each case of each group."""
    page, profile = Page(title, (7.2, 5.2), 2, 2), outcome.columns["profile"][0]
    for ax, (column, name) in zip(page.axes.ravel(), names.items(), strict=True):
        draw_bars(ax, {
            group: [Bar(repeats(outcome, column, profile=profile, **case), SERIES[i]) for i, case in enumerate(cases)]
            for group, cases in groups.items()
        })  # fmt: skip
        ax.set_ylabel(axis_label(outcome, column, name))
    return page.finish([swatch(name, SERIES[i]) for i, name in enumerate(series)], _NOTE)
