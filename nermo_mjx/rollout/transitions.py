"""Metrics of a run's switches: how far it rolls and slips meanwhile, and when it has its new speed.

The transition lasts from the first switch until a gait cycle after the last one has ended. With v_0 the speed before,
v_1 that after it, t its length and s the way walked in it, the robot is later at its new speed than if it had changed
at once by

    (v_1 t - s) / (v_1 - v_0),

half of the length of a ramp, and the time constant of an exponential approach.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import jax.numpy as jnp

from nermo_mjx.control.schedule import Schedule
from nermo_mjx.shapes import Array, Scalar

#: Share by which speeds must differ for a time between them.
LEAST: Final = 0.05


def span(schedule: Schedule, cycle_rate: Any) -> tuple[Scalar, Scalar]:
    """When the transition begins and ends [s]; `cycle_rate` is that of the world's own parameters [1/s].

    A switch that is not used ends as one at the start would, before any other one with its cycle.
    """
    return schedule.at[0], jnp.max(schedule.at + schedule.blend / cycle_rate) + 1.0 / cycle_rate


def integrals(
    within: tuple[Scalar, Scalar],
    time: Scalar,
    weight: Scalar,
    slid: Scalar,
    loaded: Scalar,
    speed: Scalar,
) -> dict[str, Array]:
    """What a tick adds to the integrals: way that feet slide [m] and time that they are loaded [s] in the transition,
    and time and way before, in and after it (3,) [s, m].

    Args:
        within: see `span`.
        time: at the end of the tick [s].
        weight: measured part of it [s].
        slid, loaded: sums over the feet: speed of those that are loaded [m/s], and how many are.
        speed: of the robot along its way [m/s].
    """
    begin, end = within
    times = weight * jnp.stack([time <= begin, (time > begin) & (time <= end), time > end])
    return {
        "switching_slid": times[1] * slid,
        "switching_loaded": times[1] * loaded,
        "switching_time": times,
        "switching_way": times * speed,
    }


def transition_result(sums: Mapping[str, Array], roll: Scalar) -> dict[str, Scalar]:
    """The metrics of `TRANSITION` from `integrals` and the largest roll; NaN where nothing was measured."""
    time, distance = sums["switching_time"], sums["switching_way"]
    has_time, has_load = time > 0.0, sums["switching_loaded"] > 0.0
    speed_before, _, speed_after = distance / jnp.where(has_time, time, 1.0)
    change = speed_after - speed_before
    differs = has_time.all() & (
        jnp.abs(change) > LEAST * jnp.maximum(jnp.abs(speed_before), jnp.abs(speed_after))
    )
    delay = (speed_after * time[1] - distance[1]) / jnp.where(differs, change, 1.0)
    slip = sums["switching_slid"] / jnp.where(has_load, sums["switching_loaded"], 1.0)
    return {
        "transition_roll": jnp.where(has_time[1], roll, jnp.nan),
        "transition_slip": jnp.where(has_load, slip, jnp.nan),
        "transition_time": jnp.where(differs, delay, jnp.nan),
    }
