"""Speed and turning: stride from the commanded speed, each leg's share from the turn rate, and theoretical radii.

A positive turn rate turns left, so it shortens the left legs' strides.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from nermo_mjx.control.parameters import ControlParameters, Gait, Stance, Turning
from nermo_mjx.control.trajectory import neutral_feet, signed_power
from nermo_mjx.kinematics.body import feet_positions
from nermo_mjx.kinematics.leg import bracketed_root
from nermo_mjx.kinematics.spine import joint_angle, transform, yaw
from nermo_mjx.robot.geometry import Geometry, dh_table, geometry_of
from nermo_mjx.robot.parameters import LIMBS, SPINE_GEOMETRY
from nermo_mjx.shapes import Array, Broadcastable, PerLimb, Planar, Scalar, Scalars

#: Turn rate below which the turning curve is linear (see `signed_power`).
LINEAR_CURVE_TURN_RATE = 1e-3

#: Curvature treated as zero, of the size of rounding errors in the theory and its inversion [1/m].
STRAIGHT_CURVATURE = 1e-5

_LIMB_SIDE_SIGNS = tuple(1.0 if limb.endswith("left") else -1.0 for limb in LIMBS)


def body_speed(gait: Gait, stride: Scalars) -> Scalars:
    """Speed without slip, v = f * gait factor * stride (5.21, 5.22) [m/s of the controller's clock]."""
    return gait.frequency * gait.gait_factor * stride


def stride_length(gait: Gait, stance: Stance, speed: Scalars) -> Scalars:
    """Stride for a commanded speed [m/s of the controller's clock]: (5.22) solved for the stride, saturated at
    `max_stride`, times the normalised stride [m]."""
    per_stride = jnp.maximum(gait.frequency * gait.gait_factor, 1e-6)
    return jnp.clip(speed / per_stride, 0.0, stance.max_stride) * gait.stride


def turning_curve(turn_rate: Broadcastable, exponent: Broadcastable) -> Broadcastable:
    """c(a) = sign(a)|a|^t of (5.38, 5.39). Errata: the sign is kept, and t = 0 means leg modulation off."""
    on = exponent > 0.0
    return jnp.where(
        on, signed_power(turn_rate, jnp.where(on, exponent, 1.0), LINEAR_CURVE_TURN_RATE), 0.0
    )


def stride_shares(turning: Turning, turn_rate: Scalars) -> PerLimb:
    """alpha_left = min(1 - c, 1) and alpha_right = min(1 + c, 1) for the four legs (5.38, 5.39).

    Full input stops the inner legs' stride. Both are in [0, 1].
    """
    curve = turning_curve(
        jnp.clip(turn_rate * turning.leg, -1.0, 1.0), jnp.asarray(turning.exponent)
    )
    return jnp.minimum(
        1.0 - jnp.asarray(_LIMB_SIDE_SIGNS, dtype=curve.dtype) * curve[..., None], 1.0
    )


def spine_share(turning: Turning, turn_rate: Scalars) -> Scalars:
    """alpha_tr of (5.45), the part of the turn rate that the spine takes, in [-1, 1]."""
    return jnp.clip(turn_rate * turning.spine, -1.0, 1.0)


def leg_curvature(stride: Scalars, share_difference: Scalars, diagonal: Scalars) -> Scalars:
    """1/r of `leg_radius` with the sign of `share_difference` [1/m], alpha_right - alpha_left; positive left."""
    half = 0.5 * stride * share_difference / diagonal
    return share_difference / diagonal * jnp.sinc(half / jnp.pi)


def leg_radius(
    stride: Broadcastable, share_difference: Broadcastable, diagonal: Broadcastable
) -> Broadcastable:
    """Radius of leg-based turning without slip (5.40-5.42) [m]; infinite when the strides of both sides are equal.

    r = l_s sin((pi - th)/2) / sin(th) with th = l_s |alpha_left - alpha_right| / d_diag. It equals
    l_s / (2 sin(th/2)), which is what is computed; for a small th that is d_diag / |alpha_left - alpha_right|.

    Args:
        stride: l_s [m].
        share_difference: |alpha_left - alpha_right|, in [0, 1].
        diagonal: d_diag, the distance between the feet of the alternating diagonal pair [m], from `foot_diagonals`.
    """
    curvature = leg_curvature(stride, jnp.abs(share_difference), diagonal)
    straight = curvature == 0.0
    return jnp.where(straight, jnp.inf, 1.0 / jnp.where(straight, 1.0, curvature))


def spine_radius(
    theta_v: Broadcastable, to_joint: Broadcastable, from_joint: Broadcastable
) -> tuple[Broadcastable, Broadcastable]:
    """Radii of spine-based turning without slip, from the shoulder axis (5.43) and the hip axis (5.44) [m].

    r_shoulder = l_sp2/th + l_sp1/tan(th) and r_hip = l_sp2/th + l_sp1/sin(th), with th = 4 theta_v as published; the
    chain of Table 5.3 turns by 3.81 theta_v (erratum 17, `spine.yaw`). The formula describes the axles of a wagon,
    whose inner wheels travel a shorter distance: a robot whose inner legs step as far as the outer ones does not reach
    this radius, see `path_curvature`.

    Args:
        theta_v: angle of each lateral joint, not 0 [rad].
        to_joint: l_sp1, shoulder axis to the first lateral joint [m].
        from_joint: l_sp2, first lateral joint to the hip axis [m].
    """
    turn = 4.0 * jnp.abs(theta_v)
    bend = from_joint / turn
    return bend + to_joint / jnp.tan(turn), bend + to_joint / jnp.sin(turn)


def foot_diagonals(stance: Stance, theta_v: Scalars, geometry: Geometry) -> Planar:
    """d_diag(theta_v): horizontal distance between the neutral feet of the pairs FL-RR and FR-RL [m].

    Measured between the feet, which gives the published 0.151 m of leg-based turning; between the axes of shoulder and
    hip (`body.diagonals`) it would be 0.147 m. Neither gives the published 0.134 m of mix-based turning at 0.1 rad:
    the feet give 0.145 m, the axes 0.139 m.
    """
    feet = feet_positions(theta_v, neutral_feet(stance), geometry)[..., :2]
    return jnp.linalg.norm(feet[..., :2, :] - feet[..., 3:1:-1, :], axis=-1)


def smallest_radius(
    stride: Scalars, stance: Stance, theta_v: Scalars, geometry: Geometry
) -> Scalars:
    """Theoretical radius at full lock, leg-based at theta_v = 0 and mix-based otherwise (5.40-5.42) [m].

    The mix-based robot turns about the pair that the bent spine brings closer together, the shorter diagonal.
    """
    return leg_radius(
        stride, jnp.asarray(1.0), jnp.min(foot_diagonals(stance, theta_v, geometry), axis=-1)
    )


def path_curvature(params: ControlParameters, turn_rate: Scalars) -> Scalars:
    """Expected curvature of the path at a turn rate [1/m], at the gait's commanded speed; positive left.

    The legs' part is less than (5.40-5.42): two feet on the ground at different speeds can turn the body only by the
    velocity component across the line that joins them, and slip along it. With w their lateral distance, the body turns
    by l_s |alpha_left - alpha_right| w / d_diag^2 while it advances by the mean of both strides. For the same reason
    the spine's part is less than (5.43), which assumes shorter strides of the inner feet: with equal strides a bent
    robot turns by theta L / d_diag^2 per metre, L being the distance of the two feet along the body: 0.44 m at 0.4 rad
    of servo instead of 0.28. Both parts add up. The ratio of the simulated robot's curvature to this is the pilot's
    `grip`.
    """
    return _path_curvature(params, _turn_of_two_feet(params), turn_rate)


def walked(
    params: ControlParameters,
    points: Float[Array, "4 3 2"],
    stance: Bool[Array, " 4"],
    turn_rate: Scalar,
) -> tuple[Scalar, Scalar]:
    """(speed [m/s], yaw rate [rad/s, positive left]) expected from the legs' current strides.

    As `path_curvature`, but from the strides that the legs have adopted so far: a leg adopts its new stride when it
    switches, so the legs' turn lags the command by half a gait cycle. The spine follows at once. On the controller's
    clock.

    Args:
        params: unbatched parameters.
        points: control points of the half-cycles that the legs are in [m].
        stance: planned contact. Uses the legs on the ground, and those in the air on a side that has none on the
        ground.
        turn_rate: the current one, for the spine.
    """
    feet = _turn_of_two_feet(params)
    strides = jnp.abs(points[:, 2, 0] - points[:, 0, 0])
    weight = jnp.where(stance, 1.0, 1e-3)
    left_step, right = (
        jnp.sum(weight * strides * of_side) / jnp.sum(weight * of_side)
        for of_side in (jnp.asarray(_LIMB_SIDE_SIGNS) > 0.0, jnp.asarray(_LIMB_SIDE_SIGNS) < 0.0)
    )
    per_stride = params.gait.frequency * params.gait.gait_factor
    speed = 0.5 * (left_step + right) * per_stride
    return speed, (right - left_step) * feet.across * per_stride + speed * _spine_part(
        params, feet, turn_rate
    )


@jax.jit  # traced once for its four uses in a walk, which saves 0.4 s at every start
def turn_rate_for(params: ControlParameters, curvature: Scalars) -> Scalars:
    """Turn rate in [-1, 1] whose `path_curvature` is the one given [1/m]; full lock if it cannot be reached.

    The curvature is an odd, increasing function of the turn rate, so its magnitude is found in [0, 1] and gets the
    sign.
    """
    feet = _turn_of_two_feet(params)
    full = _path_curvature(params, feet, jnp.ones_like(curvature))
    target = jnp.clip(jnp.abs(curvature), 0.0, full)
    # Legs or spine alone would need more than both together; if only one of them turns, that is the root.
    start = jnp.minimum(
        _turn_rate_of_legs(params, feet, target),
        target / jnp.maximum(_spine_part(params, feet, jnp.ones_like(target)), 1e-9),
    )
    rate = bracketed_root(
        lambda rate: _path_curvature(params, feet, rate) - target,
        0.0,
        1.0,
        slope_floor=1e-4,
        start=jnp.minimum(start, 1.0),
    )
    return jnp.where(target > STRAIGHT_CURVATURE, jnp.sign(curvature) * rate, 0.0)


class _TwoFeet(NamedTuple):
    """(w, L) / d_diag^2 of a diagonal's neutral feet, at the distances w across and L along the body [1/m]."""

    across: Scalars
    along: Scalars


def _turn_of_two_feet(params: ControlParameters) -> _TwoFeet:
    feet = feet_positions(0.0, neutral_feet(params.stance), geometry_of(params))[..., :2]
    distance = jnp.abs(feet[..., 0, :] - feet[..., 3, :])
    turn = distance / jnp.sum(distance**2, axis=-1, keepdims=True)
    return _TwoFeet(turn[..., 0], turn[..., 1])


def _path_curvature(params: ControlParameters, feet: _TwoFeet, turn_rate: Scalars) -> Scalars:
    shares = stride_shares(params.turning, turn_rate)
    legs = (shares[..., 1] - shares[..., 0]) * feet.across / jnp.mean(shares, axis=-1)
    return legs + _spine_part(params, feet, turn_rate)


def _spine_part(params: ControlParameters, feet: _TwoFeet, turn_rate: Scalars) -> Scalars:
    """The spine's part of `path_curvature` [1/m]."""
    return feet.along * yaw(
        joint_angle(
            params.spine.max_servo_angle * spine_share(params.turning, turn_rate),
            geometry_of(params),
        )
    )


def _turn_rate_of_legs(params: ControlParameters, feet: _TwoFeet, curvature: Scalars) -> Scalars:
    """Turn rate for a curvature >= 0 [1/m] without the spine, ignoring the linear part of the turning curve near 0; at
    most 1.

    With c = a^t the shares are 1 - c and 1, so that the curvature is k c / (1 - c / 2).
    """
    turning = params.turning
    curve = jnp.minimum(curvature / (feet.across + 0.5 * curvature), 1.0)
    positive = (curve > 0.0) & (turning.exponent > 0.0)
    power = jnp.where(positive, curve, 1.0) ** (1.0 / jnp.where(positive, turning.exponent, 1.0))
    return jnp.where(curve > 0.0, power / jnp.maximum(turning.leg, 1e-9), 0.0)


def spine_lengths(geometry: Geometry) -> tuple[float, float]:
    """(l_sp1, l_sp2): shoulder axis to the first lateral joint, and from there to the hip axis, along y [m]."""
    first = SPINE_GEOMETRY.lateral_joints[0]
    base, link = dh_table(geometry)[first - 1 : first + 1]
    joint = base[1] + link[1] * math.cos(base[2])
    hip = float(np.asarray(transform(0.0, geometry))[1, 3]) + float(geometry.hip.y)
    return joint - float(geometry.shoulder.y), hip - joint
