"""Balance: section 6.2.3, and the hardware's, 7.1.

Mass share, stance, offset compensation and the servo's bound were chosen with these outcomes known, and the masses by
these forces and the height: no line is predicted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from nermo_mjx.experiments.judgement import Judgement, Number, Same, gain
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
        return float(1.0 - on / off) if off else float("nan")

    return measure


def _published_verdict(limb: str, sbc: bool) -> str:
    return "pass" if sbc or limb.startswith("front") else "fail"


#: The other leg of a pair.
_MIRROR: Final = {limb: limb.replace(side, other) for side, other in (("left", "right"), ("right", "left"))
                  for limb in LIMBS if side in limb}  # fmt: skip


def _force(foot: str, lifted: str, sbc: bool) -> Callable[[Outcome, str], float]:
    """Force of a foot [N] on four feet, just before a leg is lifted; mean of the case and its mirror image."""

    def measure(outcome: Outcome, profile: str) -> float:
        pairs = ((foot, lifted), (_MIRROR[foot], _MIRROR[lifted]))
        return float(np.mean([outcome.mean(f"force_shift_{f}", profile=profile, leg=leg, sbc=sbc) for f, leg in pairs]))

    return measure


def _diagonal_carries_most(outcome: Outcome, profile: str) -> bool | None:
    """Whether front left and rear right carry more than the others together, before the rear left leg is lifted."""
    force = {limb: _force(limb, "rear_left", True)(outcome, profile) for limb in LIMBS}
    if not np.isfinite(list(force.values())).all():
        return None
    return force["front_left"] + force["rear_right"] > force["front_right"] + force["rear_left"]


def _chosen(name: str, reported: Judgement, measure: Measure, unit: str = "", source: str = "6.2.3") -> Figure:
    return Figure(name, "chosen", reported, measure, unit, source)


_FOUR_FEET: Final = "6.2.3, Figure 6.16: four feet, before the lift"
FIGURES: Final = (
    *(
        _chosen(
            f"{limb.replace('_', ' ')} lifted, {'with' if sbc else 'without'} balance compensation",
            Same(_published_verdict(limb, sbc)),
            _verdict(limb, sbc),
        )
        for sbc in (False, True)
        for limb in LIMBS
    ),
    _chosen("resting pitch reduced by compensation, front legs", gain(0.30), _pitch_reduction("front")),
    _chosen("resting pitch reduced by compensation, rear legs", gain(0.73), _pitch_reduction("rear")),
    _chosen("height of the centre of mass", Number(57.0), lambda o, p: 1e3 * o.mean("com_height", profile=p), "mm"),
    _chosen(
        "force of the rear left foot, without compensation",
        Number(0.73),
        _force("rear_left", "rear_left", False),
        "N",
        _FOUR_FEET,
    ),
    _chosen(
        "force of the rear left foot, with compensation",
        Number(0.16),
        _force("rear_left", "rear_left", True),
        "N",
        _FOUR_FEET,
    ),
    _chosen(
        "force of the front right foot, with compensation",
        Number(0.35),
        _force("front_right", "rear_left", True),
        "N",
        f"{_FOUR_FEET}; read as that of the rear left leg's case",
    ),
    _chosen(
        "front left and rear right carry most, with compensation",
        Same(True),
        _diagonal_carries_most,
        source=_FOUR_FEET,
    ),
    *(
        _chosen(
            f"hardware: {limb.replace('_', ' ')} lifted, {'with' if sbc else 'without'} compensation",
            Same("pass" if sbc else "fail"),
            _verdict(limb, sbc),
            source=HARDWARE,
        )
        for sbc in (False, True)
        for limb in LIMBS
    ),
)
