"""The gait: from phase and drive to planned contact and the feet's paths."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from nermo_mjx.control import clock, trajectory, turning
from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.control.pilot import Drive
from nermo_mjx.robot.nearest import choice
from nermo_mjx.shapes import Array, PerLimb, Scalar, Scalars


@runtime_checkable
class GaitLike(Protocol):
    """A gait: pure functions of its parameters and its own state. Values are unbatched."""

    def start(self, params: Any, phase: Scalar, drive: Drive) -> tuple[Any, Float[Array, "4 2"]]:
        """State in a steady gait at a phase, and the feet (y, z) in their legs' frames [m].

        The controller reads the state's `phase` of the gait cycle, in [0, 1), and `stance`, the planned contact (4,).
        """

    def update(self, params: Any, state: Any, before: Drive, now: Drive, dt: float) -> tuple[Any, Float[Array, "4 2"]]:
        """State and feet `dt` simulated seconds later, with the drive `before` until now and `now` from now on."""

    def walked(self, params: Any, state: Any, drive: Drive) -> tuple[Scalar, Scalar]:
        """(speed [m/s], yaw rate [rad/s]) without slip from the legs' current strides, in simulated time."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Steps:
    """State of `Stepping`.

    Attributes:
        phase: of the gait cycle, in [0, 1).
        stance: planned contact of the limbs.
        points: control points (start, mid, end) of each limb's half-cycle, (y, z) in the leg's frame; the next
            half-cycle starts at the end [m].
        share: stride of each limb's half-cycle, over that of a straight walk.
    """

    phase: Scalar
    stance: Bool[Array, " 4"]
    points: Float[Array, "4 3 2"]
    share: Float[Array, " 4"]


@dataclasses.dataclass(frozen=True)
class Stepping(GaitLike):
    """The published gaits: a clock, half-cycles of stance and swing, and a path through three points for each.

    Attributes:
        form: of the foot path, "cubic", "linear" or "parabolic".

    Raises:
        ParameterError: an unknown form.
    """

    form: str = "cubic"

    def __post_init__(self) -> None:
        choice("trajectory", self.form, trajectory.FORMS)

    def start(self, params: ControlParameters, phase: Scalar, drive: Drive) -> tuple[Steps, Float[Array, "4 2"]]:
        limbs = self.limbs(params, phase)
        share = turning.stride_shares(params.turning, drive.turn_rate)
        points = trajectory.nominal_points(
            params.stance, limbs.stance, self._strides(params, drive), self._moved(params, share)
        )
        return Steps(phase, limbs.stance, points, share), self._feet(params, points, share, limbs)

    def update(
        self, params: ControlParameters, state: Steps, before: Drive, now: Drive, dt: float
    ) -> tuple[Steps, Float[Array, "4 2"]]:
        phase = clock.advance(state.phase, params.gait.frequency, dt / params.tracking.clock_ratio)
        limbs = self.limbs(params, phase)
        points, share = self._half_cycles(params, state, limbs, before, now, dt)
        return Steps(phase, limbs.stance, points, share), self._feet(params, points, share, limbs)

    def walked(self, params: ControlParameters, state: Steps, drive: Drive) -> tuple[Scalar, Scalar]:
        speed, yaw_rate = turning.walked(params, state.points, state.stance, drive.turn_rate)
        return speed / params.tracking.clock_ratio, yaw_rate / params.tracking.clock_ratio

    def _duty(self, params: ControlParameters) -> Array:
        """Stance share of the cycle, of all limbs () or of each (4,)."""
        return clock.stance_share(params.gait.duty)

    def limbs(self, params: ControlParameters, phase: Scalars) -> clock.LimbStates:
        """Planned contact of the limbs, and each one's progress in its half-cycle, at phases."""
        return clock.limb_states(params.gait, phase)

    def _strides(self, params: ControlParameters, drive: Drive) -> Float[Array, " 4"]:
        stride = turning.stride_length(params.gait, params.stance, drive.speed)
        return stride * turning.stride_shares(params.turning, drive.turn_rate)

    def _moved(self, params: ControlParameters, share: PerLimb) -> trajectory.Moved | None:
        """Displacement of the control points at shares of a straight walk's strides; None without one."""
        return None

    def _feet(
        self, params: ControlParameters, points: Float[Array, "4 3 2"], share: PerLimb, limbs: clock.LimbStates
    ) -> Float[Array, "4 2"]:
        return trajectory.position(points, limbs.progress, self.form)

    def _half_cycles(
        self, params: ControlParameters, state: Steps, limbs: clock.LimbStates, before: Drive, now: Drive, dt: float
    ) -> tuple[Float[Array, "4 3 2"], PerLimb]:
        """Control points of the legs' current half-cycles, and their shares of a straight walk's strides.

        A leg switches between two ticks. Its new half-cycle starts where the old one ends, not at the foot's position
        one tick before, and has the stride that was commanded when it switched. So the commanded feet are continuous in
        frequency, duty and offsets, which determine the tick of a switch.
        """
        duty = self._duty(params)
        length, other = jnp.where(limbs.stance, duty, 1.0 - duty), jnp.where(limbs.stance, 1.0 - duty, duty)
        # Time since the leg's last switch, and length of a tick, as shares of the gait cycle.
        since = limbs.progress * length
        in_tick = jnp.maximum(params.gait.frequency * dt / params.tracking.clock_ratio, 1e-9)
        strides = [self._strides(params, drive) for drive in (before, now)]
        shares = [turning.stride_shares(params.turning, drive.turn_rate) for drive in (before, now)]

        def commanded(values: list[Array], ago: Array) -> Array:
            earlier, later = values
            return later + jnp.where(ago <= in_tick, ago / in_tick, 1.0) * (earlier - later)

        share = commanded(shares, since)
        switched = clock.switches(limbs.stance, state.stance)
        # A half-cycle shorter than a tick may go unnoticed; the foot has still moved along its path.
        skipped = ~switched & (since < in_tick - 0.5 * clock.SHORTEST_HALF)
        moved = self._moved(params, commanded(shares, since + other))
        passed = trajectory.end_points(params.stance, ~limbs.stance, commanded(strides, since + other), moved)
        start = jnp.where(skipped[:, None], passed, state.points[:, 2])
        moved = self._moved(params, share)
        planned = trajectory.plan(params.stance, start, limbs.stance, commanded(strides, since), moved)
        begins = switched | skipped
        return jnp.where(begins[:, None, None], planned, state.points), jnp.where(begins, share, state.share)
