"""The body: dimensions (Table 4.1), mass, servos, the finite elements' load case (A.1), the spine's range (5.1.1).

All of it was entered by hand, or follows from such values: no line is predicted.
"""

from __future__ import annotations

from typing import Final

from nermo_mjx.experiments.body import TORQUE
from nermo_mjx.experiments.judgement import Number, Same
from nermo_mjx.experiments.published.measure import column, figures_of

_LOAD: Final = f"A.1: finite elements, {TORQUE:g} N m; here on the test stand"
_AXES: Final = "Table 4.1: scapula to pelvis, of Nermo; Table A.5, which the twin has, gives 121.9 mm"
_JOINTS: Final = (
    f'{_LOAD}. Published as "spine joint": one of 1.2 N m/rad bends by 0.104, so that it can only be all four'
)
_figure: Final = figures_of("chosen", "Table 4.1, of Nermo")
FIGURES: Final = (
    _figure("mass", Number(270.0), column("mass", 1e3), "g", "Nermo-Lite"),
    _figure("servos", Same(11), column("servos"), source="Nermo-Lite; with the tail's"),
    _figure("length", Number(405.0), column("length", 1e3), "mm"),
    _figure("height", Number(91.0), column("height", 1e3), "mm"),
    _figure("width", Number(90.0), column("width", 1e3), "mm"),
    _figure("shoulder to hip", Number(117.0), column("scapula_pelvis", 1e3), "mm", _AXES),
    _figure("bend of a front knee under load", Number(0.95), column("bend_front_knee"), "rad", _LOAD),
    _figure("bend of a rear knee under load", Number(0.65), column("bend_rear_knee"), "rad", _LOAD),
    _figure("bend of the spine under load", Number(0.42), column("bend_spine"), "rad", _JOINTS),
    _figure("largest angle of a spine joint", Number(0.2), column("spine_joint_limit"), "rad", "5.1.1"),
)
