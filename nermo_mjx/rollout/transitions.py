"""Metrics of a run's switches: how far it rolls and slips meanwhile, and when it has its new speed.

The transition lasts from the first switch until a gait cycle after the last one has ended. With v_0 the speed before,
v_1 that after it, t its length and s the way walked in it, the robot is later at its new speed than if it had changed
at once by

    (v_1 t - s) / (v_1 - v_0),

half of the length of a ramp, and the time constant of an exponential approach.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.control.schedule import Schedule
from nermo_mjx.rollout.own_metrics import Metric
from nermo_mjx.shapes import Array, Scalar

#: Share by which speeds must differ for a time between them.
LEAST: Final = 0.05
TRANSITION: Final[dict[str, Metric]] = {
    "transition_roll": Metric("rad", "largest roll to either side while switches act, and a cycle longer", "low"),
    "transition_slip": Metric("m/s", "mean horizontal speed of loaded feet in that time", "low"),
    "transition_time": Metric(
        "s", "how much later it has its new speed than at once; NaN if it changes by less than 5 %", "low"
    ),
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TransitionState:
    """Accumulators.

    Attributes:
        roll: largest so far [rad].
        slid, loaded: way that feet slid [m] and time that they were loaded [s].
        time, way: measured before, during and after the transition (3,) [s, m].
    """

    roll: Scalar
    slid: Scalar
    loaded: Scalar
    time: Float[Array, " 3"]
    way: Float[Array, " 3"]


def init(zero: Scalar) -> TransitionState:
    """Before the first tick."""
    three = jnp.zeros(3, zero.dtype)
    return TransitionState(zero, zero, zero, three, three)


def span(schedule: Schedule, cycle_rate: Any) -> tuple[Scalar, Scalar]:
    """When the transition begins and ends [s]; `cycle_rate` is that of the world's own parameters [1/s].

    A switch that is not used ends as one at the start would, before any other one with its cycle.
    """
    return schedule.at[0], jnp.max(schedule.at + schedule.blend / cycle_rate) + 1.0 / cycle_rate


def update(
    state: TransitionState, within: tuple[Scalar, Scalar], time: Scalar, weight: Scalar, roll: Scalar, slid: Scalar,
    loaded: Scalar, speed: Scalar,
) -> TransitionState:  # fmt: skip
    """Add a tick.

    Args:
        state: so far.
        within: see `span`.
        time: at the end of the tick [s].
        weight: measured part of it [s].
        roll: of the torso [rad].
        slid, loaded: sums over the feet: speed of those that are loaded [m/s], and how many are.
        speed: of the robot along its way [m/s].
    """
    begin, end = within
    weights = weight * jnp.stack([time <= begin, (time > begin) & (time <= end), time > end])
    return TransitionState(
        roll=jnp.maximum(state.roll, jnp.where(weights[1] > 0.0, jnp.abs(roll), 0.0)),
        slid=state.slid + weights[1] * slid,
        loaded=state.loaded + weights[1] * loaded,
        time=state.time + weights,
        way=state.way + weights * speed,
    )


def result(state: TransitionState) -> dict[str, Scalar]:
    """The metrics, named as in `TRANSITION`; NaN where nothing was measured."""
    there = state.time > 0.0
    before, _, after = state.way / jnp.where(there, state.time, 1.0)
    change = after - before
    differs = there.all() & (jnp.abs(change) > LEAST * jnp.maximum(jnp.abs(before), jnp.abs(after)))
    late = (after * state.time[1] - state.way[1]) / jnp.where(differs, change, 1.0)
    some = state.loaded > 0.0
    return {
        "transition_roll": jnp.where(there[1], state.roll, jnp.nan),
        "transition_slip": jnp.where(some, state.slid / jnp.where(some, state.loaded, 1.0), jnp.nan),
        "transition_time": jnp.where(differs, late, jnp.nan),
    }
