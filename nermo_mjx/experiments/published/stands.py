"""Test stands: the finite elements' load case with chains of hinges (A.1), and what Tables 5.1, 5.2 and 5.4 are about.

The values of these tables are not among this project's sources, so that what is measured stands alone and is not
judged: force, speed and work of the routings (5.1, 5.2), and of lateral, vertical and combined bends (5.4).
"""

from __future__ import annotations

from typing import Final

from nermo_mjx.experiments.body import TORQUE
from nermo_mjx.experiments.judgement import Number, Shown
from nermo_mjx.experiments.published.measure import column, figures_of
from nermo_mjx.experiments.stands import leg, spine
from nermo_mjx.experiments.stands.stand import HINGES

_LOAD: Final = f"A.1: finite elements, {TORQUE:g} N m"
_MISSING: Final = "the published values are not among this project's sources"
#: Measured column -> what it is called, its factor and unit.
_LEG: Final = {
    "force": ("pull that the foot withstands", 1.0, "N"),
    "speed": ("speed of the rising foot", 1e3, "mm/s"),
    "work": ("work of a swing", 1e3, "mJ"),
    "coupling": ("bend of the knee per swing of the hip", 1.0, ""),
}
_SPINE: Final = {
    "force": ("force that the hip withstands", 1.0, "N"),
    "speed": ("speed of the hip", 1e3, "mm/s"),
    "work": ("work of a bend", 1e3, "mJ"),
    "range": ("range of the hip", 1e3, "mm"),
}
_figure: Final = figures_of("chosen", _LOAD)
LEG_FIGURES: Final = (
    *(
        _figure(f"bend of a {pair} knee under load, {HINGES[-1]} hinges", Number(angle),
                column("bend", pair=pair, routing="type3", hinges=HINGES[-1]), "rad")
        for pair, angle in (("front", 0.95), ("rear", 0.65))
    ),
    *(
        _figure(f"{called}, {pair} leg, {case['routing']}", Shown(), column(name, scale, **case), unit,
                f"Tables 5.1 and 5.2: {_MISSING}")
        for name, (called, scale, unit) in _LEG.items()
        for pair in ("front", "rear")
        for case in leg.CASES
        if case["pair"] == pair and case["hinges"] == 1
    ),
)  # fmt: skip
SPINE_FIGURES: Final = (
    _figure(f"bend of the spine under load, {HINGES[-1]} hinges", Number(0.42),
            column("bend", robot="nermo_lite", hinges=HINGES[-1]), "rad",
            f'{_LOAD}. Published as "spine joint": one of 1.2 N m/rad bends by 0.104, so that it can only be all four'),
    *(
        _figure(f"{called}, {plane}", Shown(), column(name, scale, robot="nermo_41", plane=plane), unit,
                f"Table 5.4: {_MISSING}; on Nermo 4.1")
        for name, (called, scale, unit) in _SPINE.items()
        for plane in spine.PLANES
    ),
)  # fmt: skip
