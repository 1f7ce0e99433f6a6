"""Maze: section 6.2.4, and the hardware's, 7.1; no decision was made with it in view."""

from __future__ import annotations

import operator
from typing import Final

from nermo_mjx.experiments.judgement import Effect, Same, gain
from nermo_mjx.experiments.judgement import Number as Size
from nermo_mjx.experiments.published.measure import (
    HARDWARE,
    Number,
    below,
    clock,
    column,
    degrees,
    figures_of,
    quotient,
    whether,
)


def _time(spine: bool) -> Number:
    time = column("time", spine=spine)
    return lambda outcome, profile: time(outcome, profile) / clock(profile)


def _speed(spine: bool) -> Number:
    speed = column("mean_speed", spine=spine)
    return lambda outcome, profile: 1e3 * clock(profile) * speed(outcome, profile)


def _over(name: str) -> Number:
    """With the spine over without."""
    return quotient(column(name, spine=True), column(name, spine=False))


_PATH: Final = "6.2.4, on another path of about 5 m"
_SPINE: Final = {False: "without spine", True: "with spine"}
_STD: Final = {
    ("roll", False): 3.09, ("roll", True): 4.13, ("pitch", False): 0.75, ("pitch", True): 1.25,
}  # fmt: skip
_figure: Final = figures_of("predicted", "6.2.4")
FIGURES: Final = (
    *(
        _figure(f"end reached {name}", Same(True), whether(lambda share: share == 1.0, column("reached", spine=spine)))
        for spine, name in _SPINE.items()
    ),
    *(
        _figure(f"no box touched {name}", Same(True), whether(operator.not_, column("touched", spine=spine)))
        for spine, name in _SPINE.items()
    ),
    _figure("time without spine", Size(85.7), _time(False), "s", _PATH),
    _figure("time with spine", Size(61.1), _time(True), "s", _PATH),
    _figure("time with spine over without", Effect(0.713, digits=3), quotient(_time(True), _time(False))),
    _figure("mean speed without spine", Size(60.0), _speed(False), "mm/s"),
    _figure("mean speed with spine", Size(82.0), _speed(True), "mm/s"),
    _figure("mean speed with spine over without", Effect(1.37), _over("mean_speed")),
    *(
        _figure(
            f"{angle} std higher with the spine", Same(True),
            whether(operator.gt, *(column(f"{angle}_std", spine=spine) for spine in (True, False))),
        )
        for angle in ("roll", "pitch")
    ),
    *(
        figure
        for angle, ratio in (("roll", 1.34), ("pitch", 1.67))
        for figure in (
            *(
                _figure(f"{angle} std {name}", Size(_STD[angle, spine]), degrees(column(f"{angle}_std", spine=spine)),
                        "deg")
                for spine, name in _SPINE.items()
            ),
            _figure(f"{angle} std with spine over without", Effect(ratio), _over(f"{angle}_std")),
        )
    ),
    _figure("hardware: time saved with the spine", gain(0.32), below(_time(True), _time(False)), source=HARDWARE),
)  # fmt: skip
