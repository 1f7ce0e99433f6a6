"""Strides as walked: from a foot's touch-down to its next one, accumulated during the run like all metrics.

A foot is down once it has been loaded for `SETTLED` of a gait cycle without a break, and up once it has been unloaded
for as long; its touch-down is its first contact before that. So a foot that bounces as it lands, or scrapes the ground
as it swings, has one touch-down. Only strides that begin and end while the run is measured count. Custom metrics, whose
values are not kept, begin anew where the foot has settled.

A touch-down is an event at a tick: which tick it is cannot be differentiated, what is summed between two of them can.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from nermo_mjx.robot import LIMBS, Sensors
from nermo_mjx.rollout import reduction
from nermo_mjx.rollout.custom_metrics import OwnMetric
from nermo_mjx.rollout.path_metrics import MeasuredPart, root
from nermo_mjx.shapes import Array, Scalar, Truth

#: Share of a gait cycle for which a foot is loaded, or unloaded, before it counts as down, or up. Soles that scrape the
#: ground in mid-swing, as in the lateral walk, do so for up to 0.08 of a cycle.
SETTLED: Final = 0.1
#: Strides of a foot of which a spread is a number.
SPREAD_STRIDES: Final = 3


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Spread:
    """Welford's running moments over strides, of any shape.

    Attributes:
        count: strides so far.
        mean, square: their mean, and the sum of squared deviations.
    """

    count: Array
    mean: Array
    square: Array

    def add(self, value: Array, complete: Array) -> Spread:
        """With a further value where a stride is complete."""
        count = self.count + complete
        deviation = jnp.where(complete, value - self.mean, 0.0)
        mean = self.mean + deviation / jnp.maximum(count, 1.0)
        return Spread(count, mean, self.square + deviation * jnp.where(complete, value - mean, 0.0))

    def std(self) -> Array:
        """Sample standard deviation; NaN with fewer than `SPREAD_STRIDES` strides."""
        enough = self.count >= SPREAD_STRIDES
        return jnp.where(
            enough, root(self.square / jnp.where(enough, self.count - 1.0, 1.0)), jnp.nan
        )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class StrideState:
    """Accumulators of one world.

    Attributes:
        down: feet that are down.
        other_seconds: for how long each has been otherwise [s].
        unloaded_seconds: for how long each has been unloaded [s].
        begun: feet whose touch-down was seen.
        lands: feet that are up, and may be landing; `landing` is `since` at their first contact.
        since: (time [s], way of the torso [m], time loaded [s]) since each foot's last touch-down.
        strides: the same of whole strides.
        own: accumulators of k custom metrics since their foot last settled; None without any.
        own_time: how long ago that was [s].
        own_strides: their values of whole strides.
    """

    down: Bool[Array, " 4"]
    other_seconds: Float[Array, " 4"]
    unloaded_seconds: Float[Array, " 4"]
    begun: Bool[Array, " 4"]
    lands: Bool[Array, " 4"]
    landing: Float[Array, "4 3"]
    since: Float[Array, "4 3"]
    strides: Spread
    own: reduction.OwnState | None
    own_time: Float[Array, " k"]
    own_strides: Spread | None


def init_strides(custom: tuple[OwnMetric, ...], sensors: Sensors) -> StrideState:
    """Accumulators before the first tick, with those of custom metrics of a stride."""
    four = jnp.zeros_like(sensors.foot_force)
    yes, since = jnp.ones(4, bool), jnp.zeros((4, 3), four.dtype)
    at_rest = reduction.init_own(custom, sensors) if custom else None
    zeros = jnp.zeros(len(custom), four.dtype)
    return StrideState(
        down=yes,
        other_seconds=four,
        unloaded_seconds=four,
        begun=~yes,
        lands=~yes,
        landing=since,
        since=since,
        strides=Spread(jnp.zeros((4, 1), four.dtype), since, since),
        own=at_rest,
        own_time=zeros,
        own_strides=Spread(zeros, zeros, zeros) if custom else None,
    )


def update_strides(
    custom: tuple[OwnMetric, ...],
    state: StrideState,
    sensors: Sensors,
    loaded: Float[Array, " 4"],
    speed: Scalar,
    part: MeasuredPart,
    cycle_rate: Any,
    is_counted: Truth,
) -> StrideState:
    """Add one control tick.

    Args:
        custom: custom metrics of a stride, the same as for `init_strides`.
        state: accumulators so far.
        sensors: readings of the tick's physics steps, leading axis (steps,).
        loaded: share of the tick for which each foot is loaded.
        speed: of the torso along its way [m/s].
        part: the measured part of the tick.
        cycle_rate: gait cycles per simulated second.
        is_counted: whether the readings are those of a tick.
    """
    on, up = loaded > 0.5, ~state.down
    other_time = jnp.where(on == up, state.other_seconds + part.weight, 0.0)
    swing_time = jnp.where(on, 0.0, state.unloaded_seconds + part.weight)
    first = on & up & ~state.lands & part.inside
    lands = (state.lands | first) & (swing_time * cycle_rate < SETTLED)
    landing = jnp.where(first[:, None], state.since, state.landing)
    turned = other_time * cycle_rate >= SETTLED
    touched = turned & up
    complete = touched & state.begun
    since = state.since + part.weight * jnp.stack(
        [jnp.ones(4), jnp.broadcast_to(speed, 4), loaded], axis=-1
    )
    accumulated, own_time, own_strides = state.own, state.own_time, state.own_strides
    if accumulated is not None and own_strides is not None:
        foot = jnp.array([LIMBS.index(custom_metric.limb) for custom_metric in custom])
        own_time = own_time + part.weight
        elapsed = jnp.where(own_time > 0.0, own_time, 1.0)
        accumulated = reduction.update_own(
            custom, accumulated, sensors, part, part.weight / elapsed, is_counted
        )
        values = jnp.stack(
            [*reduction.own_result(custom, accumulated, jnp.asarray(True), elapsed).values()]
        )
        own_strides = own_strides.add(values, complete[foot])
        zero = jnp.zeros_like(elapsed)
        anew = dataclasses.replace(
            accumulated, mean=zero, square=zero, low=zero + jnp.inf, high=zero - jnp.inf
        )
        own_time = jnp.where(touched[foot], 0.0, own_time)
        accumulated = jax.tree.map(
            lambda new, old: jnp.where(touched[foot], new, old), anew, accumulated
        )
    return StrideState(
        down=state.down ^ turned,
        other_seconds=jnp.where(turned, 0.0, other_time),
        unloaded_seconds=swing_time,
        begun=state.begun | touched,
        lands=lands & ~touched,
        landing=landing,
        since=since - jnp.where(touched[:, None], landing, 0.0),
        strides=state.strides.add(landing, complete[:, None]),
        own=accumulated,
        own_time=own_time,
        own_strides=own_strides,
    )


def stride_result(state: StrideState, custom: tuple[OwnMetric, ...] = ()) -> dict[str, Scalar]:
    """The metrics of strides of one world by name, and the custom ones; NaN without a stride."""
    count, (time, length, stance) = state.strides.count[:, 0], state.strides.mean.T
    share = count / jnp.maximum(count.sum(), 1.0)
    has_strides = count.sum() > 0
    deviation = state.strides.std()[:, 1]
    is_known = ~jnp.isnan(deviation) & (jnp.abs(length) > 1e-6)
    relative = jnp.where(is_known, deviation / jnp.where(is_known, length, 1.0), 0.0)
    spread = root(jnp.sum(relative**2) / jnp.maximum(is_known.sum(), 1))
    mean = {
        "stride_length": share @ length,
        "stride_time": share @ time,
        "stance_time": share @ stance,
    }
    mean["duty_factor"] = mean["stance_time"] / jnp.where(has_strides, mean["stride_time"], 1.0)
    metrics = {"strides": count.min()} | {
        name: jnp.where(has_strides, value, jnp.nan) for name, value in mean.items()
    }
    metrics["stride_length_cv"] = jnp.where(is_known.any(), spread, jnp.nan)
    if (strides := state.own_strides) is not None:
        std = strides.std()
        is_known = ~jnp.isnan(std) & (strides.mean != 0.0)
        across = {
            "mean": jnp.where(strides.count > 0, strides.mean, jnp.nan),
            "std": std,
            "cv": jnp.where(
                is_known, std / jnp.abs(jnp.where(is_known, strides.mean, 1.0)), jnp.nan
            ),
        }
        metrics |= {
            custom_metric.name: across[custom_metric.across][i]
            for i, custom_metric in enumerate(custom)
        }
    return metrics
