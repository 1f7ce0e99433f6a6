"""Reductions of custom metrics, accumulated during the run: `init` and `update` for one world, and `result`.

A function is evaluated on one reading per physics step, and no time series is stored. Like other readings, a value is
constant over the step before it, and a tick is weighted by its measured part. Between two readings a value is
interpolated linearly, so that extremes and the last value are continuous in both ends of the measured time, like all
metrics.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.robot import Sensors
from nermo_mjx.rollout.custom_metrics import OwnMetric
from nermo_mjx.rollout.path_metrics import MeasuredPart, root
from nermo_mjx.shapes import Array, Scalar, Truth


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class OwnState:
    """Accumulators of k metrics in one world, (k,) each.

    Attributes:
        value: at the last reading.
        mean, square: Welford's running mean, and the integral of the squared deviations.
        low, high: extremes.
        final: value at the end of the time measured so far.
    """

    value: Float[Array, " k"]
    mean: Float[Array, " k"]
    square: Float[Array, " k"]
    low: Float[Array, " k"]
    high: Float[Array, " k"]
    final: Float[Array, " k"]


def init_own(metrics: tuple[OwnMetric, ...], sensors: Sensors) -> OwnState:
    """Accumulators before the first tick, from the readings at rest."""
    value = _values(metrics, sensors)
    zero = jnp.zeros_like(value)
    return OwnState(value, zero, zero, zero + jnp.inf, zero - jnp.inf, value)


def update_own(
    metrics: tuple[OwnMetric, ...],
    state: OwnState,
    sensors: Sensors,
    part: MeasuredPart,
    share: Scalar | Float[Array, " k"],
    is_counted: Truth,
) -> OwnState:
    """Add one control tick.

    Args:
        metrics: k of them.
        state: accumulators so far.
        sensors: readings of the tick's physics steps, leading axis (steps,).
        part: the measured part of the tick.
        share: of this part in the time measured so far, of all or of each.
        is_counted: whether the readings are those of a tick; others do not contribute to derivatives.
    """
    sensors = jax.tree.map(
        lambda leaf: jnp.where(is_counted, leaf, jax.lax.stop_gradient(leaf)), sensors
    )
    values = jax.vmap(functools.partial(_values, metrics))(sensors)
    mean = values.mean(axis=0)
    deviation, spread = mean - state.mean, ((values - mean) ** 2).mean(axis=0)
    next_mean = state.mean + share * deviation
    square = state.square + part.weight * (deviation * (mean - next_mean) + spread)

    values_with_last = jnp.concatenate([state.value[None], values])
    places = jnp.arange(len(values_with_last)) / (len(values_with_last) - 1)
    between = jax.vmap(
        lambda column, target: jnp.interp(target, places, column), in_axes=(1, None), out_axes=1
    )
    ends = between(values_with_last, jnp.stack([jnp.maximum(part.begin, 0.0), part.end]))
    inner = ((places > part.begin) & (places < part.end))[:, None]
    low = jnp.minimum(jnp.where(inner, values_with_last, jnp.inf).min(axis=0), ends.min(axis=0))
    high = jnp.maximum(jnp.where(inner, values_with_last, -jnp.inf).max(axis=0), ends.max(axis=0))
    measured = OwnState(
        values[-1],
        next_mean,
        square,
        jnp.minimum(state.low, low),
        jnp.maximum(state.high, high),
        ends[1],
    )
    passed = dataclasses.replace(state, value=values[-1])
    return jax.tree.map(lambda new, old: jnp.where(part.inside, new, old), measured, passed)


def own_result(
    metrics: tuple[OwnMetric, ...],
    state: OwnState,
    has_begun: Truth,
    time: Scalar | Float[Array, " k"],
) -> dict[str, Scalar]:
    """The metrics of one world by name; NaN if nothing was measured. `time` is the measured one [s], never 0; of all or
    of each."""
    variance = state.square / time
    reduced = {
        "mean": state.mean,
        "rms": root(state.mean**2 + variance),
        "std": root(variance),
        "min": state.low,
        "max": state.high,
        "peak": jnp.maximum(state.high, -state.low),
        "range": state.high - state.low,
        "last": state.final,
        "integral": state.mean * time,
    }
    return {
        custom_metric.name: jnp.where(has_begun, reduced[custom_metric.reduce][i], jnp.nan)
        for i, custom_metric in enumerate(metrics)
    }


def _values(metrics: tuple[OwnMetric, ...], sensors: Sensors) -> Float[Array, " k"]:
    """The functions' results for one reading."""
    return jnp.stack(
        [
            jnp.asarray(custom_metric.function(sensors)).astype(jnp.zeros(()).dtype)
            for custom_metric in metrics
        ]
    )
