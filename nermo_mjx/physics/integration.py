"""MJX's integrators with derivatives that also hold for a body that does not turn.

MJX normalises the angular velocity to turn a quaternion. Its safe norm is constant at zero, so that a body at rest
would keep its orientation in the derivative whatever spins it up. The positions are integrated here instead, with the
exponential map, whose derivative is smooth; the values are the same to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.physics.mjx_import import mjx

#: Nodes a and weights b of the classical Runge-Kutta method of fourth order.
_RK4_NODES: Final = (0.5, 0.5, 1.0)
_RK4_WEIGHTS: Final = (1 / 6, 1 / 3, 1 / 3, 1 / 6)

Forward = Callable[[mjx.Model, mjx.Data], mjx.Data]


def integrate(model: mjx.Model, data: mjx.Data, forward: Forward) -> mjx.Data:
    """State one time step later, by the model's integrator.

    Args:
        model: its integrator is Euler, RK4 or implicitfast.
        data: after forward dynamics.
        forward: forward dynamics, for the stages of RK4.
    """
    if model.opt.integrator == mjx.IntegratorType.RK4:
        return _runge_kutta(model, data, forward)
    advance = mjx.euler if model.opt.integrator == mjx.IntegratorType.EULER else mjx.implicit
    after = advance(model, data)
    return after.replace(qpos=positions(model, data.qpos, after.qvel))


def _runge_kutta(model: mjx.Model, start: mjx.Data, forward: Forward) -> mjx.Data:
    dt = model.opt.timestep
    stage, velocity = start, start.qvel
    sums = [_RK4_WEIGHTS[0] * rate for rate in (velocity, start.qacc, start.act_dot)]
    for node, weight in zip(_RK4_NODES, _RK4_WEIGHTS[1:], strict=True):
        stage = stage.replace(
            qpos=positions(model, start.qpos, node * velocity), qvel=start.qvel + dt * node * stage.qacc,
            act=start.act + dt * node * stage.act_dot, time=start.time + dt * node,
        )  # fmt: skip
        velocity = stage.qvel
        stage = forward(model, stage)
        rates = (velocity, stage.qacc, stage.act_dot)
        sums = [total + weight * rate for total, rate in zip(sums, rates, strict=True)]
    velocity, qacc, act_dot = sums
    stage = stage.replace(qpos=start.qpos, qvel=start.qvel, act=start.act, time=start.time, act_dot=act_dot)
    # Euler's step advances activation and time in the same way.
    after = mjx.euler(model, stage)
    return after.replace(qpos=positions(model, start.qpos, velocity), qvel=start.qvel + dt * qacc)


def positions(model: mjx.Model, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """`qpos` after one time step at the velocity `qvel`."""
    dt, parts = model.opt.timestep, []
    for kind, q, v in zip(np.asarray(model.jnt_type), model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind == mjx.JointType.FREE:
            parts += [qpos[q : q + 3] + dt * qvel[v : v + 3], _turned(qpos[q + 3 : q + 7], dt * qvel[v + 3 : v + 6])]
        elif kind == mjx.JointType.BALL:
            parts.append(_turned(qpos[q : q + 4], dt * qvel[v : v + 3]))
        else:
            parts.append((qpos[q] + dt * qvel[v])[None])
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
