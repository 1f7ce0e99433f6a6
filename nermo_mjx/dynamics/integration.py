"""MuJoCo's integrators with derivatives that are also correct for a body that does not rotate.

MJX normalises the angular velocity to turn a quaternion. Its safe norm is constant at zero, so in the derivative a body
at rest would keep its orientation under any torque. The positions are integrated here instead, with the
exponential map, whose derivative is smooth; the values are the same to rounding.

`implicitfast` is that of MuJoCo C: forces at their limits, muscles, polynomial dampers and drag have their derivatives
by velocity, and a free body without children that of its gyroscopic forces.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.dynamics import rows, spatial
from nermo_mjx.dynamics.forces import damping, drag_slope, force_slopes
from nermo_mjx.dynamics.mjx_import import Model, Solved, mjx
from nermo_mjx.dynamics.spatial import solve_definite
from nermo_mjx.shapes import Array, Dofs

#: Integrators that `integrate` supports; MJX's enumeration also has DISCRETE, with which it cannot step.
INTEGRATORS: Final = (
    mjx.IntegratorType.EULER,
    mjx.IntegratorType.RK4,
    mjx.IntegratorType.IMPLICITFAST,
)

#: Nodes a and weights b of the classical Runge-Kutta method of fourth order.
_RK4_NODES: Final = (0.5, 0.5, 1.0)
_RK4_WEIGHTS: Final = (1 / 6, 1 / 3, 1 / 3, 1 / 6)

Forward = Callable[[mjx.Model, mjx.Data], Solved]
#: Velocity, acceleration and rate of activation.
Rates = tuple[Array, Array, Array]


def integrate(model: mjx.Model, data: Solved, forward: Forward) -> Solved:
    """State one time step later, by the model's integrator.

    Args:
        model: its integrator is one of `INTEGRATORS`.
        data: after forward dynamics.
        forward: forward dynamics, for the stages of RK4.
    """
    if model.opt.integrator == mjx.IntegratorType.RK4:
        return _runge_kutta(model, data, forward)
    accelerate = (
        _damped_acceleration
        if model.opt.integrator == mjx.IntegratorType.EULER
        else _implicit_acceleration
    )
    after, qacc = mjx.euler(model, data), accelerate(model, data)
    after = after.replace(qvel=data.qvel + model.opt.timestep * qacc)
    return after.replace(qpos=positions(model, data.qpos, model.opt.timestep * after.qvel))


def _damped_acceleration(model: mjx.Model, data: mjx.Data) -> Dofs:
    """Acceleration of Euler's method, implicit in the joints' damping B: (M + h B) a' = q + J^T f = M a."""
    if model.opt.disableflags & mjx.DisableBit.EULERDAMP:
        qacc: Array = data.qacc
        return qacc
    damping_step = model.opt.timestep * damping(model.dof_damping, model.dof_dampingpoly, data.qvel)
    # Not from the forces: those of a stiff contact magnify the acceleration's rounding.
    return data.qacc - solve_definite(
        mjx.full_m(model, data) + jnp.diag(damping_step), damping_step * data.qacc
    )


def _implicit_acceleration(model: Model, data: mjx.Data) -> Dofs:
    """Acceleration implicit in velocity: (M - h D) a' = M a, D the derivative of q by v, without that of the bias.

    D has the entries of the tree's inertia matrix only, as in MuJoCo C.
    """
    slope = -jnp.diag(damping(model.dof_damping, model.dof_dampingpoly, data.qvel))
    if model.ntendon:
        arms = rows.inner(data).ten_J
        damping_values = damping(
            model.tendon_damping, model.tendon_dampingpoly, rows.inner(data).ten_velocity
        )
        slope -= arms.T @ (damping_values[:, None] * arms)
    if model.nu and not model.opt.disableflags & mjx.DisableBit.ACTUATION:
        moment = rows.inner(data).actuator_moment
        slope += moment.T @ (force_slopes(model, data)[:, None] * moment)
    flags = mjx.DisableBit.SPRING | mjx.DisableBit.DAMPER
    if model.opt._impl.has_fluid_params and model.opt.disableflags & flags != flags:
        slope += drag_slope(model, data)
    inertia = mjx.full_m(model, data)
    slope = model.opt.timestep * jnp.where(rows.within_branches(model), slope, 0.0)
    qacc = data.qacc + solve_definite(inertia - slope, slope @ data.qacc)
    for body, first in _lone_bodies(model):
        dof_slice = slice(first, first + 6)
        turned = jax.jacfwd(lambda turn, body=body: _lone_bias(model, data, body, turn))(
            data.qvel[first + 3 : first + 6]
        )
        block = slope[dof_slice, dof_slice] - model.opt.timestep * jnp.concatenate(
            [jnp.zeros((6, 3), turned.dtype), turned], 1
        )
        change = jnp.linalg.solve(
            inertia[dof_slice, dof_slice] - block, block @ data.qacc[dof_slice]
        )
        qacc = qacc.at[dof_slice].set(data.qacc[dof_slice] + change)
    return qacc


def _lone_bodies(model: Model) -> list[tuple[int, int]]:
    """Bodies with a free joint alone and without children, and the first degree of freedom of each."""
    parents, bodies = np.asarray(model.body_parentid), np.asarray(model.jnt_bodyid)
    return [
        (int(body), int(model.jnt_dofadr[joint]))
        for joint, body in enumerate(bodies)
        if model.jnt_type[joint] == mjx.JointType.FREE
        and np.sum(bodies == body) == 1
        and body not in parents
    ]


def _lone_bias(
    model: Model, data: mjx.Data, body: int, turn: Float[Array, " 3"]
) -> Float[Array, " 6"]:
    """Bias force of a free body at an angular velocity in its frame, without gravity."""
    axes, orientation = data.ximat[body], data.xmat[body]
    rate, offset = orientation @ turn, data.xipos[body] - data.xpos[body]
    force = model.body_mass[body] * spatial.cross(rate, spatial.cross(rate, offset))
    torque = spatial.cross(rate, axes @ (model.body_inertia[body] * (axes.T @ rate)))
    return jnp.concatenate([force, orientation.T @ (spatial.cross(offset, force) + torque)])


def _runge_kutta(model: mjx.Model, start: Solved, forward: Forward) -> Solved:
    dt = model.opt.timestep

    def stage(rates: Rates, node: Array) -> tuple[Rates, tuple[Rates, tuple[Array, Array]]]:
        velocity, acceleration, activation = (node * dt * rate for rate in rates)
        data = start.replace(
            qpos=positions(model, start.qpos, velocity),
            qvel=start.qvel + acceleration,
            act=start.act + activation,
            time=start.time + node * dt,
        )
        evaluated = forward(model, data)
        derivatives = (data.qvel, evaluated.qacc, evaluated.act_dot)
        return derivatives, (derivatives, (evaluated.residual, rows.inner(evaluated).solver_niter))

    first = (start.qvel, start.qacc, start.act_dot)
    # A scan, so that forward dynamics is compiled once for all three stages.
    _, (others, (residuals, rounds)) = jax.lax.scan(
        stage, first, jnp.asarray(_RK4_NODES, start.qpos.dtype)
    )
    weight = jnp.asarray(_RK4_WEIGHTS[1:], start.qpos.dtype)
    velocity, acceleration, activation = (
        _RK4_WEIGHTS[0] * first_value + weight @ other_values
        for first_value, other_values in zip(first, others, strict=True)
    )
    # Activation and time advance as in an Euler step.
    advanced = mjx.euler(model, start.replace(act_dot=activation))
    advanced = advanced.replace(residual=jnp.maximum(start.residual, residuals.max()))
    advanced = advanced.tree_replace(
        {"_impl.solver_niter": jnp.maximum(rows.inner(start).solver_niter, rounds.max())}
    )
    return advanced.replace(
        qpos=positions(model, start.qpos, dt * velocity), qvel=start.qvel + dt * acceleration
    )


def positions(model: mjx.Model, qpos: Float[Array, " nq"], change: Dofs) -> Float[Array, " nq"]:
    """`qpos` after a change in the tangent space, a velocity times a time."""
    parts = []
    for kind, q, v in zip(
        np.asarray(model.jnt_type), model.jnt_qposadr, model.jnt_dofadr, strict=True
    ):
        if kind == mjx.JointType.FREE:
            parts += [
                qpos[q : q + 3] + change[v : v + 3],
                _turned(qpos[q + 3 : q + 7], change[v + 3 : v + 6]),
            ]
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
    product = jnp.stack(
        [
            w * cosine - x * a - y * b - z * c,
            w * a + x * cosine + y * c - z * b,
            w * b - x * c + y * cosine + z * a,
            w * c + x * b - y * a + z * cosine,
        ]
    )
    return product / jnp.sqrt(product @ product)
