"""Coordinates in which a search moves: fractions of the bounds, without ends, so that no step leaves them.

A bounded parameter is reflected at its bounds: a coordinate of 1.1 is the share 0.9. A periodic one, whose bounds are
a whole turn apart, comes back at the other side: 1.1 is 0.1.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import qmc

from nermo_mjx.search.spec import Search
from nermo_mjx.sweep.axes import Axis
from nermo_mjx.tune.sections import period_of

#: Share of a period by which written bounds may miss it: 3.14 is meant as pi.
_ROUNDING = 1e-3


class Space:
    """The p coordinates of a search.

    Attributes:
        periodic: which parameters come back to the same place, (p,).
        first: shares of the published gait, as far as the bounds have it, (p,).
    """

    def __init__(self, search: Search) -> None:
        axes, defaults = search.sweep.axes, search.sweep.parameters
        self.dimensions = len(axes)
        self.periodic = np.array([_is_turn(axis) for axis in axes])
        self.first = np.array([_share(axis, float(np.asarray(defaults[axis.name].default))) for axis in axes])
        self._seed = search.sweep.seed

    def shares(self, coordinates: np.ndarray) -> np.ndarray:
        """Shares of the bounds (n, p), in [0, 1], of any coordinates."""
        turned = coordinates - np.floor(coordinates)
        reflected = 1.0 - np.abs(1.0 - np.mod(coordinates, 2.0))
        return np.clip(np.where(self.periodic, turned, reflected), 0.0, 1.0)

    def slope(self, coordinates: np.ndarray) -> np.ndarray:
        """d share / d coordinate (n, p): -1 where a coordinate is reflected an odd number of times, else 1."""
        return np.where(self.periodic | (np.mod(coordinates, 2.0) < 1.0), 1.0, -1.0)

    def spread(self, count: int) -> np.ndarray:
        """Shares to begin with (count, p): the published gait, then points of a scrambled Sobol sequence."""
        points = qmc.Sobol(self.dimensions, rng=np.random.default_rng(self._seed))
        return np.concatenate([self.first[None], points.random_base2(max(count - 1, 1).bit_length())])[:count]


def _is_turn(axis: Axis) -> bool:
    """Whether the bounds of an angle or of a phase are one whole period apart."""
    period = period_of(axis.name)
    low, high = axis.numbers[:2]
    return period is not None and abs(high - low - period) <= _ROUNDING * period


def _share(axis: Axis, value: float) -> float:
    """Where a value stands between the bounds; the nearer bound, if it is beyond."""
    low, high = axis.numbers[:2]
    value = min(max(value, low), high)
    if axis.form.startswith("log"):
        return float(np.log(value / low) / np.log(high / low))
    return (value - low) / (high - low)
