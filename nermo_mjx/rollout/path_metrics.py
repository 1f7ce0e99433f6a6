"""Path error, and the circle that was walked; part of the metrics, with the same interface.

The torso sways by about a centimetre in each gait cycle. So the error is reported twice: at any time, and for the mean
position over a gait cycle, which is the path that the robot walks. A tick in which a cycle ends is split between both
cycles.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.shapes import Array, Scalar, Scalars, Truth

#: The fit of a circle is meaningless for flatter paths: smallest share of the path's spread across its main direction.
FLAT = 1e-5
#: It is also meaningless if the cycles' mean positions spread by less than 0.1 mm: smallest sum of their variances
#: [m^2].
SMALLEST_SPREAD = 1e-8


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PathState:
    """Accumulators of one world.

    Attributes:
        square: integral of the squared cross-track error [m^2 s].
        walked: largest of the cross-track errors' means over whole gait cycles [m].
        error, place, time: integrals over the current cycle of the error and the position (x, y) [m s], and its length
            so far [s].
        cycles, first, second, third: moments of the cycles' mean positions p: their number, p, p p^T, |p|^2 p.
    """

    square: Scalar
    walked: Scalar
    error: Scalar
    place: Float[Array, " 2"]
    time: Scalar
    cycles: Scalar
    first: Float[Array, " 2"]
    second: Float[Array, "2 2"]
    third: Float[Array, " 2"]


def init(position: Float[Array, " 3"]) -> PathState:
    """Accumulators before the first tick; `position` gives the precision."""
    zero, two = jnp.zeros((), position.dtype), jnp.zeros((2,), position.dtype)
    return PathState(
        square=zero, walked=zero, error=zero, place=two, time=zero, cycles=zero, first=two,
        second=jnp.zeros((2, 2), position.dtype), third=two,
    )  # fmt: skip


def update(
    state: PathState,
    place: Float[Array, " 2"],
    error: Scalar,
    weight: Scalar,
    rest: Scalar,
    cycle_ends: Truth,
) -> PathState:
    """Add one tick.

    Args:
        place: position of the torso relative to where measuring began [m].
        error: cross-track error [m].
        weight: length of the measured part of the tick [s].
        rest: the part of it after the end of a gait cycle [s].
        cycle_ends: whether a gait cycle ends in this tick.
    """
    part = weight - rest
    sum_error, sum_place, time = state.error + part * error, state.place + part * place, state.time + part
    per_time = 1.0 / jnp.maximum(time, 1e-9)
    mean, ended = sum_place * per_time, cycle_ends.astype(time.dtype)
    kept = 1.0 - ended
    return PathState(
        square=state.square + weight * error**2,
        walked=jnp.maximum(state.walked, ended * jnp.abs(sum_error) * per_time),
        error=kept * sum_error + rest * error,
        place=kept * sum_place + rest * place,
        time=kept * time + rest,
        cycles=state.cycles + ended,
        first=state.first + ended * mean,
        second=state.second + ended * jnp.outer(mean, mean),
        third=state.third + ended * (mean @ mean) * mean,
    )


def radius(state: PathState) -> Scalar:
    """Radius of the circle fitted to the path walked [m] (algebraic least squares of Kasa, 1976); NaN if flat.

    It is fitted to the cycles' mean positions: the swaying torso would give too small an arc.

    The centre c minimises the variance of |p|^2 - 2 c p, so that 2 cov(p, p) c = cov(p, |p|^2).
    """
    cycles = jnp.maximum(state.cycles, 1.0)
    mean, second, third = state.first / cycles, state.second / cycles, state.third / cycles
    spread = second - jnp.outer(mean, mean)
    square = jnp.trace(second)
    skew = third - square * mean
    determinant, size = jnp.linalg.det(spread), jnp.trace(spread)
    curved = (determinant > FLAT * size**2) & (size > SMALLEST_SPREAD)
    safe = jnp.where(curved, determinant, 1.0)
    adjugate = jnp.stack([spread[::-1, 1] * jnp.array([1.0, -1.0]), spread[::-1, 0] * jnp.array([-1.0, 1.0])])
    centre = 0.5 * adjugate @ skew / safe
    return jnp.where(curved, root(square - 2.0 * centre @ mean + centre @ centre), jnp.nan)


def root(value: Scalars) -> Scalars:
    """Square root; for nonpositive values 0 with a slope of 0, where the plain root's slope is infinite."""
    positive = value > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)
