"""Gaits with many parameters: the published stepping with numbers of each limb, and foot paths through free points.

Everything is added to the published gait, with nothing where it is not given, so that the published gait is the point
of this space at which all is at its default: the same numbers, bit for bit.

A foot's path is a loop through eight points. Touch-down (1) and lift-off (5) are the ends of the half-cycles, which
begin where the one before has ended, so that the path is closed and continuous whatever they are. In between, at a
quarter, the half and three quarters of stance (2-4) and swing (6-8), a spline through the points is added, which
leaves both ends as they are, with their velocities. What would leave the leg's workspace is drawn in (`within`).
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.control import clock, trajectory
from nermo_mjx.control.parameters import FOOT_POINTS, ControlParameters
from nermo_mjx.control.pilot import Drive
from nermo_mjx.control.stepping import Stepping
from nermo_mjx.kinematics.leg import four_reaches
from nermo_mjx.robot.geometry import geometry_of
from nermo_mjx.robot.interface import ServoAngles
from nermo_mjx.robot.parameters import LIMBS
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.shapes import Array, Planar, Scalars

#: The trajectory that chooses this stepping, beside `trajectory.FORMS`.
FREE: Final = "free"
#: Width of the border of the workspace within which feet are drawn in [m]. The published rear feet come within 0.05 mm
#: of it, in the middle of the swing, where their knee servos are almost at their limit.
BORDER: Final = 4e-5

#: Where the spline has its points; its ends are 0.
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
    # At a knot nothing but the third derivative changes.
    return np.concatenate([square[:1], cube[:1], np.diff(cube, axis=0)])


_SPLINE: Final = _spline()


@dataclasses.dataclass(frozen=True)
class FreeStepping(Stepping):
    """Stepping with the parameters `limb`, `foot` and `trim` besides the published ones.

    Attributes:
        form: of the path that points are moved from.
        routing: knee tendon routing, for the workspace.
    """

    routing: str = "type3"

    def trim(self, params: ControlParameters, servos: ServoAngles) -> ServoAngles:
        """The servo angles with what is added to each [rad]."""
        trim = params.trim
        return dataclasses.replace(
            servos, hip=servos.hip + _added(trim.hip), knee=servos.knee + _added(trim.knee),
            spine=servos.spine + trim.spine,
        )  # fmt: skip

    def check(self, params: ControlParameters) -> None:
        """Refuse limbs that would always or never stand; `params` are not traced, and may have leading batch axes."""
        added = np.asarray(params.limb.duty, float)
        duty = np.asarray(params.gait.duty, float)[..., None] + np.repeat(added[..., :2], 2, axis=-1) + added[..., 2:]
        for place, name in enumerate(LIMBS):
            wrong = ~((duty[..., place] > 0.0) & (duty[..., place] < 1.0))
            if wrong.any():
                value = duty[..., place][wrong].flat[0]
                raise ParameterError(
                    f"limb.duty.{name} gives the limb a duty factor of {value:g}: allowed is (0, 1) for duty, what its "
                    "pair adds and what it adds itself."
                )

    def _duty(self, params: ControlParameters) -> Array:
        return clock.stance_share(params.gait.duty[..., None] + _added(params.limb.duty))

    def limbs(self, params: ControlParameters, phase: Scalars) -> clock.LimbStates:
        """See `Stepping.limbs`."""
        gait = dataclasses.replace(params.gait, offset=params.gait.offset + _added(params.limb.phase))
        return clock.limb_states(gait, phase, _added(params.limb.duty))

    def _strides(self, params: ControlParameters, drive: Drive) -> Float[Array, " 4"]:
        pair, limb = _both(params.limb.stride)
        return super()._strides(params, drive) * (pair * limb)

    def _moved(self, params: ControlParameters) -> trajectory.Moved:
        points = _points(params)
        return trajectory.Moved(points[..., 0, :], points[..., FOOT_POINTS // 2, :], _added(params.limb.lift))

    def _feet(
        self, params: ControlParameters, points: Float[Array, "4 3 2"], limbs: clock.LimbStates
    ) -> Float[Array, "4 2"]:
        own, half = _points(params), FOOT_POINTS // 2
        inner = jnp.where(limbs.stance[:, None, None], own[:, 1:half], own[:, half + 1 :])
        path = super()._feet(params, points, limbs) + jnp.sum(bumps(limbs.progress)[..., None] * inner, axis=-2)
        return within(*four_reaches(geometry_of(params), self.routing), path)


def bumps(progress: Scalars) -> Float[Array, "*batch 3"]:
    """Of each inner point of a half-cycle, how much of its way the foot has moved at `progress` in [0, 1].

    Cubic splines, 1 at their own point and 0 at the others; value and slope are 0 at both ends.
    """
    p = jnp.asarray(progress)[..., None]
    past = jnp.maximum(p - jnp.asarray(_KNOTS[1:-1], p.dtype), 0.0)
    bases = jnp.concatenate([p**2, p**3, past**3], axis=-1)
    return jnp.sum(bases[..., None] * jnp.asarray(_SPLINE, p.dtype), axis=-2)


def within(nearest: Scalars, farthest: Scalars, foot: Planar) -> Planar:
    """The foot (y, z) from the leg's axis, drawn into the ring between both distances [m].

    Within the ring it is as it was, bit for bit, but for a border of `BORDER`: there and beyond, the distance nears
    the ring's end with a slope that is 1 where the border begins and above 0 everywhere, so that a gradient leads back.
    """
    distance = jnp.sqrt(jnp.maximum(jnp.sum(foot**2, axis=-1), 1e-12))
    low, high = nearest + BORDER, farthest - BORDER

    def drawn(beyond: Array) -> Array:
        positive = jnp.maximum(beyond, 0.0)
        return BORDER * positive / (BORDER + positive)

    kept = jnp.where(distance > high, high + drawn(distance - high), low - drawn(low - distance))
    share = jnp.where((distance >= low) & (distance <= high), 1.0, kept / distance)
    return foot * share[..., None]


def _both(value: Any) -> tuple[Array, Array]:
    """The numbers of each limb's pair and its own, (..., 4) each."""
    value = jnp.asarray(value)
    front, rear = value[..., 0], value[..., 1]
    return jnp.stack([front, front, rear, rear], axis=-1), value[..., 2:]


def _added(value: Any) -> Array:
    pair, limb = _both(value)
    return pair + limb


def _points(params: ControlParameters) -> Float[Array, "*batch 4 8 2"]:
    """How far the points of each foot's path are moved, (y, z) in the leg's frame [m]."""
    foot = params.foot
    front, rear = jnp.asarray(foot.front), jnp.asarray(foot.rear)
    moved = jnp.stack(
        [front + foot.front_left, front + foot.front_right, rear + foot.rear_left, rear + foot.rear_right], axis=-2
    )
    return jnp.stack([moved[..., :FOOT_POINTS], moved[..., FOOT_POINTS:]], axis=-1)
