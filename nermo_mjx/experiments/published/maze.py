"""Maze: section 6.5."""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.experiments.line import Figure
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.published.measure import Measure, Number, clock, degrees, quotient


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
    def measure(outcome: Outcome, profile: str) -> bool:
        return outcome.mean("touched", profile=profile, spine=spine) == 0.0

    return measure


def _noisier_in_maze(angle: str) -> Measure:
    def measure(outcome: Outcome, profile: str) -> bool:
        return outcome.mean(f"{angle}_std", profile=profile, spine=True) > outcome.mean(
            f"{angle}_std", profile=profile, spine=False
        )

    return measure


FIGURES: Final = (
    Figure("end reached without spine", True, _reached(False), source="6.5"),
    Figure("end reached with spine", True, _reached(True), source="6.5"),
    Figure("no box touched without spine", True, _untouched(False), source="6.5"),
    Figure("no box touched with spine", True, _untouched(True), source="6.5"),
    Figure("time without spine", 85.7, _maze_time(False), "s", "6.5, on another path of about 5 m"),
    Figure("time with spine", 61.1, _maze_time(True), "s", "6.5, on another path of about 5 m"),
    Figure(
        "time with spine over without",
        0.713,
        quotient(_maze_time(True), _maze_time(False)),
        source="6.5",
        demanded=(0.0, 0.80),
    ),
    Figure("mean speed without spine", 60.0, _maze_speed(False), "mm/s", "6.5"),
    Figure("mean speed with spine", 82.0, _maze_speed(True), "mm/s", "6.5"),
    Figure("roll std higher with the spine", True, _noisier_in_maze("roll"), source="6.5"),
    Figure("pitch std higher with the spine", True, _noisier_in_maze("pitch"), source="6.5"),
    Figure("roll std without spine", 3.09, degrees(_maze("roll_std", False)), "deg", "6.5"),
    Figure("roll std with spine", 4.13, degrees(_maze("roll_std", True)), "deg", "6.5"),
    Figure("pitch std without spine", 0.75, degrees(_maze("pitch_std", False)), "deg", "6.5"),
    Figure("pitch std with spine", 1.25, degrees(_maze("pitch_std", True)), "deg", "6.5"),
)
