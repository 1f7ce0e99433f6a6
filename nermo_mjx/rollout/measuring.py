"""The measured part of a control tick, and where in it a gait cycle ends.

The warm-up, the run and the gait cycles end between two ticks. If only whole ticks were counted, a metric would jump
whenever a small change of a parameter moves such an end into the next tick, and a gradient would miss it.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import jax.numpy as jnp

from nermo_mjx.rollout.setup import Window
from nermo_mjx.shapes import Scalar, Truth

#: A tick that begins less than this share of its length before the run's end counts as after it: the accuracy of
#: float32 time within two minutes. With this, results do not depend on how far beyond its end a world is simulated for
#: others in its batch.
_ROUNDING: Final = 1e-3


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
    return time - window.end < (1.0 - _ROUNDING) * dt
