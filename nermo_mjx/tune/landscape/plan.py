"""Which points a landscape is measured at: a line along each parameter, and pairs of points about some of them."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from nermo_mjx.tune.objective import FURTHEST
from nermo_mjx.tune.spec import Tuning

#: Widths of the secants, as fractions of a parameter's range: from those that show whether a derivative is correct to
#: those that show whether it is useful.
WIDTHS: Final = (0.001, 0.005, 0.02, 0.05, 0.1)
#: Number of points of each line around which secants are taken.
CENTRES: Final = 9
#: Fraction of a line left free at both ends, so that the widest secants fit.
_MARGIN: Final = 0.25


@dataclasses.dataclass(frozen=True)
class Plan:
    """The n points of a landscape of p parameters, line by line; of each line first its own points, from low to high.

    Attributes:
        points: (n, p).
        line: which parameter changes (n,).
        centre: of a secant's end: which point of its line is in the middle (n,); -1 for a point of the line itself.
        width: of a secant's end: share of the range (n,); 0 for a point of the line.
        side: of a secant's end: -1 or 1 (n,); 0 for a point of the line.
    """

    points: Float[np.ndarray, "n p"]
    line: Int[np.ndarray, " n"]
    centre: Int[np.ndarray, " n"]
    width: Float[np.ndarray, " n"]
    side: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.points)


def plan(tuning: Tuning, points: int, span: float) -> Plan:
    """Lines through the given start over the bounds.

    Args:
        points: of each line, ends included.
        span: length of each line, as a fraction of the bounds; shorter ones lie about the start.
    """
    start = np.array([each.start for each in tuning.tuned])
    rows: list[tuple[float, int, int, float, int]] = []
    for i, each in enumerate(tuning.tuned):
        bounds = each.high - each.low
        # Like a tuner's points, these stop short of the bounds.
        low, high = each.low + FURTHEST * bounds, each.high - FURTHEST * bounds
        length = span * (high - low)
        first = min(max(each.start - length / 2, low), high - length)
        line = np.linspace(first, first + length, points)
        rows += [(x, i, -1, 0.0, 0) for x in line]
        for middle in _centres(line, 0.5 * max(WIDTHS) * bounds):
            for share in WIDTHS:
                ends = [line[middle] + sign * 0.5 * share * bounds for sign in (-1, 1)]
                if low <= ends[0] and ends[1] <= high:
                    rows += [(x, i, middle, share, sign) for x, sign in zip(ends, (-1, 1), strict=True)]
    x, which, centre, width, side = map(np.array, zip(*rows, strict=True))
    where = np.tile(start, (len(rows), 1))
    where[np.arange(len(rows)), which] = x
    return Plan(where, which, centre, width, side)


def _centres(line: Float[np.ndarray, " N"], reach: float) -> list[int]:
    """Positions in a line, evenly spread, as far from its ends as the widest secants reach."""
    margin = min(reach, _MARGIN * (line[-1] - line[0]))
    inner = np.flatnonzero((line - line[0] >= margin) & (line[-1] - line >= margin))
    return np.unique(inner[np.linspace(0, len(inner) - 1, CENTRES).round().astype(int)]).tolist()
