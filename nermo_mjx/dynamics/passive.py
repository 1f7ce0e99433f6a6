"""Passive forces, with the polynomial springs and dampers that MJX leaves out.

The force of a spring is -x (k + p_0 x + p_1 x^2), that of a damper -v (b + p_0 |v| + p_1 v^2), with x the displacement
of a joint, or its length where that is a vector, and of a tendon beyond its range (MuJoCo's `mju_polyForce`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.dynamics import rows, spatial
from nermo_mjx.dynamics.mjx_import import Model, mjx
from nermo_mjx.dynamics.preparing import is_zero
from nermo_mjx.shapes import Array, Dofs


def passive(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.passive`, with polynomials, and with a derivative where a tendon has the length of its spring."""
    springs = model.ntendon and not (is_zero(model.tendon_stiffness) and is_zero(model.tendon_stiffnesspoly))
    without = model.replace(tendon_stiffness=jnp.zeros_like(model.tendon_stiffness)) if springs else model
    data = mjx.passive(without, data)
    both = mjx.DisableBit.SPRING | mjx.DisableBit.DAMPER
    if model.opt.disableflags & both == both:
        return data
    force = data.qfrc_passive
    if not is_zero(model.jnt_stiffnesspoly):
        force += _joint_springs(model, data.qpos)
    if not is_zero(model.dof_dampingpoly):
        force -= data.qvel * _share(model.dof_dampingpoly, jnp.abs(data.qvel))
    if springs:
        (low, high), length = model.tendon_lengthspring.T, data.ten_length
        # Where both limits are the same, its length at rest has the derivative of both sides.
        beyond = length - jnp.where(length >= high, high, jnp.where(length <= low, low, length))
        stiffness = model.tendon_stiffness + _share(model.tendon_stiffnesspoly, beyond)
        force -= rows.tendon_jacobian(data).T @ (beyond * stiffness)
    if model.ntendon and not is_zero(model.tendon_dampingpoly):
        rate = rows.tendon_velocity(data)
        force -= rows.tendon_jacobian(data).T @ (rate * _share(model.tendon_dampingpoly, jnp.abs(rate)))
    return data.replace(qfrc_passive=force)


def damping(linear: Float[Array, " n"], poly: Float[Array, "n k"], velocity: Float[Array, " n"]) -> Float[Array, " n"]:
    """Minus the derivative of dampers' forces by their velocities."""
    if is_zero(poly):
        return linear
    speed = jnp.abs(velocity)
    return linear + sum((k + 2) * poly[:, k] * speed ** (k + 1) for k in range(poly.shape[1]))


def drag_slope(model: Model, data: mjx.Data) -> Float[Array, "nv nv"]:
    """Derivative of the fluid's forces by the velocities."""
    from mujoco.mjx._src import passive as theirs

    from nermo_mjx.dynamics.tree import tree_of

    moves = jnp.asarray(tree_of(model).moves, data.qvel.dtype)

    def force(qvel: Dofs) -> Dofs:
        found: Dofs = theirs._fluid(model, data.replace(cvel=moves @ (data.cdof * qvel[:, None])))
        return found

    return jax.jacfwd(force)(data.qvel)


def _share(poly: Float[Array, "n k"], x: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.sum(poly * x[:, None] ** np.arange(1, poly.shape[1] + 1), axis=1)


def _joint_springs(model: Model, qpos: Float[Array, " nq"]) -> Dofs:
    """The forces of the joints' springs beyond the linear ones."""
    forces = []
    for joint, (kind, first) in enumerate(zip(np.asarray(model.jnt_type), model.jnt_qposadr, strict=True)):
        at, rest = qpos[first:], model.qpos_spring[first:]
        if kind in (mjx.JointType.SLIDE, mjx.JointType.HINGE):
            parts = [((at - rest)[:1], (at - rest)[0])]
        else:
            free = kind == mjx.JointType.FREE
            turn = spatial.turn_between(rest[3 * free : 3 * free + 4], at[3 * free : 3 * free + 4])
            parts = [(each, spatial.length(each)) for each in ([(at - rest)[:3]] if free else []) + [turn]]
        forces += [-away * _share(model.jnt_stiffnesspoly[joint, None], x[None]) for away, x in parts]
    return jnp.concatenate(forces)
