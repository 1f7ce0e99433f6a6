"""Guidance of the profile `exact`: the curvature to walk, from an estimate of the cross-track error without its sway.

The torso sways by a centimetre in every gait cycle, because the spine bends and the legs push by turns. A robot that
steers against its sway limit-cycles, or steps longer on one side, since a leg takes up its new stride only when it
switches; and each turn by the legs costs speed, since it shortens strides. The gait's phase is known, so the sway can
be estimated beside the path error, and left alone.

Between two steps of the observer the plant is linear: a triple integrator for the path (error, rate, bias) and an
oscillator for each harmonic of the sway. The observer's gains put all its poles at the same decay, whatever the gait
frequency and the pilot's rate: with a(z) the plant's characteristic polynomial and p(z) the wanted one, the gains are
the partial fractions of p(z) / a(z) at the plant's poles, in closed form.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nermo_mjx.control.parameters import Pilot

#: Harmonics of the gait cycle of which the sway is made. On a straight line right mirrors left after half a cycle,
#: which leaves the odd ones; in a turn the second joins them. Measured in trots with and without the spine: 5 to 8 mm
#: in the first, 1 to 2 mm in the third, 0.3 mm at most in the second and fourth.
HARMONICS: Final = (1, 2, 3)
#: Longest step of the observer [gait cycles]: beyond, a harmonic would look like a slower one, or like its own mirror.
LONGEST_STEP: Final = 0.4 / max(HARMONICS)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Guidance:
    """Estimate of where the robot walks, beside its path.

    Attributes:
        error: cross-track error without sway, positive left [m].
        rate: its rate of change [m/s].
        bias: lateral acceleration that the turn rate does not explain: what the theory of turning leaves out [m/s^2].
        sway: cosine and sine of each of `HARMONICS` at the gait's phase [m].
        cycles: observed since the start [gait cycles].
    """

    error: Float[Array, ""]
    rate: Float[Array, ""]
    bias: Float[Array, ""]
    sway: Float[Array, "harmonics 2"]
    cycles: Float[Array, ""]


def start(error: Float[Array, ""]) -> Guidance:
    """Estimate at rest."""
    zero = jnp.zeros_like(error)
    return Guidance(error=error, rate=zero, bias=zero, sway=jnp.zeros((len(HARMONICS), 2), error.dtype), cycles=zero)


def observe(
    pilot: Pilot, state: Guidance, error: Array, phase: Array, turning: Array, cycle_rate: Any, dt: float
) -> Guidance:
    """One step of the observer (Luenberger, in its current form: the reading of this step is used in this step).

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
    path, sway = observer_gains(pilot.bandwidth, cycle_rate * dt)
    angle = 2.0 * jnp.pi * phase * jnp.asarray(HARMONICS, error.dtype)
    wave = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    # The gain on an oscillator's complex amplitude is fixed in the frame that turns with it.
    real, imaginary = sway[:, :1], sway[:, 1:]
    turned = wave * real + wave[:, ::-1] * jnp.asarray([1.0, -1.0], error.dtype) * imaginary

    pushed = turning + state.bias
    ahead = state.error + dt * state.rate + 0.5 * dt**2 * pushed
    surprise = error - ahead - jnp.sum(wave * state.sway)
    return Guidance(
        error=ahead + path[0] * surprise,
        rate=state.rate + dt * pushed + path[1] / dt * surprise,
        bias=state.bias + path[2] / dt**2 * surprise,
        sway=state.sway + turned * surprise,
        cycles=state.cycles + cycle_rate * dt,
    )


def observer_gains(
    bandwidth: Float[Array, ""] | float, cycles: Float[Array, ""] | float
) -> tuple[Float[Array, " 3"], Float[Array, "harmonics 2"]]:
    """Gains that put each pole of the observer at exp(-bandwidth * cycles) of the plant's: stable for every bandwidth.

    Args:
        bandwidth: [rad per gait cycle]; 0 lets the estimate be.
        cycles: length of a step [gait cycles]; longer ones than `LONGEST_STEP` count as that long.

    Returns:
        of (error, rate dt, bias dt^2), and real and imaginary part of each harmonic's.
    """
    step = jnp.minimum(cycles, LONGEST_STEP)
    decay = jnp.exp(-bandwidth * step)
    closed = -jnp.expm1(-bandwidth * step)
    angle = 2.0 * jnp.pi * step * jnp.asarray(HARMONICS, float)
    curve = 4.0 * jnp.sin(0.5 * angle) ** 2

    # p / a near z = 1 + w is (w + closed)^3 / w^3 times, for each oscillator, (w^2 + n1 w + n0) / (w^2 + d w + d) with
    # n0 = closed^2 + decay d, n1 = 2 closed + decay d, d = 2 - 2 cos(angle). Up to w^2:
    series = (closed**3, 3.0 * closed**2, 3.0 * closed)
    for each in range(len(HARMONICS)):
        d = curve[each]
        ratio0 = (closed**2 + decay * d) / d
        ratio1 = (2.0 * closed + decay * d - ratio0 * d) / d
        ratio2 = (1.0 - ratio0 - ratio1 * d) / d
        series = (
            series[0] * ratio0,
            series[1] * ratio0 + series[0] * ratio1,
            series[2] * ratio0 + series[1] * ratio1 + series[0] * ratio2,
        )
    # The coefficients are those of the gains before the step; the step itself, (1, 1, 1/2; 0, 1, 1; 0, 0, 1), is
    # taken out of them.
    third, second, first = series[0], series[1] - 0.5 * series[0], series[2]
    path = jnp.stack([first - second + 0.5 * third, second - third, third])

    turn = jnp.exp(1j * angle)
    sway = []
    for each in range(len(HARMONICS)):
        here = turn[each]
        rest = 2.0 * ((here - decay) / (here - 1.0)) ** 3 / here
        for other in range(len(HARMONICS)):
            rest *= (here - decay * turn[other]) * (here - decay * turn[other].conj())
            rest /= (1.0 if other == each else here - turn[other]) * (here - turn[other].conj())
        sway.append(jnp.stack([rest.real, rest.imag]))
    return path, jnp.stack(sway)


def correction(pilot: Pilot, state: Guidance, speed: Array) -> Float[Array, ""]:
    """Curvature to add to the path's [1/m]: poles of the way walked at 1/`look_ahead`, and the bias taken back.

    It grows to its full size in the 3 / `bandwidth` gait cycles in which the observer learns the sway: what it takes
    for an error before is mostly sway.

    Args:
        pilot: `look_ahead` [m], `damping` and `bandwidth`.
        state: the estimate.
        speed: of the walk [m/s].
    """
    per_speed = 1.0 / jnp.maximum(speed, 0.01)
    spring = state.error / pilot.look_ahead**2
    damper = 2.0 * pilot.damping * state.rate * per_speed / pilot.look_ahead
    learned = jnp.clip(pilot.bandwidth * state.cycles / 3.0, 0.0, 1.0)
    return -learned * (spring + damper + state.bias * per_speed**2)
