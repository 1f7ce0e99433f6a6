"""Passive forces and those of actuators as MuJoCo C has them, and their derivatives by velocity for `implicitfast`.

MJX leaves out polynomial springs and dampers. The force of a spring is -x (k + p_0 x + p_1 x^2), that of a damper
-v (b + p_0 |v| + p_1 v^2), with x the displacement of a joint, or its length where that is a vector, and of a tendon
beyond its range (MuJoCo's `mju_polyForce`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.dynamics import rows, spatial
from nermo_mjx.dynamics.mjx_copy import adapted
from nermo_mjx.dynamics.mjx_import import Model, mjx
from nermo_mjx.dynamics.preparing import is_zero
from nermo_mjx.shapes import Array, Dofs


def passive(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.passive`, with polynomials, and with a derivative where a tendon has the length of its spring."""
    springs = model.ntendon and not (
        is_zero(model.tendon_stiffness) and is_zero(model.tendon_stiffnesspoly)
    )
    without = (
        model.replace(tendon_stiffness=jnp.zeros_like(model.tendon_stiffness)) if springs else model
    )
    data = adapted.passive.passive(without, data)
    flags = mjx.DisableBit.SPRING | mjx.DisableBit.DAMPER
    if model.opt.disableflags & flags == flags:
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
        force -= rows.inner(data).ten_J.T @ (beyond * stiffness)
    if model.ntendon and not is_zero(model.tendon_dampingpoly):
        rate = rows.inner(data).ten_velocity
        force -= rows.inner(data).ten_J.T @ (rate * _share(model.tendon_dampingpoly, jnp.abs(rate)))
    return data.replace(qfrc_passive=force)


def damping(
    linear: Float[Array, " n"], poly: Float[Array, "n k"], velocity: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Minus the derivative of dampers' forces by their velocities."""
    if is_zero(poly):
        return linear
    speed = jnp.abs(velocity)
    return linear + sum((k + 2) * poly[:, k] * speed ** (k + 1) for k in range(poly.shape[1]))


def drag_slope(model: Model, data: mjx.Data) -> Float[Array, "nv nv"]:
    """Derivative of the fluid's forces by the velocities."""
    from nermo_mjx.dynamics.tree import tree_of

    moves = jnp.asarray(tree_of(model).moves, data.qvel.dtype)

    def force(qvel: Dofs) -> Dofs:
        drag: Dofs = adapted.passive._fluid(
            model, data.replace(cvel=moves @ (data.cdof * qvel[:, None]))
        )
        return drag

    return jax.jacfwd(force)(data.qvel)


def _share(poly: Float[Array, "n k"], x: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.sum(poly * x[:, None] ** np.arange(1, poly.shape[1] + 1), axis=1)


def _joint_springs(model: Model, qpos: Float[Array, " nq"]) -> Dofs:
    """The forces of the joints' springs beyond the linear ones."""
    forces = []
    for joint, (kind, first) in enumerate(
        zip(np.asarray(model.jnt_type), model.jnt_qposadr, strict=True)
    ):
        position, rest_position = qpos[first:], model.qpos_spring[first:]
        if kind in (mjx.JointType.SLIDE, mjx.JointType.HINGE):
            parts = [((position - rest_position)[:1], (position - rest_position)[0])]
        else:
            free = kind == mjx.JointType.FREE
            turn = spatial.turn_between(
                rest_position[3 * free : 3 * free + 4], position[3 * free : 3 * free + 4]
            )
            parts = [
                (displacement, spatial.length(displacement))
                for displacement in ([(position - rest_position)[:3]] if free else []) + [turn]
            ]
        forces += [
            -spring_displacement * _share(model.jnt_stiffnesspoly[joint, None], x[None])
            for spring_displacement, x in parts
        ]
    return jnp.concatenate(forces)


def actuation(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.fwd_actuation`, with early activations, and a derivative where a tendon's force is zero."""
    unlimited = model
    if np.any(model.tendon_actfrclimited):
        # MJX divides by a tendon's force where it is zero: the limits are applied below instead.
        unlimited = model.replace(
            tendon_actfrclimited=np.zeros_like(model.tendon_actfrclimited),
            actuator_forcelimited=np.zeros_like(model.actuator_forcelimited),
        )
    actuated = adapted.forward.fwd_actuation(unlimited, data)
    if np.any(model.actuator_actearly):
        earlier = data.replace(act=_activation(model, data.replace(act_dot=actuated.act_dot)))
        actuated = adapted.forward.fwd_actuation(unlimited, earlier).replace(
            act=data.act, act_dot=actuated.act_dot
        )
    if unlimited is model or not model.nu or model.opt.disableflags & mjx.DisableBit.ACTUATION:
        return actuated
    force = _within_tendons(model, actuated.actuator_force)
    low, high = model.actuator_forcerange.T
    force = jnp.where(model.actuator_forcelimited, jnp.clip(force, low, high), force)
    total = rows.inner(data).actuator_moment.T @ force
    if model.flg_gravcomp:
        total += data.qfrc_gravcomp * model.jnt_actgravcomp[model.dof_jntid]
    lower, upper = model.jnt_actfrcrange[model.dof_jntid].T
    total = jnp.where(
        model.jnt_actfrclimited[model.dof_jntid], jnp.clip(total, lower, upper), total
    )
    return actuated.replace(actuator_force=force, qfrc_actuator=total)


def _activation(model: Model, data: mjx.Data) -> Float[Array, " na"]:
    """The activations that forces read: those after the step, of actuators with `actearly`."""
    early = np.zeros(model.na, bool)
    for actuator in np.flatnonzero(model.actuator_actearly):
        first = model.actuator_actadr[actuator]
        if first >= 0:
            early[first : first + model.actuator_actnum[actuator]] = True
    return jnp.where(early, adapted.forward._next_activation(model, data, data.act_dot), data.act)


def _within_tendons(model: Model, force: Float[Array, " nu"]) -> Float[Array, " nu"]:
    """Forces of actuators, scaled where their sum is beyond the range of their tendon."""
    limited = np.asarray(model.tendon_actfrclimited, bool)
    owners = (
        np.asarray(model.actuator_trnid)[:, 0] == np.arange(model.ntendon)[:, None]
    ) & limited[:, None]
    owners &= np.asarray(model.actuator_trntype) == mjx.TrnType.TENDON
    low, high = model.tendon_actfrcrange.T
    total = owners.astype(force.dtype) @ force
    beyond = limited & ((total < low) | (total > high)) & (total != 0.0)
    share = jnp.where(beyond, jnp.clip(total, low, high) / jnp.where(beyond, total, 1.0), 1.0)
    return force * jnp.where(owners.any(0), share @ owners.astype(force.dtype), 1.0)


def force_slopes(model: Model, data: mjx.Data) -> Float[Array, " nu"]:
    """Derivative of each actuator's force by its velocity, 0 where the force is at its limit (`mjd_actuator_vel`)."""
    gains, biases = np.asarray(model.actuator_gaintype), np.asarray(model.actuator_biastype)
    slope = jnp.where(gains == mjx.GainType.AFFINE, model.actuator_gainprm[:, 2], 0.0)
    muscles = np.flatnonzero(gains == mjx.GainType.MUSCLE)
    if muscles.size:
        length, rate = data.actuator_length[muscles], rows.inner(data).actuator_velocity[muscles]
        fixed = jnp.asarray(model.actuator_lengthrange), model.actuator_acc0, model.actuator_gainprm
        ranges, strength, prm = (constant[muscles] for constant in fixed)
        by_rate = jax.vmap(jax.grad(adapted.support.muscle_gain, argnums=1))
        slope = slope.at[muscles].set(by_rate(length, rate, ranges, strength, prm))
    controls = data.ctrl
    if model.na:
        stateful = np.asarray(model.actuator_actadr) >= 0
        last = np.where(stateful, model.actuator_actadr + model.actuator_actnum - 1, 0)
        controls = jnp.where(stateful, _activation(model, data)[last], controls)
    slope = slope * controls + jnp.where(
        biases == mjx.BiasType.AFFINE, model.actuator_biasprm[:, 2], 0.0
    )
    low, high = model.actuator_forcerange.T
    stuck = model.actuator_forcelimited & (
        (data.actuator_force <= low) | (data.actuator_force >= high)
    )
    return jnp.where(stuck, 0.0, slope)
