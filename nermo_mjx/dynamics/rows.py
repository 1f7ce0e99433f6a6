"""The rows of a constraint problem in MJX's data, and inertias.

MJX computes J, aref and the rows' other values in `mjx.make_constraint`, and stores them, like the contacts, in
`data._impl`, without public access: `inner`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from nermo_mjx.dynamics.mjx_import import Solved, mjx
from nermo_mjx.shapes import Array, Dofs, Efc

#: Fields of MJX's data with an entry for each row.
_ROW_FIELDS: Final = tuple(
    f"efc_{name}" for name in ("J", "pos", "margin", "frictionloss", "D", "aref", "force")
)


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


class ConstraintProblem(NamedTuple):
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


def inner(data: mjx.Data) -> Any:
    """MJX's private data: rows `efc_*`, `contact`, Jacobians, inertias."""
    return data._impl


def read_problem(model: mjx.Model, data: mjx.Data) -> tuple[Layout, ConstraintProblem]:
    """The constraint problem of data after the position, velocity, actuation and acceleration stages."""
    rows = inner(data)
    contact, dims = _in_row_order(rows.contact)
    cone_dims = dims[(dims > 1) & (model.opt.cone == mjx.ConeType.ELLIPTIC)]
    cones = tuple(
        (int(dim), int(count))
        for dim, count in zip(*np.unique(cone_dims, return_counts=True), strict=True)
    )
    friction = contact.friction[len(dims) - len(cone_dims) :]
    mu = friction[:, :1] / jnp.sqrt(model.opt.impratio)
    return Layout(*_counts(model), cones), ConstraintProblem(
        inertia=mjx.full_m(model, data),
        smooth=data.qfrc_smooth,
        jacobian=rows.efc_J,
        aref=rows.efc_aref,
        stiffness=rows.efc_D,
        frictionloss=rows.efc_frictionloss,
        cone=jnp.concatenate([mu, friction], axis=1),
    )


def as_made(model: mjx.Model, prepared: mjx.Model, data: Solved) -> mjx.Data:
    """Data as it was made for a model: without the rows of dry friction that only the prepared model has."""
    has, had = (
        np.concatenate(
            [
                np.asarray(source._impl.dof_hasfrictionloss),
                np.asarray(source._impl.tendon_hasfrictionloss),
            ]
        )
        for source in (prepared, model)
    )
    equality, dry = _counts(prepared)
    stays = np.ones(len(inner(data).efc_J), bool)
    if stays.size and dry:
        stays[equality : equality + dry] = had[has]
    if stays.all():
        return data.plain()
    changes = {f"_impl.{name}": getattr(inner(data), name)[stays] for name in _ROW_FIELDS}
    changes["_impl.contact.efc_address"] = inner(data).contact.efc_address - np.sum(~stays)
    cut: mjx.Data = data.plain().tree_replace(changes)
    return cut


def with_joint_inertia(model: mjx.Model, data: mjx.Data, lower: Float[Array, "nv nv"]) -> mjx.Data:
    """Data with the joint-space inertia, stored as MJX stores it.

    Args:
        lower: its entries (i, j) where j is i or one of its ancestors; others are not read.
    """
    row, column = np.repeat(np.arange(model.nv), model.M_rownnz), np.asarray(model.M_colind)
    if inner(data).M.ndim == 1:
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
    old, arms = inner(data).M, inner(data).ten_J
    added = arms.T @ (model.tendon_armature[:, None] * arms)
    if old.ndim == 1:
        added = added[np.repeat(np.arange(model.nv), model.M_rownnz), np.asarray(model.M_colind)]
    else:
        added = jnp.where(within_branches(model), added, 0.0)
    changed: mjx.Data = data.tree_replace({"_impl.M": old + added})
    return changed


def within_branches(model: mjx.Model) -> Bool[np.ndarray, "nv nv"]:
    """The entries of a joint-space inertia matrix: those of two joints of which one is an ancestor of the other."""
    stored = np.zeros((model.nv, model.nv), bool)
    stored[np.repeat(np.arange(model.nv), model.M_rownnz), np.asarray(model.M_colind)] = True
    return stored | stored.T


def _counts(model: mjx.Model) -> tuple[int, int]:
    """Numbers of rows of equalities and of dry friction."""
    kinds, off = np.asarray(model.eq_type), model.opt.disableflags
    sizes = {mjx.EqType.CONNECT: 3, mjx.EqType.WELD: 6}
    equality = sum(sizes.get(mjx.EqType(kind), 1) for kind in kinds)
    flags: Any = model._impl
    dry = int(flags.dof_hasfrictionloss.sum() + flags.tendon_hasfrictionloss.sum())
    return equality * (not off & mjx.DisableBit.EQUALITY), dry * (
        not off & mjx.DisableBit.FRICTIONLOSS
    )


def _in_row_order(contact: Any) -> tuple[Any, np.ndarray]:
    """Contacts in the order of their rows, which is by dimension, and their dimensions."""
    dims = np.asarray(contact.dim)
    order = np.argsort(dims, kind="stable")
    if (order == np.arange(len(dims))).all():
        return contact, dims
    return jax.tree.map(lambda leaf: leaf[order], contact), dims[order]
