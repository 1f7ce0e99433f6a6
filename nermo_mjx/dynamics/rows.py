"""The rows of a constraint problem in MJX's data, and inertias: the only module that accesses MJX's private data.

MJX computes J, aref and the rows' other values in `mjx.make_constraint`, and stores them, like the contacts, in
`data._impl`, without public access.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Bool, Float

from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.shapes import Array, Dofs, Efc


@dataclasses.dataclass(frozen=True)
class Layout:
    """The types of the rows; known at trace time.

    Attributes:
        equality, frictionloss: number of rows of each; they come first, in this order.
        cones: (dimension, number) of the contacts with elliptic cones, in the order of their rows, which come last;
            empty with pyramidal cones.
    """

    equality: int
    frictionloss: int
    cones: tuple[tuple[int, int], ...]


class Problem(NamedTuple):
    """The arrays of one constraint problem.

    Attributes:
        inertia: M, joint-space inertia.
        smooth: q, sum of all forces but the constraints'.
        jacobian, aref: J and the reference acceleration of each row.
        stiffness: D of each row, the inverse of its regularisation.
        frictionloss: largest force of a row of dry friction; 0 for others.
        cone: mu = friction_1 / sqrt(impratio), then the friction coefficients, of each contact in `Layout.cones`.
    """

    inertia: Float[Array, "nv nv"]
    smooth: Dofs
    jacobian: Float[Array, "nefc nv"]
    aref: Efc
    stiffness: Efc
    frictionloss: Efc
    cone: Float[Array, "ncone 6"]


def is_unconstrained(data: mjx.Data) -> bool:
    """Whether the model has no constraint rows at all."""
    rows: Any = data._impl
    return bool(rows.efc_J.size == 0)


def capacity(model: mujoco.MjModel) -> tuple[int, int]:
    """Maximum numbers of contacts and constraint rows that MJX stores for one world."""
    sized: Any = mjx.make_data(model, impl="jax")._impl
    return int(sized.ncon), int(sized.nefc)


def read(model: mjx.Model, data: mjx.Data) -> tuple[Layout, Problem]:
    """The constraint problem of data after the position, velocity, actuation and acceleration stages."""
    rows: Any = data._impl
    contact, dims = _in_row_order(rows.contact)
    chosen = dims[(dims > 1) & _elliptic(model)]
    cones = tuple((int(dim), int(count)) for dim, count in zip(*np.unique(chosen, return_counts=True), strict=True))
    friction = contact.friction[len(dims) - len(chosen) :]
    mu = friction[:, :1] / jnp.sqrt(model.opt.impratio)
    return Layout(*_counts(model), cones), Problem(
        inertia=mjx.full_m(model, data), smooth=data.qfrc_smooth, jacobian=rows.efc_J, aref=rows.efc_aref,
        stiffness=rows.efc_D, frictionloss=rows.efc_frictionloss, cone=jnp.concatenate([mu, friction], axis=1),
    )  # fmt: skip


def tendon_jacobian(data: mjx.Data) -> Float[Array, "ntendon nv"]:
    """How the tendons' lengths change with each velocity."""
    inner: Any = data._impl
    found: Array = inner.ten_J
    return found


def tendon_velocity(data: mjx.Data) -> Float[Array, " ntendon"]:
    """Rates of change of the tendons' lengths."""
    inner: Any = data._impl
    found: Array = inner.ten_velocity
    return found


def actuator_velocity(data: mjx.Data) -> Float[Array, " nu"]:
    """Rates of change of the actuators' lengths."""
    inner: Any = data._impl
    found: Array = inner.actuator_velocity
    return found


def actuator_moment(data: mjx.Data) -> Float[Array, "nu nv"]:
    """How the actuators' lengths change with each velocity."""
    inner: Any = data._impl
    found: Array = inner.actuator_moment
    return found


def inertias(data: mjx.Data) -> Float[Array, "nbody 10"]:
    """The spatial inertia of each body about the centre of mass of its tree."""
    inner: Any = data._impl
    found: Array = inner.cinert
    return found


def with_inertias(data: mjx.Data, inertia: Float[Array, "nbody 10"], axes: Float[Array, "nv 6"]) -> mjx.Data:
    """Data with the spatial inertias of its bodies and the axes of its velocities."""
    changed: mjx.Data = data.tree_replace({"_impl.cinert": inertia, "cdof": axes})
    return changed


def with_joint_inertia(model: mjx.Model, data: mjx.Data, lower: Float[Array, "nv nv"]) -> mjx.Data:
    """Data with the joint-space inertia, stored as MJX stores it.

    Args:
        lower: its entries (i, j) where j is i or one of its ancestors; others are not read.
    """
    inner: Any = data._impl
    row, column = np.repeat(np.arange(model.nv), model.M_rownnz), np.asarray(model.M_colind)
    if inner.M.ndim == 1:
        matrix = lower[row, column]
    else:
        reads = np.zeros((model.nv, model.nv), bool)
        reads[row, column] = True
        half = jnp.where(reads, lower, 0.0)
        matrix = half + jnp.tril(half, -1).T
    changed: mjx.Data = data.tree_replace({"_impl.M": matrix})
    return changed


def with_tendon_inertia(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Data with the tendons' armatures in its inertia, as in MuJoCo C not between joints of different branches."""
    inner: Any = data._impl
    added = inner.ten_J.T @ (model.tendon_armature[:, None] * inner.ten_J)
    if inner.M.ndim == 1:
        added = added[np.repeat(np.arange(model.nv), model.M_rownnz), np.asarray(model.M_colind)]
    else:
        added = jnp.where(within_branches(model), added, 0.0)
    changed: mjx.Data = data.tree_replace({"_impl.M": inner.M + added})
    return changed


def within_branches(model: mjx.Model) -> Bool[np.ndarray, "nv nv"]:
    """The entries of a joint-space inertia matrix: those of two joints of which one is an ancestor of the other."""
    stored = np.zeros((model.nv, model.nv), bool)
    stored[np.repeat(np.arange(model.nv), model.M_rownnz), np.asarray(model.M_colind)] = True
    return stored | stored.T


def with_velocities(data: mjx.Data) -> mjx.Data:
    """Data with the rates of change of its actuators' and tendons' lengths, the first part of `mjx.fwd_velocity`."""
    inner: Any = data._impl
    rates = {
        "_impl.actuator_velocity": inner.actuator_moment @ data.qvel,
        "_impl.ten_velocity": inner.ten_J @ data.qvel,
    }
    changed: mjx.Data = data.tree_replace(rates)
    return changed


def with_solution(data: mjx.Data, qacc: Array, row_force: Array, joint_force: Array, rounds: Array) -> mjx.Data:
    """Data with the acceleration, the constraint forces by row and by joint, and the number of rounds of the solver."""
    solved: mjx.Data = data.tree_replace(
        {"qacc": qacc, "qfrc_constraint": joint_force, "_impl.efc_force": row_force, "_impl.solver_niter": rounds}
    )
    return solved


def solver_rounds(data: mjx.Data) -> Array:
    """Number of rounds of the solver, as set by `with_solution`."""
    inner: Any = data._impl
    rounds: Array = inner.solver_niter
    return rounds


def with_contact_solimp(data: mjx.Data, solimp: Array) -> mjx.Data:
    """Data with other impedances of its contacts, (ncon, 5)."""
    changed: mjx.Data = data.tree_replace({"_impl.contact.solimp": solimp})
    return changed


def contact_solimp(data: mjx.Data) -> Array:
    """Impedances of all contacts, (ncon, 5)."""
    rows: Any = data._impl
    solimp: Array = rows.contact.solimp
    return solimp


def row_arrays(data: mjx.Data) -> tuple[Array, Array, Array]:
    """(D, aref, J) of all rows."""
    rows: Any = data._impl
    return rows.efc_D, rows.efc_aref, rows.efc_J


def with_row_arrays(data: mjx.Data, stiffness: Array, aref: Array) -> mjx.Data:
    """Data with another D and aref of its rows."""
    changed: mjx.Data = data.tree_replace({"_impl.efc_D": stiffness, "_impl.efc_aref": aref})
    return changed


def with_addresses(data: mjx.Data) -> mjx.Data:
    """Data after its rows were made, with its contacts' addresses among them, which follow all other rows."""
    rows: Any = data._impl
    more = len(rows.efc_J) - rows.nefc
    if not (more and rows.ncon and len(rows.efc_J)):
        return data
    changed: mjx.Data = data.tree_replace({"_impl.contact.efc_address": rows.contact.efc_address + more})
    return changed


def _counts(model: mjx.Model) -> tuple[int, int]:
    """Numbers of rows of equalities and of dry friction."""
    kinds, off = np.asarray(model.eq_type), model.opt.disableflags
    sizes = {mjx.EqType.CONNECT: 3, mjx.EqType.WELD: 6}
    equality = sum(sizes.get(mjx.EqType(kind), 1) for kind in kinds)
    inner: Any = model._impl
    dry = int(inner.dof_hasfrictionloss.sum() + inner.tendon_hasfrictionloss.sum())
    return equality * (not off & mjx.DisableBit.EQUALITY), dry * (not off & mjx.DisableBit.FRICTIONLOSS)


def _in_row_order(contact: Any) -> tuple[Any, np.ndarray]:
    """Contacts in the order of their rows, which is by dimension, and their dimensions."""
    dims = np.asarray(contact.dim)
    order = np.argsort(dims, kind="stable")
    if (order == np.arange(len(dims))).all():
        return contact, dims
    return jax.tree.map(lambda leaf: leaf[order], contact), dims[order]


def _elliptic(model: mjx.Model) -> bool:
    return bool(model.opt.cone == mjx.ConeType.ELLIPTIC)
