"""A line search along an averaged gradient: few expensive directions, each tried at many lengths.

A gradient of a walk costs as much as tens of walks on the engine `c`, so each direction is used as far as it leads. The
estimate's descent direction d, of length 1 at most, and its running sum m <- momentum * m + d (heavy-ball momentum,
Polyak 1964) are both followed to `points` / 2 lengths, spread geometrically about the expected one. The tuning moves to
the best of these points, or stays where none is better. The conditions of Wolfe, by which a line search usually ends,
do not apply: they need the slope along the line, and that of a walk is rough. The expected length becomes the geometric
mean of itself and the chosen length, or 0.6 of itself after a search without gain.
"""

from __future__ import annotations

import dataclasses
from typing import Final, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nermo_mjx.robot.quantity import ParameterError

#: Lengths tried, from the least to the most, in units of the expected one.
_LEAST, _MOST = 2.0**-3, 2.0**2
#: What becomes of the expected length after a search without gain, and its limits, in coordinates u.
_SHRINKS: Final = 0.6
_LIMITS: Final = (0.1, 4.0)


class LineState(NamedTuple):
    """State of the search of one start.

    Attributes:
        momentum: m (p,).
        length: the expected one, in coordinates u.
    """

    momentum: Float[Array, " p"]
    length: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class LineSearch:
    """The search; its functions are of one start.

    Attributes:
        points: tried in each iteration, an even number.
        momentum: share of the previous directions that is kept, in [0, 1).
        length: the first expected one, in coordinates u.

    Raises:
        ParameterError: a number that is out of range.

    >>> search = LineSearch(points=4)
    >>> state, there = search.along(search.init(jnp.zeros(2)), jnp.zeros(2), jnp.array([0.0, 2.0]))
    >>> there.shape, bool((there[:, 1] < 0).all())
    ((4, 2), True)
    """

    points: int = 16
    momentum: float = 0.5
    length: float = 1.0

    def __post_init__(self) -> None:
        if self.points != int(self.points) or self.points < 2 or self.points % 2:
            raise ParameterError(f"points is {self.points:g}: allowed is an even number from 2 on")
        if not 0.0 <= self.momentum < 1.0:
            raise ParameterError(f"momentum is {self.momentum:g}: allowed is [0, 1)")
        if not _LIMITS[0] <= self.length <= _LIMITS[1]:
            raise ParameterError(f"length is {self.length:g}: allowed is [{_LIMITS[0]:g}, {_LIMITS[1]:g}]")

    def init(self, u: Float[Array, " p"]) -> LineState:
        """Before the first iteration from a point."""
        return LineState(jnp.zeros_like(u), jnp.asarray(self.length, u.dtype))

    def along(
        self, state: LineState, u: Float[Array, " p"], gradient: Float[Array, " p"]
    ) -> tuple[LineState, Float[Array, "points p"]]:
        """The state with this gradient in its momentum, and the points to be tried.

        Without a gradient, which is then zero, the momentum alone leads on.
        """
        # Directions that disagree, whose mean is short, count less; a derivative that is large at one point, no more.
        momentum = self.momentum * state.momentum - gradient / jnp.maximum(jnp.linalg.norm(gradient), 1.0)
        # The lengths of both directions lie between one another: in the first iteration the directions are the same.
        reach = jnp.geomspace(_LEAST, _MOST, int(self.points), dtype=u.dtype)
        ways = jnp.where(jnp.arange(len(reach))[:, None] % 2, _unit(momentum), -_unit(gradient))
        return state._replace(momentum=momentum), u + state.length * reach[:, None] * ways

    def taken(self, state: LineState, better: Bool[Array, ""], moved: Float[Array, ""]) -> LineState:
        """The state after a move of a length, or after none if no point was better."""
        length = jnp.where(better, jnp.sqrt(state.length * moved), _SHRINKS * state.length)
        return state._replace(length=jnp.clip(length, *_LIMITS))


def _unit(vector: Float[Array, " p"]) -> Float[Array, " p"]:
    """A vector of length 1, or zero."""
    length = jnp.linalg.norm(vector)
    return vector / jnp.where(length > 0, length, 1.0)
