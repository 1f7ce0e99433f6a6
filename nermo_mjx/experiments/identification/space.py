"""The search space: the free parameters, their physical bounds, and the unit cube that represents them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np


@dataclasses.dataclass(frozen=True)
class Free:
    """A free parameter.

    Attributes:
        names: model parameters that share the value.
        low, high: physical bounds.
        why: reason for the bounds.
    """

    names: tuple[str, ...]
    low: float
    high: float
    why: str


#: Searched. The sole's contact is not: it is that of the author's own model (time constant 8 ms, damping ratio 2,
#: friction 1.4) with a soft onset, the default of `ModelParameters`. The bounds have physical reasons only.
FREE: Final[dict[str, Free]] = {
    "kp": Free(
        ("servo.kp",), 4.5, 20.0, "stall torque at an error of 2 degrees to 0.45, about twice a hobby servo's dead band"
    ),
    "kv": Free(("servo.kv",), 0.01, 0.3, "stall torque at 16 to 0.5 rad/s"),
    "leg_damping": Free(
        ("damping.knee", "damping.ankle"), 0.002, 0.03, "printed hinges that creep back within a tenth of a second"
    ),
    "spine_damping": Free(("damping.spine",), 0.003, 0.1, "the same, ten times as stiff"),
}
#: Not searched but uncertain: free in the ensemble, where each body has its own.
UNCERTAIN: Final[dict[str, Free]] = {
    "friction": Free(("contact.friction",), 1.0, 1.8, "rubber on a mat, about the author's 1.4"),
    "tail_friction": Free(("contact.tail_friction",), 0.2, 1.0, "printed plastic on a mat, to the author's 1.0"),
}
#: The space of the ensemble.
ALL: Final = FREE | UNCERTAIN

#: Where the search starts: the values of an earlier prototype of this robot.
START: Final[dict[str, float]] = {
    "servo.kp": 6.3,
    "servo.kv": 0.03,
    "damping.knee": 0.005,
    "damping.ankle": 0.005,
    "damping.spine": 0.01,
}
#: Significant digits of a parameter, so that printed and shipped values are the simulated ones.
_DIGITS: Final = 4


def parameters_of(point: np.ndarray, space: Mapping[str, Free] = FREE) -> dict[str, Any]:
    """Model parameters, to four digits, at points (..., d) of the unit cube, whose axes are logarithms in bounds."""
    values: dict[str, Any] = {}
    for axis, free in enumerate(space.values()):
        value = _rounded(free.low * (free.high / free.low) ** np.clip(point[..., axis], 0.0, 1.0))
        values |= dict.fromkeys(free.names, value)
    return values


def point_of(parameters: Mapping[str, float], space: Mapping[str, Free] = FREE) -> np.ndarray:
    """Inverse of `parameters_of`, shape (d,)."""
    return np.array(
        [
            np.clip(math.log(parameters[free.names[0]] / free.low) / math.log(free.high / free.low), 0.0, 1.0)
            for free in space.values()
        ]
    )


def names(space: Mapping[str, Free] = ALL) -> tuple[str, ...]:
    """Every model parameter of a space, in order."""
    return tuple(name for free in space.values() for name in free.names)


def _rounded(value: np.ndarray) -> np.ndarray:
    """To four significant digits, as their decimal text reads."""
    digits = np.vectorize(lambda each: float(f"{each:.{_DIGITS}g}"), otypes=[float])
    return np.asarray(digits(value))
