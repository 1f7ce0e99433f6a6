"""The body: dimensions (Table 4.1), mass, servos, the finite elements' load case (A.1), the spine's range (5.1.1).

All of it was entered by hand, or follows from what was: no line is predicted.
"""

from __future__ import annotations

from typing import Final

from nermo_mjx.experiments.body import TORQUE
from nermo_mjx.experiments.judgement import Judgement, Number, Same
from nermo_mjx.experiments.line import Figure
from nermo_mjx.experiments.outcome import Outcome


def _body(column: str, name: str, reported: Judgement, unit: str, source: str, scale: float = 1.0) -> Figure:
    def measure(outcome: Outcome, profile: str) -> float:
        return scale * outcome.mean(column, profile=profile)

    return Figure(name, "chosen", reported, measure, unit, source)


_LOAD: Final = f"A.1: finite elements, {TORQUE:g} N m; here on the test stand"
FIGURES: Final = (
    _body("mass", "mass", Number(270.0), "g", "Nermo-Lite", 1e3),
    _body("servos", "servos", Same(11), "", "Nermo-Lite; with the tail's"),
    _body("length", "length", Number(405.0), "mm", "Table 4.1, of Nermo", 1e3),
    _body("height", "height", Number(91.0), "mm", "Table 4.1, of Nermo", 1e3),
    _body("width", "width", Number(90.0), "mm", "Table 4.1, of Nermo", 1e3),
    _body(
        "scapula_pelvis",
        "shoulder to hip",
        Number(117.0),
        "mm",
        "Table 4.1: scapula to pelvis, of Nermo; Table A.5, which the twin has, gives 121.9 mm",
        1e3,
    ),
    _body("bend_front_knee", "bend of a front knee under load", Number(0.95), "rad", _LOAD),
    _body("bend_rear_knee", "bend of a rear knee under load", Number(0.65), "rad", _LOAD),
    _body(
        "bend_spine",
        "bend of the spine under load",
        Number(0.42),
        "rad",
        f'{_LOAD}. Published as "spine joint": one of 1.2 N m/rad bends by 0.104, so that it can only be all four',
    ),
    _body("spine_joint_limit", "largest angle of a spine joint", Number(0.2), "rad", "5.1.1"),
)
