"""Maze: section 6.2.4, and the hardware's, 7.1; nothing was decided with it in view."""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.experiments.judgement import Effect, Judgement, Same, gain
from nermo_mjx.experiments.judgement import Number as Size
from nermo_mjx.experiments.line import Figure
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.published.measure import HARDWARE, Measure, Number, below, clock, degrees, quotient


def _maze(column: str, spine: bool) -> Number:
    return lambda outcome, profile: outcome.mean(column, profile=profile, spine=spine)


def _maze_time(spine: bool) -> Number:
    return lambda outcome, profile: outcome.mean("time", profile=profile, spine=spine) / clock(profile)


def _maze_speed(spine: bool) -> Number:
    return lambda outcome, profile: 1e3 * clock(profile) * outcome.mean("mean_speed", profile=profile, spine=spine)


def _reached(spine: bool) -> Measure:
    def measure(outcome: Outcome, profile: str) -> bool | None:
        share = outcome.mean("reached", profile=profile, spine=spine)
        return None if np.isnan(share) else share == 1.0

    return measure


def _untouched(spine: bool) -> Measure:
    def measure(outcome: Outcome, profile: str) -> bool | None:
        touched = outcome.mean("touched", profile=profile, spine=spine)
        return None if np.isnan(touched) else touched == 0.0

    return measure


def _noisier_in_maze(angle: str) -> Measure:
    def measure(outcome: Outcome, profile: str) -> bool | None:
        with_it, without = (outcome.mean(f"{angle}_std", profile=profile, spine=spine) for spine in (True, False))
        return None if np.isnan([with_it, without]).any() else with_it > without

    return measure


def _predicted(name: str, reported: Judgement, measure: Measure, unit: str = "", source: str = "6.2.4") -> Figure:
    return Figure(name, "predicted", reported, measure, unit, source)


def _over(column: str) -> Number:
    """With the spine over without."""
    return quotient(_maze(column, True), _maze(column, False))


_PATH: Final = "6.2.4, on another path of about 5 m"
_SPINE: Final = {False: "without spine", True: "with spine"}
FIGURES: Final = (
    *(_predicted(f"end reached {name}", Same(True), _reached(spine)) for spine, name in _SPINE.items()),
    *(_predicted(f"no box touched {name}", Same(True), _untouched(spine)) for spine, name in _SPINE.items()),
    _predicted("time without spine", Size(85.7), _maze_time(False), "s", _PATH),
    _predicted("time with spine", Size(61.1), _maze_time(True), "s", _PATH),
    _predicted("time with spine over without", Effect(0.713, digits=3), quotient(_maze_time(True), _maze_time(False))),
    _predicted("mean speed without spine", Size(60.0), _maze_speed(False), "mm/s"),
    _predicted("mean speed with spine", Size(82.0), _maze_speed(True), "mm/s"),
    _predicted("mean speed with spine over without", Effect(1.37), _over("mean_speed")),
    _predicted("roll std higher with the spine", Same(True), _noisier_in_maze("roll")),
    _predicted("pitch std higher with the spine", Same(True), _noisier_in_maze("pitch")),
    _predicted("roll std without spine", Size(3.09), degrees(_maze("roll_std", False)), "deg"),
    _predicted("roll std with spine", Size(4.13), degrees(_maze("roll_std", True)), "deg"),
    _predicted("roll std with spine over without", Effect(1.34), _over("roll_std")),
    _predicted("pitch std without spine", Size(0.75), degrees(_maze("pitch_std", False)), "deg"),
    _predicted("pitch std with spine", Size(1.25), degrees(_maze("pitch_std", True)), "deg"),
    _predicted("pitch std with spine over without", Effect(1.67), _over("pitch_std")),
    _predicted(
        "hardware: time saved with the spine", gain(0.32), below(_maze_time(True), _maze_time(False)), source=HARDWARE
    ),
)
