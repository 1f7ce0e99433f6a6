"""How well a path was followed, and the circle that was walked; part of the metrics, in the same form.

The torso sways by about a centimetre in each gait cycle. So an error is given twice: the largest of any moment, and
the largest of the mean position of a gait cycle, which is where the robot walks.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

#: Flatter than this, the fit of a circle means nothing: smallest share of the path's spread across its main direction.
FLAT = 1e-5


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PathState:
    """Accumulators of one world.

    Attributes:
        peak: largest cross-track error of any moment [m].
        walked: largest of the cross-track errors' means over whole gait cycles [m].
        error, place, time: integrals over the present cycle of the error and the position (x, y) [m s], and its length
            until now [s].
        weight, first, second, third: moments of the cycles' mean positions p: their number, p, p p^T, |p|^2 p.
    """

    peak: Float[Array, ""]
    walked: Float[Array, ""]
    error: Float[Array, ""]
    place: Float[Array, " 2"]
    time: Float[Array, ""]
    weight: Float[Array, ""]
    first: Float[Array, " 2"]
    second: Float[Array, "2 2"]
    third: Float[Array, " 2"]


def init(position: Float[Array, " 3"]) -> PathState:
    """Accumulators before the first tick; `position` gives the precision."""
    zero, two = jnp.zeros((), position.dtype), jnp.zeros((2,), position.dtype)
    return PathState(
        peak=zero, walked=zero, error=zero, place=two, time=zero, weight=zero, first=two,
        second=jnp.zeros((2, 2), position.dtype), third=two,
    )  # fmt: skip


def update(
    state: PathState,
    place: Float[Array, " 2"],
    error: Float[Array, ""],
    dt: Float[Array, ""],
    cycle_ends: Bool[Array, ""],
) -> PathState:
    """Add one tick.

    Args:
        place: where the torso is, counted from where measuring began [m].
        error: cross-track error [m].
        dt: length of the tick, 0 while nothing is measured [s].
        cycle_ends: whether a gait cycle ends with this tick.
    """
    sum_error, sum_place, time = state.error + dt * error, state.place + dt * place, state.time + dt
    per_time = 1.0 / jnp.maximum(time, 1e-9)
    mean, ended = sum_place * per_time, cycle_ends.astype(time.dtype)
    kept = 1.0 - ended
    return PathState(
        peak=jnp.where(dt > 0, jnp.maximum(state.peak, jnp.abs(error)), state.peak),
        walked=jnp.maximum(state.walked, ended * jnp.abs(sum_error) * per_time),
        error=kept * sum_error,
        place=kept * sum_place,
        time=kept * time,
        weight=state.weight + ended,
        first=state.first + ended * mean,
        second=state.second + ended * jnp.outer(mean, mean),
        third=state.third + ended * (mean @ mean) * mean,
    )


def radius(state: PathState) -> Float[Array, ""]:
    """Radius of the circle fitted to the way walked [m] (algebraic least squares of Kasa, 1976); NaN if flat.

    To the cycles' mean positions: fitted to the swaying torso, an arc would come out too small.

    The centre c minimises the variance of |p|^2 - 2 c p, so that 2 cov(p, p) c = cov(p, |p|^2).
    """
    weight = jnp.maximum(state.weight, 1e-9)
    mean, second, third = state.first / weight, state.second / weight, state.third / weight
    spread = second - jnp.outer(mean, mean)
    square = jnp.trace(second)
    skew = third - square * mean
    determinant, size = jnp.linalg.det(spread), jnp.trace(spread)
    flat = determinant < FLAT * size**2
    safe = jnp.where(flat, 1.0, determinant)
    adjugate = jnp.stack([spread[::-1, 1] * jnp.array([1.0, -1.0]), spread[::-1, 0] * jnp.array([-1.0, 1.0])])
    centre = 0.5 * adjugate @ skew / safe
    squared = square - 2.0 * centre @ mean + centre @ centre
    return jnp.where(flat, jnp.nan, jnp.sqrt(jnp.maximum(squared, 0.0)))
