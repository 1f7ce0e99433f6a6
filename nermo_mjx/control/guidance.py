"""Guidance of the profile `exact`: the commanded curvature, from a sway-free estimate of the course beside the path.

The torso sways by a centimetre and yaws back and forth in every gait cycle, because the spine bends and the legs push
alternately. A robot that steers against its sway limit-cycles, or steps longer on one side, since a leg adopts its new
stride only when it switches; and each turn by the legs costs speed, since it shortens strides. The gait's phase is
known, so the sway can be estimated together with the course, and ignored.

Two observers of the same form track the cross-track error and the heading. Between two steps, the observed system is
linear: a double integrator for the course (the value, and what drives it beyond the known input) and an oscillator for
each harmonic of the sway. The gains place the poles for any gait frequency and pilot rate: with a(z) the plant's
characteristic polynomial and p(z) the desired one, they are the partial fractions of p(z) / a(z)
at the plant's poles, in closed form.

The heading is measured, not just predicted from the turn rate, because the prediction is inaccurate: with the spine's
stride extension the trot responds to a turn by the legs with up to three times the yaw rate that it has without.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.control.parameters import Pilot
from nermo_mjx.shapes import Array, Scalar

#: Harmonics of the gait cycle that make up the sway. On a straight line right mirrors left after half a cycle, which
#: leaves only the odd ones; in a turn the second is added. Measured in trots with and without the spine: 5 to 8 mm
#: in the first, 1 to 2 mm in the third, 0.3 mm at most in the second and fourth.
HARMONICS: Final = (1, 2, 3)
#: Decay rate of the unexplained inputs relative to all other poles: for cross-track error and heading. The unexplained
#: turning is in the loop with a plant that may turn twice as much as expected, or half as much; estimated as fast as
#: the course, it made the trot with the spine oscillate with a period of four cycles.
SLOW: Final = (1.0, 0.4)
#: Look-ahead on a bend, as a share of its radius, see `correction`.
BEND: Final = 0.7
#: Longest step of the observer [gait cycles]: beyond it, a harmonic would alias to a slower one, or to its own mirror
#: image.
LONGEST_STEP: Final = 0.4 / max(HARMONICS)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Guidance:
    """Estimate of the robot's position and heading relative to its path.

    Attributes:
        course: cross-track error [m] and heading from the path's tangent [rad], without sway, positive left.
        unexplained: not accounted for by the observers' inputs: lateral speed relative to the heading [m/s], and yaw
            rate beyond the one expected from the strides [rad/s].
        sway: of both, cosine and sine of each of `HARMONICS` at the gait's phase [m, rad].
        cycles: time observed since the start [gait cycles].
    """

    course: Float[Array, " 2"]
    unexplained: Float[Array, " 2"]
    sway: Float[Array, "2 harmonics 2"]
    cycles: Scalar


def start(error: Scalar, heading: Scalar, speed: Scalar) -> Guidance:
    """Estimate at rest: the robot is assumed to walk along its path, whatever the torso's direction.

    Args:
        error: cross-track error [m].
        heading: from the path's tangent [rad].
        speed: of the walk [m/s].
    """
    zero = jnp.zeros_like(error)
    return Guidance(
        course=jnp.stack([error, heading]),
        unexplained=jnp.stack([-speed * heading, zero]),
        sway=jnp.zeros((2, len(HARMONICS), 2), error.dtype),
        cycles=zero,
    )


def observe(
    pilot: Pilot,
    state: Guidance,
    seen: Float[Array, " 2"],
    phase: Array,
    speed: Array,
    yaw_rate: Array,
    cycle_rate: Any,
    dt: float,
) -> Guidance:
    """One step of the observers (Luenberger, in the current-estimate form: each step uses its own reading).

    Args:
        pilot: `bandwidth`, of the observers [rad per gait cycle].
        state: the estimate before.
        seen: cross-track error [m] and heading from the path's tangent [rad] as measured.
        phase: of the gait cycle.
        speed: of the walk [m/s].
        yaw_rate: expected, relative to that of the path [rad/s].
        cycle_rate: gait cycles per second [1/s].
        dt: time since the last step [s].
    """
    course, sway = observer_gains(pilot.bandwidth, cycle_rate * dt)
    angle = 2.0 * jnp.pi * phase * jnp.asarray(HARMONICS, seen.dtype)
    wave = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    # The gain on an oscillator's complex amplitude is fixed in the frame that turns with it.
    real, imaginary = sway[..., :1], sway[..., 1:]
    turned = wave * real + wave[:, ::-1] * jnp.asarray([1.0, -1.0], seen.dtype) * imaginary

    known = jnp.stack([speed * jnp.sin(state.course[1]), yaw_rate])
    ahead = state.course + dt * (known + state.unexplained)
    surprise = seen - ahead - jnp.sum(wave * state.sway, axis=(1, 2))
    return Guidance(
        course=ahead + course[0] * surprise,
        unexplained=state.unexplained + course[1] / dt * surprise,
        sway=state.sway + turned * surprise[:, None, None],
        cycles=state.cycles + cycle_rate * dt,
    )


def observer_gains(
    bandwidth: Scalar | float, cycles: Scalar | float
) -> tuple[Float[Array, "2 2"], Float[Array, "2 harmonics 2"]]:
    """Gains that put each pole of an observer at exp(-bandwidth * cycles) of the plant's: stable for every bandwidth.

    The pole of the unexplained input is at exp(-SLOW * bandwidth * cycles).

    Args:
        bandwidth: [rad per gait cycle]; 0 leaves the estimate unchanged.
        cycles: length of a step [gait cycles]; limited to `LONGEST_STEP`.

    Returns:
        of (value, unexplained rate dt), the observers in the last axis, and real and imaginary part of each harmonic's,
        the observers in the first.
    """
    step = jnp.minimum(cycles, LONGEST_STEP)
    decay = jnp.exp(-bandwidth * step)
    closed = -jnp.expm1(-bandwidth * step)
    slow = -jnp.expm1(-jnp.asarray(SLOW) * bandwidth * step)
    angle = 2.0 * jnp.pi * step * jnp.asarray(HARMONICS, float)
    curve = 4.0 * jnp.sin(0.5 * angle) ** 2

    # p / a near z = 1 + w is (w + closed) (w + slow) / w^2 times, for each oscillator, (w^2 + n1 w + n0) / (w^2 + d w
    # + d) with n0 = closed^2 + decay d, n1 = 2 closed + decay d, d = 2 - 2 cos(angle). Up to w:
    series = (closed * slow, closed + slow)
    for each in range(len(HARMONICS)):
        d = curve[each]
        ratio0 = (closed**2 + decay * d) / d
        ratio1 = (2.0 * closed + decay * d - ratio0 * d) / d
        series = (series[0] * ratio0, series[1] * ratio0 + series[0] * ratio1)
    # The coefficients are those of the gains before the step; the step itself, (1, 1; 0, 1), is taken out of them.
    course = jnp.stack([series[1] - series[0], series[0]])

    turn = jnp.exp(1j * angle)
    sway = []
    for each in range(len(HARMONICS)):
        here = turn[each]
        rest = 2.0 * (here - decay) * (here - 1.0 + slow) / (here - 1.0) ** 2 / here
        for other in range(len(HARMONICS)):
            rest *= (here - decay * turn[other]) * (here - decay * turn[other].conj())
            rest /= (1.0 if other == each else here - turn[other]) * (here - turn[other].conj())
        sway.append(jnp.stack([rest.real, rest.imag], axis=-1))
    return course, jnp.stack(sway, axis=1)


def correction(pilot: Pilot, state: Guidance, speed: Array, curvature: Array) -> Scalar:
    """Curvature to add to the path's [1/m]: poles at 1 / look-ahead along the path, unexplained turning compensated.

    The look-ahead is `look_ahead` on a line, and at most `BEND` times the radius on a bend: if the robot turns less
    than expected, it leaves the path faster the tighter the bend is.

    It is ramped up over the 2 / `bandwidth` gait cycles in which the observers learn the sway: until then, apparent
    errors are mostly sway.

    Args:
        pilot: `look_ahead` [m], `damping` and `bandwidth`.
        state: the estimate.
        speed: of the walk [m/s].
        curvature: of the path [1/m].
    """
    per_way = jnp.sqrt(1.0 / pilot.look_ahead**2 + (curvature / BEND) ** 2)
    per_speed = 1.0 / jnp.maximum(speed, 0.01)
    error, heading = state.course
    drift, turn = state.unexplained * per_speed
    spring = error * per_way**2
    damper = 2.0 * pilot.damping * (jnp.sin(heading) + drift) * per_way
    learned = jnp.clip(pilot.bandwidth * state.cycles / 2.0, 0.0, 1.0)
    return -learned * (spring + damper + turn)
