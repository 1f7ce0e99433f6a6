"""MJX's passes over the kinematic tree, for all bodies at once.

MJX goes through the tree level by level, and on each by kind of joint: some 170 small sequential operations, which
dominate XLA's compile time and a GPU's launches. Here sums up or down the tree are products with a constant matrix of
zeros and ones; orientations, which do not add up, are composed with those of ancestors at twice the distance each time.
The results equal MJX's up to rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.dynamics import rows, spatial
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.shapes import Array

FREE_JOINT, BALL_JOINT, SLIDE_JOINT, HINGE_JOINT = (
    mjx.JointType[name] for name in ("FREE", "BALL", "SLIDE", "HINGE")
)


class Tree(NamedTuple):
    """The structure of a model's tree, as constant matrices of zeros and ones.

    Attributes:
        below: (nbody, nbody), which bodies are in the subtree of each, itself among them.
        moves: (nbody, nv), which velocities move each body: its own and those of its ancestors.
        before: (nv, nv), which velocities move the axis of each: those of joints before it.
    """

    below: np.ndarray
    moves: np.ndarray
    before: np.ndarray


def tree_of(model: mjx.Model) -> Tree:
    """The tree of a model."""
    parents, body_of, joint_of = (
        np.asarray(addresses)
        for addresses in (model.body_parentid, model.dof_bodyid, model.dof_jntid)
    )
    below = np.eye(model.nbody)
    for body in range(model.nbody - 1, 0, -1):  # a parent comes before its children
        below[parents[body]] += below[body]
    moves = below.T[:, body_of]
    precedes = moves[body_of] * (joint_of[None, :] < joint_of[:, None])
    for joint in np.flatnonzero(np.asarray(model.jnt_type) == FREE_JOINT):
        first = int(np.asarray(model.jnt_dofadr)[joint])
        precedes[first + 3 : first + 6, first : first + 3] = 1.0  # it rotates about a moving point
    return Tree(below, moves, precedes)


# Long because the kinematics pass through the tree from its root to its leaves.
def kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.kinematics`: poses of bodies, joints, geoms and sites."""
    kinds, bodies = np.asarray(model.jnt_type), np.asarray(model.jnt_bodyid)
    turns, slides, qpos = _joint_turns(model, data.qpos)
    position, orientation = model.body_pos, model.body_quat
    # A joint's anchor and axis, in the frame of its body's parent, before the joints after it on the same body.
    anchors, axes = jnp.zeros((model.njnt, 3), qpos.dtype), jnp.zeros((model.njnt, 3), qpos.dtype)
    nth = np.array([np.sum(bodies[:joint] == body) for joint, body in enumerate(bodies)], int)
    for level in range(
        nth.max(initial=-1) + 1
    ):  # the first joints of all bodies, then the second ones, and so on
        joints = np.flatnonzero(nth == level)
        level_bodies = bodies[joints]
        offset, before = model.jnt_pos[joints], orientation[level_bodies]
        anchor = spatial.rotate(offset, before) + position[level_bodies]
        axis = spatial.rotate(model.jnt_axis[joints], before)
        after = spatial.product(before, turns[joints])
        moved = anchor - spatial.rotate(offset, after) + axis * slides[joints, None]
        free = (kinds[joints] == FREE_JOINT)[:, None]
        if free.any():
            first = np.where(free[:, 0], np.asarray(model.jnt_qposadr)[joints], 0)
            free_position = qpos[first[:, None] + np.arange(3)]
            anchor, moved, after = (
                jnp.where(free, new, old)
                for new, old in (
                    (free_position, anchor),
                    (free_position, moved),
                    (turns[joints], after),
                )
            )
            axis = jnp.where(free, np.array([0.0, 0.0, 1.0]), axis)
        anchors, axes = anchors.at[joints].set(anchor), axes.at[joints].set(axis)
        position, orientation = (
            position.at[level_bodies].set(moved),
            orientation.at[level_bodies].set(after),
        )
    if model.nmocap:  # children of the world, without joints
        led = np.flatnonzero(np.asarray(model.body_mocapid) >= 0)
        mocap_index = np.asarray(model.body_mocapid)[led]
        position = position.at[led].set(data.mocap_pos[mocap_index])
        orientation = orientation.at[led].set(spatial.normalized(data.mocap_quat[mocap_index]))
    position, orientation = _in_the_world(np.asarray(model.body_parentid), position, orientation)
    above = np.asarray(model.body_parentid)[bodies]
    anchors = position[above] + spatial.rotate(anchors, orientation[above])
    axes = spatial.rotate(axes, orientation[above])
    data = data.replace(
        qpos=qpos,
        xanchor=anchors,
        xaxis=axes,
        xpos=position,
        xquat=orientation,
        xmat=spatial.matrix(orientation),
    )

    def placed(body: np.ndarray, pos: Array, quat: Array) -> tuple[Array, Array]:
        turn = orientation[body]
        return position[body] + spatial.rotate(pos, turn), spatial.matrix(
            spatial.product(turn, quat)
        )

    xipos, ximat = placed(np.arange(model.nbody), model.body_ipos, model.body_iquat)
    data = data.replace(xipos=xipos, ximat=ximat)
    if model.ngeom:
        xpos, xmat = placed(np.asarray(model.geom_bodyid), model.geom_pos, model.geom_quat)
        data = data.replace(geom_xpos=xpos, geom_xmat=xmat)
    if model.nsite:
        xpos, xmat = placed(np.asarray(model.site_bodyid), model.site_pos, model.site_quat)
        data = data.replace(site_xpos=xpos, site_xmat=xmat)
    return data


def _joint_turns(
    model: mjx.Model, qpos: Float[Array, " nq"]
) -> tuple[Float[Array, "njnt 4"], Float[Array, " njnt"], Float[Array, " nq"]]:
    """Rotation and displacement [m] of each joint, and the positions with normalised quaternions."""
    kinds, first = np.asarray(model.jnt_type), np.asarray(model.jnt_qposadr)
    if not len(kinds):
        return jnp.zeros((0, 4), qpos.dtype), jnp.zeros(0, qpos.dtype), qpos
    amount = qpos[first] - model.qpos0[first]
    half = 0.5 * jnp.where(kinds == HINGE_JOINT, amount, 0.0)[:, None]
    turns = jnp.concatenate([jnp.cos(half), jnp.sin(half) * model.jnt_axis], 1)
    loose = np.flatnonzero((kinds == FREE_JOINT) | (kinds == BALL_JOINT))
    if loose.size:
        quat_addresses = (first + np.where(kinds == FREE_JOINT, 3, 0))[loose, None] + np.arange(4)
        quats = spatial.normalized(qpos[quat_addresses])
        turns, qpos = turns.at[loose].set(quats), qpos.at[quat_addresses].set(quats)
    return turns, jnp.where(kinds == SLIDE_JOINT, amount, 0.0), qpos


def _in_the_world(parents: np.ndarray, position: Array, orientation: Array) -> tuple[Array, Array]:
    """Poses in their parents' frames, converted to poses in the world."""
    ancestor = parents
    while ancestor.any():
        turn = orientation[ancestor]
        position = position[ancestor] + spatial.rotate(position, turn)
        orientation = spatial.product(turn, orientation)
        ancestor = ancestor[ancestor]
    return position, orientation


def com_pos(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.com_pos`: centres of mass of subtrees, inertias and axes about that of the whole tree."""
    tree, mass = tree_of(model), model.body_mass
    sums = tree.below.astype(mass.dtype) @ jnp.concatenate(
        [mass[:, None] * data.xipos, mass[:, None]], 1
    )
    total = sums[:, 3:]
    subtree = jnp.where(
        total < mujoco.mjMINVAL, data.xipos, sums[:, :3] / jnp.maximum(total, mujoco.mjMINVAL)
    )
    centre = subtree[np.asarray(model.body_rootid)]
    inertia = spatial.inertia_about(model.body_inertia, data.ximat, data.xipos - centre, mass)
    data = data.replace(subtree_com=subtree)
    data = data.tree_replace({"_impl.cinert": inertia, "cdof": _axes(model, data, centre)})
    return data


def _axes(
    model: mjx.Model, data: mjx.Data, centre: Float[Array, "nbody 3"]
) -> Float[Array, "nv 6"]:
    """The motion of each velocity about the centre of mass of its tree."""
    joint, body = np.asarray(model.dof_jntid), np.asarray(model.dof_bodyid)
    kind = np.asarray(model.jnt_type)[joint]
    dof_in_joint = np.arange(model.nv) - np.asarray(model.jnt_dofadr)[joint]  # in its joint
    shifts = (kind == SLIDE_JOINT) | ((kind == FREE_JOINT) & (dof_in_joint < 3))
    # One table of all axes: those of joints, of bodies, and of the world.
    table = jnp.concatenate(
        [
            data.xaxis,
            jnp.swapaxes(data.xmat, 1, 2).reshape(-1, 3),
            jnp.eye(3, dtype=data.qpos.dtype),
        ]
    )
    joint_count, world = (
        len(np.asarray(model.jnt_type)),
        len(np.asarray(model.jnt_type)) + 3 * model.nbody,
    )
    spins = ((kind == FREE_JOINT) | (kind == BALL_JOINT)) & ~shifts
    index = np.where(
        spins,
        joint_count + 3 * body + dof_in_joint % 3,
        np.where(kind == FREE_JOINT, world + dof_in_joint, joint),
    )
    axis = table[index]
    arm = spatial.cross(axis, centre[body] - data.xanchor[joint])
    straight = shifts[:, None]
    return jnp.concatenate([jnp.where(straight, 0.0, axis), jnp.where(straight, axis, arm)], 1)


def crb(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.crb`: the joint-space inertia, from the inertias of subtrees."""
    tree, inertia = tree_of(model), rows.inner(data).cinert
    carried = tree.below[np.asarray(model.dof_bodyid)].astype(inertia.dtype) @ inertia
    lower = spatial.momentum(carried, data.cdof) @ data.cdof.T
    return rows.with_joint_inertia(model, data, lower + jnp.diag(model.dof_armature))


def com_vel(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.com_vel`: velocities of bodies, and how the axes move."""
    tree, rates = tree_of(model), data.cdof * data.qvel[:, None]
    moves, precedes = (mask.astype(rates.dtype) for mask in (tree.moves, tree.before))
    return data.tree_replace(
        {"cvel": moves @ rates, "cdof_dot": spatial.moved(precedes @ rates, data.cdof)}
    )


def rne(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.rne`: the joint forces due to gravity and velocities."""
    tree, inertia = tree_of(model), rows.inner(data).cinert
    falls = jnp.concatenate([jnp.zeros(3, inertia.dtype), -model.opt.gravity])
    if model.opt.disableflags & mjx.DisableBit.GRAVITY:
        falls = jnp.zeros_like(falls)
    acceleration = falls + tree.moves.astype(inertia.dtype) @ (data.cdof_dot * data.qvel[:, None])
    force = spatial.momentum(inertia, acceleration)
    force += spatial.moved_force(data.cvel, spatial.momentum(inertia, data.cvel))
    carried = tree.below[np.asarray(model.dof_bodyid)].astype(inertia.dtype) @ force
    return data.replace(qfrc_bias=jnp.sum(data.cdof * carried, 1))
