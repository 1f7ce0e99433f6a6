"""The controller's state between ticks."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from nermo_mjx.control.head import HeadAngles
from nermo_mjx.control.pilot import Drive
from nermo_mjx.shapes import Array, Count, Scalar, Scalars

State = TypeVar("State")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ControllerState:
    """State of the controller.

    Attributes:
        tick: control ticks since the start.
        time: simulated time since the start [s].
        pilot: the pilot's memory, of its last decision.
        drive: its output, held between pilot ticks.
        gait: the gait's state.
        foot: commanded foot positions: those on the path, after offset compensation and tracking lag [m].
        spine: commanded spine servo angle, positive left [rad].
        head, tail: memories of these parts.
        head_angles, tail_angle: their commanded servo angles [rad].
        spine_vertical: that of Nermo 4.1's vertical servo, positive lifts the hip [rad]; None on Nermo-Lite.
    """

    tick: Count
    time: Scalar
    pilot: Any
    drive: Drive
    gait: Any
    foot: Float[Array, "4 2"]
    spine: Scalar
    head: Any
    head_angles: HeadAngles
    tail: Any
    tail_angle: Scalar
    spine_vertical: Scalar | None = None

    @property
    def phase(self) -> Scalars:
        """Of the gait cycle, in [0, 1)."""
        return self.gait.phase

    @property
    def stance(self) -> Bool[Array, " 4"]:
        """Planned contact of the limbs."""
        return self.gait.stance

    @property
    def turn_rate(self) -> Scalars:
        """In [-1, 1], positive left."""
        return self.drive.turn_rate


def canonical(state: State) -> State:
    """The state with every float in JAX's default precision and no weak types, so that a scan can carry it."""
    precision = jnp.zeros(()).dtype

    def settle(leaf: Array) -> Array:
        leaf = jnp.asarray(leaf)
        return leaf.astype(precision if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype)

    return jax.tree.map(settle, state)


def with_dtypes_of(reference: State, state: State) -> State:
    """`state` with the dtypes of `reference`, so that a scan can carry it."""
    return jax.tree.map(lambda old, new: jnp.asarray(new).astype(old.dtype), reference, state)
