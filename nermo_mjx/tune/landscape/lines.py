"""The lines of a landscape: values and exact slopes along a parameter, and how well secants of each width agree."""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float

from nermo_mjx.tune.landscape.plan import WIDTHS
from nermo_mjx.tune.spec import Tuned, Tuning

#: Neighbouring points of a line to which a parabola is fitted, to separate ripple from shape.
_WINDOW: Final = 7


@dataclasses.dataclass(frozen=True)
class Secants:
    """Secants of one width on one line, one per centre; those with an end at which the robot fell are left out.

    Attributes:
        share: width as a fraction of the parameter's bounds.
        width: distance of the ends, in the parameter's unit.
        centre: middles (k,), in the parameter's unit.
        secant: slopes of the secants (k,).
        slope: exact slopes at the middles (k,).
        ripple: root mean square, over the centres, of the residual standard deviation of a parabola through all points
            within the width; NaN where there are too few of them.
    """

    share: float
    width: float
    centre: Float[np.ndarray, " k"]
    secant: Float[np.ndarray, " k"]
    slope: Float[np.ndarray, " k"]
    ripple: float

    @property
    def error(self) -> float:
        """Median of |slope - secant| / |secant|; NaN without secants."""
        if not len(self.secant):
            return math.nan
        apart, size = np.abs(self.slope - self.secant), np.abs(self.secant)
        # A flat place, where both are 0, is not an error.
        relative = np.divide(apart, size, out=np.where(apart > 0, np.inf, 0.0), where=size > 0)
        return float(np.median(relative))

    @property
    def sign_agreement(self) -> float:
        """Share of the centres where slope and secant have one sign; NaN without secants."""
        return float(np.mean(np.sign(self.slope) == np.sign(self.secant))) if len(self.secant) else math.nan


@dataclasses.dataclass(frozen=True)
class Slice:
    """One parameter's line through the start.

    Attributes:
        tuned: the parameter.
        x: its values (N,), increasing; value, slope: objective and its exact derivative (N,), NaN where the robot fell.
        secants: of each width.
    """

    tuned: Tuned
    x: Float[np.ndarray, " N"]
    value: Float[np.ndarray, " N"]
    slope: Float[np.ndarray, " N"]
    secants: tuple[Secants, ...]

    @property
    def ok(self) -> Bool[np.ndarray, " N"]:
        """Where the robot walked to the end."""
        return np.isfinite(self.value)

    @property
    def ripple(self) -> float:
        """Like that of the secants, of parabolas through neighbouring points of the line."""
        windows = [slice(i, i + _WINDOW) for i in range(len(self.x) - _WINDOW + 1)]
        return _root_mean_square([_residual(self.x[part], self.value[part]) for part in windows])


def lines_of(tuning: Tuning, table: pa.Table) -> list[Slice]:
    """The lines of a landscape's table, one a tuned parameter."""
    names = np.array(table.column("line").to_pylist())
    columns = {name: table.column(name).to_numpy() for name in ("centre", "width", "side", "objective")}
    lines = []
    for tuned in tuning.tuned:
        here = names == tuned.name
        of_line = here & (columns["side"] == 0)
        x, slope = (table.column(name).to_numpy() for name in (tuned.name, f"gradient.{tuned.name}"))
        line = Slice(tuned, x[of_line], columns["objective"][of_line], slope[of_line], ())
        ends = {name: column[here & ~of_line] for name, column in (columns | {"x": x}).items()}
        secants = tuple(_secants(line, ends, share) for share in WIDTHS)
        lines.append(dataclasses.replace(line, secants=secants))
    return lines


def _secants(line: Slice, ends: dict[str, np.ndarray], share: float) -> Secants:
    """The secants of one width from the ends (m,) of all of a line's secants."""
    found, ripple = [], []
    bounds = line.tuned.high - line.tuned.low
    for centre in np.unique(ends["centre"]).tolist():
        own = ends["centre"] == centre
        low, high = (own & (ends["width"] == share) & (ends["side"] == side) for side in (-1, 1))
        if not low.any() or not line.ok[centre] or not np.isfinite(ends["objective"][low | high]).all():
            continue
        rise, run = ((ends[name][high] - ends[name][low]).item() for name in ("objective", "x"))
        found.append((line.x[centre], rise / run, line.slope[centre]))
        near = own & (ends["width"] <= share)
        ripple.append(_residual(np.append(ends["x"][near], line.x[centre]),
                                np.append(ends["objective"][near], line.value[centre])))  # fmt: skip
    centre_x, secant, slope = np.array(found, float).reshape(-1, 3).T
    return Secants(share, share * bounds, centre_x, secant, slope, _root_mean_square(ripple))


def _residual(x: Float[np.ndarray, " k"], value: Float[np.ndarray, " k"]) -> float:
    """Standard deviation of values about their parabola; NaN from less than five, or where the robot fell."""
    if len(x) < 5 or not np.isfinite(value).all():
        return math.nan
    scaled = (x - x.mean()) / np.ptp(x)
    _, residual, *_ = np.polyfit(scaled, value, 2, full=True)
    return math.sqrt(float(residual.sum()) / (len(x) - 3))


def _root_mean_square(values: list[float]) -> float:
    good = np.array(values)[np.isfinite(values)] if values else np.array([])
    return float(np.sqrt(np.mean(good**2))) if len(good) else math.nan
