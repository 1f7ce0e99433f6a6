"""Balance by the spine: the joint angle that brings the centre of mass over the support of the stance feet (5.35).

The balance line joins a supporting front foot and a supporting rear foot. Both the line and the centre of mass move
when the spine bends, because the rear feet turn with the hip.
"""

from __future__ import annotations

from typing import Final

import jax.numpy as jnp
from jax.typing import ArrayLike

from nermo_mjx.kinematics.body import centre_of_mass, feet_positions
from nermo_mjx.kinematics.root import bracketed_root
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.mass_model import MassModel
from nermo_mjx.robot.parameters import SPINE
from nermo_mjx.shapes import Array, Scalars, TruthPerLimb

#: Longer than any leg [m]; feet farther out are moved in, so that all results are finite.
_FARTHEST: Final = 1.0
#: Feet closer together than this [m] define no line.
_COINCIDENT: Final = 1e-6


def diagonal_distance(point: ArrayLike, front_foot: ArrayLike, rear_foot: ArrayLike) -> Scalars:
    """Signed distance [m] of a point from the line through two feet (5.35), all of shape (..., 2) = (x, y).

    d = (a x + b y + c) / sqrt(a^2 + b^2), a = f_y - r_y, b = r_x - f_x, c = f_x r_y - f_y r_x. Positive means right of
    the line, looking from the rear foot to the front foot. Erratum: (5.35) is printed with an absolute value, but the
    method needs the sign. Feet that coincide have no line and give 0.
    """
    point, front, rear = (jnp.asarray(xy) for xy in (point, front_foot, rear_foot))
    a, b = front[..., 1] - rear[..., 1], rear[..., 0] - front[..., 0]
    # Distances are taken from the rear foot instead of using c, which avoids cancellation.
    product = a * (point[..., 0] - rear[..., 0]) + b * (point[..., 1] - rear[..., 1])
    squared = a**2 + b**2
    distinct = squared > _COINCIDENT**2
    return jnp.where(distinct, product, 0.0) / jnp.sqrt(jnp.where(distinct, squared, 1.0))


def balance_angle(
    masses: MassModel,
    feet: ArrayLike,
    stance: ArrayLike,
    geometry: Geometry,
    lift: ArrayLike = 0.0,
    limit: ArrayLike = SPINE.max_joint_angle,
) -> Scalars:
    """Spine joint angle theta_v [rad], within +-limit, that balances the robot on its stance feet.

    With one front and one rear foot on the ground, d = 0 on their line. With three, d = lift on the supporting
    diagonal, measured towards the third foot. Where the limit does not allow that, the closer end of the range. In all
    other cases, with four feet or without a line from front to rear, 0.

    Args:
        masses: the robot's two-mass model.
        feet: (y, z) of each foot from its own axis [m], shape (..., 4, 2); rear feet turn with the hip's frame.
        stance: which feet are on the ground, shape (..., 4), bool or a number above 0.5.
        geometry: the robot's.
        lift: d_lift, the desired distance of the centre of mass inside the triangle [m]: 0 on the diagonal (dynamic),
            0.009 as published (static).
        limit: largest angle [rad].
    """
    front, rear, third, supported = _support(jnp.asarray(stance) > 0.5)
    feet = jnp.clip(jnp.asarray(feet), -_FARTHEST, _FARTHEST)
    front, rear, third = (foot[..., None].astype(feet.dtype) for foot in (front, rear, third))

    def line(theta_v: ArrayLike) -> tuple[Array, Array, Array]:
        ground = feet_positions(theta_v, feet, geometry)[..., :2]
        return ground, jnp.sum(front * ground, axis=-2), jnp.sum(rear * ground, axis=-2)

    def distance(theta_v: ArrayLike) -> Array:
        _, front_foot, rear_foot = line(theta_v)
        return diagonal_distance(centre_of_mass(masses, theta_v, geometry)[..., :2], front_foot, rear_foot)

    ground, front_foot, rear_foot = line(0.0)
    has_third = jnp.any(third > 0, axis=(-2, -1))
    side = jnp.sign(diagonal_distance(jnp.sum(third * ground, axis=-2), front_foot, rear_foot))
    limit = jnp.broadcast_to(jnp.asarray(limit, feet.dtype), supported.shape)
    ends = distance(jnp.stack([-limit, limit]))
    wanted = jnp.clip(jnp.where(has_third, side * lift, 0.0), jnp.min(ends, axis=0), jnp.max(ends, axis=0))
    angle = bracketed_root(lambda theta_v: distance(theta_v) - wanted, -limit, limit, slope_floor=1e-3)
    return jnp.where(supported, angle, 0.0)


def _support(stance: TruthPerLimb) -> tuple[Array, Array, Array, Array]:
    """Masks (..., 4) of the line's front and rear foot and of the third foot, and whether there is a line.

    Two feet in stance at the same end of the body leave the choice to the other end, whose single foot selects the one
    diagonally opposite: with three feet, only one diagonal supports.
    """
    fronts, rears = stance[..., :2], stance[..., 2:]
    n_front, n_rear = jnp.sum(fronts, axis=-1, keepdims=True), jnp.sum(rears, axis=-1, keepdims=True)
    front_foot = jnp.where(n_front == 1, fronts, rears[..., ::-1] & (n_front == 2))
    rear_foot = jnp.where(n_rear == 1, rears, fronts[..., ::-1] & (n_rear == 2))
    none = jnp.zeros_like(fronts)
    front = jnp.concatenate([front_foot, none], axis=-1)
    rear = jnp.concatenate([none, rear_foot], axis=-1)
    n_feet = (n_front + n_rear)[..., 0]
    supported = (n_front[..., 0] >= 1) & (n_rear[..., 0] >= 1) & (n_feet < 4)
    return front, rear, stance & ~front & ~rear, supported
