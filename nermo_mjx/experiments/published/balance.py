"""Balance: section 6.2.3, and the hardware's, 7.1.

Mass share, stance, offset compensation and the servo's bound were chosen with these outcomes known, and the masses by
these forces and the height: no line is predicted.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.experiments.judgement import Number as Size
from nermo_mjx.experiments.judgement import Same, gain
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.published.measure import HARDWARE, Measure, Number, below, column, figures_of, whether
from nermo_mjx.robot.parameters import LIMBS


def _verdict(limb: str, sbc: bool) -> Measure:
    def measure(outcome: Outcome, profile: str) -> str | None:
        passed = outcome.mean("passed", profile=profile, leg=limb, sbc=sbc)
        return None if np.isnan(passed) else {1.0: "pass", 0.0: "fail"}.get(passed, f"{passed:.0%} pass")

    return measure


def _pitch_reduction(end: str) -> Measure:
    """Relative reduction of the resting pitch by balance compensation, mean of left and right."""
    sizes = (
        [column("pitch_rest", leg=f"{end}_{side}", sbc=sbc) for side in ("left", "right")] for sbc in (True, False)
    )
    return below(*(_mean_size(each) for each in sizes))


def _mean_size(measures: list[Number]) -> Number:
    return lambda outcome, profile: float(np.mean([abs(each(outcome, profile)) for each in measures]))


#: The other leg of a pair.
_MIRROR: Final = {limb: limb.replace(side, other) for side, other in (("left", "right"), ("right", "left"))
                  for limb in LIMBS if side in limb}  # fmt: skip


def _force(foot: str, lifted: str, sbc: bool) -> Number:
    """Force of a foot [N] on four feet, just before a leg is lifted; mean of the case and its mirror image."""

    def measure(outcome: Outcome, profile: str) -> float:
        pairs = ((foot, lifted), (_MIRROR[foot], _MIRROR[lifted]))
        return float(np.mean([outcome.mean(f"force_shift_{f}", profile=profile, leg=leg, sbc=sbc) for f, leg in pairs]))

    return measure


#: Whether front left and rear right together carry more than the others, before the rear left leg is lifted.
_diagonal_carries_most: Final = whether(
    lambda front_left, front_right, rear_left, rear_right: front_left + rear_right > front_right + rear_left,
    *(_force(limb, "rear_left", True) for limb in LIMBS),
)
_FOUR_FEET: Final = "6.2.3, Figure 6.16: four feet, before the lift"
_READ: Final = f"{_FOUR_FEET}; read as that of the rear left leg's case"
_CASES: Final = [(sbc, limb) for sbc in (False, True) for limb in LIMBS]
_WITH: Final = {False: "without", True: "with"}
_figure: Final = figures_of("chosen", "6.2.3")
FIGURES: Final = (
    *(
        _figure(f"{limb.replace('_', ' ')} lifted, {_WITH[sbc]} balance compensation",
                Same("pass" if sbc or limb.startswith("front") else "fail"), _verdict(limb, sbc))
        for sbc, limb in _CASES
    ),
    _figure("resting pitch reduced by compensation, front legs", gain(0.30), _pitch_reduction("front")),
    _figure("resting pitch reduced by compensation, rear legs", gain(0.73), _pitch_reduction("rear")),
    _figure("height of the centre of mass", Size(57.0), column("com_height", 1e3), "mm"),
    *(
        _figure(f"force of the {foot.replace('_', ' ')} foot, {_WITH[sbc]} compensation", Size(force),
                _force(foot, "rear_left", sbc), "N", source)
        for foot, sbc, force, source in (
            ("rear_left", False, 0.73, _FOUR_FEET), ("rear_left", True, 0.16, _FOUR_FEET),
            ("front_right", True, 0.35, _READ),
        )
    ),
    _figure("front left and rear right carry most, with compensation", Same(True), _diagonal_carries_most,
            source=_FOUR_FEET),
    *(
        _figure(f"hardware: {limb.replace('_', ' ')} lifted, {_WITH[sbc]} compensation",
                Same("pass" if sbc else "fail"), _verdict(limb, sbc), source=HARDWARE)
        for sbc, limb in _CASES
    ),
)  # fmt: skip
