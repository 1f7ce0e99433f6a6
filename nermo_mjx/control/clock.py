"""Gait clock, the leg state machine: the planned contact of each foot, and its progress within its half-cycle."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.control.parameters import Gait
from nermo_mjx.shapes import Array, Broadcastable, PerLimb, Scalars, TruthPerLimb

#: Shortest share of the cycle that a half-cycle takes in a traced program; `Gait.duty` is checked where it is built.
SHORTEST_HALF = 1e-3


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
    """The duty factor, neither half-cycle shorter than `SHORTEST_HALF`."""
    return jnp.clip(jnp.asarray(duty), SHORTEST_HALF, 1.0 - SHORTEST_HALF)


def limb_states(gait: Gait, phase: Scalars, longer: Float[Array, "*#batch 4"] | None = None) -> LimbStates:
    """A leg is in stance while (phase - offset) mod 1 < duty (Tables A.2, A.6).

    Erratum: the duty factor is the stance share of the cycle; appendix A.4.1 words it as swing to stance.

    Args:
        gait: `offset` of shape (..., 4), `duty` of shape (...).
        phase: of the gait cycle, in [0, 1).
        longer: each limb's duty factor minus the gait's.
    """
    duty = stance_share(gait.duty)[..., None]
    local = wrap(jnp.asarray(phase)[..., None] - gait.offset)
    if longer is None:
        stance = local < duty
        progress = jnp.where(stance, local / duty, (local - duty) / (1.0 - duty))
    else:
        # As above, times ratios that are exactly 1 for a limb like the others: in XLA, division by a shared number and
        # by one per limb differ in the last bit.
        own = stance_share(gait.duty[..., None] + longer)
        stance = local < own
        swung = (local - own) / (1.0 - duty) * ((1.0 - duty) / (1.0 - own))
        progress = jnp.where(stance, local / duty * (duty / own), swung)
    return LimbStates(stance, jnp.minimum(progress, 1.0))


def switches(now: TruthPerLimb, before: TruthPerLimb) -> TruthPerLimb:
    """The switch flag: the leg has just begun a half-cycle and needs new control points."""
    return now != before
