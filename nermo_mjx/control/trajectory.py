"""Foot trajectories: three control points for each half-cycle, joined by two cubics in closed form.

A half-cycle is normalised to p in [0, 1] with knots at 0, 1/2 and 1. Every form is linear in its control points
P0, P1, P2, so it is represented by three weights per coordinate. The cubic form:

* y is a clamped spline (zero end velocity). Continuity of the acceleration at the mid point gives the slope there,
  m1 = 3/2 (P2 - P0).
* z is a natural spline (zero end acceleration). Continuity of the velocity gives the second derivative there,
  M1 = 6 (P0 - 2 P1 + P2).

Both are symmetric in time, so they are written once, from u = 0 at the nearer end to u = 1 at the mid point.
Points have the shape (..., 4, 3, 2): limb, knot, (y, z) in the leg's frame [m].
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from nermo_mjx.control.parameters import PUBLISHED_RATE_HZ, Gait, Stance, Tracking
from nermo_mjx.shapes import Array, Broadcastable, PerLimb, PlanarPerLimb, Scalars, TruthPerLimb

# ---
# x^t with a finite slope everywhere, which the published curves need at their ends.


def signed_power(
    base: Broadcastable, exponent: Broadcastable, linear_below: float
) -> Broadcastable:
    """sign(x)|x|^t for |x| >= linear_below, and the line through the origin to that point below it.

    Continuous in x and t > 0. With t < 1 the plain power has an infinite slope at 0, and a gradient through it is NaN;
    here the largest slope is linear_below^(t - 1).
    """
    return base * jnp.maximum(jnp.abs(base), linear_below) ** (exponent - 1.0)


#: Weights of (nearer end, mid point, farther end) at u, for one coordinate.
_Weights = tuple[Array, Array, Array]

#: Remaining share of the foot error below which the lag's power law is linear, for a finite derivative at 1.
_LINEAR_LAG_SHARE: Final = 1e-6


def _clamped(u: Array) -> _Weights:
    rise, bow = u * u * (3.0 - 2.0 * u), 0.75 * u * u * (u - 1.0)
    return 1.0 - rise - bow, rise, bow


def _natural(u: Array) -> _Weights:
    bow = 0.25 * u * (u * u - 1.0)
    return 1.0 - u + bow, u - 2.0 * bow, bow


def _linear(u: Array) -> _Weights:
    return 1.0 - u, u, jnp.zeros_like(u)


def _parabolic(u: Array) -> _Weights:
    return (1.0 - 0.5 * u) * (1.0 - u), u * (2.0 - u), 0.5 * u * (u - 1.0)


#: Trajectory forms: the weight functions of y and z. `cubic` is the published one, the others are for comparison.
FORMS: Final[dict[str, tuple[Callable[[Array], _Weights], Callable[[Array], _Weights]]]] = {
    "cubic": (_clamped, _natural),
    "linear": (_linear, _linear),
    "parabolic": (_parabolic, _parabolic),
}


def weights(progress: Scalars, form: str = "cubic") -> Float[Array, "*batch 3 2"]:
    """Weights of the three control points in y and z at `progress` in [0, 1]; they sum to 1."""
    first = progress < 0.5
    u = jnp.where(first, 2.0 * progress, 2.0 - 2.0 * progress)

    def knots(coordinate: Callable[[Array], _Weights]) -> Array:
        near, mid, far = coordinate(u)
        return jnp.stack([jnp.where(first, near, far), mid, jnp.where(first, far, near)], axis=-1)

    return jnp.stack([knots(coordinate) for coordinate in FORMS[form]], axis=-1)


def foot_position(
    points: Float[Array, "*#batch 3 2"], progress: Broadcastable, form: str = "cubic"
) -> Float[Array, "*#batch 2"]:
    """Foot position (y, z) on the path through `points` at `progress` [m]."""
    return jnp.sum(weights(progress, form) * points, axis=-2)


def neutral_feet(stance: Stance) -> PlanarPerLimb:
    """Neutral positions of the feet in their leg's frame (Table A.7) [m]."""
    front = jnp.stack(jnp.broadcast_arrays(stance.front_y, stance.front_z), axis=-1)
    rear = jnp.stack(jnp.broadcast_arrays(stance.rear_y, stance.rear_z), axis=-1)
    return jnp.stack([front, front, rear, rear], axis=-2)


class Moved(NamedTuple):
    """Displacements of each limb's control points from those of the published gait [m].

    Attributes:
        touchdown, liftoff: the ends of swing and stance.
        lift: upward, at mid-swing.
    """

    touchdown: PlanarPerLimb
    liftoff: PlanarPerLimb
    lift: PerLimb


def plan(
    stance: Stance,
    start: Float[Array, "*#batch 4 2"],
    down: Bool[Array, "*#batch 4"],
    stride: Float[Array, "*#batch 4"],
    displacement: Moved | None = None,
) -> Float[Array, "*#batch 4 3 2"]:
    """Control points of a half-cycle.

    Args:
        stance: neutral feet and amplitudes.
        start: its first point [m].
        down: planned contact. In stance the foot moves backward (+y) and is pressed down at its mid point, in swing it
            moves forward and is raised.
        stride: length of each leg's stride [m].
        displacement: displacement from the published gait.
    """
    neutral = neutral_feet(stance)
    swing = jnp.asarray(stance.swing_amplitude)[..., None]
    if displacement is not None:
        swing = swing + displacement.lift
    mid_height = jnp.where(down, -jnp.asarray(stance.stance_amplitude)[..., None], swing)
    mid = neutral + _column(mid_height, axis=1)
    return jnp.stack([start, mid, end_points(stance, down, stride, displacement)], axis=-2)


def nominal_points(
    stance: Stance,
    down: Bool[Array, "*#batch 4"],
    stride: Float[Array, "*#batch 4"],
    displacement: Moved | None = None,
) -> Float[Array, "*#batch 4 3 2"]:
    """Control points of a half-cycle in a steady gait: each starts where the opposite half-cycle ends."""
    return plan(stance, end_points(stance, ~down, stride, displacement), down, stride, displacement)


def end_points(
    stance: Stance,
    down: Bool[Array, "*#batch 4"],
    stride: Float[Array, "*#batch 4"],
    displacement: Moved | None = None,
) -> Float[Array, "*#batch 4 2"]:
    """End of a half-cycle: half a stride behind the neutral position in stance, in front of it in swing [m]."""
    ends = neutral_feet(stance) + _column(jnp.where(down, 0.5, -0.5) * stride, axis=0)
    return (
        ends
        if displacement is None
        else ends + jnp.where(down[..., None], displacement.liftoff, displacement.touchdown)
    )


def _column(value: Array, axis: int) -> Array:
    """(..., 4) as the y (axis 0) or z (axis 1) component of (..., 4, 2)."""
    return value[..., None] * jnp.asarray(
        [1.0, 0.0] if axis == 0 else [0.0, 1.0], dtype=value.dtype
    )


def share_closed(tracking: Tracking, dt: float) -> Scalars:
    """Share of the foot error closed in one control tick; exactly 1 for `foot_gain` 1 (see `Tracking`).

    `foot_gain` is closed per tick of 1/100 s of the controller's clock (see `published.tracking_share`). A tick of `dt`
    simulated seconds corresponds to 100 dt / clock_ratio such ticks.
    """
    ticks = dt * PUBLISHED_RATE_HZ / tracking.clock_ratio
    return 1.0 - signed_power(
        jnp.clip(1.0 - tracking.foot_gain, 0.0, 1.0), ticks, _LINEAR_LAG_SHARE
    )


# ---
# Gait clock, the leg state machine: the planned contact of each foot, and its progress within its half-cycle.


#: Shortest share of the cycle that a half-cycle takes in a traced program; `Gait.duty` is checked where it is built.
SHORTEST_HALF_CYCLE = 1e-3


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LimbStates:
    """State of the four limbs at one phase.

    Attributes:
        stance: planned contact; False is swing.
        progress: time within the half-cycle (stance or swing), normalised to [0, 1].
    """

    stance: TruthPerLimb
    progress: PerLimb


def wrap(phase: Scalars) -> Scalars:
    """The phase within its cycle, in [0, 1)."""
    wrapped = phase - jnp.floor(phase)
    # In floating point, -1e-9 - floor(-1e-9) rounds to 1.
    return jnp.where(wrapped < 1.0, wrapped, 0.0)


def advance(phase: Scalars, frequency: Scalars, duration: Scalars) -> Scalars:
    """Integrate the phase over `duration` seconds of the controller's clock; the frequency may change during a run."""
    return wrap(phase + frequency * duration)


def stance_share(duty: Broadcastable) -> Broadcastable:
    """The duty factor, neither half-cycle shorter than `SHORTEST_HALF_CYCLE`."""
    return jnp.clip(jnp.asarray(duty), SHORTEST_HALF_CYCLE, 1.0 - SHORTEST_HALF_CYCLE)


def limb_states(
    gait: Gait, phase: Scalars, longer: Float[Array, "*#batch 4"] | None = None
) -> LimbStates:
    """A leg is in stance while (phase - offset) mod 1 < duty (Tables A.2, A.6).

    Erratum: the duty factor is the stance share of the cycle; appendix A.4.1 words it as swing to stance. `longer` is
    each limb's duty factor minus the gait's.
    """
    duty = stance_share(gait.duty)[..., None]
    local = wrap(jnp.asarray(phase)[..., None] - gait.offset)
    if longer is None:
        stance = local < duty
        progress = jnp.where(stance, local / duty, (local - duty) / (1.0 - duty))
    else:
        # As above, times ratios that are exactly 1 for a limb like the others: in XLA, division by a shared number and
        # by one per limb differ in the last bit.
        limb_duty = stance_share(gait.duty[..., None] + longer)
        stance = local < limb_duty
        swung = (local - limb_duty) / (1.0 - duty) * ((1.0 - duty) / (1.0 - limb_duty))
        progress = jnp.where(stance, local / duty * (duty / limb_duty), swung)
    return LimbStates(stance, jnp.minimum(progress, 1.0))
