"""Guidance of the profile `exact`: the curvature to walk, from an estimate of the cross-track error without its sway.

The torso sways by a centimetre in every gait cycle, because the spine bends and the legs push by turns. A robot that
steers against its sway limit-cycles, or steps longer on one side, since a leg takes up its new stride only when it
switches. The gait's phase is known, so the sway can be estimated beside the path error, and left alone.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nermo_mjx.control.parameters import Pilot


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Guidance:
    """Estimate of where the robot walks, beside its path.

    Attributes:
        error: cross-track error without sway, positive left [m].
        rate: its rate of change [m/s].
        bias: lateral acceleration that the turn rate does not explain: what the theory of turning leaves out [m/s^2].
        sway: cosine and sine of the sway at the gait's phase [m].
    """

    error: Float[Array, ""]
    rate: Float[Array, ""]
    bias: Float[Array, ""]
    sway: Float[Array, " 2"]


def start(error: Float[Array, ""]) -> Guidance:
    """Estimate at rest."""
    zero = jnp.zeros_like(error)
    return Guidance(error=error, rate=zero, bias=zero, sway=jnp.zeros((2,), error.dtype))


def observe(
    pilot: Pilot, state: Guidance, error: Array, phase: Array, turning: Array, cycle_rate: Any, dt: float
) -> Guidance:
    """One step of the observer (Luenberger; a triple pole for the path, one more for the sway).

    Args:
        pilot: `bandwidth`, of the observer [rad per gait cycle].
        state: the estimate before.
        error: cross-track error as measured [m].
        phase: of the gait cycle.
        turning: lateral acceleration from the turn rate that was commanded, speed^2 times curvature against the path's
            [m/s^2].
        cycle_rate: gait cycles a second [1/s].
        dt: time since the last step [s].
    """
    angle = 2.0 * jnp.pi * phase
    wave = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    pole = pilot.bandwidth * cycle_rate * dt
    ahead = state.error + dt * state.rate
    surprise = error - ahead - wave @ state.sway
    return Guidance(
        error=ahead + 3.0 * pole * surprise,
        rate=state.rate + dt * (turning + state.bias) + 3.0 * pole**2 / dt * surprise,
        bias=state.bias + pole**3 / dt**2 * surprise,
        sway=state.sway + 2.0 * pole * wave * surprise,
    )


def correction(pilot: Pilot, state: Guidance, speed: Array) -> Float[Array, ""]:
    """Curvature to add to the path's [1/m]: poles of the way walked at 1/`look_ahead`, and the bias taken back.

    Args:
        pilot: `look_ahead` [m] and `damping`.
        state: the estimate.
        speed: of the walk [m/s].
    """
    per_speed = 1.0 / jnp.maximum(speed, 0.01)
    spring = state.error / pilot.look_ahead**2
    damper = 2.0 * pilot.damping * state.rate * per_speed / pilot.look_ahead
    return -(spring + damper + state.bias * per_speed**2)
