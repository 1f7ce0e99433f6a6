"""The measured part of a control tick, and how the path is followed from gait cycle to gait cycle.

The warm-up, the run and the gait cycles end between two ticks. If only whole ticks were counted, a metric would jump
whenever a small change of a parameter moves such an end into the next tick, and a gradient would miss it.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.rollout.setup import Window
from nermo_mjx.shapes import Array, Scalar, Scalars, Truth

#: A tick that begins less than this share of its length before the run's end counts as after it: the accuracy of
#: float32 time within two minutes. With this, results do not depend on how far beyond its end a world is simulated for
#: others in its batch.
_PROGRESS_ROUNDING: Final = 1e-3


class MeasuredPart(NamedTuple):
    """The measured part of a tick.

    Attributes:
        elapsed: measured time until its end [s].
        weight: its length [s]; rest: the part of it that belongs to the next gait cycle [s].
        begin, end: where in the tick measuring begins and ends: 0 is its start, 1 its end; `begin` is negative if it
            began in an earlier tick, and 1 if it has not begun.
        inside: whether any part of the tick is measured.
        cycle_ends: whether a gait cycle ends in it, counted from where measuring began.
        arrived: whether measuring ends with that cycle, since the requested distance is covered.
    """

    elapsed: Scalar
    weight: Scalar
    rest: Scalar
    begin: Scalar
    end: Scalar
    inside: Truth
    cycle_ends: Truth
    arrived: Truth


def measured_part(
    window: Window,
    elapsed: Scalar,
    cycles: Scalar,
    time: Scalar,
    dt: float,
    cycle_rate: Any,
    goes_on: Truth,
    far_enough: Truth,
) -> MeasuredPart:
    """The part of the tick [time - dt, time] that lies in the window.

    Args:
        window: when to measure.
        elapsed: measured time before the tick [s].
        cycles: gait cycles that have ended since measuring began.
        time: at the end of the tick [s].
        dt: length of the tick [s].
        cycle_rate: gait cycles per simulated second.
        goes_on: false once measuring has ended: by a fall, a divergence or the requested distance.
        far_enough: whether the requested distance is covered.
    """
    since = time - window.begin
    # Time is clamped, not accumulated, and the weights are its differences, so they sum to the window to the last
    # digit. `where` instead of `clip`: on a tick's boundary all metrics have one-sided derivatives of the same side.
    limited = jnp.where(time >= window.end, window.end - window.begin, since)
    now = jnp.where(goes_on & (since > 0.0) & begins_in_run(window, time, dt), limited, elapsed)
    inside = now > elapsed

    past = now * cycle_rate - (cycles + 1.0)
    # A window of whole cycles ends with one, whatever the rounding of its ends.
    cycle_ends = inside & (past >= -16 * jnp.finfo(now.dtype).eps * time * cycle_rate)
    rest = jnp.where(cycle_ends, past / jnp.where(cycle_ends, cycle_rate, 1.0), 0.0)
    # A discrete event that is not differentiable: tunings run without a distance.
    arrived = cycle_ends & far_enough
    now, rest = now - jnp.where(arrived, rest, 0.0), jnp.where(arrived, 0.0, rest)
    return MeasuredPart(
        elapsed=now,
        weight=now - elapsed,
        rest=rest,
        begin=jnp.minimum(1.0 - since / dt, 1.0),
        end=1.0 - (since - now) / dt,
        inside=inside,
        cycle_ends=cycle_ends,
        arrived=arrived,
    )


def begins_in_run(window: Window, time: Scalar, dt: float) -> Truth:
    """Whether the tick [time - dt, time] begins before the run's end, which every world of a batch simulates."""
    return time - window.end < (1.0 - _PROGRESS_ROUNDING) * dt


def ticks_until(end: Any, dt: float) -> np.ndarray:
    """Control ticks of a run that ends then [s], after which no metric of it changes.

    >>> ticks_until([3.25, 3.245], 0.01)
    array([326, 326])

    A tick is measured one tick later, when its readings have arrived. Where float32 time is coarser than `_ROUNDING` of
    a tick, one more may begin before the end, and is simulated, too.
    """
    last = np.asarray(end, float) / dt
    coarse = 2.0 * jnp.finfo(jax.dtypes.canonicalize_dtype(float)).eps * last
    return np.asarray(np.ceil(last - _PROGRESS_ROUNDING + coarse).astype(int) + 1)


# ---
# Path error, and the circle that was walked; part of the metrics, with the same interface.
#
# The torso sways by about a centimetre in each gait cycle. So the error is reported twice: at any time, and for the
# mean position over a gait cycle, which is the path that the robot walks. A tick in which a cycle ends is split between
# both cycles.


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
        walked: largest of the cross-track errors' means over whole gait cycles [m].
        swayed: integral over these cycles of the squared error about each one's mean [m^2 s]; cycled: their length [s].
        square: integral over the current cycle of the squared error [m^2 s].
        error, place, time: integrals over the current cycle of the error and the position (x, y) [m s], and its length
            so far [s].
        cycles, first, second, third: moments of the cycles' mean positions p: their number, p, p p^T, |p|^2 p.
    """

    walked: Scalar
    swayed: Scalar
    cycled: Scalar
    square: Scalar
    error: Scalar
    place: Float[Array, " 2"]
    time: Scalar
    cycles: Scalar
    first: Float[Array, " 2"]
    second: Float[Array, "2 2"]
    third: Float[Array, " 2"]


def init_path(position: Float[Array, " 3"]) -> PathState:
    """Accumulators before the first tick; `position` gives the precision."""
    zero, two = jnp.zeros((), position.dtype), jnp.zeros((2,), position.dtype)
    return PathState(
        walked=zero,
        swayed=zero,
        cycled=zero,
        square=zero,
        error=zero,
        place=two,
        time=zero,
        cycles=zero,
        first=two,
        second=jnp.zeros((2, 2), position.dtype),
        third=two,
    )


def update_path(
    state: PathState,
    position: Float[Array, " 2"],
    error: Scalar,
    weight: Scalar,
    rest_time: Scalar,
    cycle_ends: Truth,
) -> PathState:
    """Add one tick.

    Args:
        position: position of the torso relative to where measuring began [m].
        error: cross-track error [m].
        weight: length of the measured part of the tick [s].
        rest_time: the part of it after the end of a gait cycle [s].
        cycle_ends: whether a gait cycle ends in this tick.
    """
    part = weight - rest_time
    sum_error = state.error + part * error
    sum_place = state.place + part * position
    time = state.time + part
    sum_square, per_time = state.square + part * error**2, 1.0 / jnp.maximum(time, 1e-9)
    mean, is_cycle_end = sum_place * per_time, cycle_ends.astype(time.dtype)
    is_open = 1.0 - is_cycle_end
    return PathState(
        walked=jnp.maximum(state.walked, is_cycle_end * jnp.abs(sum_error) * per_time),
        swayed=state.swayed + is_cycle_end * (sum_square - sum_error**2 * per_time),
        cycled=state.cycled + is_cycle_end * time,
        square=is_open * sum_square + rest_time * error**2,
        error=is_open * sum_error + rest_time * error,
        place=is_open * sum_place + rest_time * position,
        time=is_open * time + rest_time,
        cycles=state.cycles + is_cycle_end,
        first=state.first + is_cycle_end * mean,
        second=state.second + is_cycle_end * jnp.outer(mean, mean),
        third=state.third + is_cycle_end * (mean @ mean) * mean,
    )


def noise(state: PathState) -> Scalar:
    """Positional noise of the path (6.2.4): root mean square of the error about its mean over each gait cycle [m]; NaN
    before the first cycle's end."""
    ended = state.cycled > 0.0
    return jnp.where(ended, root(state.swayed / jnp.where(ended, state.cycled, 1.0)), jnp.nan)


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
    adjugate = jnp.stack(
        [spread[::-1, 1] * jnp.array([1.0, -1.0]), spread[::-1, 0] * jnp.array([-1.0, 1.0])]
    )
    centre = 0.5 * adjugate @ skew / safe
    return jnp.where(curved, root(square - 2.0 * centre @ mean + centre @ centre), jnp.nan)


def root(value: Scalars) -> Scalars:
    """Square root; for nonpositive values 0 with a slope of 0, where the plain root's slope is infinite."""
    positive = value > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)
