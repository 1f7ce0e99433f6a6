"""Balance: section 6.4."""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.experiments.line import Figure
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.published.measure import HARDWARE, Measure
from nermo_mjx.robot.parameters import LIMBS


def _verdict(limb: str, sbc: bool) -> Measure:
    def measure(outcome: Outcome, profile: str) -> str | None:
        passed = outcome.mean("passed", profile=profile, leg=limb, sbc=sbc)
        return None if np.isnan(passed) else {1.0: "pass", 0.0: "fail"}.get(passed, f"{passed:.0%} pass")

    return measure


def _pitch_reduction(end: str) -> Measure:
    """Share of the resting pitch's size that balance compensation takes away, mean of left and right."""

    def measure(outcome: Outcome, profile: str) -> float:
        off, on = (
            np.mean(
                [
                    abs(outcome.mean("pitch_rest", profile=profile, leg=f"{end}_{side}", sbc=sbc))
                    for side in ("left", "right")
                ]
            )
            for sbc in (False, True)
        )
        return float(1.0 - on / off)

    return measure


def _published_verdict(limb: str, sbc: bool) -> str:
    return "pass" if sbc or limb.startswith("front") else "fail"


FIGURES: Final = (
    *(
        Figure(
            f"{limb.replace('_', ' ')} lifted, {'with' if sbc else 'without'} balance compensation",
            _published_verdict(limb, sbc),
            _verdict(limb, sbc),
            source="6.4",
        )
        for sbc in (False, True)
        for limb in LIMBS
    ),
    Figure("resting pitch reduced by compensation, front legs", 0.30, _pitch_reduction("front"), source="6.4"),
    Figure("resting pitch reduced by compensation, rear legs", 0.73, _pitch_reduction("rear"), source="6.4"),
    Figure("height of the centre of mass", 57.0, lambda o, p: 1e3 * o.mean("com_height", profile=p), "mm", "6.4"),
    *(
        Figure(
            f"hardware: {limb.replace('_', ' ')} lifted, {'with' if sbc else 'without'} compensation",
            "pass" if sbc else "fail",
            _verdict(limb, sbc),
            source=HARDWARE,
        )
        for sbc in (False, True)
        for limb in LIMBS
    ),
)
