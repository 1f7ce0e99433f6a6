"""Constants that MuJoCo derives from masses and positions in `mj_setConst`, as differentiable functions of them.

MJX reads them, for example in the regularisation of its constraints, but cannot compute them. All follow from the
inertia matrix in the reference pose. It is linear in masses and inertias: where nothing else varies, its coefficients
are taken from MuJoCo's Jacobians once, so that a batch, or a gradient, needs no second kinematics (`MassConstants`).
Where positions vary, MJX's kinematics gives them (`PlaceConstants`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.shapes import Array

#: Joint types whose degrees of freedom share one inverse weight, in groups of three.
_INVERSE_WEIGHT_GROUPS = {int(mujoco.mjtJoint.mjJNT_FREE): 2, int(mujoco.mjtJoint.mjJNT_BALL): 1}


_JOINT_TRANSMISSIONS: Final = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)

#: Prefixes of the fields that the reference pose depends on.
_POSE_PREFIXES: Final = ("body_", "site_", "geom_")


class Jacobians(NamedTuple):
    """The Jacobians, in the reference pose, that the constants depend on.

    Attributes:
        linear, angular: of the bodies' centres of mass, and of their rotation, in the world.
        principal: of the same rotation, about the bodies' principal axes.
        tendon, moment: of tendons and actuators.
    """

    linear: Float[Array | np.ndarray, "nbody 3 nv"]
    angular: Float[Array | np.ndarray, "nbody 3 nv"]
    principal: Float[Array | np.ndarray, "nbody 3 nv"]
    tendon: Float[Array | np.ndarray, "ntendon nv"]
    moment: Float[Array | np.ndarray, "nu nv"]


class Constants:
    """Maps masses, inertias and Jacobians of a model to the constants."""

    def __init__(self, model: mujoco.MjModel) -> None:
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        if data.warning[mujoco.mjtWarning.mjWARN_INERTIA].number:
            raise ValueError(
                "the inertia of the joints has no inverse at qpos0: allowed are bodies with mass, each direction of "
                "which is moved by one joint alone, or armatures."
            )
        below = np.eye(model.nbody)
        for body in range(model.nbody - 1, 0, -1):
            below[model.body_parentid[body]] += below[body]
        self._below = below
        self._moves = model.body_weldid != 0
        self._group = _groups(model)
        joints, tendons = _of_actuators(model)
        self._armature = model.dof_armature + joints[model.dof_jntid]
        self._tendon_armature = model.tendon_armature + tendons
        # Bodies that only slide, and their joints, have the inverse of their mass.
        self._slides = model.body_simple == 2
        self._slides_of_dof = self._slides[model.dof_bodyid]
        self._body_of_dof = model.dof_bodyid.copy()
        within = np.zeros((model.nv, model.nv), bool)
        within[np.repeat(np.arange(model.nv), model.M_rownnz), model.M_colind] = True
        self._within_branches = within | within.T

    def __call__(
        self,
        body_mass: Float[Array, " nbody"],
        body_inertia: Float[Array, "nbody 3"],
        jacobians: Jacobians,
    ) -> dict[str, Float[Array, ...]]:
        """The fields of `DERIVED_FIELDS`, shaped as in `mujoco.MjModel`; masses [kg], principal moments [kg m^2]."""
        linear, angular, principal, tendon, moment = (
            jnp.asarray(matrix, float) for matrix in jacobians
        )
        bodies = (
            jnp.einsum("b,bki,bkj->ij", body_mass, linear, linear)
            + jnp.einsum("bk,bki,bkj->ij", body_inertia, principal, principal)
            + jnp.diag(jnp.asarray(self._armature, float))
        )
        tendons = jnp.einsum(
            "t,ti,tj->ij", jnp.asarray(self._tendon_armature, float), tendon, tendon
        )
        inverse = jnp.linalg.inv(bodies + jnp.where(self._within_branches, tendons, 0.0))

        def weight(jacobian: Array) -> Array:
            return jnp.einsum("...i,ij,...j->...", jacobian, inverse, jacobian)

        body = jnp.stack([weight(part).mean(axis=-1) for part in (linear, angular)], axis=-1)
        dof = jnp.asarray(self._group, float) @ jnp.diag(inverse)
        if self._slides.any():
            sliding = 1.0 / jnp.where(self._slides, body_mass, 1.0)
            translation_only = jnp.stack([sliding, jnp.zeros_like(sliding)], axis=-1)
            body = jnp.where(self._slides[:, None], translation_only, body)
            dof = jnp.where(self._slides_of_dof, sliding[self._body_of_dof], dof)
        return {
            "body_subtreemass": jnp.asarray(self._below, float) @ body_mass,
            "body_invweight0": jnp.where(self._moves[:, None], body, 0.0),
            "dof_invweight0": dof,
            "dof_M0": jnp.diag(bodies),
            "tendon_invweight0": weight(tendon),
            "actuator_acc0": jnp.sqrt(jnp.sum((moment @ inverse) ** 2, axis=-1)),
        }


class MassConstants:
    """Maps the masses and inertias of a model's bodies to the constants; the rest of the model is constant."""

    def __init__(self, model: mujoco.MjModel) -> None:
        data = mujoco.MjData(model)
        data.qpos[:] = model.qpos0
        mujoco.mj_forward(model, data)
        jacobians = np.zeros((model.nbody, 2, 3, model.nv))
        for body in range(model.nbody):
            mujoco.mj_jacBodyCom(model, data, jacobians[body, 0], jacobians[body, 1], body)
        # Rotations about the principal axes of each body.
        principal = np.einsum("bij,bik->bjk", data.ximat.reshape(-1, 3, 3), jacobians[:, 1])
        tendon = np.zeros((model.ntendon, model.nv))
        if model.ntendon:
            mujoco.mju_sparse2dense(
                tendon, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind
            )
        moment = np.zeros((model.nu, model.nv))
        if model.nu:
            mujoco.mju_sparse2dense(
                moment,
                data.actuator_moment,
                data.moment_rownnz,
                data.moment_rowadr,
                data.moment_colind,
            )
        self._jacobians = Jacobians(jacobians[:, 0], jacobians[:, 1], principal, tendon, moment)
        self._constants = Constants(model)

    def __call__(
        self, body_mass: Float[Array, " nbody"], body_inertia: Float[Array, "nbody 3"]
    ) -> dict[str, Float[Array, ...]]:
        """The fields of `DERIVED_FIELDS`, shaped as in `mujoco.MjModel`.

        Args:
            body_mass: [kg].
            body_inertia: principal moments [kg m^2].
        """
        return self._constants(body_mass, body_inertia, self._jacobians)


class PlaceConstants:
    """Maps a model's fields of positions and masses to the constants."""

    def __init__(self, model: mujoco.MjModel) -> None:
        from nermo_mjx.dynamics.mjx_copy import put_model  # importing MJX takes a second

        self._model = put_model(model)
        self._constants = Constants(model)

    def __call__(self, fields: Mapping[str, Float[Array, ...]]) -> dict[str, Float[Array, ...]]:
        """The fields of `DERIVED_FIELDS`, shaped as in `mujoco.MjModel`.

        Args:
            fields: those of bodies, sites and geoms that differ from the model's.
        """
        from nermo_mjx.dynamics import rows, tree
        from nermo_mjx.dynamics.jacobians import point_jacobian
        from nermo_mjx.dynamics.mjx_copy import adapted, make_data

        model = self._model.tree_replace(
            {name: value for name, value in fields.items() if name.startswith(_POSE_PREFIXES)}
        )
        data = make_data(self._model)
        data = data.replace(qpos=jnp.asarray(self._model.qpos0, data.qpos.dtype))
        data = tree.com_pos(model, tree.kinematics(model, data))
        data = adapted.smooth.transmission(model, adapted.smooth.tendon(model, data))
        bodies = np.arange(model.nbody)
        linear, angular = jax.vmap(lambda point, body: point_jacobian(model, data, point, body))(
            data.xipos, bodies
        )
        linear, angular = jnp.swapaxes(linear, 1, 2), jnp.swapaxes(angular, 1, 2)
        principal = jnp.einsum("bij,bik->bjk", data.ximat, angular)
        jacobians = Jacobians(
            linear, angular, principal, rows.inner(data).ten_J, rows.inner(data).actuator_moment
        )
        return self._constants(model.body_mass, model.body_inertia, jacobians)


def _of_actuators(
    model: mujoco.MjModel,
) -> tuple[Float[np.ndarray, " njnt"], Float[np.ndarray, " ntendon"]]:
    """The armature that actuators give each joint and tendon: theirs, times the square of the gear."""
    joints, tendons = np.zeros(model.njnt), np.zeros(model.ntendon)
    reflected_inertia = model.actuator_armature * model.actuator_gear[:, 0] ** 2
    for kinds, element_index in (
        (_JOINT_TRANSMISSIONS, joints),
        ((mujoco.mjtTrn.mjTRN_TENDON,), tendons),
    ):
        is_of_kind = np.isin(model.actuator_trntype, kinds)
        np.add.at(element_index, model.actuator_trnid[is_of_kind, 0], reflected_inertia[is_of_kind])
    return joints, tendons


def _groups(model: mujoco.MjModel) -> Float[np.ndarray, "nv nv"]:
    """Averages the degrees of freedom that share an inverse weight."""
    average = np.eye(model.nv)
    for kind, first in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        for group in range(_INVERSE_WEIGHT_GROUPS.get(int(kind), 0)):
            span = slice(first + 3 * group, first + 3 * group + 3)
            average[span, span] = 1.0 / 3.0
    return average
