"""MJX's integrators with derivatives that are also correct for a body that does not rotate.

MJX normalises the angular velocity to turn a quaternion. Its safe norm is constant at zero, so in the derivative a body
at rest would keep its orientation under any torque. The positions are integrated here instead, with the
exponential map, whose derivative is smooth; the values are the same to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.dynamics.linear import solve_definite
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.shapes import Array, Dofs

#: Integrators that `integrate` supports; MJX's enumeration also has DISCRETE, with which it cannot step.
INTEGRATORS: Final = (mjx.IntegratorType.EULER, mjx.IntegratorType.RK4, mjx.IntegratorType.IMPLICITFAST)

#: Nodes a and weights b of the classical Runge-Kutta method of fourth order.
_RK4_NODES: Final = (0.5, 0.5, 1.0)
_RK4_WEIGHTS: Final = (1 / 6, 1 / 3, 1 / 3, 1 / 6)

Forward = Callable[[mjx.Model, mjx.Data], mjx.Data]
#: Velocity, acceleration and rate of activation.
Rates = tuple[Array, Array, Array]


def integrate(model: mjx.Model, data: mjx.Data, forward: Forward) -> mjx.Data:
    """State one time step later, by the model's integrator.

    Args:
        model: its integrator is one of `INTEGRATORS`.
        data: after forward dynamics.
        forward: forward dynamics, for the stages of RK4.
    """
    if model.opt.integrator == mjx.IntegratorType.RK4:
        return _runge_kutta(model, data, forward)
    if model.opt.integrator == mjx.IntegratorType.EULER:
        after, qacc = mjx.euler(model, data), _damped_acceleration(model, data)
        after = after.replace(qvel=data.qvel + model.opt.timestep * qacc)
    else:
        after = mjx.implicit(model, data)
    return after.replace(qpos=positions(model, data.qpos, model.opt.timestep * after.qvel))


def _damped_acceleration(model: mjx.Model, data: mjx.Data) -> Dofs:
    """Acceleration of Euler's method, implicit in the joints' damping B: (M + h B) a = q + J^T f."""
    if model.opt.disableflags & mjx.DisableBit.EULERDAMP:
        qacc: Array = data.qacc
        return qacc
    matrix = mjx.full_m(model, data) + jnp.diag(model.opt.timestep * model.dof_damping)
    return solve_definite(matrix, data.qfrc_smooth + data.qfrc_constraint)


def _runge_kutta(model: mjx.Model, start: mjx.Data, forward: Forward) -> mjx.Data:
    dt = model.opt.timestep

    def stage(rates: Rates, node: Array) -> tuple[Rates, Rates]:
        velocity, acceleration, activation = (node * dt * rate for rate in rates)
        data = start.replace(
            qpos=positions(model, start.qpos, velocity), qvel=start.qvel + acceleration, act=start.act + activation,
            time=start.time + node * dt,
        )  # fmt: skip
        after = forward(model, data)
        found = (data.qvel, after.qacc, after.act_dot)
        return found, found

    first = (start.qvel, start.qacc, start.act_dot)
    # A scan, so that forward dynamics is compiled once for all three stages.
    _, others = jax.lax.scan(stage, first, jnp.asarray(_RK4_NODES, start.qpos.dtype))
    weight = jnp.asarray(_RK4_WEIGHTS[1:], start.qpos.dtype)
    velocity, acceleration, activation = (
        _RK4_WEIGHTS[0] * one + weight @ rest for one, rest in zip(first, others, strict=True)
    )
    # Activation and time advance as in an Euler step.
    after = mjx.euler(model, start.replace(act_dot=activation))
    return after.replace(qpos=positions(model, start.qpos, dt * velocity), qvel=start.qvel + dt * acceleration)


def positions(model: mjx.Model, qpos: Float[Array, " nq"], change: Dofs) -> Float[Array, " nq"]:
    """`qpos` after a change in the tangent space, a velocity times a time."""
    parts = []
    for kind, q, v in zip(np.asarray(model.jnt_type), model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind == mjx.JointType.FREE:
            parts += [qpos[q : q + 3] + change[v : v + 3], _turned(qpos[q + 3 : q + 7], change[v + 3 : v + 6])]
        elif kind == mjx.JointType.BALL:
            parts.append(_turned(qpos[q : q + 4], change[v : v + 3]))
        else:
            parts.append((qpos[q] + change[v])[None])
    return jnp.concatenate(parts) if parts else qpos


def _turned(quaternion: Float[Array, " 4"], turn: Float[Array, " 3"]) -> Float[Array, " 4"]:
    """A quaternion turned by a rotation vector in its own frame [rad], with unit length."""
    half = 0.5 * turn
    square = half @ half
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    sinc = jnp.where(small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    cosine = jnp.where(small, 1.0 - square / 2.0, jnp.cos(angle))
    (w, x, y, z), (a, b, c) = quaternion, sinc * half
    product = jnp.stack([
        w * cosine - x * a - y * b - z * c,
        w * a + x * cosine + y * c - z * b,
        w * b - x * c + y * cosine + z * a,
        w * c + x * b - y * a + z * cosine,
    ])  # fmt: skip
    return product / jnp.sqrt(product @ product)
