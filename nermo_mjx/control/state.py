"""What the controller remembers between two ticks."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nermo_mjx.control.guidance import Guidance
from nermo_mjx.control.path import PathPoint


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ControllerState:
    """State of the controller; metrics and recordings read it too.

    Attributes:
        tick: control ticks since the start.
        time: simulated time since the start [s].
        phase: of the gait cycle, in [0, 1).
        stance: planned contact of the limbs.
        points: control points (start, mid, end) of each limb's half-cycle, (y, z) in the leg's frame; the next
            half-cycle starts at the end [m].
        foot: commanded foot positions: those on the path, after offset compensation and tracking lag [m].
        speed: commanded speed [m/s of the controller's clock].
        turn_rate: held between two pilot ticks, in [-1, 1], positive left.
        spine: commanded spine servo angle, positive left [rad].
        path_point: of the pilot's path, at the last pilot tick.
        guidance: the pilot's estimate of its course beside the path.
    """

    tick: Int[Array, ""]
    time: Float[Array, ""]
    phase: Float[Array, ""]
    stance: Bool[Array, " 4"]
    points: Float[Array, "4 3 2"]
    foot: Float[Array, "4 2"]
    speed: Float[Array, ""]
    turn_rate: Float[Array, ""]
    spine: Float[Array, ""]
    path_point: PathPoint
    guidance: Guidance


def canonical(state: ControllerState) -> ControllerState:
    """The state with every float in JAX's default precision and no weak types, so that a scan can carry it."""
    precision = jnp.zeros(()).dtype

    def settle(leaf: Array) -> Array:
        return leaf.astype(precision if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype)

    return jax.tree.map(settle, state)


def with_dtypes_of(reference: ControllerState, state: ControllerState) -> ControllerState:
    """`state` with the dtypes of `reference`, so that a scan can carry it on."""
    return jax.tree.map(lambda old, new: jnp.asarray(new).astype(old.dtype), reference, state)
