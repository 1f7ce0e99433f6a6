"""Values as shown in figures: with a name, a display unit, and values in that unit."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from nermo_mjx.robot.parameters import GAIT_CODES

_SHOWN_UNITS = {
    "rad": ("deg", 180 / math.pi),
    "m/s": ("mm/s", 1e3),
    "m": ("mm", 1e3),
    "rad/s": ("deg/s", 180 / math.pi),
}
_STATISTICS = {
    "std": "standard deviation",
    "mean": "mean",
    "min": "minimum",
    "max": "maximum",
    "rms": "root mean square",
}


def spoken(name: str) -> str:
    """The name of a column, or of a choice in it, in words, as titles and axes have it.

    >>> spoken("roll_std"), spoken("spine.phase"), spoken("cost_of_transport"), spoken("lateral_walk")
    ('roll, standard deviation', 'spine phase', 'mechanical cost of transport', 'lateral walk')
    """
    name = GAIT_CODES.get(name, name)  # of tables that former versions wrote
    if name == "cost_of_transport":
        return "mechanical cost of transport"
    stem, _, last = name.rpartition("_")
    words = f"{stem}, {_STATISTICS[last]}" if stem and last in _STATISTICS else name
    return re.sub(r"(?<=[a-z0-9])[._](?=[a-z])", " ", words)


def titled(name: str) -> str:
    """The same as a title begins with it.

    >>> titled("electrical_cost_of_transport")
    'Electrical cost of transport'
    """
    words = spoken(name)
    return words[:1].upper() + words[1:]


@dataclasses.dataclass(frozen=True)
class ShownValues:
    """Values of one column as a figure shows them: angles in degrees, lengths in mm, speeds in mm/s.

    Attributes:
        name, unit: what the axis is called; the unit is empty for a pure number.
        values: (n,), in that unit.
        log: whether the axis is logarithmic.
        names: of a choice among names, these; the values are places among them.
        side: which values of a metric are better, `max`, `min` or `nearest zero`; empty where none are.
    """

    name: str
    unit: str
    values: np.ndarray
    log: bool = False
    names: tuple[str, ...] = ()
    side: str = ""

    @property
    def label(self) -> str:
        """Name and unit for an axis; a pure number has the unit 1, a choice none."""
        return self.spoken if self.names else f"{self.spoken} [{self.unit or 1}]"

    @property
    def spoken(self) -> str:
        """The name in words."""
        return spoken(self.name)

    def shown(self, value: float) -> str:
        """One value with its unit, or its name, for a title; a value that is not known is a dash."""
        if self.names or math.isnan(value):
            return spoken(self.names[int(value)]) if self.names else "–"
        return f"{value + 0.0:.4g} {self.unit}".rstrip()


def shown(
    name: str, unit: str, values: ArrayLike, *, log: bool = False, side: str = ""
) -> ShownValues:
    """A column in SI units as a `ShownValues`."""
    unit, factor = _SHOWN_UNITS.get(unit, ("" if unit == "1" else unit, 1.0))
    return ShownValues(name, unit, np.asarray(values, dtype=float) * factor, log, side=side)


#: Of all intervals.
CONFIDENCE_LEVEL: Final = 0.95


def half_width(std: np.ndarray | float, count: np.ndarray | int) -> np.ndarray:
    """Half the 95 % interval of a mean, by Student's t; NaN of fewer than two values, whose spread is unknown.

    >>> round(float(half_width(1.0, 4)), 3)
    1.591
    """
    from scipy.special import stdtrit

    freedom = np.where(np.asarray(count) > 1, np.asarray(count) - 1.0, np.nan)
    return np.asarray(stdtrit(freedom, (1 + CONFIDENCE_LEVEL) / 2) * std / np.sqrt(freedom + 1))


def cost(side: str, values: np.ndarray) -> np.ndarray:
    """Values of a metric with this better direction so that less is better; without one, less where it is higher."""
    return {"": -values, "max": -values, "min": values, "nearest zero": np.abs(values)}[side]
