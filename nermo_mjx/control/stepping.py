"""The gait: from phase and drive to planned contact and the feet's paths."""

from __future__ import annotations

import dataclasses
from typing import Any, Final, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from nermo_mjx.control import trajectory, turning
from nermo_mjx.control.parameters import FOOT_POINTS, ControlParameters
from nermo_mjx.control.pilot import Drive
from nermo_mjx.kinematics.leg import four_reaches
from nermo_mjx.robot.geometry import geometry_of
from nermo_mjx.robot.parameters import LIMBS, ServoAngles
from nermo_mjx.robot.quantity import ParameterError, choice
from nermo_mjx.shapes import Array, PerLimb, Planar, Scalar, Scalars


@runtime_checkable
class GaitLike(Protocol):
    """A gait: pure functions of its parameters and its own state. Values are unbatched."""

    def start(self, params: Any, phase: Scalar, drive: Drive) -> tuple[Any, Float[Array, "4 2"]]:
        """State in a steady gait at a phase, and the feet (y, z) in their legs' frames [m].

        The controller reads the state's `phase` of the gait cycle, in [0, 1), and `stance`, the planned contact (4,).
        """

    def update(
        self, params: Any, state: Any, previous: Drive, now: Drive, dt: float
    ) -> tuple[Any, Float[Array, "4 2"]]:
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

    def start(
        self, params: ControlParameters, phase: Scalar, drive: Drive
    ) -> tuple[Steps, Float[Array, "4 2"]]:
        limbs = self.limbs(params, phase)
        share = turning.stride_shares(params.turning, drive.turn_rate)
        points = trajectory.nominal_points(
            params.stance, limbs.stance, self._strides(params, drive), self._moved(params, share)
        )
        return Steps(phase, limbs.stance, points, share), self._feet(params, points, share, limbs)

    def update(
        self, params: ControlParameters, state: Steps, previous: Drive, now: Drive, dt: float
    ) -> tuple[Steps, Float[Array, "4 2"]]:
        phase = trajectory.advance(
            state.phase, params.gait.frequency, dt / params.tracking.clock_ratio
        )
        limbs = self.limbs(params, phase)
        points, share = self._half_cycles(params, state, limbs, previous, now, dt)
        return Steps(phase, limbs.stance, points, share), self._feet(params, points, share, limbs)

    def walked(
        self, params: ControlParameters, state: Steps, drive: Drive
    ) -> tuple[Scalar, Scalar]:
        speed, yaw_rate = turning.walked(params, state.points, state.stance, drive.turn_rate)
        return speed / params.tracking.clock_ratio, yaw_rate / params.tracking.clock_ratio

    def _duty(self, params: ControlParameters) -> Array:
        """Stance share of the cycle, of all limbs () or of each (4,)."""
        return trajectory.stance_share(params.gait.duty)

    def limbs(self, params: ControlParameters, phase: Scalars) -> trajectory.LimbStates:
        """Planned contact of the limbs, and each one's progress in its half-cycle, at phases."""
        return trajectory.limb_states(params.gait, phase)

    def _strides(self, params: ControlParameters, drive: Drive) -> Float[Array, " 4"]:
        stride = turning.stride_length(params.gait, params.stance, drive.speed)
        return stride * turning.stride_shares(params.turning, drive.turn_rate)

    def _moved(self, params: ControlParameters, share: PerLimb) -> trajectory.Moved | None:
        """Displacement of the control points at shares of a straight walk's strides; None without one."""
        return None

    def _feet(
        self,
        params: ControlParameters,
        points: Float[Array, "4 3 2"],
        share: PerLimb,
        limbs: trajectory.LimbStates,
    ) -> Float[Array, "4 2"]:
        return trajectory.foot_position(points, limbs.progress, self.form)

    def _half_cycles(
        self,
        params: ControlParameters,
        state: Steps,
        limbs: trajectory.LimbStates,
        previous: Drive,
        now: Drive,
        dt: float,
    ) -> tuple[Float[Array, "4 3 2"], PerLimb]:
        """Control points of the legs' current half-cycles, and their shares of a straight walk's strides.

        A leg switches between two ticks. Its new half-cycle starts where the old one ends, not at the foot's position
        one tick before, and has the stride that was commanded when it switched. So the commanded feet are continuous in
        frequency, duty and offsets, which determine the tick of a switch.
        """
        duty = self._duty(params)
        length = jnp.where(limbs.stance, duty, 1.0 - duty)
        other_length = jnp.where(limbs.stance, 1.0 - duty, duty)
        # Time since the leg's last switch, and length of a tick, as shares of the gait cycle.
        since = limbs.progress * length
        in_tick = jnp.maximum(params.gait.frequency * dt / params.tracking.clock_ratio, 1e-9)
        strides = [self._strides(params, drive) for drive in (previous, now)]
        shares = [
            turning.stride_shares(params.turning, drive.turn_rate) for drive in (previous, now)
        ]

        def commanded(values: list[Array], ago: Array) -> Array:
            earlier, later = values
            return later + jnp.where(ago <= in_tick, ago / in_tick, 1.0) * (earlier - later)

        share = commanded(shares, since)
        switched = limbs.stance != state.stance
        # A half-cycle shorter than a tick may go unnoticed; the foot has still moved along its path.
        skipped = ~switched & (since < in_tick - 0.5 * trajectory.SHORTEST_HALF_CYCLE)
        offset = self._moved(params, commanded(shares, since + other_length))
        passed = trajectory.end_points(
            params.stance, ~limbs.stance, commanded(strides, since + other_length), offset
        )
        start = jnp.where(skipped[:, None], passed, state.points[:, 2])
        offset = self._moved(params, share)
        planned = trajectory.plan(
            params.stance, start, limbs.stance, commanded(strides, since), offset
        )
        begins = switched | skipped
        return jnp.where(begins[:, None, None], planned, state.points), jnp.where(
            begins, share, state.share
        )


# ---
# Gaits with many parameters: the published stepping with parameters per limb, and foot paths through free points.
#
# All parameters are offsets to the published gait and default to zero, so that the defaults give the published gait,
# bit for bit.
#
# A foot's path is a loop through eight points. Touch-down (1) and lift-off (5) are the ends of the half-cycles, each of
# which begins where the previous one ended, so that the path is always closed and continuous. In between, at a
# quarter, the half and three quarters of stance (2-4) and swing (6-8), a spline through the points is added, which
# changes neither the position nor the velocity at both ends. A turn shortens the way of the points back and forth as it
# does the stride. Points outside the leg's workspace are moved inside (`within`).


#: The name of this trajectory, in addition to `trajectory.FORMS`.
FREE_TRAJECTORY: Final = "free"
TrajectoryName = Literal["cubic", "linear", "parabolic", "free"]
#: Width of the border of the workspace within which feet are moved inside [m]. The published rear feet come within 0.05
#: mm of it in mid-swing, where their knee servos are almost at their limit.
BORDER_METRES: Final = 4e-5

#: Knots of the spline; it is 0 at its ends.
_KNOTS: Final = np.linspace(0.0, 1.0, FOOT_POINTS // 2 + 1)


def _spline() -> np.ndarray:
    """Coefficients of the splines that are 1 at one inner knot each: (power bases of `bumps`, knots)."""
    count, step = len(_KNOTS), _KNOTS[1]
    value = np.eye(count)[:, 1:-1]
    rise = np.diff(value, axis=0) / step
    # The acceleration is continuous at the inner knots; the slope is 0 at the ends.
    slope, inner = np.zeros_like(value), count - 2
    slope[1:-1] = np.linalg.solve(
        4 * np.eye(inner) + np.eye(inner, k=1) + np.eye(inner, k=-1), 3 * (rise[1:] + rise[:-1])
    )
    square = (3 * rise - 2 * slope[:-1] - slope[1:]) / step
    cube = (slope[:-1] + slope[1:] - 2 * rise) / step**2
    # At a knot only the third derivative changes.
    return np.concatenate([square[:1], cube[:1], np.diff(cube, axis=0)])


_SPLINE: Final = _spline()


@dataclasses.dataclass(frozen=True)
class FreeStepping(Stepping):
    """Stepping with the parameters `limb`, `foot` and `trim` in addition to the published ones.

    Attributes:
        form: of the path whose points are moved.
        routing: knee tendon routing, for the workspace.
    """

    routing: str = "type3"

    def trim(self, params: ControlParameters, servos: ServoAngles) -> ServoAngles:
        """The servo angles plus the offset of each [rad]."""
        trim = params.trim
        return dataclasses.replace(
            servos,
            hip=servos.hip + _added(trim.hip),
            knee=servos.knee + _added(trim.knee),
            spine=servos.spine + trim.spine,
        )

    def check(self, params: ControlParameters) -> None:
        """Reject limbs that would always or never be in stance; `params` are not traced, and may have leading batch
        axes."""
        added = np.asarray(params.limb.duty, float)
        duty = (
            np.asarray(params.gait.duty, float)[..., None]
            + np.repeat(added[..., :2], 2, axis=-1)
            + added[..., 2:]
        )
        for index, name in enumerate(LIMBS):
            wrong = ~((duty[..., index] > 0.0) & (duty[..., index] < 1.0))
            if wrong.any():
                value = duty[..., index][wrong].flat[0]
                raise ParameterError(
                    f"limb.duty.{name} gives the limb a duty factor of {value:g}: allowed is (0, 1) for duty, what its "
                    "pair adds and what it adds itself."
                )

    def _duty(self, params: ControlParameters) -> Array:
        return trajectory.stance_share(params.gait.duty[..., None] + _added(params.limb.duty))

    def limbs(self, params: ControlParameters, phase: Scalars) -> trajectory.LimbStates:
        """See `Stepping.limbs`."""
        gait = dataclasses.replace(
            params.gait, offset=params.gait.offset + _added(params.limb.phase)
        )
        return trajectory.limb_states(gait, phase, _added(params.limb.duty))

    def _strides(self, params: ControlParameters, drive: Drive) -> Float[Array, " 4"]:
        pair, limb = _both(params.limb.stride)
        return super()._strides(params, drive) * (pair * limb)

    def _moved(self, params: ControlParameters, share: PerLimb) -> trajectory.Moved:
        points = _points(params, share)
        return trajectory.Moved(
            points[..., 0, :], points[..., FOOT_POINTS // 2, :], _added(params.limb.lift)
        )

    def _feet(
        self,
        params: ControlParameters,
        points: Float[Array, "4 3 2"],
        share: PerLimb,
        limbs: trajectory.LimbStates,
    ) -> Float[Array, "4 2"]:
        free_points, half = _points(params, share), FOOT_POINTS // 2
        inner = jnp.where(
            limbs.stance[:, None, None], free_points[:, 1:half], free_points[:, half + 1 :]
        )
        path = super()._feet(params, points, share, limbs) + jnp.sum(
            bumps(limbs.progress)[..., None] * inner, axis=-2
        )
        return within(*four_reaches(geometry_of(params), self.routing), path)


def bumps(progress: Scalars) -> Float[Array, "*batch 3"]:
    """Weight of each inner point of a half-cycle at `progress` in [0, 1].

    Cubic splines, 1 at their own point and 0 at the others; value and slope are 0 at both ends.
    """
    p = jnp.asarray(progress)[..., None]
    excess = jnp.maximum(p - jnp.asarray(_KNOTS[1:-1], p.dtype), 0.0)
    bases = jnp.concatenate([p**2, p**3, excess**3], axis=-1)
    return jnp.sum(bases[..., None] * jnp.asarray(_SPLINE, p.dtype), axis=-2)


def within(nearest: Scalars, farthest: Scalars, foot: Planar) -> Planar:
    """The foot (y, z) from the leg's axis, moved into the ring between both distances [m].

    Within the ring it is unchanged, bit for bit, except in a border of width `BORDER_METRES`: there and beyond, the distance
    nears the ring's end with a slope that is 1 where the border begins and above 0 everywhere, so that a gradient leads
    back.
    """
    distance = jnp.sqrt(jnp.maximum(jnp.sum(foot**2, axis=-1), 1e-12))
    low, high = nearest + BORDER_METRES, farthest - BORDER_METRES

    def drawn(beyond: Array) -> Array:
        positive = jnp.maximum(beyond, 0.0)
        return BORDER_METRES * positive / (BORDER_METRES + positive)

    limited = jnp.where(distance > high, high + drawn(distance - high), low - drawn(low - distance))
    share = jnp.where((distance >= low) & (distance <= high), 1.0, limited / distance)
    return foot * share[..., None]


def _both(value: Any) -> tuple[Array, Array]:
    """The values of each limb's pair, and each limb's own, (..., 4) each."""
    value = jnp.asarray(value)
    front, rear = value[..., 0], value[..., 1]
    return jnp.stack([front, front, rear, rear], axis=-1), value[..., 2:]


def _added(value: Any) -> Array:
    pair, limb = _both(value)
    return pair + limb


def _points(params: ControlParameters, share: PerLimb) -> Float[Array, "*batch 4 8 2"]:
    """Displacements of the points of each foot's path at a share of its stride, (y, z) in the leg's frame [m]."""
    foot = params.foot
    front, rear = jnp.asarray(foot.front), jnp.asarray(foot.rear)
    points = jnp.stack(
        [
            front + foot.front_left,
            front + foot.front_right,
            rear + foot.rear_left,
            rear + foot.rear_right,
        ],
        axis=-2,
    )
    return jnp.stack(
        [share[..., None] * points[..., :FOOT_POINTS], points[..., FOOT_POINTS:]], axis=-1
    )
