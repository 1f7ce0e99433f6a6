"""Saltelli's design: the sample from which Sobol indices are found, by SALib.

SALib is a dependency because its designs and estimators match each other, and it provides the intervals.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import AfterValidator, Field

from nermo_mjx.specs.fields import Fields, Refused
from nermo_mjx.specs.values import Whole

_MOST_POINTS = 2**20


def _power_of_two(points: int) -> int:
    if points & (points - 1):
        near = 2 ** (points.bit_length() - 1)
        raise Refused(f"is {points}: expected a power of two, such as {near} or {2 * near}, because no other number of "
                      "points of a Sobol sequence is balanced.")  # fmt: skip
    return points


class Saltelli(Fields):
    """The sampler `saltelli` of a sweep file: a number of points, or a mapping."""

    what: ClassVar = "a field of saltelli"
    expected: ClassVar = "a power of two, or {points: N, second_order: true}"
    example: ClassVar = "points: N, a power of two"
    short: ClassVar = ({"type": "integer", "minimum": 2, "maximum": _MOST_POINTS},)
    points: Annotated[int, Whole(2, _MOST_POINTS), AfterValidator(_power_of_two)] = Field(
        description="points of a Sobol sequence, a power of two; with p parameters they make points x (p + 2) variants"
    )
    second_order: bool = Field(False, description="indices of pairs, too, from points x (2 p + 2) variants")

    @classmethod
    def written_out(cls, given: Any) -> Any:
        return {"points": given} if isinstance(given, int | float) and not isinstance(given, bool) else given


def saltelli_size(parameters: int, second_order: bool) -> int:
    """Variants for each point of the sequence."""
    return 2 * parameters + 2 if second_order else parameters + 2


def saltelli_points(parameters: int, points: int, second_order: bool, seed: int) -> np.ndarray:
    """The design in the unit cube, (points x `saltelli_size`, parameters).

    Twice as many points begin with the same ones. Each point gives a block of rows: itself, itself with one parameter
    after the other from a second point, and that second point (Saltelli et al., Comput. Phys. Commun. 181, 2010).
    """
    from SALib.sample import sobol  # takes a second or more, as it brings pandas

    design: np.ndarray = sobol.sample(unit_problem(parameters), points, calc_second_order=second_order, seed=seed)
    return design


def unit_problem(parameters: int) -> dict[str, Any]:
    """The unit cube as SALib describes it."""
    return {"num_vars": parameters, "names": [f"x{i}" for i in range(parameters)], "bounds": [[0, 1]] * parameters}
