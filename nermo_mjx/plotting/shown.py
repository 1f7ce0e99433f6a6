"""Values as shown in figures: with a name, a display unit, and values in that unit."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike

_SHOWN_UNITS = {
    "rad": ("deg", 180 / math.pi),
    "m/s": ("mm/s", 1e3),
    "m": ("mm", 1e3),
    "rad/s": ("deg/s", 180 / math.pi),
}


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
        return self.name if self.names else f"{self.name} [{self.unit or 1}]"

    def shown(self, value: float) -> str:
        """One value with its unit, or its name, for a title; a value that is not known is a dash."""
        if self.names or math.isnan(value):
            return self.names[int(value)] if self.names else "–"
        return f"{value + 0.0:.4g} {self.unit}".rstrip()


def shown(name: str, unit: str, values: ArrayLike, *, log: bool = False, side: str = "") -> ShownValues:
    """A column in SI units as a `ShownValues`."""
    unit, factor = _SHOWN_UNITS.get(unit, ("" if unit == "1" else unit, 1.0))
    return ShownValues(name, unit, np.asarray(values, dtype=float) * factor, log, side=side)
