"""Forward and inverse kinematics of front and rear legs, for all routings of the knee tendon.

A foot is a point (y, z) from the hip or shoulder axis O: y is backward, z is up. The servo angles are q1 of the hip and
q2 of the knee. The knee angle theta_1 depends on both, because a tendon connects the knee with its servo. s = +1 or -1
is the direction in which the knee bends (`Leg.knee_direction`). With u(a) = (sin a, -cos a), equations (5.1) and (5.20)
of the thesis have one form:

    knee A = l1 u(q1)             b = q1 + s theta_1
    B      = A + l2 u(b)          (tendon attachment)
    foot H = A + l3 u(b) + l4 u(b - theta_3)

Shin, ankle and foot are one rigid link of length L, so that O-A-H is a planar two-link arm, whose inverse is a cosine
rule with the knee on the side s. (The thesis integrates joint velocities instead, which drifts.)

Every function broadcasts over leading axes: leaves of `Leg`, angles and (..., 2) points. Values and first derivatives
are finite for every finite input: outside the workspace the result is the nearest pose, with `reachable` false.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from nermo_mjx.robot.geometry import (
    SMALLEST_LENGTH_METRES,
    Geometry,
    check_routing,
    lead_height,
    leg_geometry,
    pull,
    shank,
)
from nermo_mjx.robot.parameters import IDLER_RADIUS, SERVOS, LegGeometry, servo_range
from nermo_mjx.shapes import Array, PerLimb, Planar, Scalars

# ---
# Roots of monotonic scalar equations: Newton iteration inside of a bracket, with an implicit derivative.


#: Maximum number of steps. Ten steps reach double precision everywhere in the workspace; the others are a margin.
MAX_STEPS: Final = 14


class _Search(NamedTuple):
    """State of the iteration: number of steps, ends of the bracket, estimates of the roots, and which have converged."""

    steps: Array
    low: Array
    high: Array
    root: Array
    converged: Array


def bracketed_root(
    residual: Callable[[Array], Array],
    low: ArrayLike,
    high: ArrayLike,
    slope_floor: float,
    start: ArrayLike | None = None,
) -> Scalars:
    """The x in [low, high] with residual(x) = 0, element by element.

    Args:
        residual: Elementwise function that is monotonic (rising or falling) in x, with opposite signs (or zero) at the
            ends; it broadcasts over leading axes of x. It may close over traced arrays: the implicit function theorem
            provides the derivatives with respect to them.
        low, high: Ends of the bracket; their shapes broadcast with the shape of the residual. The derivative of the root
            does not depend on them. If an end is the root, no step is needed.
        slope_floor: Lower limit of the absolute slope of the residual, which keeps the derivative finite if it is flat.
        start: Initial estimate in [low, high], by default the middle. A good estimate only saves steps.
    """
    low, high = jnp.broadcast_arrays(low, high)
    value = jax.eval_shape(residual, low)
    shape = jnp.broadcast_shapes(low.shape, value.shape)
    dtype = jnp.promote_types(low.dtype, value.dtype)
    low, high = (
        jax.lax.stop_gradient(jnp.broadcast_to(end.astype(dtype), shape)) for end in (low, high)
    )
    guess = (
        0.5 * (low + high)
        if start is None
        else jax.lax.stop_gradient(jnp.broadcast_to(start, shape).astype(dtype))
    )
    # Tolerance of the bracket's ends, and the relative size of a step after which an element has converged.
    end_tolerance, step_tolerance = (
        8 * jnp.finfo(dtype).eps,
        0.1 * float(jnp.finfo(dtype).eps) ** 0.5,
    )

    # A quotient whose divisor has at least the absolute value `slope_floor`.
    def divide(value: Array, slope: Array) -> Array:
        return value / jnp.where(
            jnp.abs(slope) < slope_floor, jnp.where(slope < 0, -slope_floor, slope_floor), slope
        )

    def solve(f: Callable[[Array], Array], start: Array) -> Array:
        at_low, at_high = f(low), f(high)
        rising = at_high >= at_low

        def goes_on(state: _Search) -> Array:
            return (state.steps < MAX_STEPS) & ~state.converged.all()

        def step(state: _Search) -> _Search:
            i, a, b, x, converged = state
            value, slope = jax.jvp(f, (x,), (jnp.ones_like(x),))
            # Positive if x is above the root.
            rising_value = jnp.where(rising, value, -value)
            a, b = jnp.where(rising_value <= 0, x, a), jnp.where(rising_value >= 0, x, b)
            newton = x - divide(value, slope)
            is_inside = (newton >= a - end_tolerance) & (newton <= b + end_tolerance)
            # A step that leaves the bracket goes alternately to the nearer end, where saturated roots are, and to the
            # middle.
            safe_x = jnp.where(i % 2 == 0, jnp.clip(newton, a, b), 0.5 * (a + b))
            next_x = jnp.where(is_inside, jnp.clip(newton, a, b), safe_x)
            # The error after a Newton step is proportional to the square of the step. Converged elements no longer
            # change, so that no element depends on the other elements.
            step_size = jnp.abs(next_x - x)
            is_done = is_inside & (step_size <= step_tolerance * jnp.maximum(jnp.abs(x), 1e-3))
            return _Search(i + 1, a, b, jnp.where(converged, x, next_x), converged | is_done)

        at_end = (at_low == 0) | (at_high == 0)
        start = jnp.where(at_low == 0, low, jnp.where(at_high == 0, high, start))
        initial = _Search(jnp.int32(0), low, high, start, at_end)
        # Both loops find the same root. On an accelerator, a loop of unknown length waits for the host in each step.
        return jax.lax.platform_dependent(
            initial,
            cpu=lambda search: jax.lax.while_loop(goes_on, step, search).root,
            default=lambda search: (
                jax.lax.fori_loop(0, MAX_STEPS, lambda _, current: step(current), search).root
            ),
        )

    def tangent_solve(linear: Callable[[Array], Array], value: Array) -> Array:
        return divide(value, linear(jnp.ones_like(value)))

    def broadcast_residual(x: Array) -> Array:
        return jnp.broadcast_to(residual(x), x.shape).astype(dtype)

    return jax.lax.custom_root(broadcast_residual, guess, solve, tangent_solve)


# ---
# The routings of the knee tendon from the pulley of the servo to the shin, and the knee angles that each can hold.
#
# For each routing, the length of the tendon is l_t = l_t0 + r_p (theta_2 + k q2): l_t0 is the length at q2 = 0, r_p the
# radius of the pulley, theta_2 the angle around which the tendon is wrapped, and k the direction of the servo.
# `robot.geometry.pull` returns l_t - r_p theta_2, which depends on the hip angle and the knee angle only, so that the
# servo angle is (pull - l_t0) / (k r_p). As in that file, y is multiplied by the knee direction s.


#: Margin to the singular ends of the knee's range, where the foot or the tendon no longer determines the knee [rad].
KNEE_MARGIN_RAD: Final = 0.05


def knee_range(leg: Leg, q1: ArrayLike, routing: str) -> tuple[Array, Array, Array]:
    """Lowest and highest knee angle theta_1 [rad] at hip angle q1, and whether the routing works at this hip angle.

    Two conditions limit the range, each with a margin of `KNEE_MARGIN_RAD`. First, the foot must determine the knee
    angle (`arm_range`). Second, the tendon must flex the knee: its lever arm vanishes at two dead centres, where B is on
    the line from A to the hip axis (type 3, at 0 and pi), to the guide point (type 2), or on the tangent from A to the
    pulley (type 1). Between the dead centres, `pull` is monotonic. With type 3, the range is 0.05 to 2.93 rad for front
    legs and 0.54 to 3.09 rad for rear legs. Type 1 works while the pulley is farther from the knee than B, which is
    false only if the leg is turned upward.
    """
    low, high = arm_range(leg)
    limit, works = _dead_centre(leg, q1, routing)
    low = jnp.maximum(low, limit - math.pi + KNEE_MARGIN_RAD)
    high = jnp.maximum(jnp.minimum(high, limit - KNEE_MARGIN_RAD), low + KNEE_MARGIN_RAD)
    return low, high, works


def arm_range(leg: Leg) -> tuple[Array, Array]:
    """Lowest and highest knee angle [rad] at which the distance of the foot from O determines the knee angle.

    The tendon is not considered. The knee and the arm O-A-H are stretched at different knee angles, and folded at
    different knee angles, because H is not on the line of the shin. The range excludes all four angles.
    """
    bend = leg.knee_direction * shank(leg)[1]
    low = jnp.maximum(bend, 0.0) + KNEE_MARGIN_RAD
    return low, jnp.minimum(bend, 0.0) + math.pi - KNEE_MARGIN_RAD


def _dead_centre(leg: Leg, q1: ArrayLike, routing: str) -> tuple[Array, Array]:
    """The dead centre with a folded knee, where the line of the tendon passes through the knee; whether the routing works.

    It is pi for type 3. The other dead centre is the knee angle that is smaller by pi.
    """
    check_routing(routing)
    if routing == "type3":
        return jnp.full(jnp.shape(leg.l1), math.pi), jnp.asarray(True)
    if routing == "type2":
        y, z = leg.knee_direction * leg.guide[..., 0], leg.guide[..., 1]
    elif routing == "type3_idler":
        y, z = 0.0, lead_height(leg)
    else:
        y, z = 0.0, leg.pulley_height
    sin, cos = jnp.sin(leg.knee_direction * q1), jnp.cos(q1)
    # From the knee A to the guide point or pulley centre: along the upper leg towards O, and across it.
    towards = leg.l1 - (y * sin - z * cos)
    across = -(y * cos + z * sin)
    angle = math.pi + jnp.arctan2(across, towards)
    if routing == "type2":
        return angle, jnp.asarray(True)
    if (
        routing == "type3_idler"
    ):  # on the other side of the axis than type 1 of the pulley, or straight past the idler
        return jnp.maximum(math.pi + jnp.arcsin(IDLER_RADIUS / leg.l1), angle), jnp.asarray(True)
    distance = jnp.sqrt(jnp.maximum(towards**2 + across**2, SMALLEST_LENGTH_METRES**2))
    tangent_angle = jnp.arcsin(jnp.minimum(leg.pulley_radius / distance, 0.9))
    return angle - tangent_angle, distance**2 > (
        leg.l2 + SMALLEST_LENGTH_METRES
    ) ** 2 + leg.pulley_radius**2


#: Tolerance for rounding in float32: a foot or a tendon that is outside of its range by less is reachable [m].
REACH_TOLERANCE: Final = 1e-6
#: Largest absolute value of an angle; larger ones are clipped, so that sums of angles are finite [rad].
_LARGEST_ANGLE_RAD: Final = 1e6
#: A foot that is farther from O than `_LARGEST_REACH` is moved toward O. A foot that is closer than `_SMALLEST_REACH` has
#: no direction from O [m].
_LARGEST_REACH, _SMALLEST_REACH = 1.0, 1e-6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Leg:
    """Lengths and positions of a leg as array leaves; `robot.parameters.LegGeometry` explains each of them.

    The leaves of one leg have shape (). They may have leading batch axes, and may be differentiated. `guide` has a
    trailing axis (y, z).
    """

    l1: Float[Array | np.ndarray, "*batch"]
    l2: Float[Array | np.ndarray, "*batch"]
    l3: Float[Array | np.ndarray, "*batch"]
    l4: Float[Array | np.ndarray, "*batch"]
    theta3: Float[Array | np.ndarray, "*batch"]
    pulley_radius: Float[Array | np.ndarray, "*batch"]
    pulley_height: Float[Array | np.ndarray, "*batch"]
    tendon_length: Float[Array | np.ndarray, "*batch"]
    knee_direction: Float[Array | np.ndarray, "*batch"]
    servo_direction: Float[Array | np.ndarray, "*batch"]
    guide: Float[Array | np.ndarray, "*batch 2"]


class LegPoints(NamedTuple):
    """Points of a leg, (y, z) from O [m]: knee A, tendon attachment B, ankle, foot H."""

    knee: Planar
    attachment: Planar
    ankle: Planar
    foot: Planar


class LegPose(NamedTuple):
    """Result of forward kinematics: foot (y, z) [m], knee angle theta_1 [rad], and whether the tendon can be taut."""

    foot: Planar
    knee_angle: Scalars
    reachable: Bool[Array, "*batch"]


class LegSolution(NamedTuple):
    """Result of inverse kinematics: servo angles (q1, q2) and knee angle [rad], the foot that they reach [m], and whether
    this is the requested foot."""

    servo: Planar
    knee_angle: Scalars
    foot: Planar
    reachable: Bool[Array, "*batch"]


def leg_of(geometry: LegGeometry) -> Leg:
    """The `Leg` of one `LegGeometry`, with leaves of shape () in NumPy's float64, which suit either precision of JAX."""
    return Leg(
        **{
            field.name: np.asarray(getattr(geometry, field.name), float)
            for field in dataclasses.fields(Leg)
        }
    )


def four_legs(geometry: Geometry) -> Leg:
    """The legs of a robot in the order FL, FR, RL, RR: leaves of shape (..., 4), `guide` of shape (4, 2).

    Leaves of the geometry may have leading batch axes. Leaves of the legs that do not depend on them have shape (4,).
    """
    traced = any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(geometry))
    xp: Any = jnp if traced else np

    def stacked(front: Any, rear: Any, axis: int) -> Any:
        return xp.stack(
            xp.broadcast_arrays(
                *(xp.asarray(values, float) for values in (front, front, rear, rear))
            ),
            axis,
        )

    front, rear = (leg_geometry(geometry, pair, xp) for pair in ("front", "rear"))
    return Leg(
        **{
            field.name: stacked(
                getattr(front, field.name),
                getattr(rear, field.name),
                -2 if field.name == "guide" else -1,
            )
            for field in dataclasses.fields(Leg)
        }
    )


def points(leg: Leg, q1: ArrayLike, knee_angle: ArrayLike, ankle: ArrayLike = 0.0) -> LegPoints:
    """Points of the leg at hip angle q1 and knee angle theta_1 [rad] (5.1, 5.20).

    `ankle` is the deflection [rad] of the compliant ankle, added to theta_3.
    """
    leg = _arrays(leg)
    q1, knee_angle, ankle = (_angle(angle) for angle in (q1, knee_angle, ankle))
    shin = q1 + leg.knee_direction * knee_angle
    knee = _polar(leg.l1, q1)
    ankle_point = knee + _polar(leg.l3, shin)
    foot = ankle_point + _polar(leg.l4, shin - leg.theta3 - ankle)
    return LegPoints(knee, knee + _polar(leg.l2, shin), ankle_point, foot)


def knee_servo(leg: Leg, q1: ArrayLike, knee_angle: ArrayLike, routing: str) -> Scalars:
    """Knee servo angle q2 [rad] with which a taut tendon holds the knee at theta_1; see the law of the routings above."""
    leg = _arrays(leg)
    length = pull(leg, _angle(q1), _angle(knee_angle), routing)
    return (length - leg.tendon_length) / (leg.servo_direction * leg.pulley_radius)


def forward_kinematics(leg: Leg, servo: ArrayLike, routing: str) -> LegPose:
    """Foot of the leg at servo angles (q1, q2) [rad], shape (..., 2), with a taut tendon.

    If the tendon is longer or shorter than in `knee_range`, the knee is at the end of its range, and `reachable` is
    false.
    """
    leg, servo = _arrays(leg), jnp.asarray(servo)
    q1, q2 = _angle(servo[..., 0]), servo[..., 1]
    low, high, works = knee_range(leg, q1, routing)
    tendon_length = leg.tendon_length + leg.pulley_radius * leg.servo_direction * q2
    longest, shortest = pull(leg, q1, low, routing), pull(leg, q1, high, routing)
    length = jnp.clip(tendon_length, shortest, longest)
    if routing == "type3":
        cosine = (length**2 - leg.l1**2 - leg.l2**2) / (2 * leg.l1 * leg.l2)
        knee_angle = jnp.arccos(jnp.clip(cosine, jnp.cos(high), jnp.cos(low)))
    else:
        knee_angle = bracketed_root(
            lambda angle: pull(leg, q1, angle, routing) - length, low, high, slope_floor=1e-5
        )
    reachable = (
        works
        & (tendon_length >= shortest - REACH_TOLERANCE)
        & (tendon_length <= longest + REACH_TOLERANCE)
    )
    return LegPose(points(leg, q1, knee_angle).foot, knee_angle, reachable)


def inverse_kinematics(leg: Leg, foot: ArrayLike, routing: str) -> LegSolution:
    """Servo angles that put the foot at (y, z) from O [m], shape (..., 2): closed form for every routing.

    The workspace is a ring around O. A foot outside of the ring is moved to it along its radius (a foot at O is moved
    straight down). With types 1 and 2, the tendon cannot hold every knee angle near its dead centres (`knee_range`);
    such an angle becomes the nearest one that the tendon can hold.
    """
    check_routing(routing)
    leg, foot = _arrays(leg), jnp.asarray(foot)
    # Far outside of the workspace, the result depends on the direction of the foot only, so that the scale is constant
    # for the derivative.
    size = jnp.max(jnp.abs(foot), axis=-1, keepdims=True)
    y, z = jnp.moveaxis(
        foot / jax.lax.stop_gradient(jnp.maximum(size / _LARGEST_REACH, 1.0)), -1, 0
    )
    is_at_axis = y**2 + z**2 < _SMALLEST_REACH**2
    y, z = jnp.where(is_at_axis, 0.0, y), jnp.where(is_at_axis, -_SMALLEST_REACH, z)

    link, bend = shank(leg)
    low, high = arm_range(leg)
    cosine = (y**2 + z**2 - leg.l1**2 - link**2) / (2 * leg.l1 * link)
    arm_low, arm_high = (end - leg.knee_direction * bend for end in (low, high))
    arm = jnp.arccos(jnp.clip(cosine, jnp.cos(arm_high), jnp.cos(arm_low)))
    knee_angle = arm + leg.knee_direction * bend
    # At q1 = 0 the foot would be in the direction atan2(across, along) from O. The hip angle adds the rest.
    along, across = leg.l1 + link * jnp.cos(arm), leg.knee_direction * link * jnp.sin(arm)
    q1 = jnp.arctan2(y * along + z * across, y * across - z * along)

    tendon_low, tendon_high, works = knee_range(leg, q1, routing)
    tendon_taut = works & (knee_angle > tendon_low - 1e-5) & (knee_angle < tendon_high + 1e-5)
    knee_angle = jnp.clip(knee_angle, tendon_low, tendon_high)
    reached = points(leg, q1, knee_angle).foot
    error = jnp.max(jnp.abs(reached - jnp.stack([y, z], axis=-1)), axis=-1)
    servo = jnp.stack([q1, knee_servo(leg, q1, knee_angle, routing)], axis=-1)
    return LegSolution(servo, knee_angle, reached, tendon_taut & (error < REACH_TOLERANCE))


def four_reaches(geometry: Geometry, routing: str) -> tuple[PerLimb, PerLimb]:
    """Smallest and largest distance of the foot from O [m] in the workspace, for each of the `four_legs`.

    With type 3, the range of the knee servo limits the distance, too, because the knee angle depends on this servo only.
    """
    leg = _arrays(four_legs(geometry))
    low, high = arm_range(leg)
    if routing == "type3":
        # The knees' servos are the second four.
        servo_ends = [[servo_range(servo)[end] for servo in SERVOS[4:8]] for end in (0, 1)]
        knee_ends = [
            forward_kinematics(
                leg, jnp.stack([jnp.zeros(4), jnp.asarray(end)], axis=-1), routing
            ).knee_angle
            for end in servo_ends
        ]
        low, high = (
            jnp.maximum(low, jnp.minimum(*knee_ends)),
            jnp.minimum(high, jnp.maximum(*knee_ends)),
        )
    link, bend = shank(leg)
    arms = [knee - leg.knee_direction * bend for knee in (high, low)]
    near, far = (jnp.sqrt(leg.l1**2 + link**2 + 2 * leg.l1 * link * jnp.cos(arm)) for arm in arms)
    return near, far


def jacobian(leg: Leg, servo: ArrayLike, routing: str) -> Float[Array, "*batch 2 2"]:
    """Jacobian d(y, z) / d(q1, q2) of the foot [m/rad] at servo angles (..., 2); zero if the pose is at a limit."""
    servo = jnp.asarray(servo)
    zero = jnp.zeros(2, jnp.result_type(float, servo.dtype))
    return jax.jacfwd(lambda change: forward_kinematics(leg, servo + change, routing).foot)(zero)


def _arrays(leg: Leg) -> Leg:
    """The leg with JAX leaves in the current precision of JAX.

    JAX would cache NumPy constants in one precision, and use them after the precision has changed.
    """
    dtype = jnp.result_type(float)
    return jax.tree.map(
        lambda leaf: leaf if isinstance(leaf, jax.Array) else jnp.asarray(leaf, dtype), leg
    )


def _angle(angle: ArrayLike) -> Array:
    """The angle, clipped to finite values."""
    return jnp.clip(jnp.asarray(angle), -_LARGEST_ANGLE_RAD, _LARGEST_ANGLE_RAD)


def _polar(length: Array | np.ndarray, angle: Array) -> Planar:
    """length u(angle), with u(a) = (sin a, -cos a)."""
    return jnp.stack([length * jnp.sin(angle), -length * jnp.cos(angle)], axis=-1)
